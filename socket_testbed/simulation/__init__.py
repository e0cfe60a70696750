"""Simulated trials; their physics differs from the estimator's law."""
