"""The data quality of a trial as a section of the page."""

from __future__ import annotations

from socket_testbed.report.markup import (
    NOTHING,
    bullets,
    column_groups,
    counted,
    number,
    paragraph,
    section,
    significant,
    table,
)
from socket_testbed.report.quality import count_drop_outs, describe_triggers, measure_steadiness
from socket_testbed.report.results import Results

_MOST_GAPS = 5  # in the list


def quality_section(results: Results, overview: str) -> str:
    """Triggers, plateaus, drop-outs and the autocorrelation of the residuals.

    Args:
        results: The results.
        overview: HTML of the figure of the trial at a glance.
    """
    return section(
        "quality",
        "Data quality",
        [
            overview,
            "<h3>Triggers</h3>",
            *_triggers(results),
            "<h3>The segment, and why</h3>",
            paragraph(_why(results)),
            _plateaus(results),
            "<h3>Drop-outs</h3>",
            paragraph(
                "A saturated reading has no value; one out of the calibrated range has one,"
                " but it is an extrapolation: nothing is fitted to it or judged by it."
            ),
            _drop_outs(results),
            "<h3>Autocorrelation of the residuals</h3>",
            paragraph(
                "Over the segment. The decorrelation time is the time after which a sample counts"
                " as a new one (Sokal's window over the autocorrelation); the effective number is"
                " what the samples are worth."
            ),
            _residuals(results),
        ],
    )


def _triggers(results: Results) -> list[str]:
    triggers = describe_triggers(results.samples)
    rate = 1.0 / triggers.period if triggers.period > 0.0 else float("nan")
    text = (
        f"{triggers.count} samples in {triggers.duration:.2f} s at {significant(rate)} Hz,"
        f" {triggers.complete} with a wrench and a limb position;"
        f" {counted(len(triggers.gaps), 'gap')} longer than one and a half periods"
    )
    gaps = [f"{gap.duration:.3f} s from {gap.start:.2f} s" for gap in triggers.gaps[:_MOST_GAPS]]
    more = len(triggers.gaps) - len(gaps)
    if more:
        gaps.append(f"and {more} shorter ones")
    return [paragraph(text + ("." if not gaps else ", the longest:")), bullets(gaps)]


def _why(results: Results) -> str:
    limits = results.settings.plateau
    criteria = (
        f"A plateau is a stretch of {limits.least_duration:g} s or more without an intended change"
        f" of load (the means over {limits.smoothing:g} s before and after agree within"
        f" {limits.force_change:g} N and {limits.moment_change:g} N m), with a steady mean wrench"
        f" (spread within {limits.force_drift:g} N and {limits.moment_drift:g} N m on every axis),"
        f" at most {100 * limits.missing_fraction:g} % missing channels, and a mean force of"
        f" {limits.least_force:g} N or more."
    )
    found = len(results.plateaus)
    if results.specification == "plateau":
        chosen = results.plateaus[0]
        others = f"the longest of {found}" if found > 1 else "the only one"
        return (
            f"The plateau from {chosen.start:.2f} s to {chosen.end:.2f} s was chosen because it is"
            f" {others}. {criteria}"
        )
    return (
        f"The segment was asked for as '{results.specification}'; the trial has"
        f" {counted(found, 'plateau')}."
        f" {criteria}"
    )


def _plateaus(results: Results) -> str:
    listed = [*results.plateaus]
    if results.segment not in listed:
        listed.insert(0, results.segment)
    rows = []
    for part in listed:
        load = measure_steadiness(results.samples[part.rows])
        rows.append(
            [
                f"{part.start:.2f} to {part.end:.2f}",
                number(part.end - part.start, 2),
                number(load.force, 1),
                number(load.force_sigma, 2),
                number(load.moment, 2),
                number(load.moment_sigma, 3),
                "in use" if part == results.segment else "",
            ]
        )
    header = ["from, to [s]", "duration [s]", "mean force [N]", "its sigma [N]"]
    header += ["mean moment [N m]", "its sigma [N m]", ""]
    return table(header, rows, "plateaus")


def _drop_outs(results: Results) -> str:
    count = len(results.samples)
    rows = [
        [
            lost.name,
            str(lost.missing),
            number(100.0 * lost.missing / count, 2),
            str(lost.missing_in_segment),
            number(lost.longest, 2),
            NOTHING if lost.saturated is None else str(lost.saturated),
            NOTHING if lost.out_of_range is None else str(lost.out_of_range),
        ]
        for lost in count_drop_outs(results.samples, results.segment)
    ]
    header = ["measurement", "missing [1]", "missing [%]", "of them in the segment [1]"]
    header += ["longest [s]", "saturated [1]", "out of range [1]"]
    return table(header, rows, "drop-outs")


def _residuals(results: Results) -> str:
    rows = [
        [
            results.samples.channels[i],
            *(
                cell
                for candidate in results.candidates
                for cell in (
                    number(candidate.residuals[i].lag_one, 2),
                    number(candidate.residuals[i].decorrelation, 2),
                    number(candidate.residuals[i].effective, 0),
                )
            ),
        ]
        for i in range(len(results.samples.channels))
    ]
    header = ["channel"]
    header += ["lag-1 [-]", "decorrelation [s]", "effective [1]"] * len(results.candidates)
    groups = column_groups(1, [(candidate.label, 3) for candidate in results.candidates])
    return table(header, rows, "residuals", groups)
