"""Find what the model lacks, from measured runs: here runs of a simulated robot with a fault. Three minutes (``--quick``: two).

A folder of CSV files in the measured-run format is all that is needed (docs/run_format.md). The runs are recorded on MuJoCo
with a rolling resistance; the workflow fits the engine to them. Prints the verdict, and the effects with their sizes.

    python examples/gap_on_own_runs.py [--quick]
"""

import argparse
import tempfile
from pathlib import Path

import wlr_gym
from wlr_gym.cli import main as wlr

FAULT = """
effects:
  - name: rolling_resistance
    where: [wheel_lf, wheel_rf, wheel_lr, wheel_rr]
    parameters: {coefficient: 0.05}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="four runs instead of eight, which may not decide it")
    quick = parser.parse_args().quick
    motions = ["straight", "turns", "stop_and_go", "random"]
    if not quick:
        motions += ["posture", "s_curve", "rear_legs", "all_legs"]
    with tempfile.TemporaryDirectory() as folder:
        fault = Path(folder) / "fault.yaml"
        fault.write_text(FAULT, encoding="utf-8")
        runs = Path(folder) / "runs"
        wlr(["record", "--backend", "mujoco", "--effects", str(fault), "--excitation", *motions, "--out", str(runs)])
        result = wlr_gym.analyse(runs, threads=2)
    print(f"verdict: {result.verdict}")
    for effect in result.effects:
        for name, found in effect.parameters.items():
            print(f"{effect.name}, {', '.join(effect.where)}: {name} = {found.value:.3f} [{found.low:.3f}, {found.high:.3f}]")


if __name__ == "__main__":
    main()
