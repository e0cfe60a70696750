"""A clock for tests that never wait."""


class FakeClock:
    """A steady clock [s] that only sleeping moves on, and looking at it if that takes time."""

    def __init__(self, now: float = 100.0, look: float = 0.0) -> None:
        self.now = now
        self._look = look

    def __call__(self) -> float:
        self.now += self._look
        return self.now

    def sleep(self, duration: float) -> None:
        assert duration >= 0.0
        self.now += duration
