"""What trials of the sweeps' tests import: a task of short episodes, a training that waits in mid-run, the tests' kernels."""

import os
import tempfile
import time
from pathlib import Path

from shared_kernels import GibbsAppellPlant, choose_shared

import wlr_gym
from wlr_gym.base.paths import find_config
from wlr_gym.base.provenance import write_yaml
from wlr_gym.base.settings import read_yaml

with tempfile.TemporaryDirectory() as folder:  # episodes so short that scores on held-out ones take no time
    task = read_yaml(find_config("task", "velocity")) | {"name": "brief", "history": {"v0": "first"}, "episode_length": 0.4}
    write_yaml(Path(folder) / "brief.yaml", task)
    wlr_gym.register_task(Path(folder) / "brief.yaml")
#: As long as this file exists, a training waits at each checkpoint until it is asked to stop.
HOLD = Path(os.environ.get("SWEEP_HOLD", "no such file"))


def wait_at_checkpoints() -> None:
    from wlr_gym.learning.ppo import training

    asked: list[int] = []
    take, save = training.StopRequest._take, training.TrainingLog.save_checkpoint

    def take_and_note(self, number, frame):
        asked.append(number)
        take(self, number, frame)

    def save_and_wait(self):
        place = save(self)
        while HOLD.is_file() and not asked:
            time.sleep(0.02)
        return place

    training.StopRequest._take, training.TrainingLog.save_checkpoint = take_and_note, save_and_wait


GibbsAppellPlant._choose_kernel = choose_shared
if HOLD.is_file():
    wait_at_checkpoints()
