"""``wlr calibrate joints`` and ``wlr calibrate imu`` with a scripted operator on an emulated robot."""

import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import data_directory
from wlr_gym.cli import main
from wlr_gym.cli.calibrate import ImuOptions, JointsOptions, ServoOptions, calibrate_imu, calibrate_joints, set_up_servo
from wlr_gym.cli.options import WiredRobotOption
from wlr_gym.cli.terminal import only_results
from wlr_gym.hardware import calibration as find
from wlr_gym.hardware.config import ImuCalibration, Mounting, load_hardware
from wlr_gym.hardware.imu import to_body
from wlr_gym.hardware.servos import FoundServo, check_new_servo
from wlr_gym.robot import JOINTS, LEGS, load_robot

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")

from robot_rig import emulated_imu

from wlr_gym.hardware.dynamixel.bus import BusGroup
from wlr_gym.hardware.dynamixel.protocol import BusGoneError
from wlr_gym.hardware.emulator import Machine, MachineOptions, Server
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.link import emulated_link

ROBOT, NOMINAL = load_robot("emanual"), load_hardware()
NOMINAL_TEXT = (data_directory("configs") / "hardware/nominal.yaml").read_text()
#: How the robot at hand is really mounted: not as the file says.
TRUE = find.with_mountings(
    NOMINAL,
    {"leg_lf": Mounting(sign=-1, zero=3000), "leg_rr": Mounting(sign=1, zero=1100), "wheel_rf": Mounting(sign=1, zero=0)},
)
SENSOR = ImuCalibration(
    gyro_bias=(0.02, -0.1, 0.05), accel_offset=(0.3, -0.2, 0.7), accel_scale=(1.02, 0.99, 0.97), mounting=(0.05, -0.1, 1.6)
)


@pytest.fixture
def machine(monkeypatch):
    """An emulated robot that is mounted as :data:`TRUE` says, and that the commands are connected to."""
    machine = Machine(ROBOT, TRUE, MachineOptions(timing=NO_TIME))
    monkeypatch.setattr(WiredRobotOption, "link", lambda self, changed=None: emulated_link(machine))
    return machine


class Operator:
    """Does with the emulated robot what is asked for; ``answers`` are given to questions they are found in."""

    def __init__(self, machine, answers=(), clumsy=()):
        self.machine, self.answers, self.clumsy = machine, dict(answers), list(clumsy)
        self.questions = []

    def __call__(self, text):
        self.questions.append(text)
        joint = text.split()[0]
        for words, answer in self.answers.items():
            if words in text:
                return answer
        if "swing its foot" in text or "roll it forward" in text:
            moved = self.clumsy.pop() if self.clumsy else joint
            self.machine.turn(moved, np.deg2rad(30.0 if moved in LEGS else 90.0))
        elif "straight down" in text:
            self.machine.turn(joint, np.deg2rad(-30.0))
        self.machine.step()
        return "y" if "[y/N]" in text else ""


def test_the_wizard_finds_how_the_robot_is_mounted(machine, tmp_path, capsys):
    out = tmp_path / "mine.yaml"
    operator = Operator(machine)
    assert calibrate_joints(JointsOptions(out=out), operator) == 0
    found = load_hardware(out)
    for joint in JOINTS:
        assert found.joints[joint].sign == TRUE.joints[joint].sign, joint
        if joint in LEGS:  # the emulated robot sags a little while its legs are swung
            assert found.joints[joint].zero == pytest.approx(TRUE.joints[joint].zero, abs=12), joint
    assert found.model_copy(update={"joints": NOMINAL.joints}) == NOMINAL
    assert len(operator.questions) == 4 * 3 + 4 * 2 + 1
    assert "leg_lf    sign +1 -> -1, zero 1024 -> 30" in capsys.readouterr().out


def test_comments_and_limits_of_the_file_stay(machine, tmp_path):
    out = tmp_path / "mine.yaml"
    calibrate_joints(JointsOptions(out=out, only=("wheel_rf",)), Operator(machine))
    text = out.read_text()
    kept = [line for line in NOMINAL_TEXT.splitlines() if not re.match(r"^(joints:|  (leg|wheel)_..: )", line)]
    assert [line for line in kept if line not in text.splitlines()] == []
    assert re.search(r"# Signs and zeros by wlr calibrate joints, \d{4}-\d\d-\d\d", text)
    assert load_hardware(out) == find.with_mountings(NOMINAL, {"wheel_rf": Mounting(sign=1, zero=0)})


def test_what_was_found_as_json(machine, tmp_path, capsys):
    out = tmp_path / "mine.yaml"
    with only_results(True):
        assert calibrate_joints(JointsOptions(out=out, only=("wheel_rf",), json=True), Operator(machine)) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["hardware"], list(found["joints"])) == (str(out), ["wheel_rf"])
    assert found["joints"]["wheel_rf"]["sign"] in (1, -1)


def test_ports_of_the_command_line_are_not_written_and_comments_stay(machine, tmp_path, request):
    out = tmp_path / "mine.yaml"
    options = JointsOptions(out=out, only=("wheel_rf",), port=("legs=/tmp/robot/legs", "imu=/tmp/robot/imu"))
    calibrate_joints(options, Operator(machine))
    assert load_hardware(out) == find.with_mountings(NOMINAL, {"wheel_rf": Mounting(sign=1, zero=0)})
    assert out.read_text().count("#") == NOMINAL_TEXT.count("#") + 1  # its own note
    sensor = request.getfixturevalue("sensor")
    own = ImuOptions(hardware=str(out), out=out, seconds=2.0, mounting=True, port=("imu=/tmp/robot/imu",))
    calibrate_imu(own, Turner(sensor, [(0, 0, 1), (-0.3, 0, 0.95)]))
    found = load_hardware(out)
    assert (found.imu.port, found.buses) == (NOMINAL.imu.port, NOMINAL.buses)
    assert "# Limits of the command limiter" in out.read_text()


def test_notes_do_not_pile_up_and_odd_layouts_are_written_anew(machine, tmp_path):
    out = tmp_path / "mine.yaml"
    for _ in range(2):
        calibrate_joints(
            JointsOptions(hardware="nominal" if not out.exists() else str(out), out=out, only=("wheel_rf",)), Operator(machine)
        )
    assert out.read_text().count("by wlr calibrate joints") == 1
    odd = tmp_path / "odd.yaml"
    odd.write_text(out.read_text().replace("  leg_rf:", "\n  leg_rf:"))
    assert load_hardware(odd) == load_hardware(out)
    calibrate_joints(JointsOptions(hardware=str(odd), out=odd, only=("wheel_lf",)), Operator(machine))
    assert load_hardware(odd) == load_hardware(out)
    assert "# Limits of the command limiter" in odd.read_text()
    odd.write_text(
        out.read_text()
        .replace("joints:\n", "joints: {\n")
        .replace("# Limits of", "}\n# Limits of")
        .replace("}\n  leg", "},\n  leg")
        .replace("}\n  wheel", "},\n  wheel")
    )
    assert load_hardware(odd) == load_hardware(out)
    calibrate_joints(JointsOptions(hardware=str(odd), out=odd, only=("wheel_lf",)), Operator(machine))
    assert load_hardware(odd) == load_hardware(out)


def test_the_other_joint_is_noticed_and_asked_for_again(machine, tmp_path, capsys):
    operator = Operator(machine, clumsy=["leg_rf"])
    assert calibrate_joints(JointsOptions(out=tmp_path / "a.yaml", only=("leg_lf",)), operator) == 0
    assert re.search(r"leg_rf moved by \d+ counts while leg_lf was asked for.*Once more", capsys.readouterr().out)


def test_no_motor_is_driven_and_none_is_let_go_without_asking(machine, tmp_path):
    machine.servos["leg_lf"].set("torque_enable", 1)
    setpoints = {joint: (servo["goal_position"], servo["goal_velocity"]) for joint, servo in machine.servos.items()}
    operator = Operator(machine, {"Switch them off?": "n"})
    assert calibrate_joints(JointsOptions(out=tmp_path / "a.yaml"), operator) == 1
    assert operator.questions[0].startswith("Motors are on: leg_lf. Off, the robot drops")
    assert machine.servos["leg_lf"]["torque_enable"] == 1
    assert calibrate_joints(JointsOptions(out=tmp_path / "a.yaml"), Operator(machine)) == 0
    assert not any(servo["torque_enable"] for servo in machine.servos.values())
    assert {joint: (servo["goal_position"], servo["goal_velocity"]) for joint, servo in machine.servos.items()} == setpoints


@pytest.mark.parametrize("answers", [{"leg_rf (right front): hold it still": "q"}, {"Write": "n"}])
def test_stopping_writes_nothing(machine, tmp_path, answers):
    options = JointsOptions(out=tmp_path / "a.yaml", only=("leg_lf", "leg_rf"))
    assert calibrate_joints(options, Operator(machine, answers)) == 1
    assert list(tmp_path.iterdir()) == []


def test_skipped_joints_stay(machine, tmp_path):
    out = tmp_path / "a.yaml"
    calibrate_joints(
        JointsOptions(out=out, only=("leg_lf", "leg_rr")), Operator(machine, {"leg_lf (left front): hold it still": "s"})
    )
    assert load_hardware(out).joints["leg_lf"] == NOMINAL.joints["leg_lf"]
    assert load_hardware(out).joints["leg_rr"].sign == 1


def test_a_servo_that_does_not_answer_ends_it(machine, tmp_path):
    operator = Operator(machine)
    machine.inject("dead wheel_rr after=0.01")

    def ask(text):
        machine.advance(0.02)
        return operator(text)

    with pytest.raises(InputError, match=r"id 8: read present_position: no answer; see wlr doctor"):
        calibrate_joints(JointsOptions(out=tmp_path / "a.yaml"), ask)


def test_a_horn_put_on_wrongly_is_told():
    with pytest.raises(InputError, match="leg_lf reads 100 counts straight down, expected about 2048"):
        find.find_zero("leg_lf", 1, 100.0, ROBOT.leg_limits)
    for sign in (1, -1):
        for count in (1300.0, 2048.0, 2800.0):
            zero = find.find_zero("leg_lf", sign, count, ROBOT.leg_limits)
            assert zero + sign * (np.pi / 2) / (2 * np.pi / 4096) == pytest.approx(count, abs=0.5)
    with pytest.raises(InputError, match="leg_lf moved by 200 counts, expected 228"):
        find.find_sign("leg_lf", np.zeros(8), [200, 0, 0, 0, 0, 0, 0, 0])


# ---- IMU -------------------------------------------------------------------------------------------------------------


class Turner:
    """Holds the emulated IMU with ``ups`` (body frame) up, one after the other; the first ``silent`` times in vain."""

    def __init__(self, machine, ups, silent=0):
        self.machine, self.ups, self.silent = machine, list(ups), silent
        self.count = 0
        self.up = np.array([0.0, 0.0, 1.0])
        self.rng = np.random.default_rng(0)
        machine.plant.step = self._read

    def _read(self, setpoints, torque):
        sensors = self.machine.coupling.sensors
        sensors.accelerometer[0] = 9.80665 * self.up + 0.03 * self.rng.standard_normal(3)
        sensors.gyro[0] = 0.001 * self.rng.standard_normal(3)
        return sensors

    def __call__(self, text):
        if "[y/N]" in text:
            return "y"
        self.count += 1
        if self.count <= self.silent:
            self.machine.inject("dead imu")
        else:
            self.machine.clear()
            up = np.array(self.ups.pop(0), float)
            self.up = up / np.linalg.norm(up)
        return ""


@pytest.fixture
def sensor(monkeypatch):
    """An emulated robot whose IMU is as :data:`SENSOR` says, and that the commands are connected to."""
    hardware = find.with_calibration(NOMINAL, SENSOR)
    machine = Machine(ROBOT, hardware, MachineOptions(timing=NO_TIME))

    def link(self, changed=None):
        made = emulated_link(machine)
        assert changed is not None
        made.imu = emulated_imu(made, changed.imu)
        return made

    monkeypatch.setattr(WiredRobotOption, "link", link)
    return machine


def turned(ups):
    """Directions in the body frame that point the sensor's axes as asked for, held by hand: off by a few degrees."""
    rng = np.random.default_rng(2)
    return [to_body(SENSOR) @ (np.array(up) + rng.uniform(-0.1, 0.1, 3)) for up in ups]


SIX = [(0, 0, 1), (0, 0, -1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)]


def test_six_sides_and_mounting_find_the_sensor(sensor, tmp_path):
    turner = Turner(sensor, [*turned(SIX), (0, 0, 1), (-0.3, 0, 0.95)])
    out = tmp_path / "mine.yaml"
    assert calibrate_imu(ImuOptions(out=out, poses=6, mounting=True, seconds=2.0), turner) == 0
    found = load_hardware(out).imu.calibration
    np.testing.assert_allclose(found.gyro_bias, SENSOR.gyro_bias, atol=3e-4)
    np.testing.assert_allclose(found.accel_offset, SENSOR.accel_offset, atol=0.01)
    np.testing.assert_allclose(found.accel_scale, SENSOR.accel_scale, atol=1e-3)
    np.testing.assert_allclose(to_body(found), to_body(SENSOR), atol=2e-3)
    assert found.temperature == pytest.approx(30.0, abs=0.1)
    assert yaml.safe_load(out.read_text())["safety"] == yaml.safe_load(NOMINAL_TEXT)["safety"]


def test_one_level_pose_finds_bias_and_offset(sensor, tmp_path):
    """Scale and mounting are those of the file; here the file's are right, so offset and bias must be too."""
    known = tmp_path / "known.yaml"
    partly = SENSOR.model_copy(update={"gyro_bias": (0.0, 0.0, 0.0), "accel_offset": (0.0, 0.0, 0.0)})
    find.save_hardware(
        known, data_directory("configs") / "hardware/nominal.yaml", find.with_calibration(NOMINAL, partly), "imu", "by hand"
    )
    assert load_hardware(known).imu.calibration == partly
    assert calibrate_imu(ImuOptions(hardware=str(known), out=known, seconds=2.0), Turner(sensor, [(0, 0, 1)])) == 0
    found = load_hardware(known).imu.calibration
    np.testing.assert_allclose(found.gyro_bias, SENSOR.gyro_bias, atol=3e-4)
    np.testing.assert_allclose(found.accel_offset, SENSOR.accel_offset, atol=0.01)
    assert (found.accel_scale, found.mounting) == (SENSOR.accel_scale, SENSOR.mounting)


def test_a_pose_without_readings_is_asked_for_again(sensor, tmp_path, capsys):
    turner = Turner(sensor, [(0, 0, 1), (-0.3, 0, 0.95)], silent=2)
    assert calibrate_imu(ImuOptions(out=tmp_path / "a.yaml", mounting=True, seconds=1.0), turner) == 0
    assert capsys.readouterr().out.count("0 readings of the IMU, expected 50 or more") == 2
    assert turner.count == 4


@pytest.mark.parametrize(
    ("out", "words", "message"),
    [
        ("a.yaml", ["--poses", "3"], "invalid choice '3' for argument '--poses'. Expected one of ('1', '6')"),
        ("a.yaml", ["--seconds", "0.1"], "--seconds 0.1: expected a number from 0.5 to 60 s"),
        ("there.yaml", [], "is there already"),
        ("no/where.yaml", [], "no does not exist"),
        ("mine.txt", [], "expected a file that ends in .yaml, .yml"),
    ],
)
def test_refusals(tmp_path, out, words, message, capsys):
    (tmp_path / "there.yaml").write_text("name: x\n")
    assert main(["calibrate", "imu", "--emulated", "--out", str(tmp_path / out), *words]) == 2
    assert message in capsys.readouterr().err


def test_joints_that_are_none():
    with pytest.raises(InputError, match=r"unknown joint 'leg_fl' \(did you mean"):
        calibrate_joints(JointsOptions(out=Path("a.yaml"), only=("leg_fl",)), lambda text: "")


@pytest.mark.parametrize("what", ["joints", "servo leg_lf", "flow run_01.csv"])
def test_an_emulated_robot_is_not_offered_where_it_cannot_serve(what, tmp_path, capsys):
    assert main(["calibrate", *what.split(), "--out", str(tmp_path / "a.yaml"), "--emulated"]) == 2
    assert "Unrecognized options: --" in capsys.readouterr().err
    assert main(["calibrate", what.split()[0], "--help"]) == 0
    assert "--emulated" not in capsys.readouterr().out


@pytest.mark.parametrize(("text", "code", "words"), [("s\nn\n", 1, "nothing was written"), ("", 2, "is a dialogue")])
def test_answers_can_be_piped_and_their_end_ends_it(machine, tmp_path, monkeypatch, capsys, text, code, words):
    monkeypatch.setattr("sys.stdin", io.StringIO(text))
    assert main(["calibrate", "joints", "--out", str(tmp_path / "a.yaml"), "--only", "leg_lf"]) == code
    said = capsys.readouterr()
    assert words in said.out + said.err
    assert list(tmp_path.iterdir()) == []


# ---- a new servo -----------------------------------------------------------------------------------------------------


@pytest.fixture
def bench():
    """A workbench: servos as out of the box; only those that were plugged in have power."""
    pytest.importorskip("termios")
    machine = Machine(ROBOT, NOMINAL, MachineOptions(timing=NO_TIME, factory=True))
    with Server(machine, real_time=False) as server:

        def plug(*joints):
            for joint in JOINTS:
                machine.servos[joint].set_power(joint in joints)
            return tuple(f"{name}={path}" for name, path in server.ports.items())

        yield machine, plug


@pytest.mark.parametrize(("joint", "id", "mode"), [("leg_rr", 4, 3), ("wheel_lf", 6, 1)])
def test_a_new_servo_gets_its_id_registers_and_speed(bench, capsys, joint, id, mode):
    machine, plug = bench
    machine.servos[joint].set("operating_mode", 4)
    assert set_up_servo(ServoOptions(joint=joint, port=plug(joint)), lambda text: "y") == 0
    servo = machine.servos[joint]
    assert [servo[item] for item in ("id", "baud_rate", "operating_mode", "return_delay_time")] == [id, 3, mode, 0]
    assert f"found: id 1 at 57600 bit/s: model {servo['model_number']}" in capsys.readouterr().out


def test_servos_that_are_not_the_one():
    bus = NOMINAL.buses["wheels"]
    new = FoundServo(1, 57600, 1060, 45)
    assert check_new_servo([new], bus, "wheel_lf") == new
    for found, words in (
        ([], "connect the servo of wheel_lf alone, with power, to /dev/ttyUSB1; found: none"),
        ([new, new._replace(id=9)], "found: id 1 at 57600 bit/s.*; id 9 at 57600"),
        ([new._replace(model_number=1130)], r"wheel_lf needs an XL430-W250-T \(model 1060\); found: .*model 1130"),
    ):
        with pytest.raises(InputError, match=words):
            check_new_servo(found, bus, "wheel_lf")


def test_an_adapter_that_goes_while_servos_are_searched_is_told(bench, monkeypatch, capsys):
    def gone(self):
        raise BusGoneError("port is gone: Input/output error")

    _, plug = bench
    monkeypatch.setattr(BusGroup, "scan", gone)
    ports = ["--port", *plug("wheel_lf")]
    assert main(["calibrate", "servo", "wheel_lf", *ports]) == 2
    assert "port is gone: Input/output error; see wlr doctor" in capsys.readouterr().err
    code = main(["doctor", "--scan", *ports])
    assert (code, "robot      bus: port is gone" in capsys.readouterr().out) == (1, True)


@pytest.mark.slow
def test_servos_that_cannot_be_set_up(bench):
    machine, plug = bench
    ports = plug("wheel_lf")
    machine.servos["wheel_lf"].set("torque_enable", 1)
    with pytest.raises(InputError, match="its torque is on"):
        set_up_servo(ServoOptions(joint="wheel_lf", port=ports), lambda text: "y")
    assert set_up_servo(ServoOptions(joint="wheel_lf", port=ports), lambda text: "n") == 1
    assert machine.servos["wheel_lf"]["id"] == 1
    with pytest.raises(InputError, match="no_such_port: cannot be opened"):
        set_up_servo(ServoOptions(joint="wheel_lf", port=("wheels=/dev/no_such_port",)), lambda text: "y")
