"""Calibration of clusters, capacitance to stress, and its identification from bench data."""
