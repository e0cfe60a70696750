"""Simulated trials, from a physics that is not the estimator's law."""
