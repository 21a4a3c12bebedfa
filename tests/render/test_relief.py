"""Floors that are not flat, as they are drawn."""

import numpy as np
import pytest
from standing import PLAIN, truth_of

from wlr_gym.base.errors import InputError
from wlr_gym.physics.floor import load_floor
from wlr_gym.physics.maps import map_text
from wlr_gym.physics.plants import PlantOptions, make_plant
from wlr_gym.physics.plants.base import PlantState, settle, standing_state
from wlr_gym.physics.plants.contacts import contacts_of_plant
from wlr_gym.render import stage as marks
from wlr_gym.render.scene import floor_portrait, legend
from wlr_gym.render.stage import Stage
from wlr_gym.render.surface import BAND, REACH, Relief
from wlr_gym.render.view import View
from wlr_gym.robot.parameters import Parameters

RAMP = {"pieces": [{"kind": "ramp", "at": [0.6, 0.0], "slope": 0.2, "height": 0.3}]}
#: On its foot stand the front wheels, on the plane the rear ones.
BEFORE_RAMP = 0.5
KERB = {"pieces": [{"kind": "kerb", "at": [0.4, 0.0], "height": 0.05}]}
HILLS = {"base": {"kind": "grid", "cell": 0.2, "heading": 0.5, "random": {"height": 0.02, "length": 0.8, "size": [6.0, 6.0]}}}
#: Ice near on the left, rubber on the rest of the map.
CHECKED = {"friction": {"map": {"data": map_text(np.array([[0.1, 0.9], [0.9, 0.9]])), "cell": 0.25, "at": [0.4, 0.0]}}}
WAVES = {"base": {"kind": "waves", "waves": [{"height": 0.02, "length": 0.8}]}}
PATCH = {"friction": {"patches": [{"mu": 0.1, "x": [0.3, 0.7], "y": [-0.4, 0.1]}]}}


def on(robot, floor, seed=0):
    """Parameters of a robot on a floor."""
    parameters = Parameters.nominal(robot)
    load_floor(floor).write(parameters, np.array([seed], np.uint64))
    return parameters


def standing(robot, parameters, x=0.0):
    """Truth of a robot that stands on its floor."""
    state: PlantState = standing_state(robot, parameters)
    state.position[:, 0] = x
    settle(robot, parameters, state)
    return truth_of(parameters, position=state.position, quaternion=state.quaternion)


def posed(robot, parameters, truth):
    stage = Stage(robot, parameters)
    stage.pose(truth, parameters)
    return stage


def surface_of(robot, floor, areas=()):
    return Relief(robot, on(robot, floor)).surface(np.array([0.3, -0.1]), areas)


def corners(surface, faces):
    return [surface.vertices[faces[:, k]] for k in range(3)]


# ---- triangles ----


@pytest.mark.parametrize("floor", ["rough", "gravel", "kerbs", "ramps", "stairs", WAVES, HILLS | CHECKED, KERB | PATCH | WAVES])
def test_from_above_the_triangles_are_the_floor_that_wheels_touch(robot, floor):
    relief = Relief(robot, on(robot, floor))
    found = relief.surface(np.zeros(2), [((0.3, -0.4), (0.7, 0.1))])
    faces = np.concatenate(found.faces)
    a, b, c = corners(found, faces)
    across = np.cross(b - a, c - a)
    assert ((across * found.normals[faces].mean(axis=1)).sum(axis=1) > 0.0).all()  # their outsides
    level = across[:, 2] > 1e-12
    a, b, c, across = a[level], b[level], c[level], across[level, 2]
    for place in np.random.default_rng(0).uniform(-1.0, 1.0, (40, 2)):
        shares = [_twice_the_area(one, other, place) / across for one, other in ((b, c), (c, a), (a, b))]
        inside = np.min(shares, axis=0) > -1e-9
        heights = np.sum([share * corner[:, 2] for share, corner in zip(shares, (a, b, c), strict=True)], axis=0)
        assert heights[inside].max() == pytest.approx(relief.height(*place[:, None])[0], abs=1.5e-3)


def _twice_the_area(one, other, place):
    (x, y), (u, v) = (one[:, :2] - place).T, (other[:, :2] - place).T
    return x * v - y * u


def test_a_kerb_is_drawn_where_it_stands(robot):
    found = surface_of(robot, KERB)
    x, _, z = found.vertices.T
    assert z.max() == pytest.approx(0.05)
    assert x[z > 0.001].min() == pytest.approx(0.4)
    assert x.max() == pytest.approx(0.3 + REACH)


def test_lines_lie_along_the_edges_and_feet_of_pieces(robot):
    """Of a ramp to a level top: two feet and two edges, each seen from above as a line across."""
    floor = {"pieces": [{"kind": "ramp", "at": [0.6, 0.0], "slope": 0.2, "height": 0.06, "depth": 0.4}]}
    found = surface_of(robot, floor)
    x, z = found.vertices[np.unique(found.faces[-1])][:, [0, 2]].T
    run = 0.06 / np.tan(0.2)
    edges = np.array([0.6, 0.6 + run, 1.0 + run, 1.0 + 2.0 * run])
    nearest = np.abs(x[:, None] - edges).argmin(axis=1)
    assert (np.abs(x - edges[nearest]) < 1.6 * BAND).all()
    assert np.bincount(nearest).min() >= 4
    assert np.abs(z - np.array([0.0, 0.06, 0.06, 0.0])[nearest]).max() < 3e-3


def test_triangles_are_cut_at_areas_of_other_friction(robot):
    area = ((0.3, -0.4), (0.7, 0.1))
    found = surface_of(robot, KERB | WAVES, [area])
    bare, inside, _ = found.faces
    a, b, c = corners(found, inside)
    assert (np.minimum.reduce([a, b, c])[:, :2] > np.array(area[0]) - 1e-9).all()
    assert (np.maximum.reduce([a, b, c])[:, :2] < np.array(area[1]) + 1e-9).all()
    middle = np.mean(corners(found, bare), axis=0)[:, :2]
    assert not ((middle > area[0]) & (middle < area[1])).all(axis=1).any()
    top = (np.stack([a, b, c])[:, :, 2] > 0.049).all(axis=0)  # of the kerb, within the area: 0.3 m by 0.5 m
    size = 0.5 * np.abs(np.cross(b - a, c - a)[top, 2]).sum()
    assert size == pytest.approx((0.3 - BAND) * 0.5, abs=0.003)


def test_the_level_rises_little_by_little_at_a_kerb(robot):
    relief = Relief(robot, on(robot, KERB))
    levels = np.array([relief.level(np.array([x, 0.0])) for x in np.linspace(0.0, 0.8, 81)])
    assert levels[0] == 0.0
    assert levels[-1] == pytest.approx(0.05)
    assert (np.diff(levels) >= 0.0).all()
    assert np.diff(levels).max() < 0.003


# ---- pictures ----


def test_a_kerb_changes_pixels_where_it_stands(new_scene, robot):
    parameters, scene = on(robot, KERB), new_scene(View(size=(320, 240), camera="side", text=False))
    truth = truth_of(parameters, position=[[0.0, 0.0, -5.0]])
    kerb = scene.draw(truth, parameters).astype(int)
    column, row = np.rint(scene.pixels([0.45, -0.2, 0.045])).astype(int)
    flat = scene.draw(truth, Parameters.nominal(robot)).astype(int)
    far = np.rint(scene.pixels([0.2, -0.3, 0.0])).astype(int)
    changed = np.abs(kerb - flat).max(axis=2) > 25
    assert changed[:, column - 20 : column + 20].mean() > 0.02
    assert not changed[far[1] - 3 : far[1] + 4, far[0] - 8 : far[0] + 8].any()
    riser = kerb[
        np.rint(scene.pixels([0.4, -0.3, 0.03])).astype(int)[1], np.rint(scene.pixels([0.4, -0.3, 0.03])).astype(int)[0]
    ]
    assert riser.mean() < kerb[row, column].mean() - 10


def test_a_floor_that_is_flat_here_looks_like_a_flat_one(new_scene, robot):
    """Plane, squares and areas as triangles, against those of MuJoCo's plane and boxes: the kerb is out of sight."""
    far = on(robot, PATCH | {"pieces": [{"kind": "kerb", "at": [100.0, 0.0], "height": 0.05}]})
    flat = on(robot, PATCH)
    for camera in ("follow", "top"):
        scene = new_scene(View(size=(320, 240), camera=camera, text=False))
        one, other = (scene.draw(truth_of(flat), parameters).astype(int) for parameters in (flat, far))
        assert np.abs(one - other).mean() < 2.0
        assert (np.abs(one - other).max(axis=2) > 25).mean() < 0.02


def test_pictures_of_flat_floors_are_what_they_were_whatever_was_drawn_before(new_scene, robot, parameters):
    scene, truth = new_scene(), truth_of(parameters)
    first = scene.draw(truth, parameters)
    kerb = scene.draw(truth, on(robot, KERB))
    rough = scene.draw(truth, on(robot, "rough"))  # in a model with room for more triangles
    assert not np.array_equal(rough, first)
    assert np.array_equal(rough, new_scene().draw(truth, on(robot, "rough")))
    assert np.array_equal(scene.draw(truth, on(robot, KERB)), kerb)
    assert np.array_equal(scene.draw(truth, parameters), first)


def test_friction_colours_the_top_of_a_kerb(new_scene, robot):
    scene = new_scene(View(size=(640, 480), camera="top", text=False))
    parameters = on(robot, KERB | PATCH)
    picture = scene.draw(truth_of(parameters, position=[[0.0, 0.0, -5.0]]), parameters)
    for place, is_ice in (((0.5, -0.1), True), ((0.35, -0.1), True), ((0.5, 0.2), False), ((0.2, -0.1), False)):
        height = 0.05 if place[0] > 0.4 else 0.0
        column, row = np.rint(scene.pixels([*place, height])).astype(int)
        red, _, blue = picture[row, column].astype(int)
        assert (blue > red + 60) == is_ice


@pytest.mark.parametrize("floor", [{}, HILLS])
def test_a_map_of_friction_is_seen_as_colours(new_scene, robot, floor):
    """Also where the floor is flat: ice is blue, and nothing is where friction is not shown."""
    parameters = on(robot, floor | CHECKED)
    for shown in (True, False):
        scene = new_scene(View(size=(640, 480), camera="top", text=False, friction=shown))
        picture = scene.draw(truth_of(parameters, position=[[0.0, 0.0, -5.0]]), parameters)
        for place, is_ice in (((0.28, 0.12), True), ((0.28, -0.12), False), ((0.5, 0.12), False), ((0.05, 0.12), False)):
            column, row = np.rint(scene.pixels([*place, 0.0])).astype(int)
            red, _, blue = picture[row, column].astype(int)
            assert (blue > red + 60) == (is_ice and shown)
    assert "mapped 0.10 to 0.90" in legend(parameters, PLAIN)[0]


def test_the_camera_goes_up_with_the_floor(new_scene, robot):
    scene = new_scene(View(size=(320, 240), camera="side", text=False))
    high = on(robot, {"pieces": [{"kind": "kerb", "at": [0.4, 0.0], "height": 0.3}]})
    rows = []
    for parameters, x, z in ((Parameters.nominal(robot), 0.0, 0.0), (high, 2.0, 0.3)):
        scene.draw(truth_of(parameters, position=[[x, 0.0, 0.17 + z]]), parameters)
        rows.append(scene.pixels([x, 0.0, 0.17 + z])[1])
    assert rows[0] == pytest.approx(rows[1], abs=0.5)


def test_legend_says_how_high_the_floor_is(robot, parameters):
    assert not any("mm" in line for line in legend(parameters, PLAIN))
    assert "bumps up to 18 mm" in legend(on(robot, "rough"), PLAIN)
    both = legend(parameters, View(forces=True, loads=True))
    assert "friction (green), load (light green): 0.1 m = 4 N" in both
    assert any(line.startswith("grid up to ") for line in legend(on(robot, HILLS), PLAIN))
    assert "waves ±20 mm, pieces up to 50 mm" in legend(on(robot, KERB | WAVES), PLAIN)


# ---- arrows, pads, paths ----


def test_arrows_start_at_the_contact_points_on_a_ramp(robot):
    """Where each wheel is nearest to the ramp: a radius from its centre along the ramp's normal; forces along its axes."""
    parameters = on(robot, RAMP)
    truth = standing(robot, parameters, BEFORE_RAMP)
    truth["contact_force"][:] = [[2.0, 0.0, 8.0] * 4]
    truth["slip_velocity"][:] = [[0.05, 0.0] * 4]
    stage = posed(robot, parameters, truth)
    up, ahead = np.array([-np.sin(0.2), 0.0, np.cos(0.2)]), np.array([np.cos(0.2), 0.0, np.sin(0.2)])
    centres = stage.data.xpos[stage.wheel_bodies]
    loads, forces, slips = marks.load_arrows(stage), marks.force_arrows(stage), marks.slip_arrows(stage)
    assert len(loads) == len(forces) == len(slips) == 4
    for wheel, on_ramp in enumerate((True, True, False, False)):
        normal, along = (up, ahead) if on_ramp else (np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]))
        side = marks.OUTWARDS[wheel, 0] * np.array([0.0, 1.0, 0.0])
        point = centres[wheel] - parameters["wheel.radius"][0, wheel] * normal
        assert np.allclose(loads[wheel].start, point + marks.FORCE_BESIDE * side, atol=3e-4)
        assert np.allclose(loads[wheel].end - loads[wheel].start, marks.FORCE_SCALE * 8.0 * normal, atol=2e-3)
        assert np.allclose(forces[wheel].end - forces[wheel].start, marks.FORCE_SCALE * 2.0 * along, atol=2e-3)
        assert np.allclose(slips[wheel].end - slips[wheel].start, marks.SLIP_SCALE * 0.05 * along, atol=2e-3)
        raised = forces[wheel].start - point - marks.FORCE_BESIDE * side
        assert np.allclose(raised, np.linalg.norm(raised) * normal, atol=3e-4)


def test_a_wheel_that_pushes_against_a_kerb_has_two_loads(robot):
    """Those of the plant; without them only the force where the wheel is deepest is known."""
    parameters = on(robot, {"pieces": [{"kind": "kerb", "at": [0.4, 0.0], "height": 0.06}]})
    plant = make_plant("gibbs_appell", robot, 1, PlantOptions(sensor_noise=False))
    plant.reset(parameters=parameters)
    for _ in range(120):
        plant.step(np.array([[robot.home.leg_angle] * 4 + [4.0] * 4]))
    stage = Stage(robot, parameters)
    stage.pose(plant.truth(), plant.parameters, contacts=contacts_of_plant(plant))
    both = marks.load_arrows(stage)
    level = [arrow for arrow in both if arrow.end[2] - arrow.start[2] < 0.5 * np.linalg.norm(arrow.end - arrow.start)]
    assert len(both) == 6
    assert len(level) == 2
    for arrow in level:
        assert arrow.start[0] == pytest.approx(0.4, abs=2e-3)
        assert arrow.end[0] < arrow.start[0]
    stage.pose(plant.truth(), plant.parameters)
    assert len(marks.load_arrows(stage)) == 4


def test_pads_lie_on_the_floor(robot):
    parameters = on(robot, RAMP)
    parameters["ground.mu_x"][0] = [0.1, 0.6, 0.1, 0.6]
    stage = posed(robot, parameters, standing(robot, parameters, BEFORE_RAMP))
    front, _, rear, _ = marks.spots(stage)
    assert np.allclose(front.normal, [-np.sin(0.2), 0.0, np.cos(0.2)], atol=1e-6)
    assert np.allclose(marks.turn_to(front.normal) @ [0.0, 0.0, 1.0], front.normal)
    assert front.centre[2] == pytest.approx(stage.height(front.centre[None])[0], abs=1.5e-3)
    assert np.allclose(rear.normal, [0.0, 0.0, 1.0])


def test_a_path_goes_over_a_kerb(robot):
    parameters = on(robot, KERB)
    stage = posed(robot, parameters, truth_of(parameters))
    points = np.stack([np.linspace(0.0, 0.8, 81), np.zeros(81)], axis=1)
    trail = marks.Trail(points, (0.0, 0.0, 0.0))
    before, behind = (
        {piece.start[2] for piece in marks.pieces(trail, stage) if (piece.start[0] > 0.41) == is_behind} for is_behind in (0, 1)
    )
    assert before == {2.0 * marks.LINE}
    assert behind == {0.05 + 2.0 * marks.LINE}


def test_a_floors_portrait_is_of_a_robot_that_stands_on_it(robot, graphics):
    view = View(size=(320, 240), camera="side", text=False)
    flat = floor_portrait(robot, load_floor("flat"), view)
    assert np.array_equal(flat, floor_portrait(robot, load_floor({}), view, seed=3))
    stairs = load_floor("stairs")
    assert not np.array_equal(
        floor_portrait(robot, stairs, view, (1.02, 0.0), 1), floor_portrait(robot, stairs, view, (1.02, 0.0), 2)
    )
    with pytest.raises(InputError, match="curvature"):
        floor_portrait(robot, load_floor({"base": {"kind": "bumps", "height": 0.05, "spacing": 0.05}}), view)
