"""Where things are: the socket's tiles, the marker triads, and poses."""
