"""All subjects play the same episodes under a list of conditions; what the card needs is kept, the rest is dropped at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import groupby, product
from typing import TYPE_CHECKING, Any

import numpy as np

from wlr_gym.base.errors import InputError
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
        for name, value, most in (("episodes", self.episodes, BLOCK), ("blocks", self.blocks, 1000)):
            if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
                raise InputError(f"{name} = {value!r}: expected a whole number from 1 to {most}")

    @property
    def cost(self) -> int:
        """Relative cost of an environment step of all episodes of a block, for the progress bar only."""
        return self.episodes * (40 if self.keywords.get("backend") == "mujoco" else 1)


#: condition -> subject -> what is kept.
Results = dict[str, dict[str, Played]]
Watch = Callable[[Condition, Subject, int, Rollout], object]


def work(conditions: Sequence[Condition], subjects: Sequence[Subject], ticks: int) -> int:
    """Return how often ``tell`` of :func:`play` counts in all, for episodes of ``ticks`` environment steps."""
    players = sum(len(subject.sources) for subject in subjects)
    return sum(condition.cost * condition.blocks for condition in conditions) * players * ticks


def play(
    environment: str,
    subjects: Sequence[Subject],
    conditions: Sequence[Condition],
    first_seed: int = FIRST_SEED,
    tell: Callable[[str, int], object] | None = None,
    watch: Watch | None = None,
) -> Results:
    """Play every condition with every subject. Episode i of block k has seed ``first_seed + 10000 k + i``, whoever plays.

    A subject of several training seeds plays every block with each of them.

    Args:
        environment: id.
        subjects: who plays.
        conditions: under which; neighbours with the same keywords and number of episodes share their environment.
        first_seed: of the first block.
        tell: called after every environment step with a description and its cost; see :func:`work`.
        watch: called with every block that was played; once per training seed.

    Raises:
        InputError: unknown environment, policy, keyword or parameter; a policy that does not fit; or an environment of a policy
            in which floor, start or commands differ from those of the others.
    """
    results: Results = {condition.label: {} for condition in conditions}
    for _, group in groupby(conditions, lambda condition: (condition.keywords, condition.episodes)):
        chosen = list(group)
        references: dict[tuple[str, int], _Given] = {}
        with ExitStack() as stack:  # all players first: a policy that does not fit is refused before anything is played
            players = {subject: _players(environment, subject, chosen[0], stack) for subject in subjects}
            for subject in subjects:
                for condition in chosen:
                    blocks = _blocks(players[subject], subject, condition, first_seed, tell, watch, references)
                    results[condition.label][subject.name] = summarise(blocks, len(subject.sources))
    return results


def _players(environment: str, subject: Subject, condition: Condition, stack: ExitStack) -> list[tuple[Core, Policy]]:
    players = []
    for source in subject.sources:
        core, policy = make_player(environment, source, condition.episodes, condition.keywords)
        stack.callback(core.close)
        players.append((core, policy))
    return players


def _blocks(
    players: Sequence[tuple[Core, Policy]],
    subject: Subject,
    condition: Condition,
    first_seed: int,
    tell: Callable[[str, int], object] | None,
    watch: Watch | None,
    references: dict[tuple[str, int], _Given],
) -> Iterator[Rollout]:
    """Play the blocks of a condition with every player; each is checked against what the first subject was given."""
    text = f"{subject.name}: {condition.label}"
    on_tick = None if tell is None else lambda: tell(text, condition.cost)
    for (core, policy), block in product(players, range(condition.blocks)):
        seed = first_seed + BLOCK * block
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
