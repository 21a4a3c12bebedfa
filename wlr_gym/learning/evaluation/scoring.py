"""Evaluation from Python: what ``wlr evaluate`` does; a score card, or the acceptance test."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from wlr_gym.base.errors import InputError, check_name, require_seed
from wlr_gym.base.files import write_json
from wlr_gym.base.settings import expected
from wlr_gym.envs.core import make_task
from wlr_gym.envs.registry import task_name_of, task_source_of
from wlr_gym.envs.settings import read_settings
from wlr_gym.envs.tasks.describe import contract
from wlr_gym.envs.tasks.randomization import RandomizationConfig, load_randomization
from wlr_gym.envs.tasks.task import having, read_task
from wlr_gym.learning.evaluation.card import MAIN, OTHER_PLANT, Card
from wlr_gym.learning.evaluation.conditions import FIRST_SEED, FLOORS, Condition, Watch, play, read_sweep
from wlr_gym.learning.evaluation.subjects import Source, common_robot, identity, read_subjects
from wlr_gym.physics.effects import load_patch
from wlr_gym.physics.floor import load_floor
from wlr_gym.policy import make_policy, policy_environment, shipped_names, trained_environment
from wlr_gym.robot import load_robot, robot_hash

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
    floor: Any = None,
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
        baselines: what to compare with, given as the policy is; None = :func:`default_baselines`. The policy itself is not
            played twice.
        episodes: per block. blocks: of episodes, each with its own seeds.
        seed: of the first episode; the others count up from it, each further block from 10000 above the last one.
        backend: ``gibbs_appell``, ``mujoco``, or ``both`` (the second for the main table only).
        other_episodes: in the second simulator.
        sweeps: names of sweeps (:func:`wlr_gym.learning.evaluation.conditions.sweeps_for` lists those that suit a task).
        sweep_episodes: per point of a sweep.
        sensors: which of camera and flow the robots have; None = as their file and the randomisation say.
        randomization, effects, floor, threads, precision: of the environment; see
            :class:`wlr_gym.envs.settings.EnvironmentOptions`. None = the task's.
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
    check_name("backend", backend, (*BACKENDS, "both"))
    for name, given in (("baselines", baselines), ("sweeps", sweeps)):
        if isinstance(given, str):
            raise InputError(f"{name} = {given!r}: expected a list of names, such as [{given!r}]")
    require_seed("seed =", seed, 2**63 - 1)
    subject = read_subjects([policy])[0]
    environment = env_id or trained_environment(subject.sources[0]) or "WLR-Velocity-v0"
    task = task_name_of(environment)
    patch = load_patch(effects)
    main, *others = BACKENDS if backend == "both" else (backend,)
    subjects = read_subjects(
        [policy, *(default_baselines(subject.sources[0], environment) if baselines is None else baselines)]
    )
    robot = common_robot(subjects) if robot is None else robot
    keywords: dict[str, Any] = {"randomization": randomization, "robot": robot, "effects": patch, "floor": floor}
    keywords |= {"backend": main, "threads": threads, "precision": precision, **having(sensors)}
    chosen = tuple(read_sweep(name, task) for name in dict.fromkeys(sweeps))
    conditions = [Condition(MAIN, keywords, episodes=episodes, blocks=blocks)]
    for sweep in chosen:
        conditions += sweep.conditions(keywords, sweep_episodes)
    fewer = min(other_episodes, episodes)
    conditions += [Condition(OTHER_PLANT, {**keywords, "backend": other}, episodes=fewer) for other in others]
    results = play(environment, subjects, conditions, seed, tell, watch)
    count = f"{episodes}, in each of {blocks} blocks" if blocks > 1 else str(episodes)
    driven = None if robot is None else load_robot(robot)
    said = {
        "environment": environment, "backend": main, "episodes": count, "first seed": seed,
        "randomization": randomization_said(randomization),
        "robot": "the task's" if driven is None else f"{driven.name}, {robot_hash(driven)}", "effects": patch.summary(),
        "floor": "the task's" if floor is None else load_floor(floor).name,
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


def fitting_baselines(environment: str, names: Sequence[str] = BASELINES) -> tuple[str, ...]:
    """Return which agents without learning can drive an environment: a controller needs its task's commands."""
    wanted, found = contract(make_task(task_source_of(environment), read_settings({})), {}), []
    for name in names:
        with suppress(InputError):
            make_policy(name, wanted)
            found.append(name)
    return tuple(found)


def default_baselines(policy: Source, environment: str, names: Sequence[str] = BASELINES) -> tuple[str, ...]:
    """Return what a policy is compared with where nothing is chosen: agents that fit, beside a trained one also the controller
    of :func:`controller_of`."""
    own = () if trained_environment(policy) is None else fitting_baselines(environment, (controller_of(policy),))
    return tuple(dict.fromkeys((*fitting_baselines(environment, names), *own)))


# ---- the acceptance test: on no family of floors does a policy lose much against what it is to replace ---------------

#: Task -> families of floors of its card. No training and no setting knows ``stripes`` and ``ribbed``.
FAMILIES: Mapping[str, tuple[str, ...]] = {
    "velocity": FLOORS,
    "path": FLOORS,
    "posture": ("asymmetric", "nominal", "slippery", "ice", "stripes", "ribbed"),
    "slope": ("slope",),
}
#: Largest loss of tracking error that is accepted, %: the upper end of its 95 % interval counts.
LARGEST_LOSS = 5.0
ACCEPTANCE_EPISODES, ACCEPTANCE_BLOCKS = 512, 5
#: Of the engine: twice as fast as float64, and what rounding changes is far below what floors do.
PRECISION = "float32"
#: Name of the file, and its version.
ACCEPTANCE_FILE = "acceptance.json"
FORMAT = 1


@dataclass(frozen=True)
class Loss:
    """What a policy loses against a reference on a family of floors, in tracking error, paired episode by episode.

    Attributes:
        floors: name of the randomisation. reference: what it is compared with.
        error, reference_error: mean tracking errors.
        loss: by how much the policy's is larger, % of the reference's; negative = it gains.
        bound: upper end of the 95 % interval of the loss, %.
    """

    floors: str
    reference: str
    error: float
    reference_error: float
    loss: float
    bound: float


@dataclass(frozen=True)
class Acceptance:
    """Result of the test of one policy.

    Attributes:
        policy: as given. environment: id. episodes, blocks: per family of floors.
        sensors: those of the robots that not every robot has; None = as their file says.
        largest_loss: %, what was allowed.
        inputs: SHA-256 of the policies and of the task, robot and randomisations that were played.
        losses: one per family of floors and reference.
    """

    policy: str
    environment: str
    episodes: int
    blocks: int
    sensors: tuple[str, ...] | None
    largest_loss: float
    inputs: str
    losses: tuple[Loss, ...]

    @property
    def refused(self) -> tuple[Loss, ...]:
        """Losses that are larger than what was allowed."""
        return tuple(loss for loss in self.losses if not loss.bound <= self.largest_loss)

    @property
    def accepted(self) -> bool:
        """Whether no bound of a loss is larger than what was allowed."""
        return not self.refused


def accept(
    policy: Source,
    env_id: str | None = None,
    *,
    references: Sequence[Source] | None = None,
    floors: Sequence[Any] | None = None,
    episodes: int = ACCEPTANCE_EPISODES,
    blocks: int = ACCEPTANCE_BLOCKS,
    largest_loss: float = LARGEST_LOSS,
    sensors: Sequence[str] | None = None,
    robot: Any = None,
    tell: Tell = lambda text, share: None,
    **conditions: Any,
) -> Acceptance:
    """Play a policy and its references on the same episodes of every family of floors.

    Args:
        policy: one policy or agent, as :func:`wlr_gym.learning.evaluation.scoring.evaluate` takes it.
        env_id: id of the environment; None = the one the policy was trained in.
        references: None = :func:`references_of` the policy. The policy itself is none.
        floors: randomisations; None = those of the task's card.
        episodes: per block. blocks: of episodes, each with its own seeds.
        largest_loss: % of the tracking error.
        sensors, robot: of the environment; None = the task's.
        tell: called with what is going on and the share of the work that was done since.
        conditions: further ones of :func:`evaluate`: ``effects``, ``floor``, ``threads``.

    Raises:
        InputError: unknown names, or a policy without references.
    """
    subject = read_subjects([policy])[0]
    environment = env_id or trained_environment(subject.sources[0]) or "WLR-Velocity-v0"
    task = task_name_of(environment)
    own = (read_task(task_source_of(environment)).randomization,)
    chosen = tuple(FAMILIES.get(task, own) if floors is None else floors)
    given = references_of(subject.sources[0], environment) if references is None else references
    against = tuple(one for one in given if read_subjects([one])[0] != subject)
    if not against:
        raise InputError(f"policy '{policy}': nothing to compare it with; expected a reference")
    losses: list[Loss] = []
    for family in chosen:
        card = evaluate(
            policy,
            environment,
            baselines=against,
            episodes=episodes,
            blocks=blocks,
            randomization=family,
            sensors=sensors,
            robot=robot,
            precision=PRECISION,
            tell=lambda text, share, family=family: tell(f"{_name(family)}: {text}", share / len(chosen)),
            **conditions,
        )
        errors = {name: scores["tracking_error"].mean for name, scores in card.scores[MAIN].items()}
        for name, better in card.comparison[MAIN].items():
            gain = better["tracking_error"]
            losses.append(Loss(_name(family), name, errors[subject.name], errors[name], -gain.mean, -gain.low))
    inputs = fingerprint(environment, [policy, *against], chosen, robot, conditions.get("floor"))
    present = None if sensors is None else tuple(sensors)
    return Acceptance(str(policy), environment, episodes, blocks, present, largest_loss, inputs, tuple(losses))


def _name(family: Any) -> str:
    said = randomization_said(family)
    return said if isinstance(said, str) else str(said.get("name", "given"))


def references_of(policy: Source, environment: str) -> tuple[str, ...]:
    """Return what a policy must not lose against: its controller, and the task's blind policy."""
    blind = f"{task_name_of(environment)}_blind"
    return (controller_of(policy), *([blind] if blind in shipped_names() and blind != str(policy) else []))


def controller_of(policy: Source) -> str:
    """Return the shipped controller, with a camera or without, that could replace a trained policy; its gains are its own."""
    observer = policy_environment(policy).get("task", {}).get("observer") or {}
    return "slip_compensating" if observer.get("camera", True) else "slip_compensating_no_camera"


def fingerprint(
    environment: str, policies: Iterable[Source], floors: Sequence[Any], robot: Any = None, relief: Any = None
) -> str:
    """Return the SHA-256 of what is played: the policies' content, the task, the robot, the randomisations and their floor."""
    config = read_task(task_source_of(environment))
    own = load_robot(config.robot if robot is None else robot)
    # of treads that are rigid nothing is said, as before robot files stated them
    rigid = {"slip_compliance", "relaxation_length", "tread_damping"} - own.ground.model_dump(exclude_defaults=True).keys()
    played = {
        "policies": [identity(subject, config.name) for subject in read_subjects(list(policies))],
        "task": config.model_dump(mode="json", exclude={"floor"}),
        "floors": [load_randomization(family, own).config.model_dump(mode="json") for family in floors],
        "robot": own.model_dump(mode="json", exclude={"ground": rigid}),
    }
    floor = load_floor(config.floor if relief is None else relief)
    if not floor.is_flat:  # of a plane nothing is said, as before there were other floors
        played["relief"] = floor.content()
    return hashlib.sha256(json.dumps(played, sort_keys=True).encode()).hexdigest()


#: Columns of a row of acceptance after its first, the floors or robots.
COLUMNS = ("against", "tracking error", "its tracking error", "loss (%)", "upper bound (%)", "not worse")


def acceptance_rows(result: Acceptance) -> list[list[str]]:
    """Return the table as text: a header, then one row per family of floors and reference."""
    table = [["floors", *COLUMNS]]
    for loss in result.losses:
        numbers = [f"{loss.error:.3f}", f"{loss.reference_error:.3f}", f"{loss.loss:.1f}", f"{loss.bound:.1f}"]
        table.append([loss.floors, loss.reference, *numbers, "yes" if loss.bound <= result.largest_loss else "no"])
    return table


def write_acceptance(path: Path, result: Acceptance) -> None:
    """Write a result as JSON."""
    write_json(path, {"format": FORMAT, **asdict(result)})


def read_acceptance(path: Path) -> Acceptance:
    """Read what :func:`write_acceptance` wrote.

    Raises:
        InputError: not such a file.
    """
    try:
        return TypeAdapter(Acceptance).validate_json(path.read_bytes())
    except (OSError, ValueError) as error:
        why = str(error)
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            why = ": ".join(filter(None, (".".join(map(str, first["loc"])), expected(first))))
        raise InputError(f"{path}: expected a result of wlr evaluate --accept: {why}") from None
