"""Settings of the package: the only home of their defaults."""
