"""Units that logs use: what one of them is in SI units."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.data.format import COLUMNS
from wlr_gym.physics.servo import current_law, effort_counts
from wlr_gym.robot import JOINTS, LEGS, Robot

_TURN = 2.0 * math.pi
_RPM = _TURN / 60.0
_G = 9.80665

#: SI unit -> unit -> factor. ``count`` is a count of a Dynamixel register of the X series; see :func:`factor`.
FACTORS: dict[str, dict[str, float]] = {
    "rad": {"rad": 1.0, "deg": math.radians(1.0), "turn": _TURN, "count": _TURN / 4096},
    "rad/s": {
        "rad/s": 1.0, "deg/s": math.radians(1.0), "rpm": _RPM, "turn/s": _TURN, "count": 0.229 * _RPM,
    },
    "N m": {"N m": 1.0, "mN m": 1e-3, "N cm": 1e-2},
    "m/s2": {"m/s2": 1.0, "g": _G, "mg": _G * 1e-3},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "s": {"s": 1.0, "ms": 1e-3},
    "V": {"V": 1.0, "mV": 1e-3},
}  # fmt: skip
#: Currents mean a torque by the robot's nominal torque constants; a count is one of Present Current (legs), Load (wheels).
CURRENTS = ("A", "mA", "count")
#: Efforts that are often larger than so many stall torques are in another unit.
_STALLS = 2.0
#: rad; a joint that moved by more shows its friction.
_MOVED = 0.5


def units_of(column: str) -> Iterable[str]:
    """Return the units that a column may be in, in a log."""
    unit = COLUMNS[column].unit
    return [*FACTORS.get(unit, ()), *(CURRENTS if unit == "N m" else ())]


def is_effort(column: str) -> bool:
    """Whether a column is an effort."""
    return column.startswith("eff_")


def effort_range(column: str, robot: Robot) -> tuple[float, float]:
    """Return the stall torque behind an effort column, and one count of its register, N m."""
    joint = JOINTS.index(column.removeprefix("eff_"))
    motor = robot.servo.leg if joint < len(LEGS) else robot.servo.wheel
    return motor.stall_torque, float(effort_counts(robot)[joint])


def check_effort(column: str, table: Mapping[str, NDArray[np.float64]], unit: str, robot: Robot, where: str) -> None:
    """Refuse efforts that the robot's motor cannot have, and those in small units that its register would not show.

    Args:
        column: of the efforts.
        table: of the run, in SI units.
        unit: that the log is said to have them in.
        robot: that the run is of.
        where: for messages.

    Raises:
        InputError: naming file, column and value, and what was expected.
    """
    stall, count = effort_range(column, robot)
    sizes, moved = np.nan_to_num(np.abs(table[column])), np.ptp(table[column.replace("eff", "pos")])
    row = int(np.argmax(sizes))
    text = f"{where}: row {row}, column '{column}': {table[column][row]:.3g} N m; expected"
    if np.quantile(sizes, 0.95) > _STALLS * stall:
        hint = "looks like mA, mN m or counts of a register, or another robot (--robot)"
        raise InputError(f"{text} up to {stall:g}, the stall torque of robot '{robot.name}'; {hint}")
    if unit in ("mA", "mN m") and 0.0 < sizes[row] < count and moved > _MOVED:
        raise InputError(f"{text} more than {count:.2g}, one count of robot '{robot.name}'; looks like A or N m")


def factor(column: str, unit: str | None, robot: Robot, where: str) -> float:
    """Return what one ``unit`` of a column is in SI units, a count as the robot's encoders count; None = it is in SI units.

    Raises:
        InputError: no unit of this column.
    """
    si = COLUMNS[column].unit
    if unit is None:
        return 1.0
    encoder = robot.sensors.encoder
    of_encoder = {"rad": encoder.position, "rad/s": encoder.velocity}.get(si, 0.0)
    if unit == "count" and of_encoder > 0.0:
        return of_encoder
    if unit in FACTORS.get(si, ()):
        return FACTORS[si][unit]
    if si not in FACTORS:
        raise InputError(f"{where}: channel '{column}': unit '{unit}': expected none, it is a number from 0 to 1")
    if si != "N m" or unit not in CURRENTS:
        raise unknown_name("unit", unit, units_of(column), f"{where}: channel '{column}'")
    joint = JOINTS.index(column.removeprefix("eff_"))
    if unit == "count":
        return float(effort_counts(robot)[joint])
    return float(current_law(robot).torque_constant[joint]) * (1e-3 if unit == "mA" else 1.0)
