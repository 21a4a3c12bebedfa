"""What the supervision of a real robot makes of faults that answer plausibly and wrongly, on the emulated robot.

``python -m studies.bench.lying_sensors OUT.json`` drives every fault in every phase, with half, once and twice the robot's
mass, and writes what stopped the robot, when, and how far a joint had gone by then. The documentation's table is made of it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.hardware.config import Hardware, Measured, MeasuredValue, load_hardware
from wlr_gym.hardware.emulator import Machine, MachineOptions
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.link import emulated_link
from wlr_gym.hardware.loop import ControlLoop, StoppedError
from wlr_gym.physics.plants.base import RobotOptions
from wlr_gym.robot import JOINTS, load_robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]
ROBOT, HARDWARE, PERIOD = load_robot("emanual"), load_hardware(), 0.02
#: As ``wlr commission`` leaves it where Present Load is torque.
COMMISSIONED = HARDWARE.model_copy(
    update={"measured": Measured(load_per_pwm=dict.fromkeys(JOINTS[4:], MeasuredValue(value=0.0, unit="-", date="")))}
)
HOME = np.r_[[1.5, 1.6, 1.5, 1.6], [0.0] * 4]
_LEGS, _WHEELS = np.r_[[1.0] * 4, [0.0] * 4], np.r_[[0.0] * 4, [1.0] * 4]
#: s for which a healthy robot is driven before a fault begins, and for which it is driven with it.
BEFORE, AFTER = 3.0, 3.0
LOADS = (0.5, 1.0, 2.0)

#: Phase -> setpoints (8,) at a time since the start (s).
PHASES: dict[str, Callable[[float], Array]] = {
    "standing": lambda t: HOME,
    "legs moving": lambda t: HOME + 0.25 * np.sin(np.pi * t) * _LEGS,
    "wheels 0.3 rad/s": lambda t: HOME + 0.3 * _WHEELS,
    "wheels 3 rad/s": lambda t: HOME + 3.0 * _WHEELS,
    "turning": lambda t: HOME + 2.0 * np.r_[[0.0] * 4, -1.0, 1.0, -1.0, 1.0],
    "braking": lambda t: HOME + (3.0 if t < BEFORE else 0.0) * _WHEELS,
}
#: Fault -> how it is injected.
FAULTS = {
    "leg encoder reads 30 %": "encoder_gain leg_lf value=0.3",
    "leg encoder reads 50 %": "encoder_gain leg_lf value=0.5",
    "leg encoder drifts 100 counts/s": "encoder_drift leg_lf value=0.153",
    "leg encoder jumps 100 counts": "encoder_jump leg_lf value=0.153",
    "leg encoder jumps 150 counts": "encoder_jump leg_lf value=0.23",
    "leg encoder reversed": "encoder_reversed leg_lf",
    "leg motor reversed": "motor_reversed leg_lf",
    "leg encoder frozen": "encoder_frozen leg_lf",
    "leg torque lost": "torque_lost leg_lf",
    "leg motor at 5 %": "slow_servo leg_lf",
    "leg rebooted": "reboot_matching_tick leg_lf",
    "leg current stuck at 0": "current_stuck leg_lf value=0",
    "leg current stuck at 300 counts": "current_stuck leg_lf value=300",
    "wheel encoder reads 30 %": "encoder_gain wheel_lf value=0.3",
    "wheel encoder reads 50 %": "encoder_gain wheel_lf value=0.5",
    "wheel encoder reads 30 %, load known": "encoder_gain wheel_lf value=0.3",
    "wheel encoder reads 50 %, load known": "encoder_gain wheel_lf value=0.5",
    "wheel encoder reversed": "encoder_reversed wheel_lf",
    "wheel encoder frozen": "encoder_frozen wheel_lf",
    "wheel torque lost": "torque_lost wheel_lf",
    "accelerometer z reads 0": "imu_axis_dead value=2",
    "accelerometer x at the end of its range": "imu_axis_saturated value=0",
    "gyroscope z reads 0": "imu_axis_dead value=5",
    "gyroscope y at the end of its range": "imu_axis_saturated value=4",
}


class Outcome(NamedTuple):
    """What became of a fault."""

    rule: str  #: that stopped the robot; empty = none
    time: float  #: s from the fault until torque was off on all motors; of the whole run where it was not
    leg: float  #: rad by which a leg left its healthy range
    way: float  #: m by which the tread of a wheel went another way than the healthy one's
    reason: str  #: in the supervision's words


def drive(fault: str, phase: str, load: float, hardware: Hardware = HARDWARE, after: float = AFTER) -> tuple[Array, Array, str]:
    """Return true angles (T, 8) in rad from the fault on, s of each, and why the robot stopped (empty = it did not)."""
    parameters = Parameters.nominal(ROBOT)
    parameters["body.mass"] *= load
    options = MachineOptions(timing=NO_TIME, tick=0.002)
    machine = Machine(ROBOT, hardware, options, parameters=parameters)
    servos, angles, times = list(machine.servos.values()), [], []
    with ControlLoop(ROBOT, hardware, emulated_link(machine), PERIOD, RobotOptions()) as loop:
        loop.start()
        reason = ""
        try:
            for tick in range(round((BEFORE + after) / PERIOD)):
                if tick == round(BEFORE / PERIOD):
                    machine.watchers.append(lambda: angles.append([servo.shaft.true_position for servo in servos]))
                    machine.watchers.append(lambda: times.append(any(servo["torque_enable"] for servo in servos)))
                    if fault:
                        machine.inject(fault)
                loop.tick(PHASES[phase](tick * PERIOD))
        except StoppedError as error:
            reason = str(error)
        on = np.array(times)
        end = int(np.flatnonzero(on)[-1]) + 1
    machine.close()
    return np.array(angles)[:end], options.tick * np.arange(end, dtype=np.float64), reason


@cache
def healthy(phase: str, load: float) -> Array:
    """Return the true angles (T, 8) of a robot without a fault."""
    angles, _, reason = drive("", phase, load)
    assert not reason, reason
    return angles


def examine(fault: str, phase: str, load: float) -> Outcome:
    """Return what becomes of a fault."""
    angles, times, reason = drive(FAULTS[fault], phase, load, COMMISSIONED if "load known" in fault else HARDWARE)
    well = healthy(phase, load)
    low, high = well[:, :4].min(axis=0), well[:, :4].max(axis=0)
    leg = float(np.maximum(low - angles[:, :4], angles[:, :4] - high).max(initial=0.0))
    start = angles[0, 4:] - well[0, 4:]
    way = float(np.abs(angles[-1, 4:] - well[min(len(angles), len(well)) - 1, 4:] - start).max()) * ROBOT.wheel.radius
    rule = reason.partition(":")[0]
    return Outcome(rule, round(float(times[-1]), 3), round(leg, 3), round(way, 4), reason)


def markdown(found: list[dict[str, Any]]) -> list[str]:
    """Return the documentation's table: a line for each fault."""
    lines = ["| fault | stopped | rule | torque off after | leg out of its range | tread off its way | where not stopped |"]
    lines.append("|---|---|---|---|---|---|---|")
    for fault in dict.fromkeys(row["fault"] for row in found):
        rows = [row for row in found if row["fault"] == fault]
        stopped, driven = ([row for row in rows if bool(row["rule"]) is is_stopped] for is_stopped in (True, False))
        rules = ", ".join(f"`{rule}`" for rule in dict.fromkeys(row["rule"] for row in stopped))
        cells = [fault, f"{len(stopped)} of {len(rows)}", rules, *(_most(stopped, *of) for of in _COLUMNS)]
        phases = ", ".join(dict.fromkeys(row["phase"] for row in driven))
        moved = " and ".join(most for most in (_most(driven, *of) for of in _COLUMNS[1:]) if most not in ("", "0"))
        lines.append(f"| {' | '.join(cells)} | {phases}{f': {moved} in {AFTER:g} s' if moved else ''} |")
    return lines


#: Number of an outcome, its factor, format and unit.
_COLUMNS = (("time", 1.0, ".2f", "s"), ("leg", 1.0, ".2f", "rad"), ("way", 1000.0, ".0f", "mm"))


def _most(rows: list[dict[str, Any]], name: str, factor: float, form: str, unit: str) -> str:
    """Return the largest number of some outcomes in words; nothing where there are none, ``0`` where it rounds to that."""
    most = max((factor * row[name] for row in rows), default=None)
    if most is None:
        return ""
    return f"{most:{form}} {unit}" if float(f"{most:{form}}") else "0"


def main(path: str, *loads: str) -> None:
    """Write the matrix, or its rows of some loads."""
    found: list[dict[str, Any]] = []
    for fault in FAULTS:
        for phase in PHASES:
            for load in map(float, loads or LOADS):
                outcome = examine(fault, phase, load)
                found.append({"fault": fault, "phase": phase, "load": load, **outcome._asdict()})
                print(f"{fault:40} {phase:17} {load:3g} {outcome.rule:15} {outcome.time:6.2f} s {outcome.leg:5.2f} rad "
                          f"{outcome.way:6.3f} m", flush=True)  # fmt: skip
    with open(path, "w", encoding="utf-8") as file:
        json.dump(found, file, indent=1)


if __name__ == "__main__":
    main(*sys.argv[1:])
