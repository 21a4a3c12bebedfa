"""A folder of runs to Foxglove, PlotJuggler and ROS: ``to_mcap`` is all of it. Some seconds.

Give a folder of measured or simulated runs (docs/run_format.md); each becomes an ``.mcap`` file, which Foxglove opens: the
robot and arrows of slip in a 3D panel (``/robot_description``, ``/tf``, ``/slip``; fixed frame ``floor``), any channel in a
plot (``/joint_states.velocity[4]``). Without a folder, a simulated run is made; ``--quick`` leaves nothing of it.

    python examples/run_to_foxglove.py [FOLDER] [--quick]
"""

import argparse
import tempfile
from pathlib import Path

from wlr_gym.cli import main as wlr
from wlr_gym.data import read_dataset
from wlr_gym.data.logs import export_run


def to_mcap(folder: Path, out: Path) -> None:
    out.mkdir(exist_ok=True)
    for run in read_dataset(folder).runs:
        print(f"written: {export_run(run, out / f'{run.name}.mcap')}: {run['t'][-1]:.0f} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--quick", action="store_true", help="a made run, and nothing is left of it")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        folder = options.folder or Path(made) / "runs"
        if options.folder is None:
            wlr(["record", "--backend", "mujoco", "--excitation", "turns", "--out", str(folder)])
        to_mcap(folder, Path(made) / "mcap" if options.quick else Path("mcap"))


if __name__ == "__main__":
    main()
