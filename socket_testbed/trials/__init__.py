"""Trials: recorded bags that explain themselves, read as synchronised samples."""
