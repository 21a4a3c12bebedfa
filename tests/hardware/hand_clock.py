"""A clock that a test moves by hand, and a serial device into which it puts what has come."""


class HandClock:
    """Called it says ``now``, s; sleeping moves it on."""

    def __init__(self, now: float = 0.0) -> None:
        self.now = now

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


class HandDevice:
    """See :class:`wlr_gym.hardware.serial_frames.Device`; ``data`` has come, and the cable may be pulled (``gone``)."""

    def __init__(self) -> None:
        self.data = b""
        self.gone = False

    def received(self) -> bytes:
        if self.gone:
            raise OSError(5, "Input/output error")
        data, self.data = self.data, b""
        return data

    wait = write = None  # type: ignore[assignment]  # sensors only send

    def reset_input_buffer(self) -> None:
        self.data = b""

    def close(self) -> None:
        pass
