"""The pages on the robot say what the code does: faults, options, hardware numbers, commissioning."""

import re
from dataclasses import fields
from pathlib import Path

import pytest

from wlr_gym.cli import commission, emulate
from wlr_gym.hardware.commissioning.stand_tests import TESTS
from wlr_gym.hardware.config import load_hardware
from wlr_gym.hardware.emulator import FAULTS
from wlr_gym.hardware.emulator import servo as health
from wlr_gym.hardware.emulator.servo import BOOT_TIME, FIRMWARE
from wlr_gym.robot import JOINTS, load_robot

ROOT = Path(__file__).resolve().parents[2]
ROBOT, EMULATOR = ((ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8") for name in ("robot", "emulator"))
COMMISSIONING = ROBOT.partition("## Commission")[2]


def table_under(heading, page):
    part = page.split(heading, 1)[1].split("\n#", 1)[0]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in part.splitlines() if line.startswith("|")][2:]


def test_every_fault_is_listed():
    part = EMULATOR.split("## Faults", 1)[1].split("\n#", 1)[0]
    named = [kind for line in part.splitlines() if line.startswith(("- ", "  ")) for kind in re.findall(r"`(\w+)`", line)]
    assert sorted(named) == sorted(FAULTS)


def test_every_option_named_exists():
    part = EMULATOR.split("## Faults", 1)[0]
    options = {field.name for field in fields(emulate.EmulateOptions)}
    named = {name.replace("-", "_") for name in re.findall(r"`--([\w-]+)", part)}
    assert named
    assert named <= options


def test_every_defect_that_is_guarded_is_tested():
    guarded = (ROOT / "wlr_gym/hardware/dynamixel/port.py").read_text(encoding="utf-8")
    tested = (ROOT / "tests/hardware/test_bus.py").read_text(encoding="utf-8")
    numbers = set(re.findall(r"Defect (\d)", guarded))
    assert numbers == set("1234567")
    assert numbers == set(re.findall(r"def test_defect_(\d)_", tested))


def test_ports_and_ids_are_those_of_the_files():
    ids = load_robot().dynamixel_ids
    rows = {row[0].strip("`"): row[1] for row in table_under("## Two buses, three ports", ROBOT)}
    for name, bus in load_hardware().buses.items():
        assert bus.model in rows[name]
        assert [int(number) for number in re.findall(r"\b\d\b", rows[name].partition("ids")[2])] == [ids[j] for j in bus.joints]
    assert len(JOINTS) == 8


def test_chosen_numbers():
    page = " ".join(EMULATOR.split())

    assert f"firmware {FIRMWARE} on" in page
    assert f"{BOOT_TIME:g} s of silence" in page
    assert f"above {health.LARGEST_LOAD:.0%} of stall for {health.OVERLOAD_TIME:g} s".replace("80%", "80 %") in page
    heating = f"{health.AMBIENT:g} degC, {health.HEATING:g} degC above that in a lasting stall"
    assert f"{heating}, time constant {health.THERMAL_TIME:g} s" in page


def test_every_commissioning_test_and_option_is_listed():
    assert [row[0].strip("`") for row in table_under("## Commission\n", ROBOT)] == list(TESTS)
    options = {name.replace("-", "_") for name in re.findall(r"`--([\w-]+)", COMMISSIONING)}
    assert options
    assert options <= {field.name for field in fields(commission.CommissionOptions)}


def test_what_the_software_sees_of_the_power_switch():
    pytest.importorskip("dynamixel_sdk")
    from robot_rig import Rig, StoppedError

    page = " ".join(ROBOT.split())
    for fault, words in (
        ("dead legs wheels", "ends after 2.5 s with `{}` and `CUT THE POWER`"),
        ("brownout legs wheels", "ends it after 0.4 s with `{}`"),
    ):
        rig = Rig()
        rig.start(0.5)
        start = rig.machine.time
        rig.inject(fault)
        with pytest.raises(StoppedError) as stopped:
            rig.drive(3.0)
        reason, _, demand = str(stopped.value).partition("; ")
        assert words.format(reason.partition(":")[0]) in page
        assert demand.startswith("CUT THE POWER") == fault.startswith("dead")
        assert rig.machine.time - start == pytest.approx(2.5 if demand else 0.4, abs=0.05)
        rig.loop.close()
