"""Options shared by several verbs, and running a verb on one trial or on a folder of trials."""

from __future__ import annotations

import dataclasses
import inspect
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

from socket_testbed.batch import Job, Row, Task, plan_jobs, run_batch
from socket_testbed.commands.arguments import takes
from socket_testbed.commands.terminal import Progress, say
from socket_testbed.documents import check_number
from socket_testbed.errors import ConfigurationError, TestbedError, option_of
from socket_testbed.files import PICTURES, TABLES, check_outputs, check_suffix
from socket_testbed.identification.data_check import GOOD
from socket_testbed.settings.identification import IdentificationSettings
from socket_testbed.settings.testbed import EstimatorSettings, estimator_settings
from socket_testbed.trials.bag import find_trials
from socket_testbed.trials.metadata import FIELDS, TrialMetadata, change_metadata
from socket_testbed.trials.reprocess import RECORDED, parse_unloaded
from socket_testbed.trials.segment import Segment
from socket_testbed.trials.trial import Trial

if TYPE_CHECKING:
    from socket_testbed.api import Result

_FILES = ("geometry", "calibration", "load_cell", "params", "model")
_NO_SETTINGS = {*_FILES, "output", "replace", "command", "figure", "json"}
R = TypeVar("R")
Shown = TypeVar("Shown", bound="Result")


def given(options: Mapping[str, Any], *functions: Callable[..., Any]) -> dict[str, Any]:
    """The options accepted by some functions, as keywords.

    Args:
        options: Options of a verb, by name of the parameter.
        functions: The functions that are called with the result.
    """
    names = {name for function in functions for name in inspect.signature(function).parameters}
    return {name: value for name, value in options.items() if name in names}


def open_given(
    trial: Path,
    *,
    geometry: Path | None = None,
    calibration: Path | None = None,
    unloaded: Sequence[str] = (),
    load_cell: Path | None = None,
    tare: str = RECORDED,
    **others: Any,
) -> Trial:
    """Open a trial with its options; each note is printed once on standard error.

    Args:
        trial: As `path` in `open_trial`.
        geometry: As in `open_trial`.
        calibration: As in `open_trial`.
        unloaded: As in `open_trial`.
        load_cell: As in `open_trial`.
        tare: As in `open_trial`.
    """
    spans = parse_unloaded([*unloaded])
    return Trial(trial, geometry, calibration, cache(print_note), spans, load_cell, tare)


def open_checked(trial: Path, **options: Any) -> Trial:
    """Open a trial with its options, and report whether its data is good."""
    check_settings(options)
    opened = open_given(trial, **options)
    left_out, params = options.get("leave_out"), options.get("params")
    if left_out is None and params is not None:
        own = opened.with_channels(opened.estimator).identification.leave_out
        settings = opened.with_channels(estimator_settings(opened.estimator, Path(params)))
        stated = settings.identification.leave_out
        left_out = None if stated == own else stated
    report_data(opened, leave_out=left_out)
    return opened


def report_data(trial: Trial, good: bool = True, leave_out: Sequence[str] | None = None) -> str:
    """Report whether a trial's data is good, or the findings, as notes of the trial.

    For an unreadable trial, the error is left to the verb.

    Args:
        trial: The trial.
        good: Whether to report good data too.
        leave_out: Channels that are not checked; None stands for those of the trial's settings.

    Returns:
        The worst finding, or that the data is good; empty for an unreadable trial.
    """
    try:
        left = None if leave_out is None else tuple(leave_out)
        found = [*map(str, trial.problems(left))] or [GOOD]
    except TestbedError:
        return ""
    for line in found:
        if good or line != GOOD:
            trial.note(line)
    return found[0].removeprefix("data: ")


def check_settings(options: Mapping[str, Any]) -> None:
    """Refuse settings of a fit that are wrong for any trial, before one is read."""
    settings = given(options, estimator_settings, IdentificationSettings)
    estimator_settings(EstimatorSettings(), **settings)


def open_all(paths: Sequence[Path], options: Mapping[str, Any]) -> list[Trial]:
    """The trials at some paths, whose notes name them.

    Args:
        paths: Folders of trials; a folder of several stands for all trials in it.
        options: Options of a verb, of which those of `open_given` count.
    """

    def named(trial: Trial) -> Callable[[str], None]:
        own = f"{trial.name}: "
        return cache(lambda note: print_note(note if note.startswith(own) else own + note))

    found = [path for given in paths for path in find_trials(given, print_note).values() or [given]]
    trials = [open_given(path, **options) for path in found]
    return [dataclasses.replace(trial, notify=named(trial)) for trial in trials]


def refuse_given(options: Mapping[str, Any], belongs: str, hint: str) -> None:
    """Raise an error for options without meaning in this call.

    Args:
        options: These options; None and an unchanged tare count as not given.
        belongs: What they are for, in words.
        hint: What to do, for the error.

    Raises:
        ConfigurationError: One of them is given.
    """
    for name, value in options.items():
        if value not in (None, RECORDED):
            raise ConfigurationError(f"{option_of(name)} is for {belongs}", hint)


def check_files(
    output: Path | None, figure: Path | None = None, *, replace: bool, table: bool = True
) -> None:
    """Refuse an unsupported format or an existing file before long work.

    Args:
        output: The output file; None for none.
        figure: The picture; None for none.
        replace: Whether to accept existing files.
        table: Whether the output must be a table: `.csv`, `.parquet` or `.mat`.
    """
    if output is not None and table:
        check_suffix(output, TABLES, "table")
    if figure is not None:
        check_suffix(figure, PICTURES, "picture")
    check_outputs(output, figure, replace=replace)


def draw(
    found: Result,
    figure: Path | None = None,
    *,
    width: Literal[88, 180] = 180,
    title: bool = True,
    **others: Any,
) -> None:
    """Draw a result if `figure` is given.

    Args:
        figure: Draw the results as .png, .pdf or .svg.
        width: Printed width of figures [mm]: one column of a paper, or the full page.
        title: Titles of figures and errors in their keys.
    """
    if figure is not None:
        found.draw(figure, width=width, title=title)


@takes("commands.options.open_given", "commands.options.draw", "files.check_outputs")
def deliver(
    found: Shown,
    show: Callable[[Shown], None],
    *,
    output: Path | None = None,
    figure: Path | None = None,
    json: bool = False,
    **options: Any,
) -> None:
    """Write and draw a result as requested, then print it as JSON, or `show` it.

    Args:
        output: Table of the result.
        json: Print JSON on standard output.
    """
    if output is not None:
        found.save(output)
    draw(found, figure, **options)
    if json:
        print(found.to_json())
        return
    show(found)
    for path in filter(None, (output, figure)):
        print(f"\nwritten: {path}")


def on_trial(
    trial: Path,
    options: Mapping[str, Any],
    work: Callable[..., Shown],
    show: Callable[[Shown], None],
    *settings: Callable[..., Any],
) -> None:
    """Run a function of the API on a trial and deliver its result.

    Args:
        trial: Folder of the trial.
        options: Options of the verb, by name.
        work: The function; it receives the trial, and its own options and those of `settings`.
        show: Prints the result.
        settings: Further functions whose options it takes.
    """
    check_files(options.get("output"), options.get("figure"), replace=options["replace"])
    opened = open_checked(trial, **options)
    found = work(opened, **given({**options, "progress": Progress}, work, *settings))
    deliver(found, show, **options)


def segment_columns(samples: int, segment: Segment) -> Row:
    """Summary columns: number of samples and segment of a trial.

    Args:
        samples: Number of samples used.
        segment: The segment; its start and end are in seconds since the trial's first sample.
    """
    return {
        "samples": samples,
        "segment": segment.kind,
        "segment_start [s]": segment.start,
        "segment_end [s]": segment.end,
    }


def check_metadata(options: Mapping[str, Any]) -> TrialMetadata:
    """The metadata among the options.

    Raises:
        ConfigurationError: A value is wrong; the error names its option.
    """
    stated = {name: options[name] for name in FIELDS}
    try:
        return change_metadata(TrialMetadata(), stated, options.get("remove", ()))
    except ConfigurationError as error:
        raise ConfigurationError(f"--{error.fact}", error.hint) from None


def typed_command() -> str:
    """The command as typed, without the program's path."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])


def name_and_value(word: str, option: str, example: str) -> tuple[str, str]:
    """The parts of an option's NAME=VALUE.

    Args:
        word: The word given.
        option: The option, for the error, such as `--fault`.
        example: A correct word, for the error.

    Raises:
        ConfigurationError: The word has no name, no value or no equals sign.
    """
    name, _, value = word.partition("=")
    if not name or not value:
        raise ConfigurationError(f"{option}: '{word}' is not NAME=VALUE", f"write it as {example}")
    return name, value


def print_note(note: str) -> None:
    """Print a note on standard error."""
    say(f"note: {note}")


@dataclass(frozen=True)
class TrialVerb(Generic[R]):
    """A verb that works on one trial, or on all trials of a folder in parallel.

    Its functions are module-level, so that workers can import them; they receive the verb's options
    by name, including `output`.

    Attributes:
        name: The verb.
        suffix: Suffix of the outputs of a folder of trials, such as `.pressure.csv`.
        work: Computes the result of a trial and writes the output.
        row: The result's row of the summary of a folder: values by column name with the unit.
        show: Prints the result of a single trial.
        metadata: Metadata fields that the outputs depend on: a trial is repeated if they change.
    """

    name: str
    suffix: str
    work: Callable[[Trial, Mapping[str, Any]], R]
    row: Callable[[R], Row]
    show: Callable[[R, Mapping[str, Any]], None]
    metadata: tuple[str, ...] = ()


@takes("commands.options.open_given", exclusive="jobs dask")
def on_trials(
    verb: TrialVerb[R],
    trial: Path,
    *,
    output: Path | None = None,
    jobs: int | None = None,
    dask: str | None = None,
    again: bool = False,
    replace: bool = False,
    **options: Any,
) -> None:
    """For a folder of trials.

    Args:
        trial: Folder of the trial, or a folder of trials.
        output: The output file, or the folder of output files.
        jobs: Number of parallel trials (default: one per core).
        dask: Use the workers of a Dask cluster instead, by the address of its scheduler.
        again: Repeat finished trials.
        replace: Replace existing outputs.

    Raises:
        ConfigurationError: A folder of trials has no output folder, or an option that needs a
            single trial, or a single trial has one that needs a folder.
    """
    options |= {"output": output, "replace": replace}
    json, figure = options.get("json"), options.get("figure")
    trials = find_trials(trial, print_note)
    if not trials:
        several = {"jobs": jobs, "dask": dask, "again": again or None}
        refuse_given(several, "a folder of trials", "leave it out")
        check_files(output, figure, replace=replace, table=verb.suffix.endswith(TABLES))
        found: Any = verb.work(open_checked(trial, **options), {"alone": True, **options})
        if json:
            print(found.to_json())
        else:
            verb.show(found, options)
        return
    if output is None or json or figure:
        raise ConfigurationError(
            f"{trial} holds {len(trials)} trials",
            "give -o FOLDER without --json and --figure, or one trial",
        )
    check_settings(options)
    files = {name: path.absolute() for name in _FILES if (path := options.get(name))}
    opened = {name: open_given(path.absolute(), **options | files) for name, path in trials.items()}
    planned = plan_jobs(opened, output.absolute(), verb.suffix, files)
    work = partial(_run_job, verb, {"alone": False, **options})
    settings = {name: value for name, value in options.items() if name not in _NO_SETTINGS}
    metadata = (*verb.metadata, "mass")  # the data check compares the load with it
    task = Task(verb.name, output, work, settings, metadata, again, replace)
    if jobs is not None:
        check_number(jobs, "--jobs", 1)
    report = partial(print, flush=True)
    run_batch(task, planned, report, say, jobs, dask)


def _run_job(verb: TrialVerb[R], options: Mapping[str, Any], job: Job) -> Row:
    data = report_data(job.trial, good=False, leave_out=options.get("leave_out"))
    return {"data": data} | verb.row(
        verb.work(job.trial, {**options, **job.files, "output": job.output})
    )
