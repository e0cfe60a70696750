"""Motion capture: a NatNet client, and the bodies it tracks."""
