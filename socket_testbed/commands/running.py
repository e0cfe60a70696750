"""How verbs run: a trial is opened and checked, work done on one or a folder, results delivered."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

from socket_testbed.batch import Job, Row, Task, plan_jobs, run_batch
from socket_testbed.commands.calls import BatchOptions, Evaluate
from socket_testbed.commands.terminal import say
from socket_testbed.errors import ConfigurationError, TestbedError, option_of
from socket_testbed.files import PICTURES, TABLES, check_outputs, check_suffix
from socket_testbed.identification.data_finding import GOOD
from socket_testbed.identification.model_file import read_model
from socket_testbed.identification.survey_prior import read_survey
from socket_testbed.settings.options import (
    RECORDED,
    MetadataOptions,
    OpenOptions,
    Options,
    SettingsOptions,
    TrialFiles,
    given,
)
from socket_testbed.settings.testbed import EstimatorSettings, estimator_settings
from socket_testbed.trials.bag import find_trials
from socket_testbed.trials.metadata import FIELDS, TrialMetadata, change_metadata
from socket_testbed.trials.reprocess import parse_unloaded
from socket_testbed.trials.segment import Segment, check_specification
from socket_testbed.trials.trial import Trial, naming_notes

if TYPE_CHECKING:
    from socket_testbed.api import Result

_FILES = ("geometry", "calibration", "load_cell", "params", "model", "prior")
# Options of which the outputs of a batch do not depend, or which its jobs compare by themselves.
_NO_SETTINGS = {*_FILES, "output", "replace", "command", "figure", "json"}
_NO_SETTINGS |= {"trial", "jobs", "dask", "again", "alone"}
R = TypeVar("R")
Call = TypeVar("Call", bound=BatchOptions)
Opened = TypeVar("Opened", bound=TrialFiles)
Shown = TypeVar("Shown", bound="Result")


def open_given(trial: Path, files: TrialFiles) -> Trial:
    """Open a trial with its options; each note is printed once on standard error.

    Args:
        trial: Folder of the trial.
        files: How it is opened; `OpenOptions` have unloaded spans, too.
    """
    spans = parse_unloaded([*files.unloaded]) if isinstance(files, OpenOptions) else ()
    return Trial(
        trial,
        files.geometry,
        files.calibration,
        cache(print_note),
        spans,
        files.load_cell,
        files.tare,
    )


def open_checked(trial: Path, options: TrialFiles) -> Trial:
    """Open a trial with its options, and report whether its data is good.

    Args:
        trial: Folder of the trial.
        options: Options of a verb: files, and settings of a fit.
    """
    check_settings(options)
    opened = open_given(trial, options)
    report_data(opened, leave_out=left_out(opened, options))
    return opened


def left_out(trial: Trial, options: Options) -> Sequence[str] | None:
    """The channels that a verb leaves out of a trial; None for those of the trial's settings.

    Args:
        trial: The opened trial.
        options: Options of the verb: `leave_out`, or `params` with a file of settings; of
            `evaluate`, the model, which ignores what its fit left out.
    """
    if isinstance(options, Evaluate):
        return read_model(options.model).settings.leave_out
    stated: Sequence[str] | None = getattr(options, "leave_out", None)
    params: Path | None = getattr(options, "params", None)
    if stated is not None or params is None:
        return stated
    own = trial.estimator.identification.leave_out
    of_file = trial.settings_for(SettingsOptions(params=params)).identification.leave_out
    return None if of_file == own else of_file


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


def check_settings(options: Options) -> None:
    """Refuse settings, a segment and a survey that are wrong for any trial, before one is read."""
    estimator_settings(EstimatorSettings(), options.overrides(), getattr(options, "params", None))
    segment: str | None = getattr(options, "segment", None)
    if segment is not None:
        check_specification(segment)
    prior: Path | None = getattr(options, "prior", None)
    if prior is not None:
        read_survey(prior)


def open_all(paths: Sequence[Path], files: TrialFiles) -> list[Trial]:
    """The trials at some paths, whose notes name them.

    Args:
        paths: Folders of trials; a folder of several stands for all trials in it.
        files: How they are opened.
    """
    found = [each for path in paths for each in find_trials(path, print_note).values() or [path]]
    opened = (open_given(path, files) for path in found)
    return [naming_notes(trial, trial.name) for trial in opened]


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
) -> None:
    """Draw a result if `figure` is given.

    Args:
        found: The result.
        figure: The picture; None for none.
        width: Its printed width [mm].
        title: Whether it has titles, and errors in its keys.
    """
    if figure is not None:
        found.draw(figure, width=width, title=title)


def deliver(
    found: Shown,
    show: Callable[[Shown], None],
    *,
    output: Path | None = None,
    json: bool = False,
    figure: Path | None = None,
    width: Literal[88, 180] = 180,
    title: bool = True,
) -> None:
    """Write and draw a result as requested, then print it as JSON, or `show` it.

    Args:
        found: The result.
        show: Prints it.
        output: Its table; None for none.
        json: Whether to print JSON instead.
        figure: The picture; None for none.
        width: Its printed width [mm].
        title: Whether it has titles, and errors in its keys.
    """
    if output is not None:
        found.save(output)
    draw(found, figure, width=width, title=title)
    if json:
        print(found.to_json())
        return
    show(found)
    for path in filter(None, (output, figure)):
        print(f"\nwritten: {path}")


def on_trial(
    trial: Path,
    options: Opened,
    work: Callable[..., Shown],
    taken: type[Options],
    show: Callable[[Shown], None],
) -> None:
    """Run a function of the API on a trial and deliver its result.

    Args:
        trial: Folder of the trial.
        options: Options of the verb.
        work: The function; it receives the trial and its options.
        taken: The class of its options.
        show: Prints the result.
    """
    written = given(options, deliver)
    replace = getattr(options, "replace", False)
    check_files(written.get("output"), written.get("figure"), replace=replace)
    opened = open_checked(trial, options)
    deliver(work(opened, **given(options, taken)), show, **written)


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


def check_metadata(options: MetadataOptions) -> TrialMetadata:
    """The metadata among the options.

    Raises:
        ConfigurationError: A value is wrong; the error names its option.
    """
    stated = {name: getattr(options, name) for name in FIELDS}
    try:
        return change_metadata(TrialMetadata(), stated, getattr(options, "remove", ()))
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
class TrialVerb(Generic[Call, R]):
    """A verb that works on one trial, or on all trials of a folder in parallel.

    Its functions are module-level, so that workers can import them; they receive the verb's call,
    whose output is that of the trial.

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
    work: Callable[[Trial, Call], R]
    row: Callable[[R], Row]
    show: Callable[[R, Call], None]
    metadata: tuple[str, ...] = ()


def on_trials(verb: TrialVerb[Call, R], call: Call) -> None:
    """Run a verb on its trial, or on all trials of its folder.

    Args:
        verb: The verb.
        call: Its call.

    Raises:
        ConfigurationError: A folder of trials has no output folder, or an option that needs a
            single trial, or a single trial has one that needs a folder.
    """
    json, figure = getattr(call, "json", False), getattr(call, "figure", None)
    trials = find_trials(call.trial, print_note)
    if not trials:
        several = {"jobs": call.jobs, "dask": call.dask, "again": call.again or None}
        refuse_given(several, "a folder of trials", "leave it out")
        table = verb.suffix.endswith(TABLES)
        check_files(call.output, figure, replace=call.replace, table=table)
        found: Any = verb.work(open_checked(call.trial, call), call)
        if json:
            print(found.to_json())
        else:
            verb.show(found, call)
        return
    folder = call.output
    if folder is None or json or figure:
        raise ConfigurationError(
            f"{call.trial} holds {len(trials)} trials",
            "give -o FOLDER without --json and --figure, or one trial",
        )
    check_settings(call)
    chosen = {name: getattr(call, name, None) for name in _FILES}
    files = {name: path.absolute() for name, path in chosen.items() if path}
    call = dataclasses.replace(call, alone=False, **files)
    opened = {name: open_given(path.absolute(), call) for name, path in trials.items()}
    planned = plan_jobs(opened, folder.absolute(), verb.suffix, files)
    names = [item.name for item in dataclasses.fields(call) if item.name not in _NO_SETTINGS]
    settings = {name: getattr(call, name) for name in names}
    metadata = (*verb.metadata, "mass")  # the data check compares the load with it
    work = partial(_run_job, verb, call)
    task = Task(verb.name, folder, work, settings, metadata, call.again, call.replace)
    report = partial(print, flush=True)
    run_batch(task, planned, report, say, call.jobs, call.dask)


def _run_job(verb: TrialVerb[Call, R], call: Call, job: Job) -> Row:
    files: dict[str, Any] = {**job.files, "output": job.output}
    own = dataclasses.replace(call, **files)
    data = report_data(job.trial, good=False, leave_out=left_out(job.trial, own))
    return {"data": data} | verb.row(verb.work(job.trial, own))
