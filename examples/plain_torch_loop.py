"""A training loop without a library: 512 robots in float32, a small network, REINFORCE with a baseline.

A minute (``--quick``: seconds).

Prints environment steps per second, and the mean reward of a step and tracking error of the episodes that ended.

    python examples/plain_torch_loop.py [--quick]
"""

import argparse
import time

import gymnasium as gym
import torch

import wlr_gym  # noqa: F401

ROBOTS, STEPS, DISCOUNT = 512, 50, 0.97


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two updates instead of 60")
    updates = 2 if parser.parse_args().quick else 60
    torch.manual_seed(0)
    env = gym.make_vec("WLR-Velocity-v0", num_envs=ROBOTS, precision="float32", episode_length=4.0, autoreset_mode="SameStep")
    width = env.single_observation_space.shape[0]  # type: ignore[index]
    policy = torch.nn.Sequential(torch.nn.Linear(width, 64), torch.nn.Tanh(), torch.nn.Linear(64, 8), torch.nn.Tanh())
    optimiser = torch.optim.Adam(policy.parameters(), 3e-3)
    observation, _ = env.reset(seed=0)
    begin = time.perf_counter()
    for update in range(1, updates + 1):
        log_probabilities, rewards, errors = [], [], []
        for _ in range(STEPS):
            spread = torch.distributions.Normal(policy(torch.from_numpy(observation)), 0.3)
            action = spread.sample()
            observation, reward, _, _, infos = env.step(action.clamp(-1, 1).numpy())
            log_probabilities.append(spread.log_prob(action).sum(-1))
            rewards.append(torch.from_numpy(reward))
            if "final_info" in infos:
                errors += infos["final_info"]["episode_measures"]["tracking_error"][infos["_final_info"]].tolist()
        returns = [torch.zeros(ROBOTS)]
        for reward in reversed(rewards):
            returns.append(reward + DISCOUNT * returns[-1])
        gain = torch.stack(returns[:0:-1])
        gain = (gain - gain.mean(1, keepdim=True)) / (gain.std() + 1e-8)
        optimiser.zero_grad()
        (-torch.stack(log_probabilities) * gain).mean().backward()
        optimiser.step()
        if update == updates or update % 10 == 0:
            rate = update * ROBOTS * STEPS / (time.perf_counter() - begin)
            ended = f", tracking error of {len(errors)} episodes {sum(errors) / len(errors):.2f}" if errors else ""
            print(f"{rate:.0f} steps/s, mean reward {torch.stack(rewards).mean():.4f}{ended}")


if __name__ == "__main__":
    main()
