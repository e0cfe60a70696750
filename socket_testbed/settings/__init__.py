"""Settings of the package; their defaults are defined only here."""
