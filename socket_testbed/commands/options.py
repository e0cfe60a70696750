"""Arguments that several verbs share, and a verb's work on one trial or on a folder of them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from socket_testbed.batch import Job, Row, Task, find_trials, plan_jobs, run_batch
from socket_testbed.commands.arguments import ExtendList
from socket_testbed.documents import check_number
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import WIDTHS, check_outputs, check_picture
from socket_testbed.settings import testbed
from socket_testbed.settings.identification import VARIANTS, WEIGHTS
from socket_testbed.settings.testbed import EstimatorSettings
from socket_testbed.trials.metadata import FIELDS, TrialMetadata, change_metadata
from socket_testbed.trials.reprocess import RECORDED
from socket_testbed.trials.synchronise import parse_unloaded
from socket_testbed.trials.trial import Trial

_FILES = ("geometry", "calibration", "load_cell", "params", "model")
CHOICES = (
    "variant",
    "theta",
    "weights",
    "smoothness",
    "leave_out",
    "pose_smoothing",
    "frames",
    "initial_stiffness",
    "solver",
)
R = TypeVar("R")


def add_trial(
    parser: argparse.ArgumentParser,
    what: str = "folder of the trial",
    count: str | None = None,
    metavar: str = "TRIAL",
) -> None:
    """A trial, or several, and what is used instead of the configuration stored in it."""
    parser.add_argument("trial", type=Path, metavar=metavar, help=what, nargs=count)
    for name, file, text in (
        ("geometry", "SOCKET", "socket.yaml; poses are fitted anew to other markers"),
        ("calibration", "CALIBRATION", "calibration.yaml"),
        ("load-cell", "TESTBED", "matrix, signs and gains of the load cell"),
    ):
        help_ = f"instead of the trial's {text}"
        parser.add_argument(f"--{name}", type=Path, metavar=f"{file}.yaml", help=help_)
    parser.add_argument(
        "--tare",
        default=RECORDED,
        metavar="T0:T1|none|recorded",
        help="the mean wrench of these seconds, without load, as the tare (default: recorded)",
    )


def add_judgement(parser: argparse.ArgumentParser) -> None:
    """When a tile is in contact, and when an output of pressure is determined."""
    # It takes its time to import, and two verbs alone need it.
    from socket_testbed.identification.pressure import SHARE, THRESHOLD

    threshold = 1e-3 * THRESHOLD
    parser.add_argument(
        "--threshold",
        type=float,
        default=threshold,
        metavar="KPA",
        help=f"pressure above which a tile is in contact (default: {threshold:g})",
    )
    parser.add_argument(
        "--share",
        type=float,
        default=SHARE,
        help="a value is not determined if its 95 %% interval reaches farther from it than this"
        f" share of it (default: {SHARE:g})",
    )


def add_trials(parser: argparse.ArgumentParser) -> None:
    """A trial, or a folder of trials and where they are worked on."""
    add_trial(parser, "folder of the trial, or a folder of trials")
    many = parser.add_argument_group("for a folder of trials")
    where = many.add_mutually_exclusive_group()
    where.add_argument(
        "--jobs", type=int, metavar="N", help="trials at a time (default: one per core)"
    )
    where.add_argument(
        "--dask", metavar="ADDRESS", help="scheduler of a Dask cluster whose workers do it instead"
    )
    many.add_argument("--again", action="store_true", help="repeat finished trials")


def add_replace(parser: argparse.ArgumentParser, what: str = "outputs that exist") -> None:
    """Whether an output replaces a file; see `files.check_outputs`."""
    parser.add_argument("--replace", action="store_true", help=f"replace {what}")


def add_segment(parser: argparse.ArgumentParser, default: str = "plateau") -> None:
    """The segment of a trial."""
    parser.add_argument(
        "--segment",
        default=default,
        metavar="plateau|hold|auto|all|T0:T1|event:A:B",
        help="the longest plateau; the longest under load; that or, without one, all that is under"
        " load; all of the trial; seconds since its first sample; or between events, such as"
        f" event:placed+5:removed-2 (default: {default})",
    )


def add_unloaded(parser: argparse.ArgumentParser) -> None:
    """Spans without load."""
    parser.add_argument(
        "--unloaded",
        action=ExtendList,
        nargs="+",
        metavar="T0:T1",
        help="seconds without load before, and after: the clusters' drift is corrected by them",
    )


def add_figure(parser: argparse.ArgumentParser, metavar: str, text: str) -> None:
    """A figure, and how it is set."""
    parser.add_argument("--figure", type=Path, metavar=f"{metavar}.png|pdf", help=text)
    add_figure_style(parser, "the figure")


def add_figure_style(parser: argparse.ArgumentParser, what: str) -> None:
    """How figures are set."""
    parser.add_argument(
        "--width",
        type=int,
        choices=WIDTHS,
        default=WIDTHS[-1],
        help=f"printed width of {what} [mm]: a column of a paper, or its page (default: 180)",
    )
    parser.add_argument(
        "--no-title",
        dest="title",
        action="store_false",
        help=f"leave titles, and errors in keys, of {what} to the caption",
    )


def check_figure(options: argparse.Namespace) -> None:
    """Refuse a figure of an unknown format, before long work."""
    if options.figure is not None:
        check_picture(options.figure)


def figure_choices(options: argparse.Namespace) -> dict[str, Any]:
    """How figures are set, for the functions that draw."""
    return {"width": options.width, "title": options.title}


def add_metadata(parser: argparse.ArgumentParser) -> None:
    """Metadata of a trial."""
    group = parser.add_argument_group("metadata of the trial, each optional")
    for name, kind, metavar, text in (
        ("subject", str, "CODE", "code of the subject, such as S01; never a name"),
        ("side", str, "left|right", "side of the residual limb"),
        ("socket", str, "TEXT", "the socket, such as 'PTB 3'"),
        ("liner", str, "TEXT", "liner or sock"),
        ("mass", float, "KG", "body mass of the subject [kg]"),
        ("operator", str, "CODE", "initials or a code of who records it"),
        ("protocol", str, "TEXT", "the protocol that it follows"),
        ("notes", str, "TEXT", "anything else"),
    ):
        group.add_argument(f"--{name}", type=kind, metavar=metavar, help=text)


def metadata_of(options: argparse.Namespace, remove: Iterable[str] = ()) -> TrialMetadata:
    """The metadata that `add_metadata` was given.

    Raises:
        ConfigurationError: If one is wrong.
    """
    given = {name: getattr(options, name) for name in FIELDS}
    try:
        return change_metadata(TrialMetadata(), given, remove)
    except ConfigurationError as error:
        raise ConfigurationError(f"--{error.fact}", error.hint) from None


def add_identification(
    parser: argparse.ArgumentParser, variant: bool = True, theta: bool = True
) -> None:
    """Settings of the identification; what is not given comes from the trial's testbed.yaml."""
    add_model_choice(parser, variant, theta)
    parser.add_argument(
        "--params", type=Path, metavar="TESTBED.yaml", help="instead of the trial's testbed.yaml"
    )


def add_model_choice(
    parser: argparse.ArgumentParser, variant: bool = True, theta: bool = True
) -> None:
    """Settings of the identification that are often chosen for one run.

    Not given, they are those of the trial's own testbed.yaml, which holds the defaults that the
    help names unless it was recorded with others.

    Args:
        parser: The verb's parser.
        variant: Whether the verb leaves the choice of the variant.
        theta: Whether it leaves the choice of theta.
    """
    if variant:
        parser.add_argument(
            "--variant",
            choices=VARIANTS,
            help="the law: stiffness as published, rigid by the limb's pose; _bias with offsets"
            " (default: rigid_bias)",
        )
    if theta:
        parser.add_argument(
            "--theta",
            type=float,
            help="weight of the wrench against the clusters, 0 to 1 (default: 0.5)",
        )
    parser.add_argument(
        "--weights",
        choices=WEIGHTS,
        help="what weighs the channels of the wrench, and of the clusters, against each other"
        " (default: size)",
    )
    parser.add_argument(
        "--smoothness",
        type=float,
        help="weight of the smoothness over neighbouring tiles (default: 1e-3)",
    )
    parser.add_argument(
        "--leave-out",
        action=ExtendList,
        nargs="+",
        metavar="CHANNEL",
        help="channels to leave out of the objective, such as Mz or Mz,distal.Fx",
    )
    parser.add_argument("--solver", help="any solver that qpsolvers finds (default: osqp)")


def add_pose_smoothing(parser: argparse.ArgumentParser, default: str = "0, none") -> None:
    """The window over which poses are averaged, and where it comes from unless it is given."""
    parser.add_argument(
        "--pose-smoothing",
        type=float,
        metavar="SECONDS",
        help=f"centred window over which the poses are averaged (default: {default})",
    )


def add_stage_one(parser: argparse.ArgumentParser, frames: str = "0, all") -> None:
    """The samples of an offline fit, and what Stage 1 of the paper's variants starts from."""
    parser.add_argument(
        "--frames",
        type=int,
        metavar="N",
        help=f"samples that are used, from the segment's start (default: {frames})",
    )
    parser.add_argument(
        "--initial-stiffness",
        type=_stiffness,
        metavar="K0|auto",
        help="stiffness of Stage 1 [N/m]; auto: from the slope of the wrench over the pose"
        " (default: 3000)",
    )


def _stiffness(text: str) -> str | float:
    return text if text == "auto" else float(text)


def add_thetas(parser: argparse.ArgumentParser) -> None:
    """Number of thetas of a front."""
    parser.add_argument(
        "--thetas", type=int, default=101, metavar="N", help="thetas on the front (default: 101)"
    )


def choices(options: argparse.Namespace) -> dict[str, Any]:
    """What `add_identification` was given, as keywords of the API."""
    return {name: getattr(options, name, None) for name in ("params", *CHOICES)}


def estimator_settings(options: argparse.Namespace, stored: EstimatorSettings) -> EstimatorSettings:
    """The estimator's settings: the command line's over the file's over the stored ones."""
    return testbed.estimator_settings(stored, **choices(options))


def choose_model(options: argparse.Namespace, settings: EstimatorSettings) -> EstimatorSettings:
    """The estimator's settings with what `add_model_choice` was given."""
    given = {name: getattr(options, name, None) for name in CHOICES}
    return testbed.estimator_settings(settings, **given)


def trial_of(options: argparse.Namespace) -> Trial:
    """The trial of the options; each note on it goes to standard error once."""
    spans = parse_unloaded(getattr(options, "unloaded", None) or [])
    notify = cache(print_note)
    own = options.trial, options.geometry, options.calibration
    return Trial(*own, notify, spans, options.load_cell, options.tare)


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def print_note(note: str) -> None:
    """Print a note on standard error."""
    _warn(f"note: {note}")


def _report(line: str) -> None:
    print(line, flush=True)  # at once, however standard output is buffered


def _warn(line: str) -> None:
    print(line, file=sys.stderr)


@dataclass(frozen=True)
class TrialVerb(Generic[R]):
    """A verb that works on one trial, or on every trial of a folder in parallel.

    The work takes the verb's options and the trial; `options.alone` says whether it is a single
    one. All functions are of a module, so that workers can import them.

    Attributes:
        name: Name of the verb.
        suffix: End of the names of the outputs of a folder of trials.
        settings: Options that the results depend on, besides files.
        work: Works on a trial and writes `options.output`.
        row: The result's row of the summary.
        show: Prints the result for a single trial.
        metadata: Fields of the trials' metadata that the outputs depend on.
    """

    name: str
    suffix: str
    settings: tuple[str, ...]
    work: Callable[[argparse.Namespace, Trial], R]
    row: Callable[[R], Row]
    show: Callable[[argparse.Namespace, R], None]
    metadata: tuple[str, ...] = ()

    def run(self, options: argparse.Namespace) -> None:
        """Do the work on the trial of the options, or on all trials below that folder."""
        trials = find_trials(options.trial, print_note)
        options = argparse.Namespace(**vars(options), alone=not trials)
        if not trials:
            check_outputs(options.output, replace=options.replace)
            self.show(options, self.work(options, trial_of(options)))
            return
        estimator_settings(options, EstimatorSettings())  # wrong for all is reported once
        files = {_option(name): getattr(options, name, None) for name in _FILES}
        spans = parse_unloaded(options.unloaded or [])
        jobs = plan_jobs(trials, options.output, self.suffix, files, spans, options.tare)
        settings = {name: getattr(options, name) for name in ("tare", *self.settings)}
        work = partial(self._do, options)
        again, replace = options.again, options.replace
        task = Task(self.name, options.output, work, settings, self.metadata, again, replace)
        if options.jobs is not None:
            check_number(options.jobs, "--jobs", 1)
        run_batch(task, jobs, _report, _warn, options.jobs, options.dask)

    def _do(self, options: argparse.Namespace, job: Job) -> Row:
        files = {name: job.files.get(_option(name)) for name in _FILES}
        own = argparse.Namespace(**{**vars(options), **files, "output": job.output})
        return self.row(self.work(own, job.trial))
