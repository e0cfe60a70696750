"""Counterparts of the drivers: simulated chips, lines and servers, with faults."""
