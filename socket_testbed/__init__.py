"""Software of an instrumented prosthetic-socket testbed."""
