"""95 % intervals of the fitted numbers: from the curvature of the likelihood, and from leaving out runs (jackknife)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from wlr_gym.gap.analysis import ParameterEstimate
from wlr_gym.gap.estimation.fit import PINNED, Fit, equations_by_run
from wlr_gym.gap.estimation.model import on_bounds, prior_tightness, scaled_nominal, scaled_numbers, scales
from wlr_gym.gap.problem import Candidate, Problem

Array = NDArray[np.float64]

TWO_SIDED_95 = 1.96
#: Least degrees of freedom of a spread. Two runs have one (Student's t is 12.7): the curvature counts as another.
LEAST_DEGREES = 2


def two_sided_95(degrees: int) -> float:
    """Return Student's t: half of a 95 % interval in standard errors known to so many degrees of freedom."""
    return float(stdtrit(degrees, 0.975))


def covariance(problem: Problem, fit: Fit) -> Array:
    """Return the covariance (numbers, numbers) of all numbers, in their units, as wide as 1.96 of its sigmas must be for 95 %.

    From the curvature of the likelihood; where leaving out one run after the other (jackknife, one Newton step each) shows more
    spread, which is what differs from run to run, the number's row and column are widened to that. A spread of a few runs
    is known to a few degrees of freedom only: it is multiplied by Student's t over 1.96; that of two runs is averaged
    with the curvature, which knows from all numbers together how much runs scatter.
    """
    curvature = fit.covariance()
    matrices, vectors = equations_by_run(fit.columns, fit.residuals, fit.noise)
    tight = prior_tightness(problem, fit.model)
    pull = tight * (scaled_numbers(problem, fit.model) - scaled_nominal(problem, fit.model))
    stiff = np.diag(tight + PINNED * on_bounds(problem, fit.model))
    whole, vector, runs = matrices.sum(axis=0), vectors.sum(axis=0), len(vectors)
    shifts = [
        -np.linalg.solve(whole - matrix + stiff, vector - own + pull) for matrix, own in zip(matrices, vectors, strict=True)
    ]
    spread = np.stack(shifts) - np.mean(shifts, axis=0)
    jackknife = (runs - 1) / runs * (spread**2).sum(axis=0)
    wider = jackknife / np.maximum(np.diag(curvature), 1e-300)
    missing = max(LEAST_DEGREES - (runs - 1), 0)
    weighed = np.sqrt((missing + (runs - 1) * wider) / (missing + runs - 1))
    few = two_sided_95(missing + runs - 1) / TWO_SIDED_95
    scale = scales(problem, fit.model) * np.where(wider > 1.0, few * weighed, 1.0)
    return curvature * np.outer(scale, scale)


def half_widths(problem: Problem, fit: Fit) -> Array:
    """Return half of the 95 % interval of every number (numbers), in its unit; see :func:`covariance`.

    A calibrated parameter is never known less than by its prior, to 1.96 tolerances, unless it drifts; on its bound no better.
    """
    halves = TWO_SIDED_95 * np.sqrt(np.diag(covariance(problem, fit)))
    beforehand = TWO_SIDED_95 * scales(problem, fit.model)
    drifts = np.array([quantity.drifts for quantity in problem.quantities])
    held = np.concatenate([~drifts, np.zeros(len(halves) - len(drifts), bool)])
    return np.where(on_bounds(problem, fit.model), beforehand, np.where(held, np.minimum(halves, beforehand), halves))


def estimates(problem: Problem, fit: Fit) -> list[dict[str, ParameterEstimate]]:
    """Return the parameters of each of the model's effects with 95 % intervals.

    Added to the uncertainty of the fit is the disagreement of two simulators of one system (``problem.disagreement``), the same
    share of all unknowns that say how large an effect is. An unknown that adds to calibrated parameters is known no better than
    they are: only the sum is identifiable, up to the small errors of simulated responses, to the variance of their mean.
    """
    spread = covariance(problem, fit)
    found, at = [], len(problem.quantities)
    for candidate, values in fit.model.effects:
        own = slice(at, at + len(values))
        sizes = [(v - u.neutral) * u.is_size for u, v in zip(candidate.unknowns, values, strict=True)]
        away = problem.disagreement * np.array(sizes)
        met = candidate.tolerances or (None,) * len(values)
        summed = [0.0 if one is None or one.replaces else one.size**2 / len(one.quantities) for one in met]
        hidden = np.diag(np.maximum(np.array(summed) - np.diag(spread)[own], 0.0))
        found.append(_with_intervals(candidate, np.array(values), spread[own, own] + np.outer(away, away) + hidden))
        at += len(values)
    return found


def _with_intervals(candidate: Candidate, values: Array, spread: Array) -> dict[str, ParameterEstimate]:
    """Parameters of one effect: their slopes in the fitted values carry the covariance over."""
    here = candidate.parameters(values.tolist())
    errors = np.sqrt(np.maximum(np.diag(spread), 0.0))
    slopes = {name: np.zeros(len(values)) for name in here}
    own = np.eye(len(values))
    for k, error in enumerate(errors):
        step = 0.1 * error + 1e-9
        if candidate.kept((values + step * own[k]).tolist())[k] < values[k] + 0.5 * step:  # at the edge of its range: inwards
            step = -step
        beside = candidate.parameters((values + step * own[k]).tolist())
        for name in here:
            slopes[name][k] = (beside[name] - here[name]) / step
    units = {unknown.name: unknown.unit for unknown in candidate.unknowns}
    units |= {name: spec.unit for name, spec in candidate.vocabulary.items()}
    found = {}
    for name, value in here.items():
        half = TWO_SIDED_95 * float(np.sqrt(max(slopes[name] @ spread @ slopes[name], 0.0)))
        found[name] = ParameterEstimate(value, value - half, value + half, units.get(name, "-"))
    return found
