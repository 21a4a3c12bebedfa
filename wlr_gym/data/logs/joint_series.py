"""What a log leaves open about joints: where a table says that a motor is off, and angles that start anew after a turn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.logs.tables import TABLE
from wlr_gym.data.logs.takes import hole
from wlr_gym.data.logs.topics import Topic
from wlr_gym.robot import WHEELS

Array = NDArray[np.float64]
Times = NDArray[np.int64]

#: rad; an angle that stays within a turn, or little more, and jumps by so much between two samples starts anew after a turn.
_TURN, _JUMP = 2.2 * np.pi, 1.5 * np.pi


def with_torque_off(topic: Topic, setpoint: str, angle: str) -> Topic:
    """Return a table whose rows with a joint's angle and an empty setpoint have NaN as setpoint: torque off.

    Not where most setpoints stand in rows of their own, or alone between empty cells: those have another rate, and hold.
    """
    if topic.kind != TABLE or not {setpoint, angle} <= set(topic.fields):
        return topic
    (rows, values), measured = topic.fields[setpoint], topic.fields[angle][0]
    off = np.setdiff1d(measured, rows)
    place = np.searchsorted(measured, rows[np.isin(rows, measured)])
    if len(rows) and (len(place) < max(2, len(rows) / 2) or np.median(np.diff(place)) > 1.0):
        return topic
    rows, values = np.concatenate([rows, off]), np.concatenate([values, np.full(len(off), np.nan)])
    order = np.argsort(rows)
    return replace(topic, fields={**topic.fields, setpoint: (rows[order], values[order])})


def without_wraps(series: Mapping[str, tuple[Times, Array]], joint: str) -> tuple[Array, str]:
    """Return a joint's angles, jumps undone where they start anew after a turn or half of one; and what is to be said of it.

    Args:
        series: channel -> times (ns) and values, SI units.
        joint: name.
    """
    at, values = series[f"pos_{joint}"]
    steps, gaps = np.abs(np.diff(values)), np.diff(at)
    if np.ptp(values) >= _TURN or not (steps > np.pi).any():
        return values, ""
    if not ((steps > _JUMP) & (gaps <= hole(at))).any():
        return values, f"'pos_{joint}': {(steps > np.pi).sum()} jumps of more than half a turn are left in"
    rate = max(_fastest(series, f"{kind}_{joint}") for kind in ("cmd", "vel")) if joint in WHEELS else 0.0
    unsure = gaps[rate * gaps * 1e-9 > np.pi]
    if not len(unsure):
        return np.unwrap(values), ""
    where = f"between {len(unsure)} pairs of samples, up to {unsure.max() * 1e-9:.2g} s apart"
    return np.unwrap(values), f"'pos_{joint}': turns are a guess {where}: at {rate:.3g} rad/s that may be more than half a turn"


def _fastest(series: Mapping[str, tuple[Times, Array]], channel: str) -> float:
    """Return the highest rate of a channel, rad/s; 0 where it is not known."""
    rates = np.abs(series[channel][1]) if channel in series else np.zeros(0)
    return float(rates[np.isfinite(rates)].max(initial=0.0))
