"""Drive a robot: in a window or on a page in the browser with keys or a gamepad, or into a video with commands by schedule."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

from wlr_gym.base.errors import InputError, Interval, check_name
from wlr_gym.base.files import refuse_existing
from wlr_gym.base.progress import tracked
from wlr_gym.cli import OK
from wlr_gym.cli.options import (
    FloorOption,
    ForceOption,
    JsonOption,
    PatchOption,
    Seconds,
    Seed,
    SensorsOption,
    environment_of,
    note_untrained,
    require_simulator,
)
from wlr_gym.cli.terminal import print_json
from wlr_gym.policy import Policy, environment_for, make_policy
from wlr_gym.render.teleop import Gamepad, Keyboard, Ranges, Script
from wlr_gym.render.video import check_video
from wlr_gym.render.view import CAMERAS, LARGEST, SMALLEST, View, fits, require_display
from wlr_gym.render.web.page import HOST, PORT
from wlr_gym.robot import Robot

if TYPE_CHECKING:
    from wlr_gym.envs.core import Core
    from wlr_gym.learning.evaluation.film import Driver
    from wlr_gym.render.viewer import KeyCallback, Viewer
    from wlr_gym.render.web.player import WebViewer

    NewViewer = Callable[["PlayOptions", Robot, KeyCallback | None], Viewer | WebViewer]

#: s; length of a video unless asked otherwise.
SECONDS = 10.0
#: Pictures per second of a video.
FPS = 25.0


@dataclass(frozen=True)
class PlayOptions(JsonOption, ForceOption, PatchOption, FloorOption, SensorsOption):
    env: tyro.conf.Positional[str | None] = None
    """Environment id, see: wlr envs; default: the one the policy was trained in, else WLR-Velocity-v0."""
    agent: str = "pid"
    """Policy file or folder, run folder, or name of an agent or shipped policy."""
    beside: str | None = None
    """A second one, in the same episode, beside the first in a video."""
    backend: str = "gibbs_appell"
    """Simulator: gibbs_appell or mujoco."""
    randomization: str | None = None
    """Name in configs/randomization/ or path; default: the task's."""
    robot: str | None = None
    """Robot file, or name in configs/robot/; default: the robot that the policy was trained with, else the task's."""
    seed: Seed = 0
    """Seed of the first episode."""
    command: str | None = None
    """Commands by schedule instead of keys: '0.1,0' for good, or '0:0.1,0; 3:0.05,0.3' from these times (s) on."""
    gamepad: bool = False
    """Take commands from the first gamepad instead of the keys."""
    web: bool = False
    """A page in the browser instead of a window: works over ssh; keys I, K, J and L drive."""
    host: str = HOST
    """Of the page: name or address to listen on; localhost = this machine, and ssh to it, only."""
    port: int = PORT
    """Of the page; where it is taken, the next free one."""
    video: Path | None = None
    """Write a video (.webp, .gif, .png, .mp4) instead of opening a window; without --command, the task's own commands."""
    seconds: Seconds | None = None
    """Length; default: 10 s of video, or until the window is closed, or Ctrl-C."""
    fps: Annotated[float, Interval(least=1.0, most=1000.0)] = FPS
    """Pictures per second of a video, where the control period allows."""
    camera: str = "follow"
    """View: follow, chase, side or top."""
    size: tuple[int, int] = (640, 480)
    """Width and height of the video, pixels."""
    forces: bool = False
    """Also draw the friction force on each wheel; a page can switch it on and off."""
    loads: bool = False
    """Also draw the normal force on each wheel; a page draws it with the friction force."""
    path: bool = False
    """In a video: also draw where the robot went and where its commands would have taken it."""


def run(options: PlayOptions) -> int:
    """Play, until the window is closed or the video is written."""
    from wlr_gym.envs.tasks.task import having
    from wlr_gym.learning.evaluation.rollout import make_core

    _check(options)
    keywords: dict[str, Any] = {name: getattr(options, name) for name in ("backend", "randomization", "robot", "floor")}
    keywords |= {"effects": options.patch(), **having(options.present())}
    own = environment_for(options.agent, keywords)
    note_untrained([options.agent, *([options.beside] if options.beside else [])])
    keywords["robot"] = own["robot"]  # a second one drives the same robot
    with closing(make_core(environment_of(options.env, options.agent), 1, own)) as core:
        policy = make_policy(options.agent, core.contract())
        driver = _driver(options, core)
        if options.video is not None:
            _film(options, options.video, core, policy, driver, keywords)
        else:
            if not options.web:
                require_display()  # after all names, which are checked first
            show(options, core, policy, driver)
    return OK


def _check(options: PlayOptions) -> None:
    require_simulator(options.backend, "a real robot is driven with wlr deploy; wlr play takes a simulator")
    if options.gamepad and (options.command is not None or options.video is not None):
        raise InputError("--gamepad drives in the window: leave out --command and --video")
    check_name("view", options.camera, CAMERAS, "--camera")
    size = f"--size {options.size[0]} {options.size[1]}"
    if not all(map(fits, options.size)):
        raise InputError(f"{size}: expected width and height, each {SMALLEST} to {LARGEST} pixels")
    if options.video is not None and options.video.suffix.lower() == ".mp4" and any(pixels % 2 for pixels in options.size):
        raise InputError(f"{size}: expected even numbers: .mp4 has no others")
    if options.beside is not None and options.video is None:
        raise InputError("--beside: two robots are shown in a video only: add --video")
    if options.json and options.video is None:
        raise InputError("--json: says what was written: add --video")
    if options.web and options.video is not None:
        raise InputError("--web and --video: one or the other")
    if options.video is not None:
        check_video(options.video)
        refuse_existing(options.video, options.force, "--video")


def _view(options: PlayOptions) -> View:
    arrows = {"forces": options.forces, "loads": options.loads}
    return View(size=options.size, camera=options.camera, path=options.path, **arrows)


def _driver(options: PlayOptions, core: Core) -> Driver | None:
    names = core.task.commands
    terms = core.task.config.commands.terms
    ranges = {name: (float(terms[name][0]), float(terms[name][1])) for name in names}
    if options.command is not None:
        script = Script(options.command, names)
        _check_commands(script, ranges, core.task.robot)
        return script
    if options.video is not None:
        return None
    return Gamepad(ranges) if options.gamepad else Keyboard(ranges)


def _check_commands(script: Script, ranges: Ranges, robot: Robot) -> None:
    """Refuse commands that the robot cannot follow; warn of those that policies were not trained on."""
    from wlr_gym.envs.tasks.terms import COMMANDS

    reach = {name: COMMANDS[name].bounds(robot) for name in ranges}
    for name, value in script.outside(reach).items():
        raise InputError(f"--command: {name} = {value:g}: expected {COMMANDS[name].words(*reach[name])}")
    for name, value in script.outside(ranges).items():
        low, high = ranges[name]
        print(
            f"note: --command: {name} = {value:g} {COMMANDS[name].unit} is outside what the task commands, "
            f"[{low:g}, {high:g}]; a policy may not follow it",
            file=sys.stderr,
        )


def _film(
    options: PlayOptions, video: Path, core: Core, policy: Policy, driver: Driver | None, keywords: dict[str, Any]
) -> None:
    """Film the policy, beside a second one where there is one, and say what was written."""
    from wlr_gym.learning.evaluation.film import film, film_beside, film_length
    from wlr_gym.learning.evaluation.subjects import read_subjects
    from wlr_gym.render import write_video

    def watch(pictures: Iterable[Any], count: int) -> Iterable[Any]:
        return tracked(pictures, count, "drawing", Console())

    seconds, view = SECONDS if options.seconds is None else options.seconds, _view(options)
    count, _, fps = film_length(core, seconds, options.fps)
    if options.beside is None:
        title = f"{options.agent} on {core.plant.capabilities.name}"
        pictures = film(core, policy, options.seed, seconds, view=view, driver=driver, title=title, fps=options.fps)
        write_video(video, watch(pictures, count), fps, count)
    else:
        subjects, env = read_subjects([options.agent, options.beside]), environment_of(options.env, options.agent)
        film_beside(
            video,
            env,
            subjects,
            options.seed,
            seconds,
            keywords,
            view=view,
            schedule=options.command,
            fps=options.fps,
            watch=watch,
        )
    print(f"written: {video} ({count} pictures, {count / fps:g} s)")
    if options.json:
        print_json({"video": video, "pictures": count, "seconds": count / fps})


def _viewer(options: PlayOptions, robot: Robot, on_key: KeyCallback | None) -> Viewer | WebViewer:
    """Return the page, or the window, and say what its keys do."""
    if options.web:
        from wlr_gym.render.web.player import HELP, WebViewer

        viewer = WebViewer(robot, _view(options), on_key, options.host, options.port)
    else:
        from wlr_gym.render.teleop import HELP
        from wlr_gym.render.viewer import Viewer

        viewer = Viewer(robot, _view(options), on_key)
    if on_key is not None:
        print(HELP)
    return viewer


def show(options: PlayOptions, core: Core, policy: Policy, driver: Driver | None, new_viewer: NewViewer = _viewer) -> None:
    """Play in a window until it is closed, on a page until Ctrl-C, or for ``options.seconds``; ``new_viewer`` makes either."""
    from wlr_gym.learning.evaluation.film import commands, drive, present_time
    from wlr_gym.physics.plants.contacts import contacts_of_plant

    period, contacts = core.task.config.control_period, contacts_of_plant(core.plant)
    with closing(new_viewer(options, core.task.robot, driver.press if isinstance(driver, Keyboard) else None)) as viewer:
        for tick, _ in enumerate(drive(core, policy, options.seed, driver)):
            if options.seconds is not None and tick * period > options.seconds:
                break
            texts = {"time": present_time(core), "command": commands(core), "title": options.agent}
            if not viewer.show(core.plant.truth(), core.parameters, period=period, contacts=contacts, **texts):
                break
