"""The socket in 3D, its tiles coloured, shear as arrows; and the legend of the colours."""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from viser import SceneApi, ViserServer

from socket_testbed.arrays import FloatArray
from socket_testbed.geometry.axis import SocketAxis, socket_axis
from socket_testbed.geometry.pose import Pose
from socket_testbed.geometry.regions import anatomical_regions
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.identification.force_map import MapEstimate
from socket_testbed.identification.pressure import NORMAL_QUANTILE, SHARE
from socket_testbed.report.figures.style import CLUSTER, FONT, SCALE, SURFACE, VEIL
from socket_testbed.report.figures.tiles import wall_tiles
from socket_testbed.viewer.source import Instant

PRESSURE, SHEAR, DEVIATION = "normal pressure", "shear", "standard deviation"

_SMALLEST = 0.4  # [-]; edge of a tile of which nothing is known, by its own
_LARGEST = 0.92  # [-]; edge of a tile whose value is certain
_PALEST = 0.6  # [-]; of a tile's colour, the rest is white
_STEPS = 20  # of certainty: a tile keeps its size while that hardly changes
_SQUARE = 0.5 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
_THICK = np.array([0.0, 0.0, 0.04])  # [-]; of a value above and below its plate, by its edge
_BOTH_SIDES = np.vstack([_SQUARE + _THICK, _SQUARE - _THICK])
_FACES = np.array([[0, 1, 2], [0, 2, 3]])
_COLOURS = 255.0 * mpl.colormaps[SCALE](np.linspace(0.0, 1.0, 256))[:, :3]
_PLATE = 0.98  # [-]; edge of the plate below a value, by the tile's
_OUTLINE = 0.002  # [m]; of tiles with a cluster
_LONGEST = 0.03  # [m]; arrow of the strongest shear
_WEAKEST = 2e3  # [Pa]; that is as long as this shear at least
_ARROW, _UNSURE = np.array([178.0, 24.0, 43.0]), np.array([214.0, 190.0, 190.0])  # their colours
_LIMB = (224, 172, 140)
_MAP = 0.7  # [-]; scale of the unrolled wall
_VIEW = np.radians(32.0)  # [rad]; of the camera, from above to below
_AWAY = 1.3  # [-]; of names from the axis, by the socket's radius

_KPA = 1e3  # [Pa]
_LEAST = 2.0  # [kPa]; upper end of an automatic scale at least
_FALLS = 0.4  # [-]; of the scale, below which the values let an automatic scale fall
_ENDS = (1.0, 2.0, 3.0, 5.0, 10.0)  # times a power of ten, upper ends of automatic scales
_TICKS = 5
_STOPS = ", ".join(
    f"rgb({red:.0f} {green:.0f} {blue:.0f})"
    for red, green, blue in _COLOURS[np.linspace(0, 255, 9).astype(int)]
)


class Scene:
    """The scene of a page: the socket moves from where it was first seen in the world."""

    def __init__(self, server: ViserServer, geometry: SocketGeometry) -> None:
        self._geometry = geometry
        self._world: Pose | None = None  # in the scene
        self._drawn: tuple[object, ...] = ()
        self._strongest = _WEAKEST
        axis = socket_axis(geometry)
        scene = server.scene
        scene.set_up_direction(axis.proximal)
        # Colours are those of the bar from every side.
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(hdri=None)
        scene.add_light_ambient("/light", intensity=np.pi)
        self._socket = scene.add_frame("/socket", show_axes=False)
        self._limb = scene.add_frame("/limb", axes_length=0.04, axes_radius=0.001, visible=False)
        size = _Size.of(geometry, axis)
        poses = Pose(geometry.square_frames(), geometry.anchors)
        self._pictures = (
            _Tiles(scene, "/socket/tiles", poses, geometry),
            _Tiles(scene, "/map", _unroll(scene, geometry, axis, size), geometry, _MAP),
        )
        self._arrows = scene.add_arrows(
            "/socket/shear",
            np.zeros((1, 2, 3)),
            np.zeros((1, 3), dtype=np.uint8),
            shaft_radius=0.0009,
            head_radius=0.0025,
            head_length=0.005,
            visible=False,
        )
        _add_names(scene, axis, size)
        _add_limb(scene, axis, size)
        server.initial_camera.look_at = size.middle - 0.46 * size.height * axis.left
        server.initial_camera.fov = _VIEW
        server.initial_camera.position = size.middle + size.height * (
            4.1 * axis.anterior - 0.5 * axis.left + 1.4 * axis.proximal
        )

    def update(self, instant: Instant, legend: Legend) -> None:
        """Draw a sample in the colours of the legend."""
        wanted = (instant, legend.quantity, legend.limit)
        if wanted == self._drawn:
            return
        self._drawn = wanted
        self._place(instant)
        estimate = instant.map
        if estimate is None:
            for picture in self._pictures:
                picture.clear()
            self._arrows.visible = False
            return
        values, certainty = _shown(estimate, legend.quantity)
        colours = _colours(values / legend.limit, certainty)
        for picture in self._pictures:
            picture.paint(colours, certainty)
        self._draw_shear(estimate)

    def _draw_shear(self, estimate: MapEstimate) -> None:
        """An arrow on every tile whose shear is more than its standard deviation."""
        shear, deviation = estimate.shear[0], estimate.shear_standard_deviation[0]
        shown = shear > deviation
        self._arrows.visible = bool(shown.any())
        if not shown.any():
            return
        normals = self._geometry.rotations[shown, :, 2]
        forces = estimate.forces[0, shown]
        across = forces - (forces * normals).sum(axis=1, keepdims=True) * normals
        # Between longest and strongest, so that arrows grow with the load and do not jump.
        self._strongest = max(_WEAKEST, float(shear[shown].max()), 0.98 * self._strongest)
        traction = across / self._geometry.areas[shown, None]
        starts = self._geometry.anchors[shown]
        ends = starts + _LONGEST / self._strongest * traction
        certainty = _certainty(shear[shown], deviation[shown])[:, None]
        self._arrows.points = np.stack([starts, ends], axis=1).astype(np.float32)
        self._arrows.colors = _linear(_UNSURE + certainty * (_ARROW - _UNSURE))

    def _place(self, instant: Instant) -> None:
        """Move socket and limb as they move in the world."""
        socket, limb = instant.socket_in_world, instant.limb_in_world
        if socket is not None:
            if self._world is None:
                self._world = socket.inverse()
            moved = self._world @ socket
            self._socket.position, self._socket.wxyz = moved.translation, _wxyz(moved)
        self._limb.visible = limb is not None and self._world is not None
        if limb is not None and self._world is not None:
            moved = self._world @ limb
            self._limb.position, self._limb.wxyz = moved.translation, _wxyz(moved)


class Legend:
    """The colour bar of a page, with the choice of the quantity, the same in all browsers.

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
        highest = float(np.nanmax(_shown(estimate, self.quantity)[0], initial=0.0)) / _KPA
        end = self.limit / _KPA
        if not self._automatic.value:
            end = float(self._end.value)
        elif highest > end or highest < _FALLS * end:
            end = _upper_end(highest)
        self.limit = end * _KPA
        self._bar.content = _bar(end, self.quantity)
        self._words.content = self._describe(estimate)

    def _describe(self, estimate: MapEstimate) -> str:
        """The peak, how well it is known, and how much of the map is certain."""
        pressure = estimate.normal_pressure[0]
        deviation = estimate.normal_pressure_standard_deviation[0]
        if not np.isfinite(pressure).any():
            return _said("no force map", estimate.source, False)
        peak = int(np.nanargmax(pressure))
        reach = NORMAL_QUANTILE * deviation
        known = reach <= SHARE * np.abs(pressure)
        place = self._places[peak]
        head = f"peak {pressure[peak] / _KPA:.0f} ± {reach[peak] / _KPA:.0f} kPa, {place}"
        body = f"certain on {known.sum()} of {len(pressure)} tiles; {estimate.source}"
        measured = estimate.source.partition("measured: ")[2].split(", ")
        lacking = [name for name in ("wrench", *self._geometry.clusters) if name not in measured]
        warning = f"without {', '.join(lacking)}" if lacking else ""
        return _said(head, body, bool(known[peak]), warning)


@dataclass(frozen=True)
class _Size:
    """How large a socket is: its middle in {S}, radius and height [m]."""

    middle: FloatArray
    radius: float
    height: float

    @classmethod
    def of(cls, geometry: SocketGeometry, axis: SocketAxis) -> _Size:
        height = float(np.ptp(axis.heights(geometry.anchors)))
        radius = float(axis.radii(geometry.anchors).max())
        height, radius = max(height, 0.05), max(radius, 0.02)
        return cls(axis.end + 0.5 * height * axis.proximal, radius, height)


class _Tiles:
    """Tiles as coloured squares on pale plates, at n poses below a path of the scene.

    Those with a cluster are outlined and named.
    """

    def __init__(
        self, scene: SceneApi, path: str, poses: Pose, geometry: SocketGeometry, scale: float = 1.0
    ) -> None:
        self._edges = (scale * np.sqrt(geometry.areas)).astype(np.float32)
        white = np.full((len(geometry), 3), 255, dtype=np.uint8)
        wxyz = _wxyz(poses)
        for name, squares, share in (("plates", _SQUARE, _PLATE), ("values", _BOTH_SIDES, 0.0)):
            drawn = scene.add_batched_meshes_simple(
                f"{path}/{name}",
                squares,
                _FACES if name == "plates" else np.vstack([_FACES, _FACES + 4]),
                wxyz,
                poses.translation,
                batched_scales=share * self._edges,
                batched_colors=white if name == "values" else _rgb(SURFACE),
                lod="off",
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
        self._values = drawn
        corners = Pose(poses.rotation[:, None], poses.translation[:, None]).apply(
            self._edges[:, None, None] * _SQUARE
        )
        sides = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
        for name, tile in geometry.clusters.items():
            place = f"{path}/{name}"
            scene.add_line_segments(place, sides[tile], _rgb(CLUSTER), thickness=_OUTLINE)
            scene.add_label(
                f"{place}/name",
                name,
                position=corners[tile].mean(axis=0),
                anchor="bottom-center",
                font_screen_scale=0.8,
            )

    def paint(self, colours: NDArray[np.uint8], certainty: NDArray[np.float32]) -> None:
        """Show RGB colours, shape (n, 3); the smaller, the less certain, 0 to 1, shape (n,) [-]."""
        self._values.batched_colors = colours
        self._values.batched_scales = self._edges * (_SMALLEST + (_LARGEST - _SMALLEST) * certainty)

    def clear(self) -> None:
        """Show no values."""
        self._values.batched_scales = np.zeros_like(self._edges)


def _unroll(scene: SceneApi, geometry: SocketGeometry, axis: SocketAxis, size: _Size) -> Pose:
    """Tiles on the unrolled wall, seen from outside with anterior in its middle; named sides."""
    wall = wall_tiles(geometry, axis)
    radius = float(np.median(axis.radii(geometry.anchors[wall]))) if wall.any() else size.radius
    middle = axis.end - (_MAP * np.pi * radius + 1.75 * size.radius) * axis.left

    def place(across: FloatArray | float, up: FloatArray | float) -> FloatArray:
        along = np.multiply.outer(across, axis.left) + np.multiply.outer(up, axis.proximal)
        return middle + _MAP * along

    for turn, name in enumerate(("posterior", "right", "anterior", "left", "posterior")):
        below = place(0.5 * np.pi * radius * (turn - 2), -0.01)
        scene.add_label(
            f"/map/{turn}", name, position=below, anchor="top-center", font_screen_scale=0.8
        )
    offset = geometry.anchors - axis.end  # the distal end lies below the wall, anterior up
    across = np.where(wall, radius * axis.angles(geometry.anchors), offset @ axis.left)
    end = offset @ axis.anterior - 1.3 * size.radius
    up = np.where(wall, axis.heights(geometry.anchors), end)
    turn_up = np.column_stack([axis.proximal, -axis.left, axis.anterior])
    return Pose(np.broadcast_to(turn_up, (len(geometry), 3, 3)), place(across, up))


def _add_names(scene: SceneApi, axis: SocketAxis, size: _Size) -> None:
    """Where anterior and left are, and the frame of the load cell."""
    sides = {"anterior": axis.anterior, "left": axis.left}
    sides |= {"posterior": -axis.anterior, "right": -axis.left}
    ends = size.radius * np.array([1.1, _AWAY])
    rays = axis.end + np.array([np.outer(ends, direction) for direction in sides.values()])
    scene.add_line_segments("/sides", rays, _rgb(VEIL), thickness=_OUTLINE)
    for name, direction in sides.items():
        place = axis.end + (_AWAY + 0.1) * size.radius * direction
        scene.add_label(f"/sides/{name}", name, position=place, anchor="center-center")
    scene.add_frame("/socket/load_cell", axes_length=0.04, axes_radius=0.0015, origin_radius=0.003)
    scene.add_label("/socket/load_cell/name", "load cell", anchor="top-center")


def _add_limb(scene: SceneApi, axis: SocketAxis, size: _Size) -> None:
    """The limb as a rod with its lumped mass, drawn in its frame: that is as {S}, but moved."""
    turn = np.column_stack([axis.anterior, axis.left, axis.proximal])
    scene.add_cylinder(
        "/limb/body",
        radius=0.55 * size.radius,
        height=1.1 * size.height,
        color=_LIMB,
        opacity=0.35,
        wxyz=_wxyz(Pose(turn, np.zeros(3))),
        position=0.15 * size.height * axis.proximal,
        cast_shadow=False,
        receive_shadow=False,
    )
    scene.add_label("/limb/name", "limb", position=0.75 * size.height * axis.proximal)


def _shown(estimate: MapEstimate, quantity: str) -> tuple[FloatArray, NDArray[np.float32]]:
    """Values of a quantity [Pa] and how certain they are, shape (n,) each."""
    pressure, deviation = estimate.normal_pressure, estimate.normal_pressure_standard_deviation
    values, deviations = {
        PRESSURE: (pressure, deviation),
        SHEAR: (estimate.shear, estimate.shear_standard_deviation),
        DEVIATION: (deviation, 0.0 * deviation),
    }[quantity]
    return values[0], _certainty(values[0], deviations[0])


def _certainty(values: FloatArray, deviations: FloatArray) -> NDArray[np.float32]:
    """How certain values are: 1 where they are, less the wider their interval is."""
    reach = np.maximum(NORMAL_QUANTILE * deviations, 1e-9)
    shares = np.nan_to_num(np.clip(SHARE * np.abs(values) / reach, 0.0, 1.0))
    return (np.round(_STEPS * shares) / _STEPS).astype(np.float32)


def _colours(shares: FloatArray, certainty: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colours of shares of the scale, RGB, shape (n, 3), the paler the less they are certain."""
    index = np.clip(np.nan_to_num(255.0 * shares), 0, 255).astype(int)
    strength = (_PALEST + (1.0 - _PALEST) * certainty)[:, None]
    return _linear(255.0 + strength * (_COLOURS[index] - 255.0))


def _linear(colours: FloatArray) -> NDArray[np.uint8]:
    """Colours as viser wants those of many squares or arrows: linear light, not sRGB."""
    share = np.asarray(colours) / 255.0
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.round(255.0 * light).astype(np.uint8)


def _rgb(colour: str) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in mpl.colors.to_rgb(colour))
    return red, green, blue


def _wxyz(pose: Pose) -> FloatArray:
    """Quaternions in viser's order."""
    return np.roll(pose.quaternion(), 1, axis=-1)


def _upper_end(highest: float) -> float:
    """The end of a scale to a value [kPa]: 1, 2, 3 or 5 times a power of ten."""
    highest = max(highest, _LEAST)
    decade = 10.0 ** math.floor(math.log10(highest))
    return next(end * decade for end in _ENDS if end * decade >= highest)


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
    note = "full squares are certain; the smaller, the wider the 95 % interval"
    if quantity == DEVIATION:
        note = ""
    return (
        f'<div style="padding:0 1em;font:12px {FONT}">'
        f'<div style="height:14px;background:linear-gradient(to right,{_STOPS})"></div>'
        f'<div style="display:flex;justify-content:space-between">{ticks}</div>'
        f"<div>{quantity} [kPa]</div><div>{note}</div></div>"
    )


def _said(head: str, body: str, certain: bool, warning: str = "") -> str:
    colour = "inherit" if certain else "#8a8a8a"
    return (
        f'<div style="padding:0.5em 1em;font:12px {FONT}">'
        f'<div style="font-size:17px;font-weight:600;color:{colour}">{escape(head)}</div>'
        f'<div style="font-weight:600;color:#b35900">{escape(warning)}</div>'
        f"<div>{escape(body)}</div></div>"
    )
