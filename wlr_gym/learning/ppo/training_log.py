"""What a training writes while it runs: curves, TensorBoard, scores on held-out episodes, the best policy, checkpoints."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from torch.utils.tensorboard import SummaryWriter

from wlr_gym.envs import Sb3VecEnv
from wlr_gym.learning.evaluation import read_curve
from wlr_gym.learning.ppo import checkpoint
from wlr_gym.learning.ppo.config import PpoConfig
from wlr_gym.learning.ppo.curve import LOSSES, CurveFile
from wlr_gym.learning.ppo.held_out import HeldOutEpisodes, best_of, is_better
from wlr_gym.policy import Training

if TYPE_CHECKING:
    from stable_baselines3 import PPO

CURVE_FILE = "learning_curve.csv"
SCORES_FILE = "held_out.csv"
BEST = "best"


class TrainingLog:
    """Writes the run folder of one training; a resumed one goes on in the same files.

    Args:
        training, config, env, model: what is being trained; ``model`` is where the run (re)starts.

    Attributes:
        training, config, env, model: as given.
        scores: newest row of ``held_out.csv``; empty before the first.
        best: that of the policy in ``best/``.
    """

    def __init__(self, training: Training, config: PpoConfig, env: Sb3VecEnv, model: PPO) -> None:
        self.training, self.config, self.env, self.model = training, config, env, model
        folder, steps = training.folder, model.num_timesteps
        self._curve = CurveFile(folder / CURVE_FILE, steps)
        self._scores = CurveFile(folder / SCORES_FILE, steps) if config.evaluate_every else None
        rows = read_curve(folder / SCORES_FILE) if self._scores else []
        self.scores: Mapping[str, float] = rows[-1] if rows else {}
        self.best: Mapping[str, float] = best_of(rows)
        self._episodes = HeldOutEpisodes(training.environment, config) if config.evaluate_every else None
        model.set_logger(Logger(str(folder), [_ResumedTensorBoard(folder / "tensorboard", steps)]))

    def close(self) -> None:
        """Release the plant of the held-out episodes; the files are complete at any time."""
        self.model.logger.close()
        if self._episodes is not None:
            self._episodes.close()

    def update(self, row: Mapping[str, float]) -> None:
        """Write what an update measured."""
        self._curve.append(row)
        for name, value in row.items():
            if name != "steps" and name not in LOSSES:  # Stable-Baselines3 records the losses itself
                group = "reward" if name.startswith("term.") else "training"
                self.model.logger.record(f"{group}/{name.removeprefix('term.')}", value)
        self.model.logger.dump(step=self.model.num_timesteps)

    def score(self) -> None:
        """Score the present policy on the held-out episodes, once per step count; keep it where it is the best so far."""
        steps = self.model.num_timesteps
        if self._episodes is None or self._scores is None or self.scores.get("steps") == steps:
            return
        self.scores = {"steps": steps, **self._episodes.score(self.model)}
        self._scores.append(self.scores)
        for name, value in self.scores.items():
            if name != "steps":
                self.model.logger.record(f"held_out/{name}", value)
        self.model.logger.dump(step=steps)
        if is_better(self.scores, self.best):
            self.best = self.scores
            self._save(self.training.folder / BEST)

    def save_checkpoint(self) -> Path:
        """Write a checkpoint that the training can be resumed from; drop the oldest."""
        checkpoints = self.training.folder / "checkpoints"
        place = self._save(checkpoints / checkpoint.name_of(self.model.num_timesteps), to_resume=True)
        checkpoint.drop_old(checkpoints, self.config.keep_checkpoints)
        return place

    def save_policy(self) -> Path:
        """Write the present policy as that of the run."""
        return self._save(self.training.folder / "policy")

    def _save(self, place: Path, *, to_resume: bool = False) -> Path:
        notes = {"environment": self.training.environment}
        if self.scores.get("steps") == self.model.num_timesteps:
            notes |= {"held_out": {name: value for name, value in self.scores.items() if name != "steps"}}
        return checkpoint.save(place, self.model, self.config, self.env, notes, to_resume=to_resume)


class _ResumedTensorBoard(TensorBoardOutputFormat):
    """TensorBoard's files; what an interrupted run wrote beyond ``steps`` is no longer shown."""

    def __init__(self, folder: Path, steps: int) -> None:
        self.writer = SummaryWriter(str(folder), purge_step=steps or None)
        self._is_closed = False
