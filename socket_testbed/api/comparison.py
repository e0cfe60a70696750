"""Trials side by side: values of every trial, and differences from the first."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from socket_testbed.api.pressure import pressure
from socket_testbed.api.trials import (
    Progress,
    open_different,
    require_one_socket,
    started,
    trials_of,
    unique_names,
)
from socket_testbed.arrays import IntArray
from socket_testbed.documents import mapping_of
from socket_testbed.errors import ConfigurationError, IdentificationError, TrialError, naming
from socket_testbed.identification.differences import Conditions
from socket_testbed.results.comparing import compare_pressures
from socket_testbed.results.comparison import Comparison
from socket_testbed.results.result import PathLike
from socket_testbed.results.survey import Survey
from socket_testbed.settings.options import ComparisonOptions
from socket_testbed.trials.segment import Segment, Span, specification_of
from socket_testbed.trials.trial import Trial

_MAX_ITEMS = 200  # trials or conditions


def compare(
    *items: Trial | PathLike,
    conditions: Mapping[str, Sequence[Trial | PathLike]] | None = None,
    segment: str | Span | Segment = ComparisonOptions.segment,
    threshold: float = ComparisonOptions.threshold,
    by_region: bool = False,
    params: PathLike | None = None,
    prior: Survey | PathLike | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Compare trials: every value side by side, and differences from the first.

    The comparison holds the outputs of `st.pressure` by region and tile with 95 % intervals, the
    mean wrench, and the metadata. All trials must be of one socket, unless `by_region` is set.

    The interval of a difference treats errors of two limbs as independent and those of one subject
    in one socket as correlated, see `identification.differences`; docs/compare.md reports its
    coverage. With several trials per condition, it includes the spread between donnings, which is
    reported along with the smallest detectable difference.

    Args:
        items: Two to 200 trials, or their folders; notes on a trial given as a folder begin with
            its name.
        conditions: Instead of `items`, the trials of two to 200 named conditions, such as the
            repeated donnings of each liner.
        segment: As in `fit`, for every trial.
        threshold: As in `st.pressure`.
        by_region: Whether to compare trials by region alone; their sockets may then differ.
        params: A `testbed.yaml` to use instead of each trial's own.
        prior: A survey of this limb in this socket, such as the file of `survey -o FILE.json`, as a
            prior of the force map; the trial must not be in it.
        progress: See `Progress`.

    Returns:
        The comparison: `to_dataframe()` holds every value, `cells` one part as formatted text,
        `differing()` the clear differences in words.

    Raises:
        ConfigurationError: There are too few or too many trials or conditions, one is given twice,
            the sockets differ, a setting is wrong, or the survey is of another socket or holds a
            trial.
        TrialError: A trial cannot be read or has no such segment.
        IdentificationError: The measured values of a trial have another unit.

    >>> found = st.compare("trials/hold", "trials/walk", segment="15:20")
    >>> found
    Comparison(trials hold, walk; 21 regions, 79 tiles)
    >>> found.cells("regions", "peak pressure").loc["socket", "walk - hold"]
    '... (... to ...)...'
    >>> found.save("comparison.csv")
    >>> st.write_comparison(found, "comparison.html")
    """
    specification = specification_of(segment)
    trials, numbers = open_compared(items, conditions)
    names = unique_names(trials)
    compared = Conditions(tuple(map(str, conditions or names)), numbers)
    if not by_region:
        require_one_socket(trials, "compare them by region with --by-region")
    report = started(progress, "comparing")
    found = []
    for done, (name, trial) in enumerate(zip(names, trials, strict=True), start=1):
        with naming(name, TrialError, IdentificationError):
            found.append(
                pressure(trial, specification, threshold=threshold, params=params, prior=prior)
            )
        report(done, len(trials))
    over = f"segment {specification}, in contact above {threshold:g} kPa"
    return compare_pressures(found, names, compared, over, by_region, one_prior=params is not None)


def open_compared(
    items: Sequence[Trial | PathLike], conditions: Mapping[str, Sequence[Trial | PathLike]] | None
) -> tuple[list[Trial], IntArray]:
    """The trials, all different, and the index of each one's condition.

    Args:
        items: Two to 200 trials, or their folders; empty if there are conditions.
        conditions: Trials by condition, two to 200; None if there are items.

    Returns:
        The k opened trials, condition by condition, and the indices, shape (k,).

    Raises:
        ConfigurationError: Neither or both are given, a condition has no trial, there are too few
            or too many, a trial is given twice, or a path is not that of a trial but of a model or
            socket.
    """
    items = trials_of(items)
    if conditions is not None:
        hint = "give trials by condition, such as {'gel': ['trials/a'], 'sock': ['trials/b']}"
        conditions = {
            str(name): [each] if isinstance(each, Trial | str | os.PathLike) else each
            for name, each in mapping_of(conditions, "conditions", hint).items()
        }
    if conditions and items:
        raise ConfigurationError(
            f"{len(items)} trials and also conditions are given", "give each trial to a condition"
        )
    groups = [*conditions.values()] if conditions else [[item] for item in items]
    if empty := [name for name, given in (conditions or {}).items() if not given]:
        raise ConfigurationError(f"the condition '{empty[0]}' has no trial", "name its trials")
    if not 2 <= len(groups) <= _MAX_ITEMS:
        raise ConfigurationError(
            f"{'conditions' if conditions else 'trials'} to compare: {len(groups)}",
            f"give 2 to {_MAX_ITEMS}, or 'pressure FOLDER -o OUTPUT' for a table with all trials",
        )
    given = [*chain(*groups)]
    for item in given:
        path = item.path if isinstance(item, Trial) else item
        suffix = Path(path).suffix if isinstance(path, str | os.PathLike) else ""
        if suffix.lower() in {".json", ".yaml", ".yml"}:
            raise ConfigurationError(
                f"{path}: compare takes trials", "judge a model by 'evaluate TRIAL --model MODEL'"
            )
    trials = open_different(given)
    return trials, np.repeat(np.arange(len(groups)), [*map(len, groups)])
