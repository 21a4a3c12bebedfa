"""From bags to a gap report: ``report_on`` is all of it. Three minutes (``--quick``: imports only, some seconds).

Give bags of your robot (.mcap, .db3, .bag, folders of rosbag2, CSV), and a map of what their fields mean (docs/own_logs.md):
``wlr import BAG --suggest`` writes one that asks what names leave open. Without any, bags of a simulated robot are made.

    python examples/bag_to_gap.py [BAG ... --map map.yaml] [--quick]
"""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import wlr_gym
from wlr_gym.cli import main as wlr
from wlr_gym.data.logs import import_log

FAULT = """
effects:
  - name: rolling_resistance
    where: [wheel_lf, wheel_rf, wheel_lr, wheel_rr]
    parameters: {coefficient: 0.05}
"""


def report_on(bags: Sequence[Path], folder: Path, map_file: Path | None = None) -> None:
    for bag in bags:
        import_log(bag, folder / "runs", map_file)
    result = wlr_gym.analyse(folder / "runs", folder / "report", threads=2)
    print(f"{result.verdict}: {', '.join(effect.name for effect in result.effects)}; {folder / 'report' / 'report.html'}")


def made_bags(folder: Path, motions: Sequence[str]) -> list[Path]:
    fault = folder / "fault.yaml"
    fault.write_text(FAULT, encoding="utf-8")
    wlr(["record", "--backend", "mujoco", "--effects", str(fault), "--excitation", *motions, "--out", str(folder / "driven")])
    wlr(["export", str(folder / "driven"), "--to", "rosbag2", "--out", str(folder / "bags")])
    return sorted((folder / "bags").iterdir())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bags", nargs="*", type=Path)
    parser.add_argument("--map", type=Path, help="what topics and fields mean")
    parser.add_argument("--quick", action="store_true", help="a made bag, imported and not analysed")
    options = parser.parse_args()
    if options.bags:
        report_on(options.bags, Path("from_bags"), options.map)
        return
    with tempfile.TemporaryDirectory() as name:
        if options.quick:
            (bag,) = made_bags(Path(name), ["straight"])
            (run,) = import_log(bag, Path(name) / "runs")
            print(f"imported: {run.source} as {run.path.name}")
        else:
            motions = ["straight", "turns", "stop_and_go", "random", "posture", "s_curve", "rear_legs", "all_legs"]
            report_on(made_bags(Path(name), motions), Path(name))


if __name__ == "__main__":
    main()
