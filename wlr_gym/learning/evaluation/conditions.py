"""Conditions of evaluation, and sweeps through them.

All subjects play the same episodes under each. What the card needs of them is kept, the rest is dropped at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby, product
from typing import TYPE_CHECKING, Any

import numpy as np

from wlr_gym.base.errors import InputError, check_name, check_number
from wlr_gym.learning.evaluation.metrics import Played, summarise
from wlr_gym.learning.evaluation.rollout import Rollout, roll_out
from wlr_gym.learning.evaluation.subjects import Subject, make_player
from wlr_gym.robot.parameter_table import ELEMENTS

if TYPE_CHECKING:
    from wlr_gym.envs.core import Core
    from wlr_gym.policy import Policy

#: Seeds of evaluation episodes begin here: beyond those that searches of gains and trials while training use.
FIRST_SEED = 100_000
#: Distance between the first seeds of two blocks of episodes.
BLOCK = 10_000


@dataclass(frozen=True)
class Condition:
    """Under which conditions episodes are played.

    Attributes:
        label: name of it, unique.
        keywords: of the environment.
        parameters: elements of the parameter table set after randomisation and effects.
        commands: held through the episodes.
        episodes: N per block. blocks: S, each with its own seeds.
    """

    label: str
    keywords: Mapping[str, Any] = field(default_factory=dict)
    parameters: Mapping[str, float] = field(default_factory=dict)
    commands: Mapping[str, float] = field(default_factory=dict)
    episodes: int = 64
    blocks: int = 1

    def __post_init__(self) -> None:
        check_number("episodes", self.episodes, least=1, most=BLOCK, whole=True)
        check_number("blocks", self.blocks, least=1, most=1000, whole=True)

    @property
    def cost(self) -> int:
        """Relative cost of an environment step of all episodes of a block, for the progress bar only."""
        return self.episodes * (40 if self.keywords.get("backend") == "mujoco" else 1)


#: condition -> subject -> what is kept.
Results = dict[str, dict[str, Played]]
Watch = Callable[[Condition, Subject, int, Rollout], object]


def play(
    environment: str,
    subjects: Sequence[Subject],
    conditions: Sequence[Condition],
    first_seed: int = FIRST_SEED,
    tell: Callable[[str, float], object] | None = None,
    watch: Watch | None = None,
) -> Results:
    """Play every condition with every subject. Episode i of block k has seed ``first_seed + 10000 k + i``, whoever plays.

    A subject of several training seeds plays every block with each of them.

    Args:
        environment: id.
        subjects: who plays.
        conditions: under which; neighbours with the same keywords and number of episodes share their environment.
        first_seed: of the first block.
        tell: called after every environment step with a description and the share of all that was done in it, of 1.
        watch: called with every block that was played; once per training seed.
    """
    results: Results = {condition.label: {} for condition in conditions}
    work = sum(one.cost * one.blocks for one in conditions) * sum(len(subject.sources) for subject in subjects)
    for _, group in groupby(conditions, lambda condition: (condition.keywords, condition.episodes)):
        chosen = list(group)
        references: dict[tuple[str, int], _Given] = {}
        with ExitStack() as stack:  # all players first: a policy that does not fit is refused before anything is played
            players: dict[Subject, list[tuple[Core, Policy]]] = {subject: [] for subject in subjects}
            for subject, made in players.items():
                for source in subject.sources:
                    made.append(make_player(environment, source, chosen[0].episodes, chosen[0].keywords))
                    stack.callback(made[-1][0].close)
            for subject in subjects:
                for condition in chosen:
                    share = condition.cost / work
                    blocks = _blocks(players[subject], subject, condition, first_seed, tell, share, watch, references)
                    results[condition.label][subject.name] = summarise(blocks, len(subject.sources))
    return results


def _blocks(
    players: Sequence[tuple[Core, Policy]],
    subject: Subject,
    condition: Condition,
    first_seed: int,
    tell: Callable[[str, float], object] | None,
    share: float,
    watch: Watch | None,
    references: dict[tuple[str, int], _Given],
) -> Iterator[Rollout]:
    """Play the blocks of a condition, each a ``share`` of all, with every player; check them against the first subject's."""
    text = f"{subject.name}: {condition.label}"
    for (core, policy), block in product(players, range(condition.blocks)):
        seed = first_seed + BLOCK * block
        on_tick = None if tell is None else partial(tell, text, share / core.limit)
        rollout = roll_out(core, policy, seed, on_tick, parameters=condition.parameters, commands=condition.commands)
        given = _Given(subject.name, rollout)
        references.setdefault((condition.label, block), given).check(given)
        if watch is not None:
            watch(condition, subject, block, rollout)
        yield rollout


class _Given:
    """What a subject was given in a block of episodes: floors and robots, starts, commands."""

    def __init__(self, name: str, rollout: Rollout) -> None:
        self.name, self.seeds, self.measures = name, rollout.seeds, rollout.measures
        self.parameters, self.start = rollout.parameters, rollout.start
        self.active, self.command = rollout.active, rollout.command

    def check(self, other: _Given) -> None:
        """Refuse to compare subjects that were not given the same episodes, bit for bit, as long as both last."""
        names = f"'{self.name}' and '{other.name}' were not given the same episodes"
        hint = "; a policy's environment may change its observations and actions only"
        if self.measures != other.measures or self.command.shape[2] != other.command.shape[2]:
            raise InputError(f"{names}: their tasks have other measures or commands{hint}")
        differs = self.parameters != other.parameters
        if differs.any():
            episode, column = np.argwhere(differs)[0]
            mine, theirs = (given.parameters[episode, column] for given in (self, other))
            raise InputError(f"{names}: seed {self.seeds[episode]}: {ELEMENTS[column]} is {mine:g} and {theirs:g}{hint}")
        if (differs := (self.start != other.start).any(axis=1)).any():
            raise InputError(f"{names}: seed {self.seeds[np.argmax(differs)]} starts in another state{hint}")
        ticks = min(len(self.active), len(other.active))
        both = self.active[:ticks] & other.active[:ticks]
        differs = (self.command[:ticks] != other.command[:ticks]).any(axis=2) & both
        if differs.any():
            tick, episode = np.argwhere(differs)[0]
            raise InputError(f"{names}: seed {self.seeds[episode]} gets another command from environment step {tick} on{hint}")


# ---- sweeps ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Point:
    """One condition of a sweep: where it stands on the axis (its rank where there is no number), and what makes it."""

    label: str
    value: float
    parameters: Mapping[str, float] = field(default_factory=dict)
    randomization: str | None = None
    commands: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Sweep:
    """A family of conditions.

    Attributes:
        name: as on the command line.
        axis: quantity and unit of the points.
        doc: what stays as it is and what changes.
        points: in order.
        numeric: the points' values are numbers, not ranks.
        tasks: for which it makes sense; empty: all.
    """

    name: str
    axis: str
    doc: str
    points: tuple[Point, ...]
    numeric: bool = True
    tasks: tuple[str, ...] = ()

    def conditions(self, keywords: Mapping[str, Any], episodes: int) -> list[Condition]:
        """Return one condition per point, laid over ``keywords`` of the environment."""
        return [
            Condition(
                label=self.label(point),
                keywords={**keywords, **({} if point.randomization is None else {"randomization": point.randomization})},
                parameters=point.parameters,
                commands=point.commands,
                episodes=episodes,
            )
            for point in self.points
        ]

    def label(self, point: Point) -> str:
        """Return the name of a point's condition."""
        return f"{self.name} {point.label}"


def _degrees_below_limit(mu: float, degrees: float) -> dict[str, float]:
    """A slope along the floor's x axis so much less steep than the friction limit atan(mu)."""
    return {**_even_floor(mu), "ground.slope[pitch]": math.atan(mu) - math.radians(degrees)}


def _even_floor(mu: float) -> dict[str, float]:
    return {"ground.mu_x": mu, "ground.mu_y": mu, "patch.mu": mu}


def _paper_sweep(front: tuple[float, float], rear: tuple[float, float]) -> dict[str, float]:
    """Legs (degrees, before and after) at the paper's leg rate and speed."""
    first, second = ([math.radians(legs[k]) for legs in (front, rear)] for k in (0, 1))
    names = [f"{axle}_leg_{when}" for when in ("first", "second") for axle in ("front", "rear")]
    return {**dict(zip(names, [*first, *second], strict=True)), "linear_velocity_x": 0.065, "leg_rate": 0.36}


#: Test of the paper -> front and rear legs, degrees, before and after the sweep.
PAPER_LEGS = {"test 1": ((30.0, 30.0), (30.0, 150.0)), "test 2": ((30.0, 150.0), (150.0, 30.0))}
#: In the order of the command ``path_shape``: below 1, below 2, above.
SHAPES = ("line", "S-curve", "circle")
#: Friction coefficient under the left wheels of split floors.
LEFT_FRICTION = 0.1
#: Friction coefficient of the slopes.
SLOPE_FRICTION = 0.4
#: Degrees by which slopes of any friction stay below their limits.
GRIP_DEGREES = 2.0
#: m, body frame: ahead, to the left and above the middle, so that the wheels carry unequal loads.
PAYLOAD_PLACE = {"payload.position[x]": 0.05, "payload.position[y]": 0.03, "payload.position[z]": 0.05}
#: No training and no choice of a setting has seen the last two.
FLOORS = ("slippery", "nominal", "ice", "split", "patches", "wide", "stripes", "ribbed")

SWEEPS: dict[str, Sweep] = {
    sweep.name: sweep
    for sweep in (
        Sweep(
            "friction", "friction coefficient of the floor", "the same friction everywhere, from ice to rubber",
            tuple(Point(f"{mu:g}", mu, _even_floor(mu)) for mu in (0.05, 0.1, 0.15, 0.2, 0.3, 0.45, 0.7, 1.0)),
            tasks=("velocity", "path", "posture"),
        ),
        Sweep(
            "slope", f"slope below the friction limit (degrees; friction {SLOPE_FRICTION:g})",
            "ever closer to the steepest slope that friction can hold, atan(mu)",
            tuple(
                Point(f"{degrees:g}", degrees, _degrees_below_limit(SLOPE_FRICTION, degrees))
                for degrees in (10.0, 6.0, 4.0, 3.0, 2.0, 1.5, 1.0, 0.5)
            ),
            tasks=("slope",),
        ),
        Sweep(
            "grip", f"friction coefficient (slope {GRIP_DEGREES:g} degrees below atan of it)",
            "slopes near the friction limit, from ice to rubber",
            tuple(Point(f"{mu:g}", mu, _degrees_below_limit(mu, GRIP_DEGREES)) for mu in (0.1, 0.15, 0.2, 0.3, 0.45, 0.7)),
            tasks=("slope",),
        ),
        Sweep(
            "split", f"friction under the right wheels over that under the left ({LEFT_FRICTION:g})",
            "astride a line along the start heading, ever more friction right of it (randomization split)",
            tuple(
                Point(f"{ratio:g}", ratio, {**_even_floor(ratio * LEFT_FRICTION), "patch.mu[patch_1]": LEFT_FRICTION}, "split")
                # Beyond about 2 the legs decide whether a robot turns: see docs/physics.md.
                for ratio in (1.0, 1.5, 2.0, 3.0, 4.5, 6.0, 9.0)
            ),
            tasks=("velocity", "path"),
        ),
        Sweep(
            "floors", "randomization", "whole randomizations: robots and floors they draw",
            tuple(Point(name, float(rank), randomization=name) for rank, name in enumerate(FLOORS)),
            numeric=False, tasks=("velocity", "path"),
        ),
        Sweep(
            "shapes", "path", "each kind of path",
            tuple(Point(name, float(k), commands={"path_shape": k + 0.5}) for k, name in enumerate(SHAPES)),
            numeric=False, tasks=("path",),
        ),
        Sweep(
            "paper", "test of the paper", "the leg sweeps of the paper's two tests, as commands of the task",
            tuple(Point(name, float(k), commands=_paper_sweep(*legs)) for k, (name, legs) in enumerate(PAPER_LEGS.items())),
            numeric=False, tasks=("posture",),
        ),
        Sweep(
            "latency", "delay of every command (s)", "commands act this much later than written",
            tuple(Point(f"{delay:g}", delay, {"command.delay": delay}) for delay in (0.0, 0.01, 0.02, 0.04, 0.06)),
        ),
        Sweep(
            "payload", "payload (kg)", "a mass on the body, off its middle",
            tuple(Point(f"{mass:g}", mass, {"payload.mass": mass, **PAYLOAD_PLACE}) for mass in (0.0, 0.25, 0.5, 1.0, 2.0)),
        ),
    )
}  # fmt: skip


def sweeps_for(task: str) -> tuple[str, ...]:
    """Return the names of the sweeps that make sense for a task."""
    return tuple(name for name, sweep in SWEEPS.items() if not sweep.tasks or task in sweep.tasks)


def read_sweep(name: str, task: str) -> Sweep:
    """Return a sweep by name.

    Raises:
        InputError: unknown, or not for this task.
    """
    check_name("sweep", name, SWEEPS)
    if name not in sweeps_for(task):
        raise InputError(f"sweep '{name}' is not for task '{task}'; for it: {', '.join(sweeps_for(task))}")
    return SWEEPS[name]
