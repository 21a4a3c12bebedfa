"""Register behaviour: every row of both control tables, and the rules of register_behaviour.yaml."""

from pathlib import Path

import pytest
import yaml

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.dynamixel.protocol import Error
from wlr_gym.hardware.dynamixel.tables import TABLE_SIZE, load_table, shipped_tables
from wlr_gym.hardware.emulator.servo import EmulatedServo

MODELS = tuple(sorted(shipped_tables()))
ROWS = [(model, item.name) for model in MODELS for item in load_table(model).items.values()]
RULES = yaml.safe_load(Path(__file__).with_name("register_behaviour.yaml").read_text(encoding="utf-8"))


def make(model, at=2048):
    servo = EmulatedServo("servo", load_table(model), {})
    servo.shaft.position = at * servo.table.per_count("present_position")
    servo.shaft.reference = lambda: (servo.shaft.position, servo.shaft.velocity)
    servo.boot(0.0)
    return servo


def write(servo, name, count):
    item = servo.table[name]
    return servo.write(item.address, item.encode(count))


def read(servo, name):
    item = servo.table[name]
    error, data = servo.read(item.address, item.size)
    assert error == Error.NONE
    return item.decode(data)


def number(servo, bound):
    if isinstance(bound, str):
        return -servo[bound[1:]] if bound.startswith("-") else servo[bound]
    assert bound is not None
    return bound


# --- every row


@pytest.mark.parametrize(("model", "name"), ROWS)
def test_row(model, name):
    """Default, access, range (both ends and one beyond), length: as the table says."""
    servo = make(model)
    item = servo.table[name]
    if item.default is not None:
        assert read(servo, name) == number(servo, item.default)
    if not item.writable:
        assert servo.write(item.address, bytes(item.size)) == Error.ACCESS
        return
    if item.size > 1:
        assert servo.write(item.address, b"\0") == Error.DATA_LENGTH
    if name == "operating_mode":
        return
    low, high = number(servo, item.low), number(servo, item.high)
    beyond = Error.DATA_LIMIT if isinstance(item.high, str) else Error.DATA_RANGE
    before = read(servo, name)
    for count in (low - 1, high + 1):
        if item.decode((count % 256**item.size).to_bytes(item.size, "little")) == count:
            assert write(servo, name, count) == beyond
            assert read(servo, name) == before
    for count in (high, low):
        assert write(servo, name, count) == Error.NONE
        assert name.startswith("indirect_address") or read(servo, name) == count
    write(servo, name, before)
    if item.in_eeprom and name != "protocol_type":
        servo.set("torque_enable", 1)
        assert write(servo, name, before) == Error.ACCESS


@pytest.mark.parametrize("model", MODELS)
def test_reads_across_gaps_give_zeros_and_end_at_the_table(model):
    servo = make(model)
    assert servo.read(14, 6) == (Error.NONE, bytes(6))
    assert servo.read(TABLE_SIZE - 2, 2)[0] == Error.NONE
    assert servo.read(TABLE_SIZE - 1, 2) == (Error.ACCESS, b"")
    assert servo.read(0, 0) == (Error.ACCESS, b"")
    assert servo.write(14, b"\0") == Error.ACCESS
    assert servo.write(TABLE_SIZE, b"\0") == Error.ACCESS
    assert servo.write(64, b"") == Error.DATA_LENGTH


@pytest.mark.parametrize("model", MODELS)
def test_a_long_read_follows_indirect_addresses_too(model):
    servo = make(model)
    write(servo, "led", 1)
    write(servo, "indirect_address_2", 65)
    _, data = servo.read(0, TABLE_SIZE)
    assert data[225] == 1
    assert data[132:136] == servo.read(132, 4)[1]


@pytest.mark.parametrize("model", MODELS)
def test_a_write_over_several_items_acts_whole_or_not_at_all(model):
    servo = make(model)
    both = servo.table["profile_acceleration"].encode(5) + servo.table["profile_velocity"].encode(80)
    assert servo.write(108, both) == Error.NONE
    assert (servo["profile_acceleration"], servo["profile_velocity"]) == (5, 80)
    bad = servo.table["profile_acceleration"].encode(6) + servo.table["profile_velocity"].encode(40000)
    assert servo.write(108, bad) == Error.DATA_RANGE
    assert servo["profile_acceleration"] == 5


def test_identity():
    assert make("XM540-W150-R")["model_number"] == 1130
    assert make("XL430-W250-T")["model_number"] == 1060
    assert make("XL430-W250-T")["firmware_version"] == 45


def test_time_based_profile_takes_the_time_asked_for():
    servo = make("XM540-W150-R")
    write(servo, "drive_mode", 4)
    write(servo, "profile_velocity", 1000)
    write(servo, "profile_acceleration", 250)
    write(servo, "goal_position", 3072)
    drive = servo.drive()
    way = 1024 * servo.table.per_count("goal_position")
    assert drive.profile_velocity / drive.profile_acceleration == pytest.approx(0.25)
    assert way / drive.profile_velocity + 0.25 == pytest.approx(1.0)


def test_set_goes_past_the_rules_but_not_past_the_table():
    servo = make("XM540-W150-R")
    servo.set("model_number", 7)
    assert servo["model_number"] == 7
    with pytest.raises(InputError, match="did you mean 'led'"):
        servo.set("lead", 1)


# --- rules


def carry_out(servo, step):
    words, _, error = step.partition("->")
    verb, *rest = words.split()
    wanted = Error[error.strip()] if error else Error.NONE
    if verb == "read":
        assert rest[1] == "="
        assert servo[rest[0]] == int(rest[2]), step
    elif verb == "write":
        assert write(servo, rest[0], int(rest[1])) == wanted, step
    elif verb == "clear":
        assert servo.clear(bytes([0x01, 0x44, 0x58, 0x4C, 0x22])) == wanted, step
    elif verb == "alert":
        assert bool(servo.alert) == bool(int(rest[0])), step
    else:
        happen(servo, verb, rest)


def happen(servo, verb, rest):
    shaft, table = servo.shaft, servo.table
    if verb == "wait":
        for _ in range(round(float(rest[0]) / 0.001)):
            servo.advance(0.001)
    elif verb == "at":
        shaft.position = int(rest[0]) * table.per_count("present_position")
    elif verb == "speed":
        shaft.velocity = int(rest[0]) * table.per_count("present_velocity")
    elif verb == "volt":
        shaft.voltage = float(rest[0])
    elif verb == "load":
        shaft.load = float(rest[0])
    elif verb in ("reboot", "hear"):
        getattr(servo, {"reboot": "boot"}.get(verb, verb))()
    else:
        raise AssertionError(f"unknown step {verb}")


@pytest.mark.parametrize(
    ("rule", "model"),
    [pytest.param(rule, model, id=f"{model[:2]} {rule['rule']}") for rule in RULES for model in rule.get("models", MODELS)],
)
def test_rule(rule, model):
    servo = make(model)
    for step in rule["steps"]:
        carry_out(servo, step)
