"""Train an agent on an environment. Ctrl-C saves a checkpoint; --resume continues from the newest one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from wlr_gym.base.errors import InputError
from wlr_gym.base.provenance import CONFIG_FILE
from wlr_gym.base.settings import read_yaml
from wlr_gym.cli import OK
from wlr_gym.cli.options import PatchOption
from wlr_gym.envs.registry import task_name_of
from wlr_gym.policy import Training, load_agent_config
from wlr_gym.policy.agents import agent_function

if TYPE_CHECKING:
    from wlr_gym.physics.effects import Patch


@dataclass(frozen=True)
class TrainOptions(PatchOption):
    env: tyro.conf.Positional[str] = "WLR-Velocity-v0"
    """Environment id; see: wlr envs."""
    agent: str = "ppo"
    """Agent to train: a folder of agents/."""
    config: str | None = None
    """Settings of the agent: name in configs/agent/ or path of a YAML file; default: the agent's own."""
    set: tuple[str, ...] = ()
    """Settings to change, as key=value: --set total_steps=20_000_000 environment.randomization=wide"""
    backend: str | None = None
    """Simulator: gibbs_appell or mujoco (with --set environment.precision=float64); default: that of the settings."""
    seed: int | None = None
    """Seed of everything random; default: that of the settings."""
    out: Path | None = None
    """Run folder; default: runs_out/<env>_<config or agent>_<seed>."""
    resume: Path | None = None
    """Run folder to resume; its own environment, agent and settings are used."""
    max_minutes: float | None = None
    """Stop in good order after this time."""
    progress: bool = True
    """Show a progress bar."""


def run(options: TrainOptions) -> int:
    """Train and print where the policy is."""
    if options.max_minutes is not None and not options.max_minutes > 0:
        raise InputError(f"--max-minutes {options.max_minutes:g}: expected more than 0")
    agent, training = _resumed(options) if options.resume is not None else _new(options)
    train = agent_function(agent, "train")
    policy = train(training)
    print(f"policy: {policy}\nscore it: wlr evaluate {policy} --env {training.environment}")
    return OK


def _new(options: TrainOptions) -> tuple[str, Training]:
    config = load_agent_config(options.config or options.agent, options.set, task_name_of(options.env))
    if options.seed is not None:
        config["seed"] = options.seed
    if options.backend is not None:
        config["environment"] = (config.get("environment") or {}) | {"backend": options.backend}
    add_effects(config, options.patch())
    settings = Path(options.config or options.agent).stem
    folder = options.out or Path("runs_out") / f"{options.env.rpartition(':')[2]}_{settings}_{config.get('seed', 0)}"
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder}: not empty; give another --out, or resume what is there: wlr train --resume {folder}")
    return options.agent, _training(options, options.env, folder, config, resume=False)


def add_effects(config: dict[str, Any], patch: Patch) -> None:
    """Put a patch into an agent's settings, in place: its content, so that the run folder says what was added."""
    if patch:
        config["environment"] = (config.get("environment") or {}) | {"effects": patch.content()["effects"]}


def _resumed(options: TrainOptions) -> tuple[str, Training]:
    folder = options.resume
    assert folder is not None
    own = (options.out, options.config, options.seed, options.backend)
    if any(value is not None for value in own) or options.set or options.effects:
        raise InputError(
            "--resume uses the settings of the run folder; leave out --out, --config, --set, --seed, --backend and --effects"
        )
    path = folder / CONFIG_FILE
    if not path.is_file():
        raise InputError(f"{folder}: not a run folder: {CONFIG_FILE} is missing")
    saved = read_yaml(path)
    for key in ("environment", "agent", "settings"):
        if not isinstance(saved, dict) or key not in saved:
            raise InputError(f"{path}: '{key}' is missing")
    return saved["agent"], _training(options, saved["environment"], folder, saved["settings"], resume=True)


def _training(options: TrainOptions, environment: str, folder: Path, config: dict, *, resume: bool) -> Training:
    seconds = None if options.max_minutes is None else 60.0 * options.max_minutes
    return Training(environment, folder, config, resume=resume, max_seconds=seconds, progress=options.progress)
