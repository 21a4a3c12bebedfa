"""Write a trained policy as one file: ONNX with its contract inside. It runs wherever a policy is named, without torch.

With --to, write measured runs as MCAP files or as rosbag2, which Foxglove, PlotJuggler and ROS open and wlr import reads back.
"""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import make_output_folder, refuse_existing, require_ending
from wlr_gym.base.provenance import PROVENANCE_FILE
from wlr_gym.base.settings import read_yaml
from wlr_gym.cli import OK
from wlr_gym.cli.options import ForceOption, JsonOption, environment_of, refuse_given
from wlr_gym.cli.terminal import print_json
from wlr_gym.envs.registry import task_name_of
from wlr_gym.policy import (
    Parity,
    export_policy,
    exportable,
    fed_environment,
    find_policy,
    load_agent_config,
    make_policy,
    policy_environment,
    shipped_names,
    write_model_card,
)

#: Episodes whose observations are compared, and their length, s.
ROBOTS = 16
SECONDS = 4.0
#: Options of ``wlr train`` that say where and how it ran, not what it did.
ELSEWHERE = ("--out", "--resume", "--max-minutes")


@dataclass(frozen=True)
class ExportOptions(JsonOption, ForceOption):
    policy: tyro.conf.Positional[tuple[str, ...]] = ()
    """Policy folder, run folder, or archive of Stable-Baselines3 (.zip, with --env); with --card: policy file, or name of a
    shipped policy; with --to: runs, or folders of runs."""
    out: Path | None = None
    """The file; default: policy.onnx. With --to: the folder; default: where each run is."""
    to: Literal["mcap", "rosbag2"] | None = None
    """Instead, write runs in this format: run_01.mcap, or run_01 as a folder."""
    card: Path | None = None
    """Folder that wlr evaluate --out has written: instead, write the model card beside the policy file."""
    env: str | None = None
    """Of an archive: id of the environment that it was trained in."""
    config: str | None = None
    """Of an archive: settings in configs/agent/, or a path, whose environment has the observations of its training."""
    normalizer: Path | None = None
    """Of an archive: saved VecNormalize that its observations went through."""
    robot: str | None = None
    """Of an archive: robot of the training: robot file, or name in configs/robot/; default: the task's. Other policies carry
    their robot."""


def run(options: ExportOptions) -> int:
    """Export and compare, or write the card; say what was written."""
    found = _do(options)
    if options.json:
        print_json(found)
    return OK


def _do(options: ExportOptions) -> Any:
    """Do it, say so, and return what came of it."""
    if options.to is not None:
        return _export_runs(options, options.to)
    if len(options.policy) != 1:
        raise InputError(f"expected one policy, got {len(options.policy)}")
    if options.policy[0].endswith(".zip"):
        return _import(options)
    refuse_given(options, ("robot",), "of archives (.zip) only; other policies carry the robot of their training")
    refuse_given(options, ("env", "config", "normalizer"), "of archives (.zip) only; other policies say themselves")
    if options.card is None:
        return _export(options)
    if options.out is None:
        return _write_card(options.policy[0], options.card, options.force)
    raise InputError("--card and --out: one or the other; a card is written beside its policy file")


def _target(options: ExportOptions) -> Path:
    """Return the file to write."""
    out = options.out or Path("policy.onnx")
    require_ending(out, (".onnx",))
    refuse_existing(out, options.force)
    return out


def _export_runs(options: ExportOptions, form: str) -> list[Path]:
    from wlr_gym.data.logs import export_run
    from wlr_gym.data.logs.messages import FORMATS
    from wlr_gym.data.runs import read_run, some_runs

    refuse_given(options, ("card", "env", "config", "normalizer", "robot"), f"it is of policies; --to {form} writes runs")
    paths = [run for name in map(Path, options.policy) for run in (some_runs(name) if name.is_dir() else [name])]
    if not paths:
        raise InputError("--to: expected runs, or folders of runs")
    targets = [(options.out or path.parent) / f"{path.stem}{FORMATS[form]}" for path in paths]
    _check_targets(paths, targets, options.force)
    if options.out is not None:
        make_output_folder(options.out)
    for path, target in zip(paths, targets, strict=True):
        run = read_run(path)  # one that cannot be read leaves the target as it was
        if target.is_dir():
            shutil.rmtree(target)  # rosbag2 is a folder; a file is replaced in one step
        print(f"written: {export_run(run, target, form)}")
    return targets


def _check_targets(paths: Sequence[Path], targets: Sequence[Path], force: bool) -> None:
    """Refuse runs that would go to one place, or over what is there."""
    taken: dict[Path, Path] = {}
    for path, target in zip(paths, targets, strict=True):
        if target in taken:
            raise InputError(f"{path} and {taken[target]}: both would be {target}: export them to folders of their own (--out)")
        refuse_existing(target, force)
        taken[target] = path


def _export(options: ExportOptions) -> dict[str, Any]:
    out, folder = _target(options), exportable(options.policy[0])
    make_output_folder(out.parent)
    print(f"exporting {options.policy[0]}, then comparing: some seconds", flush=True)
    parity = export_policy(folder, out, real_observations(folder), training_facts(folder))
    return _written(out, parity, "policy", f"{ROBOTS} episodes")


def _written(out: Path, parity: Parity, original: str, real: str) -> dict[str, Any]:
    """Say that a policy file is written, and how exactly it answers as what it was made of; return both."""
    print(
        f"written: {out} ({out.stat().st_size / 1000:.0f} kB)\n"
        f"answers as the {original} does: actions differ by at most {parity.random:.1e} on random observations, "
        f"{parity.real:.1e} on those of {real}"
    )
    return {"policy": out, "parity": parity}


def _import(options: ExportOptions) -> dict[str, Any]:
    import gymnasium

    from wlr_gym.learning.foreign import import_policy

    if options.env is None:
        raise InputError(f"{options.policy[0]}: an archive does not say what it was trained in: give --env ID")
    settings = load_agent_config(options.config, (), task_name_of(options.env)) if options.config else {}
    out = _target(options)
    make_output_folder(out.parent)
    env = gymnasium.make(options.env, robot=options.robot, **fed_environment(settings.get("environment") or {}))
    parity = import_policy(options.policy[0], env, out, normalizer=options.normalizer)
    return _written(out, parity, "archive", "robots that it drives")


def _write_card(source: str, evaluation: Path, force: bool) -> dict[str, Any]:
    policy = find_policy(source)
    for name in ("card.json", "card.md"):
        if not (evaluation / name).is_file():
            raise InputError(f"--card {evaluation}: no {name}; expected a folder that wlr evaluate --out wrote")
    if source in shipped_names() and not force:
        raise InputError(f"--card: the shipped policy '{source}' has its model card: {policy.with_suffix('.md')}")
    refuse_existing(policy.with_suffix(".md"), force, "--card")
    text = (evaluation / "card.md").read_text(encoding="utf-8")
    card = write_model_card(policy, text)
    print(f"written: {card}")
    return {"card": card}


def real_observations(source: Path) -> NDArray[np.float32]:
    """Return the observations (M, D) of a policy that drives robots in the environment it was trained in."""
    from wlr_gym.learning.evaluation.rollout import make_core, seen_observations

    with closing(make_core(environment_of(None, source), ROBOTS, policy_environment(source))) as core:
        return seen_observations(core, make_policy(source, core.contract()), SECONDS)


def training_facts(folder: Path) -> dict[str, Any]:
    """Return what the run folder around a policy says of its training, as far as it does: command, git commit, wall time."""
    from wlr_gym.learning.curves import read_curve, wall_time

    facts: dict[str, Any] = {}
    origin, curve = folder.parent / PROVENANCE_FILE, folder.parent / "learning_curve.csv"
    if origin.is_file():
        saved = read_yaml(origin) or {}
        facts |= {"command": portable(saved.get("command", "")), "git_commit": saved.get("git_commit")}
    if curve.is_file() and (rows := read_curve(curve)):
        facts["seconds"] = wall_time(rows)
    return facts


def portable(command: str) -> str:
    """Return a ``wlr train`` command without its output folder and the like, which belong to the machine it ran on."""
    words = iter(shlex.split(command))
    kept = []
    for word in words:
        if word in ELSEWHERE:
            next(words, None)
        elif word != "--no-progress" and not word.startswith(tuple(f"{option}=" for option in ELSEWHERE)):
            kept.append(word)
    return shlex.join(kept)
