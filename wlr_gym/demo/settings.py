"""What a demo is made with, and where its results lie."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

ENVIRONMENT = "WLR-Velocity-v0"


@dataclass(frozen=True)
class Demo:
    """One demo.

    Attributes:
        out: folder of all results.
        seed: of everything random: training, episodes, commands, and what the robot hides.
        steps: environment steps to train for, all robots together.
        episodes: of each policy in the comparison.
        film_seconds: length of the film.
        run_seconds: length of each measured run.
        runs: how many of them, 3 to 4.
        further_steps: environment steps to train on for, with what was found.
        drives, drive_seconds: episodes of the old and the new policy on the robot, and their length.
    """

    out: Path
    seed: int = 0
    steps: int = 3_000_000
    episodes: int = 64
    film_seconds: float = 12.0
    run_seconds: float = 10.0
    runs: int = 4
    further_steps: int = 1_000_000
    drives: int = 8
    drive_seconds: float = 5.0

    @property
    def training(self) -> Path:
        """Run folder of the training."""
        return self.out / "run"

    @property
    def measured(self) -> Path:
        """Folder of the measured runs of the robot."""
        return self.out / "measured_runs"

    @property
    def gap(self) -> Path:
        """Folder of the gap workflow's results."""
        return self.out / "gap"

    @property
    def adapted(self) -> Path:
        """Folder of the training with what was found, and of the drives after it."""
        return self.out / "adapted"

    @property
    def hidden(self) -> Path:
        """Patch file with what the robot hides."""
        return self.out / "hidden.yaml"

    @property
    def page(self) -> Path:
        """The page."""
        return self.out / "demo.html"
