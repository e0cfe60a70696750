"""Capacitance to stress: applied to clusters, and identified from bench data."""
