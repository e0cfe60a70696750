"""Identification of the contact model by convex least squares, in two stages."""
