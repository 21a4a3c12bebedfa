"""Train an agent on an environment. Ctrl-C saves a checkpoint; --resume continues from the newest one."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from wlr_gym.base.errors import InputError, Interval
from wlr_gym.base.provenance import CONFIG_FILE
from wlr_gym.base.settings import read_yaml
from wlr_gym.base.text import quoted
from wlr_gym.cli import OK
from wlr_gym.cli.options import FloorOption, JsonOption, PatchOption, ProgressOption, Seed, environment_of, refuse_given
from wlr_gym.cli.terminal import print_json
from wlr_gym.envs.registry import task_name_of
from wlr_gym.learning.training import recipe_of, resume_training, run_training, settings_of
from wlr_gym.policy import Training, TrainingProgress, find_policy


@dataclass(frozen=True)
class TrainOptions(ProgressOption, JsonOption, PatchOption, FloorOption):
    env: tyro.conf.Positional[str | None] = None
    """Environment id (see: wlr envs); default: that of --init, else WLR-Velocity-v0."""
    agent: str = "ppo"
    """Agent to train: a folder of agents/."""
    config: str | None = None
    """Settings of the agent: name in configs/agent/ or path of a YAML file; default: of ppo on the tasks that ship those of the
    shipped policies (ppo_slip_aware; with --robot ppo_slip_aware_no_camera), else the agent's own. Plain PPO: ppo."""
    set: tuple[str, ...] = ()
    """Settings to change, as key=value: --set total_steps=20_000_000 environment.randomization=wide"""
    backend: str | None = None
    """Simulator: gibbs_appell or mujoco (with --set environment.precision=float64); default: that of the settings."""
    robot: str | None = None
    """Robot file, or name in configs/robot/; default: that of the settings, else the task's. The run folder has its content."""
    seed: Seed | None = None
    """Seed of everything random; default: that of the settings."""
    out: Path | None = None
    """Run folder; default: runs_out/<env>_<config or agent>_<seed>."""
    init: str | None = None
    """Trained policy to start from: run or policy folder, policy file or shipped policy. Its settings hold without --config."""
    resume: Path | None = None
    """Run folder to resume; its own environment, agent and settings are used."""
    total_steps: int | None = None
    """With --resume: go on until so many environment steps, at the rate at which the run's schedule ended."""
    max_minutes: Annotated[float, Interval("min", above=0.0)] | None = None
    """Stop in good order after this time."""


def run(options: TrainOptions) -> int:
    """Train and print where the policy is."""
    seconds = None if options.max_minutes is None else 60.0 * options.max_minutes
    updates: deque[TrainingProgress] = deque(maxlen=1)
    if options.resume is not None:
        own = ("env", "out", "config", "seed", "backend", "robot", "init", "set", "effects", "floor")
        refuse_given(options, own, "--resume uses the settings of the run folder: leave it out")
        policy = resume_training(
            options.resume,
            total_steps=options.total_steps,
            on_update=updates.append,
            max_seconds=seconds,
            progress=options.progress,
        )
        environment = read_yaml(options.resume / CONFIG_FILE)["environment"]
    elif options.total_steps is not None:
        raise InputError(f"--total-steps goes with --resume; of a new training: --set total_steps={options.total_steps}")
    else:
        environment = options.env or "WLR-Velocity-v0"
        if options.init is not None:
            environment = environment_of(options.env, find_policy(options.init))
        added: dict[str, Any] = {} if options.backend is None else {"backend": options.backend}
        if patch := options.patch():  # its content, so that the run folder says what was added
            added["effects"] = patch.content()["effects"]
        added |= options.floor_content()
        given = {"changes": options.set, "settings": {"environment": added} if added else None, "seed": options.seed}
        config = settings_of(environment, options.config, options.agent, options.init, robot=options.robot, **given)
        folder = options.out or default_folder(options, environment, config)
        follow = {"max_seconds": seconds, "progress": options.progress, "on_update": updates.append}
        training = Training(environment, folder, config, init=options.init, **follow)
        policy = run_training(options.agent, training)
    if updates and updates[0].steps < updates[0].total_steps:  # it looks finished otherwise
        last = updates[0]
        print(
            f"stopped after {options.max_minutes:g} min at step {last.steps:,} of {last.total_steps:,}; "
            f"go on with: wlr train --resume {quoted(last.folder)}"
        )
    best = policy.with_name("best")
    if options.json:
        print_json({"environment": environment, "policy": policy, "best": best if best.is_dir() else None})
        return OK
    print(f"policy: {policy}\nscore it: wlr evaluate {quoted(policy)} --env {environment}")
    if best.is_dir():
        print(f"best on held-out episodes: {best}")
    return OK


def default_folder(options: TrainOptions, environment: str, config: dict[str, Any]) -> Path:
    """Return the run folder of a training without ``--out``: its environment, settings and seed."""
    own = recipe_of(options.agent, task_name_of(environment), options.robot)
    settings = Path(options.config or options.init or own).stem
    return Path("runs_out") / f"{environment.rpartition(':')[2]}_{settings}_{config.get('seed', 0)}"
