"""A video of the pressure on the unrolled socket."""

from __future__ import annotations

import io
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.animation import FFMpegWriter
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from socket_testbed.arrays import BoolArray, FloatArray, IntArray
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import atomic_output
from socket_testbed.geometry.socket import SocketGeometry
from socket_testbed.report.figures.pressure import UNIT, hatch_note
from socket_testbed.report.figures.style import (
    CLUSTER,
    EDGE,
    PALE,
    SCALE,
    FigureStyle,
    in_style,
    lay_out,
)
from socket_testbed.report.figures.tile_maps import (
    HEADING,
    add_key,
    cluster_key,
    draw_maps,
    maps_height,
    scales_of,
)
from socket_testbed.report.figures.tiles import paint_tiles
from socket_testbed.report.figures.unrolled import DrawnTiles

RATE = 10  # [1/s]; frames of a video, in real time
_MOST_FRAMES = {".mp4": 9000, ".gif": 1800}  # a GIF is held in memory
_FRAME = 0.15  # [s]; that a frame takes, about
_WIDTH, _DPI = 140.0, {".mp4": 200, ".gif": 110}  # [mm], [1/inch]
_GAP = 3.0  # usual steps between samples; farther from one, nothing is known


def check_video(path: Path, duration: float = 0.0) -> None:
    """Refuse a video that cannot be written, before long work.

    Args:
        path: File to write.
        duration: Of the video [s].

    Raises:
        ConfigurationError: If its suffix is another than `.mp4` or `.gif`, if ffmpeg is missing
            for an `.mp4`, or if it has too many frames.
    """
    suffix = path.suffix.lower()
    if suffix not in _MOST_FRAMES:
        raise ConfigurationError(
            f"{path}: a video cannot be a '{path.suffix}' file", "name a .mp4 or .gif file"
        )
    if suffix == ".mp4" and not FFMpegWriter.isAvailable():
        raise ConfigurationError(
            f"{path}: an .mp4 needs ffmpeg, which is not installed",
            "install ffmpeg, or name a .gif file",
        )
    frames, most = int(duration * RATE) + 1, _MOST_FRAMES[suffix]
    if frames > most:
        longer = (
            ", or name an .mp4 file" if suffix == ".gif" and frames <= _MOST_FRAMES[".mp4"] else ""
        )
        raise ConfigurationError(
            f"{path}: {duration / 60.0:.1f} min at {RATE} frames a second are {frames} frames,"
            f" about {np.ceil(frames * _FRAME / 60.0):.0f} min of work",
            f"choose a span of {most // RATE} s or less with --segment T0:T1{longer}",
        )


@in_style
def write_video(
    path: Path,
    geometry: SocketGeometry,
    time: FloatArray,
    pressure: FloatArray,
    determined: BoolArray,
    side: str = "",
    title: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write the pressure on the unrolled socket as a video in real time, on one colour scale.

    Args:
        path: File to write or replace, `.mp4` or `.gif`.
        geometry: The socket.
        time: Times of the samples since the first sample of the trial, shape (N,) [s].
        pressure: Pressures of the tiles, shape (N, n) [kPa]; NaN where there is none.
        determined: Which of them are determined, shape (N, n): the others are pale and hatched.
        side: The leg that wears the socket, `left` or `right`; empty where that is not known.
        title: What is shown.
        progress: Called with the number of frames written and of all.

    Raises:
        ConfigurationError: See `check_video`; also if the file cannot be written.
    """
    check_video(path, float(time[-1] - time[0]))
    suffix = path.suffix.lower()
    (limits,) = scales_of(geometry, {"": pressure}, from_zero=True)
    style = FigureStyle(_WIDTH)
    figure = style.figure(maps_height(geometry, style.width, [limits], 1) + HEADING)
    figure.set_dpi(_DPI[suffix])
    style.add_title(figure, title)
    nothing = np.full(len(geometry), np.nan)
    drawn = draw_maps(figure, geometry, {_at(time[-1]): nothing}, UNIT, [limits], side=side)
    note = hatch_note({"": pressure}, {"": determined})
    add_key(figure, style, *cluster_key(geometry), note)
    lay_out(figure)
    _freeze(figure, drawn)

    def frames() -> Iterator[Figure]:
        rows = rows_of_frames(time)
        for number, row in enumerate(rows):
            values = pressure[row] if row >= 0 else nothing
            paint = paint_tiles(geometry, values, limits, determined=determined[row])
            for part in drawn:
                part.repaint(paint)
            instant = _at(time[0] + number / RATE)
            figure.axes[0].set_title(instant, loc="left", fontweight="bold")
            yield figure
            if progress is not None:
                progress(number + 1, len(rows))

    with atomic_output(path) as staging:
        if suffix == ".mp4":
            _write_mp4(frames(), staging, path)
        else:
            palette = _palette()
            plain = Image.Dither.NONE
            images = (
                _pixels(frame).convert("RGB").quantize(palette=palette, dither=plain)
                for frame in frames()
            )
            next(images).save(
                staging, save_all=True, append_images=images, duration=1000 // RATE, loop=0
            )


def _write_mp4(frames: Iterator[Figure], staging: Path, path: Path) -> None:
    writer = FFMpegWriter(fps=RATE)
    figure = next(frames)
    try:
        with writer.saving(figure, str(staging), figure.dpi):
            writer.grab_frame()
            for _ in frames:
                writer.grab_frame()
    except (subprocess.CalledProcessError, BrokenPipeError):
        raise ConfigurationError(f"{path}: ffmpeg cannot write it", "name a .gif file") from None


def _freeze(figure: Figure, drawn: list[DrawnTiles]) -> None:
    """Make an image of all but the tiles, their numbers and the time, so that it is drawn once."""
    for part in drawn:
        part.set_visible(False)
    for axis in figure.axes:
        axis.set_title("", loc="left")
    pixels = np.asarray(_pixels(figure))
    for part in drawn:
        part.set_visible(True)
    for text in figure.texts:
        text.set_visible(False)
    for axis in figure.axes:
        axis.set_axis_off()
        axis.set_title("")
        axis.set_visible(bool(axis.texts or axis.collections) and axis.get_label() != "<colorbar>")
    figure.figimage(pixels, zorder=-1)


def _pixels(figure: Figure) -> Image.Image:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="rgba", dpi=figure.dpi)
    size = figure.canvas.get_width_height()
    return Image.frombytes("RGBA", size, buffer.getvalue())


def _palette() -> Image.Image:
    """Colours of all frames of a GIF: the scale, its pale colours, greys, outlines."""
    scale = colormaps[SCALE](np.linspace(0.0, 1.0, 104))[:, :3]
    pale = 1.0 - PALE + PALE * scale
    greys = np.repeat(np.linspace(0.0, 1.0, 32)[:, None], 3, axis=1)
    lines = np.array([to_rgb(colour) for colour in (CLUSTER, EDGE)])
    outlines = np.concatenate([mix * lines + (1.0 - mix) for mix in (1.0, 0.75, 0.5, 0.25)])
    colours = np.concatenate([scale, pale, greys, outlines])
    image = Image.new("P", (1, 1))
    image.putpalette(np.round(255.0 * colours).astype(np.uint8).tobytes())
    return image


def _at(instant: float) -> str:
    return f"{instant:.1f} s"


def rows_of_frames(time: FloatArray) -> IntArray:
    """The sample nearest to each frame, shape (f,); -1 in a gap.

    Args:
        time: Times of the samples, ascending, shape (N,) [s].
    """
    instants = time[0] + np.arange(int((time[-1] - time[0]) * RATE) + 1) / RATE
    middles = 0.5 * (time[1:] + time[:-1])
    nearest = np.searchsorted(middles, instants)
    usual = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    apart = np.abs(time[nearest] - instants)
    return np.where(apart <= _GAP * max(usual, 1.0 / RATE), nearest, -1)
