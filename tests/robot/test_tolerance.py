"""Tolerances of a robot file: every unit with every dimension, one for all or one each, and what is refused."""

import math

import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.robot import LEGS, WHEELS, load_robot
from wlr_gym.robot.parameter_table import KEYS, UNITS, ParameterTolerance, read_tolerances

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
