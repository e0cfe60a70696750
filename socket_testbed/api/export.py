"""Export of trials: tables, and files for OpenSim, C3D and plotting tools."""

from __future__ import annotations

import pandas as pd

from socket_testbed.api.cycles import cycles as cycles_of
from socket_testbed.api.cycles import cycles_by
from socket_testbed.api.models import Model, model_for
from socket_testbed.api.pressure import force_map as force_map_of
from socket_testbed.api.pressure import pressure as pressure_of
from socket_testbed.api.trials import as_trial
from socket_testbed.documents import described, path_of, plain
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import check_suffix
from socket_testbed.results.export import export_table, sources
from socket_testbed.results.result import PathLike
from socket_testbed.results.survey import Survey
from socket_testbed.settings.options import ExportOptions
from socket_testbed.tables import write_table
from socket_testbed.trials.export import (
    EXPORT_FORMATS,
    GAIT_FORMATS,
    write_gait_file,
    write_standard_bag,
)
from socket_testbed.trials.segment import Segment, Span
from socket_testbed.trials.trial import Trial

_MAX_ABOUT = 2.0  # [m]


def _is_point(about: object) -> bool:
    """Whether it is three numbers near the load cell [m]."""
    given = plain(about)
    return (
        isinstance(given, list)
        and len(given) == 3
        and all(isinstance(each, int | float) and abs(each) <= _MAX_ABOUT for each in given)
    )


def export(
    trial: Trial | PathLike,
    path: PathLike,
    segment: str | Span | Segment = ExportOptions.segment,
    model: Model | None = None,
    force_map: bool = False,
    pressure: bool = False,
    cycles: str | tuple[str, str] | None = None,
    about: tuple[float, float, float] | None = None,
    prior: Survey | PathLike | None = None,
) -> pd.DataFrame:
    """Write the synchronised samples of a trial, with the raw measurements, as a table.

    Args:
        trial: The trial.
        path: The file; its suffix, `.csv`, `.parquet` or `.mat`, selects the format. `.mot` and
            `.sto` are external loads for OpenSim, `.trc` its markers, `.c3d` both; `.mcap` holds
            standard ROS messages with named columns: see `socket_testbed.trials.export`.
        segment: As in `fit`.
        model: A model whose predictions are added as `predicted.*` and engaged springs as
            `springs.*`, see `Evaluation.engagement`.
        force_map: Whether to add the force map as `map.*`, see `st.force_map`.
        pressure: Whether to add pressure and shear of every region and tile as `pressure.*`, see
            `TrialPressure.over_time`.
        cycles: Events that delimit cycles; the table then holds mean and standard deviation of all
            columns over 0 to 100 % of a cycle, see `st.cycles`.
        about: Reference point of the moments in {S}, such as the knee's centre [m] (default: the
            load cell's origin).
        prior: A survey of this limb in this socket, such as the file of `survey -o FILE.json`, as a
            prior of the force map; the trial must not be in it.

    Returns:
        The table as written. Its `attrs` describe the `segment` and the `rows`; their `notes` say
        what was left out of the file, or is NaN there, and which prior was used with a survey, one
        line each. A row per sample, no named
        index; missing values are NaN. Columns:

        - `stamp [ns]` of the trigger since the epoch, `time [s]` since the trial's first sample;
        - the wrench in {S}, such as `Mx [N m]` and `Fz [N]`; position and rotation vector of the
          limb in {S}, such as `q_x [m]` and `phi_x [rad]`;
        - for each cluster its capacitances by converter input, such as `distal.C0 [pF]`; its
          status, `distal.status [-]` (0 ok, 1 saturated, 2 missing, 3 out of the calibrated range);
          its stresses along its own axes, `distal.normal [Pa]` (positive in compression),
          `distal.shear_x [Pa]` and `distal.shear_y [Pa]`; and its force in the frame {L} of its
          tile, such as `distal.Fz [N]`;
        - `predicted.*` as in `st.predict`; `springs.engaged [1]`, and the shares
          `springs.engaged_share [-]` and `springs.uncertain_share [-]` of all springs; `map.*` as
          in `TrialMap.to_dataframe`; `pressure.*` as in `TrialPressure.over_time`.

        With `cycles` it has a row per percent, as in `Cycles.to_dataframe`; for OpenSim and C3D a
        row per sample, indexed by `time [s]`, with forces [N], points [m] and moments [N m], or
        markers [mm]. External loads have a row per sample with a wrench.

    Raises:
        ConfigurationError: The suffix is unknown or its format does not hold what is asked for,
            `about` is no point near the load cell, the model or the survey is of another socket, or
            the survey holds the trial.
        TrialError: The trial cannot be read, has no such segment, or lacks markers or cycles.

    >>> table = st.export(st.open_trial("trials/hold"), "hold.csv", segment="10:20")
    >>> "distal.C0 [pF]" in table.columns, len(table)
    (True, 41)
    """
    trial = as_trial(trial)
    path = path_of(path, "the file")
    if about is not None and not _is_point(about):
        hint = f"give three numbers [m], from -{_MAX_ABOUT:g} to {_MAX_ABOUT:g}"
        fact = f"about is {[*about] if isinstance(about, list | tuple) else described(about)}"
        raise ConfigurationError(fact, hint)
    check_suffix(path, EXPORT_FORMATS, "trial's export")
    if prior is not None and not (force_map or pressure):
        raise ConfigurationError(
            "a prior is given, but no column that it changes", "add --map or --pressure"
        )
    cycles = None if cycles is None else cycles_by(cycles)
    of_gait = path.suffix.lower() in GAIT_FORMATS
    if of_gait and (model or force_map or pressure or cycles):
        raise ConfigurationError(
            f"{path}: a {path.suffix} holds only measured forces and markers",
            "give .csv, .parquet or .mat for computed columns",
        )
    as_bag = path.suffix.lower() == ".mcap"
    if as_bag and cycles:
        raise ConfigurationError(f"{path}: a bag holds samples", "give .csv for cycles")
    stored = None if model is None else model_for(trial, model)
    chosen = trial.select(segment, trial.estimator)
    trial.note_problems()
    if of_gait:
        table = write_gait_file(trial, chosen.rows, path, about)
        table.attrs |= {"segment": str(chosen), "rows": f"{len(table)} samples"}
        return table
    mapped = force_map_of(trial, chosen, prior=prior) if force_map else None
    pressures = pressure_of(trial, chosen, prior=prior) if pressure else None
    table = export_table(trial, chosen, stored, mapped, pressures, about)
    rows = f"{len(table)} samples"
    if cycles is not None:
        found = cycles_of(trial, table, by=cycles, segment=chosen)
        table, rows = found.to_dataframe(), str(found)
    notes: tuple[str, ...] = ()
    if as_bag:
        measured, _ = trial.measurements_and_samples()
        notes = write_standard_bag(measured, chosen.rows, table, path)
    else:
        write_table(table, path)
    if prior is not None:
        notes = (*notes, *sources(mapped, pressures))
    table.attrs |= {"segment": str(chosen), "rows": rows, "notes": notes}
    return table
