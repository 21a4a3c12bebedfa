"""What is in a picture, and where."""

import os
import subprocess
import sys
import threading
from typing import Any

import numpy as np
import pytest
from standing import PLAIN, truth_of

from wlr_gym.base.errors import InputError
from wlr_gym.base.settings import overlay
from wlr_gym.physics.plants import SIMULATORS, PlantOptions, make_plant
from wlr_gym.render import scene as gl
from wlr_gym.render import stage as marks
from wlr_gym.render import view as camera
from wlr_gym.render.scene import describe, legend
from wlr_gym.render.stage import Stage
from wlr_gym.render.view import View, magnification, read_view
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters


def at(picture, scene, point):
    """Mean colour of the 3 x 3 pixels around a point of the floor frame."""
    column, row = np.rint(scene.pixels(point)).astype(int)
    assert 1 < column < picture.shape[1] - 2
    assert 1 < row < picture.shape[0] - 2
    return picture[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3).mean(axis=0)


def posed(robot, truth, parameters):
    stage = Stage(robot, parameters)
    stage.pose(truth, parameters)
    return stage


def lay_patch(parameters, index, mu, x, y):
    for name, value in (("mu", mu), ("x_min", x[0]), ("x_max", x[1]), ("y_min", y[0]), ("y_max", y[1])):
        parameters[f"patch.{name}"][:, index] = value


# ---- paths ----


def test_a_path_lies_where_it_was_driven(new_scene, parameters):
    scene = new_scene(View(size=(320, 240), camera="top", text=False))
    points = np.stack([np.linspace(-0.5, 0.5, 101), np.full(101, 0.3)], axis=1)
    truth = truth_of(parameters)
    picture = scene.draw(truth, parameters, trails=[marks.Trail(points, (1.0, 0.0, 0.0))])
    red, green, _ = at(picture, scene, [0.2, 0.3, 0.0])
    assert red > 1.5 * green
    red, green, _ = at(picture, scene, [0.2, 0.4, 0.0])
    assert red < 1.2 * green
    assert np.array_equal(scene.draw(truth, parameters), scene.draw(truth, parameters, trails=[]))


def test_pieces_of_a_path():
    points = np.stack([np.linspace(0.0, 0.3, 31), np.zeros(31)], axis=1)
    whole = marks.pieces(marks.Trail(points, (0.0, 0.0, 0.0)))
    assert whole[0].start[0] == 0.0
    assert whole[-1].end[0] == pytest.approx(0.3)
    assert sum(np.hypot(*(one.end - one.start)[:2]) for one in whole) == pytest.approx(0.3)
    assert len(marks.pieces(marks.Trail(points, (0.0, 0.0, 0.0), dashed=True))) == (len(whole) + 1) // 2
    assert marks.pieces(marks.Trail(points[:1], (0.0, 0.0, 0.0))) == []


# ---- the picture ----


@pytest.mark.parametrize("name", camera.CAMERAS)
def test_every_camera_sees_the_robot_in_the_middle(new_scene, parameters, name):
    scene = new_scene(View(size=(320, 240), camera=name, text=False))
    picture = scene.draw(truth_of(parameters), parameters)
    assert picture.shape == (240, 320, 3)
    assert picture.dtype == np.uint8
    assert 60 < picture.mean() < 230
    gone = scene.draw(truth_of(parameters, position=[[0, 0, -5.0]]), parameters)
    changed = np.argwhere(np.abs(picture.astype(int) - gone).sum(axis=2) > 60)
    assert 0.05 < len(changed) / (240 * 320) < 0.5
    assert np.allclose(changed.mean(axis=0), [120, 160], atol=36)
    low, high = changed.min(axis=0), changed.max(axis=0)
    assert (low > 5).all()
    assert (high < [234, 314]).all()


def test_same_input_same_picture_and_nothing_of_it_changes(new_scene, parameters):
    truth = truth_of(parameters, slip_velocity=0.1)
    before = truth.values.copy(), parameters.values.copy()
    scene = new_scene(View(size=(320, 240)))
    first = scene.draw(truth, parameters, time=1.0, command={"yaw_rate": 0.1})
    scene.draw(truth_of(parameters, position=[[3.0, 2.0, 0.2]]), parameters)
    again = scene.draw(truth, parameters, time=1.0, command={"yaw_rate": 0.1})
    other = new_scene(View(size=(320, 240))).draw(truth, parameters, time=1.0, command={"yaw_rate": 0.1})
    assert np.array_equal(first, again)
    assert np.array_equal(first, other)
    assert np.array_equal(truth.values, before[0])
    assert np.array_equal(parameters.values, before[1])


def test_the_picture_is_of_the_row_asked_for(new_scene, robot):
    parameters = Parameters.nominal(robot, 2)
    truth = truth_of(parameters)
    truth["joint_position"][1, :4] = 1.1
    scene = new_scene()
    pictures = [scene.draw(truth, parameters, row) for row in (0, 1)]
    alone = scene.draw(truth_of(Parameters.nominal(robot)), Parameters.nominal(robot))
    assert np.array_equal(pictures[0], alone)
    assert not np.array_equal(pictures[0], pictures[1])


def test_a_turning_wheel_is_seen(new_scene, parameters):
    scene = new_scene(View(size=(640, 480), camera="side", text=False))
    still = truth_of(parameters)
    turned = truth_of(parameters)
    turned["joint_position"][:, 4:] = 0.3
    difference = np.abs(scene.draw(still, parameters).astype(int) - scene.draw(turned, parameters)).sum(axis=2)
    rows, _ = np.nonzero(difference > 60)
    assert len(rows) > 50
    wheel = scene.pixels([[0.0, 0.0, 0.07], [0.0, 0.0, -0.02]])[:, 1]
    assert (rows > wheel[0] - 40).all()


def test_sizes_come_from_the_parameters(new_scene, parameters):
    """A larger wheel is drawn larger, in the same scene; the axle stays where the truth says."""
    scene = new_scene(View(size=(640, 480), camera="side", text=False))
    truth = truth_of(parameters, position=[[0, 0, 0.3]])
    small = scene.draw(truth, parameters)
    large = parameters.copy()
    large["wheel.radius"][:] *= 1.5
    grown = scene.draw(truth, large)
    below = [0.175, -0.16, 0.3 - 0.135 - 1.25 * 0.034]
    assert at(small, scene, below).mean() > 100
    assert at(grown, scene, below).mean() < 60
    assert np.array_equal(scene.draw(truth, parameters), small)


def test_payload_is_drawn_where_it_is(new_scene, parameters):
    loaded = parameters.copy()
    loaded["payload.mass"], loaded["payload.position"] = 1.0, [0.1, -0.05, 0.1]
    scene = new_scene(View(size=(320, 240), camera="side", text=False))
    place = [0.1, -0.05, 0.17 + 0.1]
    bare, with_it = (scene.draw(truth_of(parameters), given) for given in (parameters, loaded))
    assert np.abs(at(bare, scene, place) - at(with_it, scene, place)).max() > 50


def test_every_plant_looks_like_its_truth_and_starts_alike(new_scene, robot, parameters):
    """The scene knows no plant: the engine's truth, and the same numbers in a bare matrix."""
    scene, starts = new_scene(), []
    for backend in SIMULATORS:
        plant = make_plant(backend, robot, 1, PlantOptions())
        plant.reset(parameters=parameters)
        starts.append(scene.draw(plant.truth(), plant.parameters))
        for _ in range(3):
            plant.step(np.array([[1.6] * 4 + [3.0] * 4]))
        copy = truth_of(parameters)
        copy.values[:] = plant.truth().values
        assert np.array_equal(scene.draw(plant.truth(), plant.parameters), scene.draw(copy, parameters))
        plant.close()
    assert np.array_equal(starts[0], starts[1])


# ---- floor ----


def test_patch_has_its_colour_where_it_lies_and_nowhere_else(new_scene, parameters):
    scene = new_scene(View(size=(640, 480), camera="top", text=False))
    plain = scene.draw(truth_of(parameters), parameters)
    lay_patch(parameters, 0, 0.05, (0.3, 0.6), (-0.4, 0.1))
    lay_patch(parameters, 1, 1.0, (-0.6, -0.3), (0.0, 0.4))
    picture = scene.draw(truth_of(parameters), parameters)
    ice, rough = at(picture, scene, [0.45, -0.15, 0.0]), at(picture, scene, [-0.45, 0.2, 0.0])
    assert ice[2] > ice[0] + 60
    assert rough[0] > rough[2] + 60
    for inside, outside in (((0.33, -0.37), (0.27, -0.37)), ((0.57, 0.07), (0.57, 0.13)), ((-0.33, 0.03), (-0.33, -0.03))):
        assert np.abs(at(picture, scene, [*inside, 0]) - at(plain, scene, [*inside, 0])).max() > 40
        assert np.abs(at(picture, scene, [*outside, 0]) - at(plain, scene, [*outside, 0])).max() < 6


def test_later_patches_lie_on_top_and_empty_ones_are_not_drawn(parameters):
    lay_patch(parameters, 0, 0.1, (0.0, 1.0), (0.0, 1.0))
    lay_patch(parameters, 2, 0.9, (0.5, 1.5), (0.0, 1.0))
    lay_patch(parameters, 3, 0.9, (1.0, 1.0), (0.0, 1.0))
    low, high = marks.areas(parameters, np.zeros(2))
    assert (low.mu, high.mu) == (0.1, 0.9)
    assert high.height > low.height


def test_half_a_world_of_ice_is_cut_to_what_can_be_seen(parameters):
    lay_patch(parameters, 0, 0.1, (-1000, 1000), (0, 1000))
    (area,) = marks.areas(parameters, np.array([100.0, -3.0, 0.2]))
    assert area.low == (100 - marks.REACH, 0.0)
    assert area.high == (100 + marks.REACH, marks.REACH - 3.0)
    assert marks.areas(parameters, np.array([0.0, -50.0])) == []


def test_anisotropy_acts_on_the_shown_friction(parameters):
    parameters["ground.mu_y"][:] = 0.5 * parameters["ground.mu_x"]
    lay_patch(parameters, 0, 0.4, (0, 1), (0, 1))
    assert marks.areas(parameters, np.zeros(2))[0].mu == pytest.approx(0.3)


def test_floor_colour_follows_its_friction(new_scene, parameters):
    slippery = parameters.copy()
    slippery["ground.mu_x"][:] = slippery["ground.mu_y"][:] = 0.1
    scene = new_scene(View(size=(320, 240), camera="top", text=False))
    grey, blue = (at(scene.draw(truth_of(given), given), scene, [0.45, 0.3, 0]) for given in (parameters, slippery))
    assert abs(grey[2] - grey[0]) < 15
    assert blue[2] > blue[0] + 40


def test_wheels_on_floors_of_their_own_get_pads(robot, parameters):
    stage = posed(robot, truth_of(parameters), parameters)
    assert marks.spots(stage) == []
    parameters["ground.mu_x"][0] = parameters["ground.mu_y"][0] = [0.1, 0.6, 0.1, 0.6]
    pads = marks.spots(posed(robot, truth_of(parameters), parameters))
    assert [pad.mu for pad in pads] == [0.1, 0.6, 0.1, 0.6]
    assert np.allclose(pads[1].centre[:2], [0.175, -0.16])


def test_squares_of_the_floor_are_20_cm(new_scene, parameters):
    """As the legend says: along a line, light and dark alternate every 0.2 m."""
    scene = new_scene(View(size=(640, 480), camera="top", text=False))
    picture = scene.draw(truth_of(parameters, position=[[0, 0, -5.0]]), parameters).astype(int)
    columns = scene.pixels([[x, 0.0, 0.0] for x in (-0.6, 0.6)])[:, 0]
    row = int(scene.pixels([0.0, 0.05, 0.0])[1])
    line = picture[row, round(columns[0]) : round(columns[1])].mean(axis=1)
    lighter = line > 0.5 * (np.quantile(line, 0.1) + np.quantile(line, 0.9))
    places = np.flatnonzero(np.diff(lighter.astype(int))) / len(line) * 1.2
    edges = places[np.append(True, np.diff(places) > 0.05)]  # a square's edge line is dark too
    assert np.allclose(np.diff(edges), 0.2, atol=0.02)


def test_squares_lie_on_patches_too_and_stay_when_the_robot_moves(new_scene, parameters):
    """Ice over the half of a square: its other half has the same shade; where the robot is does not matter."""
    scene = new_scene(View(size=(640, 480), camera="top", text=False))
    lay_patch(parameters, 0, 0.05, (0.35, 0.9), (-0.6, 0.6))
    for x in (0.0, 0.2, 0.31):
        picture = scene.draw(truth_of(parameters, position=[[x, 0, -5.0]]), parameters)
        whole = np.array([at(picture, scene, [0.3, y, 0.0]).mean() for y in (-0.1, 0.1)])
        ice = np.array([at(picture, scene, [0.38, y, 0.0]).mean() for y in (-0.1, 0.1)])
        assert ice[0] / ice[1] == pytest.approx(whole[0] / whole[1], abs=0.02)
        assert abs(ice[0] / ice[1] - 1.0) > 0.05


# ---- arrows ----


@pytest.mark.parametrize("yaw", [0.0, 0.7, 2.4])
def test_slip_arrow_points_where_the_contact_skids(robot, parameters, yaw):
    """Heading and axle are turned into the floor frame with the robot's yaw; only the slipping wheel has an arrow."""
    quaternion = [[np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]]
    truth = truth_of(parameters, quaternion=quaternion, slip_velocity=[[0, 0, 0.03, 0.04, 0, 0, 0, 0]])
    stage = posed(robot, truth, parameters)
    (arrow,) = marks.slip_arrows(stage)
    ahead, left = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0])
    assert np.allclose(arrow.end - arrow.start, marks.SLIP_SCALE * (0.03 * ahead + 0.04 * left))
    contact = 0.175 * ahead - 0.16 * left
    assert np.allclose(arrow.start[:2], (contact - marks.SLIP_BESIDE * left)[:2])
    assert 0 < arrow.start[2] < 0.02


def test_slip_arrow_is_seen_at_its_place(new_scene, parameters):
    scene = new_scene(View(size=(640, 480), camera="top", text=False))
    calm = scene.draw(truth_of(parameters), parameters)
    truth = truth_of(parameters, slip_velocity=[[0, 0, 0, -0.1, 0, 0, 0, 0]])  # right front wheel, to the right
    picture = scene.draw(truth, parameters)
    shaft = at(picture, scene, [0.175, -0.16 - marks.SLIP_BESIDE - 0.07, 0.007])
    assert shaft[0] > 180
    assert shaft[2] < 90
    opposite = [0.175, 0.16 + marks.SLIP_BESIDE + 0.07, 0.007]
    assert np.allclose(at(picture, scene, opposite), at(calm, scene, opposite), atol=3)


def test_contact_frames_of_a_tilted_robot_are_the_slip_definitions(robot, parameters):
    """Points and axes against wlr_gym.robot.slip: the contact's velocity in a pure turn about a known axis."""
    from wlr_gym.robot.slip import contact_slip_velocity

    half = 0.5 * np.array([0.1, -0.08, 0.6])
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    quaternion = np.array(
        [[cy * cp * cr + sy * sp * sr, cy * cp * sr - sy * sp * cr, cy * sp * cr + sy * cp * sr, sy * cp * cr - cy * sp * sr]]
    )
    truth = truth_of(parameters, quaternion=quaternion, position=[[0.3, -0.2, 0.25]])
    stage = posed(robot, truth, parameters)
    points, heading, left, *_ = stage.contact_frames()
    turn = np.array([0.3, -0.2, 0.9])  # rad/s, floor frame, about the body origin
    body = stage.data.body("body").xmat.reshape(3, 3)
    expected = contact_slip_velocity(
        parameters, quaternion, np.zeros((1, 3)), (turn @ body)[None], truth.joint_position, np.zeros((1, 8))
    )[0]
    velocity = np.cross(turn, points - truth.position[0])
    assert np.allclose((velocity * heading).sum(axis=1), expected[:, 0], atol=1e-12)
    assert np.allclose((velocity * left).sum(axis=1), expected[:, 1], atol=1e-12)


def test_too_little_too_much_and_no_slip(robot, parameters):
    slip = [[0.5 * marks.SLIP_FLOOR, 0, 10.0, 0, 0, 0, np.nan, 0]]
    truth = truth_of(parameters, slip_velocity=slip)
    stage = posed(robot, truth, parameters)
    (arrow,) = marks.slip_arrows(stage)
    assert np.linalg.norm(arrow.end - arrow.start) == pytest.approx(marks.LONGEST_ARROW)


def test_force_arrows_are_the_friction_on_the_wheels(robot, parameters):
    truth = truth_of(parameters, contact_force=[[2.0, -1.0, 7.0] + [0.0, 0.0, 7.0] * 3])
    stage = posed(robot, truth, parameters)
    (arrow,) = marks.force_arrows(stage)
    assert np.allclose(arrow.end - arrow.start, marks.FORCE_SCALE * np.array([2.0, -1.0, 0.0]))


def test_force_arrows_of_a_heavy_robot_stay_in_the_picture(robot):
    """A wheel's share of the weight is as long, beside the picture, as that of the nominal robot."""
    changes = {"body": {"mass": 13.2}, "hip_position": {"x": 0.3}, "leg": {"length": 0.3}, "name": "heavy"}
    heavy = load_robot(overlay(robot.model_dump(mode="json"), changes), check=False)
    share = heavy.total_mass * heavy.gravity / 4
    assert marks.force_scale(heavy) * share / magnification(heavy) == pytest.approx(marks.FORCE_SCALE * marks.LIGHT / 4)
    assert marks.force_scale(robot) == marks.FORCE_SCALE
    (line,) = [one for one in legend(Parameters.nominal(heavy), View(loads=True), marks.force_scale(heavy)) if "load" in one]
    assert f"0.1 m = {0.1 / marks.force_scale(heavy):.3g} N" in line


# ---- slope ----


def test_on_a_slope_gravity_points_down_in_the_picture(new_scene, parameters):
    steep = parameters.copy()
    steep["ground.slope"][0] = [0.3, 0.0]
    scene = new_scene(View(size=(320, 240), camera="side", text=False))
    scene.draw(truth_of(steep), steep)
    up = camera.up_direction(steep["ground.slope"][0])
    foot, head = scene.pixels([[0, 0, 0.09], [0, 0, 0.09] + 0.2 * up])
    assert head[0] == pytest.approx(foot[0], abs=0.5)
    assert head[1] < foot[1] - 20
    low, high = scene.pixels([[-0.3, 0, 0], [0.3, 0, 0]])  # positive = uphill along x
    assert high[1] < low[1] - 20
    level = scene.draw(truth_of(parameters), parameters)
    assert level.shape == (240, 320, 3)


def test_up_is_against_the_gravity_of_the_plants(robot, parameters):
    from wlr_gym.physics.plants.mujoco.mjcf import build_model

    parameters["ground.slope"][0] = [0.2, -0.1]
    gravity = build_model(robot, parameters).opt.gravity
    assert np.allclose(-gravity / np.linalg.norm(gravity), camera.up_direction(parameters["ground.slope"][0]))


@pytest.mark.parametrize(("slope", "line"), [((0.1, 0.4), None), ((-0.7, 0.3), "slope -0.7° along x"), ((2, 1), "along y")])
def test_only_slopes_that_matter_are_written(robot, parameters, slope, line):
    parameters["ground.slope"][0] = np.radians(slope)
    last = describe(posed(robot, truth_of(parameters), parameters))[-1]
    assert (line in last and "-0.0" not in last) if line else "slope" not in last


# ---- text ----


def test_text_stays_inside_and_can_be_left_out(new_scene, parameters):
    lay_patch(parameters, 0, 0.05, (0.3, 0.8), (-0.4, 0.4))
    with_text = new_scene(View(size=(320, 240)))
    written = with_text.draw(truth_of(parameters), parameters, time=12.34, command={"linear_velocity_x": 0.1}, title="title")
    bare = new_scene().draw(truth_of(parameters), parameters)
    changed = np.argwhere((written != bare).any(axis=2))
    assert len(changed) > 2000
    assert (changed.min(axis=0) >= 8).all()
    assert (changed.max(axis=0) <= [232, 312]).all()


def test_the_robot_is_not_written_over(new_scene, robot, parameters):
    lay_patch(parameters, 0, 0.05, (-0.5, 0.5), (-0.5, 0.5))
    scene = new_scene(View(size=(320, 240), camera="top"))
    scene.draw(truth_of(parameters), parameters)
    ((_, place),) = scene._labels(posed(robot, truth_of(parameters), parameters), marks.areas(parameters, np.zeros(2)))
    robot, corner = scene.pixels([[0, 0, 0.1], [0.175, 0.16, 0.2]])
    assert np.linalg.norm(np.array(place) - robot) > np.abs(corner - robot).max()


# ---- OpenGL ----


def test_nothing_is_opened_before_the_first_picture_and_close_gives_it_back(new_scene, parameters):
    scene = new_scene()
    assert scene._canvas is None
    with pytest.raises(InputError, match="nothing has been drawn"):
        scene.pixels([0, 0, 0])
    first = scene.draw(truth_of(parameters), parameters)
    canvas: Any = scene._canvas
    assert not canvas.closed
    scene.close()
    scene.close()
    assert canvas.closed
    assert scene._canvas is None
    assert np.array_equal(scene.draw(truth_of(parameters), parameters), first)
    for _ in range(6):
        other = new_scene(View(size=(64, 64), text=False))
        other.draw(truth_of(parameters), parameters)
        other.close()
    assert np.array_equal(scene.draw(truth_of(parameters), parameters), first)


def test_a_scene_left_open_does_not_disturb_the_end_of_the_program(new_scene):
    code = (
        "import mujoco\n"  # whoever imports it first
        "from wlr_gym.robot import load_robot\n"
        "from wlr_gym.robot.parameters import Parameters\n"
        "from wlr_gym.physics.plants.base import Truth, TRUTH_LAYOUT\n"
        "from wlr_gym.render import Scene, View\n"
        "import numpy as np\n"
        "truth = Truth(np.zeros((1, TRUTH_LAYOUT.width))); truth['quaternion'][:, 0] = 1\n"
        "scene = Scene(load_robot(), View(size=(64, 64)))\n"
        "print(scene.draw(truth, Parameters.nominal(load_robot())).shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, "(64, 64, 3)", "")


@pytest.mark.parametrize(
    ("value", "expected"),
    [("off", "switches pictures off"), ("vulkan", "MUJOCO_GL=vulkan: expected one of")],
)
def test_bad_setting_of_mujoco_gl(monkeypatch, robot, parameters, value, expected):
    monkeypatch.setenv("MUJOCO_GL", value)
    from wlr_gym.render import Scene

    with pytest.raises(InputError, match=expected):
        Scene(robot, PLAIN).draw(truth_of(parameters), parameters)


def test_without_opengl_the_message_names_the_remedy(monkeypatch, robot, parameters):
    def broken(name):
        raise ImportError("libEGL.so.1: cannot open shared object file\nmore")

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(gl.platform, "system", lambda: "Linux")
    monkeypatch.setattr(gl.importlib, "import_module", broken)
    with pytest.raises(InputError, match=r"no OpenGL .*egl: libEGL.*apt install libegl1"):
        gl._open_context(Stage(robot, parameters).model, (64, 64))


@pytest.mark.parametrize("name", ["osmesa", "glfw"])
def test_opengl_that_is_asked_for_and_not_there_ends_in_one_line_each_time(name):
    """MuJoCo itself fails at its import, or ends the process at the second picture."""
    code = """
from standing import PLAIN, truth_of
from wlr_gym import InputError
from wlr_gym.render import Scene
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

robot = load_robot("nominal")
parameters = Parameters.nominal(robot, 1)
for _ in range(2):
    try:
        Scene(robot, PLAIN).draw(truth_of(parameters), parameters)
        print("drawn")
    except InputError as error:
        print(error)
"""
    own = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}
    own |= {"MUJOCO_GL": name, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=own)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 2
    assert all(line == "drawn" or (f"({name}: " in line and "unset MUJOCO_GL, or install" in line) for line in lines)


def test_a_picture_from_another_thread_is_refused_in_one_line_and_closing_there_does_no_harm(robot, parameters):
    scene, found = gl.Scene(robot, PLAIN), []

    def draw():
        try:
            found.append(scene.draw(truth_of(parameters), parameters).shape)
        except InputError as error:
            found.append("refused" if "another thread" in str(error) else str(error))

    for work in (draw, scene.close, lambda: None):
        draw()
        (thread := threading.Thread(target=work)).start()
        thread.join()
    scene.close()
    assert found == [found[0], "refused", found[0], found[0]]


def test_a_headless_machine_needs_no_setting(monkeypatch):
    monkeypatch.setattr(gl.platform, "system", lambda: "Linux")
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert gl.context_names() == ("egl",)
    monkeypatch.setenv("DISPLAY", ":0")
    assert gl.context_names() == ("egl", "glfw")
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert gl.context_names() == ("osmesa",)


# ---- views ----


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"camra": "top"}, "did you mean 'camera'"),
        ({"camera": "topp"}, "did you mean 'top'"),
        ({"size": (10, 480)}, "64 to 4096 pixels"),
        ({"size": 480}, "64 to 4096 pixels"),
        ({"size": (640.0, 480)}, "64 to 4096 pixels"),
        ({"slip": 1}, "slip = 1: expected True or False"),
    ],
)
def test_bad_views(given, expected):
    with pytest.raises(InputError, match=expected):
        read_view(given)


def test_views_as_mappings():
    assert read_view({"size": [320, 240], "camera": "top"}) == View(size=(320, 240), camera="top")
    assert read_view(None) == View()
