"""The score card of a policy: tracking, falls, slip, energy and saturation over many episodes, with confidence intervals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.evaluation.rollout import Rollout
from wlr_gym.files import replace_file, write_json

Array = NDArray[np.float64]

#: An episode succeeds without a fall and with rms tracking errors below these: half of what doing nothing gets on average.
SUCCESS_VELOCITY_ERROR = 0.025
SUCCESS_YAW_RATE_ERROR = 0.08
RESAMPLES = 2000
CONFIDENCE = 0.95
#: Less than this travelled per episode (m), and a figure per metre says nothing.
SHORTEST_TRAVEL = 0.05


@dataclass(frozen=True)
class Metric:
    """One row of the card: key, unit, printed digits, whether less is better, meaning."""

    key: str
    unit: str
    digits: int
    less_is_better: bool
    doc: str


METRICS = (
    Metric("velocity_error", "m/s", 4, True, "rms error of the forward velocity over the episode"),
    Metric("yaw_rate_error", "rad/s", 3, True, "rms error of the yaw rate over the episode"),
    Metric(
        "success", "%", 0, False,
        f"episodes without a fall, errors below {SUCCESS_VELOCITY_ERROR:g} m/s and {SUCCESS_YAW_RATE_ERROR:g} rad/s",
    ),
    Metric("falls", "%", 0, True, "episodes that a termination ended"),
    Metric("slip_speed", "m/s", 4, True, "slip speed, mean over wheels and time"),
    Metric("slip_per_metre", "m/m", 3, True, "slip distance of a wheel per metre the body travels"),
    Metric("energy_per_metre", "J/m", 1, True, "energy drawn per metre the body travels"),
    Metric("saturation", "%", 2, True, "share of time and motors at the voltage or torque limit"),
    Metric("reward", "-", 2, False, "sum of rewards over the episode"),
)  # fmt: skip


@dataclass(frozen=True)
class Estimate:
    """Mean over episodes with its bootstrap confidence interval; NaN where the quantity does not exist."""

    mean: float
    low: float
    high: float


Card = dict[str, Estimate]


def score(rollout: Rollout) -> Card:
    """Return metric -> estimate. Figures per metre are ratios of sums, so that an episode of little travel weighs little."""
    pairs = per_episode(rollout)
    resampled = _resamples(rollout.episodes)
    return {metric.key: _estimate(*pairs[metric.key], resampled) for metric in METRICS}


def per_episode(rollout: Rollout) -> dict[str, tuple[NDArray, NDArray]]:
    """Return metric -> (numerator, denominator), one number per episode; the metric is sum over sum."""
    active = rollout.active
    ticks = active.sum(axis=0).astype(np.float64)
    velocity_error = _rms(rollout.forward_velocity - rollout.commanded("linear_velocity_x"), active)
    yaw_rate_error = _rms(rollout.yaw_rate - rollout.commanded("yaw_rate"), active)
    success = ~rollout.fell & (velocity_error < SUCCESS_VELOCITY_ERROR) & (yaw_rate_error < SUCCESS_YAW_RATE_ERROR)
    slip = np.linalg.norm(rollout.slip_velocity, axis=-1).mean(axis=-1)
    slip_distance = _sum(slip, active) * rollout.control_period
    travel = travelled(rollout)
    travel = np.where(travel.mean() < SHORTEST_TRAVEL, 0.0, travel)
    ones = np.ones(rollout.episodes)
    return {
        "velocity_error": (velocity_error, ones),
        "yaw_rate_error": (yaw_rate_error, ones),
        "success": (100.0 * success, ones),
        "falls": (100.0 * rollout.fell, ones),
        "slip_speed": (_sum(slip, active) / ticks, ones),
        "slip_per_metre": (slip_distance, travel),
        "energy_per_metre": (_sum(rollout.energy, active), travel),
        "saturation": (100.0 * _sum(rollout.saturated.mean(axis=-1), active) / ticks, ones),
        "reward": (_sum(rollout.reward, active), ones),
    }


def travelled(rollout: Rollout) -> Array:
    """Return the path length of each body origin (N,), m."""
    steps = np.linalg.norm(np.diff(rollout.position, axis=0), axis=-1)
    return _sum(steps, rollout.active[1:])


def _sum(values: Array, active: NDArray[np.bool_]) -> Array:
    return np.where(active, values, 0.0).sum(axis=0)


def _rms(error: Array, active: NDArray[np.bool_]) -> Array:
    return np.sqrt(_sum(error * error, active) / active.sum(axis=0))


def _resamples(episodes: int) -> NDArray[np.int64]:
    """Return (RESAMPLES, N) episode indices, the same for every policy, so that cards of the same seeds are paired."""
    return np.random.default_rng(0).integers(0, episodes, (RESAMPLES, episodes))


def _estimate(numerator: NDArray, denominator: NDArray, resampled: NDArray[np.int64]) -> Estimate:
    if denominator.sum() <= 0:
        return Estimate(np.nan, np.nan, np.nan)
    draws = numerator[resampled].sum(axis=1) / np.maximum(denominator[resampled].sum(axis=1), 1e-12)
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(draws, (tail, 100.0 - tail))
    return Estimate(float(numerator.sum() / denominator.sum()), float(low), float(high))


def rows(cards: Mapping[str, Card], *, short: bool = False) -> list[list[str]]:
    """Return the table as text: a header, then one row per metric with a column per policy.

    ``short`` gives half the width of the interval instead of its ends.
    """
    cell = _short_cell if short else _full_cell
    header = ["metric", "unit", *cards]
    return [header, *([m.key, m.unit, *(cell(card[m.key], m.digits) for card in cards.values())] for m in METRICS)]


def _full_cell(estimate: Estimate, digits: int) -> str:
    if np.isnan(estimate.mean):
        return "-"
    return f"{estimate.mean:.{digits}f} [{estimate.low:.{digits}f}, {estimate.high:.{digits}f}]"


def _short_cell(estimate: Estimate, digits: int) -> str:
    if np.isnan(estimate.mean):
        return "-"
    return f"{estimate.mean:.{digits}f} ± {(estimate.high - estimate.low) / 2:.{digits}f}"


def markdown(cards: Mapping[str, Card], conditions: Mapping[str, Any]) -> str:
    """Return the card as Markdown: conditions, table, meaning of the rows."""
    header, *body = rows(cards)
    lines = ["# Score card", "", *(f"- {name}: {value}" for name, value in conditions.items()), ""]
    lines += [f"| {' | '.join(header)} |", f"|{'---|' * len(header)}", *(f"| {' | '.join(row)} |" for row in body), ""]
    lines += [f"Mean over episodes [{CONFIDENCE:.0%} bootstrap interval]; `-` where nothing moved.", ""]
    lines += [f"- `{m.key}` ({m.unit}, {'less' if m.less_is_better else 'more'} is better): {m.doc}" for m in METRICS]
    return "\n".join(lines) + "\n"


def write_card(folder: Path, cards: Mapping[str, Card], conditions: Mapping[str, Any]) -> None:
    """Write ``card.md`` and ``card.json`` into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    text = markdown(cards, conditions)
    replace_file(folder / "card.md", lambda temporary: temporary.write_text(text, encoding="utf-8"))
    content = {name: {key: _numbers(estimate) for key, estimate in card.items()} for name, card in cards.items()}
    write_json(folder / "card.json", {"conditions": dict(conditions), "policies": content})


def _numbers(estimate: Estimate) -> dict[str, float | None]:
    return {name: None if np.isnan(value) else value for name, value in vars(estimate).items()}
