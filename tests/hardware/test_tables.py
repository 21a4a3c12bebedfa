"""The control tables against the SDK's own model files, and their own rules."""

import importlib.util
from itertools import pairwise
from pathlib import Path

import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.dynamixel.tables import TABLE_SIZE, load_table
from wlr_gym.physics.servo import REGISTER_UNITS

MODELS = {"XM540-W150-R": "xm540_w150", "XL430-W250-T": "xl430_w250"}
#: Names that differ between the SDK's model files and the e-manual's tables.
RENAMED = {
    "secondary(shadow) id": "secondary_id",
    "indirect address write": "indirect_address_1",
    "indirect data write": "indirect_data_1",
    "indirect address read": "indirect_address_29",
    "indirect data read": "indirect_data_29",
}


def sdk_rows(stem):
    """(address, size, name) as the SDK's model file has them."""
    spec = importlib.util.find_spec("dynamixel_easy_sdk")
    if spec is None or spec.origin is None:
        pytest.skip("dynamixel-sdk is not installed")
    text = (Path(spec.origin).parent / "control_table" / f"{stem}.model").read_text(encoding="utf-8")
    rows = text.partition("[control table]")[2].splitlines()[2:]
    for address, size, name in (row.split("\t") for row in rows if row.strip()):
        lowered = name.strip().lower()
        yield int(address), int(size), RENAMED.get(lowered, lowered.replace(" ", "_"))


@pytest.mark.parametrize("model", MODELS)
def test_addresses_and_sizes_are_those_of_the_sdk(model):
    table = load_table(model)
    rows = list(sdk_rows(MODELS[model]))
    assert len(rows) >= 55
    for address, size, name in rows:
        assert (table[name].address, table[name].size) == (address, size), name
    known = {name for *_, name in rows} | {"startup_configuration", "backup_ready"}  # newer than the model files
    assert {name for name in table.items if not name.startswith("indirect")} <= known


@pytest.mark.parametrize("model", MODELS)
def test_items_do_not_overlap_and_bounds_name_items(model):
    table = load_table(model)
    items = list(table.items.values())
    for before, after in pairwise(items):
        assert before.address + before.size <= after.address, (before, after)
    assert items[-1].address + items[-1].size == TABLE_SIZE
    for item in items:
        for bound in (item.default, item.low, item.high):
            assert not isinstance(bound, str) or bound.lstrip("-") in table.items
        assert item.quantity in {*REGISTER_UNITS[model], None, "degC", "ms", "2us"}, item
        if isinstance(item.default, int):
            assert item.decode(item.encode(item.default)) == item.default
        if item.writable and item.name != "operating_mode":
            assert item.low is not None
            assert item.high is not None
    assert sum(name.startswith("indirect_address") for name in table.items) == 56


@pytest.mark.parametrize("model", MODELS)
def test_gain_defaults_give_the_nominal_robots_gains(model):
    """Two sources of the same numbers: the control table's defaults and the robot file."""
    from wlr_gym.robot import load_robot

    table, servo = load_table(model), load_robot().servo
    if model == "XM540-W150-R":
        wanted = {"position_p_gain": servo.leg.kp}
    else:
        wanted = {"velocity_i_gain": servo.wheel.kp, "velocity_p_gain": servo.wheel.kd}
    for name, gain in wanted.items():
        default = table[name].default
        assert isinstance(default, int)
        assert default * table.per_count(name) == pytest.approx(gain, rel=1e-3)


def test_unknown_names_are_told_the_nearest():
    with pytest.raises(InputError, match="did you mean 'goal_position'"):
        load_table("XM540-W150-R")["goal_postion"]
    with pytest.raises(InputError, match="did you mean 'XL430-W250-T'"):
        load_table("XL430-W250")
    with pytest.raises(InputError, match="has no SI unit"):
        load_table("XL430-W250-T").per_count("led")


def test_counts_that_do_not_fit_are_refused():
    table = load_table("XM540-W150-R")
    assert table["goal_position"].encode(-1) == b"\xff\xff\xff\xff"
    assert table["goal_position"].decode(b"\xff\xff\xff\xff") == -1
    assert table.block("realtime_tick", "present_position") == (120, 16)
    with pytest.raises(InputError, match="goal_pwm = 40000"):
        table["goal_pwm"].encode(40000)
