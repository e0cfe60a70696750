"""Units and frames, which show in sizes: of tiles, positions, forces, moments and rotations.

Every rule is a function. It yields what it finds with the channels whose unit it doubts, because
whatever else such a channel seems to show, its unit causes. Values that no person applies go before
the other sizes (`_RULES_OF_SIZES`): beside them these say nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, groupby
from typing import NamedTuple

import numpy as np

from socket_testbed.arrays import finite_quantile
from socket_testbed.errors import IdentificationError
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification import plausibility
from socket_testbed.identification.data_finding import DataFinding
from socket_testbed.samples import GRAVITY, MOMENTS, WRENCH_CHANNELS, Samples, force_magnitude

AREA_RATIO = (0.1, 10.0)  # [-]; squared distance of neighbouring tiles over their area; 1.5
MIN_LEVER = 3e-4  # [m]; usual moment over usual load; sound 0.0076 and more
LOAD_RANGE = (0.12, 5.0)  # [-]; load over the weight of a stated mass; 0.10 for kgf when standing
MAX_ROTATION = 0.7  # [rad]; of the limb from its mean attitude; sound 0.04
USUAL_QUANTILE = 0.95  # [-]; of a magnitude, its usual size
MOMENT_CHANNELS = tuple(WRENCH_CHANNELS[MOMENTS])
LOAD = "load"  # stands for the size of the load among names of channels
POSE = "pose"  # stands for the limb's pose among names of channels


class Doubt(NamedTuple):
    """A finding on a unit.

    Attributes:
        finding: The finding.
        channels: Names of the channels whose unit it doubts, or `LOAD` or `POSE`; empty if it is
            about none of them.
    """

    finding: DataFinding
    channels: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Sizes:
    """The sizes of a trial, in which rules find units.

    Attributes:
        samples: The N samples, with rotations since the mean attitude.
        geometry: The socket.
        mass: Mass of the person [kg]; None if it is unknown.
        leave_out: Names of channels that are not checked.
    """

    samples: Samples
    geometry: SocketGeometry
    mass: float | None
    leave_out: tuple[str, ...]

    @cached_property
    def force(self) -> float:
        """The usual force of the wrench [N]."""
        return finite_quantile(force_magnitude(self.samples.wrench), USUAL_QUANTILE)

    @cached_property
    def moment(self) -> float:
        """The usual moment of the wrench [N m]."""
        moments = self.samples.wrench[:, MOMENTS]
        return finite_quantile(np.linalg.norm(moments, axis=1), USUAL_QUANTILE)

    @cached_property
    def rotation(self) -> float:
        """The usual rotation of the limb [rad]."""
        return finite_quantile(np.linalg.norm(self.samples.rotation, axis=1), USUAL_QUANTILE)


def check_units(
    samples: Samples, geometry: SocketGeometry, mass: float | None, leave_out: tuple[str, ...]
) -> list[Doubt]:
    """Units and frames that cannot be right, in the order of the rules.

    Args:
        samples: The N samples, with rotations since the mean attitude.
        geometry: The socket.
        mass: Mass of the person [kg]; None if it is unknown.
        leave_out: Names of channels that are not checked.
    """
    sizes = _Sizes(samples, geometry, mass, leave_out)
    beyond = [*_values_beyond_a_person(sizes)]
    rules = () if beyond else _RULES_OF_SIZES
    others = chain.from_iterable(rule(sizes) for rule in rules)
    return [*_areas_unlike_distances(sizes), *_limb_beyond_the_socket(sizes), *beyond, *others]


def _areas_unlike_distances(sizes: _Sizes) -> Iterator[Doubt]:
    """Areas of tiles that do not fit their distances.

    In the median of neighbouring tiles, the squared distance over the area is outside `AREA_RATIO`.
    """
    geometry = sizes.geometry
    one, other = geometry.neighbours.T
    if not len(one):
        return
    squares = ((geometry.anchors[one] - geometry.anchors[other]) ** 2).sum(axis=1)
    areas = np.sqrt(geometry.areas[one] * geometry.areas[other])
    ratio = float(np.median(squares / areas))
    if not AREA_RATIO[0] <= ratio <= AREA_RATIO[1]:
        area, distance = 1e4 * np.median(areas), 1e3 * np.sqrt(np.median(squares))
        finding = DataFinding(
            "the socket",
            f"its tiles have {area:.2g} cm^2, and the next one is {distance:.2g} mm away",
            "check that areas are in m^2 and anchors in m in socket.yaml",
        )
        yield Doubt(finding)


def _limb_beyond_the_socket(sizes: _Sizes) -> Iterator[Doubt]:
    """A limb too far from the load cell, or that moves too far: `plausibility.require_position`."""
    try:
        plausibility.require_position(sizes.samples, sizes.geometry)
    except IdentificationError as error:
        yield Doubt(DataFinding("the units", error.fact, error.hint), (POSE,))


def _values_beyond_a_person(sizes: _Sizes) -> Iterator[Doubt]:
    """Values that no person applies, a finding per source: `plausibility.wrong_units`."""
    wrong = plausibility.wrong_units(sizes.samples, sizes.geometry, sizes.leave_out)
    for channels, excess in wrong:
        yield Doubt(DataFinding("the units", excess.fact, excess.hint), channels)


def _channels_beyond_the_load(sizes: _Sizes) -> Iterator[Doubt]:
    """Moments or clusters beyond the measured load, a finding per source.

    The limits are those of `plausibility.find_implausible`. A cluster's unit is not in doubt: its
    sensor or its calibration may be wrong as well.
    """
    proposed = plausibility.find_implausible(sizes.samples, sizes.geometry)
    implausible = [each for each in proposed if each.channel not in sizes.leave_out]
    for source, group in groupby(implausible, lambda each: each.channel.rpartition(".")[0]):
        own = [*group]  # of the wrench, then of each cluster
        hint = "check that moments are in N m and forces in N, and the load cell's channels"
        if source:
            channels = dict.fromkeys(each.channel for each in own)
            hint = f"check its calibration, or leave it out (--leave-out {' '.join(channels)})"
        finding = DataFinding(source or "the wrench", f"{own[0].channel}: {own[0].reason}", hint)
        yield Doubt(finding, () if source else MOMENT_CHANNELS)


def _moments_without_a_lever(sizes: _Sizes) -> Iterator[Doubt]:
    """Moments that the force would have at a lever below `MIN_LEVER`.

    They are judged under a load above `plausibility.MIN_LOAD`, and if none is left out or zero.
    """
    force, moment = sizes.force, sizes.moment
    counted = not {*MOMENT_CHANNELS} & {*sizes.leave_out}
    if counted and force > plausibility.MIN_LOAD and 0.0 < moment < MIN_LEVER * force:
        finding = DataFinding(
            "the wrench",
            f"its moment of {moment:.2g} N m is that of its force of {force:.3g} N at a lever of"
            f" {1e3 * moment / force:.2g} mm",
            "check that moments are in N m (kN m?), and the load cell's matrix",
        )
        yield Doubt(finding, MOMENT_CHANNELS)


def _load_unlike_the_mass(sizes: _Sizes) -> Iterator[Doubt]:
    """A load outside `LOAD_RANGE` times the weight of the stated mass, if one is stated."""
    if not sizes.mass or not sizes.samples.has_wrench.any():
        return
    weights = sizes.force / (GRAVITY * sizes.mass)
    if not LOAD_RANGE[0] <= weights <= LOAD_RANGE[1]:
        finding = DataFinding(
            "the wrench",
            f"its force of {sizes.force:.3g} N is {weights:.2g} weights of the stated"
            f" {sizes.mass:g} kg",
            "check that forces are in N (kgf, kN?), and the mass",
        )
        yield Doubt(finding, (LOAD,))


def _limb_turned_too_far(sizes: _Sizes) -> Iterator[Doubt]:
    """A limb that turns in the socket by more than `MAX_ROTATION`."""
    if sizes.rotation > MAX_ROTATION:
        finding = DataFinding(
            "the limb pose",
            f"the limb turns by {np.degrees(sizes.rotation):.0f} deg in the socket",
            "check the order of the quaternion (x, y, z, w), and the marker bodies",
        )
        yield Doubt(finding, (POSE,))


_RULES_OF_SIZES = (
    _channels_beyond_the_load,
    _moments_without_a_lever,
    _load_unlike_the_mass,
    _limb_turned_too_far,
)
