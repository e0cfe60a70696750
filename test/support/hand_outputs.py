"""What the document functions make of numbers in SI units that were written by hand.

On `small_socket`: 20 kPa everywhere, known within 5 kPa, but 40 kPa on `left2`.
"""

from typing import Any

import numpy as np

from socket_testbed.geometry.regions import all_regions
from socket_testbed.identification.pressure import Quantity, RegionOutputs
from socket_testbed.pages import document
from support.problems import small_socket

GEOMETRY = small_socket()
PLACES = all_regions(GEOMETRY, "left")
PRESSURE = np.full(len(GEOMETRY), 20e3)  # [Pa]
PRESSURE[GEOMETRY.names.index("left2")] = 40e3
REACH = np.full(len(GEOMETRY), 5e3)  # [Pa]
SHEAR = np.full(len(GEOMETRY), 2e3)  # [Pa]
MEASURED = np.array([21.26e3, np.nan])  # of front and side [Pa]
TIME = np.array([0.0, 10.0, 40.0])  # [s]
FORCE = np.array([100.0, 800.0, -20.0])  # [N]
PEAK = Quantity(
    *(1e3 * np.array([[5.0, 50.0, 8.0], [2.0, 40.0, 6.0], [9.0, 70.0, 11.0], [1.0] * 3]))
)


def _everywhere(value: float, low: float, high: float, *axes: int) -> Quantity:
    shape = (len(PLACES), *axes)
    return Quantity(*(np.full(shape, number) for number in (value, low, high, value)))


OUTPUTS = RegionOutputs(
    mean=_everywhere(15e3, 12e3, 18e3),  # [Pa]
    peak=_everywhere(40e3, 30e3, 62.5e3),  # [Pa]
    area=_everywhere(9e-3, 8e-3, 1e-2),
    integral=_everywhere(np.nan, np.nan, np.nan),
    centre=_everywhere(0.01, 0.0, 0.02, 3),
    shear=_everywhere(2e3, 1e3, 3e3),  # [Pa]
    direction=_everywhere(0.1, 0.0, 0.2),
    share=_everywhere(0.25, 0.2, 0.3),  # [-]
)


def made_socket() -> dict[str, Any]:
    """The socket, of a left leg: lateral is to the left."""
    return document.socket_document(GEOMETRY, "left")


def made_moment(time: float = 12.5, factor: float = 1.0) -> dict[str, Any]:
    """The moment, its pressures times a factor."""
    return document.moment(time, factor * PRESSURE, REACH, SHEAR, MEASURED)


def made_course() -> dict[str, Any]:
    """Force and peak over 40 s, with an event at 10 s."""
    return document.course(TIME, FORCE, PEAK, [(10.0, "push")])


def made_bars() -> dict[str, Any]:
    """The outputs of the regions."""
    return document.bars(PLACES, OUTPUTS)


def made_cards(when: str = "") -> list[dict[str, Any]]:
    """The cards of the pressure, and that of good data."""
    shown = document.cards(GEOMETRY, PLACES, OUTPUTS, PRESSURE, MEASURED, when)
    return [*shown, document.check_card([], [])]
