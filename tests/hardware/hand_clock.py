"""A clock that a test moves by hand."""


class HandClock:
    """Called it says ``now``, s; sleeping moves it on."""

    def __init__(self, now: float = 0.0) -> None:
        self.now = now

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
