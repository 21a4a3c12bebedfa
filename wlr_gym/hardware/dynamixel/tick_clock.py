"""A servo's own clock against ours."""

from __future__ import annotations

#: Part by which a servo's clock may run slow.
CLOCK_TOLERANCE = 0.02
#: Age at which a reading is stale, s.
STALE = 0.012
#: Age beyond which a reading is not late, but the servo's clock restarted, s.
LATEST = 1.0
#: Realtime Tick wraps at this many ms.
_TICKS = 32768


class TickClock:
    """Tells how old a reading is from the servo's Realtime Tick (ms, modulo 32768) and our clock.

    The freshest reading seen so far sets the offset between the two clocks; the offset is allowed to drift by
    ``CLOCK_TOLERANCE``, and may be short by what that reading waited for us. A late answer to an earlier request shows as age;
    Protocol 2.0 has nothing else to tell it by. Any other jump is a servo that restarted.
    """

    def __init__(self) -> None:
        self._offset: float | None = None
        self._time = self._waited = 0.0

    def age(self, tick: int, now: float, waited: float = 0.0) -> tuple[float, bool]:
        """Return the age (s) of a reading, and whether the servo's clock was found restarted.

        Args:
            tick: of the reading.
            now: s, when it was received.
            waited: s since it was asked for; an answer may have lain there for so long, where this program was not given time.
        """
        sample = tick - now * 1e3
        if self._offset is None:
            self._offset, self._time, self._waited = sample, now, waited
        ahead = (sample - self._offset + _TICKS / 2) % _TICKS - _TICKS / 2
        drift = CLOCK_TOLERANCE * (now - self._time) * 1e3
        age = max(0.0, -ahead - drift) * 1e-3
        latest = max(LATEST, waited + STALE)
        if STALE < age < latest:
            return age, False
        restarted = age >= latest or ahead > (STALE + self._waited) * 1e3 + drift
        if restarted or ahead > -drift:
            self._waited = waited
        self._offset, self._time = self._offset + (ahead if restarted else max(ahead, -drift)), now
        return (0.0 if restarted else age), restarted
