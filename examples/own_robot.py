"""Another robot from its file to the sim-to-real gap: 18 kg, legs of 0.3 m, wheels of 80 mm, servos of 24 V.

Task, training, tuned controller, evaluation, export, emulated deployment, recording and, without ``--quick``, the gap. Half an
hour on two cores (``--quick``: a minute or two, and no policy that can drive). Step by step: docs/own_robot.md.

    python examples/own_robot.py [--quick] [--out FOLDER]
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import wlr_gym
from wlr_gym.cli import main
from wlr_gym.policy import contract_of

FILES = Path(__file__).parent / "own_robot"
ROBOT, HARDWARE = str(FILES / "robot.yaml"), str(FILES / "hardware.yaml")
#: What the recorded robot has that its file does not say.
HIDDEN = """
effects:
  - name: rolling_resistance
    where: [wheel_lf, wheel_rf, wheel_lr, wheel_rr]
    parameters: {coefficient: 0.04}
"""


def wlr(*words: object) -> None:
    """Run a command of ``wlr``; end where it fails."""
    print("\n$ wlr", *words, flush=True)
    if code := main([str(word) for word in words]):
        sys.exit(code)


def go(out: Path, quick: bool) -> None:
    """Go the whole way in a folder."""
    steps, episodes = ("total_steps=32_768", 8) if quick else ("total_steps=4_000_000", 128)
    small = ("num_envs=64", "evaluate_every=0", "evaluation_episodes=8") if quick else ()
    blind = ("--config", "ppo_blind") if quick else ("--config", "ppo_slip_aware_no_camera")

    wlr("envs", "WLR-Velocity-v0", "--robot", ROBOT)
    policy = out / "policy_run"
    wlr("train", "WLR-Velocity-v0", *blind, "--robot", ROBOT, "--set", steps, *small, "--no-progress", "--out", policy)
    search = ("--set", "search.rounds=1", "search.episodes=8", "search.steps={yaw_rate_p: 2.0}") if quick else ()
    wlr("train", "WLR-Velocity-v0", "--agent", "pid", "--robot", ROBOT, *search, "--no-progress", "--out", out / "pid_run")
    # From here on nobody names the robot: what was trained with it finds it by itself.
    tuned = f"tuned_pid={out / 'pid_run'}"
    count = ("--episodes", episodes, "--no-progress")
    wlr("evaluate", f"mine={policy}", "--baselines", tuned, *count, "--out", out / "card")
    wlr("export", policy, "--out", out / "mine.onnx")
    seconds = ("--seconds", 1 if quick else 10)
    drive = ("--hardware", HARDWARE, "--emulated", "--stepped", "--yes", "--no-status", *seconds)
    wlr("deploy", out / "mine.onnx", *drive, "--out", out / "driven")
    (out / "hidden.yaml").write_text(HIDDEN, encoding="utf-8")
    motions = (
        ["straight"] if quick else ["straight", "turns", "stop_and_go", "random", "posture", "s_curve", "rear_legs", "all_legs"]
    )
    short = ("--seconds", 1.0) if quick else ()
    wlr(
        "record", "--backend", "mujoco", "--robot", ROBOT, "--effects", out / "hidden.yaml", "--excitation", *motions, *short,
        "--out", out / "runs",
    )  # fmt: skip
    wlr("replay", out / "runs", "--segment", 0.3, "--out", out / "replay")
    if not quick:
        wlr("gap", out / "runs", "--out", out / "gap")
    report(out, policy)


def report(out: Path, policy: Path) -> None:
    """Print where the robot went: one fingerprint in contract, policy file, log and runs."""
    contract = json.loads((policy / "policy" / "contract.json").read_text(encoding="utf-8"))["environment"]["robot"]
    exported = contract_of(out / "mine.onnx")["environment"]["robot"]
    metas = {name: wlr_gym.read_dataset(out / name).meta for name in ("driven", "runs")}
    print(f"\nrobot '{contract['name']}', fingerprint {contract['hash']}: in the run folder, in the policy file", end="")
    assert exported["hash"] == contract["hash"]
    for name, meta in metas.items():
        assert meta.robot_hash == contract["hash"], name
        print(f", in {name}/{meta.robot}", end="")
    print()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="every step in its shortest form, without the gap")
    parser.add_argument("--out", type=Path, help="folder of the results; default: a temporary one")
    chosen = parser.parse_args()
    if chosen.out is not None:
        go(chosen.out, chosen.quick)
    else:
        with tempfile.TemporaryDirectory() as folder:
            go(Path(folder), chosen.quick)
