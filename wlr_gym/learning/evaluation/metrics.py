"""What episodes are scored by: the task's own measures, and slip, energy, saturation and smoothness in every task.

And how sure a score is: bootstrap confidence intervals over training seeds, blocks of episodes, and episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from wlr_gym.envs.tasks.task import FALL, Which, limits_within, scales_within, succeeded, tracking_error
from wlr_gym.learning.evaluation.rollout import Measure, Rollout

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Less than this travelled per episode (m, mean), and a figure per metre says nothing.
SHORTEST_TRAVEL = 0.05
#: An action this near to its limit counts as being there.
ACTION_AT_LIMIT = 0.99
#: Hz from which a movement of the action counts as jitter: no command of a task changes that fast.
JITTER_FREQUENCY = 5.0
#: Environment steps of one window of the spectrum; windows overlap by half.
WINDOW = 128
#: Friction ratio of the wheels, largest over smallest: from the first on floors count as uneven, from the second as hard.
UNEVEN_FLOOR, HARD_FLOOR = 2.0, 4.5
#: s after the start and after a change of a command in which a motion is not steady yet.
SETTLING = 2.0


@dataclass(frozen=True)
class Metric:
    """One row of the card: key, unit, printed digits, whether less is better, meaning; of episodes the mean, or a quantile."""

    key: str
    unit: str
    digits: int
    less_is_better: bool
    doc: str
    quantile: float | None = None


_AFTER = f"{SETTLING:g} s after start and changes of command"
TRACKING = (
    Metric("tracking_error_median", "-", 3, True, "tracking_error of the episode in the middle", 0.5),
    Metric("tracking_error_p90", "-", 3, True, "tracking_error that one episode in ten exceeds", 0.9),
    Metric("tracking_error_steady", "-", 3, True, f"tracking_error later than {_AFTER}"),
    Metric("tracking_error_transient", "-", 3, True, f"tracking_error within {_AFTER}"),
    Metric(
        "tracking_error_even",
        "-",
        3,
        True,
        f"tracking_error where the wheels' frictions at the start differ by less than {UNEVEN_FLOOR:g} times",
    ),
    Metric("tracking_error_uneven", "-", 3, True, f"where by {UNEVEN_FLOOR:g} to {HARD_FLOOR:g} times"),
    Metric("tracking_error_hard", "-", 3, True, f"where by {HARD_FLOOR:g} times or more"),
)
GENERAL = (
    Metric("falls", "%", 0, True, "episodes that a termination ended"),
    Metric("slip_speed", "m/s", 4, True, "slip speed, mean over wheels and time"),
    Metric("excess_slip", "m/s", 4, True, "slip speed beyond what a steady skid turn needs, mean over wheels and time"),
    Metric(
        "excess_slip_hard",
        "m/s",
        4,
        True,
        f"excess_slip where the wheels' frictions at the start differ by {HARD_FLOOR:g} times or more",
    ),
    Metric("load_weighted_slip", "m/s", 4, True, "slip speed, mean over wheels by the load each carries, and time"),
    Metric("slip_per_metre", "m/m", 3, True, "slip distance of a wheel per metre the body travels"),
    Metric("excess_slip_per_metre", "m/m", 3, True, "slip distance beyond a steady skid turn's per metre the body travels"),
    Metric("energy_per_metre", "J/m", 1, True, "energy drawn per metre the body travels"),
    Metric("power", "W", 2, True, "mean power drawn from the supply"),
    Metric("saturation", "%", 2, True, "share of time and motors at the voltage or torque limit"),
    Metric("action_saturation", "%", 2, True, f"share of time and joints with an action beyond ±{ACTION_AT_LIMIT:g}"),
    Metric("action_jitter", "-", 4, True, f"rms of what moves faster than {JITTER_FREQUENCY:g} Hz in the action (range ±1)"),
    Metric("reward", "-", 2, False, "sum of rewards over the episode"),
)


def metrics_of(measures: Sequence[Measure]) -> tuple[Metric, ...]:
    """Return the rows of a task's card, in order: all limits in one number, the measures, success, and the general ones."""
    limits = [f"{kind} of {m.name} {limit:g} {m.unit}" for m in measures for kind, limit in limits_within(m).items()]
    scales = [f"{kind} of {m.name} {scale:g} {m.unit}" for m in measures for kind, scale in scales_within(m).items()]
    general = [metric.key for metric in GENERAL]
    own = []
    for m in measures:
        if m.name not in general:
            own.append(Metric(m.name, m.unit, 4, True, f"rms over the episode: {m.doc}"))
        if m.max is not None:
            own.append(Metric(f"{m.name}_max", m.unit, 4, True, f"largest magnitude in the episode: {m.doc}"))
    in_scales = f"rms over the measures in units of their scales ({', '.join(scales)}); a fall adds {FALL:g}"
    return (
        Metric("tracking_error", "-", 3, True, in_scales),
        *TRACKING,
        *own,
        Metric("success", "%", 0, False, f"episodes without a fall and within every limit ({', '.join(limits)})"),
        Metric("within_scales", "%", 0, False, "episodes without a fall and within every scale of the tracking error"),
        *GENERAL,
    )


def has_limits(measures: Sequence[Measure]) -> bool:
    """Return whether there is a limit to track within."""
    return any(limits_within(measure) for measure in measures)


def _scales(measures: Sequence[Measure]) -> dict[Which, float]:
    return {(measure.name, kind): scale for measure in measures for kind, scale in scales_within(measure).items()}


@dataclass(frozen=True)
class Played:
    """What is kept of B blocks of N episodes, each played by T training seeds of one recipe (T = 1: one policy).

    Attributes:
        measures: of the task.
        pairs: metric -> (T, B, N, 2), numerator and denominator of each episode. Over many episodes a metric is the sum of its
            numerators over the sum of its denominators, so that in figures per metre an episode of little travel weighs little.
        frequency: (F,) Hz. power: (F,) density of the action, mean over joints and episodes, 1/Hz; NaN if none was long enough.
    """

    measures: tuple[Measure, ...]
    pairs: dict[str, Array]
    frequency: Array
    power: Array


def summarise(rollouts: Iterable[Rollout], training_seeds: int = 1) -> Played:
    """Return what is kept of blocks of episodes of the same number each; takes one after the other.

    Args:
        rollouts: all blocks of the first training seed, then those of the next.
        training_seeds: how many there are.
    """
    measures: tuple[Measure, ...] = ()
    frequency, powers, pairs = np.zeros(0), [], []
    for rollout in rollouts:
        measures = rollout.measures
        frequency, power = spectrum(rollout)
        pairs.append(_per_episode(rollout, frequency, power))
        powers.append(power)
    power = np.concatenate(powers)
    seen = power[np.isfinite(power[:, 0])]
    mean = seen.mean(axis=0) if len(seen) else np.full(frequency.size, np.nan)
    shape = (training_seeds, -1, *pairs[0]["success"].shape)
    kept = {key: np.stack([block[key] for block in pairs]).reshape(shape) for key in pairs[0]}
    return Played(measures, kept, frequency, mean)


def _per_episode(rollout: Rollout, frequency: Array, power: Array) -> dict[str, Array]:
    """Return metric -> (N, 2): numerator and denominator of every episode."""
    active, period = rollout.active, rollout.control_period
    ticks = active.sum(axis=0).astype(np.float64)
    errors = errors_of(rollout.measures, rollout.measured, active)
    tracking = _tracking(rollout, errors)
    slip = np.linalg.norm(rollout.slip_velocity, axis=-1).mean(axis=-1)
    energy = _sum(rollout.energy, active)
    travel = travelled(rollout)
    travel = np.where(travel.mean() < SHORTEST_TRAVEL, 0.0, travel)
    at_limit = np.abs(rollout.action) >= ACTION_AT_LIMIT
    seen = np.isfinite(power[:, 0])
    width = frequency[1] if frequency.size > 1 else 0.0
    jitter = np.sqrt(np.where(seen[:, None], power, 0.0)[:, frequency > JITTER_FREQUENCY].sum(axis=1) * width)
    ones = np.ones(rollout.episodes)
    excess_slip, hard = _sum(rollout.excess_slip, active) / ticks, friction_ratio(rollout) >= HARD_FLOOR
    weighted = (np.linalg.norm(rollout.slip_velocity, axis=-1) * rollout.load).sum(axis=-1)
    values = {
        **{name if kind == "rms" else f"{name}_{kind}": error for (name, kind), error in errors.items()},
        **tracking,
        "success": 100.0 * rollout.succeeded,
        "within_scales": 100.0 * succeeded(_scales(rollout.measures), errors, rollout.fell),
        "falls": 100.0 * rollout.fell,
        "slip_speed": _sum(slip, active) / ticks,
        "excess_slip": excess_slip,
        "excess_slip_hard": (excess_slip * hard, hard),
        "load_weighted_slip": (_sum(weighted, active), _sum(rollout.load.sum(axis=-1), active)),
        "slip_per_metre": (_sum(slip, active) * period, travel),
        "excess_slip_per_metre": (_sum(rollout.excess_slip, active) * period, travel),
        "energy_per_metre": (energy, travel),
        "power": (energy, ticks * period),
        "saturation": 100.0 * _sum(rollout.saturated.mean(axis=-1), active) / ticks,
        "action_saturation": 100.0 * _sum(at_limit.mean(axis=-1), active) / ticks,
        "action_jitter": (jitter, seen.astype(np.float64)),
        "reward": _sum(rollout.reward, active),
    }
    return {key: np.stack(value if isinstance(value, tuple) else (value, ones), axis=1) for key, value in values.items()}


def _tracking(rollout: Rollout, errors: dict[Which, Array]) -> dict[str, tuple[Array, Array]]:
    """Return the tracking error of every episode, whole and in parts: value and weight; weight 0 where there is none."""
    scales, known = _scales(rollout.measures), np.full(rollout.episodes, float(has_limits(rollout.measures)))
    whole = (tracking_error(scales, errors, rollout.fell), known)
    parts = {"tracking_error": whole, "tracking_error_median": whole, "tracking_error_p90": whole}
    ratio = friction_ratio(rollout)
    classes = {"even": ratio < UNEVEN_FLOOR, "hard": ratio >= HARD_FLOOR}
    classes["uneven"] = ~classes["even"] & ~classes["hard"]
    parts |= {f"tracking_error_{name}": (whole[0] * inside, known * inside) for name, inside in classes.items()}
    steady = is_steady(rollout)
    for name, chosen in (("steady", rollout.active & steady), ("transient", rollout.active & ~steady)):
        own = errors_of(rollout.measures, rollout.measured, chosen)
        parts[f"tracking_error_{name}"] = tracking_error(scales, own, np.zeros_like(rollout.fell)), known * chosen.any(axis=0)
    return parts


def friction_ratio(rollout: Rollout) -> Array:
    """Return the largest over the smallest friction coefficient of the wheels at the start (N,), along their headings."""
    along = np.maximum(rollout.friction[:, :, 0], 1e-6)
    return along.max(axis=1) / along.min(axis=1)


def is_steady(rollout: Rollout) -> Mask:
    """Return in which steps (T, N) neither the start nor a change of a command lies in the last :data:`SETTLING` seconds."""
    changed = np.ones(rollout.active.shape, bool)
    changed[1:] = (rollout.command[1:] != rollout.command[:-1]).any(axis=-1)
    step = np.arange(len(changed))[:, None]
    last = np.maximum.accumulate(np.where(changed, step, 0), axis=0)
    return (step - last) * rollout.control_period >= SETTLING


def errors_of(measures: Sequence[Measure], measured: Array, active: Mask) -> dict[Which, Array]:
    """Return (measure, ``rms`` or ``max``) -> (N,), in SI units; ``max`` where it is limited.

    Args:
        measures: of the task.
        measured: (T, N, M).
        active: (T, N) the robot's episode had not ended before this step.
    """
    errors = {}
    for k, measure in enumerate(measures):
        seen = np.where(active, measured[:, :, k], 0.0)
        errors[measure.name, "rms"] = np.sqrt((seen**2).sum(axis=0) / np.maximum(active.sum(axis=0), 1))
        if measure.max is not None:
            errors[measure.name, "max"] = np.abs(seen).max(axis=0)
    return errors


def travelled(rollout: Rollout) -> Array:
    """Return the path length of each body origin (N,), m."""
    steps = np.linalg.norm(np.diff(rollout.position, axis=0), axis=-1)
    return _sum(steps, rollout.active[1:])


def spectrum(rollout: Rollout) -> tuple[Array, Array]:
    """Return frequencies (F,) in Hz and the power density (N, F) of each episode's action, mean over joints, in 1/Hz.

    Welch's estimate: Hann windows of ``WINDOW`` steps (the whole episode if it is shorter) that overlap by half, each without
    its mean; one-sided. NaN for an episode that ended before the first window did.
    """
    size = min(WINDOW, len(rollout.active))
    frequency: Array = np.arange(size // 2 + 1) / np.float64(size * rollout.control_period)
    window = np.hanning(size + 1)[:size] if size > 1 else np.ones(1)
    density = np.full(frequency.size, 2.0 * rollout.control_period / (window @ window))
    density[0] /= 2.0  # one-sided: all but the ends of an even window stand for two frequencies
    if size % 2 == 0:
        density[-1] /= 2.0
    total = np.zeros((rollout.episodes, frequency.size))
    windows = np.zeros(rollout.episodes)
    for first in range(0, len(rollout.active) - size + 1, max(1, size // 2)):
        piece = rollout.action[first : first + size]
        moving = (piece - piece.mean(axis=0)) * window[:, None, None]
        power = (np.abs(np.fft.rfft(moving, axis=0)) ** 2).mean(axis=-1).T * density
        whole: Mask = np.all(rollout.active[first : first + size], axis=0)
        total += np.where(whole[:, None], power, 0.0)
        windows += whole
    return frequency, np.where(windows[:, None] > 0, total / np.maximum(windows, 1.0)[:, None], np.nan)


def _sum(values: Array, active: Mask) -> Array:
    """Sum (T, N, ...) over the steps that count; what is not finite after the end does not matter."""
    return np.where(active.reshape(active.shape + (1,) * (values.ndim - 2)), values, 0.0).sum(axis=0)


# ---- confidence intervals --------------------------------------------------------------------------------------------

RESAMPLES = 2000
CONFIDENCE = 0.95
#: Share of the training seeds that the interquartile mean leaves out at either end, rounded down to whole seeds.
TRIM = 0.25


@dataclass(frozen=True)
class Estimate:
    """A number with its confidence interval; NaN where the quantity, or its interval, does not exist."""

    mean: float
    low: float
    high: float

    @property
    def excludes_zero(self) -> bool:
        """Whether the whole interval lies on one side of zero."""
        return self.low > 0.0 or self.high < 0.0


def mean(scores: Array) -> Array:
    """Return the mean over training seeds, (R, T) to (R,)."""
    return scores.mean(axis=1)


def interquartile_mean(scores: Array) -> Array:
    """Return the mean over the middle half of the training seeds, (R, T) to (R,); that of all where T is below 4."""
    cut = int(TRIM * scores.shape[1])
    return np.sort(scores, axis=1)[:, cut : scores.shape[1] - cut].mean(axis=1)


def _over(above: Array, below: Array) -> Array:
    """Return quotients (R,); NaN where the first divisor, as measured, is not above 0: the sign would say the opposite."""
    return above / below if below[0] > 0.0 else np.full_like(above, np.nan)


def expansion(seeds: int) -> float:
    """Return by how much resampled means of T training seeds must spread more to give Student's interval; 0 for one seed.

    Resampling few values gives too narrow an interval: the variance lacks T / (T - 1), and normal quantiles stand for those of
    Student's t with T - 1 degrees of freedom (Hesterberg 2015, section 4).
    """
    if seeds < 2:
        return 0.0
    tail = 0.5 * (1.0 + CONFIDENCE)
    return float(np.sqrt(seeds / (seeds - 1.0)) * stdtrit(seeds - 1, tail) / ndtri(tail))


class Bootstrap:
    """Resampling of blocks, of episodes within them (Davison and Hinkley 1997, section 3.8), and of training seeds.

    All subjects play the same episodes and get the same resamples of them, so that differences between them are paired. So do
    all training seeds of a subject: what is particular to an episode does not average out over seeds. Training seeds of one
    subject have nothing to do with those of another: each subject's are resampled by themselves, as blocks of all their
    episodes.

    Args:
        blocks: B, of episodes with their own seeds.
        episodes: N per block.
    """

    def __init__(self, blocks: int, episodes: int) -> None:
        draws = np.random.default_rng(0)
        counts = draws.multinomial(episodes, np.full(episodes, 1.0 / episodes), (RESAMPLES, blocks)).astype(np.float64)
        chosen = draws.integers(0, blocks, (RESAMPLES, blocks))
        weights = np.zeros((RESAMPLES, blocks, episodes))
        for stage in range(blocks):
            weights[np.arange(RESAMPLES), chosen[:, stage]] += counts[:, stage]
        self._weights = weights.reshape(RESAMPLES, -1)

    def scores(self, pairs: Array, quantile: float | None = None) -> Array:
        """Return each training seed's metric (RESAMPLES + 1, T) of numerators and denominators (T, B, N, 2).

        The first row is as measured, the others with resampled episodes. ``quantile``: of the episodes, in place of their mean.
        """
        flat = pairs.reshape(-1, self._weights.shape[1], 2)
        if quantile is not None:
            return self._quantiles(flat, quantile)
        columns = flat.transpose(1, 0, 2).reshape(self._weights.shape[1], -1)
        sums = np.concatenate([columns.sum(axis=0, keepdims=True), self._weights @ columns]).reshape(-1, len(flat), 2)
        above, below = sums[:, :, 0], sums[:, :, 1]
        return np.divide(above, below, out=np.full(above.shape, np.nan), where=below > 0)

    def _quantiles(self, flat: Array, quantile: float) -> Array:
        """Return the smallest values (RESAMPLES + 1, T) that the share ``quantile`` of the episodes does not exceed."""
        weights = np.concatenate([np.ones((1, flat.shape[1])), self._weights])
        found = []
        for own in flat:
            values = np.divide(own[:, 0], own[:, 1], out=np.full(len(own), np.nan), where=own[:, 1] > 0)
            order = np.argsort(values)
            reached = np.cumsum(weights[:, order] * (own[order, 1] > 0), axis=1)
            found.append(values[order][np.argmax(reached >= quantile * reached[:, -1:] - 1e-9, axis=1)])
        return np.stack(found, axis=1)

    def estimate(
        self,
        function: Callable[..., Array],
        *pairs: Array,
        subjects: Sequence[int] | None = None,
        over_seeds: Callable[[Array], Array] = mean,
        quantile: float | None = None,
    ) -> Estimate:
        """Return ``function`` of metrics with its interval.

        Args:
            function: of as many metrics, each (RESAMPLES + 1,), as there are ``pairs``.
            pairs: numerators and denominators (T, B, N, 2), or (B, N, 2) of one training seed; T may differ.
            subjects: number of the subject that each belongs to; None = all different ones.
            over_seeds: makes one score of those of a subject's training seeds.
            quantile: of the episodes, in place of their mean.
        """
        numbers = range(len(pairs)) if subjects is None else subjects
        drawn = [self._draw(pair, number, over_seeds, quantile) for pair, number in zip(pairs, numbers, strict=True)]
        by_episodes, by_both, seeds = zip(*drawn, strict=True)
        factor = expansion(min((count for count in seeds if count > 1), default=1))
        with np.errstate(divide="ignore", invalid="ignore"):
            values = function(*by_episodes)
            values = values + factor * (function(*by_both) - values)
        if not np.isfinite(values[0]):
            return Estimate(np.nan, np.nan, np.nan)
        if not factor and self._weights.shape[1] == 1:  # one episode of one training says nothing of others
            return Estimate(float(values[0]), np.nan, np.nan)
        tail = 50.0 * (1.0 - CONFIDENCE)
        low, high = np.nanpercentile(np.where(np.isfinite(values), values, np.nan)[1:], (tail, 100.0 - tail))
        return Estimate(float(values[0]), float(low), float(high))

    def _draw(
        self, pairs: Array, subject: int, over_seeds: Callable[[Array], Array], quantile: float | None
    ) -> tuple[Array, Array, int]:
        """Return a metric (RESAMPLES + 1,), as measured first: resampled in its episodes, in its seeds too; how many seeds."""
        scores = self.scores(pairs, quantile)
        seeds = scores.shape[1]
        chosen = np.random.default_rng([subject, seeds]).integers(0, seeds, (RESAMPLES, seeds))
        chosen = np.concatenate([np.arange(seeds)[None], chosen])
        return over_seeds(scores), over_seeds(np.take_along_axis(scores, chosen, axis=1)), seeds

    def mean(self, pairs: Array, quantile: float | None = None) -> Estimate:
        """Return the metric itself, mean over training seeds."""
        return self.estimate(lambda value: value, pairs, quantile=quantile)

    def interquartile_mean(self, pairs: Array, quantile: float | None = None) -> Estimate:
        """Return the metric itself, interquartile mean over training seeds (Agarwal et al. 2021)."""
        return self.estimate(lambda value: value, pairs, over_seeds=interquartile_mean, quantile=quantile)

    def difference(self, ours: Array, theirs: Array) -> Estimate:
        """Return ours - theirs."""
        return self.estimate(lambda a, b: a - b, ours, theirs)

    def reduction(self, ours: Array, theirs: Array, quantile: float | None = None) -> Estimate:
        """Return by how much ours is smaller than theirs, in % of theirs."""
        return self.estimate(lambda a, b: 100.0 * (1.0 - _over(a, b)), ours, theirs, quantile=quantile)

    def share(self, ours: Array, theirs: Array, our_zero: Array, their_zero: Array, *, subjects: Sequence[int]) -> Estimate:
        """Return ours in % of theirs, each above its own zero; ``subjects`` as for :meth:`estimate`."""
        return self.estimate(
            lambda a, b, zero_a, zero_b: 100.0 * _over(a - zero_a, b - zero_b),
            ours, theirs, our_zero, their_zero, subjects=subjects,
        )  # fmt: skip
