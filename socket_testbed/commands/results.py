"""Results of trials: models fitted and judged; `pressure` and the force `map` without a fit."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Literal

import pandas as pd

from socket_testbed import api
from socket_testbed.api import Evaluation, PaperTable, TrialFit, TrialPressure
from socket_testbed.batch import Row
from socket_testbed.commands import calls
from socket_testbed.commands.calls import takes
from socket_testbed.commands.running import (
    TrialVerb,
    check_files,
    deliver,
    draw,
    left_out,
    on_trial,
    on_trials,
    open_all,
    report_data,
    segment_columns,
)
from socket_testbed.commands.terminal import Progress, decimals, say, text_of
from socket_testbed.documents import finite_or_null
from socket_testbed.errors import ConfigurationError, IdentificationError
from socket_testbed.files import PAGES, PICTURES, TABLES
from socket_testbed.geometry.regions import main_regions
from socket_testbed.identification.channel_errors import (
    ChannelErrors,
    errors_to_dataframe,
    summarise_errors,
)
from socket_testbed.identification.information import MIN_RATIO, share_warning
from socket_testbed.identification.model_file import quoted_figures
from socket_testbed.identification.pareto import Front
from socket_testbed.results import pressure_text
from socket_testbed.results.cycles import MAX_PANELS
from socket_testbed.settings.identification import PAPER_VARIANTS
from socket_testbed.settings.options import (
    EvaluationOptions,
    FitOptions,
    FrontOptions,
    MapOptions,
    PaperOptions,
    PressureOptions,
    ValidationOptions,
    given,
)
from socket_testbed.tables import Table
from socket_testbed.trials.trial import Trial

_MAX_SHOWN = 8  # tiles of a map
_FRONT_LEGEND = (
    "wrench error, local error: roots of the weighted squares of the objective, J_w and J_f;"
    "\nRMSE: of the channels in the objective;"
    "\ndominated: another theta is better in both, which is possible with two successive stages"
)


@takes(calls.Fit)
def fit(call: calls.Fit) -> None:
    """Identify the contact model on a trial, or on every trial of a folder.

    Raises:
        ConfigurationError: The output has the suffix of a table, a page or a picture.
    """
    suffix = call.output.suffix
    if suffix.lower() in (*TABLES, *PAGES, *PICTURES):
        raise ConfigurationError(f"{call.output}: a model is not a {suffix}", "name a .json")
    on_trials(TrialVerb("fit", ".json", _fit, _fit_row, _show_fit), call)


def _fit(trial: Trial, call: calls.Fit) -> TrialFit:
    found = api.fit(trial, **given(call, FitOptions))
    found.save(call.output)
    return found


def _show_fit(found: TrialFit, call: calls.Fit) -> None:
    fit, model, settings = found.fit, found.fit.model, found.fit.settings
    size = model.stiffness.size
    count = f"{fit.samples} of {len(found.trial.samples())} samples"
    print(f"{found.trial.name}: {found.segment}, {count}")
    print(
        f"variant {model.variant}, theta {settings.theta:g}, weights by {settings.weights}; in"
        f" {fit.determined:.0f} of {size} stiffness directions the data outweigh the smoothness"
    )
    if model.variant in PAPER_VARIANTS:
        print(f"stiffness k0 of Stage 1: {settings.initial_stiffness:.4g} N/m")
    if not (fit.stage_one.determined and fit.stage_two.determined):
        print("warning: the solution is not unique: give a --smoothness above 0")
    if fit.wrench:
        print(f"the wrench is predicted by {fit.wrench}")
    print(f"{fit.status}\n\n{errors_table(fit.errors)}\n")
    shares, motion = found.load_shares(), found.motion()
    borne = [f"{share.name} {decimals(100 * share.springs, 0)} %" for share in shares]
    print(f"share of the measured load carried by the springs: {', '.join(borne)}")
    if warning := share_warning(shares):
        print(f"warning: {warning}")
    print(
        f"the pose moves by {MIN_RATIO:g} times its noise or more in {motion.directions} of 6"
        " independent directions"
    )
    for excitation in motion.excitations:
        print(f"  {excitation}")
    print(f"\nmodel in {call.output}")


def _fit_row(found: TrialFit) -> Row:
    fit = found.fit
    solutions = (fit.stage_one, fit.stage_two, fit.joint)
    certificates = [solution.certificate for solution in solutions if solution is not None]
    _, force, _ = found.load_shares()
    unseen: tuple[ChannelErrors, ...] = ()  # none where they are unknown
    try:
        unseen = found.unseen_half()
    except IdentificationError as error:
        found.trial.note(f"no skill on an unseen half: {error}")
    return {
        **segment_columns(fit.samples, found.segment),
        "variant": fit.model.variant,
        "theta [-]": fit.settings.theta,
        "force_on_springs [-]": finite_or_null(force.springs),
        "kkt_residual [-]": max(c.stationarity for c in certificates),
        "duality_gap [-]": max(c.gap for c in certificates),
        **error_columns(fit.errors, {"_in_sample": fit.errors, "_unseen_half": unseen}),
    }


@takes(calls.Evaluate)
def evaluate(call: calls.Evaluate) -> None:
    """Compute a model's errors on a trial, or on every trial of a folder."""
    if not call.model.is_dir():
        api.read_model(call.model)  # an invalid model is reported once
    metadata = ("side",) if call.pressure else ()  # the regions depend on the side
    verb = TrialVerb(
        "evaluate", ".errors.json", _evaluate, _evaluation_row, _show_evaluation, metadata
    )
    on_trials(verb, call)


def _evaluate(trial: Trial, call: calls.Evaluate) -> Evaluation:
    found = api.evaluate(trial, call.model, **given(call, EvaluationOptions))
    if call.output is not None:
        found.save(call.output)
    return found


def _show_evaluation(found: Evaluation, call: calls.Evaluate) -> None:
    print(f"{found.trial.name}: {found.segment}, {found.samples} samples")
    print(f"model {found.model.model.variant} of {found.model.trial}\n")
    print(errors_table(found.errors))
    if found.in_sample:
        print("\nin-sample where the model was fitted: errors on another trial may be far larger")
    if found.pressure is not None:
        print(f"\nfrom the force map, not from the model:\n\n{pressure_tables(found.pressure)}")


def _evaluation_row(found: Evaluation) -> Row:
    return {
        **segment_columns(found.samples, found.segment),
        "model": found.model.trial,
        "variant": found.model.model.variant,
        "theta [-]": found.model.settings.theta,
        "in_sample": "yes" if found.in_sample else "no",
        **error_columns(found.errors, {"": found.errors}),
        **(pressure_text.summary_row(found.pressure) if found.pressure is not None else {}),
    }


@takes(calls.Validate)
def validate(call: calls.Validate) -> None:
    """Judge estimates on held-out data, against simple rivals."""
    check_files(call.output, call.figure, replace=call.replace)
    trials = open_all(call.trial, call)
    for each in trials:
        report_data(each, leave_out=left_out(each, call))
    found = api.validate(*trials, **given(call, ValidationOptions), progress=Progress)
    deliver(found, _show_validation, **given(call, deliver))


def _show_validation(found: api.Validation) -> None:
    from socket_testbed.report.validation import LEGEND, judged_tables

    if len(found.trials) == 1:
        print(f"{found.trials[0]}: the part under load, in two halves")
    else:
        print(
            f"{len(found.trials)} trials, means over them; models fitted on {len(found.fitted)}:"
            f" {', '.join(found.fitted)}"
        )
    for line in found.priors:
        print(line)
    for judged in judged_tables(found):
        print(f"\n{judged.caption}\n\n{text_of(judged)}")
    print(f"\n{textwrap.fill(LEGEND, 100)}")


@takes(calls.Pareto)
def pareto(call: calls.Pareto) -> None:
    """Trace the trade-off between wrench and clusters over theta."""
    work = partial(api.pareto, progress=Progress)
    on_trial(call.trial, call, work, FrontOptions, _show_fronts)


def _show_fronts(found: api.Tradeoff) -> None:
    from socket_testbed.report.fronts import marks_table

    fronts = [*found.fronts.values()]
    print(
        f"{found.trial.name}: {found.segment}, theta from 0 to 1 in {len(fronts[0].theta)} values\n"
    )
    print(f"{text_of(marks_table(fronts))}\n\n{_FRONT_LEGEND}\n")
    for front in fronts:
        print(_describe_front(front))


def _describe_front(front: Front) -> str:
    """Counts, certificate and flaws of a front, one per line."""
    count = len(front.theta)
    lines = [
        f"{front.variant}: {front.knee.verdict}",
        f"  {int(front.non_dominated.sum())} of {count} solutions not dominated, largest KKT"
        f" residual or gap {front.worst_residual:.1e}",
    ]
    for flaw in dict.fromkeys(filter(None, front.flaws)):
        thetas = front.theta[[text == flaw for text in front.flaws]]
        span = f"{thetas[0]:.3g}" + (f" to {thetas[-1]:.3g}" if len(thetas) > 1 else "")
        lines.append(f"  left out: {len(thetas)} at theta {span}: {flaw}")
    return "\n".join(lines)


@takes(calls.Paper)
def paper(call: calls.Paper) -> None:
    """Run the published pipeline and compare its figures with the published ones."""
    work = partial(api.paper, progress=Progress)
    on_trial(call.trial, call, work, PaperOptions, _show_paper)


def _show_paper(found: PaperTable) -> None:
    settings = found.settings.to_flat()
    print(f"{found.trial.name}: {found.segment}, {found.samples} samples")
    print(
        f"theta {settings['theta']:g}, weights {settings['weights']}; rest positions within"
        f" {1e3 * settings['rest_position_limit']:g} mm of"
        f" {settings['reference_position'] or 'the mean limb position'}; k0"
        f" {settings['initial_stiffness']:.4g} N/m, alpha {settings['gate_sharpness']:g} 1/m\n"
    )
    figures = pd.DataFrame.from_dict(found.document()["figures"], orient="index")
    print(text_of(Table("figures", "", figures.rename_axis("figure"))))


def errors_table(errors: Sequence[ChannelErrors]) -> str:
    """RMSE, MAE and sigma [N m, N] and skill [-] per channel, with means and medians, as text."""
    frame = errors_to_dataframe(errors).drop(columns="samples")
    frame[""] = frame.pop("in objective").map({True: "", False: "not in objective"})
    summary = summarise_errors(errors)
    lines = [
        text_of(Table("errors", "", frame, {"skill": "z.2f"})),
        "",
        f"{summary.in_words(decimals)}, of the channels in the objective",
        f"median skill of the wrench {decimals(summary.wrench_skill, 2)}, of the local forces"
        f" {decimals(summary.local_skill, 2)}",
    ]
    if any(error.skill < 0.0 for error in errors):
        lines.append("negative skill: the channel's mean would have been a better prediction")
    if summary.without_value:
        lines.append(f"without a value, not included: {', '.join(summary.without_value)}")
    return "\n".join(lines)


def error_columns(
    errors: Sequence[ChannelErrors], judged: Mapping[str, Sequence[ChannelErrors]]
) -> Row:
    """Error columns for a summary: the paper's figures, median skills, then every channel.

    Args:
        errors: Errors of every channel in its unit [N m, N].
        judged: Errors that median skills come from, by the suffix of their columns' names, such as
            `_in_sample`.

    Returns:
        Values by column name with the unit, such as `Fz_rmse [N]`; None where unknown.
    """
    row: Row = {**quoted_figures(errors)}
    for suffix, channels in judged.items():
        summary = summarise_errors(channels)
        row[f"median_wrench_skill{suffix} [-]"] = summary.wrench_skill
        row[f"median_local_skill{suffix} [-]"] = summary.local_skill
    for error in errors:
        row |= {
            f"{error.name}_rmse [{error.unit}]": error.rmse,
            f"{error.name}_mae [{error.unit}]": error.mae,
            f"{error.name}_sigma [{error.unit}]": error.sigma,
            f"{error.name}_skill [-]": error.skill,
        }
    return {name: finite_or_null(value) for name, value in row.items()}


@takes(calls.Pressure)
def pressure(call: calls.Pressure) -> None:
    """Pressure by region: mean, peak, contact area, time integral, shear, load.

    Raises:
        ConfigurationError: A table over time is asked for without an output.
    """
    if call.over_time and call.output is None:
        raise ConfigurationError("--over-time has no output", "name its table with -o FILE.csv")
    verb = TrialVerb(
        "pressure", ".pressure.csv", _pressure, _pressure_row, _show_pressure, ("side",)
    )
    on_trials(verb, call)


def _pressure(trial: Trial, call: calls.Pressure) -> TrialPressure:
    found = api.pressure(trial, **given(call, PressureOptions))
    if call.prior is not None and not call.alone:
        trial.note(found.outputs.source)  # the summary has no line for it
    if call.cycles is not None:
        _bring_to_cycles(found, call.cycles, output=call.output, **given(call, draw))
        return found
    if call.output is not None:
        found.save(call.output, over_time=call.over_time)
    draw(found, **given(call, draw))
    return found


def _bring_to_cycles(
    found: TrialPressure,
    cycles: str,
    output: Path | None,
    *,
    figure: Path | None = None,
    width: Literal[88, 180] = 180,
    title: bool = True,
) -> None:
    """Write all outputs normalised to cycles, and draw the mean pressure of the regions."""
    table, to_cycles = found.over_time(), partial(api.cycles, found.trial, by=cycles)
    outputs = to_cycles(table, segment=found.segment)
    say(f"{outputs}\n")
    if output is not None:
        outputs.save(output)
    if figure is not None:
        names = [place.name for place in main_regions(found.places)][-MAX_PANELS:]  # the user's
        shown = [f"{name}.mean pressure [kPa]" for name in names]
        drawn = to_cycles(table[shown], segment=found.segment)
        draw(drawn, figure=figure, width=width, title=title)


def _show_pressure(found: TrialPressure, call: calls.Pressure) -> None:
    print(f"{found.trial.name}: {found.segment}, {len(found.time)} samples")
    print(f"{found.outputs.source}\n")
    print(pressure_tables(found))
    for path in filter(None, (call.output, call.figure)):
        print(f"\nwritten: {path}")


def _pressure_row(found: TrialPressure) -> Row:
    return {
        **segment_columns(len(found.time), found.segment),
        "threshold [kPa]": found.threshold,
        **pressure_text.summary_row(found),
    }


def pressure_tables(found: TrialPressure) -> str:
    """Tables of the outputs of regions, of tiles under a cluster and of the limb, as text."""
    tables = (text_of(each) + "\n" for each in pressure_text.printed_tables(found))
    return "\n".join([*tables, pressure_text.legend(found)])


@takes(calls.Map)
def map(call: calls.Map) -> None:
    """Estimate the force on every tile with its uncertainty, without a fit."""
    on_trial(call.trial, call, api.force_map, MapOptions, _show_map)


def _show_map(found: api.TrialMap) -> None:
    summary = found.summary()
    highest = summary.head(_MAX_SHOWN)
    print(f"{found.trial.name}: {found.segment}, {len(found.time)} samples, {len(summary)} tiles")
    print(f"{found.estimate.source}\n")
    print(text_of(Table("map", "", highest)))
    print(f"\nmeans over the segment, the {len(highest)} highest; sd: standard deviation")
