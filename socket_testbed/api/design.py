"""The socket and its sensors before any trial: tiles, marker bodies, calibration."""

from __future__ import annotations

import dataclasses
import difflib
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from threadpoolctl import threadpool_limits

from socket_testbed.api.trials import Progress, as_path, started
from socket_testbed.arrays import FloatArray
from socket_testbed.calibration.model import read_calibration
from socket_testbed.documents import (
    check_kind,
    check_number,
    convert,
    mapping_of,
    path_of,
    plain,
    texts_of,
)
from socket_testbed.errors import ConfigurationError, closest
from socket_testbed.figures.style import save_figure
from socket_testbed.figures.tiles import socket_figure
from socket_testbed.files import SOCKET_FILE, check_suffix, packaged
from socket_testbed.geometry.regions import all_regions, tiles_named
from socket_testbed.geometry.socket import AREA_LIMITS, read_socket, write_socket
from socket_testbed.results.calibration import CalibratedCluster
from socket_testbed.results.result import PathLike
from socket_testbed.settings.options import TileOptions

if TYPE_CHECKING:
    from socket_testbed.socket_design.design import SocketDesign
    from socket_testbed.socket_design.registration import Registration
    from socket_testbed.socket_design.tiling import TilingSettings


def calibrate(
    bench: PathLike | Sequence[PathLike],
    cluster: str,
    *,
    into: PathLike | None = None,
    baseline: Sequence[PathLike] = (),
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    area: float | None = None,
    geometry: PathLike | None = None,
    wiring: Sequence[int] | None = None,
    drop_outliers: bool = False,
) -> CalibratedCluster:
    """Fit the coefficients of a cluster to bench data and judge them on held-out data.

    `save` of the result writes them into a calibration.

    Args:
        bench: CSV files of bench data, see docs/calibration.md.
        cluster: Name of the cluster.
        into: A calibration whose other clusters are kept.
        baseline: CSV files of unloaded readings before the bench run and, to correct its drift,
            after it.
        columns: Header names of quantities (`time`, `cycle`, `normal`, `shear_x`, `shear_y`, `c0`
            to `c3`), keyed by quantity.
        units: Units that override the header's, keyed by quantity: `Pa`, `kPa`, `MPa`, `N`, `kN`;
            `pF`, `fF`, `nF`, `counts` of an FDC1004; `s`, `ms`.
        area: Area that converts forces into stresses [m^2].
        geometry: A `socket.yaml` that supplies the area of the cluster's tile instead.
        wiring: Input of each channel (-x,+y), (+x,+y), (-x,-y), (+x,-y) (default: the existing
            cluster's, else 0, 1, 2, 3).
        drop_outliers: Whether to leave outliers out of the fit.

    Returns:
        The calibrated cluster: `to_dataframe()` holds its errors, `save` writes it.

    Raises:
        ConfigurationError: A file, column, unit or number is wrong, there are more than two
            baselines, the wiring names an input twice, or the cluster's name is nearly that of one
            in the calibration.
        CalibrationError: The readings cannot be calibrated.

    >>> found = st.calibrate("bench.csv", "distal", wiring=(2, 3, 0, 1))
    >>> found
    CalibratedCluster(distal: 1062 readings; held-out RMSE of full scale: normal ... %, ...)
    >>> found.save("calibration.yaml", limit=10.0)
    """
    from socket_testbed.calibration.bench_data import join_benches, read_bench, read_unloaded
    from socket_testbed.calibration.calibrate import calibrate_bench
    from socket_testbed.calibration.drift import average_baseline, correct_bench, measure_drift

    paths, baseline = _paths(bench, "bench"), _paths(baseline, "baseline")
    if not paths:
        raise ConfigurationError("no bench data is given", "name its CSV files")
    (cluster,) = texts_of([cluster], "cluster")
    hint = "give them by quantity, such as {'normal': 'kPa'}"
    columns = mapping_of(columns or {}, "columns", hint.replace("kPa", "Force"))
    units = mapping_of(units or {}, "units", hint)
    if area is not None:
        check_number(area, "--area", *AREA_LIMITS)
    elif geometry is not None:
        area = _tile_area(path_of(geometry, "the file"), cluster)
    if len(baseline) > 2:
        raise ConfigurationError(
            f"--baseline: {len(baseline)} files", "give one before and at most one after"
        )
    wired = plain(wiring)
    known = isinstance(wired, list) and sorted(map(str, wired)) == [*"0123"]
    if not (wiring is None or known):
        raise ConfigurationError(f"--wiring is {wired}", "give each of 0, 1, 2, 3 once")
    existing = None if into is None else read_calibration(path_of(into, "the file"))
    old = existing.clusters if existing else {}
    if cluster not in old:
        for near in difflib.get_close_matches(cluster, old, n=1, cutoff=0.9):
            raise ConfigurationError(
                f"--cluster is '{cluster}', which the calibration does not hold",
                f"did you mean '{near}'? For a new cluster choose a name less like it",
            )
    with threadpool_limits(1):
        data = join_benches([read_bench(path, columns, units, area) for path in paths])
        ends = (data.time[0], data.time[-1])
        baselines = [
            average_baseline(time, read_unloaded(path, columns, units), str(path))
            for path, time in zip(baseline, ends, strict=False)
        ]
        if len(baselines) == 2:
            data = correct_bench(data, *baselines)
        usual = old[cluster].wiring if cluster in old else np.arange(4)
        inputs = usual if wiring is None else np.array(wiring)
        quality = calibrate_bench(data, inputs, wiring is not None, drop_outliers)
        drift = measure_drift(quality.cluster, *baselines) if len(baselines) == 2 else None
    unloaded = baselines[0].capacitance if baselines else None
    return CalibratedCluster(cluster, quality, unloaded, drift, existing, as_path(into))


def _paths(given: object, what: str) -> list[Path]:
    """The paths that were given: one or several."""
    if isinstance(given, Iterable) and not isinstance(given, str | os.PathLike):
        return [path_of(each, what) for each in given]
    return [path_of(given, what)]


def _tile_area(geometry: Path, cluster: str) -> float:
    socket = read_socket(geometry)
    if cluster not in socket.clusters:
        raise ConfigurationError(
            f"{geometry}: has no cluster '{cluster}'", closest(cluster, socket.clusters)
        )
    return float(socket.areas[socket.clusters[cluster]])


def tile(
    scan: PathLike,
    output: PathLike | None = None,
    *,
    unit: Literal["m", "cm", "mm", "in"] | None = None,
    body: str | None = None,
    proximal: str | None = None,
    anterior: str | None = None,
    height: float = 0.08,
    landmarks: PathLike | None = None,
    points: FloatArray | None = None,
    clusters: PathLike | None = None,
    place: int = 0,
    keep_out: Sequence[str] = (),
    bodies: PathLike | None = None,
    settings: TilingSettings | None = None,
    progress: Progress | None = None,
) -> SocketDesign:
    """Lay tiles out on a scan of the socket's interior.

    Args:
        scan: STL, PLY or OBJ file.
        output: The `socket.yaml` to write, if any, with a picture (.png) and a page (.html) next
            to it.
        unit: Unit of the scan's lengths (default: inferred).
        body: Name or number of the body, if the file has several.
        proximal: Direction of the opening in the scan, such as `+z` or `0 0.1 1` (default:
            detected).
        anterior: Direction of the x axis of {S} in the scan.
        height: Height of the distal end above the load cell [m].
        landmarks: YAML file of points known in the scan and in {S}.
        points: Origin of {S}, a point on its +x, one towards its +y, picked in the scan in its
            unit.
        clusters: YAML file of cluster positions in {S} or in the scan (default: the usual ones).
        place: Total number of clusters: given ones stay, the others are proposed where they are
            most informative for the force map; 0: none is proposed.
        keep_out: Regions and tiles excluded from proposals, such as `anterior proximal`.
        bodies: A registered `socket.yaml` whose marker bodies are kept (default: nominal ones).
        settings: Settings of the tiling.
        progress: See `Progress`.

    Returns:
        The design: `geometry` is the socket in {S}, `facts()` describes it, `notes` need attention.

    Raises:
        ConfigurationError: A setting or a file is wrong, or the output holds registered bodies.
        ScanError: The scan cannot be read or tiled.

    >>> design = st.tile("scan.stl", "socket.yaml", proximal="+z", anterior="+x")
    >>> design
    SocketDesign(scan.stl: ... tiles on ...% of ... cm^2)
    >>> len(design.geometry) > 20
    True
    """
    from socket_testbed.socket_design import design as designs  # trimesh is slow to import
    from socket_testbed.socket_design.clusters import read_cluster_places
    from socket_testbed.socket_design.scan_file import read_scan
    from socket_testbed.socket_design.tiling import TilingSettings

    if output is not None:
        _check_socket_output(path_of(output, "the file"), bodies)
    places = None  # the usual ones
    if clusters:
        places = read_cluster_places(path_of(clusters, "the file of clusters"))
    if places is None and place:
        places = []  # all are proposed
    usual = read_socket(packaged("config", SOCKET_FILE))
    usual_regions = {region.name: region.tiles for region in all_regions(usual)}
    given_names = [given.name for given in places or ()]
    keep_out = texts_of(keep_out, "keep_out")
    for name in keep_out:  # before any tile is laid
        is_tile = designs.TILE_NAME.fullmatch(name) is not None
        if name not in given_names and not is_tile:
            tiles_named(name, usual_regions)  # refuses an unknown region
    kept = (
        read_socket(path_of(bodies, "the file"))
        if bodies
        else dataclasses.replace(usual, registration="")
    )
    for name, direction in (("proximal", proximal), ("anterior", anterior)):
        check_kind(direction or "", str, name, "give a text, such as '+z' or '0 0.1 1'")
    if settings is not None:
        check_kind(settings, TilingSettings, "settings", "leave it")
    place = TileOptions(place=place).place
    if points is not None:
        points = convert(plain(points), list[list[float]], "points")  # type: ignore[assignment]
        if [len(point) for point in points] != [3, 3, 3]:
            raise ConfigurationError("points are not three of three numbers", "pick three")
    height = check_number(height, "--height", -2.0, 2.0)
    upwards = designs.parse_direction(proximal, "--proximal") if proximal else None
    front = designs.parse_direction(anterior, "--anterior") if anterior else None

    def placed(vertices: FloatArray, upwards: FloatArray, metres: float) -> designs.Placement:
        if landmarks is not None:
            return designs.place_by_landmarks(path_of(landmarks, "the file"), metres)
        if points is not None:
            return designs.place_by_points(np.asarray(points) * metres)
        return designs.place_by_directions(vertices, upwards, front, height)

    path = path_of(scan, "the file")
    with threadpool_limits(1):
        design = designs.design_socket(
            path.name,
            read_scan(path, unit, body),
            placed,
            upwards,
            places,
            kept,
            settings or TilingSettings(),
            started(progress, "tiling"),
        )
        if place:
            design = designs.with_proposed_clusters(design, place, keep_out)
    if landmarks is None and points is None and front is None:
        note = "x of the scan is assumed to be anterior: check it, or give --anterior"
        design = dataclasses.replace(design, notes=(*design.notes, note))
    if output is not None:
        _write_design(design, path_of(output, "the file"))
    return design


def _check_socket_output(output: Path, bodies: PathLike | None) -> None:
    check_suffix(output, (".yaml", ".yml"), "socket")
    if output.exists() and not bodies:
        registration = read_socket(output).registration
        if registration:
            raise ConfigurationError(
                f"{output} holds registered marker bodies ({registration})",
                f"keep them with --bodies {output}, or name another output",
            )


def _write_design(design: SocketDesign, output: Path) -> None:
    from socket_testbed.report.page import write_socket_page
    from socket_testbed.socket_design.scan_file import simplify

    title = f"{design.name}: {len(design.geometry)} tiles"
    write_socket(design.geometry, output)
    picture = socket_figure(design.geometry, title)
    save_figure(picture, output.with_suffix(".png"), dpi=200)
    page = output.with_suffix(".html")
    shown = simplify(design.mesh)
    write_socket_page(shown, design.geometry, page, title, design.facts())


def register(
    take: PathLike,
    landmarks: PathLike,
    socket: PathLike,
    output: PathLike | None = None,
    *,
    force: bool = False,
) -> Registration:
    """Register the marker bodies and the limb of a socket with a static take.

    Args:
        take: The take, exported from Motive as CSV.
        landmarks: YAML file that assigns the markers and locates the landmarks.
        socket: The `socket.yaml` to register.
        output: The `socket.yaml` to write; None to write nothing.
        force: Whether to accept landmarks with large residuals, or a limb outside the socket.

    Returns:
        The registration with its uncertainty; `geometry` is the registered socket, in {S}.

    Raises:
        ConfigurationError: A file is wrong.
        RegistrationError: The take and the landmarks do not determine the bodies and the limb, or
            their residuals are large.

    >>> found = st.register("take.csv", "landmarks.yaml", "old_socket.yaml", "new_socket.yaml")
    >>> found
    Registration(take.csv: ... frames; ... mm rms)
    """
    from socket_testbed.socket_design.motive import read_motive_csv
    from socket_testbed.socket_design.registration import read_landmarks, register_take

    with threadpool_limits(1):
        seen = read_motive_csv(path_of(take, "the take"))
        sides = read_landmarks(path_of(landmarks, "the file of landmarks"))
        found = register_take(seen, sides, read_socket(path_of(socket, "the socket")), force)
    if output is not None:
        write_socket(found.geometry, path_of(output, "the file"))
    return found
