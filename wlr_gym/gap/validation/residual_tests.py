"""Is the final model adequate? What it leaves in the runs, beside what it would leave in runs that it made itself.

Three statistics of the fitted runs (:func:`adequacy_of`): *level*, the root mean square of the residuals; *whiteness*, their
integrated autocorrelation time in rows (see :mod:`wlr_gym.gap.estimation`); *constancy*, the scatter of the runs'
estimates of the model's numbers over what their rows predict. A parametric bootstrap shows what chance alone leaves: the same
runs are made anew by the final model with the same sensors, the model's numbers are fitted to each such set by one linear step
with the columns of the fit, drawn towards the numbers that made it, and the same statistics are taken. No decision depends on
it. No simulator is exact, and such tests notice that: with real runs they always reject. What matters is the ratio of a
statistic to its median in the sets that were made.

One test decides something (:func:`turning`): residuals that are periodic in the angle of a joint that turns without end. A
wheel of the model is round and its encoder centred: but for a ripple of its torque, nothing depends on its angle. A residual
that does after calibration is a missing effect (a wheel out of round, an encoder off its centre, a bent axle); its law is not
identified.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from wlr_gym.gap.analysis import Adequacy, ByChannel, Constancy, Pulled, Statistic, Turning
from wlr_gym.gap.estimation import Fit, Replayed, estimate_noise, run_scatter
from wlr_gym.gap.problem import Array
from wlr_gym.gap.selection.screening import Products

#: Sets of runs that the model makes: the least of which the largest is a limit of 5 %.
REPLICATES = 19
#: Curvature of the likelihood, scaled numbers, above which the data are informative about a number.
INFORMATIVE = 1.0


class _Columns:
    """The columns of a fit and their products, channel by channel: what a set of runs pulls costs next to nothing with them."""

    def __init__(self, found: Fit) -> None:
        products = Products(found, found.columns)
        self._by_channel, self._products = products.columns, products.by_run
        self._free = ~found.model.on_bounds
        self._tight = found.model.tightness
        self._found = found

    def refitted(self, residuals: Sequence[Array]) -> list[Array]:
        """Return the residuals (rows, channels) per run after one linear step of the fit."""
        pull = np.einsum("c,rcn->n", self._found.noise.weight, self._vectors(residuals))
        step = -np.linalg.solve(self._found.hessian, pull).astype(np.float32)
        return [residual + (step @ column).T for residual, column in zip(residuals, self._by_channel, strict=True)]

    def left(self, residuals: Sequence[Array]) -> tuple[Array, Array, float, Array]:
        """Return statistics of residuals (rows, channels), one array per run; NaN in channels that were not measured.

        Level (channels), autocorrelation time (channels), scatter of the runs' estimates of the numbers over what their rows
        predict (NaN = the data are informative about none), and by how many standard errors each run pulls each number away
        from the others (runs, numbers).
        """
        noise = estimate_noise(residuals)
        matrices = np.einsum("c,rcmn->rmn", noise.weight, self._products)[:, self._free][:, :, self._free]
        vectors = np.einsum("c,rcn->rn", noise.weight, self._vectors(residuals))[:, self._free]
        scatter = run_scatter(matrices, vectors)
        pulls = np.zeros((len(residuals), len(self._free)))
        pulls[:, self._free] = _pulls(matrices, vectors, self._tight[self._free])
        level, time = (np.where(noise.rows > 0, v, np.nan) for v in (np.sqrt(noise.square), noise.autocorrelation_time))
        return level, time, math.nan if scatter is None else scatter, pulls

    def _vectors(self, residuals: Sequence[Array]) -> Array:
        """Products (runs, channels, numbers) of columns and residuals."""
        pairs = zip(self._by_channel, residuals, strict=True)
        return np.stack([(c @ np.nan_to_num(r).T.astype(np.float32)[:, :, None])[:, :, 0] for c, r in pairs]).astype(np.float64)


def _pulls(matrices: Array, vectors: Array, tight: Array) -> Array:
    """By how many standard errors (runs, numbers) each run alone moves each number; 0 where the data say nothing of it."""
    total = matrices.sum(axis=0)
    inverse = np.linalg.inv(total + np.diag(tight))
    shifts = (vectors - vectors.mean(axis=0)) @ inverse
    errors = np.sqrt(np.einsum("ij,rjk,ki->ri", inverse, matrices, inverse).clip(min=0.0))
    return np.where((np.diag(total) > INFORMATIVE) & (errors > 0.0), np.abs(shifts) / np.where(errors > 0.0, errors, 1.0), 0.0)


def adequacy_of(found: Fit) -> Adequacy | None:
    """Compare what a fitted model leaves in the runs it was fitted to with what it leaves in runs that it made itself.

    None where it cannot make them.
    """
    problem, columns = found.problem, _Columns(found)
    made = problem.remade(found.model.setting, found.runs, REPLICATES)
    every = [columns.left(found.residuals), *(columns.left(columns.refitted(residuals)) for residuals in made)]
    if len(every) == 1:
        return None
    levels, times, scatters, pulls = (np.stack(values) for values in zip(*every, strict=True))
    run, which = np.unravel_index(int(np.argmax(pulls[0])), pulls[0].shape)
    names = [quantity.name for quantity in problem.quantities]
    names += [f"{candidate.label} {one.name}" for candidate, _ in found.model.effects for one in candidate.unknowns]
    number, pulled_by = names[int(which)], problem.runs[found.runs[int(run)]]
    pulled = Pulled(**vars(compared(pulls.max(axis=(1, 2)))), number=number, run=pulled_by)
    measured = [(c, signal.name) for c, signal in enumerate(problem.signals) if np.isfinite(levels[0, c])]

    def by_channel(whole: Array, values: Array) -> ByChannel:
        return ByChannel(**vars(compared(whole)), channels={name: compared(values[:, c]) for c, name in measured})

    return Adequacy(
        REPLICATES,
        by_channel(np.sqrt(np.nanmean(levels**2, axis=1)), levels),
        by_channel(np.exp(np.nanmean(np.log(times), axis=1)), times),
        Constancy(**vars(compared(scatters)), pulled_most=pulled),
    )


def compared(values: Array) -> Statistic:
    """Compare the first of the values, which was observed, with the others, which a true model would have left.

    What cannot be compared has a p of NaN.
    """
    observed, others = float(values[0]), values[1:]
    if not np.isfinite(values).all():
        return Statistic(observed, math.nan, math.nan, math.nan, math.nan)
    larger = int((others >= observed).sum())
    limit = float(np.quantile(others, 0.95, method="weibull"))  # what a value of p = 0.05 must exceed
    expected = float(np.median(others))
    ratio = observed / expected if expected > 0.0 else math.nan
    return Statistic(observed, expected, limit, (1 + larger) / (1 + len(others)), ratio)


# ---- periodic residuals ----------------------------------------------------------------------------------------------

#: Periods per turn that are tried.
ORDERS = (1, 2, 3)
#: How far beside them a dependence on the place on the floor, which a wheel's angle follows too, would be seen.
BESIDE = 0.4
#: Parts of a run, each predicted from the others.
PARTS = 4
#: Turns that a joint must make in a run.
LEAST_TURNS = 2.5
#: Rows of such a run.
LEAST_ROWS = 100
#: Runs in which it does.
LEAST_RUNS = 3
#: Bootstrap samples of the runs.
SAMPLES = 500
#: Selection frequency: share of them that must show it.
LEAST_CONFIDENCE = 0.9
#: Share of a signal's squared residual that must be periodic in the angle.
LEAST_SHARE = 0.1


def turning(left: Replayed, features: Sequence[Mapping[str, Array]]) -> Turning | None:
    """Return the signal whose residual is most periodic in its joint's angle, or None.

    ``left``: the final model; ``features``: simulated angles (rows,) among them, per run.
    """
    names = [signal.name for signal in left.problem.signals]
    found = [
        _best_order(joint, signal, [r[:, names.index(signal)] for r in left.residuals], [f[angle] for f in features])
        for joint, (angle, signals) in left.problem.turning.items()
        for signal in signals
        if signal in names
    ]
    clear = [one for one in found if one is not None and one.share > LEAST_SHARE and one.confidence > LEAST_CONFIDENCE]
    return max(clear, key=lambda one: one.share, default=None)


def _best_order(joint: str, signal: str, residuals: Sequence[Array], angles: Sequence[Array]) -> Turning | None:
    runs = []
    for residual, angle in zip(residuals, angles, strict=True):
        known = np.isfinite(residual) & np.isfinite(angle)
        if known.sum() >= LEAST_ROWS and np.ptp(angle[known]) >= 2.0 * np.pi * LEAST_TURNS:
            runs.append((residual[known] - residual[known].mean(), angle[known]))
    if len(runs) < LEAST_RUNS:
        return None
    best, falls = max(((order, _falls(runs, order)) for order in ORDERS), key=lambda pair: _share(pair[1]))
    picks = np.random.default_rng(0).integers(0, len(runs), (SAMPLES, len(runs)))
    frequency = float(np.mean([_share(falls[:, pick]) > LEAST_SHARE for pick in picks]))
    amplitudes = [np.hypot(*_wave(residual, _waves(angle, best))) for residual, angle in runs]
    return Turning(joint, signal, best, _share(falls), float(np.sqrt(np.mean(np.square(amplitudes)))), frequency)


def _falls(runs: Sequence[tuple[Array, Array]], order: int) -> Array:
    """Squared residuals (5, runs): how far they fall with this order, with those beside it, with a wave in time, and all."""
    falls = [[_predicted(*run, other) for run in runs] for other in (order, order - BESIDE, order + BESIDE)]
    in_time = []  # over the same turning at one speed, a clock's
    for residual, angle in runs:
        rows = np.arange(len(angle))
        steady = np.asarray(np.polyval(np.polyfit(rows, angle, 1), rows), np.float64)
        in_time.append(_predicted(residual, steady, order))
    return np.array([*falls, in_time, [float(residual @ residual) for residual, _ in runs]])


def _share(falls: Array) -> float:
    """Share that is periodic in the angle, less what orders that no turning part has, or time, predict as well."""
    here, *beside, total = falls.sum(axis=1)
    return float((here - max(*beside, 0.0)) / total) if total > 0.0 else 0.0


def _predicted(residual: Array, angle: Array, order: float) -> float:
    """How far the squared residuals of a run fall by a wave over the angle, each part's from the run's other parts."""
    waves, fall = _waves(angle, order), 0.0
    for part in np.array_split(np.arange(len(residual)), PARTS):
        rest = np.ones(len(residual), bool)
        rest[part] = False
        left = residual[part] - waves[part] @ _wave(residual[rest], waves[rest])
        fall += float(residual[part] @ residual[part] - left @ left)
    return fall


def _waves(angle: Array, order: float) -> Array:
    waves = np.stack([np.sin(order * angle), np.cos(order * angle)], axis=1)
    return waves - waves.mean(axis=0)


def _wave(residual: Array, waves: Array) -> Array:
    """Least-squares amplitudes (2) of sine and cosine."""
    return np.asarray(np.linalg.lstsq(waves, residual, rcond=None)[0], np.float64)
