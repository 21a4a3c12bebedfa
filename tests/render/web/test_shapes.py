"""What the page draws, checked without a server: shapes against MuJoCo's own boxes, the floor's motion, curves."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("viser", minversion="1.1", reason="needs the extra web")

from wlr_gym.base.errors import InputError
from wlr_gym.render.stage import Stage
from wlr_gym.render.view import CAMERAS, LOOK_HEIGHT, up_direction
from wlr_gym.render.web.page import Curve, aligned, eye, floor_pose, how_to_open, open_server, thinned
from wlr_gym.render.web.player import bodies
from wlr_gym.robot import WHEELS, load_robot
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot()


@pytest.fixture(scope="module")
def stage():
    return Stage(ROBOT, Parameters.nominal(ROBOT))


def test_bodies_fill_the_boxes_that_mujoco_has_around_their_geoms(stage):
    """Corners of each visible geom's own axis-aligned box are reached; the hidden capsules of the wheels are not drawn."""
    model, found = stage.model, {body.name: body for body in bodies(stage)}
    assert set(found) == {"body", *(f"{kind}_{corner}" for kind in ("leg", "wheel") for corner in ("lf", "rf", "lr", "rr"))}
    for body in found.values():
        whole = body.whole
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for geom in range(model.body_geomadr[body.index], model.body_geomadr[body.index] + model.body_geomnum[body.index]):
            if model.geom_group[geom] == 3:
                continue
            turn = Rotation.from_quat(model.geom_quat[geom], scalar_first=True).as_matrix()
            centre = model.geom_pos[geom] + turn @ model.geom_aabb[geom, :3]
            half = np.abs(turn) @ model.geom_aabb[geom, 3:]
            low, high = np.minimum(low, centre - half), np.maximum(high, centre + half)
        assert (whole.vertices >= low - 1e-6).all()
        assert (whole.vertices <= high + 1e-6).all()
        # spokes stand askew in their boxes, and what is round has 32 sides
        assert np.allclose([whole.vertices.min(axis=0), whole.vertices.max(axis=0)], [low, high], atol=2e-3)
        assert sum(len(mesh.faces) for mesh, _ in body.surfaces) == len(whole.faces)


def test_a_wheel_is_as_wide_and_round_as_its_parameters_say():
    parameters = Parameters.nominal(ROBOT)
    parameters["wheel.radius"][0, 0] = 0.05
    radii = {body.name: np.hypot(*body.whole.vertices[:, [0, 2]].T).max() for body in bodies(Stage(ROBOT, parameters))}
    assert radii[WHEELS[0]] == pytest.approx(0.05, abs=2e-3)
    assert radii[WHEELS[1]] == pytest.approx(ROBOT.wheel.radius, abs=2e-3)


def test_faces_look_outwards(stage):
    """The volume that closed surfaces enclose is positive when faces go round against the clock."""
    for body in bodies(stage):
        a, b, c = (body.whole.vertices[body.whole.faces[:, k]] for k in range(3))
        assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0.0


@pytest.mark.parametrize("camera", ["follow", "chase"])
def test_the_floor_moves_so_that_the_robot_stays_in_front_of_the_eye_and_gravity_points_down(camera):
    place, yaw, up = np.array([3.0, -2.0, 0.2]), 0.7, up_direction(np.array([0.2, -0.1]))
    turn, position = floor_pose(place, yaw, up, CAMERAS[camera])
    rotation = Rotation.from_quat(turn, scalar_first=True)
    assert np.allclose(rotation.apply(place) + position, 0.0, atol=1e-12)  # with the floor's level there
    assert np.allclose(rotation.apply(up), [0.0, 0.0, 1.0], atol=1e-12)
    ahead = rotation.apply([np.cos(yaw), np.sin(yaw), 0.0])
    assert np.arctan2(ahead[1], ahead[0]) == pytest.approx(0.0 if camera == "chase" else yaw, abs=0.03)


def test_the_eye_looks_at_the_robot_from_above():
    position, look_at = eye(CAMERAS["side"])
    assert np.allclose(look_at, [0.0, 0.0, LOOK_HEIGHT])
    assert position[1] < -1.0  # azimuth 90 degrees looks along y, so it stands to the right of the robot
    assert position[2] > LOOK_HEIGHT


def test_a_thinned_curve_keeps_every_peak():
    t = np.arange(100_000) / 100.0
    values = np.sin(t)
    values[54_321] = 9.0
    values[60_000:60_100] = np.nan
    shown_t, shown = thinned(Curve("a", t, values), 0.0, 1000.0)
    assert len(shown) <= 800
    assert shown.max() == 9.0
    assert shown_t[shown.argmax()] == t[54_321]
    assert np.isfinite(shown).all()
    near_t, near = thinned(Curve("a", t, values), 543.0, 543.5)
    assert len(near) == 52
    assert near_t[0] <= 543.0 <= 543.5 <= near_t[-1]
    assert 9.0 in near


def test_curves_of_different_times_share_one_axis_and_have_no_holes():
    slow = Curve("slow", np.array([0.0, 1.0, 2.0]), np.array([0.0, 10.0, 0.0]))
    quick = Curve("quick", np.arange(21) / 10.0, np.ones(21))
    t, first, second, now = aligned([slow, quick], 0.0, 2.0, 0.55)
    assert (np.diff(t) > 0).all()
    assert np.allclose(first, np.interp(t, slow.t, slow.values))
    assert (second == 1.0).all()
    assert np.isfinite([first, second, now]).all()
    assert t[now.argmax()] == 0.55
    assert now.max() > 10.0


def test_the_way_through_ssh_is_printed_as_the_login_tells_it(monkeypatch):
    monkeypatch.setenv("SSH_CONNECTION", "10.0.0.5 5555 192.168.7.2 2222")
    here, there = how_to_open("localhost", 8081).splitlines()
    assert "http://localhost:8081" in here
    assert "ssh -p 2222 -N -L 8081:localhost:8081 " in there
    assert "@192.168.7.2" in there
    assert "http://localhost:80 " in how_to_open("0.0.0.0", 80)
    monkeypatch.setenv("SSH_CONNECTION", "10.0.0.5 5555 192.168.7.2 22")
    assert "-p" not in how_to_open("localhost", 8081)


def test_an_address_of_another_machine_and_a_port_that_is_none_are_refused():
    with pytest.raises(InputError, match=r"--host 192\.0\.2\.1: no address of this machine"):
        open_server("192.0.2.1", 8090)
    with pytest.raises(InputError, match="--port 70000: expected 1 to 65535"):
        open_server("localhost", 70000)
