"""Geometry: the socket's tiles, the marker bodies, and poses."""
