"""Films of a policy at work."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from wlr_gym.envs.interfaces import Infos
from wlr_gym.envs.tasks.signals import Signals, climb_speed, path_point, yaw_of
from wlr_gym.render.view import DRIVEN, WANTED, View

if TYPE_CHECKING:
    from wlr_gym.envs.core import Core
    from wlr_gym.learning.evaluation.subjects import Subject
    from wlr_gym.policy import Policy
    from wlr_gym.render.stage import Trail

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

#: Pictures per second of a film, where the control period allows.
FPS = 25.0


class Driver(Protocol):
    """Where commands come from, if not from the task."""

    def command(self, time: float) -> Mapping[str, float]:
        """Return the commands from ``time`` (s since the episode began) on."""
        ...

    def wants_reset(self) -> bool:
        """Return whether a new episode is requested since the last call."""
        ...


def drive(core: Core, policy: Policy, seed: int, driver: Driver | None = None) -> Iterator[None]:
    """Let a policy drive the one robot of ``core`` for ever, episode after episode, yielding before every environment step.

    Args:
        core: a batch of one.
        policy: what drives it.
        seed: of the first episode; the following ones follow from it.
        driver: where the commands come from; None = the task's own.
    """
    core.seed(0, seed)
    while True:
        commands = driver.command(0.0) if driver else {}
        core.begin_episodes(core.everyone, {"command": dict(commands)} if commands else None)
        policy.reset(core.everyone)
        yield
        while not ((driver and driver.wants_reset()) or core.terminated[0] or core.truncated[0]):
            if driver and (commands := driver.command(present_time(core))):
                core.set_command(dict(commands))
            core.step(policy.act(core.observation), core.everyone)
            yield


def film_length(core: Core, seconds: float, fps: float = FPS) -> tuple[int, int, float]:
    """Return the number of pictures of a film of ``seconds``, environment steps per picture, and pictures per second."""
    period = core.task.config.control_period
    every = max(1, round(1.0 / (fps * period)))
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
    fps: float = FPS,
) -> Iterator[Picture]:
    """Yield the pictures of a film; see :func:`film_length` for how many and how fast.

    Args:
        core, policy, seed, driver: as in :func:`drive`.
        seconds: length.
        view: what to show.
        title: first line of the text.
        fps: pictures per second, where the control period allows.

    Raises:
        InputError: no OpenGL on this machine.
    """
    from wlr_gym.physics.plants.contacts import contacts_of_plant
    from wlr_gym.render import Scene

    count, every, _ = film_length(core, seconds, fps)
    scene, path = Scene(core.task.robot, view), Journey()
    ticks, contacts = drive(core, policy, seed, driver), contacts_of_plant(core.plant)
    try:
        for index in range(count):
            for _ in range(every if index else 1):
                next(ticks)
                path.note(core)
            trails = path.trails() if scene.view.path else []
            texts = {"time": present_time(core), "command": commands(core), "title": title, "result": result(core)}
            yield scene.draw(core.plant.truth(), core.parameters, trails=trails, contacts=contacts, **texts)
    finally:
        scene.close()


def film_beside(
    path: Path,
    environment: str,
    subjects: Sequence[Subject],
    seed: int,
    seconds: float,
    keywords: Mapping[str, Any],
    *,
    view: View | None = None,
    schedule: str | None = None,
    title: str = "",
    fps: float = FPS,
    watch: Callable[[Iterable[Picture], int], Iterable[Picture]] = lambda pictures, count: pictures,
) -> Path:
    """Film one subject, or two side by side in the same episode, and write the film.

    Args:
        path: see :func:`wlr_gym.render.write_video`.
        environment, keywords: id, and keywords of the environment.
        subjects: one or two.
        seed, seconds, view, title, fps: as for :func:`film`.
        schedule: commands from given times on, see :class:`wlr_gym.render.teleop.Script`; None = the task's own.
        watch: is given the pictures and how many there will be, and yields them (progress bars).
    """
    from wlr_gym.learning.evaluation.subjects import make_player
    from wlr_gym.render import side_by_side, write_video
    from wlr_gym.render.teleop import Script

    with ExitStack() as stack:
        films, count, rate = [], 0, fps
        for subject in subjects:
            core, policy = make_player(environment, subject.sources[0], 1, keywords)
            stack.callback(core.close)
            driver = None if schedule is None else Script(schedule, core.task.commands)
            count, _, rate = film_length(core, seconds, fps)
            films.append(film(core, policy, seed, seconds, view=view, driver=driver, title=title, fps=fps))
        pictures = films[0] if len(films) == 1 else side_by_side(films[0], films[1], (subjects[0].name, subjects[1].name))
        return write_video(path, watch(pictures, count), rate, count)


def result(core: Core) -> str:
    """Return the tracking error of the first robot's episode so far, as text; nothing where the task has none."""
    return f"tracking error {Infos(core).tracking_error()[0]:.2f} so far" if core.task.config.success else ""


class Journey:
    """Where the robot went in this episode, and its commanded path, or where its commands would have taken it from its start.

    Floor frame; a commanded path is as long as the commanded speed goes in the time that has passed.
    """

    def __init__(self) -> None:
        self._driven: list[Array] = []
        self._wanted: list[Array] = []
        self._yaw = 0.0
        self._way = 0.0

    def note(self, core: Core) -> None:
        """Note the present step."""
        truth, asked = core.plant.truth(), commands(core)
        place = truth.position[0, :2].copy()
        if core.episodes.steps[0] == 0 or not self._driven:
            self._driven, self._yaw, self._way = [], float(yaw_of(*truth["quaternion"].T)[0]), 0.0
            self._wanted = [_on_floor(core, path_point(asked, 0.0)) if "path_shape" in asked else place]
        else:
            period = core.task.config.control_period
            step = period * asked.get("linear_velocity_x", 0.0)
            self._way += step
            self._yaw += period * asked.get("yaw_rate", 0.0)
            ahead = self._wanted[-1] + step * np.array([math.cos(self._yaw), math.sin(self._yaw)])
            self._wanted.append(_on_floor(core, path_point(asked, self._way)) if "path_shape" in asked else ahead)
        self._driven.append(place)

    def trails(self) -> list[Trail]:
        """Return both, to be drawn."""
        from wlr_gym.render.stage import Trail

        return [Trail(np.array(self._wanted), WANTED, dashed=True), Trail(np.array(self._driven), DRIVEN)]


def _on_floor(core: Core, point: tuple[float, float]) -> Array:
    """Return a point of the frame of the first robot's start in the floor frame, m."""
    x, y, yaw = core.start[0]
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([x + cos * point[0] - sin * point[1], y + sin * point[0] + cos * point[1]])


def present_time(core: Core) -> float:
    """Return the time of the first robot since its episode began, s."""
    return float(core.episodes.steps[0]) * core.task.config.control_period


def commands(core: Core) -> dict[str, float]:
    """Return the present commands of the first robot by name; of a climb also the forward velocity asked for now."""
    found = dict(zip(core.task.commands, core.command[0].tolist(), strict=True))
    if "climb_speed" not in found:
        return found
    signals = {"time": present_time(core)} | {f"command.{name}": value for name, value in found.items()}
    return found | {"linear_velocity_x": float(climb_speed(Signals(signals.__getitem__)))}
