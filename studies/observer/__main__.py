"""``python -m studies.observer train MINUTES`` and ``accuracy``: train the observer's network, measure its errors."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``python -m studies.observer``."""
    parser = argparse.ArgumentParser("python -m studies.observer", description="The slip observer's training and accuracy.")
    commands = parser.add_subparsers(dest="command", required=True)
    train = commands.add_parser("train", help="train how far the observer trusts each wheel; replaces the package's trust.npz")
    train.add_argument("minutes", type=float, help="how long")
    train.add_argument("--start", type=Path, help="trust.npz to begin with; default: random weights")
    accuracy = commands.add_parser("accuracy", help="errors on many floors, four minutes; prints a table")
    accuracy.add_argument(
        "--data", type=Path, help="file (.json) for all numbers; that of the documentation: docs/data/observer.json"
    )
    accuracy.add_argument("--figure", type=Path, help="picture of an estimate beside the truth")
    given = parser.parse_args(arguments)
    if given.command == "train":
        from studies.observer.training import train_network

        train_network(given.minutes, given.start)
    else:
        from studies.observer.accuracy import measure_accuracy

        measure_accuracy(given.data, given.figure)


if __name__ == "__main__":
    main()
