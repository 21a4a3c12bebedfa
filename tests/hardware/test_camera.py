"""The live camera: what its process hands over, which of its poses are believed, and what of it stands in the log."""

import math
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("cv2")
pytest.importorskip("dynamixel_sdk")

from camera_rig import FORWARD, TURN, CameraRig, small_camera
from robot_rig import HARDWARE, ROBOT

from wlr_gym.base.errors import InputError
from wlr_gym.cli.deploy import camera_line, camera_state
from wlr_gym.data.runs import read_run
from wlr_gym.hardware.camera import process
from wlr_gym.hardware.camera.process import StampClock
from wlr_gym.hardware.camera.reading import CAMERA_FAULTS, SIZE, UNKNOWN_READOUT, CameraReading, LiveCamera, load_camera_file
from wlr_gym.hardware.camera.rendered import PoseFeed, RobotPose, scene_pose
from wlr_gym.hardware.emulator import Machine, MachineOptions
from wlr_gym.hardware.emulator.camera import FeedWriter
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.log import read_events
from wlr_gym.hardware.safety import camera as rules
from wlr_gym.hardware.safety.camera import CameraWatch, camera_statistics
from wlr_gym.hardware.safety.preflight import check_camera
from wlr_gym.perception.vision.tracking import DARK, MEANINGS

PERIOD = 0.02
HEIGHT = ROBOT.leg.length + ROBOT.wheel.radius - ROBOT.hip_position.z


# ---- what passes between the processes ----


def reading(number=1, moment=1.0, pose=(0.1, 0.2, HEIGHT, 0.3, 0.0, 0.0), reason="", sigma=1e-4):
    covariance = sigma**2 * np.eye(6)
    return CameraReading(number, moment, moment + 0.04, moment + 0.045, reason, np.array(pose, float), covariance)


def test_a_packed_reading_is_whole_and_short_enough_for_one_write():
    found = CameraReading.unpack(reading(3).pack())
    assert (found.number, found.time, found.reason) == (3, 1.0, "")
    np.testing.assert_array_equal(found.pose, reading().pose)
    for words in MEANINGS.values():
        assert CameraReading.unpack(reading(reason=words).pack()).reason == words
    np.testing.assert_array_equal(found.covariance, reading().covariance)
    assert SIZE <= 512  # PIPE_BUF, wherever it is least


def test_stamps_of_this_computers_clock_are_believed():
    clock = StampClock(delay=0.004)
    assert clock.time(100.0, 100.05) == pytest.approx(99.996)
    assert (clock.source, clock.offset) == ("driver", 0.0)


def test_another_clock_is_related_by_its_least_delay():
    """The offset is found to within the least delay on the way, which ``delay`` stands for."""
    clock, random = StampClock(delay=0.03), np.random.default_rng(0)
    errors = []
    for k in range(400):
        exposed = 500.0 + k / 30
        errors.append(clock.time(exposed - 477.0, exposed + 0.03 + random.exponential(0.01)) - exposed)
    assert clock.source == "driver's own clock"
    assert abs(errors[-1]) < 0.001
    assert clock.offset == pytest.approx(477.03, abs=0.001)


def test_without_stamps_arrivals_count():
    clock = StampClock(delay=0.03)
    assert [clock.time(0.0, 7.0), clock.time(0.0, 7.1)] == pytest.approx([6.97, 7.07])
    assert clock.source == "arrival"


def test_the_feed_gives_the_pose_of_a_time(tmp_path):
    feed = PoseFeed(tmp_path / "feed", create=True)
    for k in range(1000):
        feed.write(RobotPose(0.002 * k, np.array([0.1 * k, 0, 0]), np.array([1.0, 0, 0, 0]), np.zeros(4)), np.zeros(3))
    found = PoseFeed(tmp_path / "feed").at(1.5001)
    assert found is not None
    assert found.position[0] == pytest.approx(75.0)
    assert feed.at(0.1) is None  # overwritten
    turned = scene_pose(RobotPose(0.0, np.zeros(3), np.array([math.cos(0.2), 0, 0, math.sin(0.2)]), np.zeros(4)))
    np.testing.assert_allclose(turned.rotation[:2, 0], [math.cos(0.4), math.sin(0.4)])


def test_a_camera_file_names_what_is_wrong(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text("name: mine\ncalibration: nowhere.yaml\n")
    with pytest.raises(InputError, match=r"nowhere\.yaml: no such camera file"):
        load_camera_file(path)
    path.write_text("name: mine\ncalibration: {width: 640, height: 360, focal: [380, 380], centre: [320, 180]}\nrates: 30\n")
    with pytest.raises(InputError, match=r"unknown key 'rates'.*rate"):
        load_camera_file(path)


# ---- which poses are believed ----


class Motion:
    """A robot that drives as told, and a camera that shows it; poses of the floor frame, from (1, -2) with heading 0.7."""

    def __init__(self):
        self.watch = CameraWatch(ROBOT)
        self.now, self.number = 10.0, 0
        self.pose = np.array([1.0, -2.0, 0.7])
        self.past = [(self.now, self.pose.copy())]

    def step(self, speed=0.0, turn=0.0, shown=None, wheels=None, age=0.05, every=2, trouble="", **changes):
        """Take a control step; ``shown`` maps the true pose to what the camera says (None of it: no reading)."""
        self.now += PERIOD
        self.pose = self.pose + PERIOD * np.array([math.cos(self.pose[2]) * speed, math.sin(self.pose[2]) * speed, turn])
        self.past.append((self.now, self.pose.copy()))
        found = None
        if round(self.now / PERIOD) % every == 0 and shown is not False:
            self.number += 1
            exposed = max(self.past[0][0], self.now - age)
            rows = np.array([pose for _, pose in self.past])
            true = np.array([np.interp(exposed, [t for t, _ in self.past], column) for column in rows.T])
            x, y, yaw = true if shown is None else shown(true)
            found = reading(self.number, exposed, (x, y, changes.pop("height", HEIGHT), yaw, 0, 0), **changes)
        rolling = speed if wheels is None else wheels
        sides = np.array([-1.0, 1.0, -1.0, 1.0]) * turn * ROBOT.hip_position.y
        velocity = np.concatenate([np.zeros(4), (rolling + sides) / ROBOT.wheel.radius])
        position = np.concatenate([np.full(4, math.pi / 2), np.zeros(4)])
        return self.watch.next(self.now, (position, velocity), np.array([0.0, 0.0, turn]), found, trouble)

    def begin(self):
        for _ in range(20):
            self.step()
        self.watch.begin_run()
        self.start = self.pose.copy()

    def error(self):
        """Of the pose that is shown, against the truth when it was exposed, m."""
        status = self.watch.status
        rows = np.array([pose for _, pose in self.past])
        true = np.array([np.interp(status.time, [t for t, _ in self.past], column) for column in rows.T]) - self.start
        c, s = math.cos(self.start[2]), math.sin(self.start[2])
        return math.hypot(*(status.pose[:2] - [c * true[0] + s * true[1], c * true[1] - s * true[0]]))


def moved(x=0.0, y=0.0, yaw=0.0):
    """A camera that shows everything somewhere else."""
    return lambda pose: pose + np.array([x, y, yaw])


def test_poses_are_shown_from_the_start_with_their_age():
    motion = Motion()
    motion.begin()
    assert not motion.watch.status.is_new
    for _ in range(50):
        motion.step(speed=0.1, turn=0.3)
    status = motion.watch.status
    assert status.reason == ""
    assert motion.now - status.time == pytest.approx(0.05, abs=PERIOD)
    assert status.pose[2] == pytest.approx(0.3 * 0.95, abs=0.01)
    assert motion.error() < 1e-6


def test_a_slipping_robot_is_believed():
    """Wheels that spin, and a body that slides sideways by 5 cm/s, are no contradiction."""
    motion = Motion()
    motion.begin()
    for k in range(100):
        status = motion.step(speed=0.03, wheels=0.2, shown=moved(-0.03 * 0.02 * k, 0.04 * 0.02 * k))
        assert not status.is_wrong
        assert status.reason == ""


def against(shown, seconds=1.0, speed=0.1, turn=0.0, **keywords):
    """Reasons of the steps, and s for which poses that are off by 3 cm were believed, after 0.5 s of driving well."""
    motion = Motion()
    motion.begin()
    for _ in range(25):
        motion.step(speed=speed, turn=turn)
    reasons, believed = [], 0.0
    for _ in range(round(seconds / PERIOD)):
        status = motion.step(speed=speed, turn=turn, shown=shown, **keywords)
        reasons.append(status.reason)
        believed += PERIOD * (status.is_new and motion.error() > 0.03)
    return reasons, believed, motion


def test_a_pose_that_jumps_is_wrong_and_the_run_goes_on_from_dead_reckoning():
    reasons, believed, motion = against(moved(0.3), seconds=3.0)
    assert reasons[1] in rules.CONTRADICTIONS
    assert believed == 0.0
    assert reasons[-1] == ""  # believed again, for how it moves
    assert motion.error() < 0.01


def test_a_turn_that_the_gyroscope_does_not_know_is_wrong():
    reasons, _, _ = against(moved(yaw=0.1))
    assert rules.CONTRADICTIONS[0] in reasons


def test_a_camera_that_stands_still_while_the_robot_turns_is_wrong():
    frozen = []

    def shown(pose):
        frozen.append(pose)
        return frozen[0]

    reasons, believed, motion = against(shown, turn=0.3)
    assert rules.CONTRADICTIONS[0] in reasons
    assert believed <= 0.2
    assert motion.watch.status.is_wrong


def test_a_sheet_back_to_front_is_wrong_once_the_robot_drives():
    motion = Motion()

    def backward(pose):
        return np.array([*(2 * np.array([1.0, -2.0]) - pose[:2]), pose[2] + math.pi])

    for _ in range(20):
        motion.step(shown=backward)
    motion.watch.begin_run()
    motion.start = motion.pose.copy()
    seen, believed = [], 0.0
    for _ in range(400):
        status = motion.step(speed=0.1, shown=lambda p: np.array([*(np.array([2.0, -4.0]) - p[:2]), p[2]]))
        seen.append(status.is_wrong)
        believed = believed + PERIOD if status.is_new and motion.error() > 0.03 else 0.0
        assert believed <= 0.2
    assert np.mean(seen) > 0.9


def test_a_height_that_the_legs_do_not_have_is_wrong():
    reasons, believed, _ = against(None, height=HEIGHT + 0.05)
    assert reasons[1] == rules.CONTRADICTIONS[2]
    assert believed == 0.0


@pytest.mark.parametrize(
    ("keywords", "reason"),
    [
        ({"age": 0.5}, rules.TOO_OLD),
        ({"age": -0.1}, rules.FUTURE),
        ({"sigma": 0.02}, rules.UNCERTAIN),
        ({"reason": MEANINGS[DARK]}, "the picture is dark or blank: lens covered?"),
    ],
)
def test_a_dropout_has_a_reason_and_is_not_wrong(keywords, reason):
    reasons, _, motion = against(None, seconds=0.3, **keywords)
    assert reasons[-1] == reason
    assert not motion.watch.status.is_wrong
    assert camera_statistics(motion.watch)["without_pose"][reason] > 3


def test_silence_and_a_dead_process_are_told_apart():
    reasons, _, motion = against(False, seconds=0.4)
    assert reasons[-1] == rules.STALLED
    assert motion.step(shown=False, trouble="the camera process has ended (exit code -9)").reason.endswith("(exit code -9)")


def test_after_a_gap_poses_are_believed_again_in_the_same_frame():
    motion = Motion()
    motion.begin()
    for _ in range(100):
        motion.step(speed=0.1, turn=0.2, shown=False)
    for _ in range(20):
        motion.step(speed=0.1, turn=0.2)
    assert motion.watch.status.reason == ""
    assert motion.error() < 1e-6


def test_the_lag_of_the_pictures_is_found():
    """Pictures 40 ms older than their stamps say, on a course whose turns change: then they are dated right."""
    motion = Motion()
    motion.begin()
    for k in range(600):
        times = [t for t, _ in motion.past]
        lagged = np.array([np.interp(motion.now + PERIOD - 0.09, times, c) for c in np.array([p for _, p in motion.past]).T])
        status = motion.step(speed=0.05, turn=0.35 * math.sin(0.06 * k), shown=lambda _, lagged=lagged: lagged)
        assert not status.is_wrong
    assert motion.watch.lag is not None
    lag, sigma = motion.watch.lag
    delay = 1 / (2 * math.pi * ROBOT.sensors.imu.bandwidth)  # of a gyroscope's filter, which this one has not
    assert lag - delay == pytest.approx(0.04, abs=0.006)
    assert sigma < 0.004
    assert motion.now - motion.watch.status.time == pytest.approx(0.09 + delay, abs=PERIOD + 0.006)


# ---- in the loop ----


def test_the_camera_is_part_of_the_run(tmp_path):
    rig = CameraRig(small_camera(dropout=0.1, clutter=0, samples=2), log=tmp_path, tick=0.004)
    rig.start(0.2, FORWARD)
    rig.machine.inject("camera_covered duration=0.2")
    rig.drive(0.4, TURN)
    rig.loop.stop()
    errors = rig.errors()
    assert rig.loop.ended_well
    assert np.abs(errors[:, 1:3]).max() < 1e-3
    assert np.abs(errors[:, 3]).max() < 2e-3
    found = rig.loop.statistics()["camera"]
    assert 38.0 < found["latency"]["p50"] < 62.0
    run = read_run(tmp_path / "run_01.csv")
    is_new = np.isfinite(run["cam_x"])
    assert is_new.sum() >= len(errors) - 1  # the last step's is read after its row; the stop has rows of its own
    assert run["cam_age"][is_new].max() < 0.07
    assert run["cam_age"].max() > 0.2
    events = [event["no_pose"] for event in read_events(tmp_path / "run_01.csv") if event["event"] == "camera"]
    assert "the picture is dark or blank: lens covered?" in events


def test_a_camera_whose_readout_is_not_stated_is_doubted(tmp_path):
    """In the live status, the statistics, the log and the doctor; not where the shutter is known."""
    known = small_camera(clutter=0, samples=2)
    unknown = known.model_copy(update={"calibration": known.calibration.model_copy(update={"readout": None})})
    assert not known.doubt
    rig = CameraRig(unknown, log=tmp_path, tick=0.004)
    rig.start(0.1, FORWARD)
    rig.loop.stop()
    assert rig.loop.status is not None
    assert UNKNOWN_READOUT in camera_state(rig.loop.status)
    assert UNKNOWN_READOUT in camera_line(rig.loop.statistics()["camera"])
    events = [event for event in read_events(tmp_path / "run_01.csv") if event["event"] == "camera"]
    assert events[0]["doubt"] == UNKNOWN_READOUT
    rig.loop.close()
    assert rig.link.camera is not None
    shutter = next(check for check in check_camera(rig.link.camera, unknown, rig.link.clock) if check.what == "shutter")
    assert not shutter.ok
    assert not shutter.is_fatal
    assert shutter.found == UNKNOWN_READOUT


@pytest.mark.slow
def test_a_wrong_camera_is_an_intervention_that_stops_nothing():
    rig = CameraRig()
    rig.machine.inject("camera_back_to_front")
    rig.start(0.8, FORWARD)
    assert rig.loop.interventions["camera"] > 0
    assert rig.loop.setpoints[4] > 0.0
    rig.loop.stop()
    assert rig.loop.ended_well


@pytest.mark.slow
def test_the_same_run_again_gives_the_same_bits():
    shown = []
    for _ in range(2):
        rig = CameraRig(small_camera(dropout=0.2))
        rig.start(0.3, FORWARD)
        rig.loop.stop()
        rig.loop.close()
        shown.append(rig.shown)
    assert shown[0] == shown[1]
    assert any(row[5] for row in shown[0])


# ---- the process ----


def standing_feed(path):
    feed = PoseFeed(path, create=True)
    feed.write(RobotPose(0.0, np.array([0.0, 0.0, HEIGHT]), np.array([1.0, 0, 0, 0]), np.full(4, math.pi / 2)), np.zeros(15))
    return feed


@pytest.mark.slow
def test_the_process_finds_the_robot_and_its_death_is_noticed(tmp_path):
    standing_feed(tmp_path / "poses")
    camera = LiveCamera(small_camera().model_copy(update={"rate": 10.0}), ROBOT, feed=tmp_path / "poses")
    camera.open()
    try:
        poses, end = [], time.monotonic() + 30.0
        while len(poses) < 3 and time.monotonic() < end:
            found = camera.read(time.monotonic())
            if found is not None and not found.reason:
                poses.append(found)
            time.sleep(0.005)
        assert len(poses) == 3
        np.testing.assert_allclose(poses[-1].pose[:4], [0.0, 0.0, HEIGHT, 0.0], atol=2e-3)
        assert camera.trouble == ""
        assert camera.process is not None
        os.kill(camera.process.pid, signal.SIGKILL)
        camera.process.wait()
        assert camera.trouble == "the camera process has ended (exit code -9)"
        start = time.perf_counter()
        camera.read(time.monotonic())
        assert time.perf_counter() - start < 0.005
    finally:
        camera.close()


@pytest.mark.slow
def test_a_camera_that_is_not_there_is_named():
    camera = LiveCamera(small_camera().model_copy(update={"device": 97}), ROBOT)
    with pytest.raises(InputError, match="camera 97: cannot be opened"):
        camera.open()
    camera.close()


class Device:
    """Stands in for OpenCV's camera: three frames with stamps of the monotonic clock, then it is unplugged."""

    def __init__(self, number):
        self.number, self.left, self.asked = number, 3, {}

    def isOpened(self):  # noqa: N802
        return True

    def set(self, what, value):
        self.asked[what] = value

    def get(self, what):
        return 1e3 * (time.monotonic() - 0.02)

    def grab(self):
        self.left -= 1
        return self.left >= 0

    def retrieve(self):
        return True, np.full((270, 480, 3), 40 * self.left, np.uint8)

    def release(self):
        pass


def test_frames_of_a_device_come_grey_with_their_stamps(monkeypatch):
    import cv2

    monkeypatch.setattr(cv2, "VideoCapture", Device)
    monkeypatch.setattr(process, "_GONE", 0.05)
    with pytest.raises(InputError, match="camera 0: gives no more frames; was it unplugged"):
        list(process.frames_of_device(small_camera()))
    frames = process.frames_of_device(small_camera())
    taken = [frame for frame in (next(frames) for _ in range(3)) if frame is not None]
    assert [frame.image.shape for frame in taken] == [(270, 480)] * 3
    clock = StampClock(0.0)
    assert all(0.0 <= frame.arrival - clock.time(frame.stamp, frame.arrival) < 0.2 for frame in taken)
    assert clock.source == "driver"


def test_the_emulator_feeds_pose_and_faults(tmp_path):
    machine = Machine(ROBOT, HARDWARE, MachineOptions(timing=NO_TIME, tick=0.002))
    machine.watchers.append(FeedWriter(machine, tmp_path / "poses", lambda: 100.0))
    machine.inject("camera_moved value=0.05 after=0.01")
    machine.advance(0.04)
    feed = PoseFeed(tmp_path / "poses")
    pose, last = feed.at(200.0), feed.last()
    assert pose is not None
    assert last is not None
    assert pose.time == pytest.approx(100.04, abs=0.003)
    assert pose.position[2] == pytest.approx(HEIGHT, abs=0.005)
    faults = dict(zip(CAMERA_FAULTS, last[1], strict=False))
    assert faults.pop("camera_moved") == pytest.approx(1.05)
    assert not any(faults.values())
    machine.close()


# ---- what the page says ----


def test_the_file_of_the_page_is_one(tmp_path):
    """docs/camera.md: its file, with the shipped markers and calibration in place of the reader's own."""
    page = (Path(__file__).parents[2] / "docs" / "camera.md").read_text(encoding="utf-8")
    given = yaml.safe_load(page.split("```yaml\n")[1].split("```")[0])
    shipped = small_camera()
    calibration = shipped.calibration.model_dump(mode="json")
    content = given | {"calibration": calibration, "body": "body", "floor": "floor"}
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(content))
    camera = load_camera_file(tmp_path / "camera.yaml")
    assert (camera.name, camera.rate, camera.delay) == ("overhead", 30.0, 0.0)
    assert not camera.is_film


def test_a_target_that_is_no_name_is_refused(tmp_path):
    content = small_camera().model_dump(mode="json") | {"body": 3}
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(InputError, match=r"camera\.yaml: .*body"):
        load_camera_file(tmp_path / "camera.yaml")
