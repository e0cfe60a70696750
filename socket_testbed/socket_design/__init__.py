"""From a scan to tiles, and from landmarks to registered marker bodies."""
