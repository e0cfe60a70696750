"""Settings of nodes, fits and maps; their defaults are defined only here."""
