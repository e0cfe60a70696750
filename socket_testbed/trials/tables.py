"""Tables with units as CSV, Parquet and MAT files, and samples as such a table."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from socket_testbed.arrays import FloatArray, StatusArray
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import atomic_output, closest
from socket_testbed.identification.contact import ContactModel
from socket_testbed.identification.evaluation import predict_channels
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, Samples, channel_unit
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.synchronise import Measurements
from socket_testbed.trials.trial import Trial

_LONGEST_NAME = 63  # of a variable in MATLAB


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        name: Its name, such as distal.Fz.
        unit: Its unit, `-` for a number without one; empty for texts and counts.
        values: Its values; NaN and None stand for what is not there.
    """

    name: str
    unit: str
    values: Sequence[Any] | np.ndarray[Any, Any]

    @property
    def title(self) -> str:
        """The name with the unit, such as `distal.Fz [N]`."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def check_format(path: Path) -> None:
    """Refuse a file whose suffix says no format, before long work.

    Raises:
        ConfigurationError: Naming the likely one.
    """
    if path.suffix.lower() not in _WRITERS:
        raise ConfigurationError(
            f"{path}: '{path.suffix}' is no format of a table", closest(path.suffix, _WRITERS)
        )


def write_table(columns: Sequence[Column], path: Path) -> None:
    """Write a table in the format that its suffix says.

    CSV and Parquet have the titles for names, and null where a value is missing; every field of a
    Parquet file has its `unit` in its metadata. A MAT file holds a column vector a column, under
    the name as MATLAB can have it, and a struct `units` of the same names.

    Args:
        columns: The columns, all of the same length.
        path: The file, `.csv`, `.parquet` or `.mat`; an older one is replaced.

    Raises:
        ConfigurationError: For another suffix, or if the file cannot be written.
    """
    check_format(path)
    with atomic_output(path) as staging:
        _WRITERS[path.suffix.lower()](columns, staging)


def _write_csv(columns: Sequence[Column], path: Path) -> None:
    from pyarrow import csv

    csv.write_csv(_arrow_table(columns), path)


def _write_parquet(columns: Sequence[Column], path: Path) -> None:
    from pyarrow import parquet

    parquet.write_table(_arrow_table(columns), path)


def _arrow_table(columns: Sequence[Column]) -> Any:
    import pyarrow

    arrays = [_arrow_array(column) for column in columns]
    fields = [
        pyarrow.field(column.title, array.type, metadata={"unit": column.unit})
        for column, array in zip(columns, arrays, strict=True)
    ]
    return pyarrow.table(arrays, schema=pyarrow.schema(fields))


def _arrow_array(column: Column) -> Any:
    import pyarrow

    array = pyarrow.array(column.values, from_pandas=True)  # NaN becomes null
    if pyarrow.types.is_null(array.type):
        return array.cast(pyarrow.float64() if column.unit else pyarrow.string())
    return array


def _write_mat(columns: Sequence[Column], path: Path) -> None:
    from scipy.io import savemat

    names = matlab_names([column.name for column in columns])
    variables = {n: np.asarray(c.values) for n, c in zip(names, columns, strict=True)}
    units = {n: c.unit for n, c in zip(names, columns, strict=True)}
    savemat(
        path,
        {**variables, "units": units},
        long_field_names=True,
        do_compression=True,
        oned_as="column",
    )


def matlab_names(names: Sequence[str]) -> list[str]:
    """Names as MATLAB can have them: letters, digits, underscores, 63 at most, all different."""
    taken = {"units"}
    found = []
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
        plain = plain if plain[:1].isalpha() else f"x{plain}"
        unique, number = plain[:_LONGEST_NAME], 1
        while unique in taken:
            number += 1
            tail = f"_{number}"
            unique = plain[: _LONGEST_NAME - len(tail)] + tail
        taken.add(unique)
        found.append(unique)
    return found


_WRITERS: dict[str, Callable[[Sequence[Column], Path], None]] = {
    ".csv": _write_csv,
    ".parquet": _write_parquet,
    ".mat": _write_mat,
}


_STRESSES = ("normal", "shear_x", "shear_y")


def sample_columns(
    trial: Trial,
    measured: Measurements,
    samples: Samples,
    segment: Segment,
    model: ContactModel | None = None,
) -> list[Column]:
    """The samples of a trial as columns, with what the clusters' forces were computed from.

    Args:
        trial: The trial.
        measured: All that was measured.
        samples: All samples made of it.
        segment: Which of them are wanted.
        model: A model whose predictions are added as `predicted.*`.

    Returns:
        Stamp [ns], time since the trial's first sample [s], wrench and limb position in {S};
        for each cluster its capacitances by the converter's input [pF], its status (0 ok,
        1 saturated, 2 missing, 3 out of the calibrated range), and its stress [Pa] and force [N]
        in its own frame. NaN where there is none.

    Raises:
        ConfigurationError: If the model lacks a cluster of the samples.
    """
    time = samples.time[segment.rows]
    samples = samples[segment.rows]
    columns = [Column("stamp", "ns", samples.stamps), Column("time", "s", time)]
    columns += _channels("", WRENCH_CHANNELS, samples.wrench)
    columns += [Column(f"q_{axis}", "m", samples.position[:, i]) for i, axis in enumerate("xyz")]
    capacitance, status = measured.capacitance[segment.rows], measured.status[segment.rows]
    for number in range(len(samples.clusters)):
        columns += _cluster_columns(
            trial, samples, number, capacitance[:, number], status[:, number]
        )
    if model is not None:
        columns += _prediction_columns(samples, model)
    return columns


def _channels(prefix: str, names: tuple[str, ...], values: FloatArray) -> list[Column]:
    return [
        Column(f"{prefix}{name}", channel_unit(name), values[:, i]) for i, name in enumerate(names)
    ]


def _cluster_columns(
    trial: Trial,
    samples: Samples,
    number: int,
    capacitance: FloatArray,
    status: StatusArray,
) -> Iterator[Column]:
    name = samples.clusters[number]
    stress, _ = trial.calibration.clusters[name].apply(capacitance, status)
    for channel in range(4):
        yield Column(f"{name}.C{channel}", "pF", capacitance[:, channel])
    yield Column(f"{name}.status", "-", samples.status[:, number])
    for i, component in enumerate(_STRESSES):
        yield Column(f"{name}.{component}", "Pa", stress[:, i])
    yield from _channels(f"{name}.", LOCAL_CHANNELS, samples.local_forces[:, number])


def _prediction_columns(samples: Samples, model: ContactModel) -> list[Column]:
    values = predict_channels(model, samples.position, samples.clusters)
    return _channels("predicted.", samples.channels, values)
