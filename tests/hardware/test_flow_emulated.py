"""The optical-flow sensor of the emulated robot: plant to control loop, faults; the commands of docs/camera.md."""

import json
from typing import Any

import numpy as np
import pytest

from wlr_gym.base.paths import find_config
from wlr_gym.cli import main
from wlr_gym.data.runs import read_run
from wlr_gym.hardware.config import FlowPort, load_hardware
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.link import emulated_link, with_flow_port
from wlr_gym.hardware.emulator.machine import Machine, MachineOptions
from wlr_gym.hardware.emulator.server import Server
from wlr_gym.hardware.flow import FlowStream
from wlr_gym.hardware.flow_comparison import floor_velocity, lens_height
from wlr_gym.hardware.loop import Phase
from wlr_gym.hardware.plant import RobotPlant
from wlr_gym.physics.plants.base import PlantOptions, RobotOptions
from wlr_gym.robot import load_robot

ROBOT = load_robot("flow")
HARDWARE = with_flow_port(ROBOT, load_hardware("nominal"))
SENSOR: Any = ROBOT.sensors.flow
LENS = np.array(SENSOR.position)
STAND, DRIVE, TURN = (0.0, 0.0), (5.0, 5.0), (2.0, 5.0)
#: Fault -> how its reason begins, of the reading; in the order of what they do.
FAULTS = {
    "flow_texture": "poor texture",
    "flow_saturated": "too fast",
    "dead flow": "silent",
    "flip flow probability=0.9": "",
    "flow_frozen": "frozen",
    "flow_scale value=0.8": "",
    "flow_turned": "turned",
    "unplug flow": "no port",
}


class Robot:
    """An emulated robot with a flow sensor, its truth beside it."""

    def __init__(self, log=None, tick=0.002):
        self.machine = Machine(ROBOT, HARDWARE, MachineOptions(tick=tick, timing=NO_TIME))
        options = RobotOptions(log=log)
        self.plant = RobotPlant(ROBOT, 1, PlantOptions(), options, link=emulated_link(self.machine))
        self.plant.reset()

    def drive(self, wheels, seconds, legs=np.pi / 2):
        """Drive on; return per step whether flow was new, its reason, its note, and how far its velocity was off (m/s)."""
        setpoints = np.full((1, 8), legs)
        setpoints[0, 4::2], setpoints[0, 5::2] = wheels
        rows = []
        for _ in range(round(seconds / 0.02)):
            sensors = self.plant.step(setpoints)
            truth = self.machine.plant.truth()
            status: Any = self.plant.loop.status
            reading = status.flow
            height = lens_height(ROBOT, sensors.joint_position[0, :4])
            v = floor_velocity(sensors.flow[0], truth.angular_velocity_in_body[0], height, LENS)
            rows.append((bool(sensors.flow_is_new[0]), reading.trouble, reading.note, v - truth.linear_velocity_in_body[0, :2]))
            assert (sensors.flow_quality[0] > 0.0) == reading.is_new
            assert not (reading.trouble and reading.is_new)
        return rows


@pytest.fixture
def robot():
    robot = Robot()
    yield robot
    robot.plant.close()


def test_emulated_flow_tells_the_velocity_over_the_floor_as_in_the_simulator(robot):
    assert robot.plant.parameters["flow.present"][0] == 1.0
    rows = robot.drive(DRIVE, 0.6) + robot.drive(TURN, 0.6)
    assert np.mean([new for new, *_ in rows]) > 0.98
    errors = np.array([error for *_, error in rows])
    assert np.abs(errors.mean(axis=0)).max() < 0.006
    one = SENSOR.noise * SENSOR.count * np.sqrt(121 * 50) * 0.134
    assert np.all(errors.std(axis=0) < 2.0 * one)


def test_a_robot_without_the_sensor_reads_nothing_of_it():
    robot = load_robot("emanual")
    plant = RobotPlant(robot, 1, link=emulated_link(Machine(robot, load_hardware("nominal"), MachineOptions(tick=0.002))))
    try:
        assert plant.parameters["flow.present"][0] == 0.0
        sensors = plant.reset()
        assert not sensors.flow_is_new[0]
        assert "flow" not in plant.loop.statistics()
    finally:
        plant.close()


def test_frames_come_over_a_port_of_their_own():
    pytest.importorskip("serial")
    machine = Machine(ROBOT, HARDWARE, MachineOptions(tick=0.002, timing=NO_TIME))
    with Server(machine, real_time=False) as server:
        stream = FlowStream(FlowPort(port=server.ports["flow"]), SENSOR, lambda: machine.time)
        stream.open()
        server.advance(0.06)
        reading = stream.read()
        stream.close()
    machine.close()
    assert reading.is_new
    assert stream.statistics.errors == 0


@pytest.mark.slow
def test_no_fault_of_the_sensor_stops_the_drive_and_each_is_a_dropout_with_its_reason(tmp_path):
    robot = Robot(tmp_path)
    for phase in (STAND, DRIVE, TURN):
        for fault, reason in FAULTS.items():
            robot.machine.clear()
            if fault == "unplug flow" and phase is not TURN:  # a port that is gone stays gone
                continue
            robot.drive(phase, 0.1)
            robot.machine.inject(fault)
            rows = robot.drive(phase, 2.4 if fault.startswith("flow_scale") else 1.0)
            assert robot.plant.loop.phase is Phase.RUNNING
            late = rows[35:]
            if fault in ("flow_frozen", "flow_turned", "flow_scale value=0.8") and phase is STAND:
                continue  # where nothing moves, nothing can be told
            if fault == "flow_scale value=0.8":
                assert phase is TURN or any(note.startswith("way: 0.8") for _, _, note, _ in late)  # it needs 0.25 m
            elif fault.startswith("flip"):
                off = np.array([error for new, _, _, error in rows if new])
                assert len(off) > 2
                assert np.abs(off).max() < 0.2  # a broken frame is no reading
            else:
                assert [trouble.partition(":")[0] for _, trouble, *_ in late[:5]] == [reason] * 5
                assert not any(new for new, *_ in late)
            if fault != "unplug flow":
                robot.machine.clear()
                healed = robot.drive(phase, 1.2)
                assert all(new for new, *_ in healed[-3:])
    robot.plant.close()
    assert robot.plant.loop.ended_well
    events = [json.loads(line) for line in next(tmp_path.glob("*.events.jsonl")).read_text().splitlines()]
    told = {event["trouble"].partition(":")[0] for event in events if event["event"] == "flow"}
    assert {"poor texture", "too fast", "silent", "frozen", "turned", "no port"} <= told
    run = read_run(next(tmp_path.glob("run_*.csv")))
    assert np.isnan(run["flow_x"]).any()
    assert np.isfinite(run["flow_x"]).any()


@pytest.mark.slow
def test_a_robot_that_crouches_too_low_loses_the_floor_and_finds_it_again(robot):
    low = robot.drive(STAND, 0.8, legs=0.55)
    assert low[-1][1].startswith("poor texture")
    assert robot.plant.loop.phase is Phase.RUNNING
    assert all(new for new, *_ in robot.drive(STAND, 0.8)[-3:])


@pytest.mark.slow
def test_record_calibrate_and_doctor_from_the_command_line(tmp_path, capsys):
    patch = tmp_path / "patch.yaml"
    patch.write_text("effects:\n- {name: flow_misalignment, parameters: {yaw: 0.12, scale: 1.1}}\n")
    command = ["record", "--emulated", "--robot", "flow", "--excitation", "straight", "--seconds", "9", "--yes"]
    assert main([*command, "--effects", str(patch), "--out", str(tmp_path / "runs")]) == 0
    hardware = tmp_path / "robot.yaml"
    text = find_config("hardware", "nominal").read_text()
    hardware.write_text(text.replace("robot: emanual", "robot: flow") + "flow: {port: /dev/ttyACM1}\n")
    run = next((tmp_path / "runs").glob("run_*.csv"))
    assert main(["calibrate", "flow", str(run), "--hardware", str(hardware), "--out", str(hardware), "--yes"]) == 0
    flow = load_hardware(hardware).flow
    assert flow is not None
    found = flow.calibration
    assert found.scale == pytest.approx(1.1, abs=0.04)
    assert found.mount_yaw == pytest.approx(0.12, abs=0.04)
    assert found.date is not None
    capsys.readouterr()
    assert main(["doctor", "--emulated", "--robot", "flow"]) == 0
    assert "flow       quality: 0.3" in capsys.readouterr().out
