"""docs/extending.md is followed literally; what comes out is what it says."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from blocks import ROOT, blocks, run_page

PAGE = ROOT / "docs" / "extending.md"


def _parameters(env: gym.Env, name: str) -> np.ndarray:
    env.reset(seed=0)
    return env.unwrapped.core.plant.parameters[name][0]  # type: ignore[attr-defined]


@pytest.mark.slow
def test_the_page_makes_what_it_says(workplace):
    names = run_page(PAGE, slow=False, smaller=False)
    assert names["leg_rate_reward"] < 0.0
    rows = [line for line in names["described"].splitlines() if line.startswith("side_speed") and "left, right" in line]
    assert [row.partition("  ")[0] for row in rows] == ["side_speed", *(f"side_speed, lag {k} (steps)" for k in (1, 2))]
    assert (names["env_id"], names["batch"].num_envs) == ("WLR-Spin-v0", 64)
    nominal = _parameters(gym.make("WLR-Velocity-v0", randomization="none"), "servo.stall_torque")
    for simulator in ("on_engine", "on_mujoco"):
        hot = _parameters(names[simulator], "servo.stall_torque")
        np.testing.assert_allclose(hot / nominal, [1, 1, 1, 1, 0.6, 0.6, 1, 1])
    with_xm430 = gym.make("WLR-Velocity-v0", robot="my_servos.yaml", randomization="none")
    np.testing.assert_allclose(_parameters(with_xm430, "servo.stall_torque"), [4.1] * 4 + [1.5] * 4)
    assert names["travelled"] == pytest.approx(1.0 * 3.0 * 0.034, rel=1e-6)
    assert (workplace / "out" / "calm" / "policy").is_dir()
    assert (workplace / "out" / "spin" / "policy").is_dir()


def test_each_addition_is_one_file():
    """A YAML file or a module; a task has a module besides, for the commands."""
    files = [block.words for block in blocks(PAGE) if block.mark == "file"]
    assert files == [
        "my_reward.py",
        "my_observation.py",
        "spin.yaml",
        "my_task.py",
        "my_effect.py",
        "my_servos.yaml",
        "my_plant.py",
    ]
