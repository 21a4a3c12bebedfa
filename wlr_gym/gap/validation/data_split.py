"""Which runs are fitted and which are held out for validation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.gap.estimation import Columns, Replayed, linearise, nominal_model
from wlr_gym.gap.problem import Array, Candidate, Problem

#: Share of the runs that is held out.
HELD_OUT_SHARE = 0.3
#: Runs that a fit needs at least.
LEAST_FITTED = 2
#: Integrated autocorrelation time of a channel in rows, assumed before any residual is known.
AUTOCORRELATION_TIME = 10.0
#: An exchange of two runs must be better by more than rounding.
LEAST_BETTER = 1e-6


def named_split(runs: Sequence[str], heldout: Sequence[str]) -> tuple[list[int], list[int]]:
    """Return the indices of the runs to fit and of the named ones to hold out.

    Raises:
        InputError: a name that is no run, or too few left to fit.
    """
    for name in heldout:
        if name not in runs:
            raise unknown_name("run to hold out", name, runs)
    held_out = sorted({runs.index(name) for name in heldout})
    fitted = [k for k in range(len(runs)) if k not in held_out]
    if len(fitted) < LEAST_FITTED:
        raise InputError(f"{len(held_out)} of {len(runs)} runs held out: at least {LEAST_FITTED} must be left to fit")
    return fitted, held_out


def informative_split(problem: Problem) -> tuple[list[int], list[int], list[NDArray[np.float32]] | None]:
    """Hold out 30 % of the runs: so that the rest is informative about the model's numbers, and both sides show each effect.

    An effect that the fitted runs hardly show cannot be found; one that the held-out runs hardly show cannot be validated.
    Judged by the model as its file says, not by what was measured: by the information, as the logarithm of its determinant,
    about the numbers in the runs to fit (D-optimality), and about the size of each effect in the side that tells less of it,
    its response less what the numbers imitate.

    Returns:
        Runs to fit, held-out runs, and the columns (:func:`wlr_gym.gap.estimation.linearise`) of the runs to fit where they
        were needed.

    Raises:
        InputError: too few runs.
    """
    count = len(problem.runs)
    if problem.held_out:
        return (*named_split(problem.runs, problem.held_out), None)
    if count <= LEAST_FITTED:
        raise InputError(f"{count} runs: at least {LEAST_FITTED + 1} are needed, so that one can be held out")
    held_out = min(math.ceil(HELD_OUT_SHARE * count), count - LEAST_FITTED)
    now, columns = linearise(nominal_model(problem), range(count))
    shown = information_of(now, columns)
    kept = list(range(count))
    while len(kept) > count - held_out:
        kept.remove(max(kept, key=lambda k: shown.of_numbers([other for other in kept if other != k])))
    kept = _exchanged(shown, kept, count)
    return kept, [k for k in range(count) if k not in kept], [columns[k] for k in kept]


@dataclass(frozen=True, eq=False)
class Information:
    """What each run tells, in products of responses.

    Attributes:
        numbers: (runs, numbers, numbers) of the model's numbers.
        across: (runs, numbers, effects) of those and the effects.
        effects: (runs, effects) squares of the effects.
        added: effects that add to numbers, in their tolerances: which numbers.
    """

    numbers: Array
    across: Array
    effects: Array
    added: tuple[list[int], ...]

    def of_numbers(self, runs: Sequence[int]) -> float:
        """Information that runs add about the numbers to their tolerances, twice the nats."""
        total = np.eye(self.numbers.shape[1]) + self.numbers[runs].sum(axis=0)
        return float(np.linalg.slogdet(total)[1])

    def of_effects(self, runs: Sequence[int]) -> Array:
        """The same about each effect's size (effects), of which one probe is known beforehand; its own numbers stay."""
        spread = np.linalg.inv(np.eye(self.numbers.shape[1]) + self.numbers[runs].sum(axis=0))
        across = self.across[runs].sum(axis=0)
        own = self.effects[runs].sum(axis=0) - (across * (spread @ across)).sum(axis=0)
        free = [np.linalg.inv(spread[np.ix_(rows, rows)]).sum() - len(rows) for rows in self.added]
        return np.log1p(np.maximum([*own, *free], 0.0))

    def worth(self, kept: Sequence[int], held_out: Sequence[int]) -> float:
        """How good a split is."""
        return self.of_numbers(kept) + float(np.minimum(self.of_effects(kept), self.of_effects(held_out)).sum())


def _exchanged(shown: Information, kept: list[int], count: int) -> list[int]:
    """The runs to fit after exchanging one for a held-out one as long as that makes the split better."""
    best = shown.worth(kept, [k for k in range(count) if k not in kept])
    while True:
        held_out = [k for k in range(count) if k not in kept]
        tries = [sorted({*kept, new} - {old}) for old in kept for new in held_out]
        worths = [shown.worth(one, [k for k in range(count) if k not in one]) for one in tries]
        place = int(np.argmax(worths))
        if worths[place] <= best + LEAST_BETTER:
            return kept
        kept, best = tries[place], worths[place]


def information_of(now: Replayed, columns: Columns) -> Information:
    """Return what each run tells of the numbers, and of each named effect at its largest set of places.

    Args:
        now: the model as its file says, in all runs.
        columns: of its numbers there.
    """
    problem, model, runs = now.problem, now.model, now.runs
    _, candidates = problem.candidates(model.setting, [np.zeros_like(residual) for residual in now.residuals], runs)
    largest: dict[str, Candidate] = {}
    for candidate in sorted(candidates, key=lambda one: -len(one.where)):
        if not candidate.formula:
            largest.setdefault(candidate.name, candidate)
    places = {quantity.name: k for k, quantity in enumerate(problem.quantities)}
    added: dict[str, list[int]] = {}  # which numbers an effect adds to, if its first guess needs nothing else
    for name, candidate in largest.items():
        keys = {key: None for direction in candidate.starts[0].directions for key in direction}
        if keys and keys.keys() <= places.keys():
            added[name] = [places[key] for key in keys]
    more = [candidate for name, candidate in largest.items() if name not in added]
    settings = [model.with_effect(one, one.probed(one.starts[0])).setting for one in more]
    found = problem.residuals(settings, runs) if settings else [np.zeros((0, *residual.shape)) for residual in now.residuals]
    own = [np.nan_to_num(r - base).reshape(len(r), -1) for r, base in zip(found, now.residuals, strict=True)]
    return Information(
        np.stack([column @ column.T for column in columns]).astype(np.float64) / AUTOCORRELATION_TIME,
        np.stack([column @ one.T for column, one in zip(columns, own, strict=True)]) / AUTOCORRELATION_TIME,
        np.stack([(one * one).sum(axis=1) for one in own]) / AUTOCORRELATION_TIME,
        tuple(added.values()),
    )
