"""Tests of what servos do with setpoints: when the line falls silent, and when torque comes on."""

from __future__ import annotations

import numpy as np

from wlr_gym.hardware.commissioning.contract import PartlyError, Reading, StandQuantity, StandTest
from wlr_gym.hardware.commissioning.errors import TroubleError
from wlr_gym.hardware.commissioning.person import Person
from wlr_gym.hardware.commissioning.stand import Stand
from wlr_gym.hardware.dynamixel.errors import RefusedError
from wlr_gym.robot import JOINTS, LEG_SLICE, LEGS, WHEEL_SLICE, WHEELS

#: rad/s of the wheels when the line falls silent, s until they turn evenly, s of silence beyond the watchdog's time.
_SPEED, _EVEN, _SILENCE = 2.0, 1.6, 0.8
_SLOW = 1.0
#: rad that a leg is asked to move by, and s it is given for it.
_LEAN, _LEAN_TIME = 0.1, 0.8
_STOP = "Do not drive until this is understood: nothing else stops the wheels when this computer dies."
_WEAK = "If the test load or stall differs too, the leg is weak or something holds it. Otherwise: "
_GOAL = "The start-up order (setpoint first, then torque) is right for neither case alone: report it before driving."


def _measure_watchdog(stand: Stand, person: Person) -> list[Reading]:
    stand.prepare(JOINTS)
    stand.switch_on(JOINTS)
    stand.spin(dict.fromkeys(WHEELS, _SPEED))
    before = stand.run(_EVEN)[-1]
    speed = np.mean([readings.velocity for readings in stand.run(0.2)], axis=0)[WHEEL_SLICE]
    if (np.abs(speed) < 0.5 * _SPEED).any():
        raise TroubleError(f"wheels turn at {np.round(speed, 2).tolist()} rad/s, asked for {_SPEED:g}")
    last = stand.fall_silent(_SILENCE)
    after = stand.step()
    rolled = (after.position - last.position)[WHEEL_SLICE]
    found = [Reading("watchdog_stop_time", wheel, float(rolled[k] / speed[k])) for k, wheel in enumerate(WHEELS)]
    moved = np.abs(after.position - before.position)[LEG_SLICE]
    found += [Reading("watchdog_leg_move", leg, float(moved[k])) for k, leg in enumerate(LEGS)]
    for joint in JOINTS:
        found.append(Reading("watchdog_latched", joint, float(stand.servos.get(joint, "bus_watchdog") < 0)))
        found.append(Reading("watchdog_holds_torque", joint, float(stand.servos.get(joint, "torque_enable"))))
    return found + [Reading("watchdog_refuses", wheel, float(_refuses(stand, wheel))) for wheel in WHEELS]


def _refuses(stand: Stand, wheel: str) -> bool:
    try:
        stand.spin({wheel: 0.0})
    except RefusedError:
        return True
    return False


WATCHDOG = StandTest(
    "watchdog",
    "Bus Watchdog",
    "",
    f"All motors come on; wheels turn at {_SPEED:g} rad/s, then nothing is sent for a second.",
    (
        StandQuantity(
            "watchdog_stop_time", "s", "way of a wheel after the last packet over its speed", 0.08, f"Too long: {_STOP}", 0.1
        ),
        StandQuantity("watchdog_leg_move", "rad", "way of a leg meanwhile", 0.02, "Is its Homing Offset 0 (wlr doctor)?"),
        StandQuantity("watchdog_latched", "-", "1: the watchdog register says that it stopped the servo", 0.1, _STOP),
        StandQuantity("watchdog_holds_torque", "-", "1: torque stays on", 0.1, "The emulator has this otherwise: report it."),
        StandQuantity("watchdog_refuses", "-", "1: setpoints are refused until it is cleared", 0.1, _STOP),
    ),
    _measure_watchdog,
)


def _measure_torque_on(stand: Stand, person: Person) -> list[Reading]:
    found = _wheels_torque_on(stand) + _legs_torque_on(stand)
    person.turn(LEGS[0], -_LEAN)
    start = stand.step().position[0]
    try:
        stand.switch_on(LEGS[:1])
    except TroubleError as error:  # turned too far: only this value is missing
        raise PartlyError(str(error), found) from None
    end = stand.run(_LEAN_TIME)[-1].position[0]
    stand.switch_off(LEGS[:1])
    return [*found, Reading("leg_follows_kept", LEGS[0], float((end - start) / _LEAN))]


def _wheels_torque_on(stand: Stand) -> list[Reading]:
    stand.prepare(WHEELS)
    stand.spin(dict.fromkeys(WHEELS, _SLOW))
    stand.switch_on(WHEELS)
    given = _speed(stand)
    stand.switch_off(WHEELS)
    stand.run(0.4)
    stand.switch_on(WHEELS)
    kept = _speed(stand)
    stand.switch_off(WHEELS)
    found = [Reading("wheel_follows_given", wheel, float(given[k] / _SLOW)) for k, wheel in enumerate(WHEELS)]
    return found + [Reading("wheel_follows_kept", wheel, float(kept[k] / _SLOW)) for k, wheel in enumerate(WHEELS)]


def _speed(stand: Stand) -> np.ndarray:
    """Return the wheels' mean speed (4,) once they turn evenly, rad/s."""
    stand.run(_EVEN)
    return np.mean([readings.velocity[WHEEL_SLICE] for readings in stand.run(0.2)], axis=0)


def _legs_torque_on(stand: Stand) -> list[Reading]:
    found = []
    stand.prepare(LEGS)
    for k, leg in enumerate(LEGS):
        start = stand.step().position[k]
        stand.lean(leg, _LEAN)
        stand.switch_on([leg])
        end = stand.run(_LEAN_TIME)[-1].position[k]
        stand.switch_off([leg])
        found.append(Reading("leg_follows_given", leg, float((end - start) / _LEAN)))
    return found


TORQUE_ON = StandTest(
    "torque_on",
    "What torque-on does to the setpoint",
    "Legs straight down. One leg is to be turned by hand in between, motors off.",
    f"Wheels turn at {_SLOW:g} rad/s, and each leg moves by {_LEAN:g} rad.",
    (
        StandQuantity("wheel_follows_given", "-", "speed over the setpoint written before torque came on", 0.15, _GOAL),
        StandQuantity("wheel_follows_kept", "-", "speed over the setpoint left from before torque went off", 0.15, _GOAL),
        StandQuantity("leg_follows_given", "-", "way over the way asked for before torque came on", 0.2, _WEAK + _GOAL),
        StandQuantity("leg_follows_kept", "-", "way over the way back to the setpoint from before torque went off", 0.2, _GOAL),
    ),
    _measure_torque_on,
)
