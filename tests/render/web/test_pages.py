"""Pages on a real server without a browser: what stands on them after a step, a key, a seek."""
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false
# (What stands on a page is looked up in viser by name; stand-ins have only what is used.)

import io
from typing import Any

import numpy as np
import pytest
from standing import truth_of

from wlr_gym.render.stage import Arrow, Stage
from wlr_gym.render.teleop import UP
from wlr_gym.render.view import View
from wlr_gym.render.web.page import NOTHING, Curve, close_server, open_server
from wlr_gym.render.web.player import KEYS, Figure, Moment, PageFloor, Player, WebViewer
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot()
PORT = 18080


class NoPace:
    """Never waits, and remembers for how long it should have."""

    def __init__(self):
        self.periods = []

    def wait(self, period):
        self.periods.append(period)


@pytest.fixture(scope="module")
def server():
    opened = open_server("localhost", PORT)
    yield opened
    close_server(opened)


@pytest.fixture
def parameters():
    return Parameters.nominal(ROBOT)


def node(server, name):
    return server.scene._handle_from_node_name[name]


def test_a_figure_stands_where_the_truth_is_and_is_built_anew_only_when_its_sizes_change(server, parameters):
    figure = Figure(server, "one", ROBOT)
    truth = truth_of(parameters, position=[[1.0, 2.0, 0.17]])
    figure.pose(truth, parameters)
    body, wheel = node(server, "/floor/one/body"), node(server, "/floor/one/wheel_lf")
    stage = Stage(ROBOT, parameters)
    stage.pose(truth, parameters)
    assert np.allclose(body.position, [1.0, 2.0, 0.17])
    assert np.allclose(wheel.position, stage.data.body("wheel_lf").xpos)
    truth.position[0, 0] = 1.5
    figure.pose(truth, parameters)
    assert node(server, "/floor/one/body") is body
    assert body.position[0] == 1.5
    parameters["leg.length"][:] *= 1.2
    figure.pose(truth, parameters)
    assert node(server, "/floor/one/body") is not body
    figure.hide()
    assert not node(server, "/floor/one").visible


def test_arrows_come_and_go(server, parameters):
    figure = Figure(server, "two", ROBOT)
    figure.pose(truth_of(parameters), parameters)
    figure.point([Arrow(np.zeros(3), np.ones(3), (1.0, 0.0, 0.0))])
    arrows = node(server, "/floor/two/arrows")
    assert np.allclose(arrows.points[0], [[0, 0, 0], [1, 1, 1]])
    assert tuple(arrows.colors[0]) == (255, 0, 0)
    assert (arrows.points[1:, :, 2] < -1.0).all()
    figure.point([])
    assert (arrows.points[:, :, 2] < -1.0).all()


def test_the_floor_has_areas_and_pads_of_other_friction(server, parameters):
    floor, stage, truth = PageFloor(server), Stage(ROBOT, parameters), truth_of(parameters)
    stage.pose(truth, parameters)
    floor.show(stage, View())
    assert "/floor/area_0" not in server.scene._handle_from_node_name
    for name, value in (("mu", 0.1), ("x_min", 1), ("x_max", 2), ("y_min", 1), ("y_max", 2)):
        parameters[f"patch.{name}"][:, 0] = value
    parameters["ground.mu_x"][0, 0] = 0.2
    stage.pose(truth, parameters)
    floor.show(stage, View())
    area = node(server, "/floor/area_0")
    assert np.allclose(area.position[:2], [1.5, 1.5])
    assert np.allclose(area.dimensions[:2], [1.0, 1.0])
    assert "µ 0.1" in node(server, "/floor/label_0").text
    assert len({tuple(node(server, f"/floor/pad_{k}").color) for k in range(4)}) == 2
    floor.show(stage, View(friction=False))
    assert "/floor/area_0" not in server.scene._handle_from_node_name


def test_a_floor_that_is_not_flat_is_triangles_in_its_colours_and_the_eye_goes_up_with_it(server, parameters):
    import trimesh

    floor, stage, truth = PageFloor(server), Stage(ROBOT, parameters), truth_of(parameters)
    stage.pose(truth, parameters)
    floor.show(stage, View())
    assert "/floor/surface_0" not in server.scene._handle_from_node_name
    kerb = parameters.copy()
    kerb["piece.x"][:, 0], kerb["piece.height"][:, 0] = 0.4, 0.05
    for name, value in (("mu", 0.1), ("x_min", 0.5), ("x_max", 1), ("y_min", 0), ("y_max", 1)):
        kerb[f"patch.{name}"][:, 0] = value
    stage.pose(truth, kerb)
    floor.show(stage, View())
    bare, ice = (trimesh.load(io.BytesIO(node(server, f"/floor/surface_{k}").glb_data), "glb").to_mesh() for k in range(2))
    assert bare.bounds[1, 2] == pytest.approx(0.05)
    assert np.allclose(ice.bounds[:, :2], [[0.5, 0.0], [1.0, 1.0]])
    colours = [mesh.visual.material.baseColorFactor.astype(int) for mesh in (bare, ice)]
    assert colours[1][2] > colours[1][0] + 60
    assert abs(colours[0][2] - colours[0][0]) < 15
    assert node(server, "/floor/plane").position[2] < 0.0
    assert node(server, "/floor/label_0").position[2] > 0.05
    shown = node(server, "/floor/surface_0")
    truth.position[0, 0] = 0.1
    stage.pose(truth, kerb)
    floor.show(stage, View())
    assert node(server, "/floor/surface_0") is shown  # sent once, not at every step
    truth.position[0, 0] = 2.0
    stage.pose(truth, kerb)
    floor.show(stage, View())
    assert node(server, "/floor/surface_0") is not shown
    assert np.allclose(node(server, "/floor").position, [-2.0, 0.0, -0.05])
    stage.pose(truth, parameters)
    floor.show(stage, View())
    assert "/floor/surface_0" not in server.scene._handle_from_node_name
    assert node(server, "/floor/plane").position[2] == 0.0


@pytest.fixture
def live():
    """A page of a running plant, the keys that it has handed on, and its pace."""
    pressed, pace = [], NoPace()
    viewer: Any = WebViewer(ROBOT, View(forces=True), pressed.append, port=PORT + 100)
    viewer._pace = pace
    yield viewer, pressed, pace
    viewer.close()


def test_a_page_of_a_running_plant_shows_it_and_hands_its_keys_on(live, parameters):
    viewer, pressed, pace = live
    truth = truth_of(parameters, position=[[0.3, 0.0, 0.17]], contact_force=[[0, 0, 8.0] * 4])
    for k in range(3):
        assert viewer.show(truth, parameters, period=0.02, time=0.02 * k, command={"yaw_rate": 0.3}, title="me")
    assert pace.periods == [0.02] * 3
    assert np.allclose(node(viewer.server, "/floor").position, [-0.3, 0.0, 0.0])
    assert "me<br>t 0.00 s" in viewer._text.content
    arrows = node(viewer.server, "/floor/robot/arrows").points
    assert np.allclose(np.linalg.norm(np.diff(arrows[:4], axis=1), axis=-1), 8.0 * 0.025)
    commands = {one.label: one for one in viewer.server.gui._command_handle_from_uuid.values()}
    assert {one.hotkey for one in commands.values()} == set(KEYS)
    for call in commands["faster"]._impl.trigger_cb:
        call(None)
    assert pressed == [UP]


def test_plots_of_a_running_plant_hold_the_last_seconds(live, parameters):
    viewer, truth = live[0], truth_of(parameters)
    for k in range(3000):
        truth["contact_force"][0, 2] = k
        viewer._note(truth, 0.02 * k)
    curves = viewer.curves("contact_force")
    assert curves[0].t[[0, -1]] == pytest.approx([39.98, 59.98])
    assert curves[2].label == "contact_force[wheel_lf,z]"
    assert curves[2].values[-1] == 2999
    assert len(curves) == 12
    viewer._note(truth, 0.0)
    assert len(viewer.curves("contact_force")[0].t) == 1


class Line:
    """A robot that drives along x at 1 m/s, with a ghost 0.1 m beside it from 1 s on."""

    robot, name = ROBOT, "line"

    def __init__(self, length=4.0):
        self.length, self.closed = length, False
        self.titles = {"x": "m", "length": "m"} if length > 4 else {"x": "m"}
        self._parameters = Parameters.nominal(ROBOT)

    def at(self, time):
        return Moment(truth_of(self._parameters, position=[[time, 0.0, 0.17]]), self._parameters, slip=False, forces=False)

    def ghost_at(self, time):
        moment = Moment(truth_of(self._parameters, position=[[time, 0.1, 0.17]]), self._parameters)
        return moment if time >= 1.0 else None

    def curves(self, title):
        return [Curve(title, np.array([0.0, self.length]), np.array([0.0, self.length]))]

    def lines(self, time):
        return ["a straight line"]

    def close(self):
        self.closed = True


@pytest.fixture
def player():
    recordings = [Line(), Line(6.0)]
    made = Player(["first", "second"], lambda k: recordings[k], ("x", "length"), port=PORT + 200)
    made.recordings = recordings
    yield made
    made.close()


def test_a_player_goes_on_in_real_time_and_begins_again_at_the_end(player):
    player.update()
    assert not node(player.server, "/floor/ghost").visible
    player.advance(1.5)
    player._told = -np.inf
    player.update()
    assert player.time == 1.5
    assert np.allclose(node(player.server, "/floor/robot/body").position[:2], [1.5, 0.0])
    assert np.allclose(node(player.server, "/floor/ghost/body").position[:2], [1.5, 0.1])
    assert np.allclose(node(player.server, "/floor").position, [-1.5, 0.0, 0.0])
    assert player._slider.value == 1.5
    assert "a straight line" in player._text.content
    player._speed.value = "2"
    player.advance(0.5)
    assert player.time == 2.5
    player.advance(10.0)
    assert player.time == 4.0
    player.advance(0.1)
    assert player.time == 0.0
    player._turn()
    player.advance(1.0)
    assert player.time == 0.0
    assert player._button.label.startswith("play")
    player.seek(99.0)
    assert player.time == 4.0


def test_another_run_brings_its_own_length_and_channels(player):
    player.seek(2.0)
    assert player._plots.chosen == ["x", NOTHING]
    player._run.value = "second"
    player.update()
    assert player.time == 0.0
    assert player.recording is player.recordings[1]
    assert player.recordings[0].closed
    assert player._slider.max == 6.0
    assert player._plots.chosen == ["x", NOTHING]
    player._plots._choices[1].value = "length"
    player._told = -np.inf
    player.update()
    drawn = [plot.title for plot in player._plots._plots]
    assert drawn == ["x (m)", "length (m)"]


def test_a_player_sends_thirty_updates_a_second_and_ends_when_told(player, monkeypatch):
    pace, asked = NoPace(), iter([False] * 30 + [True])
    monkeypatch.setattr("wlr_gym.render.web.player.Pace", lambda: pace)
    player.run(lambda: next(asked))
    assert len(pace.periods) == 30
    assert pace.periods[0] == pytest.approx(1.0 / 30.0)
    assert player.recording.closed
