"""Evaluation from Python: what ``wlr evaluate`` does."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.seeds import require_seed
from wlr_gym.envs.core import make_task
from wlr_gym.envs.registry import task_name_of, task_source_of
from wlr_gym.envs.settings import read_settings
from wlr_gym.envs.tasks.describe import contract
from wlr_gym.envs.tasks.randomization import RandomizationConfig
from wlr_gym.envs.tasks.task import having
from wlr_gym.learning.evaluation.card import MAIN, OTHER_PLANT, Card
from wlr_gym.learning.evaluation.conditions import FIRST_SEED, Condition, Watch, play, work
from wlr_gym.learning.evaluation.subjects import Source, common_robot, identity, read_subjects
from wlr_gym.learning.evaluation.sweeps import read_sweep
from wlr_gym.physics.effects import load_patch
from wlr_gym.policy import make_policy, trained_environment
from wlr_gym.robot import RobotSource, load_robot, robot_hash

BACKENDS = ("gibbs_appell", "mujoco")
#: What a policy is compared with where nothing is chosen, as far as it fits the task.
BASELINES = ("do_nothing", "pid")
#: Episodes of each value of a sweep, and of each other condition.
SWEEP_EPISODES = 64
OTHER_EPISODES = 64

Tell = Callable[[str, float], object]


def evaluate(
    policy: Source | Sequence[Source],
    env_id: str | None = None,
    *,
    baselines: Sequence[Source | Sequence[Source]] | None = None,
    episodes: int = 64,
    blocks: int = 1,
    seed: int = FIRST_SEED,
    backend: str = "gibbs_appell",
    other_episodes: int = OTHER_EPISODES,
    sweeps: Sequence[str] = (),
    sweep_episodes: int = SWEEP_EPISODES,
    randomization: Any = None,
    sensors: Sequence[str] | None = None,
    robot: Any = None,
    effects: Any = None,
    threads: int = 1,
    precision: str = "float64",
    tell: Tell = lambda text, share: None,
    watch: Watch = lambda condition, subject, block, rollout: None,
) -> Card:
    """Score a policy over whole episodes, against baselines on the same ones, as ``wlr evaluate`` does.

    Args:
        policy: agent, policy file (.onnx), policy or run folder, or shipped policy; ``NAME=POLICY`` names it. A list, a pattern
            such as ``out/five/trials/*``, a folder that holds run folders, or ``NAME=POLICY,POLICY,...``: trainings of one
            recipe that differ in the seed. All play all episodes; intervals contain training-seed variance.
        env_id: id of the environment; None = the one the policy was trained in, else ``WLR-Velocity-v0``.
        baselines: what to compare with, given as the policy is; None = ``do_nothing`` and ``pid`` as far as they fit the task.
            The policy itself is not played twice.
        episodes: per block. blocks: of episodes, each with its own seeds.
        seed: of the first episode; the others count up from it, each further block from 10000 above the last one.
        backend: ``gibbs_appell``, ``mujoco``, or ``both`` (the second for the main table only).
        other_episodes: in the second simulator.
        sweeps: names of sweeps (:func:`wlr_gym.learning.evaluation.sweeps_for` lists those that suit a task).
        sweep_episodes: per point of a sweep.
        sensors: which of camera and flow the robots have; None = as their file and the randomisation say.
        randomization, effects, threads, precision: of the environment; see :class:`wlr_gym.envs.settings.EnvironmentOptions`.
            None = the task's.
        robot: that all drive; None = the one that the first trained policy was made for, else the task's.
        tell: called with what is being played and the share that was done since, of 1.
        watch: called with the episodes of every block once they were played.

    Returns:
        The card: ``card.scores["main"][card.names[0]]["tracking_error"].mean`` and so on, ``card.seed_scores`` for each
        training seed; ``write_card`` writes it.

    Raises:
        InputError: unknown policy, environment, sweep or backend, a policy that does not fit the environment, several that are
            not trainings of one recipe, or a seed that is out of range.
    """
    if backend not in (*BACKENDS, "both"):
        raise unknown_name("backend", backend, (*BACKENDS, "both"))
    for name, given in (("baselines", baselines), ("sweeps", sweeps)):
        if isinstance(given, str):
            raise InputError(f"{name} = {given!r}: expected a list of names, such as [{given!r}]")
    require_seed("seed =", seed, 2**63 - 1)
    subject = read_subjects([policy])[0]
    environment = env_id or trained_environment(subject.sources[0]) or "WLR-Velocity-v0"
    task = task_name_of(environment)
    patch = load_patch(effects)
    main, *others = BACKENDS if backend == "both" else (backend,)
    subjects = read_subjects([policy, *(fitting_baselines(environment) if baselines is None else baselines)])
    robot = common_robot(subjects) if robot is None else robot
    keywords: dict[str, Any] = {"randomization": randomization, "robot": robot, "effects": patch}
    keywords |= {"backend": main, "threads": threads, "precision": precision, **having(sensors)}
    chosen = tuple(read_sweep(name, task) for name in dict.fromkeys(sweeps))
    conditions = [Condition(MAIN, keywords, episodes=episodes, blocks=blocks)]
    for sweep in chosen:
        conditions += sweep.conditions(keywords, sweep_episodes)
    fewer = min(other_episodes, episodes)
    conditions += [Condition(OTHER_PLANT, {**keywords, "backend": other}, episodes=fewer) for other in others]
    total = work(conditions, subjects, make_task(task_source_of(environment), read_settings(keywords)).episode_steps)
    results = play(environment, subjects, conditions, seed, lambda text, done: tell(text, done / total), watch)
    count = f"{episodes}, in each of {blocks} blocks" if blocks > 1 else str(episodes)
    said = {
        "environment": environment, "backend": main, "episodes": count, "first seed": seed,
        "randomization": randomization_said(randomization), "robot": _named(robot), "effects": patch.summary(),
    }  # fmt: skip
    if sensors is not None:
        said["sensors that not every robot has"] = ", ".join(sensors) or "none"
    training_seeds = {subject.name: subject.seeds for subject in subjects if subject.seeds}
    if training_seeds:
        said["training seeds"] = "; ".join(f"{name}: {len(own)} ({', '.join(own)})" for name, own in training_seeds.items())
    if others:
        said |= {"second simulator": f"{others[0]}, {fewer} episodes"}
    said |= {"sweeps": f"{sweep_episodes} episodes per point"} if chosen else {}
    return Card(results, chosen, said, {subject.name: identity(subject) for subject in subjects}, training_seeds)


def randomization_said(given: Any) -> str | dict[str, Any]:
    """Return a randomisation as a card says it: its name or path, or its content."""
    if given is None:
        return "the task's"
    if isinstance(given, RandomizationConfig):
        return given.model_dump(mode="json", exclude_unset=True)
    return dict(given) if isinstance(given, Mapping) else str(given)


def _named(robot: RobotSource | None) -> str:
    if robot is None:
        return "the task's"
    loaded = load_robot(robot)
    return f"{loaded.name}, {robot_hash(loaded)}"


def fitting_baselines(environment: str, names: Sequence[str] = BASELINES) -> tuple[str, ...]:
    """Return which agents without learning can drive an environment: a controller needs its task's commands."""
    wanted, found = contract(make_task(task_source_of(environment), read_settings({})), {}), []
    for name in names:
        with suppress(InputError):
            make_policy(name, wanted)
            found.append(name)
    return tuple(found)
