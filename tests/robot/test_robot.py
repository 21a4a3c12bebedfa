"""The robot: its file, fingerprints, tolerances and parameters."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from pydantic import Field

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import data_directory, find_config
from wlr_gym.base.settings import SettingsModel, merge_changes, overlay, read_yaml
from wlr_gym.robot import JOINTS, LEGS, WHEELS, Robot, load_robot, physical_faults, robot_hash, servo_hash, standing_height
from wlr_gym.robot.description import Motor, Servo
from wlr_gym.robot.parameter_table import ELEMENTS, KEYS, SPECS, TABLE, UNITS, ParameterTolerance, read_tolerances, spec_of
from wlr_gym.robot.parameters import Parameters

NOMINAL = data_directory("configs") / "robot" / "nominal.yaml"
SHARED = Path(__file__).resolve().parents[3] / "shared" / "robot.yaml"


@pytest.fixture
def edited(tmp_path):
    """Write a copy of the nominal file with one change, as path -> new value (None removes it)."""

    def write(**changes):
        data = yaml.safe_load(NOMINAL.read_text())
        for path, value in changes.items():
            *parents, last = path.split("__")
            place = data
            for parent in parents:
                place = place[parent]
            if value is None:
                del place[last]
            else:
                place[last] = value
        path = tmp_path / "robot.yaml"
        path.write_text(yaml.safe_dump(data))
        return path

    return write


def test_nominal_robot():
    robot = load_robot()
    assert load_robot(robot) is robot
    with pytest.raises(ValueError, match="frozen"):
        robot.body.mass = 3.0  # type: ignore[misc]
    assert robot.name == "wlr-nominal"
    assert robot.joints == JOINTS
    assert robot.total_mass == pytest.approx(3.0)
    assert robot.home.leg_angle == math.pi / 2
    assert standing_height(robot, math.pi / 2) == pytest.approx(0.135 + 0.034)
    assert sorted(robot.dynamixel_ids.values()) == list(range(1, 9))
    assert set(robot.dynamixel_ids) == set(JOINTS)


def leaves(tree, path=()):
    if isinstance(tree, dict):
        return {key: value for name, branch in tree.items() for key, value in leaves(branch, (*path, name)).items()}
    return {path: tree}


@pytest.mark.skipif(not SHARED.is_file(), reason="the shared robot file is not beside the repository")
def test_nominal_robot_equals_the_shared_file():
    shared, shipped = leaves(read_yaml(SHARED)), leaves(read_yaml(NOMINAL))
    assert {key: shipped.get(key) for key in shared} == shared
    tread = {("ground", name) for name in ("slip_compliance", "relaxation_length", "tread_damping")}
    own = tread | {("ground", "normal_damping"), ("servo", "leg", "gear_stiffness"), ("servo", "wheel", "gear_stiffness")}
    assert set(shipped) - set(shared) == own


def test_paper_robot_loads_as_printed_and_is_refused_with_reasons():
    printed = load_robot("paper", check=False)
    assert printed.body.inertia == (None, 2e-5, 3e-5)
    with pytest.raises(InputError) as caught:
        load_robot("paper")
    message = str(caught.value)
    assert "robot 'wlr-paper-table-1' cannot be simulated" in message
    for reason in ("body.inertia y = 2e-05", "body.inertia z = 3e-05", "leg.mass is missing", "wheel.mass is missing"):
        assert reason in message
    factor = float(re.findall(r"(\d+) times more", message)[0])
    assert 1000 < factor < 2000


def test_an_edited_file_loads_from_its_path(edited):
    assert load_robot(edited(body__mass=4.0)).body.mass == 4.0
    assert load_robot(str(edited(wheel__radius=0.05))).wheel.radius == 0.05


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"body__mas": 1.0}, r"robot.yaml: unknown key 'body.mas' \(did you mean 'mass'\?\); valid: mass, size"),
        ({"wheell": {}}, r"unknown key 'wheell' \(did you mean 'wheel'\?\)"),
        ({"servo__leg__kpp": 1.0}, r"unknown key 'servo.leg.kpp' \(did you mean 'kp'\?\); valid: stall_torque"),
        ({"body__mass": "heavy"}, r"robot.yaml: body.mass = 'heavy': expected a number$"),
        ({"body__mass": -1.0}, r"body.mass = -1.0: expected more than 0"),
        ({"body__mass": math.nan}, "body.mass = nan"),
        ({"gravity": math.inf}, "gravity = inf"),
        ({"ground__slip_compliance": -0.1}, "ground.slip_compliance = -0.1: expected 0 or more"),
        ({"ground__relaxation_length": 5.0}, "ground.relaxation_length = 5.0: expected 0.1 or less"),
        ({"ground__slip_complience": 0.1}, r"unknown key 'ground.slip_complience' \(did you mean 'slip_compliance'\?\)"),
        ({"body__size": [0.3, 0.2]}, "body.size.2' is missing"),
        ({"body": 3.0}, "body = 3.0: expected keys and values; keys: mass, size, inertia, com_offset$"),
        ({"leg__length": None}, "robot.yaml: 'leg.length' is missing"),
        ({"servo__wheel": None}, "'servo.wheel' is missing"),
        ({"joints": list(reversed(JOINTS))}, "joints must be"),
        ({"body__inertia": [0.02, 0.03, 0.08]}, "body.inertia .*triangle inequality"),
        ({"leg__inertia": [1e-4, 1e-5, 1e-5]}, "leg.inertia .*triangle inequality"),
        ({"leg_limits": [2.79, 0.35]}, "leg_limits = .*lower limit must be below"),
        ({"home__leg_angle": 0.1}, "home.leg_angle = 0.1 rad is outside leg_limits"),
        ({"dynamixel_ids__leg_lf": None}, "dynamixel_ids = .*expected one id of its own for each of leg_lf"),
        ({"dynamixel_ids__leg_lf": 3}, "dynamixel_ids = .*expected one id of its own"),
        ({"dynamixel_ids__leg_lf": 253}, "dynamixel_ids = .*0 to 252"),
    ],
)
def test_bad_files_are_refused_by_name(edited, changes, message):
    with pytest.raises(InputError, match=message):
        load_robot(edited(**changes))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"name: x\nbody: {mass: 1\nleg: [\n", r"bad\.yaml, line [34], column \d+: broken YAML"),
        (
            b"effects:\n- parameters:\n    mass: 0.5\n    mass: 0.7\n",
            r"bad\.yaml, line 4, column 5: broken YAML: key 'mass' occurs twice, first in line 3",
        ),
        (b"? [a, b]\n: 1\n", r"bad\.yaml, line 1"),
        (b"\xff\xfe\x00\x81", r"bad\.yaml: is no text file"),
    ],
    ids=["broken", "twice", "list", "binary"],
)
def test_a_file_that_is_no_yaml_is_refused_with_its_place(tmp_path, content, message):
    path = tmp_path / "bad.yaml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        load_robot(path)


def test_merged_keys_are_not_given_twice(tmp_path):
    path = tmp_path / "merged.yaml"
    path.write_text("a: &a {x: 1, y: 2}\nb: &b {<<: *a, x: 3}\nc: {<<: *b, y: 4}\n")
    assert read_yaml(path) == {"a": {"x": 1, "y": 2}, "b": {"x": 3, "y": 2}, "c": {"x": 3, "y": 4}}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the file is empty; expected the keys name, gravity"),
        ("- 1\n- 2\n", r"\[1, 2\]: expected keys and values; keys: name, gravity"),
        ("just text\n", "'just text': expected keys and values; keys: name, gravity"),
    ],
)
def test_a_file_without_keys_is_refused(tmp_path, text, words):
    path = tmp_path / "list.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=f"list.yaml: {words}"):
        load_robot(path)


def test_missing_files_and_names():
    with pytest.raises(InputError, match=r"no file 'nowhere/robot.yaml'"):
        load_robot("nowhere/robot.yaml")
    with pytest.raises(
        InputError,
        match=r"unknown robot config 'nomnal' \(did you mean 'nominal'\?\); valid: emanual, flow, kit, nominal, paper",
    ):
        load_robot("nomnal")


def test_numbers_in_exponent_form_are_numbers(tmp_path):
    path = tmp_path / "numbers.yaml"
    path.write_text("[1e-3, 2.5e-4, -1E6, 12, +3e+2, 1e, e3]\n")
    assert read_yaml(path) == [1e-3, 2.5e-4, -1e6, 12, 300.0, "1e", "e3"]


def test_a_uniform_box_is_possible_and_a_thousandth_of_it_is_not():
    robot = load_robot()
    assert physical_faults(robot) == []
    shrunk = robot.model_copy(update={"body": robot.body.model_copy(update={"inertia": (2e-5, 3e-5, 5e-5)})})
    faults = physical_faults(shrunk)
    assert len(faults) == 3
    assert all("impossible" in fault for fault in faults)
    assert isinstance(shrunk, Robot)


def test_a_robot_file_is_laid_over_its_base(tmp_path):
    path = tmp_path / "heavy.yaml"
    path.write_text("base: nominal\nname: heavy\nbody: {mass: 3.5}\n")
    heavy, nominal = load_robot(path), load_robot()
    assert (heavy.name, heavy.body.mass, heavy.body.size) == ("heavy", 3.5, nominal.body.size)
    further = tmp_path / "further.yaml"
    further.write_text("base: heavy.yaml\nname: further\nwheel: {radius: 0.04}\n")  # beside it, not in the present folder
    assert (load_robot(further).body.mass, load_robot(further).wheel.radius) == (3.5, 0.04)


def test_the_content_of_a_robot_file_is_the_robot_of_the_file():
    content = {"base": "nominal", "name": "x", "servo": {"leg": {"stall_torque": 4.1}}}
    assert load_robot(content).servo.leg.stall_torque == 4.1
    assert load_robot(content).body == load_robot().body
    with pytest.raises(InputError, match=re.escape("robot: unknown key 'body.mas' (did you mean 'mass'?)")):
        load_robot({"base": "nominal", "name": "x", "body": {"mas": 3.0}})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("base: nominl", "did you mean 'nominal'"),
        ("base: 3", "base = 3: expected the name"),
        ("base: {}", "base = {}"),
        ("base: nominal\nbody: {mass: 3.5}", "'name' is missing"),  # it has one of its own
        ("base: base.yaml\nname: robot", "base.yaml: unknown key 'body.mas'"),
        ("base: robot.yaml", "is its own base"),
    ],
)
def test_a_bad_base_is_named(tmp_path, text, message):
    (tmp_path / "base.yaml").write_text("base: nominal\nname: base\nbody: {mas: 3.5}\n")
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(message)):
        load_robot(path)


def test_merged_changes_say_what_both_say_one_after_the_other():
    first, second = {"a": {"b": None, "c": 1}, "d": 1}, {"a": {"c": None, "e": 2}, "d": None}
    merged = merge_changes(first, second)
    assert merged == {"a": {"b": None, "c": None, "e": 2}, "d": None}
    base = {"a": {"b": 0, "c": 0, "f": 0}, "d": 0}
    assert overlay(base, merged) == overlay(overlay(base, first), second)


# ---- fingerprints of a robot: they follow the numbers that a simulator reads, and nothing else -----------------------


ROBOT = load_robot()


class FlowSensor(SettingsModel):
    noise: float = 0.01


class LaterMotor(Motor):
    resistance: float | None = None


class LaterServo(Servo):
    leg: LaterMotor  # pyright: ignore[reportIncompatibleVariableOverride]
    fuse: float = Field(default=10.0, gt=0)


class LaterRobot(Robot):
    """A robot of a later version: with fields that today's files do not have."""

    servo: LaterServo  # pyright: ignore[reportIncompatibleVariableOverride]
    flow: FlowSensor = Field(default_factory=FlowSensor)
    toe: tuple[float, float] = (0.0, 0.0)


def later(**changes):
    """The nominal file, read by the later version; ``changes``: dotted path (``__``) -> value."""
    data = yaml.safe_load(find_config("robot", "nominal").read_text())
    for path, value in changes.items():
        *parents, last = path.split("__")
        place = data
        for parent in parents:
            place = place.setdefault(parent, {})
        place[last] = value
    return LaterRobot.model_validate(data)


def test_the_nominal_robots_are_known():
    """They change when a number does, or the canonical form (then HASH_FORM has to)."""
    assert robot_hash(ROBOT) == "2-1bad2a980ac2fdec"
    assert servo_hash(ROBOT) == "2-8e2765725d7f700f"


@pytest.mark.parametrize(
    ("changes", "same_robot", "same_servo"),
    [
        ({}, True, True),  # a later version's new fields, with their defaults
        ({"toe": [0.0, 0.0], "servo__fuse": 10.0, "flow__noise": 0.01}, True, True),
        ({"toe": [0.0, 0.1]}, False, True),  # and with other values
        ({"flow__noise": 0.02}, False, True),
        ({"servo__fuse": 9.0}, False, False),
        ({"servo__leg__resistance": 1.0}, False, False),
        ({"tolerances": {}}, True, True),  # what no simulator reads
        ({"tolerances": {"body.mass": "3 g"}}, True, True),
        ({"name": "other"}, True, True),
        ({"dynamixel_ids__leg_lf": 42}, True, True),
        ({"gravity": 9.81}, True, True),
        ({"servo__supply_voltage": 12}, True, True),  # whole numbers are the same numbers
        ({"body__mass": 2.8000000000000003}, False, True),  # every number of a simulator
        ({"body__com_offset": [0.0, 0.0, 1e-9]}, False, True),
        ({"ground__slope": 0.01}, False, True),
        ({"ground__slip_compliance": 0.05}, False, True),
        ({"ground__slip_compliance": 0.0, "ground__relaxation_length": 0.005, "ground__tread_damping": 5.0}, True, True),
        ({"hip_position__z": 0.001}, False, True),
        ({"leg_limits": [0.35, 2.8]}, False, True),
        ({"home__leg_angle": 1.5}, False, True),
        ({"sensors__imu__gyro_noise": 0.001}, False, True),
        ({"sensors__control_rate": 100.0}, False, True),
        ({"servo__integral_cycle": 2e-3}, False, False),
        ({"servo__integral_cycle": 1e-3}, True, True),
    ],
)
def test_fingerprints_follow_what_a_simulator_reads(changes, same_robot, same_servo):
    robot = later(**changes)
    assert (robot_hash(robot) == robot_hash(ROBOT)) == same_robot
    assert (servo_hash(robot) == servo_hash(ROBOT)) == same_servo


def test_currents_of_the_motors_do_not_matter():
    """No motion depends on them: a policy from ``nominal`` drives a robot with ``emanual``."""
    emanual = load_robot("emanual")
    assert emanual.servo.leg.stall_current != ROBOT.servo.leg.stall_current
    assert (robot_hash(emanual), servo_hash(emanual)) == (robot_hash(ROBOT), servo_hash(ROBOT))


# ---- tolerances of a robot file: every unit with every dimension, one for all or one each, and what is refused -------


UNIT = {key: rows[0].unit for key, rows in KEYS.items()}
#: Unit -> the units of the parameter table that it may state, and its size in them.
EXPECTED = {
    "m": {"m": 1.0},
    "cm": {"m": 1e-2},
    "mm": {"m": 1e-3},
    "s": {"s": 1.0},
    "ms": {"s": 1e-3},
    "rad": {"rad": 1.0},
    "mrad": {"rad": 1e-3},
    "deg": {"rad": math.pi / 180},
    "kg": {"kg": 1.0},
    "g": {"kg": 1e-3},
    "N": {},
    "mN": {},
    "V": {"V": 1.0},
    "mV": {"V": 1e-3},
    "-": {"-": 1.0},
    "N m": {"N m": 1.0},
    "mN m": {"N m": 1e-3},
    "N mm": {"N m": 1e-3},
    "N m s/rad": {"N m s/rad": 1.0},
    "mN m s/rad": {"N m s/rad": 1e-3},
    "N m ms/deg": {"N m s/rad": 1e-3 * 180 / math.pi},
    "kg m2": {"kg m2": 1.0},
    "g cm2": {"kg m2": 1e-7},
    "rad/s": {"rad/s": 1.0},
    "deg/s": {"rad/s": math.pi / 180},
    "V/rad": {"V/rad": 1.0},
    "mV/deg": {"V/rad": 1e-3 * 180 / math.pi},
}


def one(key, value):
    return read_tolerances({key: value})[key]


def test_the_list_of_units_is_whole():
    assert set(UNITS) <= EXPECTED.keys()
    assert set(UNIT.values()) <= EXPECTED.keys()
    assert all(row.unit == rows[0].unit for rows in KEYS.values() for row in rows)


@pytest.mark.parametrize("unit", EXPECTED)
def test_every_unit_with_every_dimension(unit):
    for key in KEYS:
        size = EXPECTED[unit].get(UNIT[key])
        if size is None:
            with pytest.raises(InputError, match=rf"^tolerances\.{key} = '3 {unit}': '{unit}' is not a unit of {key}"):
                one(key, f"3 {unit}")
            continue
        found = one(key, f"3 {unit}")
        assert found.unit == UNIT[key]
        assert found.legs == found.wheels == pytest.approx(3 * size, rel=1e-12)


@pytest.mark.parametrize("value", [0.05, "0.05", "5 %", "5%", "5e-2", " .05 "])
def test_relative(value):
    assert {one(key, value) for key in KEYS} == {ParameterTolerance(0.05, 0.05, None)}


@pytest.mark.parametrize("key", ["servo.viscous_friction", "servo.coulomb_friction"])
def test_one_each_for_legs_and_wheels(key):
    found = one(key, f"2 {UNIT[key]} (wheels), 10 m{UNIT[key]} (legs)")
    assert (found.legs, found.wheels) == (0.01, 2.0)
    assert {found.of(f"{key}[{joint}]") for joint in LEGS} == {0.01}
    assert {found.sigma(f"{key}[{joint}]", 7.0) for joint in WHEELS} == {2.0}
    both = one(key, "5 % (legs), 0.1 (wheels)")
    assert (both.legs, both.wheels, both.unit) == (0.05, 0.1, None)
    assert both.sigma(f"{key}[leg_lf]", -2.0) == 0.1
    assert both.share(f"{key}[leg_lf]", -2.0) == 0.05


def test_text_of_a_tolerance_is_the_tolerance():
    robot = load_robot()
    assert read_tolerances({key: str(tolerance) for key, tolerance in robot.tolerances.items()}) == robot.tolerances
    assert type(robot).model_validate(robot.model_dump()) == robot


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("servo.Kp", "0.05", r"unknown tolerance 'servo\.Kp' \(did you mean 'servo\.kp'\?\)"),
        ("body.mass", "-0.1", r"tolerances\.body\.mass = -0\.1: expected a finite amount of 0 or more"),
        ("body.mass", "-5 g", r"tolerances\.body\.mass = '-5 g': expected a finite amount of 0 or more"),
        ("body.mass", ".nan", r"tolerances\.body\.mass = nan: expected a relative number"),
        ("body.mass", ".inf", r"tolerances\.body\.mass = inf: expected a relative number"),
        ("body.mass", "1e999 kg", r"'1e999 kg': expected a finite amount"),
        ("body.mass", "true", r"tolerances\.body\.mass = True: expected a relative number"),
        ("body.mass", "[0.1]", r"tolerances\.body\.mass = \[0\.1\]: expected a relative number"),
        ("body.mass", "some", r"'some': expected a relative number \(0\.05 or '5 %'\), or one with its unit \(kg, g\)"),
        ("body.mass", "5 %%", "unknown unit '%%'"),
        ("body.mass", "0.1 kg m0", "unknown unit 'm0'"),
        ("body.mass", "''", "expected a relative number"),
        ("command.delay", "5 msec", r"unknown unit 'msec' \(did you mean 'ms'\?\); expected .* \(s, ms\)"),
        ("command.delay", "5 mm", r"'mm' is not a unit of command\.delay; expected .* \(s, ms\)"),
        ("command.delay", "5 s/", "is not a unit|unknown unit"),
        ("servo.coulomb_friction", "0.1 N m (feet)", "expected one amount for all, or one each"),
        ("servo.coulomb_friction", "0.1 N m (wheels)", "expected one amount for all, or one each"),
        ("servo.coulomb_friction", "0.1 N m, 0.2 N m", "expected one amount for all, or one each"),
        ("servo.coulomb_friction", "0.1 N m (legs), 5 % (wheels)", "expected both relative, or both with a unit"),
        ("joint_zero", "1 deg (legs), 2 deg (wheels)", "legs and wheels do not both have a joint_zero"),
        ("command.delay", "5 %", r"tolerances\.command\.delay = '0\.05': is relative to 0"),
    ],
)
def test_refused_with_file_key_value_and_what_is_expected(tmp_path, key, value, message):
    file = tmp_path / "mine.yaml"
    file.write_text(f"base: nominal\nname: mine\ntolerances:\n  {key}: {value}\n")
    with pytest.raises(InputError, match=message) as refused:
        load_robot(file)
    assert str(refused.value).startswith(f"{file}: ")


def test_tolerances_are_a_mapping(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("base: nominal\nname: mine\ntolerances: 5 %\n")
    with pytest.raises(InputError, match=r"mine\.yaml: tolerances = '5 %': expected a mapping"):
        load_robot(file)


# ---- the parameter table: complete, documented, bounded; its views write; its errors name ----------------------------


@pytest.fixture
def parameters():
    return Parameters.nominal(ROBOT, 3)


@pytest.mark.parametrize("spec", TABLE, ids=lambda spec: spec.name)
def test_every_row_is_complete(spec):
    assert spec.doc
    assert spec.unit
    assert spec.low < spec.high
    values = np.ravel(np.asarray(spec.nominal(ROBOT), float))
    assert values.shape == (spec.size,)
    assert np.isfinite(values).all()
    assert (spec.low <= values).all()
    assert (values <= spec.high).all()
    assert len(set(spec.elements)) == spec.size


def test_names_are_unique_and_elements_are_in_table_order():
    assert len(SPECS) == len(TABLE)
    assert len(set(ELEMENTS)) == len(ELEMENTS)
    assert list(ELEMENTS) == [element for spec in TABLE for element in spec.elements]
    assert "wheel.radius[wheel_lf]" in ELEMENTS
    assert "gravity" in ELEMENTS
    assert SPECS["servo.kp"].labels == JOINTS
    assert SPECS["leg.mass"].labels == LEGS
    assert SPECS["ground.mu_x"].labels == WHEELS
    assert spec_of("wheel.radius[wheel_lf]") is SPECS["wheel.radius"]
    assert spec_of("gravity").unit == "m/s2"


def test_every_tolerance_is_one_of_the_robot_files():
    named = {spec.tolerance for spec in TABLE if spec.tolerance}
    assert named == set(load_robot("emanual").tolerances)
    assert named - set(ROBOT.tolerances) == {"servo.integral_cycle"}  # which nobody thought of when nominal was written


def test_nominal_values_come_from_the_robot(parameters):
    assert parameters["body.mass"].tolist() == [2.8] * 3
    assert parameters["servo.kp"].tolist() == [[55.24] * 4 + [8.63] * 4] * 3
    assert parameters["servo.stall_torque[wheel_rr]"].tolist() == [1.5] * 3
    assert parameters["leg.inertia[leg_lr,x]"].tolist() == [1.2e-4] * 3
    assert parameters["command.delay"].shape == (3, 8)
    assert len(parameters) == 3
    assert list(parameters) == [spec.name for spec in TABLE]
    parameters.validate()


def test_views_write_through(parameters):
    parameters["wheel.radius[wheel_rf]"][1] = 0.04
    assert parameters["wheel.radius"][1].tolist() == [0.034, 0.04, 0.034, 0.034]
    parameters["body.mass"][2] = 3.1
    assert parameters.values[2, ELEMENTS.index("body.mass")] == 3.1
    parameters["ground.mu_x"] = [0.1, 0.2, 0.3, 0.4]
    assert parameters["ground.mu_x[wheel_rr]"].tolist() == [0.4] * 3
    parameters.copy()["gravity"] = 0.0
    assert parameters["gravity"].tolist() == [9.81] * 3
    parameters["gravity"] = 1.62
    assert parameters["gravity"].tolist() == [1.62] * 3


@pytest.mark.parametrize("value", [-0.01, 5.01, np.nan, np.inf])
def test_values_out_of_bounds_are_named(parameters, value):
    parameters["ground.mu_y[wheel_lr]"][1] = value
    with pytest.raises(InputError, match=r"ground.mu_y\[wheel_lr\] = .* \(robot 1 of the batch\) is outside \[0, 5\]"):
        parameters.validate()


@pytest.mark.parametrize("spec", TABLE, ids=lambda spec: spec.name)
def test_bounds_are_inclusive_and_enforced(spec):
    for bound, beyond in ((spec.low, -1), (spec.high, 1)):
        parameters = Parameters.nominal(ROBOT)
        parameters[spec.elements[-1]] = bound
        if spec.name != "payload.inertia":  # no masses have a single product of inertia
            parameters.validate()
        parameters[spec.elements[-1]] = np.nextafter(bound, beyond * np.inf)
        with pytest.raises(InputError, match="outside"):
            parameters.validate()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("wheel.radios", r"unknown parameter 'wheel.radios' \(did you mean 'wheel.radius'\?\)"),
        ("wheel.radius[wheel_fl]", r"unknown element of parameter 'wheel.radius' 'wheel_fl'.*valid: wheel_lf, wheel_lr"),
        ("wheel.radius[leg_lf]", "unknown element of parameter 'wheel.radius' 'leg_lf'"),
        ("wheel.radius[wheel_lf", "unknown"),
        ("gravity[x]", r"unknown parameter 'gravity\[x\]' \(did you mean 'gravity'\?\)"),
        ("", "unknown parameter ''"),
    ],
)
def test_unknown_names_are_refused_with_the_nearest(parameters, name, message):
    with pytest.raises(InputError, match=message):
        parameters[name]
    with pytest.raises(InputError, match=message):
        parameters[name] = 1.0
    with pytest.raises(InputError, match=message):
        spec_of(name)


@pytest.mark.parametrize("value", [[1.0, 2.0], np.zeros((3, 5)), "heavy", [[1.0], [2.0, 3.0]]])
def test_values_of_the_wrong_shape_or_kind_are_refused(parameters, value):
    with pytest.raises(InputError, match=r"parameter 'wheel\.radius' takes numbers of shape \(3, 4\)"):
        parameters["wheel.radius"] = value


def test_a_matrix_of_the_wrong_shape_is_refused():
    with pytest.raises(InputError, match=r"parameter matrix has shape \(2, 3\), expected \(N, "):
        Parameters(np.zeros((2, 3)))


@pytest.mark.parametrize("inertia", [(0, 0, 0, 0.1, 0, 0), (-0.02, 0, 0, 0, 0, 0), (0.1, 0.1, 0.3, 0, 0, 0)])
def test_payload_inertia_is_one_that_masses_have(inertia):
    parameters = Parameters.nominal(ROBOT, 2)
    parameters["payload.inertia"][0] = 0.0, 0.01, 0.01, 0.0, 0.0, 0.0  # two point masses on a line
    parameters.validate()
    parameters["payload.inertia"][1] = inertia
    with pytest.raises(InputError, match=r"payload.inertia \(robot 1 of the batch\)"):
        parameters.validate()
