"""Robot files: the shipped ones are right, and every broken one is refused with a message that helps."""

import math
import re
from pathlib import Path

import pytest
import yaml

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import data_directory
from wlr_gym.base.settings import merge_changes, overlay, read_yaml
from wlr_gym.robot import JOINTS, Robot, load_robot, physical_faults, standing_height

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
    own = {("ground", "normal_damping"), ("servo", "leg", "gear_stiffness"), ("servo", "wheel", "gear_stiffness")}
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


def test_a_robot_object_passes_through():
    robot = load_robot()
    assert load_robot(robot) is robot


def test_robots_are_frozen():
    with pytest.raises(ValueError, match="frozen"):
        load_robot().body.mass = 3.0  # type: ignore[misc]


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


def test_broken_yaml_names_line_and_column(tmp_path):
    path = tmp_path / "broken.yaml"
    path.write_text("name: x\nbody: {mass: 1\nleg: [\n")
    with pytest.raises(InputError, match=r"broken.yaml, line [34], column \d+: broken YAML"):
        load_robot(path)


def test_a_key_given_twice_is_refused_and_named(tmp_path):
    path = tmp_path / "twice.yaml"
    path.write_text("effects:\n- parameters:\n    mass: 0.5\n    mass: 0.7\n")
    with pytest.raises(
        InputError, match=r"twice\.yaml, line 4, column 5: broken YAML: key 'mass' occurs twice, first in line 3"
    ):
        read_yaml(path)


def test_merged_keys_are_not_given_twice(tmp_path):
    path = tmp_path / "merged.yaml"
    path.write_text("a: &a {x: 1, y: 2}\nb: &b {<<: *a, x: 3}\nc: {<<: *b, y: 4}\n")
    assert read_yaml(path) == {"a": {"x": 1, "y": 2}, "b": {"x": 3, "y": 2}, "c": {"x": 3, "y": 4}}


def test_a_key_that_is_a_list_is_refused(tmp_path):
    path = tmp_path / "list_key.yaml"
    path.write_text("? [a, b]\n: 1\n")
    with pytest.raises(InputError, match=r"list_key\.yaml, line 1"):
        read_yaml(path)


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


def test_a_file_that_is_no_text_is_refused(tmp_path):
    path = tmp_path / "binary.yaml"
    path.write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(InputError, match=r"binary.yaml: is no text file"):
        load_robot(path)


def test_missing_files_and_names():
    with pytest.raises(InputError, match=r"no file 'nowhere/robot.yaml'"):
        load_robot("nowhere/robot.yaml")
    with pytest.raises(
        InputError, match=r"unknown robot config 'nomnal' \(did you mean 'nominal'\?\); valid: emanual, flow, nominal, paper"
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


def test_a_robot_with_a_base_has_a_name_of_its_own(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text("base: nominal\nbody: {mass: 3.5}\n")
    with pytest.raises(InputError, match="'name' is missing"):
        load_robot(path)


def test_a_fault_in_a_base_is_said_with_its_name(tmp_path):
    (tmp_path / "base.yaml").write_text("base: nominal\nname: base\nbody: {mas: 3.5}\n")
    path = tmp_path / "robot.yaml"
    path.write_text("base: base.yaml\nname: robot\n")
    with pytest.raises(InputError, match=r"base\.yaml: unknown key 'body\.mas'"):
        load_robot(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [("base: nominl\n", "did you mean 'nominal'"), ("base: 3\n", "base = 3: expected the name"), ("base: {}\n", "base = {}")],
)
def test_a_bad_base_is_named(tmp_path, text, message):
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


def test_a_robot_that_is_its_own_base_is_refused(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text(f"base: {path}\n")
    with pytest.raises(InputError, match="is its own base"):
        load_robot(path)
