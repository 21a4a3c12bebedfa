"""An effect of one's own: a hot winding weakens a motor. It acts in both simulators: some seconds once compiled.

Prints how fast the robot drives at full wheel command, with nominal motors and with two hot ones, in each simulator.

    python examples/own_effect.py [--quick]
"""

import argparse

import gymnasium as gym
import numpy as np

import wlr_gym
from wlr_gym.physics.effects import EFFECTS, EffectParameter
from wlr_gym.physics.effects.effect import multiply
from wlr_gym.robot import JOINTS

EFFECTS["hot_winding"] = wlr_gym.Effect(
    name="hot_winding",
    doc="a hot motor: its winding's resistance is higher",
    equation="stall torque = scale x nominal",
    where=JOINTS,
    parameters={"scale": EffectParameter("-", "cold over hot resistance", 0.2, 1.0, 1.0, (0.6, 1.0), 0.7)},
    apply=multiply("servo.stall_torque", "scale"),
    stage="scale",
)
HOT = {"name": "hot_winding", "where": ["wheel_lf", "wheel_rf"], "parameters": {"scale": 0.3}}


def travelled(steps, **options):
    """Return how far (m) the robot drives forward."""
    env = gym.make("WLR-Velocity-v0", randomization="none", truth_info=True, **options)
    env.reset(seed=0)
    forward = np.array([0, 0, 0, 0, 1, 1, 1, 1], dtype=np.float32)
    infos = [env.step(forward)[-1] for _ in range(steps)]
    return infos[-1]["truth"]["position"][0]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="0.2 s instead of 2 s")
    steps = 10 if parser.parse_args().quick else 100
    for backend in ("gibbs_appell", "mujoco"):
        cold, hot = travelled(steps, backend=backend), travelled(steps, backend=backend, effects=HOT)
        print(f"{backend}: {cold:.4f} m in {0.02 * steps:g} s, with hot front motors {hot:.4f} m")


if __name__ == "__main__":
    main()
