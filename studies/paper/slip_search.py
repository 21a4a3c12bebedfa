"""What could make the robot slip as the paper reports? A search with the effect library on the Gibbs-Appell engine.

A rigid robot on Coulomb friction makes both tests with no slip and no drift. The paper reports 11.5 % and 1.1 cm in the first
test, 5 % and 5.2 cm in the second. Candidates are tried alone and in pairs, by random draws that close in on the paper's four
numbers. What is reported are the ranges of all draws that give all four at once: not the best one, and not a cause.

Each :class:`SlipCandidate` is named effects, each number of them drawn from a range. How the paper's numbers are meant is open
in two ways, so every result is given for each :class:`PaperReading`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.paper.experiments import TESTS, PaperTest, drive, no_slip_travel, select
from wlr_gym.base.random import generator
from wlr_gym.physics.effects import EFFECTS, apply_patch, load_patch
from wlr_gym.robot import LEGS, Robot
from wlr_gym.robot.parameters import Parameters
from wlr_gym.robot.slip import no_slip_error

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PaperReading:
    """What the paper may mean by its errors.

    Attributes:
        name, doc: key, sentence.
        encoder_on_leg: the no-slip prediction counts the wheel angle relative to the leg, as the servo reads it (True), or
            takes it for the absolute angle, as (3) is printed (False).
        sign: +1 the robot falls short of the prediction in both tests, 0 the error is unsigned.
    """

    name: str
    doc: str
    encoder_on_leg: bool
    sign: int


READINGS = (
    PaperReading("short, encoder", "falls short of a prediction that knows the wheel angle is relative to the leg", True, 1),
    PaperReading("short, printed", "falls short of the prediction of (3) as printed", False, 1),
    PaperReading(
        "unsigned, encoder", "differs either way from a prediction that knows the wheel angle is relative to the leg", True, 0
    ),
    PaperReading("unsigned, printed", "differs either way from the prediction of (3) as printed", False, 0),
)


@dataclass(frozen=True)
class Dial:
    """One number of one effect, drawn from [low, high]; ``where`` are its places, of the effect library."""

    effect: str
    where: tuple[str, ...]
    parameter: str
    low: float
    high: float

    @property
    def label(self) -> str:
        """``coulomb_friction[wheel_lr].torque``."""
        return f"{self.effect}[{', '.join(self.where)}].{self.parameter}"

    @property
    def unit(self) -> str:
        """SI unit."""
        return EFFECTS[self.effect].parameters[self.parameter].unit

    def entry(self, value: float) -> dict[str, Any]:
        """Return the effect as a patch holds it."""
        return {"name": self.effect, "where": list(self.where), "parameters": {self.parameter: float(value)}}


@dataclass(frozen=True)
class SlipCandidate:
    """A plausible departure from the nominal robot: what it is, and its dials."""

    name: str
    doc: str
    dials: tuple[Dial, ...]


def _candidate(name: str, doc: str, *ranges: tuple[str, str, Sequence[str], float, float]) -> SlipCandidate:
    """A candidate of ranges: effect, parameter, places with a number each, low, high."""
    dials = (Dial(effect, (place,), number, low, high) for effect, number, places, low, high in ranges for place in places)
    return SlipCandidate(name, doc, tuple(dials))


_FRONT = ("wheel_lf", "wheel_rf")
_REAR = ("wheel_lr", "wheel_rr")
_ALL = (*_FRONT, *_REAR)
_BODY = ("body",)
CANDIDATES: tuple[SlipCandidate, ...] = (
    _candidate("rear drag", "gears of the free rear wheels, each its own", ("coulomb_friction", "torque", _REAR, 0.0, 0.2)),
    _candidate("radius", "tyres of the front wheels, each its own", ("wheel_radius_error", "scale", _FRONT, 0.9, 1.1)),
    _candidate("creep", "tyres that creep under load, each its own", ("tyre_creep", "creep_speed", _ALL, 0.0, 0.1)),
    _candidate("grip", "wheels on unequal floor or tread", ("friction_asymmetry", "mu", _ALL, 0.1, 1.0)),
    _candidate("rolling", "rolling resistance, each wheel its own", ("rolling_resistance", "coefficient", _ALL, 0.0, 0.15)),
    _candidate("zeros", "zeros of the leg encoders", ("joint_zero_offset", "angle", LEGS, -0.1, 0.1)),
    _candidate(
        "load", "centre of mass, and the power source that the paper's 3 kg leave out",
        ("com_offset", "x", _BODY, -0.05, 0.05), ("com_offset", "y", _BODY, -0.05, 0.05), ("payload", "mass", _BODY, 0.0, 1.0),
    ),
    _candidate(
        "pull", "slope of the floor and pull of cables",
        ("external_force", "fx", _BODY, -3.0, 3.0), ("external_force", "fy", _BODY, -3.0, 3.0),
        ("floor_slope", "pitch", ("ground",), -0.03, 0.03), ("floor_slope", "roll", ("ground",), -0.03, 0.03),
    ),
    _candidate(
        "servo", "delay, play and torque of the front wheels' servos",
        ("command_delay", "delay", _FRONT, 0.0, 0.06), ("backlash", "angle", _FRONT, 0.0, 0.1),
        ("weak_motor", "scale", _FRONT, 0.3, 1.0),
    ),
    _candidate(
        "camera", "camera's frame turned against the start heading, and scaled",
        ("camera_misalignment", "yaw", ("sensor",), -0.1, 0.1), ("camera_misalignment", "scale", ("sensor",), 0.9, 1.1),
    ),
)  # fmt: skip
#: The paper gives no coefficient of the floor; every draw has one of its own.
FLOOR_DIAL = Dial("friction_level", ("ground",), "mu", 0.3, 0.9)


def scaled(dials: Sequence[Dial], unit: Array) -> Array:
    """Return values of dials (N, dials) for numbers from 0 (low) to 1 (high)."""
    low, high = (np.array([getattr(dial, end) for dial in dials]) for end in ("low", "high"))
    return low + unit * (high - low)


def make_parameters(robot: Robot, dials: Sequence[Dial], values: Array) -> Parameters:
    """Return robots (N) with the dials (N, dials) set, by the effect library."""
    nominal = Parameters.nominal(robot)
    rows = [
        apply_patch(load_patch([dial.entry(value) for dial, value in zip(dials, row, strict=True)]), nominal).values
        for row in values
    ]
    return Parameters(np.concatenate(rows))


# ---- what the paper would have measured ------------------------------------------------------------------------------


#: A match is this near the paper's error of ignoring slip (share) and lateral displacement. [chosen: the paper gives one run
#: each, and no repeatability.]
ERROR_TOLERANCE = 0.015
#: m.
LATERAL_TOLERANCE = 0.005
#: s, and precision: of the search, four times as fast. What comes near a match is driven again with 1 ms in float64.
_FAST = (0.002, "float32")
_EXACT = (0.001, "float64")


@dataclass(frozen=True, eq=False)
class Outcomes:
    """What the paper would have measured on N robots: both tests side by side (N, 2).

    Attributes:
        error_encoder, error_printed: of ignoring slip, positive = falls short. lateral: m. yaw: at the end, rad.
        rear_turns: encoder turns of the rear wheels, mean of both. front_effort: mean motor torque of a front wheel, N m.
    """

    error_encoder: Array
    error_printed: Array
    lateral: Array
    yaw: Array
    rear_turns: Array
    front_effort: Array

    def miss(self, reading: PaperReading) -> Array:
        """Return the worst of the four departures from the paper's numbers (N,), in tolerances; 1 or less is a match."""
        error = self.error_encoder if reading.encoder_on_leg else self.error_printed
        error = np.abs(error) if reading.sign == 0 else error
        targets, sideways = (np.array([getattr(test, name) for test in TESTS.values()]) for name in ("error", "lateral"))
        misses = [np.abs(error - targets) / ERROR_TOLERANCE, np.abs(np.abs(self.lateral) - sideways) / LATERAL_TOLERANCE]
        return np.nan_to_num(np.concatenate(misses, axis=1).max(axis=1), nan=np.inf)

    def take(self, rows: NDArray[np.intp]) -> Outcomes:
        """Return some of the robots."""
        return Outcomes(**{name: value[rows] for name, value in vars(self).items()})


def outcomes(robot: Robot, parameters: Parameters, threads: int = 2, exact: bool = True) -> Outcomes:
    """Drive both tests on N robots and return what the paper reports of them; not ``exact`` = four times as fast."""
    columns = [measure(robot, parameters, test, threads, exact) for test in TESTS.values()]
    return Outcomes(**{name: np.stack([column[name] for column in columns], axis=1) for name in columns[0]})


def measure(robot: Robot, parameters: Parameters, test: PaperTest, threads: int = 2, exact: bool = True) -> dict[str, Array]:
    """Drive one test on N robots; return the fields of :class:`Outcomes`, each (N,).

    One robot more goes with every batch, with every dial of every candidate a tenth on its way: all batches then need the same
    compiled kernel.
    """
    step, precision = _EXACT if exact else _FAST
    dials = [dial for candidate in CANDIDATES for dial in candidate.dials]
    everything = make_parameters(robot, dials, scaled(dials, np.full((1, len(dials)), 0.1)))
    batch = Parameters(np.concatenate([parameters.values, everything.values]))
    record = drive("gibbs_appell", test, robot, batch, step, every=50, threads=threads, precision=precision)
    record = select(record, np.arange(len(parameters)))
    x, y = record.end.T
    yaw, scale = parameters["camera.mount_yaw"], parameters["camera.scale"]
    seen = scale * (np.cos(yaw) * x + np.sin(yaw) * y)
    return {
        "error_encoder": no_slip_error(seen, no_slip_travel(robot, record, True)[-1]),
        "error_printed": no_slip_error(seen, no_slip_travel(robot, record, False)[-1]),
        "lateral": scale * (np.cos(yaw) * y - np.sin(yaw) * x),
        "yaw": record.attitude[-1, :, 0],
        "rear_turns": record.joint_position[-1, :, 6:].mean(axis=1) / (2 * np.pi),
        "front_effort": record.torque[record.time > 0.0][:, :, 4:6].mean(axis=(0, 2)),
    }


# ---- the search ------------------------------------------------------------------------------------------------------


#: Share of draws that are made anew in every round; the rest are made near the best so far, closer each round.
_FRESH = 0.15
#: Best draws of each reading that new ones are made near.
_ELITE = 8
#: Combinations that are drawn again for each reading, and rounds of it.
BEAM = 4
ROUNDS = 3
#: In tolerances: what comes near a match.
_NEAR = 1.5


@dataclass(frozen=True, eq=False)
class SearchFinding:
    """One candidate, or a pair of them.

    Attributes:
        names: of the candidates. dials: their numbers, the floor's mu last. values: (N, dials) all draws.
        outcomes: of all draws.
    """

    names: tuple[str, ...]
    dials: tuple[Dial, ...]
    values: Array
    outcomes: Outcomes

    @property
    def label(self) -> str:
        """``rear drag + radius``."""
        return " + ".join(self.names)

    def matches(self, reading: PaperReading) -> NDArray[np.intp]:
        """Return the draws that give all four numbers."""
        return np.flatnonzero(self.outcomes.miss(reading) <= 1.0)

    def closest(self, reading: PaperReading) -> float:
        """Return the smallest miss, in tolerances."""
        return float(self.outcomes.miss(reading).min())

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types: per reading how close, how many matches, and the range of every dial among them."""
        found: dict[str, Any] = {"candidates": list(self.names), "draws": len(self.values), "readings": {}}
        for reading in READINGS:
            rows = self.matches(reading)
            entry: dict[str, Any] = {"closest": self.closest(reading), "matches": len(rows)}
            if len(rows):
                low, high = self.values[rows].min(axis=0), self.values[rows].max(axis=0)
                entry["ranges"] = {
                    dial.label: {"low": float(a), "high": float(b), "unit": dial.unit}
                    for dial, a, b in zip(self.dials, low, high, strict=True)
                }
            found["readings"][reading.name] = entry
        return found


def search(
    robot: Robot,
    draws: int = 16,
    levels: int = 3,
    seed: int = 0,
    candidates: Sequence[SlipCandidate] = CANDIDATES,
    threads: int = 2,
    tell: Callable[[float], None] = lambda share: None,
) -> list[SearchFinding]:
    """Try every candidate alone, every pair, then the pairs that came closest together with every third.

    Each level starts with ``draws`` draws for each of its combinations; the :data:`BEAM` that come closest to each reading are
    drawn again in :data:`ROUNDS` rounds of four times as many, near the best so far and nearer each round. At last all that
    have a match are drawn again, sixteen times as many near their best: how far do the matches reach?

    Args:
        robot: the nominal one.
        draws: per combination at first.
        levels: most candidates at once, 1 to 3.
        seed: another seed, other draws.
        candidates: what to try.
        threads: of the engine.
        tell: told the share of the batches that are driven.

    Returns:
        One finding per combination; no choice is made among them.
    """
    findings: list[SearchFinding] = []
    matched: list[_Trial] = []
    driven, batches = itertools.count(1), levels * (ROUNDS + 2) + 1
    for level in range(1, levels + 1):
        if level < 3:
            combos = list(itertools.combinations(candidates, level))
        else:
            combos = _extended(_survivors([found for found in findings if len(found.names) == 2]), candidates)
        trials = [_Trial(combo, generator(seed, "paper", *(c.name for c in combo)), draws) for combo in combos]
        _drive_all(robot, trials, threads)
        tell(next(driven) / batches)
        for turn in range(ROUNDS):
            near = {found.names for found in _survivors([trial.finding() for trial in trials])}
            chosen = [trial for trial in trials if trial.names in near]
            for trial in chosen:
                trial.close_in(4 * draws, 0.2 / 2.0**turn)
            _drive_all(robot, chosen, threads)
            tell(next(driven) / batches)
        _drive_again(robot, trials, threads)
        tell(next(driven) / batches)
        found = [trial.finding() for trial in trials]
        matched += [trial for trial, one in zip(trials, found, strict=True) if any(len(one.matches(r)) for r in READINGS)]
        findings += found
    for width in (0.15, 0.05) if matched else ():  # how far do the matches reach?
        for trial in matched:
            trial.close_in(8 * draws, width)
        _drive_all(robot, matched, threads)
        _drive_again(robot, matched, threads)
    spread = {trial.names: trial.finding() for trial in matched}
    return [spread.get(found.names, found) for found in findings]


def _survivors(findings: Sequence[SearchFinding]) -> list[SearchFinding]:
    """The findings that come closest to each reading, each once."""
    near = {}
    for reading in READINGS:
        for found in sorted(findings, key=lambda found: found.closest(reading))[:BEAM]:
            near[found.names] = found
    return list(near.values())


def _extended(findings: Sequence[SearchFinding], candidates: Sequence[SlipCandidate]) -> list[tuple[SlipCandidate, ...]]:
    """Every finding with each candidate that it lacks, in the candidates' own order."""
    names = {
        frozenset({*found.names, other.name}) for found in findings for other in candidates if other.name not in found.names
    }
    combos = [tuple(candidate for candidate in candidates if candidate.name in chosen) for chosen in names]
    return sorted(combos, key=lambda combo: [candidate.name for candidate in combo])


class _Trial:
    """A combination while it is searched: its draws in the unit cube, and what came of them."""

    def __init__(self, combo: Sequence[SlipCandidate], stream: np.random.Generator, draws: int) -> None:
        self.names = tuple(candidate.name for candidate in combo)
        self.dials = (*(dial for candidate in combo for dial in candidate.dials), FLOOR_DIAL)
        self.stream, self.seen = stream, np.zeros((0, len(self.dials)))
        self.known = Outcomes(*np.zeros((6, 0, len(TESTS))))
        self.waiting: Array = stream.uniform(size=(draws, len(self.dials)))

    def close_in(self, draws: int, width: float) -> None:
        """Draw near the best of every reading so far, ``width`` away in the unit cube; a few anywhere."""
        size = (draws, len(self.dials))
        best = np.concatenate([np.argsort(self.known.miss(reading), kind="stable")[:_ELITE] for reading in READINGS])
        near = np.abs(self.seen[self.stream.choice(best, draws)] + width * self.stream.normal(size=size))
        near = 1.0 - np.abs(1.0 - near)  # reflected at both ends
        anew = self.stream.uniform(size=draws) < _FRESH
        self.waiting = np.clip(np.where(anew[:, None], self.stream.uniform(size=size), near), 0.0, 1.0)

    def take(self, outcomes: Outcomes) -> None:
        """Take the outcomes of the waiting draws."""
        self.seen = np.concatenate([self.seen, self.waiting])
        self.known = Outcomes(
            **{name: np.concatenate([old, getattr(outcomes, name)]) for name, old in vars(self.known).items()}
        )

    def finding(self) -> SearchFinding:
        """Return all there is so far."""
        return SearchFinding(self.names, self.dials, scaled(self.dials, self.seen), self.known)


def _drive_all(robot: Robot, trials: Sequence[_Trial], threads: int) -> None:
    """Drive the waiting draws of all trials in one batch."""
    rows = [make_parameters(robot, trial.dials, scaled(trial.dials, trial.waiting)).values for trial in trials]
    every = outcomes(robot, Parameters(np.concatenate(rows)), threads, exact=False)
    ends = np.cumsum([len(trial.waiting) for trial in trials])
    for trial, end in zip(trials, ends, strict=True):
        trial.take(every.take(np.arange(end - len(trial.waiting), end)))


def _drive_again(robot: Robot, trials: Sequence[_Trial], threads: int) -> None:
    """Put the exact outcomes in the place of the fast ones where these come near a match."""
    near = [np.flatnonzero(np.min([one.known.miss(reading) for reading in READINGS], axis=0) < _NEAR) for one in trials]
    again = [(trial, rows) for trial, rows in zip(trials, near, strict=True) if len(rows)]
    if not again:
        return
    robots = [make_parameters(robot, one.dials, scaled(one.dials, one.seen[rows])).values for one, rows in again]
    exact, start = outcomes(robot, Parameters(np.concatenate(robots)), threads), 0
    for trial, rows in again:
        for name, values in vars(trial.known).items():
            values[rows] = getattr(exact, name)[start : start + len(rows)]
        start += len(rows)


# ---- what would decide -----------------------------------------------------------------------------------------------

_DOWN = (np.pi / 2, np.pi / 2)
#: Legs straight down, same wheels: a third drive that any of the candidates could be told by.
CONTROL = PaperTest("control", "control: legs straight down", _DOWN, _DOWN)

#: What else could have been measured: name -> meaning and unit.
OBSERVABLES: Mapping[str, tuple[str, str]] = {
    "control_error": ("error of ignoring slip with all legs straight down, same wheels", "%"),
    "control_lateral": ("lateral displacement in that drive, absolute", "cm"),
    "rear_turns_1": ("encoder turns of the rear wheels in the first test", "turns"),
    "rear_turns_2": ("encoder turns of the rear wheels in the second test", "turns"),
    "front_effort_1": ("mean effort of a front wheel in the first test", "N m"),
    "front_effort_2": ("mean effort of a front wheel in the second test", "N m"),
    "yaw_2": ("heading at the end of the second test, absolute", "deg"),
}


def observables(
    robot: Robot, findings: Sequence[SearchFinding], reading: PaperReading, most: int = 32, threads: int = 2
) -> list[dict[str, Array]]:
    """Return what the matching robots of each finding would have shown elsewhere: :data:`OBSERVABLES`, each (matches,).

    Args:
        robot: nominal. findings: with matches. reading: whose matches.
        most: of the matches of one finding are driven again for the control drive, the first ones.
        threads: of the engine.
    """
    chosen = [finding.matches(reading)[:most] for finding in findings]
    if not chosen:
        return []
    batch = [make_parameters(robot, one.dials, one.values[rows]).values for one, rows in zip(findings, chosen, strict=True)]
    control = measure(robot, Parameters(np.concatenate(batch)), CONTROL, threads)
    shown, end = [], 0
    for finding, rows in zip(findings, chosen, strict=True):
        start, end = end, end + len(rows)
        own = finding.outcomes.take(rows)
        shown.append(
            {
                "control_error": 100 * control["error_encoder"][start:end],
                "control_lateral": 100 * np.abs(control["lateral"][start:end]),
                "rear_turns_1": own.rear_turns[:, 0],
                "rear_turns_2": own.rear_turns[:, 1],
                "front_effort_1": own.front_effort[:, 0],
                "front_effort_2": own.front_effort[:, 1],
                "yaw_2": np.degrees(np.abs(own.yaw[:, 1])),
            }
        )
    return shown


def matching(findings: Sequence[SearchFinding], reading: PaperReading) -> list[SearchFinding]:
    """Return the findings with a match, most matches first."""
    ordered = sorted(findings, key=lambda finding: -len(finding.matches(reading)))
    return [finding for finding in ordered if len(finding.matches(reading))]
