"""Which motion to drive next: the one that distinguishes best, per second of driving, what may still be missing.

Every explanation in play is replayed in every motion, and so is the model with each of its numbers moved. What two
explanations predict differently, less what calibrated numbers and their own can take up within their uncertainty, is what a
run of that motion would add to the difference of their minus two log evidence, to first order; levels and autocorrelation
times are those that the last analysis found. The mean over all pairs is weighted by the probabilities of both (Box and Hill,
1967).

An explanation's own numbers are as uncertain as the runs that are there leave them: a law that becomes another one at the
edge of a number (Stribeck friction with a large speed is Coulomb friction) cannot be told from it by any run.
"""

from __future__ import annotations

import itertools
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.excitations import EXCITATIONS, GENTLE, Motion, excite
from wlr_gym.data.format import Profile
from wlr_gym.data.record import motion_of, record_simulation
from wlr_gym.data.runs import Run, read_run
from wlr_gym.gap.estimation.uncertainty import TWO_SIDED_95
from wlr_gym.gap.problem import Setting
from wlr_gym.gap.report.result import NOTHING, AdequacyEntry, Explanation, Result
from wlr_gym.gap.robot.candidates import shown_by
from wlr_gym.gap.robot.problem import RobotProblem
from wlr_gym.physics.effects import EFFECTS, PatchEffect, Source
from wlr_gym.robot import Robot

Array = NDArray[np.float64]

#: Least weight of an explanation in play, however improbable.
LEAST_WEIGHT = 1e-6
#: Expected difference of minus two log evidence that takes even odds to 95 %: a motion that promises less would not tell.
TELLS = 2.0 * math.log(19.0)
#: Change of an explanation's own number for finite differences, a share of the way to where the effect vanishes: large, for
#: friction that sticks and slips answers small ones by chance. Before any run the number is unknown by the whole way.
STEP = 0.2
#: Share of rows in which a run of an excitation has its setpoints.
ALIKE = 0.9


@dataclass(frozen=True)
class Promise:
    """What a run of a motion would tell.

    Attributes:
        motion: its setpoints.
        telling: expected difference of minus two log evidence, mean over the pairs of explanations.
        most: the same of the pair that it distinguishes best. pair: their names.
    """

    motion: Motion
    telling: float
    most: float
    pair: tuple[str, str]

    @property
    def per_second(self) -> float:
        """``telling`` per second of driving."""
        return self.telling / self.motion.duration


def motions_to_drive(robot: Robot, profile: Profile, driven: Sequence[str]) -> list[Motion]:
    """Return the excitations that may be driven with a servo profile; one that was driven already is drawn anew.

    Args:
        robot: whose limits they keep.
        profile: of the runs that are there. A motion made for another one is left out.
        driven: names of the excitations that were driven, once for each time.
    """
    names = [name for name, excitation in EXCITATIONS.items() if excitation.profile in (GENTLE, profile)]
    return [replace(excite(name, list(driven).count(name), robot), profile=profile) for name in names]


def driven_already(runs: Sequence[Run], robot: Robot) -> list[str]:
    """Return the names of the excitations that some runs are of, as ``wlr record`` drives them."""
    commands = [motion_of(run).setpoints for run in runs]
    names = [(name, excite(name, robot=robot).setpoints) for name in EXCITATIONS]
    return [name for own in commands for name, setpoints in names if _alike(own, setpoints)]


def _alike(one: Array, two: Array) -> bool:
    """Whether setpoints are the same in nearly all rows."""
    rows = min(len(one), len(two))
    if rows < ALIKE * max(len(one), len(two)):
        return False
    return bool(np.isclose(one[:rows], two[:rows], equal_nan=True).all(axis=1).mean() >= ALIKE)


def most_shown(motions: Sequence[Motion], driven: Sequence[str]) -> Motion:
    """Return the motion that shows most effects best, of those that were driven least often: before any analysis."""
    shows = list(shown_by().values())
    return min(motions, key=lambda motion: (list(driven).count(motion.name), -shows.count(motion.name)))


def promises(
    result: Result,
    explanations: Sequence[Explanation],
    motions: Sequence[Motion],
    robot: Robot,
    runs: Sequence[Run],
    *,
    known: Source = None,
    backend: str = "gibbs_appell",
    threads: int = 1,
) -> list[Promise]:
    """Return what motions promise, most per second first; the first is the best of all.

    What numbers take up costs most to know, and only lowers a promise: motions that promise less even without it, and would
    tell no more, are left out.

    Args:
        result: of the last analysis: its calibration, and what its model leaves.
        explanations: in play, two or more.
        motions: to choose from.
        robot, runs, known, backend, threads: of the analysis.
    """
    there = RobotProblem(runs, robot, known, backend, threads=threads)
    free = _own_uncertainty(there, result, explanations)
    with tempfile.TemporaryDirectory() as folder:
        bounds = []
        for motion in motions:
            path = record_simulation(Path(folder) / f"run_{motion.name}.parquet", motion, robot, "gibbs_appell")
            problem = RobotProblem([read_run(path)], robot, known, backend, threads=threads)
            bounds.append((_promise(problem, result, explanations, motion), problem))
        found: list[Promise] = []
        for bound, problem in sorted(bounds, key=lambda pair: -pair[0].per_second):
            best = max((one.per_second for one in found), default=-math.inf)
            tells = max((one.most for one in found), default=0.0) >= TELLS
            if bound.per_second > best or (bound.most >= TELLS and not tells):
                found.append(_promise(problem, result, explanations, bound.motion, free))
    return sorted(found, key=lambda one: -one.per_second)


def _promise(
    problem: RobotProblem,
    result: Result,
    explanations: Sequence[Explanation],
    motion: Motion,
    free: Sequence[Array] | None = None,
) -> Promise:
    """What a motion promises; ``free``: see :func:`_own_uncertainty`; None: if no number took up anything, the most it can."""
    values, deviations = _calibrated(problem, result)
    moved = [] if free is None else [values + step for step in np.diag(_inside(problem, values, deviations))]
    bare, *calibrated = _rows(problem, result, [Setting(values), *map(Setting, moved)])
    columns = np.array(calibrated).reshape(-1, len(bare)) - bare
    predicted, slopes = _predicted(problem, result, explanations, with_own=free is not None)
    own = slopes if free is None else [share @ own for share, own in zip(free, slopes, strict=True)]
    weights = np.maximum([one.probability for one in explanations], LEAST_WEIGHT)
    pairs = list(itertools.combinations(range(len(explanations)), 2))
    shares = np.array([weights[i] * weights[j] for i, j in pairs])
    told = np.array([_told(predicted[i] - predicted[j], np.vstack([columns, own[i], own[j]])) for i, j in pairs])
    best = tuple(explanations[k].name for k in pairs[int(np.argmax(told))])
    return Promise(motion, float(shares @ told / shares.sum()), float(told.max()), (best[0], best[1]))


def _told(difference: Array, columns: Array) -> float:
    """Square of a weighted difference (rows), less what numbers of unit variance, whose columns are given, take up."""
    across = columns @ difference
    return max(
        float(difference @ difference - across @ np.linalg.solve(np.eye(len(columns)) + columns @ columns.T, across)), 0.0
    )


def _own_uncertainty(problem: RobotProblem, result: Result, explanations: Sequence[Explanation]) -> list[Array]:
    """How explanations' own numbers may still move, each (numbers, numbers): rows are independent, of unit variance."""
    _, columns = _predicted(problem, result, explanations)
    found = (np.linalg.inv(np.linalg.cholesky(np.eye(len(own)) + own @ own.T)) for own in columns)
    return [np.asarray(one, np.float64) for one in found]


def _predicted(
    problem: RobotProblem, result: Result, explanations: Sequence[Explanation], *, with_own: bool = True
) -> tuple[list[Array], list[Array]]:
    """Weighted predictions (rows) of explanations, and their change per way of their own numbers (see :data:`STEP`), each
    (numbers, rows); none of them unless ``with_own``."""
    values, _ = _calibrated(problem, result)
    models = [(one.effects, *(_own_moved(one) if with_own else ())) for one in explanations]
    rows = _rows(problem, result, [Setting(values, effects) for tried in models for effects in tried])
    parts = np.split(rows, np.cumsum([len(tried) for tried in models])[:-1])
    return [part[0] for part in parts], [(part[1:] - part[0]) / STEP for part in parts]


def _own_moved(one: Explanation) -> list[tuple[PatchEffect, ...]]:
    """The effects of an explanation with each of its own numbers moved by :data:`STEP`."""
    if one.name == NOTHING:
        return []
    *before, own = one.effects
    known = EFFECTS[own.name].parameters if own.name in EFFECTS else {}
    neutral = {name: parameter.neutral for name, parameter in known.items() if isinstance(parameter.neutral, float | int)}
    ways = {name: value - neutral.get(name, 0.0) for name, value in own.parameters.items()}
    moved = [{**own.parameters, name: own.parameters[name] - STEP * way} for name, way in ways.items() if way]
    return [(*before, replace(own, parameters=parameters)) for parameters in moved]


def _rows(problem: RobotProblem, result: Result, settings: Sequence[Setting]) -> Array:
    """Weighted predictions (settings, rows of all runs and channels)."""
    root = np.sqrt(_weights(problem, result))
    runs = problem.residuals(settings, range(len(problem.runs)))
    return np.concatenate([(np.nan_to_num(one) * root).reshape(len(settings), -1) for one in runs], axis=1)


def _calibrated(problem: RobotProblem, result: Result) -> tuple[Array, Array]:
    """Values and standard deviations of the problem's quantities; nominal, to their tolerance, where the result has none."""
    values, deviations = [], []
    for quantity in problem.quantities:
        entry = result.calibration.get(quantity.name)
        values.append(quantity.nominal if entry is None else entry.fitted)
        half = None if entry is None or entry.ci95 is None else 0.5 * (entry.ci95[1] - entry.ci95[0])
        deviations.append(quantity.sigma if half is None else min(half / TWO_SIDED_95, quantity.sigma))
    return np.array(values), np.array(deviations)


def _inside(problem: RobotProblem, values: Array, deviations: Array) -> Array:
    """The deviations as steps to the side where there is room."""
    high = np.array([quantity.high for quantity in problem.quantities])
    return np.where(values + deviations <= high, deviations, -deviations)


def _weights(problem: RobotProblem, result: Result) -> Array:
    """Weight (channels) of a squared residual, as of the fit that left what the result says; 0 where nothing was measured."""
    adequacy = result.adequacy
    if not isinstance(adequacy, AdequacyEntry):
        return np.full(len(problem.signals), 1.0 / problem.tempering)
    scatter = problem.tempering * max(adequacy.constancy.value or 1.0, 1.0)
    levels, times = _by_channel(adequacy.level.channels), _by_channel(adequacy.whiteness.channels)
    worth = {name: 1.0 / (max(level, 1.0) ** 2 * times[name] * scatter) for name, level in levels.items() if name in times}
    return np.array([worth.get(signal.name, 0.0) for signal in problem.signals])


def _by_channel(entries: Mapping[str, object]) -> dict[str, float]:
    found = {name: getattr(entry, "value", None) for name, entry in entries.items()}
    return {name: float(value) for name, value in found.items() if value is not None}
