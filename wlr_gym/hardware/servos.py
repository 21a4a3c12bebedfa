"""The eight servos in SI units and joint order, over however many buses: counts, mounting signs and zeros end here.

New servos: :func:`find_servos` finds them at any baud rate, :func:`set_up` gives them their id, registers and baud rate.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.config import Bus, Hardware, check_fit
from wlr_gym.hardware.dynamixel.bus import PATIENCE, Block, BlockReading, BusGroup, IndirectBlock
from wlr_gym.hardware.dynamixel.protocol import BusGoneError, NoAnswerError, RefusedError
from wlr_gym.hardware.dynamixel.tables import BAUD_RATES, ControlTable, load_table
from wlr_gym.physics.servo import effort_counts, idle_effort
from wlr_gym.robot import JOINTS, LEG_SLICE, LEGS, WHEEL_SLICE, WHEELS, Robot

if TYPE_CHECKING:
    from wlr_gym.hardware.dynamixel.port import DynamixelPort

Array = NDArray[np.float64]

_IS_LEG = np.arange(len(JOINTS)) < len(LEGS)
#: First and last item of what is read every tick ...
_MOTION = ("realtime_tick", "present_position")
#: ... what is used of it, besides current or load ...
_STATE = ("present_position", "present_velocity")
#: ... what is read with that, through indirect addresses, while the robot is driven ...
_REGISTERS = ("torque_enable", "hardware_error_status", "bus_watchdog", "goal_pwm", "present_pwm")
#: ... and now and then.
_HEALTH = ("present_input_voltage", "present_temperature")
#: Times that a single item is asked for again.
RETRIES = 2


class JointMap:
    """Counts of the eight servos to SI values of the eight joints, and back.

    Args:
        robot: encoder counts, and the torque that currents and loads mean.
        hardware: models, and how the servos are mounted.
    """

    def __init__(self, robot: Robot, hardware: Hardware) -> None:
        models = {joint: bus.model for bus in hardware.buses.values() for joint in bus.joints}
        tables = [load_table(models[joint]) for joint in JOINTS]
        self._sign = np.array([hardware.joints[joint].sign for joint in JOINTS], np.float64)
        self._zero = np.array([hardware.joints[joint].zero for joint in JOINTS], np.float64)
        self._position = np.array([table.per_count("present_position") for table in tables])
        self._velocity = np.array([table.per_count("present_velocity") for table in tables])
        self._effort, self._idle = effort_counts(robot), idle_effort(robot)
        self._full_pwm = np.array([table.counts.full_pwm for table in tables], np.float64)

    def pwm_share(self, counts: ArrayLike) -> Array:
        """Return the parts of the supply (8,) that Goal PWM lets through; 0 to 1."""
        return np.asarray(counts, np.float64) / self._full_pwm

    def voltage_share(self, counts: ArrayLike) -> Array:
        """Return the parts of the supply (8,) that are on the motors, from Present PWM; -1 to 1, joint directions."""
        return self._sign * np.asarray(counts, np.float64) / self._full_pwm

    def position(self, counts: ArrayLike) -> Array:
        """Return joint angles (8,) in rad; wheels as many turns as the servos counted."""
        return self._sign * (np.asarray(counts, np.float64) - self._zero) * self._position

    def velocity(self, counts: ArrayLike) -> Array:
        """Return joint rates (8,) in rad/s."""
        return self._sign * np.asarray(counts, np.float64) * self._velocity

    def effort(self, counts: ArrayLike, velocity_counts: ArrayLike) -> Array:
        """Return motor torques (8,) in N m by the nominal currents or loads, before gear friction."""
        return self._sign * np.asarray(counts, np.float64) * self._effort - self._idle * self.velocity(velocity_counts)

    def setpoint_counts(self, setpoints: ArrayLike) -> NDArray[np.int64]:
        """Return the counts (8,) of leg angles (rad) and wheel speeds (rad/s): Goal Position and Goal Velocity.

        Raises:
            InputError: wrong shape, or a setpoint that is not finite; names the joint.
        """
        values = np.asarray(setpoints, np.float64)
        if values.shape != (len(JOINTS),):
            raise InputError(f"setpoints have shape {values.shape}, expected ({len(JOINTS)},)")
        if not np.isfinite(values).all():
            bad = int(np.flatnonzero(~np.isfinite(values))[0])
            raise InputError(f"setpoint of {JOINTS[bad]} is {values[bad]}, expected a finite number")
        counts = self._sign * values / np.where(_IS_LEG, self._position, self._velocity) + np.where(_IS_LEG, self._zero, 0.0)
        return np.rint(counts).astype(np.int64)

    def written(self, setpoints: ArrayLike) -> Array:
        """Return setpoints (8,) as the registers hold them: rounded to whole counts, in rad and rad/s."""
        counts = self.setpoint_counts(setpoints)
        return np.where(_IS_LEG, self.position(counts), self.velocity(counts))


class ServoRegisters(NamedTuple):
    """What the servos' registers hold besides the motion, (8,) in joint order; NaN where not read.

    Attributes:
        torque, error, watchdog, goal_pwm: counts of Torque Enable, Hardware Error Status, Bus Watchdog, Goal PWM.
        voltage_share: of the supply on the motor, -1 to 1, in the joint's direction.
    """

    torque: Array
    error: Array
    watchdog: Array
    goal_pwm: Array
    voltage_share: Array


#: Registers that were not read.
UNREAD = ServoRegisters(*(np.full(len(JOINTS), np.nan) for _ in range(5)))


@dataclass(frozen=True)
class JointReadings:
    """What the eight servos said, in joint order; NaN where one did not.

    Attributes:
        position, velocity, effort: (8,) rad, rad/s, N m (see :class:`JointMap`).
        age: (8,) s since the servo took the reading.
        answered: (8,) it answered, and not too late.
        alert: (8,) it has a hardware error.
        restarted: (8,) it was rebooted, or had no power, since the last reading.
        registers: read since :meth:`Servos.supervise`.
    """

    position: Array
    velocity: Array
    effort: Array
    age: Array
    answered: NDArray[np.bool_]
    alert: NDArray[np.bool_]
    restarted: NDArray[np.bool_]
    registers: ServoRegisters = UNREAD


class Servos:
    """All servos of a robot.

    Use as a context manager, or :meth:`open` and :meth:`close`. Nothing here decides what is safe: callers other than the
    command limiter read only. Errors are those of :class:`wlr_gym.hardware.dynamixel.bus.BusGroup`; switching torque off raises
    none: a bus that is gone does not keep the others.

    Args:
        robot: its ``dynamixel_ids``.
        hardware: ports, models, mounting.
        patience, clock, make_port: see :class:`wlr_gym.hardware.dynamixel.bus.BusGroup`.

    Attributes:
        groups: bus name -> bus group. ports: bus name -> device.
        joint_map: counts to SI units.
    """

    def __init__(
        self,
        robot: Robot,
        hardware: Hardware,
        patience: float = PATIENCE,
        clock: Callable[[], float] = time.monotonic,
        make_port: Callable[[str, int, float], DynamixelPort] | None = None,
    ) -> None:
        check_fit(robot, hardware)
        self.joint_map: JointMap = JointMap(robot, hardware)
        self._ids = {joint: robot.dynamixel_ids[joint] for joint in JOINTS}
        self._bus_of = {joint: name for name, bus in hardware.buses.items() for joint in bus.joints}
        self.groups: dict[str, BusGroup] = {}
        self.ports: dict[str, str] = {name: bus.port for name, bus in hardware.buses.items()}
        self._motion: dict[str, Block] = {}
        self._supervised: dict[str, IndirectBlock] = {}
        self._is_supervised = False
        self._health: dict[str, Block] = {}
        for name, bus in hardware.buses.items():
            table = load_table(bus.model)
            servos = {robot.dynamixel_ids[joint]: table for joint in bus.joints}
            self.groups[name] = BusGroup(name, bus.port, bus.baud_rate, servos, patience, clock, make_port)
            self._motion[name] = Block(table, *_MOTION)
            self._supervised[name] = IndirectBlock(table, ("realtime_tick", table.effort, *_STATE, *_REGISTERS))
            self._health[name] = Block(table, *_HEALTH)

    def open(self) -> None:
        """Open all ports, or none; see :class:`wlr_gym.hardware.serial_frames.SerialDevice`."""
        with contextlib.ExitStack() as stack:
            for group in self.groups.values():
                group.open()
                stack.callback(group.close)
            stack.pop_all()

    def set_patience(self, seconds: float) -> None:
        """Set how long (s) an answer may take beyond its bytes' time on the wire, on all buses."""
        for group in self.groups.values():
            group.port.patience = seconds

    def close(self) -> None:
        """Close all ports; servos stay as they are."""
        for group in self.groups.values():
            group.close()

    def __enter__(self) -> Servos:
        self.open()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # ---- reading ----

    def supervise(self) -> None:
        """Have the servos' registers read with every :meth:`read` from here on. Torque must be off."""
        for joint in JOINTS:
            block = self._supervised[self._bus_of[joint]]
            _persist(self._group(joint).point, self._ids[joint], block)
        self._is_supervised = True

    def unsupervise(self) -> None:
        """Read the motion alone: servos may have been rebooted since :meth:`supervise`."""
        self._is_supervised = False

    def read(self) -> JointReadings:
        """Read all joints; the buses work at the same time."""
        readings = self._read(self._supervised if self._is_supervised else self._motion)
        items = (*_STATE, *_REGISTERS) if self._is_supervised else _STATE
        rows = [_row(readings.get(id), items) for id in self._ids.values()]
        age, effort, position, velocity, *registers = np.array([numbers for numbers, _ in rows]).T
        flags = np.array([flags for _, flags in rows]).T
        convert = self.joint_map
        motion = convert.position(position), convert.velocity(velocity), convert.effort(effort, velocity)
        if not registers:
            return JointReadings(*motion, age, *flags)
        registers[-1] = convert.voltage_share(registers[-1])
        return JointReadings(*motion, age, *flags, registers=ServoRegisters(*registers))

    @property
    def broken_packets(self) -> int:
        """Packets with a wrong checksum since the ports were opened."""
        return sum(group.statistics.crc_errors for group in self.groups.values())

    def read_health(self) -> tuple[Array, Array]:
        """Return supply voltages (8,) in V and temperatures (8,) in degC; NaN where a servo did not answer."""
        readings = self._read(self._health)
        values = np.full((2, len(JOINTS)), np.nan)
        for k, id in enumerate(self._ids.values()):
            if id in readings:
                counts = readings[id].counts
                values[:, k] = counts["present_input_voltage"] * 0.1, counts["present_temperature"]
        return values[0], values[1]

    def _read(self, blocks: Mapping[str, Block]) -> dict[int, BlockReading]:
        for name, group in self.groups.items():
            group.ask_all(blocks[name])
        found: dict[int, BlockReading] = {}
        for group in self.groups.values():
            found |= group.answers()
        return found

    # ---- single items, by joint ----

    def ping(self, joint: str) -> tuple[int, int]:
        """Return a joint's model number and firmware version; see :meth:`BusGroup.ping`."""
        return _persist(self._group(joint).ping, self._ids[joint])

    def get(self, joint: str, item: str) -> int:
        """Return the count of a joint's control table item; see :meth:`BusGroup.read`. A lost answer is asked for again."""
        return _persist(self._group(joint).read, self._ids[joint], item)

    def set(self, joint: str, item: str, count: int) -> None:
        """Write a count into a joint's control table item; see :meth:`BusGroup.write`. A lost answer is asked for again."""
        _persist(self._group(joint).write, self._ids[joint], item, count)

    def get_all(self, item: str) -> dict[str, int]:
        """Return joint -> count of an item, of the joints that answered; the buses work at the same time."""
        tables = {name: next(iter(group.servos.values())) for name, group in self.groups.items()}
        readings = self._read({name: Block(table, item, item) for name, table in tables.items()})
        return {joint: readings[id].counts[item] for joint, id in self._ids.items() if id in readings}

    def table(self, joint: str) -> ControlTable:
        """Return a joint's control table."""
        return self._group(joint).servos[self._ids[joint]]

    def _group(self, joint: str) -> BusGroup:
        if joint not in self._bus_of:
            raise InputError(f"no joint '{joint}'; there are {', '.join(JOINTS)}")
        return self.groups[self._bus_of[joint]]

    # ---- writing ----

    def write_setpoints(self, setpoints: ArrayLike) -> None:
        """Write setpoints (8,): leg angles in rad, wheel speeds in rad/s.

        Nothing is acknowledged; a servo ignores a setpoint out of its range.

        Raises:
            InputError: wrong shape, or a setpoint that is not finite.
        """
        counts = self.joint_map.setpoint_counts(setpoints).tolist()
        self.write_item("goal_position", dict(zip(LEGS, counts[LEG_SLICE], strict=True)))
        self.write_item("goal_velocity", dict(zip(WHEELS, counts[WHEEL_SLICE], strict=True)))

    def write_item(self, item: str, counts: Mapping[str, int]) -> None:
        """Write joint -> count of one item, all joints of a bus in one packet. Not acknowledged."""
        for name, group in self.groups.items():
            if here := {self._ids[joint]: count for joint, count in counts.items() if self._bus_of[joint] == name}:
                group.write_all(item, here)

    def torque_off_unacknowledged(self) -> None:
        """Send torque off to every servo and wait for no answer; a bus that is gone does not keep the others."""
        for group in self.groups.values():
            with contextlib.suppress(BusGoneError):
                group.write_all("torque_enable", dict.fromkeys(group.servos, 0))

    def reopen_gone(self) -> None:
        """Open the ports again that are gone, where they are back."""
        for group in self.groups.values():
            if group.port.gone:
                with contextlib.suppress(InputError):
                    group.close()
                    group.open()

    def torque_off(self, retries: int = 5, joints: Iterable[str] = JOINTS) -> list[str]:
        """Switch motors off, whatever happened before; return the joints that did not confirm it.

        A bus whose port is gone does not keep the others from being tried.

        Args:
            retries: times that each is asked.
            joints: which; those that confirmed it before need not do so again.
        """
        left: list[str] = []
        for name, group in self.groups.items():
            here = {self._ids[joint]: joint for joint in joints if self._bus_of[joint] == name}
            try:
                left += [here[id] for id in group.torque_off(retries, here)]
            except BusGoneError:
                left += here.values()
        return [joint for joint in JOINTS if joint in left]


def _row(reading: BlockReading | None, items: tuple[str, ...]) -> tuple[list[float], tuple[bool, bool, bool]]:
    """Return age, current or load, and the counts of ``items``; and whether a servo answered, is in alert, was restarted."""
    if reading is None:
        return [np.nan] * (2 + len(items)), (False, False, False)
    counts = reading.counts
    effort = counts["present_current"] if "present_current" in counts else counts["present_load"]
    return [reading.age, effort, *[counts[item] for item in items]], (True, reading.alert, reading.restarted)


def _persist(ask: Callable[..., Any], *arguments: Any) -> Any:
    """Ask up to three times: reading and writing an item twice does no harm."""
    for _ in range(RETRIES):
        with contextlib.suppress(NoAnswerError):
            return ask(*arguments)
    return ask(*arguments)


# ---- new servos ----


#: bit/s of a servo out of the box.
FACTORY_RATE = 57600
#: s an answer may take: nothing is in a hurry here.
_PATIENCE = 0.05


class FoundServo(NamedTuple):
    """A servo that answered a scan."""

    id: int
    baud_rate: int
    model_number: int
    firmware: int

    def __str__(self) -> str:
        return f"id {self.id} at {self.baud_rate} bit/s: model {self.model_number}, firmware {self.firmware}"


def find_servos(name: str, port: str, baud_rates: Sequence[int] = BAUD_RATES) -> list[FoundServo]:
    """Search a bus, whatever the ids; about 0.8 s for each baud rate. Servos that share an id may hide each other.

    Args:
        name: of the bus, for messages.
        port: its device, not open.
        baud_rates: to search at.

    Raises:
        InputError: the port is not there, or cannot be opened at any speed.
    """
    found, failures = [], []
    for baud_rate in baud_rates:
        try:
            with BusGroup(name, port, baud_rate, {}) as group:
                found += [FoundServo(id, baud_rate, *answer) for id, answer in group.scan().items()]
        except InputError as error:  # the SDK does not know every speed the servos do
            failures.append(error)
    if len(failures) == len(baud_rates):
        raise failures[0]
    return found


def check_new_servo(found: list[FoundServo], bus: Bus, joint: str) -> FoundServo:
    """Return the one servo that is connected.

    Raises:
        InputError: none, several, or one of another model.
    """
    table = load_table(bus.model)
    if len(found) != 1:
        seen = "; ".join(map(str, found)) or "none"
        raise InputError(f"connect the servo of {joint} alone, with power, to {bus.port}; found: {seen}")
    if found[0].model_number != table.model_number:
        raise InputError(f"{joint} needs an {bus.model} (model {table.model_number}); found: {found[0]}")
    return found[0]


def set_up(name: str, bus: Bus, servo: FoundServo, id: int) -> None:
    """Write the EEPROM of a servo: what the hardware file says, its id, then its baud rate; and see that it answers there.

    Raises:
        InputError: its torque is on, or it does not answer as it should afterwards.
        NoAnswerError, RefusedError: it does not take a value.
    """
    table = load_table(bus.model)
    with BusGroup(name, bus.port, servo.baud_rate, {servo.id: table, id: table}, _PATIENCE) as group:
        if group.read(servo.id, "torque_enable"):
            raise InputError(f"servo {servo}: its torque is on; the EEPROM is locked until it is off")
        for item, count in bus.eeprom.items():
            group.write(servo.id, item, count)
        for now, item, count in ((servo.id, "id", id), (id, "baud_rate", BAUD_RATES.index(bus.baud_rate))):
            with contextlib.suppress(NoAnswerError, RefusedError):  # the answer may come under either id, at either speed
                group.write(now, item, count)
    with BusGroup(name, bus.port, bus.baud_rate, {id: table}, _PATIENCE) as group:
        try:
            group.ping(id)
            wrong = {item: count for item in bus.eeprom if (count := group.read(id, item)) != bus.eeprom[item]}
        except NoAnswerError:
            raise InputError(
                f"no answer from id {id} at {bus.baud_rate} bit/s after it was set up: wlr doctor --scan"
            ) from None
        if wrong:
            raise InputError(f"id {id} holds {wrong} after it was set up, expected {bus.eeprom}")
