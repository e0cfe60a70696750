"""From a scan to tiles; from landmarks to registered marker bodies."""
