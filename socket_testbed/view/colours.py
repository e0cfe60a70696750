"""Colours of a socket and its tiles, which differ in lightness, too."""

from __future__ import annotations

SURFACE = "#D9D9D9"
VEIL = "#A8A8A8"  # the surface where one sees through it
TILE = "#A6CBE3"
CLUSTER = "#D55E00"  # Okabe & Ito's vermilion
EDGE = "#2B5C7D"
NO_VALUE = "#FFFFFF"
PROXIMAL = "#333333"
AXES = ("#B2182B", "#1B7837", "#2166AC")  # x, y, z
SCALE = "cividis"  # Nunez et al. 2018, doi:10.1371/journal.pone.0199239: even in lightness
