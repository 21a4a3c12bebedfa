"""A task of one's own is data: here, turning on the spot. Registers it and steps 64 robots of it: some seconds once compiled.

Prints the id, the size of the observation, and the mean reward of a step at random actions.

    python examples/own_task.py [--quick]
"""

import argparse
import tempfile
from pathlib import Path

import gymnasium as gym

import wlr_gym

TASK = """
name: spin
summary: Turn on the spot at a commanded rate.
history: {v0: first version}
randomization: slippery
control_period: 0.02
episode_length: 5.0
action: {leg_scale: 0.4, wheel_scale: 6.0}
commands: {hold_time: [2.0, 4.0], terms: {yaw_rate: [-0.3, 0.3]}}
observations: {command: {}, wheel_velocity: {scale: 0.2}, gyro: {}, last_action: {}}
rewards: {track_yaw_rate: {weight: 1.0, width: 0.2}, slip: {weight: -0.2}}
terminations: {tilt: {}}
measures: {yaw_rate_error: {}, slip_speed: {}}
success: {yaw_rate_error: {rms: 0.06}}
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="ten steps instead of 250")
    steps = 10 if parser.parse_args().quick else 250
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "spin.yaml"
        file.write_text(TASK, encoding="utf-8")
        env_id = wlr_gym.register_task(file)
    env = gym.make_vec(env_id, num_envs=64)
    env.reset(seed=0)
    env.action_space.seed(0)
    rewards = [env.step(env.action_space.sample())[1].mean() for _ in range(steps)]
    print(f"{env_id}: {env.single_observation_space.shape} observations, mean reward {sum(rewards) / steps:.4f}")


if __name__ == "__main__":
    main()
