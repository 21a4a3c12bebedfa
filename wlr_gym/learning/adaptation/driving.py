"""Steps in which the robot drives: the task before, the excitations, and the task again, old policy beside new."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import write_json
from wlr_gym.data.excitations import excite
from wlr_gym.data.read import Run, read_dataset, read_run, run_files
from wlr_gym.data.replay import robot_of
from wlr_gym.learning.adaptation.plan import AdaptStep, Asked, Progress
from wlr_gym.learning.adaptation.robots import AdaptedRobot, excite_robot, interrupted
from wlr_gym.learning.evaluation.robot_episodes import RobotEpisode, drive_episode
from wlr_gym.learning.evaluation.scoring import evaluate
from wlr_gym.learning.evaluation.statistics import Bootstrap, Estimate
from wlr_gym.robot import Robot, robot_hash

Array = NDArray[np.float64]

#: Seeds of the episodes before and after: no episode is driven twice, and none is met in training or acceptance.
BEFORE, AFTER = 300_000, 400_000
#: s; shorter runs say nothing.
SHORTEST = 3.0
_NO_ROBOT = "No robot to drive: measured runs were given."


def drive_before(progress: Progress, robot: AdaptedRobot | None) -> AdaptStep:
    """Drive the task with the old policy; in simulation the same commands on the model as its file has it."""
    asked = progress.asked
    if robot is None:
        return AdaptStep(outcome="left out", said=(_NO_ROBOT,))
    seeds = seeds_of(BEFORE, asked)
    driven = episodes_of(progress, "before", {"old": asked.policy}, robot, seeds)["old"]
    model = on_the_model(progress, seeds)
    errors = errors_of(driven)
    lost = paired(errors, np.full(len(errors), model))
    said = f"Tracking error on the robot {errors.mean():.3f}, of the model as its file has it {model:.3f}."
    return AdaptStep(
        said=(said, *stops(driven)),
        driving=sum(one.seconds for one in driven),
        command=_deploy_command(asked.policy, progress, seeds[0]),
        numbers={"old": errors.tolist(), "model": model, "lost_percent": 100.0 * (errors.mean() / model - 1.0)}
        | {"lost_ci95": [-lost.high, -lost.low]},
    )


def drive_after(progress: Progress, robot: AdaptedRobot | None, kept: str) -> AdaptStep:
    """Drive fresh episodes with the old policy and the kept one, in turns."""
    asked = progress.asked
    if robot is None:
        return AdaptStep(outcome="left out", said=(_NO_ROBOT, f"To drive it: wlr deploy {kept}"))
    if kept == asked.policy:
        return AdaptStep(outcome="left out", said=("The old policy is kept: there is nothing new to drive.",))
    seeds = seeds_of(AFTER, asked)
    driven = episodes_of(progress, "after", {"old": asked.policy, "new": kept}, robot, seeds)
    old, new = errors_of(driven["old"]), errors_of(driven["new"])
    model, gain = on_the_model(progress, seeds), paired(new, old)
    regained = 100.0 * (old.mean() - new.mean()) / (old.mean() - model) if old.mean() > model else float("nan")
    said = f"Tracking error on fresh episodes {old.mean():.3f} with the old policy, {new.mean():.3f} with the new one: "
    said += f"{gain.mean:.0f} % [{gain.low:.0f}, {gain.high:.0f}] better."
    return AdaptStep(
        said=(said, *stops([*driven["old"], *driven["new"]])),
        driving=sum(one.seconds for both in driven.values() for one in both),
        command=_deploy_command(kept, progress, seeds[0]),
        numbers={"old": old.tolist(), "new": new.tolist(), "model": model, "better_percent": gain.mean}
        | {"better_ci95": [gain.low, gain.high], "regained_percent": regained if np.isfinite(regained) else None},
    )


def record_runs(progress: Progress, robot: AdaptedRobot | None, own: Robot) -> AdaptStep:
    """Drive the excitations, or check the runs that were given.

    Raises:
        InputError: runs of another robot, or none.
    """
    asked = progress.asked
    if asked.robot_runs is not None:
        return check_runs(Path(asked.robot_runs), own)
    assert robot is not None
    folder = progress.folder("runs")
    noted = folder / "driven.json"
    done: dict[str, Any] = json.loads(noted.read_text(encoding="utf-8")) if noted.is_file() else {}
    for path in run_files(folder):  # that of a drive that was killed is not noted
        if path.name not in {one["run"] for one in done.values()}:
            path.unlink()
    for number, name in enumerate(asked.excitations):
        if name in done:
            continue
        progress.tell(f"robot: {name}", number / len(asked.excitations))
        recorded = excite_robot(robot, excite(name, asked.seed, own), folder, asked.seed + number)
        seconds, kept = 0.0, ""
        if recorded.run is not None:
            seconds = _seconds(read_run(recorded.run))
            if seconds < SHORTEST:
                recorded.run.unlink()
            else:
                kept = recorded.run.name
        done[name] = {"run": kept, "seconds": seconds, "stopped": recorded.reason}
        write_json(noted, done)
    stopped = [f"The supervision stopped '{name}': {one['stopped']}" for name, one in done.items() if one["stopped"]]
    kept = [name for name, one in done.items() if one["run"]]
    return AdaptStep(
        said=(f"{len(kept)} of {len(done)} excitations left a run: {', '.join(kept) or 'none'}.", *stopped),
        driving=sum(one["seconds"] for one in done.values()),
        command=f"wlr record --excitation {' '.join(asked.excitations)} --out {folder}{_emulated_words(progress)}",
    )


def check_runs(folder: Path, own: Robot) -> AdaptStep:
    """Read the runs that were given; errors as of :func:`record_runs`."""
    runs = read_dataset(folder).runs
    for run in runs:
        measured = robot_of(run)
        if robot_hash(measured) != robot_hash(own):
            raise InputError(
                f"{run.path}: of robot '{measured.name}' ({robot_hash(measured)}), and the policy is made for '{own.name}' "
                f"({robot_hash(own)}); expected runs of the policy's robot"
            )
    seconds = sum(map(_seconds, runs))
    return AdaptStep(said=(f"{len(runs)} measured runs were given, {seconds:.0f} s in all.",), driving=seconds)


def _seconds(run: Run) -> float:
    return float(run["t"][-1] - run["t"][0])


# ---- episodes --------------------------------------------------------------------------------------------------------


def seeds_of(first: int, asked: Asked) -> list[int]:
    """Return the seeds of the episodes that are driven, from ``BEFORE`` or ``AFTER`` on."""
    return [first + 1000 * asked.seed + k for k in range(asked.drives)]


def episodes_of(
    progress: Progress, step: str, policies: Mapping[str, str], robot: AdaptedRobot, seeds: Sequence[int]
) -> dict[str, list[RobotEpisode]]:
    """Drive episodes with policies in turns; those that the step's folder has are not driven again.

    Raises:
        KeyboardInterrupt: somebody stopped the robot.
    """
    asked, path = progress.asked, progress.folder(step) / "episodes.json"
    content = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    done = {name: [RobotEpisode(**one) for one in content.get(name, [])] for name in policies}
    total = len(seeds) * len(policies)
    for seed in seeds:
        for name, policy in policies.items():
            if seed in [one.seed for one in done[name]]:
                continue
            progress.tell(f"robot: episode {seed} with the {name} policy", sum(map(len, done.values())) / total)
            episode = drive_episode(asked.environment, policy, robot, seed, asked.drive_seconds)
            if interrupted(episode.reason):
                raise KeyboardInterrupt(episode.reason)
            done[name].append(episode)
            write_json(path, {key: [asdict(one) for one in several] for key, several in done.items()})
    return done


def on_the_model(progress: Progress, seeds: Sequence[int]) -> float:
    """Return the old policy's tracking error in simulation, on the robot as its file has it, with the same commands."""
    asked = progress.asked
    card = evaluate(
        asked.policy,
        asked.environment,
        baselines=(),
        episodes=len(seeds),
        seed=seeds[0],
        randomization="none",
        sensors=asked.sensors,
    )
    return float(card.scores["main"][card.names[0]]["tracking_error"].mean)


def errors_of(episodes: Sequence[RobotEpisode]) -> Array:
    """Return the tracking errors (N,)."""
    return np.array([one.tracking_error for one in episodes])


def paired(ours: Array, theirs: Array) -> Estimate:
    """Return by how much ours is better, % of theirs, with its interval over the episodes."""
    return Bootstrap(1, len(ours)).reduction(_pairs(ours), _pairs(theirs))


def share_regained(old: Array, new: Array, best: Array) -> Estimate:
    """Return (old - new) / (old - best), %, with its interval over the episodes."""
    pairs = [_pairs(errors) for errors in (old, old, new, best)]
    return Bootstrap(1, len(old)).share(*pairs, subjects=(0, 0, 1, 2))


def _pairs(errors: Array) -> Array:
    return np.stack([errors, np.ones(len(errors))], axis=1)[None]


def stops(episodes: Sequence[RobotEpisode]) -> tuple[str, ...]:
    """Return why episodes ended early, in sentences."""
    return tuple(f"Episode {one.seed} ended after {one.seconds:.1f} s: {one.reason}." for one in episodes if not one.whole)


def _deploy_command(policy: str, progress: Progress, seed: int) -> str:
    asked = progress.asked
    stepped = " --stepped" if asked.driven == "emulated" else ""
    return f"wlr deploy {policy}{_emulated_words(progress)}{stepped} --seconds {asked.drive_seconds:g} --seed {seed}"


def _emulated_words(progress: Progress) -> str:
    asked = progress.asked
    if asked.driven != "emulated":
        return ""
    return " --emulated" + (f" --effects {progress.out / 'hidden.yaml'}" if asked.effects else "")
