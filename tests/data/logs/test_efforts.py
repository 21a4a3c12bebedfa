"""Efforts of a log are torques, currents or counts: a unit that is wrong or open is refused or said, whoever the robot is."""

import numpy as np
import pytest
from foreign_logs import NAMES, lab_frame, lab_map, made_up, rows_of

from wlr_gym.base.errors import InputError
from wlr_gym.data import read_run
from wlr_gym.data.format import COLUMNS
from wlr_gym.data.logs import import_log, suggest_map
from wlr_gym.data.logs.map import factor
from wlr_gym.physics.servo import current_law
from wlr_gym.robot import JOINTS, load_robot

UNITS = {"A": 1.0, "mA": 1e-3}


def written(tmp_path, unit, name="current", wheels_only=False):
    """Return a table with the efforts as currents, or as torques in a unit, and the torques (rows,) of each joint."""
    table = rows_of(made_up(8.0))
    torques = {joint: 0.03 * np.tanh(table[f"vel_{joint}"]) + 0.003 for joint in JOINTS}
    constants = dict(zip(JOINTS, current_law(load_robot()).torque_constant, strict=True))
    frame = lab_frame(made_up(8.0))
    for joint in JOINTS[4:] if wheels_only else JOINTS:
        size = UNITS[unit] * constants[joint] if unit in UNITS else {"N m": 1.0, "mN m": 1e-3}[unit]
        frame[f"{NAMES[joint].lower()}_{name}"] = torques[joint] / size
    frame.to_csv(tmp_path / "a.csv", index=False)
    return tmp_path / "a.csv", torques


def read_as(log, unit, name="current"):
    """Return the proposed map with another unit of the efforts."""
    known = lab_map(log, eff="N m" if name == "effort" else "A").model_dump()
    efforts = {f"eff_{joint}": f"{NAMES[joint].lower()}_{name}" for joint in JOINTS[4:]}
    known["channels"] |= {key: {"topic": "table", "field": one, "unit": unit} for key, one in efforts.items()}
    return known


@pytest.mark.parametrize("unit", UNITS)
def test_a_current_comes_in_as_a_torque(tmp_path, unit):
    log, torques = written(tmp_path, unit)
    known = lab_map(log, eff=unit)
    (imported,) = import_log(log, tmp_path / "runs", known)
    run = read_run(imported.path)
    for joint in JOINTS:
        assert np.allclose(run[f"eff_{joint}"], torques[joint][: len(run["t"])], rtol=1e-6)
    (note,) = [note for note in imported.notes if note.startswith("efforts")]
    assert note == f"efforts in {unit} become N m by the torque constants of 'wlr-nominal': name your robot (--robot)"
    (named,) = import_log(log, tmp_path / "named", known, robot="nominal")
    assert not [note for note in named.notes if note.startswith("efforts")]


@pytest.mark.parametrize("robot", [None, "nominal"])
@pytest.mark.parametrize(
    ("unit", "name", "read", "message"),
    [
        ("mA", "effort", "N m", r"a.csv: row \d+, column 'eff_wheel_lf': -?\d\S+ N m; expected up to 1.5, the stall torque of"),
        ("mN m", "effort", "N m", "column 'eff_wheel_lf': .*; looks like mA, mN m or counts of a register"),
        ("A", "current", "mA", r"column 'eff_wheel_lf': \S+ N m; expected more than 0.0015, one count of robot 'wlr-nominal'"),
        ("N m", "effort", "mN m", "looks like A or N m .from topic 'table', field 'fl_wheel_effort', read as mN m: check its"),
        ("mA", "current", None, "'eff_wheel_lf': field 'fl_wheel_current' is a current: expected its unit: A, mA or count"),
    ],
)  # fmt: skip
def test_a_unit_that_makes_no_sense_is_refused(tmp_path, robot, unit, name, read, message):
    log, _ = written(tmp_path, unit, name, wheels_only=True)
    with pytest.raises(InputError, match=message):
        import_log(log, tmp_path / "runs", read_as(log, read, name), robot=robot)
    assert not (tmp_path / "runs").exists()


def test_every_channel_has_units_or_says_that_it_has_none():
    robot = load_robot()
    assert all(factor(column, one.unit, robot, "map") == 1.0 for column, one in COLUMNS.items() if one.unit != "-")
    assert factor("cam_age", "ms", robot, "map") == factor("flow_age", "ms", robot, "map") == 1e-3
    with pytest.raises(InputError, match=r"^map: channel 'flow_quality': unit 'ms': expected none"):
        factor("flow_quality", "ms", robot, "map")


def test_a_unit_of_efforts_is_asked_with_their_size(tmp_path):
    log, _ = written(tmp_path, "mA", "effort")
    found = suggest_map(log)
    assert {f"channels.eff_{part}.unit" for part in ("leg", "wheel")} <= set(found.open)
    (said,) = [line.why for line in found.lines if line.place == "channels.eff_wheel"]
    assert "the motor stalls at 1.5 N m" in said
    assert "A, mA and counts become N m by the robot's torque constants" in said
