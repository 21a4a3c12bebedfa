"""When a frame was exposed, on this computer's clock: from the driver's time stamp, or from its arrival."""

from __future__ import annotations

import math
from collections import deque

#: s within which a driver's stamp and the arrival are taken to be of one clock (Linux drivers stamp by the monotonic one).
SAME_CLOCK = 0.5
#: Frames over which the offset of another clock is the least (arrival - stamp).
WINDOW = 300


class StampClock:
    """Tell capture times from time stamps and arrivals.

    A driver that stamps by this computer's monotonic clock is believed. One with a clock of its own is related to it by the
    least of (arrival - stamp) over the last frames: what is on top of it is delay on the way, and the least delay cannot be
    told from the offset (``delay`` of the camera's file is for that). Without stamps (0, or none that move) arrivals count.

    Args:
        delay: s from mid-exposure to the stamp or, at the least, to the arrival.

    Attributes:
        source: ``driver``, ``driver's own clock`` or ``arrival``, as the last frame was dated.
        offset: s, this computer's clock minus the stamps'; 0 where they are of one clock.
    """

    def __init__(self, delay: float) -> None:
        self.delay, self.source, self.offset = delay, "arrival", 0.0
        self._lags: deque[float] = deque(maxlen=WINDOW)
        self._last = math.nan

    def time(self, stamp: float, arrival: float) -> float:
        """Return when a frame was exposed (s) that the driver dates ``stamp`` and that came at ``arrival``."""
        moves = stamp != self._last and stamp > 0.0 and math.isfinite(stamp)
        self._last = stamp
        if not moves:
            self.source = "arrival"
            return arrival - self.delay
        if -0.001 <= arrival - stamp < SAME_CLOCK:
            self.source, self.offset = "driver", 0.0
            self._lags.clear()
            return stamp - self.delay
        self._lags.append(arrival - stamp)
        self.source, self.offset = "driver's own clock", min(self._lags)
        return stamp + self.offset - self.delay
