"""Everything about the window but the window: what is put into it, pacing, keys, gamepad."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
import contextlib
import types
import warnings

import mujoco
import numpy as np
import pytest
from standing import truth_of

from wlr_gym.base.errors import InputError
from wlr_gym.render import viewer as viewer_module
from wlr_gym.render.stage import MESHES
from wlr_gym.render.teleop import DOWN, LEFT, RESET, RIGHT, SPACE, UP, Gamepad, Keyboard, Script
from wlr_gym.render.view import LOOK_HEIGHT, View
from wlr_gym.render.viewer import Viewer, open_window

RANGES = {"linear_velocity_x": (-0.1, 0.2), "yaw_rate": (-0.5, 0.5)}


class FakeWindow:
    """The few methods of MuJoCo's viewer handle that are used."""

    def __init__(self, model, data, on_key):
        self.model, self.data, self.on_key = model, data, on_key
        self.cam = mujoco.MjvCamera()
        self.user_scn = mujoco.MjvScene(model, 100)
        self.texts, self.poses, self.taken, self.running, self.locked = [], [], [], True, False

    def is_running(self):
        return self.running

    @contextlib.contextmanager
    def lock(self):
        self.locked = True
        yield
        self.locked = False

    def sync(self):
        assert not self.locked
        self.poses.append(self.data.qpos[:3].copy())

    def update_mesh(self, number):
        assert not self.locked
        self.taken.append(number)

    def set_texts(self, texts):
        self.texts.append(texts[0][2])

    def close(self):
        self.running = False


@pytest.fixture
def opened(robot, monkeypatch):
    """A viewer with a fake window and a clock that only sleeping moves: (viewer, windows, time)."""
    windows, now = [], [100.0]

    def open_fake(*arguments):
        windows.append(FakeWindow(*arguments))
        return windows[-1]

    def sleep(seconds):
        now[0] += seconds

    monkeypatch.setattr(viewer_module, "open_window", open_fake)
    monkeypatch.setattr(viewer_module.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(viewer_module.time, "sleep", sleep)
    return Viewer(robot, View()), windows, now


def test_pose_text_and_marks_go_into_the_window(opened, parameters):
    viewer, windows, _ = opened
    assert not viewer.is_open
    for name, value in (("mu", 0.1), ("x_min", 1), ("x_max", 2), ("y_min", 1), ("y_max", 2)):
        parameters[f"patch.{name}"][:, 0] = value
    truth = truth_of(parameters, position=[[0.5, -0.2, 0.17]], slip_velocity=[[0.1, 0, 0, 0, 0, 0, 0, 0]])
    assert viewer.show(truth, parameters, period=0.02, time=1.0, command={"yaw_rate": 0.3}, title="me")
    (window,) = windows
    assert viewer.is_open
    assert np.allclose(window.poses[0], [0.5, -0.2, 0.17])
    assert window.user_scn.ngeom == 3  # squares, patch, arrow
    assert np.allclose(window.cam.lookat[:2], [0.5, -0.2])
    assert window.texts[0].splitlines()[:2] == ["me", "t 1.00 s"]
    viewer.show(truth_of(parameters), parameters, period=0.02)
    assert window.user_scn.ngeom == 2
    assert len(windows) == 1


def test_new_sizes_are_shown_in_the_same_model(opened, parameters):
    viewer, windows, _ = opened
    viewer.show(truth_of(parameters), parameters, period=0.02)
    model = windows[0].model
    place = model.body("wheel_lf").pos.copy()
    longer = parameters.copy()
    longer["leg.length"][:] *= 1.2
    viewer.show(truth_of(longer), longer, period=0.02)
    assert np.allclose(model.body("wheel_lf").pos, 1.2 * place)


def test_no_faster_than_real_time_and_no_catching_up_after_a_pause(opened, parameters):
    viewer, _, now = opened
    truth = truth_of(parameters)
    for _ in range(51):
        viewer.show(truth, parameters, period=0.02)
    assert now[0] - 100.0 == pytest.approx(51 * 0.02)
    now[0] += 0.01  # a slow tick is made up for
    viewer.show(truth, parameters, period=0.02)
    assert now[0] - 100.0 == pytest.approx(52 * 0.02)
    now[0] += 10.0  # a hold-up is not
    for _ in range(10):
        viewer.show(truth, parameters, period=0.02)
    assert now[0] - 110.0 == pytest.approx(62 * 0.02)


def test_a_closed_window_neither_shows_nor_waits(opened, parameters):
    viewer, windows, now = opened
    viewer.show(truth_of(parameters), parameters, period=0.02)
    windows[0].running = False
    before = now[0]
    assert not viewer.show(truth_of(parameters), parameters, period=0.02)
    assert now[0] == before
    assert len(windows[0].poses) == 1
    viewer.close()
    viewer.close()


def test_without_a_display_the_message_says_what_to_do(monkeypatch):
    monkeypatch.setattr(viewer_module, "require_display", lambda: None)

    def broken(name):
        raise RuntimeError("could not initialize GLFW")

    monkeypatch.setattr(viewer_module.importlib, "import_module", broken)
    with pytest.raises(InputError, match=r"does not open .*GLFW.* make a video instead"):
        open_window(None, None, None)  # type: ignore[arg-type]
    monkeypatch.undo()
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("wlr_gym.render.view.platform.system", lambda: "Linux")
    with pytest.raises(InputError, match=r"no display here .*wlr play --video"):
        open_window(None, None, None)  # type: ignore[arg-type]


# ---- commands ----


def test_arrow_keys():
    keys = Keyboard(RANGES)
    for key in (UP, UP, LEFT):
        keys.press(key)
    assert keys.command(0.0) == pytest.approx({"linear_velocity_x": 0.04, "yaw_rate": 0.05})
    keys.press(ord("Q"))
    for key in [RIGHT] * 20 + [DOWN] * 40:
        keys.press(key)
    assert keys.command(0.0) == pytest.approx({"linear_velocity_x": -0.1, "yaw_rate": -0.5})
    keys.press(SPACE)
    assert keys.command(0.0) == {"linear_velocity_x": 0.0, "yaw_rate": 0.0}
    assert not keys.wants_reset()
    keys.press(UP)
    keys.press(RESET)
    assert keys.command(0.0)["linear_velocity_x"] == 0.0
    assert keys.wants_reset()
    assert not keys.wants_reset()


@pytest.mark.parametrize(("bounds", "way"), [((0.08, 0.1), 1), ((-0.1, -0.08), -1)])
def test_who_drives_can_slow_down_and_stop_where_the_task_never_does(bounds, way):
    keys = Keyboard({"linear_velocity_x": bounds})
    faster, slower = (UP, DOWN) if way > 0 else (DOWN, UP)
    for key in (faster, faster, faster, slower):
        keys.press(key)
    assert keys.command(0.0) == pytest.approx({"linear_velocity_x": way * 0.02})
    keys.press(SPACE)
    assert keys.command(0.0) == {"linear_velocity_x": 0.0}
    assert Gamepad({"linear_velocity_x": bounds}, pad([0.0, 0.0])).command(0.0) == {"linear_velocity_x": 0.0}


def test_keys_of_a_task_without_such_commands():
    with pytest.raises(InputError, match="the arrow keys steer others: unknown command 'height'"):
        Keyboard({"height": (0.0, 1.0)})


def pad(axes, buttons=(0, 0), present=True):
    return types.SimpleNamespace(
        joystick_present=lambda index: present,
        get_joystick_axes=lambda index: (axes, len(axes)),
        get_joystick_buttons=lambda index: (buttons, len(buttons)),
    )


def test_gamepad():
    assert Gamepad(RANGES, pad([0.0, -1.0])).command(0.0) == pytest.approx({"linear_velocity_x": 0.2, "yaw_rate": 0.0})
    assert Gamepad(RANGES, pad([-1.0, 1.0])).command(0.0) == pytest.approx({"linear_velocity_x": -0.1, "yaw_rate": 0.5})
    assert Gamepad(RANGES, pad([0.1, -0.1])).command(0.0) == pytest.approx({"linear_velocity_x": 0.0, "yaw_rate": 0.0})
    assert Gamepad(RANGES, pad([0.9, 0.9], (1, 0))).command(0.0) == {"linear_velocity_x": 0.0, "yaw_rate": 0.0}
    held = Gamepad(RANGES, pad([0.0, 0.0], (0, 1)))
    assert [held.wants_reset(), held.wants_reset()] == [True, False]
    with pytest.raises(InputError, match="no gamepad found"):
        Gamepad(RANGES, pad([], present=False))


def test_glfw_that_does_not_start_is_said_once(monkeypatch, recwarn):
    glfw = pytest.importorskip("glfw")
    monkeypatch.setattr(glfw, "init", lambda: warnings.warn("no display", glfw.GLFWError, stacklevel=1))
    with pytest.raises(InputError, match="GLFW does not start"):
        Gamepad(RANGES)
    assert not recwarn.list


NAMES = tuple(RANGES)


def test_schedules():
    assert Script("0.2,-0.1", NAMES).command(99.0) == {"linear_velocity_x": 0.2, "yaw_rate": -0.1}
    script = Script("0:0.2,0; 3:0.1,0.5;", NAMES)
    times = (0.0, 2.98, 3.0, 50.0)
    assert [script.command(time)["yaw_rate"] for time in times] == [0, 0, 0.5, 0.5]


@pytest.mark.parametrize("text", ["", ";", "0.2", "0.2,0,0", "a,b", "nan,0", "0:0.2", "inf:0,0", "0:0,0;x:0,0"])
def test_what_is_no_schedule(text):
    with pytest.raises(InputError, match="expected linear_velocity_x,yaw_rate"):
        Script(text, NAMES)


@pytest.mark.parametrize("text", ["1:0.2,0", "0:0,0;2:0,0;2:0,0", "0:0,0;3:0,0;1:0,0"])
def test_times_that_do_not_rise(text):
    with pytest.raises(InputError, match="expected rising times from 0"):
        Script(text, NAMES)


def test_the_window_takes_a_new_floor_and_opens_anew_where_it_has_no_room(opened, parameters):
    viewer, windows, _ = opened
    truth = truth_of(parameters)
    kerb = parameters.copy()
    kerb["piece.x"][:, 0], kerb["piece.height"][:, 0] = 0.4, 0.05
    for given in (parameters, kerb):
        assert viewer.show(truth, given, period=0.02)
    flat, window = windows
    assert not flat.running
    assert window.user_scn.geoms[0].type == mujoco.mjtGeom.mjGEOM_MESH
    assert window.taken == []
    truth["position"][:, 0] = 1.5
    assert viewer.show(truth, kerb, period=0.02)
    assert window.taken == [window.model.mesh(name).id for name in MESHES]
    assert window.cam.lookat[2] == pytest.approx(LOOK_HEIGHT + 0.05)
    window.close()
    kerb["bumps.height"][:] = 0.02  # needs more room
    assert not viewer.show(truth, kerb, period=0.02)
    assert len(windows) == 2
