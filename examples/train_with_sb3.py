"""Train with Stable-Baselines3 on 64 robots, with a callback that gathers finished episodes: a minute (``--quick``: seconds).

Prints the mean reward per step of each roll-out, and the number of finished episodes.

    python examples/train_with_sb3.py [--quick]
"""

import argparse

from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

import wlr_gym


class Watch(BaseCallback):
    """Counts finished episodes; prints the mean reward of each roll-out."""

    ended = 0

    def _on_step(self):
        self.ended += int(self.locals["dones"].sum())
        return True

    def _on_rollout_end(self):
        mean = self.locals["rollout_buffer"].rewards.mean()
        print(f"{self.num_timesteps} steps: mean reward {mean:.4f}, {self.ended} episodes ended")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one roll-out")
    steps = 2_048 if parser.parse_args().quick else 200_000
    env = wlr_gym.Sb3VecEnv("WLR-Velocity-v0", num_envs=64, seed=1)
    PPO("MlpPolicy", env, n_steps=32, batch_size=512, n_epochs=4, seed=1, device="cpu").learn(steps, callback=Watch())


if __name__ == "__main__":
    main()
