"""Registration: from a static take of the motion capture to the frames of its bodies."""
