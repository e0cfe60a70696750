"""The scene with holes in its wrenches and markers, and without some of its samples."""

from pathlib import Path
from typing import Any

import numpy as np

from socket_testbed.wire.cdr import stamp_of
from support import scene
from support.bags import rewrite

NO_WRENCH = (0, 40, 41, 42, 43)  # rows of the scene's samples
HALF_WRENCH = (90, 91)
LAST_MARKER_HIDDEN = (0, 50, 51, 52, 95)


def row_of(message: Any) -> int:
    """The row of the sample to which a message belongs."""
    return int(np.searchsorted(scene.STAMPS, stamp_of(message)))


def with_holes(source: Path, target: Path) -> Path:
    """A copy of the scene without some wrenches, moments about x, and last markers."""

    def spoil(topic: str, message: Any) -> Any:
        row = row_of(message)
        if topic == "/load_cell/wrench":
            if row in NO_WRENCH:
                return None
            if row in HALF_WRENCH:
                message.wrench.torque.x = np.nan
        if topic == "/mocap/markers" and row in LAST_MARKER_HIDDEN:
            (pylon,) = (body for body in message.bodies if body.name == "pylon")
            place = pylon.markers[2]
            place.x = place.y = place.z = np.nan
        return message

    return rewrite(source, target, spoil)


def without_samples(source: Path, target: Path, *rows: int) -> Path:
    """A copy of the scene without all messages of some samples, given by their rows."""
    return rewrite(source, target, lambda _, m: None if row_of(m) in rows else m)
