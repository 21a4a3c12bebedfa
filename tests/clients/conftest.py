"""Other people's code drives our environments.

These tests need packages that the library does not: they run in an environment of their own,
``pip install -e ".[train]" -r tests/clients/requirements.txt pytest`` and ``pytest tests/clients``. Where a package is absent
its tests are skipped, and say so.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import pytest

TASK = """
name: clients_spin
summary: Turn on the spot.
history: {v0: first version}
control_period: 0.02
episode_length: 1.0
action: {leg_scale: 0.4, wheel_scale: 6.0}
commands: {hold_time: [2.0, 4.0], terms: {yaw_rate: [-0.5, 0.5]}}
observations: {command: {}, gyro: {}, last_action: {}}
rewards: {track_yaw_rate: {weight: 1.0}}
"""
OWN_ID = "WLR-ClientsSpin-v0"
#: What a program writes before the ids of a module of its own; workers import it.
MODULE = "import pathlib\n\nimport wlr_gym\n\nwlr_gym.register_task(pathlib.Path(__file__).with_name('spin.yaml'))\n"


@pytest.fixture(params=["WLR-Velocity-v0", OWN_ID])
def env_id(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A shipped environment and one of a user's task, named as other libraries want it: with the module that registers it."""
    from wlr_gym.envs.registry import ENVIRONMENTS

    (tmp_path / "spin.yaml").write_text(TASK)
    (tmp_path / "clients_task.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))  # for processes that are started
    monkeypatch.chdir(tmp_path)
    yield "wlr_gym:WLR-Velocity-v0" if request.param == "WLR-Velocity-v0" else f"clients_task:{OWN_ID}"
    ENVIRONMENTS.pop(OWN_ID, None)
    gym.registry.pop(OWN_ID, None)
    __import__("sys").modules.pop("clients_task", None)
