"""``wlr commission`` on emulated robots in emulated time: an unaltered one differs nowhere, one that differs is found."""

import json
import math
import re
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import yaml

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import data_directory
from wlr_gym.cli import main, run_command
from wlr_gym.cli.commission import CommissionOptions, run
from wlr_gym.cli.options import RobotOption
from wlr_gym.data import read_dataset
from wlr_gym.data.format import RunMeta
from wlr_gym.hardware import calibration as find
from wlr_gym.hardware.config import Measured, Mounting, load_hardware
from wlr_gym.robot import JOINTS, LEGS, WHEELS, load_robot
from wlr_gym.robot.parameters import Parameters

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")

from robot_rig import emulated_imu, hardware_file

from wlr_gym.hardware.commissioning import runner
from wlr_gym.hardware.commissioning.runner import Commissioning, Readings, run_test
from wlr_gym.hardware.commissioning.stand import (
    EmulatedPerson,
    PartlyError,
    Person,
    PowerError,
    QuitError,
    SkippedError,
    Stand,
    TroubleError,
)
from wlr_gym.hardware.commissioning.stand_tests import TESTS, StandTest, choose
from wlr_gym.hardware.dynamixel import tables
from wlr_gym.hardware.emulator import MachineOptions, Server
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.link import emulated_link
from wlr_gym.hardware.emulator.stand import EmulatedStand

NOMINAL = load_hardware()
ROBOT = load_robot(NOMINAL.robot or "nominal")
#: Tests in which a person is asked for something often.
ASKING = ("joints", "imu", "stall")
NOMINAL_TEXT = (data_directory("configs") / "hardware/nominal.yaml").read_text()
QUANTITIES = {quantity.name: quantity for test in TESTS.values() for quantity in test.quantities}


@pytest.fixture
def emulated():
    """An emulated robot on a stand."""
    return EmulatedStand(ROBOT, NOMINAL)


@pytest.fixture
def stand(emulated):
    """What may drive it."""
    link = emulated_link(emulated.machine)
    link.open()
    yield Stand(ROBOT, NOMINAL, link)
    link.close()


@pytest.fixture
def beside(emulated, monkeypatch):
    """An emulated robot that the command takes for the real one."""
    monkeypatch.setattr(RobotOption, "link_to", lambda *args: emulated_link(emulated.machine))
    return emulated


def commission(out, tests, *words):
    """Commission the emulated robot of the command; return the exit code."""
    return main(["commission", "--emulated", "--out", str(out), "--tests", *tests.split(), *words])


def motors_on(machine):
    return [joint for joint, servo in machine.servos.items() if servo["torque_enable"] and not servo.dead]


def results_of(folder):
    return {result["test"]: result for result in json.loads((folder / "commission.json").read_text())}


def differing(folder):
    """(quantity, place) of everything that is not as expected."""
    found = [finding for result in results_of(folder).values() for finding in result["findings"]]
    return {(one["quantity"], one["where"]) for one in found if one["verdict"] == "differs"}


# ---- an unaltered robot ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def nominal(tmp_path_factory):
    """Exit code and folder of the whole commissioning of an emulated robot."""
    out = tmp_path_factory.mktemp("commissioning")
    return main(["commission", "--emulated", "--out", str(out)]), out


@pytest.mark.slow
def test_an_unaltered_robot_differs_nowhere(nominal):
    code, out = nominal
    assert differing(out) == set()
    assert code == 0
    results = results_of(out)
    assert list(results) == list(TESTS)
    assert {result["state"] for result in results.values()} == {"done"}
    assert sum(len(result["findings"]) for result in results.values()) > 100


@pytest.mark.slow
def test_what_it_measures_is_what_the_emulator_is_made_of(nominal):
    measured = load_hardware(nominal[1] / "hardware.yaml").measured
    for wheel in WHEELS:
        assert measured.integral_cycle[wheel].value == pytest.approx(1e-3, rel=0.05)
        assert measured.load_per_pwm[wheel].value == pytest.approx(0.0, abs=0.05)  # its load is torque
        friction = ROBOT.servo.wheel.coulomb_friction / ROBOT.servo.wheel.stall_torque
        assert measured.running_load[wheel].value == pytest.approx(friction, rel=0.2)
        assert measured.stall_load[wheel].value == pytest.approx(1.0, abs=0.05)
        assert NOMINAL.safety.watchdog < measured.watchdog_stop_time[wheel].value < 0.5
    for bus in NOMINAL.buses:
        assert measured.adapter_latency[bus].value == pytest.approx(0.0018, abs=0.0005)
        assert measured.adapter_latency[bus].unit == "s"


@pytest.mark.slow
def test_the_hardware_file_keeps_its_comments_and_gets_every_measured_value(nominal):
    text = (nominal[1] / "hardware.yaml").read_text()
    assert text.startswith(NOMINAL_TEXT)
    assert re.search(r"# Measured on the robot by wlr commission", text)
    found = load_hardware(nominal[1] / "hardware.yaml")
    assert found.model_copy(update={"measured": Measured()}) == NOMINAL
    assert set(found.measured.model_fields_set) == set(Measured.model_fields)


def test_every_measured_field_is_a_quantity_of_a_test():
    assert set(Measured.model_fields) <= set(QUANTITIES)


@pytest.mark.slow
def test_its_runs_are_measured_runs(nominal):
    dataset = read_dataset(nominal[1])
    names = {result["run"] for result in results_of(nominal[1]).values()} - {""}
    assert {run.path.name for run in dataset.runs} == names
    step = results_of(nominal[1])["velocity_step"]["run"]
    run = next(run for run in dataset.runs if run.path.name == step)
    assert np.nanmax(run["cmd_wheel_lf"]) == pytest.approx(3.0)
    assert run["vel_wheel_lf"][-1] == pytest.approx(3.0, abs=0.1)
    assert np.isnan(run["cmd_leg_lf"]).all()
    assert json.loads((nominal[1] / "load.json").read_text())["samples"]["pwm_wheel_lf"][-1] == pytest.approx(0.49, abs=0.05)


# ---- a robot that differs --------------------------------------------------------------------------------------------


def changed(name, joint, factor):
    parameters = Parameters.nominal(ROBOT)
    parameters[name][0, JOINTS.index(joint)] *= factor
    return parameters


#: Tests in their order, and one of them -> its readings of the emulated robot that is as the files say; each is made once.
EXPECTED: dict[tuple[str, ...], Readings] = {}


def make(folder, emulated, *tests, person=None, link=None, expected=EXPECTED):
    """Commission an emulated robot; return the results by test."""
    link, made = link or emulated_link(emulated.machine), runner.run_test
    found = []

    def remembering(test, stand, person):
        if person is not commissioning._model_person:
            return made(test, stand, person)
        key = (*tests, test.name)
        if key not in expected:
            expected[key] = made(test, stand, person)
        return expected[key]

    whole = Commissioning(ROBOT, NOMINAL, link, person or EmulatedPerson(emulated), folder, RunMeta())
    with mock.patch.object(runner, "run_test", remembering), whole as commissioning:
        assert commissioning.faults() == []
        for result in commissioning.make(choose(tests)):
            found.append(result)
            assert motors_on(emulated.machine) == []
    return {result.test: result for result in found}


def found_in(results):
    findings = [finding for result in results.values() for finding in result.findings]
    return {(finding.quantity, finding.where) for finding in findings if not finding.is_expected}


@pytest.mark.parametrize(
    ("name", "joint", "factor", "test", "quantities"),
    [
        ("servo.stall_torque", "wheel_rf", 0.7, "stall", {"stall_load"}),
        ("servo.stall_torque", "leg_rf", 0.7, "stall", {"stall_load"}),
        ("servo.torque_scale", "leg_lr", 0.5, "load", {"running_load"}),
        ("servo.kp", "wheel_lr", 0.7, "velocity_step", {"velocity_loop_time", "integral_cycle"}),
        ("servo.coulomb_friction", "wheel_rr", 2.0, "load", {"running_load"}),
        ("servo.kp", "wheel_lf", 0.4, "watchdog", {"watchdog_stop_time"}),
    ],
)
def test_a_servo_that_differs_is_found_and_named(tmp_path, name, joint, factor, test, quantities):
    results = make(tmp_path, EmulatedStand(ROBOT, NOMINAL, parameters=changed(name, joint, factor)), test)
    assert found_in(results) == {(quantity, joint) for quantity in quantities}
    assert not results[test].is_good


def test_legs_that_get_a_part_of_their_voltage_are_found(emulated, tmp_path):
    emulated.machine.inject("slow_servo legs value=0.05")
    results = make(tmp_path, emulated, "load", "stall")
    assert found_in(results) == {("stall_pwm", leg) for leg in LEGS}


class Careless(EmulatedPerson):
    """Holds each of some joints only the nth time that it is asked for, and notes what it is told then."""

    def __init__(self, stand, **holds):
        super().__init__(stand)
        self.holds, self.told = holds, []

    def brake(self, joint, trouble=""):
        self.told += [trouble] if trouble else []
        self.holds[joint] = self.holds.get(joint, 1) - 1
        if self.holds[joint] <= 0:
            super().brake(joint, trouble)


def test_a_leg_that_does_not_move_or_is_not_held_has_no_strength(tmp_path):
    effect = {"name": "weak_motor", "where": ["leg_rf"], "parameters": {"scale": 0.05}}
    emulated = EmulatedStand(ROBOT, NOMINAL, {"effects": [effect]})
    results = make(tmp_path, emulated, "load", "stall", person=Careless(emulated, leg_lf=3, wheel_rr=3))
    assert [result.state for result in results.values()] == ["failed", "failed"]
    assert re.match(r"leg_rf moved by 0.0\d+ rad, expected 0.12 within 20%", results["load"].reason)
    assert re.match(r"not measured: wheel_rr .*; leg_lf turned by 0.1\d rad, .*: hold it firmly$", results["stall"].reason)
    assert {finding.where for finding in results["stall"].findings} == set(JOINTS) - {"wheel_rr", "leg_lf"}
    assert found_in(results) == set()


def test_a_joint_that_slips_is_asked_for_once_more(emulated, tmp_path):
    person = Careless(emulated, leg_rf=2, wheel_lf=2)
    result = make(tmp_path, emulated, "stall", person=person)["stall"]
    assert result.is_good
    assert {finding.where for finding in result.findings} == set(JOINTS)
    assert [re.sub(r"turned by .*:", ":", text) for text in person.told] == [
        f"{joint} : hold it firmly. Once more. " for joint in ("wheel_lf", "leg_rf")
    ]


def test_torque_comes_on_where_the_hand_holds_the_joint(emulated, stand, monkeypatch):
    off = []

    class Mover(EmulatedPerson):
        def brake(self, joint, trouble=""):
            for leg in LEGS if joint in LEGS else ():
                emulated.machine.turn(leg, 0.3 if leg == joint else -0.1)
            super().brake(joint, trouble)

    def note(joints):
        off.extend(abs(stand.servos.get(leg, "goal_position") - stand.servos.get(leg, "present_position")) for leg in joints)
        switch_on(joints)

    switch_on = stand.switch_on
    monkeypatch.setattr(stand, "switch_on", lambda joints: note(joints) if joints[0] in LEGS else switch_on(joints))
    run_test(TESTS["stall"], stand, Mover(emulated))
    assert len(off) == len(LEGS)
    assert max(off) <= 2  # counts


def test_nobody_says_that_legs_have_no_profile(tmp_path):
    assert commission(tmp_path, "velocity_step") == 0
    (run_made,) = read_dataset(tmp_path).runs
    assert not run_made.meta.states_profile


@pytest.mark.slow
def test_a_rubbing_wheel_and_a_slow_adapter_are_told_on_the_command_line(tmp_path, capsys):
    patch = {"effects": [{"name": "coulomb_friction", "where": ["wheel_rf"], "parameters": {"torque": 0.05}}]}
    (tmp_path / "rub.yaml").write_text(yaml.safe_dump(patch))
    words = ["--effects", str(tmp_path / "rub.yaml"), "--fault", "delay legs value=0.015"]
    assert commission(tmp_path / "out", "latency load", *words) == 1
    assert differing(tmp_path / "out") == {("adapter_latency", "legs"), ("running_load", "wheel_rf")}
    shown = capsys.readouterr().out
    assert "legs, adapter_latency: median time of a ping" in shown
    assert "wheel_rf, running_load: load of the free wheel, or of the leg" in shown
    assert load_hardware(tmp_path / "out" / "hardware.yaml").measured.adapter_latency["legs"].value > 0.01


@pytest.mark.filterwarnings("error")
def test_a_wheel_that_does_not_turn_has_no_load(tmp_path, capsys):
    assert commission(tmp_path, "load", "--yes", "--fault", "slow_servo wheel_lf") == 1
    result = results_of(tmp_path)["load"]
    assert result["state"] == "failed"
    assert "wheel_lf turns at 0." in result["reason"]
    assert "expected 1 within 20%" in result["reason"]
    assert "wheel_rf" not in result["reason"]
    assert "as expected" not in capsys.readouterr().out


def test_a_joint_mounted_the_other_way_and_a_wrong_zero_are_found(tmp_path):
    mounted = find.with_mountings(NOMINAL, {"leg_rf": Mounting(sign=1, zero=1024), "wheel_lr": Mounting(sign=-1, zero=0)})
    results = make(tmp_path, EmulatedStand(ROBOT, mounted), "joints")
    assert found_in(results) == {("joint_sign", "leg_rf"), ("joint_sign", "wheel_lr")}
    offset = {"name": "joint_zero_offset", "where": ["leg_lr"], "parameters": {"angle": 0.08}}
    results = make(tmp_path, EmulatedStand(ROBOT, NOMINAL, {"effects": [offset]}), "joints")
    assert found_in(results) == {("joint_zero", "leg_lr")}


@pytest.mark.slow
def test_an_imu_that_is_mounted_otherwise_is_found(emulated, tmp_path):
    link = emulated_link(emulated.machine)
    turned = NOMINAL.imu.model_copy(
        update={"calibration": NOMINAL.imu.calibration.model_copy(update={"mounting": (0, 0, 1.57)})}
    )
    link.imu = emulated_imu(link, turned)
    found = found_in(make(tmp_path, emulated, "imu", link=link))
    assert found == {(quantity, "imu") for quantity in ("gyro_roll", "gyro_pitch", "tilt_roll", "tilt_pitch")}


# ---- whatever happens, motors are off --------------------------------------------------------------------------------


def test_a_leg_that_a_hand_moved_far_gets_no_torque(emulated, stand):
    stand.prepare(["leg_lf"])
    for far, on in ((-0.1, ["leg_lf"]), (-0.8, [])):
        stand.prepare(["leg_lf"])
        counts = stand.servos.get("leg_lf", "present_position") + round(far / (2.0 * math.pi) * 4096.0)
        stand.servos.set("leg_lf", "goal_position", counts)
        if on:
            stand.switch_on(["leg_lf"])
        else:
            with pytest.raises(TroubleError, match=r"leg_lf: [+-]0\.80 rad from its setpoint, expected 0\.12 at most"):
                stand.switch_on(["leg_lf"])
        assert motors_on(emulated.machine) == on
        stand.switch_off(["leg_lf"])


def test_a_leg_that_is_turned_too_far_costs_only_its_own_value(emulated, stand):

    class Far(EmulatedPerson):
        def turn(self, joint, angle):
            super().turn(joint, 1.6 * angle)

    with pytest.raises(PartlyError, match="turn it less"):
        run_test(TESTS["torque_on"], stand, Far(emulated))
    assert {quantity for quantity, _ in stand.readings} == {"wheel_follows_given", "wheel_follows_kept", "leg_follows_given"}


def test_a_stop_that_came_during_a_question_comes_before_torque(emulated, stand):
    stand.operator.ask_to_stop("SIGINT")
    with pytest.raises(QuitError, match="SIGINT"):
        stand.switch_on(WHEELS)
    assert motors_on(emulated.machine) == []


def test_only_enter_is_consent():
    for answer in ("n", "no", "x", "s"):
        person = Person(lambda text, answer=answer: answer)
        for ask in (lambda person: person.ready("Latency."), lambda person: person.brake("wheel_lf")):
            with pytest.raises(SkippedError):
                ask(person)
    Person(lambda text: "").ready("Latency.")


def spinning(then):
    def measure(stand, person):
        stand.prepare(JOINTS)
        stand.switch_on(JOINTS)
        stand.spin(dict.fromkeys(WHEELS, 2.0))
        stand.weaken("wheel_lf")
        stand.run(0.1)
        then(stand)

    return StandTest("trial", "", "", "", (), measure)


def fail(error):
    raise error


@pytest.mark.parametrize("error", [TroubleError("odd"), QuitError(), RuntimeError("a mistake"), KeyboardInterrupt()])
def test_motors_are_off_and_registers_back_however_a_test_ends(emulated, stand, error):
    seen = []

    def end(stand):
        seen.append(motors_on(emulated.machine))
        seen.append({servo["bus_watchdog"] for servo in emulated.machine.servos.values()})
        fail(error)

    with pytest.raises(type(error)):
        run_test(spinning(end), stand, EmulatedPerson(emulated))
    assert seen == [list(JOINTS), {10}]  # armed, 0.2 s
    assert motors_on(emulated.machine) == []
    wheel, leg = emulated.machine.servos["wheel_lf"], emulated.machine.servos["leg_lf"]
    assert (wheel["goal_velocity"], wheel["goal_pwm"], wheel["bus_watchdog"]) == (0, 885, 0)
    assert leg["goal_position"] == leg["present_position"]


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("dead wheel_rr", "no answer from wheel_rr"),
        ("overload wheel_rr", "wheel_rr: a hardware error"),
        ("brownout wheel_rr", "wheel_rr"),
        ("unplug wheels", "unplugged"),
    ],
)
def test_a_fault_ends_the_test_with_motors_off(emulated, stand, fault, words):

    def fault_then_run(stand):
        emulated.machine.inject(fault)
        stand.run(1.0)

    with pytest.raises((TroubleError, ConnectionError, PowerError)) as ended:
        run_test(spinning(fault_then_run), stand, EmulatedPerson(emulated))
    chain = f"{ended.value} {ended.value.__context__}"
    assert words in chain
    assert [joint for joint in motors_on(emulated.machine) if "unplug" not in fault or joint in LEGS] == []


def test_a_held_wheel_ends_the_test(emulated, stand):

    def hold(stand, person):
        stand.prepare(WHEELS)
        stand.switch_on(WHEELS)
        emulated.brake("wheel_lf")
        stand.spin({"wheel_lf": 3.0})
        stand.run(3.0)

    with pytest.raises(TroubleError, match=r"wheel_lf: above 40% of stall torque: does something hold it\?"):
        run_test(StandTest("trial", "", "", "", (), hold), stand, EmulatedPerson(emulated))
    assert motors_on(emulated.machine) == []


def test_torque_that_does_not_go_off_ends_everything(emulated, tmp_path):

    class Saboteur(EmulatedPerson):
        def watch_supply(self):
            emulated.machine.inject("dead wheel_rr")

    link = emulated_link(emulated.machine)
    with Commissioning(ROBOT, NOMINAL, link, Saboteur(emulated), tmp_path, RunMeta()) as commissioning:
        results = list(commissioning.make([TESTS["stall"], TESTS["latency"]]))
    assert [(result.test, result.state) for result in results] == [("stall", "stopped")]
    assert results[0].reason == "CUT THE POWER: torque is not confirmed off at wheel_rr"


@pytest.mark.parametrize("fault", ["", "dead wheel_rr"])
def test_the_watchdog_process_of_a_real_robot_is_released_when_torque_is_off(emulated, tmp_path, monkeypatch, fault):
    guards = []

    class Guard:
        def __init__(self, *_, is_wanted):
            self.is_released = not is_wanted
            guards.append(self)

        def start(self, log):
            pass

        def release(self):
            self.is_released = True

        def expect(self, seconds):
            pass

    monkeypatch.setattr(runner, "Guard", Guard)
    link = emulated_link(emulated.machine)
    link.is_serial = True

    class Saboteur(EmulatedPerson):
        def turn(self, joint, angle):
            super().turn(joint, angle)
            if fault:
                emulated.machine.inject(fault)

    with Commissioning(ROBOT, NOMINAL, link, Saboteur(emulated), tmp_path, RunMeta()) as commissioning:
        list(commissioning.make(choose(["joints"])))
    assert [guard.is_released for guard in guards] == [not fault]


@pytest.mark.parametrize(
    "name",
    ["watchdog", "velocity_step", "torque_on", "load", *(pytest.param(name, marks=pytest.mark.slow) for name in ASKING)],
)
def test_the_next_sign_of_life_comes_in_time_while_a_motor_is_on(emulated, stand, monkeypatch, name):
    """However long a person takes over a question: no motor is on then. Whenever one is, a sign is promised."""
    signs = []
    stand.sign_of_life = lambda seconds: signs.append((stand.clock.now(), seconds))
    look_at_promises(monkeypatch, emulated, stand, lambda: signs[-1][1] if signs else math.inf)
    human = SlowHuman(emulated, stand.clock)
    run_test(TESTS[name], stand, Person(human))
    assert bool(human.asked) == (name in ("torque_on", *ASKING))
    times, promised = np.array(signs).T
    assert promised[-1] == math.inf
    assert motors_on(emulated.machine) == []
    waited = np.diff(times)
    on = np.isfinite(promised[:-1])
    assert on.sum() > 10 or name in ("joints", "imu")
    assert (waited[on] < promised[:-1][on]).all()
    late = promised[:-1][on] - waited[on]  # how much later than needed it would be seen that nothing comes any more
    assert (late[:-1] < 2.1).all()


def look_at_promises(monkeypatch, emulated, stand, promised):
    """See at every reading that a next sign of life is promised just while a motor is on."""
    read = stand.servos.read

    def look():
        assert (promised() < math.inf) == bool(motors_on(emulated.machine))
        return read()

    monkeypatch.setattr(stand.servos, "read", look)


def test_signs_of_life_are_promised_whenever_a_held_motor_is_on(emulated, stand, monkeypatch):
    promised = [math.inf]
    stand.sign_of_life = promised.append
    look_at_promises(monkeypatch, emulated, stand, lambda: promised[-1])
    run_test(TESTS["stall"], stand, EmulatedPerson(emulated))


def test_the_stand_has_limits_of_its_own(stand):
    for speeds in ({"wheel_lf": 3.1}, {"wheel_lf": float("nan")}, {"leg_lf": 1.0}):
        with pytest.raises(InputError, match="expected a wheel and 3 rad/s at most"):
            stand.spin(speeds)
    with pytest.raises(InputError, match=r"leg_lf: by 0.2 rad to 1.77, expected a leg, 0.12 rad at most"):
        stand.lean("leg_lf", 0.2)
    slow = NOMINAL.model_copy(update={"safety": NOMINAL.safety.model_copy(update={"wheel_speed": 1.5})})
    stand.hardware = slow
    with pytest.raises(InputError, match=r"wheel_lf: 2 rad/s, expected a wheel and 1.5 rad/s at most"):
        stand.spin({"wheel_lf": 2.0})


def test_a_robot_with_a_fault_is_not_switched_on(tmp_path, capsys):
    assert commission(tmp_path, "watchdog", "--fault", "dead leg_rf") == 1
    shown = capsys.readouterr().out
    assert "leg_rf     answer: none" in shown
    assert "Nothing was switched on" in shown
    assert not (tmp_path / "commission.json").exists()


# ---- the person ------------------------------------------------------------------------------------------------------


def test_nothing_is_armed_while_hands_are_at_the_robot(emulated, stand):

    class Watcher(EmulatedPerson):
        def turn(self, joint, angle):
            assert {servo["bus_watchdog"] for servo in emulated.machine.servos.values()} == {0}
            super().turn(joint, angle)

    run_test(TESTS["torque_on"], stand, Watcher(emulated))


class Human:
    """Reads the questions and does with the emulated robot what they ask for; ``answers`` to questions they are found in."""

    def __init__(self, emulated, **answers):
        self.emulated, self.answers = emulated, answers
        self.asked = []

    def __call__(self, text):
        assert motors_on(self.emulated.machine) == [], text
        self.asked.append(text)
        for words, answer in self.answers.items():
            if words in text:
                return answer
        joint = text.split()[0]
        if turned := re.search(r"(swing its foot to the|roll it) (back|front|forward|backward) by about (\d+) deg", text):
            way = 1 if turned.group(2) in ("back", "forward") else -1
            self.emulated.machine.turn(joint, way * np.deg2rad(float(turned.group(3))))
        elif "straight down" in text and joint in LEGS:
            self.emulated.machine.straighten(joint)
        elif "hold the tyre" in text or "hold its end" in text:
            self.emulated.brake(joint)
        elif "let go" in text:
            self.emulated.release(joint)
        elif joint == "Robot:":
            tilts = {"roll": "right side down", "pitch": "nose down", "yaw": "nose to the left"}
            self.emulated.tilt(**{name: math.radians(20.0) for name, words in tilts.items() if words in text})
        return ""


class SlowHuman(Human):
    """Lets 5 s pass before every answer."""

    def __init__(self, emulated, clock):
        super().__init__(emulated)
        self.clock = clock

    def __call__(self, text):
        self.clock.wait_until(self.clock.now() + 5.0)
        return super().__call__(text)


@pytest.mark.slow
def test_a_human_is_led_through_and_nobody_is_asked_while_a_motor_is_on(beside, tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text(NOMINAL_TEXT)
    drawn = f"{0.2**2 * beside.stall_current:.3f}"
    human = Human(beside, **{"Write the measured": "y", "current while": drawn, "Sign and zero": "s"})
    options = CommissionOptions(hardware=str(mine), out=tmp_path / "out", tests=("joints", "torque_on", "stall"))
    assert run(options, human) == 0
    assert [result["state"] for result in results_of(tmp_path / "out").values()] == ["skipped", "done", "done"]
    starts = [text for text in human.asked if "Enter starts, s skips, q ends" in text]
    assert len(starts) == 3
    assert "Each wheel, then each leg's end, is to be held by hand" in starts[2]
    found = load_hardware(mine)
    assert found.measured.stall_current["wheel_lf"].value == pytest.approx(beside.stall_current, rel=0.05)
    assert not found.measured.joint_zero


def test_a_joint_that_cannot_be_held_is_named_and_the_others_are_told(beside, tmp_path, capsys):
    class OneHanded(Human):
        def __call__(self, text):
            answer = super().__call__(text)
            if "leg_rf (right front): hold" in text:
                self.emulated.release("leg_rf")
            return answer

    human = OneHanded(beside)
    assert run(CommissionOptions(out=tmp_path, tests=("stall",), yes=True), human) == 1
    (again,) = (text for text in human.asked if "Once more" in text)
    assert re.match(r"leg_rf turned by .*: hold it firmly. Once more. leg_rf \(right front\): hold its end", again)
    shown = capsys.readouterr().out
    assert "stall: failed: not measured: leg_rf turned by" in shown
    assert "Not tested: stall in part." in shown
    assert set(load_hardware(tmp_path / "hardware.yaml").measured.stall_load) == set(JOINTS) - {"leg_rf"}


def test_how_the_body_is_to_be_turned():
    asked = []
    person = Person(lambda text: asked.append(text) or "")
    for angles in ({"roll": 0.35}, {"pitch": 0.35}, {"yaw": 0.35}, {}):
        person.tilt(3.0, **angles)
    ways = ["right side down by about 20 deg", "nose down by about 20 deg", "nose to the left by about 20 deg", "level"]
    assert all(way in text and "within 3 s" in text for way, text in zip(ways, asked, strict=True))


def test_the_way_out_is_always_open(beside, tmp_path, capsys):
    for word, made in (("Latency", 0), ("leg_lf (left front): swing", 2)):
        out = tmp_path / str(made)
        options = CommissionOptions(out=out, tests=("latency", "silent_servo", "joints"))
        assert run(options, Human(beside, **{word: "q", "Write": "n"})) == 1
        states = [result["state"] for result in results_of(out).values()]
        assert states == ["done"] * made + ["stopped"]
        shown = capsys.readouterr().out
        assert f"Not tested: {', '.join(['latency', 'silent_servo', 'joints'][made:])}." in shown
        assert ("values of the other tests as expected" in shown) == bool(made)


def test_a_signal_during_the_comparison_stops_everything_too(emulated, monkeypatch, tmp_path):
    made = []

    def interrupted(test, stand, person):
        made.append(person)
        if len(made) == 2:  # the emulated robot that the readings are compared with
            raise QuitError("SIGINT")
        return run_test(test, stand, person)

    monkeypatch.setattr(runner, "run_test", interrupted)
    (result,) = make(tmp_path, emulated, "latency", "silent_servo", expected={}).values()
    assert (result.test, result.state, result.reason, result.findings) == ("latency", "stopped", "SIGINT", ())


# ---- a computer that is busy -----------------------------------------------------------------------------------------


class Hiccups:
    """A clock of whose waits some last 0.5 s longer, for the computer was busy with something else.

    Args:
        clock: of the robot.
        waits: which, from 1.
    """

    def __init__(self, clock, waits):
        self.clock, self.waits, self.count = clock, waits, 0
        self.now = clock.now

    def wait_until(self, moment):
        self.count += 1
        self.clock.wait_until(moment + (0.5 if self.count in self.waits else 0.0))


def make_with_hiccups(folder, test, waits, person=None):
    """Commission an emulated robot; return the result."""
    emulated = EmulatedStand(ROBOT, NOMINAL)
    link = emulated_link(emulated.machine)
    link.clock = Hiccups(link.clock, waits)
    return make(folder, emulated, test, person=person, link=link)[test]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("test", "wait"),
    [
        ("velocity_step", 10),  # the setpoint is refused ...
        ("velocity_step", 20),  # ... or wheels stop on their way
        ("load", 70),
        ("watchdog", 80),  # not in the silence that is wanted
        ("torque_on", 215),
        ("stall", 30),
    ],
)
def test_a_test_is_made_once_more_where_the_computer_was_silent_for_too_long(tmp_path, test, wait):
    result = make_with_hiccups(tmp_path, test, {wait})
    assert result.state == "done"
    assert result.is_good
    (reason,) = result.repeated
    assert re.search(r"_\w\w: stopped by the Bus Watchdog: this computer, or the bus, was silent for longer than 0.2 s", reason)
    assert json.loads((tmp_path / f"{test}.json").read_text())["repeated"] == [reason]
    assert len(read_dataset(tmp_path).runs) == 1  # not the one whose wheels were stopped


def test_a_computer_that_is_always_busy_is_named_and_not_the_servo(tmp_path):
    result = make_with_hiccups(tmp_path, "velocity_step", range(8, 100000, 8))
    assert (result.state, len(result.repeated)) == ("failed", 2)
    assert re.search(r"silent for longer than 0.2 s, in 3 tries$", result.reason)
    assert "refused" not in result.reason
    assert result.run == ""
    assert not result.findings


def test_who_is_beside_the_robot_is_asked_before_a_test_is_made_once_more(tmp_path):
    asked = []
    person = Person(lambda text: asked.append(text) or ("" if len(asked) == 1 else "q"))
    result = make_with_hiccups(tmp_path, "velocity_step", {20}, person)
    assert [text.startswith("Once more, for wheel_lf") for text in asked] == [False, True]
    assert (result.state, len(result.repeated)) == ("stopped", 1)


def test_a_setpoint_that_is_refused_for_another_reason_is_told_as_it_is(emulated, tmp_path):

    class Saboteur(EmulatedPerson):
        def ready(self, test):
            emulated.machine.servos["wheel_lf"].set("velocity_limit", 50)

    result = make(tmp_path, emulated, "velocity_step", person=Saboteur(emulated))["velocity_step"]
    assert (result.state, result.repeated) == ("failed", ())
    assert "write goal_velocity" in result.reason
    assert "refused (data limit error)" in result.reason


def test_a_lost_answer_now_and_then_leaves_no_gap(emulated, tmp_path):
    emulated.machine.inject("drop probability=0.01")
    results = make(tmp_path, emulated, "velocity_step", "stall")
    assert found_in(results) == set()
    assert {result.state for result in results.values()} == {"done"}


@pytest.mark.slow
def test_over_serial_ports(tmp_path, monkeypatch):
    """In emulated time: what the emulator and this process are given of the processor does not matter."""
    pytest.importorskip("termios")
    emulated = EmulatedStand(ROBOT, NOMINAL, options=MachineOptions(timing=NO_TIME))
    with Server(emulated.machine, real_time=False) as server:
        monkeypatch.setattr("wlr_gym.hardware.link.MonotonicClock", lambda: ServedClock(server))
        mine = hardware_file(tmp_path, server.ports, patience=1.0, watchdog=NOMINAL.safety.watchdog)
        words = ["--hardware", str(mine), "--yes", "--out", str(tmp_path / "out"), "--tests", "watchdog", "velocity_step"]
        assert main(["commission", *words]) == 0
        assert motors_on(emulated.machine) == []
    assert {result["state"] for result in results_of(tmp_path / "out").values()} == {"done"}
    assert set(load_hardware(mine).measured.velocity_loop_time) == set(WHEELS)


class ServedClock:
    """The emulated time of a robot on serial ports, which passes when somebody waits."""

    def __init__(self, server):
        self.server = server

    def now(self):
        return self.server.machine.time

    def wait_until(self, moment):
        if (left := moment - self.now()) > 0.0:
            self.server.advance(left)


def test_options_that_make_no_sense(tmp_path):
    for words, message in (
        (["--tests", "latncy", "--out", str(tmp_path)], "unknown test 'latncy' (did you mean 'latency'?)"),
        ([], "--out: expected a folder"),
        (["--fault", "drop legs", "--out", str(tmp_path)], "--fault: it is for the emulated robot"),
        (["--effects", "stiff_leg", "--out", str(tmp_path)], "--effects: a real robot has its own"),
    ):
        with pytest.raises(InputError, match=re.escape(message)):
            run_command("commission", words)


def test_the_list_names_every_test(capsys):
    assert main(["commission", "--list"]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in TESTS)


def test_what_was_measured_stays_when_somebody_leaves(beside, tmp_path):

    def leave(text):
        if "A read of" in text:
            raise KeyboardInterrupt
        return ""

    tests = ("latency", "silent_servo")
    with pytest.raises(KeyboardInterrupt):
        run(CommissionOptions(out=tmp_path, tests=tests), leave)
    assert set(load_hardware(tmp_path / "hardware.yaml").measured.adapter_latency) == set(NOMINAL.buses)
    run(CommissionOptions(out=tmp_path, tests=("silent_servo",), force=True, yes=True), Human(beside))
    assert set(load_hardware(tmp_path / "hardware.yaml").measured.adapter_latency) == set(NOMINAL.buses)


def test_a_hardware_file_of_ones_own_is_no_folder_for_results(tmp_path, capsys):
    file = tmp_path / "hardware.yaml"
    file.write_text(NOMINAL_TEXT)
    assert commission(tmp_path, "latency") == 2
    assert "hardware.yaml: exists" in capsys.readouterr().err
    assert commission(tmp_path, "latency", "--hardware", str(file), "--force") == 2
    assert "its hardware.yaml is the file of --hardware" in capsys.readouterr().err
    assert file.read_text() == NOMINAL_TEXT


def test_the_copy_finds_a_servo_file_beside_the_original(tmp_path, capsys):
    (tmp_path / "mine").mkdir()
    content = yaml.safe_load(NOMINAL_TEXT)
    table = Path(tables.__file__).parent / "xm540_w150.yaml"
    (tmp_path / "mine" / "my_servo.yaml").write_text(table.read_text())
    content["buses"]["legs"]["model"] = "my_servo.yaml"
    (tmp_path / "mine" / "hardware.yaml").write_text(yaml.safe_dump(content))
    assert commission(tmp_path / "out", "latency", "--hardware", str(tmp_path / "mine" / "hardware.yaml")) == 0
    copy = load_hardware(tmp_path / "out" / "hardware.yaml")
    assert Path(copy.buses["legs"].model) == tmp_path / "mine" / "my_servo.yaml"
    assert set(copy.measured.adapter_latency) == set(copy.buses)


def test_json_goes_to_the_standard_output(tmp_path, capsys):
    assert commission(tmp_path, "latency", "--json") == 0
    assert [result["test"] for result in json.loads(capsys.readouterr().out)] == ["latency"]


def test_what_was_measured_must_be_of_this_robot(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text(NOMINAL_TEXT + "measured:\n  stall_load:\n    wheel_xy: {value: 1.0, unit: '-', date: '2026-01-01'}\n")
    with pytest.raises(InputError, match=r"measured.stall_load: unknown joint or bus 'wheel_xy'"):
        load_hardware(file)
    file.write_text(NOMINAL_TEXT + "measured:\n  stal_load: {}\n")
    with pytest.raises(InputError, match=r"unknown key 'measured.stal_load' \(did you mean 'stall_load'"):
        load_hardware(file)


def test_a_second_commissioning_keeps_what_it_did_not_measure(tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    assert commission(first, "latency") == 0
    file = first / "hardware.yaml"
    assert commission(second, "silent_servo", "--hardware", str(file)) == 0
    found = load_hardware(second / "hardware.yaml").measured
    assert found.adapter_latency == load_hardware(file).measured.adapter_latency
    assert set(found.answers_behind_fast) == set(NOMINAL.buses)
    text = (second / "hardware.yaml").read_text()
    assert text.count("measured:") == text.count("by wlr commission") == 1


def test_tests_made_again_leave_the_results_of_the_others(tmp_path, capsys):
    assert commission(tmp_path, "latency silent_servo") == 0
    first = results_of(tmp_path)
    assert commission(tmp_path, "silent_servo", "--force") == 0
    second = results_of(tmp_path)
    assert second["latency"] == first["latency"]
    assert set(second) == set(first)
    measured = load_hardware(tmp_path / "hardware.yaml").measured
    assert set(measured.adapter_latency) == set(measured.answers_behind_fast) == set(NOMINAL.buses)
    assert commission(tmp_path, "latency", "--force", "--fault", "delay legs value=0.015") == 2
    assert "silent_servo is of robot 'wlr-emanual', hardware 'nominal', emulated, not of" in capsys.readouterr().err
    assert results_of(tmp_path) == second


@pytest.mark.parametrize("answers", [{"Latency": "q"}, {"Latency": "s", "A read of": "q"}, {"swing its foot": "q"}])
def test_a_test_that_is_not_made_leaves_its_earlier_result(beside, tmp_path, answers):
    tests = ("latency", "silent_servo", "joints")
    assert run(CommissionOptions(out=tmp_path, tests=tests, yes=True), Human(beside)) == 0
    first, samples = results_of(tmp_path), (tmp_path / "joints.json").read_text()
    run(CommissionOptions(out=tmp_path, tests=tests, force=True), Human(beside, **answers))
    second = json.loads((tmp_path / "commission.json").read_text())
    assert [result["state"] for result in second] == ["done"] * 3
    assert {result["test"] for result in second} == set(tests)
    assert results_of(tmp_path)["joints"] == first["joints"]
    assert (tmp_path / "joints.json").read_text() == samples


@pytest.mark.parametrize(
    "content", ['[{"test": "silent_servo", "state": "done", "findings": []}]', '[{"test": "silent_se', "{}  []", '{"a": 1}']
)
def test_results_of_nobody_knows_whom_are_replaced(tmp_path, capsys, content):
    (tmp_path / "commission.json").write_text(content)
    (tmp_path / "hardware.yaml").write_text("of another robot\n")
    assert commission(tmp_path, "latency") == 2
    assert "exists" in capsys.readouterr().err
    assert commission(tmp_path, "latency", "--force") == 0
    assert "commission.json: damaged, or does not say of which robot" in capsys.readouterr().out
    assert set(results_of(tmp_path)) == {"latency"}


def test_two_hardware_files_of_one_name_are_two_robots(tmp_path, capsys):
    def code(file, tests):
        return commission(tmp_path / "out", tests, "--force", "--hardware", str(tmp_path / file / "my_robot.yaml"))

    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / "my_robot.yaml").write_text(NOMINAL_TEXT)
    assert code("a", "latency") == 0
    assert code("b", "silent_servo") == 2
    assert "choose another --out" in capsys.readouterr().err
    assert code("b/../a", "silent_servo") == 0
    assert code("b", "latency silent_servo") == 0  # nothing is left of a


def test_the_later_of_two_values_stays_and_only_the_copy_gets_those_of_an_earlier_session(beside, tmp_path):
    def at(date, value):
        return {"value": value, "unit": "A", "date": date}

    mine, out = tmp_path / "mine.yaml", tmp_path / "out"
    mine.write_text(NOMINAL_TEXT)
    options = {"hardware": str(mine), "out": out, "yes": True, "force": True}
    assert run(CommissionOptions(tests=("silent_servo",), **options)) == 0
    own = {"wheel_lf": at("2026-11-20", 1.5), "wheel_rf": at("2026-11-01", 1.6)}
    earlier = {"wheel_lf": at("2026-11-01", 1.1), "wheel_rf": at("2026-11-20", 1.2), "wheel_lr": at("2026-11-20", 1.3)}
    mine.write_text(NOMINAL_TEXT + yaml.safe_dump({"measured": {"stall_current": own}}))
    (out / "hardware.yaml").write_text(NOMINAL_TEXT + yaml.safe_dump({"measured": {"stall_current": earlier}}))
    assert run(CommissionOptions(tests=("latency",), **options)) == 0

    def currents(file):
        return {wheel: found.value for wheel, found in load_hardware(file).measured.stall_current.items()}

    assert currents(mine) == {"wheel_lf": 1.5, "wheel_rf": 1.6}
    assert currents(out / "hardware.yaml") == {"wheel_lf": 1.5, "wheel_rf": 1.2, "wheel_lr": 1.3}
    assert set(load_hardware(mine).measured.adapter_latency) == set(NOMINAL.buses)


def test_a_copy_of_the_hardware_file_still_finds_its_robot(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/robot.yaml").write_text("base: emanual\nname: mine\n")
    file = tmp_path / "mine/hardware.yaml"
    file.write_text(re.sub(r"(?m)^robot: \w+", "robot: robot.yaml", NOMINAL_TEXT))
    assert commission(tmp_path / "out", "latency", "--hardware", str(file)) == 0
    assert load_robot(load_hardware(tmp_path / "out/hardware.yaml").robot or "").name == "mine"


@pytest.mark.parametrize("action", ["brake", "release"])
def test_a_joint_that_is_not_there_cannot_be_held(emulated, action):
    with pytest.raises(InputError, match="unknown joint 'wheel_fl'"):
        getattr(emulated, action)("wheel_fl")
