"""Pictures of a socket with its tiles: on paper, and as a page that turns under the mouse."""
