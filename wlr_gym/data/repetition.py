"""A run repeated on a robot, compared with the one that was measured first: the same table as for a simulator."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.format import CHANNELS
from wlr_gym.data.noise import channel_noise
from wlr_gym.data.read import Run
from wlr_gym.data.replay import ReplayResult, channel_errors, prepare, segment_starts
from wlr_gym.robot import WHEELS, Robot

Array = NDArray[np.float64]


def compare_repeat(measured: Run, repeated: Run, robot: Robot | str | Path | None = None, segment: float = 1.0) -> ReplayResult:
    """Compare a run with a repetition of it, channel by channel, from the first row of both on.

    A robot cannot be put back to where it was at the start of each segment; what drifts in a log of joints and IMU are the
    wheels' angles, and those count anew from each segment's start. Both runs carry sensor noise, so a perfect repetition
    shows 1.4 noise units. Rows beyond the end of the repetition are not compared.

    Args:
        measured: the run whose setpoints were driven again.
        repeated: what was logged then.
        robot: whose sensors' noise; None = the one the run's meta data name.
        segment: s.

    Raises:
        InputError: as :func:`wlr_gym.data.replay.replay`.
    """
    robot, _ = prepare(measured, robot, segment=segment)
    t = measured["t"]
    starts = segment_starts(t, segment)
    own = repeated["t"] - repeated["t"][0]
    full, pieces = {}, {}
    for name in CHANNELS:
        if name not in measured or name not in repeated:
            continue
        known = np.isfinite(repeated[name])
        if not known.any():
            continue
        full[name] = np.interp(t - t[0], own[known], repeated[name][known], right=np.nan)
        full[name][t - t[0] > own[-1]] = np.nan
        turns = name in {f"pos_{joint}" for joint in WHEELS}
        pieces[name] = _from_each_start(measured[name], full[name], starts) if turns else full[name]
    errors = channel_errors(measured, full, pieces, channel_noise(robot))
    return ReplayResult(measured, full, pieces, tuple(map(int, starts)), errors, robot, float(np.median(np.diff(own))), 0.0)


def _from_each_start(measured: Array, repeated: Array, starts: NDArray[np.intp]) -> Array:
    """Shift each segment of ``repeated`` so that it begins where ``measured`` does."""
    shifted = repeated.copy()
    for begin, end in zip(starts, [*starts[1:], len(measured)], strict=True):
        shifted[begin:end] += measured[begin] - repeated[begin]
    return shifted
