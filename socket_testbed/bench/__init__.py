"""Bench data of a cluster: read, fitted, and judged before anybody believes a coefficient."""
