"""Drive the emulated robot with a shipped policy: the real servo protocol, in emulated time. Some seconds once compiled.

Writes the run it logs; prints its length, columns and the command that compares it with the simulator.

    python examples/deploy_emulated.py [--quick] [--out FOLDER]
"""

import argparse
import sys
import tempfile
from pathlib import Path

import wlr_gym
from wlr_gym.cli import main as wlr


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="1 s instead of 10 s")
    parser.add_argument("--out", type=Path, help="folder of the run; default: a temporary one")
    chosen = parser.parse_args()
    folder, seconds = chosen.out or Path(tempfile.mkdtemp()) / "robot", "1" if chosen.quick else "10"
    words = ["velocity_blind", "--emulated", "--stepped", "--seconds", seconds, "--yes", "--no-status", "--out", str(folder)]
    if code := wlr(["deploy", *words]):
        sys.exit(code)
    for run in wlr_gym.read_dataset(folder).runs:
        print(f"{run.path}: {len(run.table)} rows, {run.table.shape[1]} columns")
    print(f"wlr replay {folder} --out REPLAYED")


if __name__ == "__main__":
    main()
