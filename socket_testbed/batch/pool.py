"""Work spread over the cores of this machine, or over the workers of a Dask cluster.

By Dask's own client: under joblib's backend for it, a worker that dies or that lacks a package
leaves the caller waiting for ever (joblib 1.6).
"""

from __future__ import annotations

import signal
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

from socket_testbed.errors import ConfigurationError

_PATIENCE = "15s"  # for the scheduler to answer and a worker to be there

_T = TypeVar("_T")
_R = TypeVar("_R")


def spread_on_dask(
    function: Callable[[_T], _R], items: Sequence[_T], address: str
) -> Generator[tuple[int, _R | Exception], None, None]:
    """Apply a function to every item on a cluster: see `socket_testbed.batch.pool.spread`.

    Args:
        function: The function.
        items: The items.
        address: Address of the scheduler, such as `tcp://host:8786`.

    Yields:
        The number of an item and its result as they come, or the error its worker ended with.

    Raises:
        ConfigurationError: If Dask is not installed, or no scheduler with a worker answers.
    """
    with _client(address) as client:
        from distributed import as_completed

        # What is worked on may have changed since an equal call: it is no pure function.
        futures = [client.submit(function, item, pure=False) for item in items]
        numbers = {future.key: number for number, future in enumerate(futures)}
        try:
            for future in as_completed(futures):
                failed = future.status == "error"
                yield numbers[future.key], future.exception() if failed else future.result()
        finally:
            client.cancel(futures)


@contextmanager
def _client(address: str) -> Iterator[Any]:
    try:
        from distributed import Client
    except ImportError:
        raise ConfigurationError(
            "--dask: Dask is not installed", "run 'pip install -r requirements/dask.txt'"
        ) from None
    try:
        client = Client(address, timeout=_PATIENCE)
    except (OSError, ValueError) as error:
        raise _unreachable(address, error) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
        except TimeoutError as error:
            raise _unreachable(address, error) from None
        yield client


def _unreachable(address: str, error: Exception) -> ConfigurationError:
    return ConfigurationError(
        f"--dask {address}: no scheduler with a worker answers ({error})",
        "give the address of a running one, such as tcp://host:8786",
    )


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
