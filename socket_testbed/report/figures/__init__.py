"""Figures of sockets, channels and trade-offs."""
