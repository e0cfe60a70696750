"""Software of an instrumented prosthetic-socket testbed."""

__version__ = "0.1.0"
