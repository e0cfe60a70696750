"""Trials: self-describing recorded bags, read as synchronised samples."""
