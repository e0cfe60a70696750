"""Motion capture: a client of NatNet servers, and the bodies that it tracks."""
