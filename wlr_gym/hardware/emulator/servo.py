"""One emulated servo: its control table with access rules, resets, watchdog, hardware errors and shutdown.

No motion here: :meth:`EmulatedServo.drive` says what the firmware asks of the motor, and :class:`Shaft` brings back what the
physics made of it. Everything is in the encoder's own frame: radians from count 0, positive as the encoder counts, before
Drive Mode, turn counting and Homing Offset. Source: ROBOTIS e-manual; where it is silent, docs/robot.md lists what was chosen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.dynamixel.protocol import ALERT, CLEAR_TURNS, Error
from wlr_gym.hardware.dynamixel.tables import BAUD_RATES, TABLE_SIZE, ControlTable, Item

VELOCITY_MODE, POSITION_MODE, EXTENDED_POSITION_MODE, CURRENT_POSITION_MODE, CURRENT_MODE, PWM_MODE = 1, 3, 4, 5, 0, 16
POSITION_MODES = (POSITION_MODE, EXTENDED_POSITION_MODE, CURRENT_POSITION_MODE)
#: Counts per turn, and the turns extended position mode allows, in counts.
TURN = 4096
EXTENDED_RANGE = 1_048_575
#: Homing Offset that acts in position mode.
HOMING_IN_POSITION_MODE = 1024

# Not in the e-manual: chosen.
FIRMWARE = 45
BOOT_TIME = 0.3  #: s during which a rebooting servo does not answer
AMBIENT, HEATING, THERMAL_TIME = 25.0, 150.0, 120.0  #: degC, degC above ambient in a lasting stall, s
OVERLOAD, OVERLOAD_TIME = 0.8, 2.0  #: part of stall torque that trips the servo after this many s
IN_POSITION = 16  #: counts

INPUT_VOLTAGE, OVERHEATING, OVERLOADED = 0x01, 0x04, 0x20
_GAINS = (
    "velocity_i_gain",
    "velocity_p_gain",
    "position_d_gain",
    "position_i_gain",
    "position_p_gain",
    "feedforward_2nd_gain",
    "feedforward_1st_gain",
)
_GOALS = ("goal_pwm", "goal_current", "goal_velocity", "goal_position")
_WATCHDOG_UNIT = 0.02
#: Items that decide what Present Position counts from, and which way.
_FRAME = ("drive_mode", "operating_mode", "homing_offset")
_KEPT = {0xFF: (), 0x01: ("id",), 0x02: ("id", "baud_rate")}


@dataclass
class Shaft:
    """What the physics hands to a servo each tick.

    Attributes:
        position, velocity: rad from encoder count 0, rad/s.
        effort: counts of Present Current or Present Load, positive as the encoder counts.
        load: motor torque over stall torque, 0 to about 1.
        voltage: V at the servo.
        pwm: part of the supply on the motor, -1 to 1.
        reference: asks where the profile generator stands: rad and rad/s.
    """

    position: float = 0.0
    velocity: float = 0.0
    effort: int = 0
    load: float = 0.0
    voltage: float = 12.0
    pwm: float = 0.0
    reference: Callable[[], tuple[float, float]] = lambda: (0.0, 0.0)


@dataclass(frozen=True)
class Drive:
    """What the firmware asks of the motor: SI units, encoder frame.

    Attributes:
        on: torque.
        mode: Operating Mode.
        goal_position, goal_velocity: rad, rad/s.
        goal_current: A; limit of the current in current-based position mode.
        goal_pwm: part of the supply; limit of the output in every mode but PWM mode.
        position_gain: V/rad on the position error.
        velocity_gain, velocity_integral_gain: V s/rad on the velocity error, V/rad on its integral.
        profile_velocity, profile_acceleration: rad/s, rad/s2; 0 = none.
    """

    on: bool
    mode: int
    goal_position: float
    goal_velocity: float
    goal_current: float
    goal_pwm: float
    position_gain: float
    velocity_gain: float
    velocity_integral_gain: float
    profile_velocity: float
    profile_acceleration: float


class EmulatedServo:
    """One servo.

    Args:
        name: what faults and reports call it.
        table: its control table.
        eeprom: what its EEPROM holds beyond the factory defaults, in counts.
        firmware: version it reports; fast reads need 45.

    Attributes:
        shaft: written by the physics before :meth:`advance`.
        dead: no power at the electronics: silent, motor off.
        heating_rate: degC/s that a fault adds.
    """

    def __init__(self, name: str, table: ControlTable, eeprom: Mapping[str, int], firmware: int = FIRMWARE) -> None:
        self.name = name
        self.table = table
        self.firmware = firmware
        self.shaft = Shaft()
        self.dead = False
        self.heating_rate = 0.0
        self._items = list(table.items.values())
        self._places = {item.name: (item.address, item.address + item.size, item.signed) for item in self._items}
        self._present_values = self._make_present_values()
        self._kept_up: dict[tuple[int, int], list[Item]] = {}
        self._pointers = {
            table[f"indirect_data_{k}"].address: table[f"indirect_address_{k}"]
            for k in range(1, 1 + sum(item.name.startswith("indirect_data") for item in self._items))
        }
        self._at = {item.address + k: item for item in self._items for k in range(item.size)}
        self._memory = bytearray(TABLE_SIZE)
        self._unit = table.per_count("present_position")
        self._temperature = AMBIENT
        self._load_defaults(self._items)
        for item_name, count in eeprom.items():
            self._set(item_name, count)
        self.boot(0.0)

    # ---- registers by name ----

    def __getitem__(self, name: str) -> int:
        """Return the count an item holds now."""
        self._refresh(self.table[name])
        return self._get(name)

    def _get(self, name: str) -> int:
        start, stop, signed = self._places[name]
        return int.from_bytes(self._memory[start:stop], "little", signed=signed)

    def _set(self, name: str, count: int) -> None:
        item = self.table.items[name]
        self._memory[item.address : item.address + item.size] = item.encode(count)
        self._drive = None
        if name in _FRAME:
            self._update_frame()

    def _has(self, name: str) -> bool:
        return name in self.table.items

    # ---- resets ----

    def _load_defaults(self, items: list[Item]) -> None:
        for item in items:  # plain defaults first: the others copy them
            self._set(item.name, item.default if isinstance(item.default, int) else 0)
        for item in items:
            if isinstance(item.default, str):
                self._set(item.name, self._get(item.default))
        self._set("firmware_version", self.firmware)

    def boot(self, silence: float = BOOT_TIME) -> None:
        """Start the firmware: RAM to its defaults, latches cleared, torque as Startup Configuration says.

        Args:
            silence: s during which it does not answer.
        """
        self._load_defaults([item for item in self._items if not item.in_eeprom])
        self._registered: tuple[int, bytes] | None = None
        self._clock = 0.0
        self._silence = silence
        self._since_packet = 0.0
        self._overload_time = 0.0
        self._shut_down = False
        self._goal_given = False
        self._start_turn_count()
        self._go_to_present()
        if self._get("startup_configuration") & 1:
            self._torque(True)

    def factory_reset(self, keep: int) -> Error:
        """Carry out a factory reset; ``keep``: FF nothing, 01 the id, 02 id and baud rate."""
        if keep not in _KEPT:
            return Error.DATA_RANGE
        kept = {name: self._get(name) for name in _KEPT[keep]}
        self._load_defaults([item for item in self._items if item.in_eeprom])
        for name, count in kept.items():
            self._set(name, count)
        self.boot()
        return Error.NONE

    # ---- the line's view ----

    @property
    def answers(self) -> bool:
        """Whether it is powered, booted and speaking Protocol 2."""
        return not self.dead and self._silence <= 0.0 and self._get("protocol_type") == 2

    @property
    def id(self) -> int:
        """Its id on the line."""
        return self._get("id")

    @property
    def baud_rate(self) -> int:
        """Bits per second."""
        return BAUD_RATES[self._get("baud_rate")]

    @property
    def return_delay(self) -> float:
        """s from an instruction's end to the answer's start."""
        return self._get("return_delay_time") * 2e-6

    @property
    def alert(self) -> int:
        """Alert bit of the status packets."""
        return ALERT if self._get("hardware_error_status") else 0

    def set_power(self, on: bool) -> None:
        """Take the power away, or give it back (then :meth:`boot` it)."""
        if self.dead == on:
            self.dead = not on
            self._drive = None

    def hear(self) -> None:
        """An instruction packet, to whomever, was seen on the line: feeds the Bus Watchdog."""
        self._since_packet = 0.0

    def read(self, address: int, length: int) -> tuple[Error, bytes]:
        """Return ``length`` bytes from ``address``; gaps read as 0."""
        if length == 0 or address + length > TABLE_SIZE:
            return Error.ACCESS, b""
        if not self._pointers.keys().isdisjoint(range(address, address + length)):
            return Error.NONE, b"".join(self._read_plain(self._resolve(a), 1) for a in range(address, address + length))
        return Error.NONE, self._read_plain(address, length)

    def _read_plain(self, address: int, length: int) -> bytes:
        block = (address, length)
        if block not in self._kept_up:
            inside = {item.address: item for place in range(address, address + length) if (item := self._at.get(place))}
            self._kept_up[block] = [item for item in inside.values() if item.name in self._present_values]
        for item in self._kept_up[block]:
            self._refresh(item)
        return bytes(self._memory[address : address + length])

    def write(self, address: int, data: bytes) -> Error:
        """Write bytes; either all of it acts or nothing does."""
        error, changes = self._check_write(address, data)
        if error == Error.NONE:
            for item, count in changes:
                self._apply(item, count)
        return error

    def register(self, address: int, data: bytes) -> Error:
        """Keep a write back until :meth:`action`."""
        error, _ = self._check_write(address, data)
        if error == Error.NONE:
            self._registered = (address, data)
            self._set("registered_instruction", 1)
        return error

    def action(self) -> Error:
        """Carry out the registered write."""
        if self._registered is None:
            return Error.INSTRUCTION
        address, data = self._registered
        self._registered = None
        self._set("registered_instruction", 0)
        return self.write(address, data)

    def clear(self, parameters: bytes) -> Error:
        """Bring Present Position back into one turn; refused while moving."""
        if parameters != CLEAR_TURNS:
            return Error.DATA_RANGE
        if self["moving"]:
            return Error.RESULT_FAIL
        self._start_turn_count()
        self._go_to_present()
        return Error.NONE

    # ---- writing ----

    def _resolve(self, address: int) -> int:
        """Follow an Indirect Data byte to the byte it stands for."""
        pointer = self._pointers.get(address)
        return address if pointer is None else self._get(pointer.name)

    def _check_write(self, address: int, data: bytes) -> tuple[Error, list[tuple[Item, int]]]:
        """Split a write into items with their new counts, and check each."""
        changes: list[tuple[Item, int]] = []
        place = 0
        while place < len(data):
            item = self._at.get(self._resolve(address + place)) if address + place < TABLE_SIZE else None
            if item is None:
                return Error.ACCESS, []
            targets = [self._resolve(address + place + k) for k in range(min(item.size, len(data) - place))]
            if targets != list(range(item.address, item.address + item.size)):
                return Error.DATA_LENGTH, []
            count = item.decode(data[place:])
            error = self._check(item, count)
            if error != Error.NONE:
                return error, []
            changes.append((item, count))
            place += item.size
        return (Error.NONE, changes) if data else (Error.DATA_LENGTH, [])

    def _check(self, item: Item, count: int) -> Error:
        if not item.writable or (item.in_eeprom and self._get("torque_enable")):
            return Error.ACCESS
        latched = self._get("bus_watchdog") < 0
        if latched and (item.name in _GOALS or (item.name == "bus_watchdog" and count != 0)):
            return Error.DATA_RANGE
        if item.name == "operating_mode":
            return Error.NONE if count in self.table.operating_modes else Error.DATA_RANGE
        if item.name == "goal_position" and self._get("operating_mode") != POSITION_MODE:
            return Error.NONE if abs(count) <= EXTENDED_RANGE else Error.DATA_RANGE
        if not self._bound(item.low) <= count <= self._bound(item.high):
            return Error.DATA_LIMIT if isinstance(item.high, str) else Error.DATA_RANGE
        return Error.NONE

    def _bound(self, bound: int | str | None) -> int:
        if isinstance(bound, str):
            return -self._get(bound[1:]) if bound.startswith("-") else self._get(bound)
        assert bound is not None, "every writable item has bounds"
        return bound

    def _apply(self, item: Item, count: int) -> None:
        name = item.name
        if name == "torque_enable":
            self._torque(bool(count))
            return
        changed = count != self._get(name)
        self._set(name, count)
        if name in _GOALS:
            self._take_goal(name)
        elif name == "operating_mode" and changed:
            self._enter_mode()
        elif name == "pwm_limit":
            self._set("goal_pwm", count)
        elif name == "current_limit":
            self._set("goal_current", count)
        elif name == "bus_watchdog":
            self._since_packet = 0.0
        elif name == "drive_mode" and changed:
            self._start_turn_count()
            self._go_to_present()

    def _take_goal(self, name: str) -> None:
        self._goal_given = True
        if name == "goal_position":
            self._profile_start = self.shaft.reference()[0]
        if self._get("drive_mode") & 8 and not self._get("torque_enable"):
            self._torque(True)

    def _torque(self, on: bool) -> None:
        if on and not self._get("torque_enable") and not self._shut_down:
            if self._get("operating_mode") == POSITION_MODE:
                self._start_turn_count()
            if not self._goal_given:
                self._go_to_present()
            self._since_packet = 0.0
            self._set("torque_enable", 1)
        elif not on:
            self._goal_given = False
            self._set("torque_enable", 0)

    def _enter_mode(self) -> None:
        for name in _GAINS:
            default = self.table[name].default
            assert isinstance(default, int)
            self._set(name, default)
        self._set("profile_velocity", 0)
        self._set("profile_acceleration", 0)
        self._set("goal_pwm", self._get("pwm_limit"))
        if self._has("goal_current"):
            self._set("goal_current", self._get("current_limit"))
        self._goal_given = False
        self._start_turn_count()
        self._go_to_present()

    # ---- position: turns, homing, direction ----

    def _update_frame(self) -> None:
        """Work out direction and offset of Present Position."""
        in_position_mode = self._get("operating_mode") == POSITION_MODE
        limit = HOMING_IN_POSITION_MODE if in_position_mode else EXTENDED_RANGE
        self._direction = -1 if self._get("drive_mode") & 1 else 1
        self._homing = max(-limit, min(limit, self._get("homing_offset")))

    def _raw_count(self, position: float) -> int:
        return self._direction * round(position / self._unit)

    def _start_turn_count(self) -> None:
        """Present Position becomes the absolute angle within one turn (plus Homing Offset)."""
        self._turns = self._raw_count(self.shaft.position) // TURN
        self._drive = None

    def _present(self, position: float) -> int:
        return self._raw_count(position) - TURN * self._turns + self._homing

    def _go_to_present(self) -> None:
        """Goals that ask for no motion."""
        self._set("goal_position", self._present(self.shaft.position))
        self._set("goal_velocity", 0)
        self._profile_start = self.shaft.reference()[0]

    # ---- motion ----

    def drive(self) -> Drive:
        """Return what the firmware asks of the motor."""
        if self._drive is None:
            self._drive = self._build_drive()
        return self._drive

    def _build_drive(self) -> Drive:
        si, get = self.table.per_count, self._get
        sign = self._direction
        goal = sign * (get("goal_position") - self._homing + TURN * self._turns) * self._unit
        velocity, acceleration = self._profile(goal)
        mode = get("operating_mode")
        pwm = get("goal_pwm") / 885
        return Drive(
            on=bool(get("torque_enable")) and not self.dead and self._silence <= 0.0,
            mode=mode,
            goal_position=goal,
            goal_velocity=sign * get("goal_velocity") * si("goal_velocity"),
            goal_current=sign * get("goal_current") * si("goal_current") if self._has("goal_current") else math.inf,
            goal_pwm=sign * pwm if mode == PWM_MODE else abs(pwm),
            position_gain=get("position_p_gain") * si("position_p_gain"),
            velocity_gain=get("velocity_p_gain") * si("velocity_p_gain"),
            velocity_integral_gain=get("velocity_i_gain") * si("velocity_i_gain"),
            profile_velocity=velocity,
            profile_acceleration=acceleration,
        )

    def _profile(self, goal: float) -> tuple[float, float]:
        """Profile velocity and acceleration in SI units; time-based profiles for the way to ``goal``."""
        velocity, acceleration = self._get("profile_velocity"), self._get("profile_acceleration")
        if not self._get("drive_mode") & 4:
            return velocity * self.table.per_count("profile_velocity"), acceleration * self.table.per_count(
                "profile_acceleration"
            )
        duration, ramp = velocity * 1e-3, min(acceleration, velocity / 2) * 1e-3
        way = abs(goal - self._profile_start)
        if duration == 0.0 or way == 0.0:
            return 0.0, 0.0
        speed = way / (duration - ramp)
        return speed, speed / ramp if ramp > 0.0 else 0.0

    def advance(self, step: float) -> None:
        """Let ``step`` seconds pass: clock, watchdog, temperature, hardware errors."""
        if self.dead:
            return
        self._clock += step
        if self._silence > 0.0:
            self._silence -= step
            self._drive = None
            return
        self._since_packet += step
        limit = self._get("bus_watchdog")
        if limit > 0 and self._get("torque_enable") and self._since_packet > limit * _WATCHDOG_UNIT:
            self._watchdog_stop()
        self._supervise(step)

    def _watchdog_stop(self) -> None:
        """The line went silent: stop, keep torque, latch."""
        self._set("bus_watchdog", -1)
        self._set("profile_velocity", 0)
        self._set("profile_acceleration", 0)
        self._go_to_present()
        mode = self._get("operating_mode")
        if mode == PWM_MODE:
            self._set("goal_pwm", 0)
        if mode == CURRENT_MODE:
            self._set("goal_current", 0)

    def _supervise(self, step: float) -> None:
        load = abs(self.shaft.load)
        equilibrium = AMBIENT + HEATING * load * load
        self._temperature += step * ((equilibrium - self._temperature) / THERMAL_TIME + self.heating_rate)
        self._overload_time = self._overload_time + step if load > OVERLOAD else 0.0
        error = 0
        if not self._get("min_voltage_limit") <= round(self.shaft.voltage * 10) <= self._get("max_voltage_limit"):
            error |= INPUT_VOLTAGE
        if self._temperature > self._get("temperature_limit"):
            error |= OVERHEATING
        if self._overload_time > OVERLOAD_TIME:
            error |= OVERLOADED
        if error:
            self.raise_error(error)

    def raise_error(self, error: int) -> None:
        """Set bits of Hardware Error Status, until the next reboot; shut down where Shutdown says so."""
        status = self._get("hardware_error_status") | error
        self._set("hardware_error_status", status)
        if status & self._get("shutdown") and not self._shut_down:
            self._shut_down = True
            self._torque(False)

    # ---- reading ----

    def _make_present_values(self) -> dict[str, Callable[[], int]]:
        """How to work out the items that the servo itself keeps up to date; done when they are read."""
        si, shaft = self.table.per_count, self.shaft
        effort = "present_current" if self._has("present_current") else "present_load"
        speed = si("present_velocity")
        return {
            "realtime_tick": lambda: int(self._clock * 1000 + 1e-6) % 32768,
            "present_pwm": lambda: self._direction * round(shaft.pwm * 885),
            effort: lambda: self._direction * shaft.effort,
            "present_velocity": lambda: self._direction * round(shaft.velocity / speed),
            "present_position": lambda: self._present(shaft.position),
            "velocity_trajectory": lambda: self._direction * round(shaft.reference()[1] / speed),
            "position_trajectory": lambda: self._present(shaft.reference()[0]),
            "present_input_voltage": lambda: max(0, round(shaft.voltage * 10)),
            "present_temperature": lambda: round(self._temperature),
            "moving": lambda: int(abs(round(shaft.velocity / speed)) > self._get("moving_threshold")),
            "moving_status": self._moving_status,
            "led": lambda: int(self._clock) % 2 if self._shut_down else self._get("led"),
        }

    def _refresh(self, item: Item) -> None:
        compute = self._present_values.get(item.name)
        if compute is not None:
            self._memory[item.address : item.address + item.size] = item.encode(compute())

    def _moving_status(self) -> int:
        if self._get("operating_mode") not in POSITION_MODES:
            return 0
        goal, present = self._get("goal_position"), self._present(self.shaft.position)
        reference = self._present(self.shaft.reference()[0])
        profile = 0 if self._get("profile_velocity") == 0 else 3 if self._get("profile_acceleration") else 1
        flags = (abs(goal - present) <= IN_POSITION, reference != goal, False, abs(reference - present) > IN_POSITION)
        return profile << 4 | sum(flag << bit for bit, flag in enumerate(flags))

    def set(self, name: str, count: int) -> None:
        """Put a count into an item past all access rules (for tests and faults).

        Raises:
            InputError: unknown item, or a count that does not fit.
        """
        item = self.table[name]
        if item.decode(item.encode(count)) != count:
            raise InputError(f"{name} = {count} does not fit")
        self._set(name, count)
