"""Commands to a NatNet server, one at a time, repeated until they are answered."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from socket_testbed.drivers.natnet.protocol import (
    UNRECOGNIZED,
    Response,
    encode_command,
    parse_response,
)

ATTEMPTS = 10
INTERVAL = 0.02  # [s]; what the maker's own client does
_DUPLICATES = 0.01  # [s]; how long a second copy of an answer may take
_STRAYS = 0.06  # [s]; how long answers to the repetitions may take


@dataclass(frozen=True)
class Answer:
    """What became of a command.

    Attributes:
        response: The reply; None: none came.
        recognized: Whether the server knows the command.
    """

    response: Response | None
    recognized: bool = True

    @property
    def accepted(self) -> bool:
        """Whether the server did it."""
        return self.response is not None and self.recognized and self.response.accepted

    def fault(self, command: str) -> str:
        """What went wrong, empty for nothing."""
        name = command.partition(",")[0]
        if self.response is None:
            return f"no answer to {name}"
        if not self.recognized:
            return f"the server does not know {name}"
        if not self.response.accepted:
            return f"the server refuses {name} ({self.response.text})"
        return ""


Done = Callable[[Answer], None]


class CommandQueue:
    """Sends commands one after the other; replies carry no mark of what they answer.

    So after an answer, what else comes of its repetitions is awaited before the next command.
    `submit` may be called from any thread, all else from one.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[str, Done]] = deque()
        self._current: tuple[str, Done] | None = None
        self._sent = 0
        self._next = 0.0
        self._strays = 0
        self._quiet = 0.0

    def submit(self, text: str, done: Done) -> None:
        """Have a command sent; `done` is called with what became of it."""
        self._waiting.append((text, done))

    def step(self, now: float, send: Callable[[bytes], None]) -> None:
        """Send what is due at a time of the steady clock [s]."""
        if self._current is None:
            if now < self._quiet or not self._waiting:
                return
            self._current, self._sent, self._strays = self._waiting.popleft(), 0, 0
            self._next = now
        if now < self._next:
            return
        if self._sent == ATTEMPTS:
            self._finish(Answer(None), now)
            return
        self._sent += 1
        self._next = now + INTERVAL
        send(encode_command(self._current[0]))

    def answer(self, message: int, payload: bytes, now: float) -> None:
        """Take a reply."""
        if self._current is not None and self._sent:
            self._sent -= 1
            self._finish(Answer(parse_response(payload), message != UNRECOGNIZED), now)
        elif self._strays:
            self._strays -= 1
            if not self._strays:
                self._quiet = now + _DUPLICATES

    def _finish(self, answer: Answer, now: float) -> None:
        assert self._current is not None
        _, done = self._current
        self._current = None
        self._strays = self._sent
        self._quiet = now + (_STRAYS if self._strays else _DUPLICATES)
        done(answer)
