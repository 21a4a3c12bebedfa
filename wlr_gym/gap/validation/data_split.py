"""Which runs are fitted and which are held out for validation."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.gap.estimation.fit import linearise
from wlr_gym.gap.estimation.model import nominal_model
from wlr_gym.gap.problem import Problem

#: Share of the runs that is held out.
HELD_OUT_SHARE = 0.3
#: Runs that a fit needs at least.
LEAST_FITTED = 2
#: Integrated autocorrelation time of a channel in rows, assumed before any residual is known.
AUTOCORRELATION_TIME = 10.0


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
    """Hold out 30 % of the runs: those without which the rest is still most informative about the model's numbers.

    Judged by the model as its file says (D-optimality of the runs that are left), not by what was measured.

    Returns:
        Runs to fit, held-out runs, and the columns (:func:`wlr_gym.gap.estimation.fit.linearise`) of the runs to fit where they
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
    _, columns = linearise(problem, nominal_model(problem), range(count))
    information = [(column @ column.T).astype(np.float64) / AUTOCORRELATION_TIME for column in columns]
    kept = list(range(count))
    while len(kept) > count - held_out:
        kept.remove(max(kept, key=lambda k: _log_information(information, [other for other in kept if other != k])))
    return kept, [k for k in range(count) if k not in kept], [columns[k] for k in kept]


def _log_information(information: Sequence[np.ndarray], kept: Sequence[int]) -> float:
    total = np.eye(len(information[0])) + np.sum([information[k] for k in kept], axis=0)
    return float(np.linalg.slogdet(total)[1])
