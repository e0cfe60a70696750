"""The tare of the load cell, which a file keeps over a restart."""

from __future__ import annotations

import json
import threading
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.documents import read_document
from socket_testbed.errors import ConfigurationError
from socket_testbed.files import whole_output

_LARGEST = 1e3  # [mV/V]; no bridge comes near it


class Tare:
    """The ratios of the bridges that stand for no load.

    Args:
        path: File that keeps them; empty for none. It need not exist yet.

    Raises:
        ConfigurationError: If the file is there but damaged.
    """

    def __init__(self, path: str) -> None:
        self._path = Path(path).expanduser() if path else None
        self._writing = threading.Lock()
        self._offsets: FloatArray = np.zeros(6)
        if self._path is not None and self._path.exists():
            self._offsets = _read(self._path)

    @property
    def offsets(self) -> FloatArray:
        """Ratios at no load, shape (6,) [mV/V]."""
        return self._offsets

    def set(self, offsets: FloatArray) -> None:
        """Take other ratios, shape (6,) [mV/V], and write them to the file.

        Raises:
            ConfigurationError: If the file cannot be written; the tare stays as it was.
        """
        with self._writing:
            if self._path is not None:
                content = {
                    "offsets_mV_per_V": offsets.tolist(),
                    "time": datetime.now(UTC).isoformat(timespec="seconds"),
                }
                with whole_output(self._path) as path:
                    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
            self._offsets = offsets.copy()


def _read(path: Path) -> FloatArray:
    try:
        document = read_document(path).expect(("offsets_mV_per_V", "time"))
        return document.array("offsets_mV_per_V", (6,), limit=_LARGEST)
    except ConfigurationError as error:
        raise ConfigurationError(error.fact, "remove the file and tare again") from None
