"""What the colours of the scene say: the quantity, its scale, and the state of the map in words."""

from __future__ import annotations

import math
from html import escape

import numpy as np
from matplotlib import colormaps
from viser import ViserServer

from socket_testbed.geometry.regions import anatomical_regions
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.pressure import NORMAL_QUANTILE, SHARE, of_deviations
from socket_testbed.report.figures.style import FONT, SCALE

PRESSURE, SHEAR, DEVIATION = "normal pressure", "shear", "standard deviation"

_KPA = 1e3  # [Pa]
_LEAST = 2.0  # [kPa]; upper end of an automatic scale at least
_FALLS = 0.4  # [-]; of the scale, below which the values let an automatic scale fall
_STEPS = (1.0, 2.0, 3.0, 5.0)  # times a power of ten, upper ends of automatic scales
_TICKS = 5
_STOPS = ", ".join(
    f"rgb({red:.0f} {green:.0f} {blue:.0f})"
    for red, green, blue, _ in 255.0 * colormaps[SCALE](np.linspace(0.0, 1.0, 9))
)


class Legend:
    """The colour bar of a page, with the choice of what is shown, the same in all browsers.

    Args:
        server: Serves the page.
        geometry: Geometry of the socket.

    Attributes:
        quantity: What the colours show: `PRESSURE`, `SHEAR` or `DEVIATION`, of the pressure.
        limit: Upper end of the scale, whose lower end is 0 [Pa].
    """

    def __init__(self, server: ViserServer, geometry: SocketGeometry) -> None:
        gui = server.gui
        self._geometry = geometry
        self._places = _places(geometry)
        self.quantity = PRESSURE
        self.limit = 30.0 * _KPA
        self._words = gui.add_html("")
        self._choice = gui.add_dropdown("colours", (PRESSURE, SHEAR, DEVIATION))
        self._bar = gui.add_html("")
        self._automatic = gui.add_checkbox("automatic scale", True)
        self._end = gui.add_number("scale to [kPa]", 30.0, min=0.1, step=1.0, visible=False)

        @self._automatic.on_update
        def _(event: object) -> None:
            self._end.visible = not self._automatic.value

    def update(self, estimate: MapEstimate | None) -> None:
        """Show the scale and the words of a map."""
        self.quantity = self._choice.value
        if estimate is None:
            self._words.content = _said("no force map", "the estimator is silent", False)
            return
        values = {
            PRESSURE: estimate.normal_pressure,
            SHEAR: estimate.shear,
            DEVIATION: estimate.normal_pressure_standard_deviation,
        }[self.quantity][0]
        highest = float(np.nanmax(values, initial=0.0)) / _KPA
        end = self.limit / _KPA
        if not self._automatic.value:
            end = float(self._end.value)
        elif highest > end or highest < _FALLS * end:
            end = upper_end(highest)
        self.limit = end * _KPA
        self._bar.content = _bar(end, self.quantity)
        self._words.content = self._describe(estimate)

    def _describe(self, estimate: MapEstimate) -> str:
        """The peak, how well it is known, and how much of the map is determined."""
        pressure = estimate.normal_pressure[0]
        deviation = estimate.normal_pressure_standard_deviation[0]
        if not np.isfinite(pressure).any():
            return _said("no force map", estimate.source, False)
        peak = int(np.nanargmax(pressure))
        known = of_deviations(pressure, deviation).determined(SHARE)
        reach = NORMAL_QUANTILE * deviation[peak] / _KPA
        head = f"peak {pressure[peak] / _KPA:.0f} ± {reach:.0f} kPa, {self._places[peak]}"
        body = f"determined on {known.sum()} of {len(pressure)} tiles; {estimate.source}"
        return _said(head, body, bool(known[peak]), self._missing(estimate))

    def _missing(self, estimate: MapEstimate) -> str:
        """Which channels the map lacks, in words; empty if none."""
        measured = estimate.source.partition("measured: ")[2].split(", ")
        lacking = [name for name in ("wrench", *self._geometry.clusters) if name not in measured]
        return f"without {', '.join(lacking)}" if lacking else ""


def upper_end(highest: float) -> float:
    """The end of a scale to a value [kPa]: 1, 2, 3 or 5 times a power of ten."""
    highest = max(highest, _LEAST)
    decade = 10.0 ** math.floor(math.log10(highest))
    return next(step * decade for step in (*_STEPS, 10.0) if step * decade >= highest)


def _places(geometry: SocketGeometry) -> list[str]:
    """Where each tile is, in words."""
    words = [""] * len(geometry)
    for region in anatomical_regions(geometry):
        for tile in region.tiles:
            words[tile] = region.name  # the last and smallest one
    for name, tile in geometry.clusters.items():
        words[tile] = f"measured by {name}"
    return words


def _bar(end: float, quantity: str) -> str:
    ticks = "".join(f"<span>{end * tick / (_TICKS - 1):g}</span>" for tick in range(_TICKS))
    faint = (
        ""
        if quantity == DEVIATION
        else ("<div>full squares are determined; the smaller, the wider the 95 % interval</div>")
    )
    return (
        f'<div style="padding:0 1em;font:12px {FONT}">'
        f'<div style="height:14px;background:linear-gradient(to right,{_STOPS})"></div>'
        f'<div style="display:flex;justify-content:space-between">{ticks}</div>'
        f"<div>{quantity} [kPa]</div>{faint}</div>"
    )


def _said(head: str, body: str, certain: bool, warning: str = "") -> str:
    colour = "inherit" if certain else "#8a8a8a"
    return (
        f'<div style="padding:0.5em 1em;font:12px {FONT}">'
        f'<div style="font-size:17px;font-weight:600;color:{colour}">{escape(head)}</div>'
        f'<div style="font-weight:600;color:#b35900">{escape(warning)}</div>'
        f"<div>{escape(body)}</div></div>"
    )
