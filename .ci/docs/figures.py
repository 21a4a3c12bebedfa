"""Figures of the documentation that no command of wlr makes: ``python .ci/docs/figures.py [NAME ...]``, all without a name."""

from __future__ import annotations

import itertools
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.plots import BLUE, legend_below, new_figure, save, tidy
from wlr_gym.envs.tasks import load_randomization
from wlr_gym.envs.tasks.signals import path_point
from wlr_gym.learning.evaluation.conditions import SHAPES, SWEEPS
from wlr_gym.learning.evaluation.film import Journey, commands, drive, present_time
from wlr_gym.learning.evaluation.plots import draw_floors
from wlr_gym.learning.evaluation.rollout import roll_out, start_episodes
from wlr_gym.learning.evaluation.subjects import make_player
from wlr_gym.render.teleop import Script
from wlr_gym.render.view import View
from wlr_gym.robot import load_robot

Picture = NDArray[np.uint8]

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "figures"
#: Presets whose floors can be told by friction along the heading.
PRESETS = ("nominal", "wide", "ice", "split", "patches", "slippery", "asymmetric", "slope", "stripes")
#: Seed of the floors: one of which each kind is well seen.
FLOOR = 6
EPISODES = 8
#: Floors that ship -> camera, where along x the robot stands on them (m), and a seed that draws large heights.
FLOORS = {
    "flat": ("follow", 0.0, 0),
    "rough": ("follow", 0.0, 6),
    "gravel": ("follow", 0.0, 6),
    "kerbs": ("follow", 0.66, 168),
    "ramps": ("side", 0.66, 19),
    "stairs": ("side", 1.02, 141),
}
#: Control periods from one picture of the climb to the next.
EVERY = 8
#: Environment steps of a leg sweep that are shown.
SHOWN = (190, 345, 525)
#: Pixels; of a still with text.
SIZE = (480, 400)


def randomization_floors(path: Path) -> None:
    """A floor of each preset that has one to be seen."""
    robot = load_robot()
    draw_floors(path, [load_randomization(name, robot) for name in PRESETS], FLOOR, count=1)


def environment_path(path: Path) -> None:
    """Episodes on a line, an S-curve and a circle, each seen from where its path begins."""
    figure = new_figure(9.0, 3.4)
    grid = figure.add_gridspec(2, 2, width_ratios=(2.2, 1.0))
    for k, (shape, place) in enumerate(zip(SHAPES, (grid[0, 0], grid[1, 0], grid[:, 1]), strict=True)):
        axes = figure.add_subplot(place)
        bend = {"path_shape": k + 0.5, "path_curvature": 1.2, "path_wavelength": 1.4}
        driven, length = _driven(bend)
        axes.plot(*driven.transpose(2, 0, 1), color=BLUE, linewidth=0.9, label="driven")
        straight = bend | {"path_heading": 0.0, "path_offset": 0.0}
        wanted = np.array([path_point(straight, way) for way in np.linspace(0.0, length, 200)])
        axes.plot(*wanted.T, "--", color="black", linewidth=1.2, label="path")
        axes.set(title=shape, xlabel="x (m)", ylabel="y (m)", aspect="equal")
        axes.title.set_fontsize(10)
        if k < 2:
            axes.set(xlim=(-0.1, 2.4), ylim=(-0.25, 0.35), yticks=(-0.2, 0.0, 0.2))
        else:
            axes.set(xlim=(-0.1, 1.0), xticks=(0.0, 0.5, 1.0), yticks=(0.0, 0.5, 1.0, 1.5))
        tidy(axes)
    legend_below(figure)
    save(figure, path)


def environment_velocity(path: Path) -> None:
    """An episode on a floor with patches: straight on, then a turn."""
    shown = {4.0: "straight on", 10.0: "turning since 4 s"}
    _write_stills(path, "WLR-Velocity-v0", {}, View(size=SIZE, path=True), "0:0.1,0; 4:0.1,0.25", shown)


def environment_slope(path: Path) -> None:
    """A climb, and holding, seen from one place beside the slope."""
    shown = {1.0: "begins to climb", 11.0: "holds since 6 s"}
    _write_stills(
        path, "WLR-Slope-v0", {}, View(size=SIZE, camera="side", forces=True, path=True), "0.05,6", shown, (0.14, -0.12)
    )


def environment_posture(path: Path) -> None:
    """The robot before, in and after the leg sweep of the paper's second test, from the side."""
    from PIL import Image

    from wlr_gym.render import Scene
    from wlr_gym.render.scene import banner

    core, policy = make_player("WLR-Posture-v0", "slip_compensating", 1, {"randomization": "none"})
    scene, pictures = Scene(core.task.robot, View(size=(420, 300), camera="side", text=False)), []
    start_episodes(core, policy, 0, {"command": dict(SWEEPS["paper"].points[1].commands)})
    for tick in range(1 + max(SHOWN)):
        if tick in SHOWN:
            title = banner(420, f"t = {tick * core.task.config.control_period:g} s", 20)
            pictures.append(np.vstack([title, scene.draw(core.plant.truth(), core.parameters)]))
        core.step(policy.act(core.observation), core.everyone)
    scene.close()
    core.close()
    Image.fromarray(np.hstack(pictures)).quantize(128).save(path)


def scene(path: Path) -> None:
    """Three cameras on one robot between two patches, and a robot on a slope with a payload and a floor under each wheel."""
    size = (480, 360)
    turn = [View(size), View(size, camera="top"), View(size, camera="side", forces=True)]
    three = _drawn(turn, _patch(1, 0.1, (0.25, 0.75)) | _patch(2, 1.0, (-0.85, -0.25)), {"yaw_rate": 0.3}, 63)
    wheels = {f"ground.mu_{axis}[wheel_{k}]": 0.2 if k[0] == "l" else 0.8 for axis in "xy" for k in ("lf", "rf", "lr", "rr")}
    slope = {"ground.slope[pitch]": 0.15, "payload.mass": 1.0, "payload.position[z]": 0.07, **wheels}
    (one,) = _drawn([View(size, camera="side")], slope, {"linear_velocity_x": 0.0}, 0)
    _write(path, np.vstack([np.hstack(three[:2]), np.hstack([three[2], one])]))


def floors(path: Path) -> None:
    """A robot on each floor that ships."""
    from wlr_gym.physics.floor import load_floor
    from wlr_gym.render.scene import banner, floor_portrait

    robot, panels = load_robot(), []
    for name, (camera, x, seed) in FLOORS.items():
        floor, size = load_floor(name), (420, 300)
        picture = floor_portrait(robot, floor, View(size, camera, text=False), (x, 0.0), seed)
        panels.append(np.vstack([banner(size[0], f"{name}: {floor.summary}", 22), picture]))
    _write(path, np.vstack([np.hstack(panels[:3]), np.hstack(panels[3:])]))


def one_wheel_at_a_time(path: Path) -> None:
    """A kerb of two wheel radii, climbed in the engine by the script of ``studies.bench.climbing``, filmed."""
    from studies.bench.climbing import KERB, ONE_BY_ONE, ONE_BY_ONE_START, REAR_GAP, Climber
    from wlr_gym.render import Scene, write_video
    from wlr_gym.render.scene import banner

    robot = load_robot()
    view = View((480, 260), "side", text=False, slip=False, loads=True)
    scene, pictures, ticks = Scene(robot, view), [], itertools.count()

    class Filmed(Climber):
        def _step(self) -> None:
            super()._step()
            if next(ticks) % EVERY == 0:
                now = self.plant.truth(), self.plant.parameters
                pictures.append(scene.draw(*now, look_at=(KERB - 0.04, 0.0), contacts=self.plant.contacts))

    climber = Filmed("gibbs_appell", robot, 0.07, 0.3, legs=ONE_BY_ONE_START)
    for legs, way, seconds in ONE_BY_ONE:
        rear_gap = KERB - climber.wheels()[:, 2:, 0].max(axis=1) - robot.wheel.radius
        climber.move(legs, rear_gap - REAR_GAP if way is None else way, seconds)
    climber.hold(1.0)
    scene.close()
    title = banner(view.size[0], "a kerb of 70 mm, friction 0.3; green: loads; twice as fast as it was", 22)
    write_video(path.with_suffix(".webp"), [np.vstack([title, one]) for one in pictures], fps=2.0 * 50.0 / EVERY)


def _patch(number: int, mu: float, x: tuple[float, float]) -> dict[str, float]:
    sides = {"mu": mu, "x_min": x[0], "x_max": x[1], "y_min": -0.4, "y_max": 0.4}
    return {f"patch.{side}[patch_{number}]": value for side, value in sides.items()}


def _drawn(views: list[View], parameters: dict[str, float], asked: dict[str, float], steps: int) -> list[Picture]:
    """Return pictures of a robot at 0.1 m/s after some steps."""
    from wlr_gym.render import Scene

    core, policy = make_player("WLR-Velocity-v0", "pid", 1, {"randomization": "none"})
    start_episodes(core, policy, 0, {"parameters": parameters, "command": {"linear_velocity_x": 0.1, "yaw_rate": 0.0} | asked})
    for _ in range(steps):
        core.step(policy.act(core.observation), core.everyone)
    pictures = []
    for view in views:
        scene = Scene(core.task.robot, view)
        pictures.append(scene.draw(core.plant.truth(), core.parameters, time=present_time(core), command=commands(core)))
        scene.close()
    core.close()
    return pictures


def _write(path: Path, picture: Picture) -> None:
    from PIL import Image

    Image.fromarray(picture).quantize(256, kmeans=1).save(path)


def _write_stills(
    path: Path,
    environment: str,
    keywords: dict[str, Any],
    view: View,
    schedule: str,
    shown: dict[float, str],
    look_at: tuple[float, float] | None = None,
) -> None:
    """Write pictures of the episode of seed 0 beside each other: at which time (s) -> what the robot does, for the title."""
    from wlr_gym.render import Scene
    from wlr_gym.render.scene import banner

    core, policy = make_player(environment, "slip_compensating", 1, keywords)
    scene, journey, pictures = Scene(core.task.robot, view), Journey(), []
    ticks = drive(core, policy, 0, Script(schedule, core.task.commands))
    while len(pictures) < len(shown):
        next(ticks)
        journey.note(core)
        time = round(present_time(core), 6)
        if time in shown:
            texts = {"time": time, "command": commands(core), "trails": journey.trails(), "look_at": look_at}
            title = banner(view.size[0], f"t = {time:g} s: {shown[time]}", 24)
            pictures.append(np.vstack([title, scene.draw(core.plant.truth(), core.parameters, **texts)]))
    scene.close()
    core.close()
    _write(path, np.hstack(pictures))


def _driven(bend: dict[str, float]) -> tuple[NDArray[np.float64], float]:
    """Return positions (T, N, 2) in the frame of each episode's path, NaN after its end, and the longest way, m."""
    core, policy = make_player("WLR-Path-v0", "slip_compensating", EPISODES, {})
    played = roll_out(core, policy, commands=bend)
    x, y, yaw = core.start.T
    core.close()
    shifted = played.position - np.stack([x, y], axis=1)
    offset, heading = (played.commanded(f"path_{name}")[0] for name in ("offset", "heading"))
    placed = _turned(_turned(shifted, yaw) - np.stack([0.0 * offset, offset], axis=1), heading)
    placed[~played.active] = np.nan
    speed = played.commanded("linear_velocity_x") * played.active
    return placed, float(speed.sum(axis=0).max() * played.control_period)


def _turned(points: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (T, N, 2) in frames that are turned by angles (N,)."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * points[..., 0] + sin * points[..., 1], cos * points[..., 1] - sin * points[..., 0]], axis=-1)


def vision_slip(path: Path) -> None:
    """Slip in a rendered film of a skid turn, as ``wlr vision`` draws it."""
    from studies.bench.vision import CAMERA, TRUE_OFFSET, film, skid_turn
    from wlr_gym.perception.markers.targets import load_target
    from wlr_gym.perception.scene import Look, Renderer, floor_facets, view
    from wlr_gym.perception.vision.analysis import analyse, save_video_analysis

    drive, body, floor = skid_turn(load_robot()), load_target("body"), load_target("floor")
    frames = film(drive, Renderer(CAMERA, view(0.0, 2.0), floor_facets(floor)), body, Look(), TRUE_OFFSET)
    with tempfile.TemporaryDirectory() as folder:
        save_video_analysis(analyse(frames, drive.run, CAMERA, body, floor, drive.robot), Path(folder))
        shutil.copyfile(Path(folder) / "slip.png", path)


FIGURES: dict[str, Callable[[Path], None]] = {
    draw.__name__: draw
    for draw in (
        randomization_floors,
        environment_velocity,
        environment_path,
        environment_posture,
        environment_slope,
        scene,
        floors,
        one_wheel_at_a_time,
        vision_slip,
    )
}

if __name__ == "__main__":
    for name in sys.argv[1:] or FIGURES:
        FIGURES[name](FOLDER / f"{name}.png")
