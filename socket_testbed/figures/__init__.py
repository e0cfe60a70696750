"""Figures of values: a print style, the unrolled wall, maps of tiles, regions over time."""
