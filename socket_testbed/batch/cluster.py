"""Work spread over the workers of a Dask cluster.

By Dask's own client: under joblib's backend for it, a worker that dies or that lacks a package
leaves the caller waiting for ever (joblib 1.6).
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from socket_testbed.errors import ConfigurationError

_PATIENCE = "15s"  # for the scheduler to answer and a worker to be there

T = TypeVar("T")
R = TypeVar("R")


def spread_on_dask(
    function: Callable[[T], R], items: Sequence[T], address: str
) -> Generator[tuple[int, R | Exception], None, None]:
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
