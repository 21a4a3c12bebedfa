"""Train a policy, score it against controllers on the same episodes: two minutes of training (``--quick``: seconds).

Prints the tracking error of the policy and of each baseline (1 = the limit of success).

    python examples/first_policy.py [--quick] [--out FOLDER]
"""

import argparse
import tempfile
from pathlib import Path

import wlr_gym


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a training too short to learn anything, two episodes")
    parser.add_argument("--out", type=Path, help="run folder, empty or absent; default: a temporary one")
    chosen = parser.parse_args()
    settings = {"total_steps": 16_384} if chosen.quick else {}
    folder = chosen.out or Path(tempfile.mkdtemp()) / "first"
    policy = wlr_gym.train("WLR-Velocity-v0", folder, settings=settings, seed=1)
    card = wlr_gym.evaluate(policy, episodes=2 if chosen.quick else 64)
    for name, scores in card.scores["main"].items():
        print(f"{name}: tracking error {scores['tracking_error'].mean:.3f}")
    print(f"policy: {policy}")


if __name__ == "__main__":
    main()
