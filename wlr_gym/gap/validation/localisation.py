"""Where the gap is: which channels, in which states of the robot, and traces of held-out runs that show it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from wlr_gym.gap.analysis import HeatMap, Place, Trace
from wlr_gym.gap.estimation import FittedModel, Noise, Replayed
from wlr_gym.gap.problem import Array, Problem

#: Bins of a feature, by its quantiles.
BINS = 5
#: Maps drawn.
MAPS = 4
#: Channels named, at most.
MOST_PLACES = 8
#: Share of the gap from which on a channel is named.
LEAST_SHARE = 0.02
#: Variance of the squared residual that a feature must explain before the text mentions it.
LEAST_DEPENDENCE = 0.05


def localise(
    calibrated: Replayed, expected: Array, noise: Noise, features: Sequence[Mapping[str, Array]]
) -> tuple[tuple[Place, ...], tuple[HeatMap, ...]]:
    """Return the channels that hold the gap, strongest first, and heat maps of the states it depends on.

    Args:
        calibrated: the model without effects.
        expected: (signals) mean squares that a complete model has: of the final model, or 1; NaN where nothing was measured.
        noise: of the final model's residuals.
        features: what residuals may depend on, (rows,) per run.
    """
    problem, rows = calibrated.problem, np.concatenate(calibrated.residuals)
    capped = [np.nansum(np.minimum(r * r, problem.cap**2), axis=0) for r in calibrated.residuals]
    squares = np.sum(capped, axis=0) / np.maximum(noise.rows, 1)
    floor = np.where(np.isfinite(expected), np.maximum(expected, 1.0), 1.0)
    excess = np.maximum(squares / floor - 1.0, 0.0) * noise.rows / noise.autocorrelation_time
    total = float(excess.sum())
    if total <= 0.0:
        return (), ()
    order = [int(c) for c in np.argsort(-excess) if excess[c] > LEAST_SHARE * total][:MOST_PLACES]
    pooled = {name: np.concatenate([f[name] for f in features]) for name in (features[0] if features else {})}
    places, chosen = [], []
    for c in order:
        text, feature = _dependence(np.clip(rows[:, c], -problem.cap, problem.cap), pooled)
        places.append(Place(problem.signals[c].name, float(excess[c] / total), text))
        chosen += [feature] if feature and feature not in chosen else []
    maps = tuple(_heat_map(problem, rows, order, name, pooled[name]) for name in chosen[:MAPS])
    return tuple(places), maps


def _dependence(residual: Array, features: Mapping[str, Array]) -> tuple[str, str]:
    """In which states a channel's residual is large: the feature whose bins explain most of its square."""
    seen = np.isfinite(residual)
    square = residual[seen] ** 2
    best, best_share, text = "", LEAST_DEPENDENCE, "no clear dependence on the state"
    for name, values in features.items():
        edges = _edges(values[seen])
        if not edges.size:
            continue
        bins, labels = np.searchsorted(edges, values[seen], side="right"), _labels(edges)
        means = np.array([square[bins == b].mean() if (bins == b).any() else np.nan for b in range(len(edges) + 1)])
        share = float(np.var(means[bins]) / max(np.var(square), 1e-12))
        if share > best_share:
            best, best_share, top, low = name, share, int(np.nanargmax(means)), int(np.nanargmin(means))
            text = f"largest for {name} {labels[top]} ({np.sqrt(means[top]):.1f} noise units), "
            text += f"smallest {labels[low]} ({np.sqrt(means[low]):.1f})"
    return text, best


def _edges(values: Array) -> Array:
    """Return what divides values into bins of about as many, in round figures; the first and the last bin are open."""
    inner = np.quantile(values, np.linspace(0, 1, BINS + 1)[1:-1]) if values.size else np.zeros(1)
    spread = np.ptp(inner)
    if not spread:
        return np.zeros(0)
    decimals = 1 - math.floor(math.log10(spread))
    return np.unique(np.round(inner, decimals) + 0.0)


def _labels(edges: Array) -> tuple[str, ...]:
    between = (f"{a:.6g} to {b:.6g}" for a, b in itertools.pairwise(edges))
    return (f"below {edges[0]:.6g}", *between, f"above {edges[-1]:.6g}") if edges.size else ("all",)


def _heat_map(problem: Problem, rows: Array, channels: Sequence[int], name: str, values: Array) -> HeatMap:
    edges = _edges(values)
    bins = np.searchsorted(edges, values, side="right")
    cells = np.full((len(channels), len(edges) + 1), np.nan)
    for k, c in enumerate(channels):
        for b in range(len(edges) + 1):
            inside = rows[bins == b, c]
            if np.isfinite(inside).any():
                cells[k, b] = np.sqrt(np.nanmean(np.minimum(inside**2, problem.cap**2)))
    return HeatMap(tuple(problem.signals[c].name for c in channels), _labels(edges), cells, name)


# ---- traces ----------------------------------------------------------------------------------------------------------

#: Traces of an analysis.
MOST = 6
#: Shown where nothing stands out.
USUAL = ("gyro_z", "cam_x", "eff_leg_lf", "vel_wheel_lf", "position")


def informative_traces(models: Sequence[FittedModel], heldout: Sequence[int], places: Sequence[Place]) -> tuple[Trace, ...]:
    """Return measured and replayed traces of held-out runs, channels in the order of their share of the gap.

    ``models``: as its file says; calibrated; with the effects.
    """
    problem = models[0].problem
    names = [signal.name for signal in problem.signals]
    wanted = [place.name for place in places] + [name for name in USUAL if name in names]
    settings = [model.setting for model in models]
    replayed, residuals = problem.simulate(settings, heldout), problem.residuals(settings[1:], heldout)
    found = []
    for name in list(dict.fromkeys(wanted))[:MOST]:
        c = names.index(name)
        k = int(np.argmax([float(np.nan_to_num(np.nansum(r[0][:, c] ** 2))) for r in residuals]))
        run, signal, measured = heldout[k], problem.signals[c], problem.measured(heldout[k])[:, c]
        if np.isfinite(measured).any():
            errors = residuals[k][:, :, c] * signal.noise
            lines = (problem.times(run), measured, *replayed[k][:, :, c], *errors)
            found.append(Trace(problem.runs[run], name, signal.unit, *lines))
    return tuple(found)
