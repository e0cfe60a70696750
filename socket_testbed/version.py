"""The version of this package, as MAJOR.MINOR.PATCH."""

__version__ = "0.3.0"
