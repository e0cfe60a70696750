"""Surveys with values by hand, and their files."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.map_prior import hypotheses
from socket_testbed.identification.survey import Donned
from socket_testbed.identification.survey_prior import FORMAT, SurveyPrior
from socket_testbed.settings.identification import ForceMapSettings


def prior_by_hand(
    geometry: SocketGeometry,
    tiles: tuple[int, ...] = (0, 1),
    load: Sequence[float] = (0.0, 0.6, 0.0, 0.0, 0.0, -200.0),
    forces: Sequence[Sequence[float]] = ((0.5, 0.0, -8.0), (0.5, 0.0, -8.0)),
) -> SurveyPrior:
    """Two trials `a` and `b` with a cluster each, at two loads, of which the second is half.

    Args:
        geometry: The socket.
        tiles: The tile under each trial's cluster.
        load: The first load, [M; F] on the socket in {S} [N m, N].
        forces: Force on each trial's cluster at this load, in its tile's frame [N].
    """
    (sizes,) = hypotheses(ForceMapSettings(draws=1), geometry.tile_share)
    share = np.array([1.0, 0.5])[:, None]
    wrench = share * np.array(load)
    return SurveyPrior(
        geometry=geometry,
        trials=("a", "b"),
        fingerprints=("of a", "of b"),
        clusters=(("one",), ("two",)),
        donned=tuple(
            Donned((tile,), np.hstack([wrench, share * np.array(force)]))
            for tile, force in zip(tiles, forces, strict=True)
        ),
        changes=np.array([0.1, 0.3]),
        hypotheses=(sizes,),
        weights=np.array([[0.75, 0.25]]),
    )


def write_survey_file(path: Path, prior: SurveyPrior, **changed: Any) -> Path:
    """Write the file of a survey, in which some parts of its prior are others."""
    document = prior.document() | changed
    path.write_text(json.dumps({"format": FORMAT, "verdict": "by hand", "prior": document}))
    return path
