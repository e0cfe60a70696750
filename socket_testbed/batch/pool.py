"""Work spread over the cores of this machine, or over the workers of a Dask cluster."""

from __future__ import annotations

import signal
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

from socket_testbed.batch.cluster import spread_on_dask

T = TypeVar("T")
R = TypeVar("R")
Results: TypeAlias = Generator[tuple[int, R | Exception], None, None]


@dataclass(frozen=True)
class Pool:
    """Where work is done.

    Attributes:
        jobs: Number of processes on this machine; None for one a core, 1 for this process.
        dask: Address of a Dask scheduler, whose workers do it instead.
    """

    jobs: int | None = None
    dask: str | None = None


def spread(function: Callable[[T], R], items: Sequence[T], pool: Pool) -> Results[R]:
    """Apply a function to every item, in parallel; to be closed if it is left early.

    Args:
        function: The function, which raises nothing; it and its results must be picklable.
        items: The items; picklable, too.
        pool: Where it is done.

    Yields:
        The number of an item and its result as they come, or the error its worker ended with.

    Raises:
        ConfigurationError: If the Dask cluster cannot be reached.
    """
    if pool.dask is not None:
        return spread_on_dask(function, items, pool.dask)
    return _spread_here(function, items, pool.jobs)


def _spread_here(function: Callable[[T], R], items: Sequence[T], wanted: int | None) -> Results[R]:
    from joblib import cpu_count

    backend = {
        "backend": "loky",
        "n_jobs": min(wanted or cpu_count(), len(items)),
        "initializer": _leave_interrupts_to_the_caller,
    }
    pending = dict(enumerate(items))
    try:
        with _applied(function, pending, backend) as results:
            for number, result in results:
                del pending[number]
                yield number, result
    except BrokenProcessPool:
        # One worker that dies, as for want of memory, takes the others' work with it.
        yield from _one_by_one(function, pending, backend)


def _one_by_one(
    function: Callable[[T], R], items: dict[int, T], backend: dict[str, Any]
) -> Results[R]:
    for number, item in items.items():
        try:
            with _applied(function, {number: item}, backend) as results:
                yield from results
        except BrokenProcessPool as error:
            yield number, error


@contextmanager
def _applied(
    function: Callable[[T], R], items: dict[int, T], backend: dict[str, Any]
) -> Iterator[Generator[tuple[int, R], None, None]]:
    from joblib import Parallel, delayed, parallel_config

    with parallel_config(**backend):
        parallel = Parallel(return_as="generator_unordered")
    results = parallel([delayed(_numbered)(function, *entry) for entry in items.items()])
    try:
        yield results
    finally:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # on the work that is given up
            results.close()


def _leave_interrupts_to_the_caller() -> None:
    """In a worker: Ctrl-C reaches the whole group, and the caller ends its workers by itself."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _numbered(function: Callable[[T], R], number: int, item: T) -> tuple[int, R]:
    return number, function(item)
