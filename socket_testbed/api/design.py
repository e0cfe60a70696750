"""The socket and its sensors before any trial: tiles, marker bodies, calibration."""

from __future__ import annotations

import dataclasses
import difflib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

from socket_testbed.api.trials import Progress, as_path, started
from socket_testbed.arrays import FloatArray
from socket_testbed.calibration.model import Calibration, read_calibration, write_calibration
from socket_testbed.documents import (
    check_kind,
    check_number,
    check_whole,
    convert,
    mapping_of,
    path_of,
    plain,
    texts_of,
)
from socket_testbed.errors import ConfigurationError, closest
from socket_testbed.files import SOCKET_FILE, check_suffix, packaged, refuse_existing
from socket_testbed.geometry.regions import all_regions
from socket_testbed.geometry.socket import AREA_LIMITS, read_socket, write_socket
from socket_testbed.results.result import PathLike, Result

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure

    from socket_testbed.calibration.calibrate import BenchCalibration
    from socket_testbed.calibration.drift import Drift
    from socket_testbed.figures.style import FigureStyle
    from socket_testbed.socket_design.design import SocketDesign
    from socket_testbed.socket_design.registration import Registration
    from socket_testbed.socket_design.tiling import TilingSettings

_MAX_CLUSTERS = 1000
_MAX_POINTS = 4000  # per panel


@dataclass(frozen=True, repr=False)
class CalibratedCluster(Result):
    """A cluster calibrated from bench data, to be saved into a calibration.

    Attributes:
        name: Name of the cluster.
        quality: The coefficients (`quality.cluster`), the bench data, its outliers, and the errors
            on the data of the fit and on held-out data [Pa].
        baseline: Capacitances of the unloaded cluster before the bench run by converter input,
            shape (4,) [pF]; None without unloaded readings.
        drift: Change of the unloaded cluster over the bench run, for which the bench data is
            corrected: `capacitance` by converter input, shape (4,) [pF], and `stress` (normal,
            shear x, shear y), shape (3,) [Pa]; None without unloaded readings before and after.
        existing: The calibration whose other clusters are kept; None without one.
        existing_file: The file of that calibration, which `save` may replace; None without one.
    """

    name: str
    quality: BenchCalibration
    baseline: FloatArray | None
    drift: Drift | None
    existing: Calibration | None = None
    existing_file: Path | None = None

    def __repr__(self) -> str:
        errors = self.to_dataframe()["held-out RMSE [%]"]
        words = ", ".join(f"{name} {percent:.2g} %" for name, percent in errors.items())
        return (
            f"CalibratedCluster({self.name}: {len(self.quality.bench)} readings; held-out RMSE of"
            f" full scale: {words})"
        )

    def to_dataframe(self) -> pd.DataFrame:
        """Range and errors, a row per stress, indexed by `stress`: normal, shear_x, shear_y.

        Full scale is the largest magnitude of the known stress; outliers do not count for it.

        Columns:

        - `from [Pa]`, `to [Pa]`: range of the known stress without outliers; normal is positive in
          compression;
        - `held-out RMSE [Pa]`, `held-out RMSE [%]`, `held-out MAE [Pa]`, `held-out R2 [-]`: errors
          on groups of readings (files, cycles or blocks) that the fit did not see, the percentage
          of full scale; R2 is the explained share of the variance;
        - `training RMSE [Pa]`: error on the readings of the fit;
        - `hysteresis [%]`, `repeatability [%]`, `cross-talk [%]`: of full scale, see
          `socket_testbed.calibration.calibrate.quality_figures`. NaN if the bench run does not show
          them: without a rise and fall through equal loads, without a repeated cycle, or without a
          pure load along another axis.
        """
        held_out = self.quality.held_out
        columns = {
            "from [Pa]": self.quality.stress_range[:, 0],
            "to [Pa]": self.quality.stress_range[:, 1],
            "held-out RMSE [Pa]": held_out["rmse"],
            "held-out RMSE [%]": held_out["percent"],
            "held-out MAE [Pa]": held_out["mae"],
            "held-out R2 [-]": held_out["r2"],
            "training RMSE [Pa]": self.quality.training["rmse"],
            "hysteresis [%]": self.quality.figures["hysteresis"],
            "repeatability [%]": self.quality.figures["repeatability"],
            "cross-talk [%]": self.quality.figures["cross_talk"],
        }
        return pd.DataFrame(columns).rename_axis("stress")

    def notes(self) -> list[str]:
        """A note if other clusters of the existing calibration were fitted to these readings."""
        old, new = self.existing.clusters if self.existing else {}, self.quality.cluster
        same = [
            name
            for name, other in old.items()
            if name != self.name
            and np.allclose(
                [*other.normal, *other.mean_range], [*new.normal, *new.mean_range], 1e-9
            )
        ]
        note = (
            f"{self.name} has the same bench readings as {', '.join(same)}: calibrate every cluster"
            " on a bench run of its own"
        )
        return [note] if same else []

    def calibration(self, limit: float = 10.0, force: bool = False) -> Calibration:
        """The existing calibration with this cluster replaced or added.

        Args:
            limit: Largest held-out RMSE [% of the full scale].
            force: Whether to accept a cluster above the limit, marked as forced.

        Returns:
            The calibration: its coefficients by cluster, with this cluster's errors as its `bench`.

        Raises:
            CalibrationError: The normal stress does not grow with the capacitance, or a held-out
                RMSE exceeds the limit.
        """
        from socket_testbed.calibration.calibrate import bench_record

        self.quality.require_gain()
        if not force:
            self.quality.require_accuracy(limit)
        today, forced = date.today().isoformat(), bool(self.quality.above(limit))
        record = bench_record(self.quality, today, limit, forced, self.drift)
        cluster = dataclasses.replace(self.quality.cluster, baseline=self.baseline, bench=record)
        old = self.existing
        clusters = {**(old.clusters if old else {}), self.name: cluster}
        if old is not None and not all(c.bench for c in clusters.values()):
            # Clusters without a record of their own rely on the old date and source.
            return dataclasses.replace(old, clusters=clusters)
        sources = [f"{name}: {c.bench.get('source')}" for name, c in clusters.items()]
        return Calibration(clusters, today, "; ".join(sources))

    def save(
        self, path: PathLike, limit: float = 10.0, force: bool = False, replace: bool = False
    ) -> None:
        """Write `calibration` to a new file, or over the existing calibration.

        Args:
            path: The YAML file, whatever its suffix.
            limit: Largest held-out RMSE [% of the full scale].
            force: Whether to accept a cluster above the limit.
            replace: Whether to replace another file.

        Raises:
            CalibrationError: As in `calibration`.
            ConfigurationError: Another file exists.
        """
        path = path_of(path, "the file")
        own = self.existing_file is not None and self.existing_file.resolve() == path.resolve()
        if not (own or replace):
            refuse_existing(path)
        calibration = self.calibration(limit, force)
        write_calibration(calibration, path)

    def _figure(self, style: FigureStyle) -> Figure:
        """Calibrated versus known stress, and the residuals; a column per stress."""
        from socket_testbed.calibration.bench_data import STRESSES
        from socket_testbed.figures.style import MEASURED_STYLE, VERMILION, lay_out, style_axes

        found = self.quality
        groups = found.cross_validation.groups
        known, fitted, held_out = (
            1e-3 * stress
            for stress in (found.bench.stress, found.fitted, found.cross_validation.predicted)
        )
        some = slice(None, None, 1 + len(known) // _MAX_POINTS)
        figure = style.figure(110.0)
        axes = figure.subplots(2, 3, sharex="col")
        files = ", ".join(found.bench.files)
        style.add_title(figure, f"{self.name}: {files}; {groups} held out in turn")
        for k, name in enumerate(STRESSES):
            x = known[:, k]
            above, below = axes[:, k]
            ends = [x[some].min(), x[some].max()]
            above.plot(ends, ends, **MEASURED_STYLE)
            above.plot(x[some], fitted[some, k], ".", color="0.2", markersize=2.0)
            if outliers := [o for o in found.outliers if o.axis == k]:
                places = np.array([(o.known, o.fitted) for o in outliers]).T * 1e-3
                above.plot(*places, "o", color=VERMILION, fillstyle="none", label="outlier")
            unseen = (held_out - known)[some, k]
            below.plot(x[some], unseen, "x", color=VERMILION, markersize=3.0, label="held out")
            fit = (fitted - known)[some, k]
            below.plot(x[some], fit, ".", color="0.2", markersize=2.0, label="in the fit")
            below.axhline(0.0, color=MEASURED_STYLE["color"], linewidth=1.0)
            error = f"\nheld-out:\n{found.held_out['percent'].iloc[k]:.1f} % of\nfull scale"
            above.set_title(name + error * style.titles)
            below.set_xlabel("known [kPa]")
        for row, label in enumerate(("calibrated", "residual")):
            axes[row, 0].set_ylabel(f"{label} [kPa]")
        keys: dict[str, Artist] = {}
        for axis in axes.flat:
            style_axes(axis)
            axis.locator_params(nbins=4 if style.is_narrow else 6)
            handles, labels = axis.get_legend_handles_labels()
            keys |= dict(zip(labels, handles, strict=True))
        figure.legend(keys.values(), keys.keys(), loc="outside lower center", ncols=3)
        return lay_out(figure)


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
            designs.tiles_named(name, usual_regions)  # refuses an unknown region
    kept = (
        read_socket(path_of(bodies, "the file"))
        if bodies
        else dataclasses.replace(usual, registration="")
    )
    for name, direction in (("proximal", proximal), ("anterior", anterior)):
        check_kind(direction or "", str, name, "give a text, such as '+z' or '0 0.1 1'")
    if settings is not None:
        check_kind(settings, TilingSettings, "settings", "leave it")
    place = check_whole(place, "--place", 0, _MAX_CLUSTERS)
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
    from socket_testbed.figures.style import save_figure
    from socket_testbed.figures.tiles import socket_figure
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
