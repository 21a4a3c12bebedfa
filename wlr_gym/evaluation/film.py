"""Films of a policy at work."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from wlr_gym.render.view import View

if TYPE_CHECKING:
    from wlr_gym.envs.core import Core
    from wlr_gym.policy import Policy

Picture = NDArray[np.uint8]

#: Pictures per second of a film, where the control period allows.
FPS = 25.0


class Driver(Protocol):
    """Where commands come from, if not from the task."""

    def command(self, time: float) -> Mapping[str, float]:
        """Return the commands from ``time`` (s since the episode began) on."""
        ...

    def wants_reset(self) -> bool:
        """Return whether a new episode was asked for since the last call."""
        ...


class OwnCommands:
    """Leaves the commands to the task."""

    def command(self, time: float) -> Mapping[str, float]:
        """Return nothing to change."""
        return {}

    def wants_reset(self) -> bool:
        """Return False."""
        return False


def drive(core: Core, policy: Policy, seed: int, driver: Driver | None = None) -> Iterator[None]:
    """Let a policy drive the one robot of ``core`` for ever, episode after episode, yielding before every control tick.

    Args:
        core: a batch of one.
        policy: what drives it.
        seed: of the first episode; the following go on from it.
        driver: where the commands come from; None = the task's own.
    """
    driver, period = driver or OwnCommands(), core.task.config.control_period
    core.seed(0, seed)
    while True:
        commands = driver.command(0.0)
        core.begin_episodes(core.everyone, {"command": dict(commands)} if commands else None)
        policy.reset(core.everyone)
        yield
        while not (driver.wants_reset() or core.terminated[0] or core.truncated[0]):
            if commands := driver.command(float(core.ticks[0]) * period):
                core.set_command(dict(commands))
            core.step(policy.act(core.observation), core.everyone)
            yield


def film_length(core: Core, seconds: float) -> tuple[int, int, float]:
    """Return how many pictures a film of ``seconds`` has, how many control ticks each stands for, and pictures per second."""
    period = core.task.config.control_period
    every = max(1, round(1.0 / (FPS * period)))
    return max(1, round(seconds / (every * period))), every, 1.0 / (every * period)


def film(
    core: Core,
    policy: Policy,
    seed: int,
    seconds: float,
    *,
    view: View | None = None,
    driver: Driver | None = None,
    title: str = "",
) -> Iterator[Picture]:
    """Yield the pictures of a film; see :func:`film_length` for how many and how fast.

    Args:
        core, policy, seed, driver: as in :func:`drive`.
        seconds: length.
        view: what to show.
        title: first line of the text.

    Raises:
        InputError: no OpenGL on this machine.
    """
    from wlr_gym.render import Scene

    count, every, _ = film_length(core, seconds)
    scene = Scene(core.task.robot, view)
    ticks = drive(core, policy, seed, driver)
    try:
        for index in range(count):
            for _ in range(every if index else 1):
                next(ticks)
            yield scene.draw(core.plant.truth(), core.parameters, time=present_time(core), command=commands(core), title=title)
    finally:
        scene.close()


def present_time(core: Core) -> float:
    """Return the time of the first robot since its episode began, s."""
    return float(core.ticks[0]) * core.task.config.control_period


def commands(core: Core) -> dict[str, float]:
    """Return the present commands of the first robot by name."""
    return dict(zip(core.task.commands, core.command[0].tolist(), strict=True))
