"""The interior of a socket covered with square tiles that do not overlap."""
