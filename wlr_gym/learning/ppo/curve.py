"""What training measures per update (rewards by term, slip, falls, losses), and the files of numbers over steps."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback

from wlr_gym.base.files import replace_file
from wlr_gym.envs.core import Core
from wlr_gym.learning.evaluation import read_curve

LOSSES = ("policy_gradient_loss", "value_loss", "approx_kl", "explained_variance", "std")


class TrainingError(RuntimeError):
    """Training met a number that is not finite; the message names the file with the state it happened in."""


class Meter(BaseCallback):
    """Watches every environment step of an update: sums up what the learning curve shows and stops at non-finite numbers.

    Args:
        core: the batch of robots.
        dump: file to write the state to when a number is not finite.
    """

    def __init__(self, core: Core, dump: Path) -> None:
        super().__init__()
        self.core = core
        self.dump = dump
        self._clear()

    def _clear(self) -> None:
        self._ticks, self._robots, self._reward, self._slip = 0, 0, 0.0, 0.0
        self._terms = np.zeros(len(self.core.task.rewards))
        self._episodes, self._falls = 0, 0

    def _on_step(self) -> bool:
        rewards, dones = self.locals["rewards"], self.locals["dones"]
        if not all(np.isfinite(array).all() for array in (rewards, *_arrays("", self.locals["new_obs"]).values())):
            self.fail("an observation or reward is not finite")
        going_on = ~dones
        slip = self.core.plant.truth()["slip_velocity"].reshape(-1, 4, 2)
        self._ticks += 1
        self._reward += float(rewards.mean(dtype=np.float64))
        self._robots += int(going_on.sum())
        self._terms += self.core.scores.terms[going_on].sum(axis=0)
        self._slip += float(np.sqrt((slip * slip).sum(axis=-1)).mean(axis=-1)[going_on].sum())
        for row in np.flatnonzero(dones):
            self._episodes += 1
            self._falls += not self.locals["infos"][row]["TimeLimit.truncated"]
        return True

    def fail(self, reason: str) -> None:
        """Write the state to the dump file and raise :class:`TrainingError`."""
        arrays: dict[str, Any] = {}
        for name in ("actions", "new_obs", "obs_tensor", "rewards"):
            arrays |= _arrays(name, self.locals[name]) if name in self.locals else {}
        episodes = self.core.episodes
        arrays |= {"parameters": self.core.parameters.values, "robot_seeds": episodes.robot_seeds, "ticks": episodes.steps}
        replace_file(self.dump, lambda temporary: np.savez(temporary, **arrays))  # type: ignore[arg-type]
        raise TrainingError(f"{reason} after {self.num_timesteps} steps; state written to {self.dump}")

    def take(self) -> dict[str, float]:
        """Return the means since the last call, rewards per second; terms and slip over robots whose episode continued."""
        period = self.core.task.config.control_period
        terms = self._terms / max(self._robots, 1) / period
        means = {"reward_per_second": self._reward / max(self._ticks, 1) / period}
        means |= {f"term.{name}": float(value) for name, value in zip(self.core.task.rewards, terms, strict=True)}
        means |= {"slip_speed": self._slip / max(self._robots, 1), "episodes": self._episodes, "falls": self._falls}
        self._clear()
        return means


def _arrays(name: str, value: Any) -> dict[str, NDArray]:
    """Return an observation, or anything else, as arrays by name: groups of an observation apart."""
    if isinstance(value, Mapping):
        return {f"{name}.{group}": np.asarray(part) for group, part in value.items()}
    return {name: np.asarray(value)}


class CurveFile:
    """A CSV file of numbers over steps (``learning_curve.csv``, ``held_out.csv``); each row is written at once.

    Args:
        path: of the file; rows beyond ``steps``, which a resumed run repeats, are dropped, the others stay as they are.
        steps: environment steps done so far.
    """

    def __init__(self, path: Path, steps: int) -> None:
        self.path = path
        kept = ""
        if path.is_file():
            count = sum(row["steps"] <= steps for row in read_curve(path))
            lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
            kept = "".join(lines[: count + 1]) if count else ""
        replace_file(path, lambda temporary: temporary.write_text(kept, encoding="utf-8"))

    def append(self, row: Mapping[str, float]) -> None:
        """Add a row."""
        with self.path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(row))
            if file.tell() == 0:
                writer.writeheader()
            writer.writerow(row)


def losses(logged: dict[str, Any]) -> dict[str, float]:
    """Return the losses that Stable-Baselines3 recorded in its logger during the last update."""
    return {name: float(logged.get(f"train/{name}", math.nan)) for name in LOSSES}
