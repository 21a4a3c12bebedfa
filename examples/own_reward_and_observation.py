"""A reward term and an observation of one's own: two functions of named signals, compiled with the task. Seconds once compiled.

Prints the new columns of the observation, and what the term was worth over some random steps.

    python examples/own_reward_and_observation.py [--quick]
"""

import argparse

import gymnasium as gym

import wlr_gym  # noqa: F401
from wlr_gym.envs.tasks import terms
from wlr_gym.envs.tasks.signals import Signals, Value, mean


@terms.registered(terms.REWARDS, speed=terms.POSITIVE)
def leg_rate(signals: Signals, *, speed: Value = 1.0) -> Value:
    """Mean squared leg rate over ``speed`` (rad/s)."""
    rates = [rate / speed for rate in signals.truth("joint_velocity")[:4]]
    return mean([rate * rate for rate in rates])


@terms.computed("left", "right", unit="rad/s", frame="joint", limit=20.0, estimated=True)
def side_speed(signals: Signals) -> list[Value]:
    """Mean wheel speed of each side, as the servos read it."""
    left_front, right_front, left_rear, right_rear = signals.sensors("joint_velocity")[4:]
    return [0.5 * (left_front + left_rear), 0.5 * (right_front + right_rear)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="ten steps instead of 250")
    steps = 10 if parser.parse_args().quick else 250
    task = {
        "rewards": {"leg_rate": {"weight": -0.2, "speed": 2.0}},
        "observations": {"side_speed": {"scale": 0.2, "history": 3}},
    }
    env = gym.make("WLR-Velocity-v0", task=task)
    env.reset(seed=0)
    env.action_space.seed(0)
    total = sum(env.step(env.action_space.sample())[-1]["reward_terms"]["leg_rate"] for _ in range(steps))
    described = env.unwrapped.describe()  # type: ignore[attr-defined]
    print("\n".join(line for line in described.splitlines() if "side_speed" in line))
    print(f"leg_rate over {steps} random steps: {total:.4f}")


if __name__ == "__main__":
    main()
