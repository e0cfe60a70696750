"""Videos of the pressure: real time, one colour scale, and what cannot be written refused."""

import numpy as np
import pytest
from matplotlib import colormaps, rc_context
from matplotlib.animation import FFMpegWriter
from PIL import Image, ImageSequence
from support.ring_socket import ring_socket

from socket_testbed.errors import ConfigurationError
from socket_testbed.report.figures.style import SCALE
from socket_testbed.report.figures.video import RATE, check_video, rows_of_frames, write_video

SOCKET = ring_socket()
TIME = np.arange(8) * 0.25


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """Pressures of all tiles that rise from 0 to 40 kPa in 1.75 s."""
    path = tmp_path_factory.mktemp("video") / "map.gif"
    pressure = np.linspace(0.0, 40.0, len(TIME))[:, None] + np.zeros(len(SOCKET))
    steps = []
    known = np.ones(pressure.shape, dtype=bool)
    write_video(path, SOCKET, TIME, pressure, known, progress=lambda *s: steps.append(s))
    assert steps == [(n, 18) for n in range(1, 19)]
    return path


def test_a_video_runs_in_real_time(video):
    with Image.open(video) as image:
        lengths = [frame.info["duration"] for frame in ImageSequence.Iterator(image)]
    assert sum(lengths) / 1e3 == pytest.approx(TIME[-1], abs=1 / RATE)


def test_a_video_has_one_scale_from_its_first_frame_to_its_last(video):
    with Image.open(video) as image:
        frames = [np.asarray(f.convert("RGB")) / 255.0 for f in ImageSequence.Iterator(image)]
    scale = colormaps[SCALE]
    for frame, value in ((frames[0], 0.0), (frames[-1], 1.0)):
        alike = np.abs(frame - scale(value)[:3]).max(axis=2) < 0.03
        assert alike.mean() > 0.1  # the tiles; the bar alone is less
    bar = [frame[:, int(0.92 * frame.shape[1])] for frame in (frames[0], frames[-1])]
    np.testing.assert_array_equal(*bar)


def test_a_frame_shows_the_nearest_sample_or_none_in_a_gap():
    time = np.array([5.0, 5.5, 6.0, 6.5, 12.0, 12.5])
    rows = rows_of_frames(time)
    assert len(rows) == 76
    at = {round(5.0 + i / RATE, 1): row for i, row in enumerate(rows.tolist())}
    assert (at[5.0], at[5.2], at[5.3], at[6.4], at[12.5]) == (0, 0, 1, 3, 5)
    assert at[9.2] == -1  # 2.7 s from any sample, the usual step is 0.5 s
    assert rows_of_frames(np.array([3.0])).tolist() == [0]


def test_a_gap_is_hatched(tmp_path):
    pressure = np.full((2, len(SOCKET)), 20.0)
    known = np.ones(pressure.shape, dtype=bool)
    pressure[1] = np.nan
    write_video(tmp_path / "map.gif", SOCKET, np.array([0.0, 0.1]), pressure, known)
    with Image.open(tmp_path / "map.gif") as image:
        assert image.n_frames == 2


@pytest.mark.parametrize("name", ["map.avi", "map"])
def test_another_format_is_refused(tmp_path, name):
    with pytest.raises(ConfigurationError, match=r"\.mp4 or \.gif"):
        check_video(tmp_path / name)


def test_an_mp4_without_ffmpeg_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setattr(FFMpegWriter, "isAvailable", lambda: False)
    with pytest.raises(ConfigurationError, match=r"needs ffmpeg.*install ffmpeg, or name a \.gif"):
        check_video(tmp_path / "map.mp4")


@pytest.mark.parametrize(("name", "span"), [("map.gif", 180), ("map.mp4", 900)])
def test_an_hour_says_how_long_it_is_and_asks_for_a_span(tmp_path, monkeypatch, name, span):
    monkeypatch.setattr(FFMpegWriter, "isAvailable", lambda: True)
    with pytest.raises(ConfigurationError) as error:
        check_video(tmp_path / name, 3600.0)
    assert "60.0 min at 10 frames a second are 36001 frames, about 91 min" in error.value.fact
    assert f"span of {span} s or less with --segment" in error.value.hint
    check_video(tmp_path / name, 0.9 * span)


def test_ffmpeg_gets_every_frame_in_even_pixels(tmp_path, monkeypatch):
    """A program in the place of ffmpeg keeps what it is given."""
    program = tmp_path / "ffmpeg"
    program.write_text('#!/bin/sh\nfor last; do :; done\necho "$@" > "$last.txt"\ncat > "$last"\n')
    program.chmod(0o755)
    pressure = np.full((3, len(SOCKET)), 20.0)
    path = tmp_path / "map.mp4"
    with rc_context({"animation.ffmpeg_path": str(program)}):
        monkeypatch.setattr(FFMpegWriter, "isAvailable", lambda: True)
        write_video(path, SOCKET, TIME[:3], pressure, np.ones(pressure.shape, dtype=bool))
    frames = 1 + int(TIME[2] * RATE)
    size = path.stat().st_size
    assert size % (4 * frames) == 0  # RGBA
    pixels = size // (4 * frames)
    assert pixels % 4 == 0 and pixels > 500_000


def test_an_ffmpeg_that_fails_is_one_line(tmp_path, monkeypatch):
    program = tmp_path / "ffmpeg"
    program.write_text("#!/bin/sh\ncat > /dev/null\nexit 1\n")
    program.chmod(0o755)
    pressure = np.full((3, len(SOCKET)), 20.0)
    with rc_context({"animation.ffmpeg_path": str(program)}):
        monkeypatch.setattr(FFMpegWriter, "isAvailable", lambda: True)
        with pytest.raises(ConfigurationError, match=r"ffmpeg cannot write it: name a \.gif"):
            write_video(
                tmp_path / "map.mp4", SOCKET, TIME[:3], pressure, np.ones(pressure.shape, bool)
            )
    assert not (tmp_path / "map.mp4").exists()
