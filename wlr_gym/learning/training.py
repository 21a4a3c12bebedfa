"""Training from Python: what ``wlr train`` does."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError, check_number, nearest
from wlr_gym.base.files import alone_in, require_empty
from wlr_gym.base.paths import as_path
from wlr_gym.base.provenance import CONFIG_FILE, write_yaml
from wlr_gym.base.settings import merge_changes, read_yaml
from wlr_gym.envs.registry import task_name_of
from wlr_gym.physics.floor import load_floor
from wlr_gym.physics.plants import check_simulator
from wlr_gym.policy.agents import (
    Training,
    TrainingProgress,
    agent_function,
    apply_changes,
    for_task,
    load_agent,
    load_agent_config,
)
from wlr_gym.robot import RobotSource, robot_content


def train(
    env_id: str,
    out: str | Path,
    config: str | Path | None = None,
    *,
    agent: str = "ppo",
    settings: Mapping[str, Any] | None = None,
    seed: int | None = None,
    init: str | Path | None = None,
    robot: RobotSource | None = None,
    on_update: Callable[[TrainingProgress], object] | None = None,
    max_seconds: float | None = None,
    progress: bool = False,
) -> Path:
    """Train an agent on an environment, as ``wlr train`` does.

    Args:
        env_id: id of the environment, such as ``WLR-Velocity-v0``, or of a registered task.
        out: run folder to fill; it must be empty or absent.
        config: settings of the agent: name in ``configs/agent/`` or path of a YAML file; None = of
            :func:`recipe_of`, with ``init`` those of that policy's training.
        agent: a folder of ``agents/``.
        settings: changes laid over the settings, such as
            ``{"total_steps": 100_000, "environment": {"randomization": "ice"}}``.
        seed: of everything random; None = that of the settings.
        init: trained policy to start from: run or policy folder, policy file, or shipped policy. It must have been made for
            this environment's observations and actions.
        robot: name in ``configs/robot/``, path of a robot file, its content, or a :class:`wlr_gym.robot.Robot`; None = as the
            settings say, else the task's. It goes into the run folder and the policy by content: what was trained with a robot
            finds it by itself.
        on_update: called with a :class:`wlr_gym.TrainingProgress` after every update; ``progress.stop()`` ends the training
            in good order. What it raises ends it too, after a checkpoint was saved.
        max_seconds: stop in good order after this wall time, s; :func:`resume_training` continues. None = no limit.
        progress: show a progress bar.

    Returns:
        The folder of the policy, which :func:`wlr_gym.evaluate` and :func:`wlr_gym.load_policy` take. Beside it, ``best/`` is
        the policy that did best on the held-out episodes, ``held_out.csv`` the scores of all.

    Raises:
        InputError: unknown environment, agent, policy or setting, a bad value, or a folder that is in use.
        KeyboardInterrupt: Ctrl-C or SIGTERM, after a checkpoint was saved.
    """
    chosen = settings_of(env_id, config, agent, init, settings=settings, seed=seed, robot=robot)
    follow: dict[str, Any] = {"max_seconds": max_seconds, "progress": progress, "on_update": on_update}
    return run_training(agent, Training(env_id, as_path(out), chosen, init=init, **follow))


#: Settings of the shipped policies, for the tasks that they name; and the same for robots without camera and optical flow.
RECIPE, RECIPE_WITHOUT_CAMERA = "ppo_slip_aware", "ppo_slip_aware_no_camera"


def recipe_of(agent: str, task: str, robot: RobotSource | None = None) -> str:
    """Return the settings of a training that names none: of ``ppo`` what ships, where the task has that, else the agent's own.

    Args:
        agent, task: their names.
        robot: as for :func:`train`. On one that is named, no sensors are expected that not every robot has.
    """
    if agent != "ppo" or task not in load_agent_config(RECIPE)["tasks"]:
        return agent
    return RECIPE if robot is None else RECIPE_WITHOUT_CAMERA


def settings_of(
    env_id: str,
    config: str | Path | None,
    agent: str,
    init: str | Path | None,
    *,
    changes: tuple[str, ...] = (),
    settings: Mapping[str, Any] | None = None,
    seed: int | None = None,
    robot: RobotSource | None = None,
) -> dict[str, Any]:
    """Return all settings of a training, with changes: of ``config``, of the policy to start from, or of :func:`recipe_of`.

    Args:
        env_id, config, agent, init, settings, seed, robot: as for :func:`train`.
        changes: ``key=value``, laid over the settings before ``settings``.

    Raises:
        InputError: unknown names, or a change that is none.
    """
    if not isinstance(settings, Mapping | None):
        raise InputError(f"settings = {settings!r}: expected a mapping, such as {{'total_steps': 100_000}}")
    task = task_name_of(env_id)
    load_agent(agent)  # an unknown one is refused as that, not as settings
    if init is None or config is not None:
        chosen = load_agent_config(config or recipe_of(agent, task, robot), changes, task)
    else:
        chosen = {**agent_function(agent, "settings_to_start_from")(init), "tasks": {}}
        apply_changes(chosen, changes)
        chosen = for_task(chosen, task)
    chosen = merge_changes(chosen, for_task(settings or {}, task))
    return with_robot(chosen if seed is None else chosen | {"seed": seed}, robot)


def with_robot(settings: Mapping[str, Any], robot: RobotSource | None = None) -> dict[str, Any]:
    """Return an agent's settings with robot and floor of their environment by content, so that they mean the same anywhere.

    Args:
        settings: of the agent.
        robot: instead of the one that they name; None = that one. Without any the settings stay as they are.
    """
    environment = settings.get("environment") or {}
    if not isinstance(environment, Mapping):
        environment = {}
    chosen, floor = environment.get("robot") if robot is None else robot, environment.get("floor")
    content = {} if chosen is None else {"robot": robot_content(chosen)}
    content |= {} if floor is None else {"floor": load_floor(floor).content()}
    return {**settings, "environment": {**environment, **content}} if content else dict(settings)


def resume_training(
    folder: str | Path,
    *,
    total_steps: int | None = None,
    on_update: Callable[[TrainingProgress], object] | None = None,
    max_seconds: float | None = None,
    progress: bool = False,
) -> Path:
    """Continue a training that was stopped, or go on after its end, from its newest checkpoint, with its own settings.

    Args:
        folder: run folder.
        total_steps: new end of the training, environment steps; the learning rate stays where its schedule ended.
            None = as before.
        on_update, max_seconds, progress: as for :func:`train`.

    Returns:
        The folder of the policy.

    Raises:
        InputError: not a run folder, nothing in it to resume, or an end before the present one.
    """
    path = as_path(folder) / CONFIG_FILE
    if not path.is_file():
        raise InputError(f"{folder}: not a run folder: {CONFIG_FILE} is missing")
    with alone_in(path.parent):
        saved = read_yaml(path)
        for key in ("environment", "agent", "settings"):
            if not isinstance(saved, dict) or key not in saved:
                raise InputError(f"{path}: '{key}' is missing")
        if total_steps is not None:
            _extend(saved["settings"], total_steps)
            write_yaml(path, saved)
        follow: dict[str, Any] = {"max_seconds": max_seconds, "progress": progress, "on_update": on_update}
        request = Training(saved["environment"], path.parent, saved["settings"], resume=True, init=saved.get("init"), **follow)
        return run_training(saved["agent"], request)


def _extend(settings: dict[str, Any], total_steps: int) -> None:
    """Move the end of a training, in place."""
    before = settings.get("total_steps")
    if not isinstance(before, int) or total_steps <= before:
        raise InputError(f"total_steps = {total_steps}: expected more than the {before} steps of the run")
    settings["schedule_steps"] = settings.get("schedule_steps") or before
    settings["total_steps"] = total_steps


def run_training(agent: str, training: Training) -> Path:
    """Train, and return the folder of the policy."""
    if training.max_seconds is not None:
        check_number("max_seconds", training.max_seconds, "s", above=0)
    with alone_in(training.folder):
        if not training.resume:
            require_empty(training.folder, "wlr train" if can_resume(training.folder) else "")
        check_environment_settings(training.config)
        return agent_function(agent, "train")(replace(training, config=with_robot(training.config)))


def check_environment_settings(settings: Mapping[str, Any]) -> None:
    """Refuse a setting of the environment that does not exist, as a setting, not as a keyword of Python.

    Raises:
        InputError: naming it, and the nearest that exists.
    """
    from wlr_gym.envs.settings import EnvironmentOptions

    valid = EnvironmentOptions.__annotations__
    environment = settings.get("environment")
    for name in environment if isinstance(environment, Mapping) else ():
        if name not in valid:
            raise InputError(f"unknown setting 'environment.{name}'{nearest(name, valid)}; valid: {', '.join(valid)}")
    if isinstance(environment, Mapping) and isinstance(backend := environment.get("backend"), str):
        check_simulator(backend)


def can_resume(folder: Path) -> bool:
    """Whether a training was in a folder, and left a checkpoint."""
    return (folder / CONFIG_FILE).is_file() and any(folder.glob("checkpoints/*"))
