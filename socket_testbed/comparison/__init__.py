"""Trials, models or sockets side by side."""
