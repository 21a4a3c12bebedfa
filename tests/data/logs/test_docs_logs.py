"""docs/own_logs.md: its map is a map, its units and topics are those of the code."""

import re
from pathlib import Path

import yaml

from wlr_gym.base.settings import parse_config
from wlr_gym.data.logs.map import CURRENTS, FACTORS, LogMap, decided, open_places, resolve
from wlr_gym.data.logs.messages import (
    CAMERA_TOPIC,
    DESCRIPTION,
    IMU,
    JOINT_COMMANDS,
    JOINT_STATES,
    POSE,
    RUN,
    SLIP,
    SUPPLY,
    TRANSFORMS,
)
from wlr_gym.robot import JOINTS, load_robot

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "own_logs.md").read_text(encoding="utf-8")


def test_its_map_is_a_map():
    (text,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.S)
    data = yaml.safe_load(text)
    data["joints"] |= {joint: joint for joint in JOINTS if joint not in data["joints"]}
    assert open_places(data) == ["meta.profile"]  # numbers of an example would be copied unread
    found = resolve(parse_config(LogMap, decided(data), "docs"), load_robot(), "docs")
    assert found["pos_leg_lf"].field == "position[FL_hip]"
    assert (found["pos_leg_lf"].sign, found["pos_leg_lf"].zero) == (-1, 1.5708)
    assert (found["gyro_x"].field, found["gyro_x"].sign) == ("angular_velocity.y", -1)
    assert found["eff_wheel_lf"].unit == "mA"


def test_its_units_are_those_of_the_code():
    (line,) = re.findall(r"^Units: .*?(?=\n\n)", PAGE, re.M | re.S)
    groups = [re.findall(r"`([^`]+)`", part) for part in line.split(";")]
    expected = [[*factors, *(CURRENTS if unit == "N m" else ())] for unit, factors in FACTORS.items()]
    assert [*groups[:-1], groups[-1][:2]] == expected


def test_its_topics_are_those_of_the_code():
    table = PAGE[PAGE.index("| topic | type |") : PAGE.index("### While the robot runs")]
    named = set(re.findall(r"`(/[\w/]+)`", table))
    assert named == {RUN, JOINT_STATES, JOINT_COMMANDS, IMU, SUPPLY, CAMERA_TOPIC, POSE, TRANSFORMS, SLIP, DESCRIPTION}
