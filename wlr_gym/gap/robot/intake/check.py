"""What a check of measured runs is: one fault that it looks for, in the channels that may have it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.read import Run
from wlr_gym.gap.analysis import IntakeFinding
from wlr_gym.robot import JOINTS, Robot

Array = NDArray[np.float64]


class Sound(Enum):
    """A channel without the fault."""

    YES = "the run shows that the channel is right"
    UNDECIDED = "the run does not excite the channel enough to tell"


@dataclass(frozen=True)
class ChannelFault:
    """What is wrong with one channel of one run.

    Attributes:
        row: first row that shows it; None = the whole run.
        text: what was seen.
        expected: what would be right.
        remedy: what to do.
    """

    row: int | None
    text: str
    expected: str
    remedy: str


Outcome = ChannelFault | Sound

#: Channels that stand for the run as a whole: clock, setpoints, encoders.
WHOLE = ("t", "cmd", "pos")


@dataclass(frozen=True)
class IntakeCheck:
    """One check.

    Attributes:
        kind: of the findings.
        channels: that are looked at, one by one; of :data:`WHOLE` the run as a whole.
        look: (run, channel, robot) -> fault, or sound. It gets channels that the run has, with finite values.
    """

    kind: str
    channels: tuple[str, ...]
    look: Callable[[Run, str, Robot], Outcome]


def findings_of(runs: Sequence[Run], checks: Sequence[IntakeCheck], robot: Robot) -> list[IntakeFinding]:
    """Return what the checks find, run by run.

    What stands at one place (a joint's encoder, its rate and effort) is not looked at further once a check has found a fault
    there: later checks compare with it, and the first fault counts. Nor is anything else of a run with a fault as a whole. A
    run in which a channel cannot be judged has the fault of the others if no run shows that the channel is right: a unit, a
    sign and a broken wire are the recording's, not the run's.
    """
    outcomes = [_of_one(run, checks, robot) for run in runs]
    found = []
    for run, outcome in zip(runs, outcomes, strict=True):
        told = set[str]()
        for (check, channel), seen in outcome.items():
            fault = _shared(runs, outcomes, check, channel) if seen is Sound.UNDECIDED else seen
            if channel not in told and isinstance(fault, ChannelFault):
                told.add(channel)
                found.append(_finding(run, check.kind, channel, fault))
    return found


def _shared(
    runs: Sequence[Run], outcomes: Sequence[dict[tuple[IntakeCheck, str], Outcome]], check: IntakeCheck, channel: str
) -> ChannelFault | None:
    """The fault that a run which does not show it has like the others; None where one shows that the channel is right."""
    first = _only_faults(runs, outcomes, check, channel)
    if first is None:
        return None
    text = f"the run does not show whether it is right, and it is {check.kind} in {first[0]}"
    return ChannelFault(None, text, first[1].expected, first[1].remedy)


def _of_one(run: Run, checks: Sequence[IntakeCheck], robot: Robot) -> dict[tuple[IntakeCheck, str], Outcome]:
    outcomes: dict[tuple[IntakeCheck, str], Outcome] = {}
    bad: set[str] = set()
    for check in checks:
        for channel in check.channels:
            if place(channel) in bad or bad.intersection(WHOLE) or not _is_measured(run, channel):
                continue
            outcomes[check, channel] = check.look(run, channel, robot)
            if isinstance(outcomes[check, channel], ChannelFault):
                bad.add(place(channel))
    return outcomes


def _only_faults(
    runs: Sequence[Run], outcomes: Sequence[dict[tuple[IntakeCheck, str], Outcome]], check: IntakeCheck, channel: str
) -> tuple[str, ChannelFault] | None:
    """The first run with a fault that a check found, and the fault; None where a run shows that the channel is right."""
    seen = [(run.name, outcome.get((check, channel))) for run, outcome in zip(runs, outcomes, strict=True)]
    if any(one is Sound.YES for _, one in seen):
        return None
    return next(((name, one) for name, one in seen if isinstance(one, ChannelFault)), None)


def _is_measured(run: Run, channel: str) -> bool:
    return channel in WHOLE or (channel in run and bool(np.isfinite(run[channel]).any()))


def _finding(run: Run, kind: str, channel: str, fault: ChannelFault) -> IntakeFinding:
    time = None if fault.row is None else float(run["t"][fault.row] - run["t"][0])
    return IntakeFinding(run.name, channel, kind, fault.text, True, time, fault.expected, fault.remedy)


def place(channel: str) -> str:
    """Return the joint of a channel, or the channel itself."""
    joint = channel.partition("_")[2]
    return joint if joint in JOINTS else channel


def moving(run: Run) -> NDArray[np.bool_]:
    """Return in which rows (rows,) some joint's encoder reads another count than in the row before."""
    steps = np.stack([np.diff(run[f"pos_{joint}"], prepend=run[f"pos_{joint}"][0]) != 0.0 for joint in JOINTS])
    return np.any(steps, axis=0)


def correlation(a: Array, b: Array) -> tuple[float, float, float]:
    """Return the standard deviations of two series (rows,), and their correlation (0 where one is constant)."""
    a, b = a - a.mean(), b - b.mean()
    sizes = float(np.std(a)), float(np.std(b))
    return *sizes, float(a @ b) / (len(a) * sizes[0] * sizes[1]) if min(sizes) > 0.0 else 0.0


def rate_of(run: Run, joint: str) -> Array:
    """Return a joint's rate (rows,), rad/s: the servo's own reading, else the change of its angle."""
    name = f"vel_{joint}"
    if name in run and np.isfinite(run[name]).all():
        return run[name]
    return np.gradient(run[f"pos_{joint}"], run["t"])
