"""The pages on the robot say what the code does: faults, commissioning, the power switch."""

import re
from dataclasses import fields
from pathlib import Path

import pytest

from wlr_gym.cli import commission
from wlr_gym.hardware.commissioning.stand_tests import TESTS
from wlr_gym.hardware.emulator import FAULTS

ROOT = Path(__file__).resolve().parents[2]
ROBOT, EMULATOR = ((ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8") for name in ("robot", "emulator"))
COMMISSIONING = ROBOT.partition("## Commission")[2]


def test_every_fault_is_listed():
    part = EMULATOR.split("## Faults", 1)[1].split("\n#", 1)[0]
    named = [kind for line in part.splitlines() if line.startswith(("- ", "  ")) for kind in re.findall(r"`(\w+)`", line)]
    assert sorted(named) == sorted(FAULTS)


def test_every_defect_that_is_guarded_is_tested():
    guarded = (ROOT / "wlr_gym/hardware/dynamixel/port.py").read_text(encoding="utf-8")
    tested = (ROOT / "tests/hardware/test_bus.py").read_text(encoding="utf-8")
    numbers = set(re.findall(r"Defect (\d)", guarded))
    assert numbers == set("1234567")
    assert numbers == set(re.findall(r"def test_defect_(\d)_", tested))


def test_every_commissioning_test_and_option_is_listed():
    part = ROBOT.split("## Commission\n", 1)[1].split("\n#", 1)[0]
    rows = [line for line in part.splitlines() if line.startswith("|")][2:]
    assert [row.split("|")[1].strip(" `") for row in rows] == list(TESTS)
    options = {name.replace("-", "_") for name in re.findall(r"`--([\w-]+)", COMMISSIONING)}
    assert options
    assert options <= {field.name for field in fields(commission.CommissionOptions)}


def test_what_the_software_sees_of_the_power_switch():
    pytest.importorskip("dynamixel_sdk")
    from robot_rig import Rig, StoppedError

    page = " ".join(ROBOT.split())
    for fault, words in (
        ("dead legs wheels", "ends after 2.6 s with `{}` and `CUT THE POWER`"),
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
        assert rig.machine.time - start == pytest.approx(2.6 if demand else 0.4, abs=0.05)
        rig.loop.close()
