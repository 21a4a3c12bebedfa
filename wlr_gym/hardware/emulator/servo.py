"""One emulated servo: its control table, what its firmware does with instructions and time, what it asks of the motor.

No motion here: :class:`MotorDrive` is what the firmware asks of the motor, and :class:`Shaft` what the physics made of it. Both
are in the encoder's own frame: radians from count 0, positive as the encoder counts, before Drive Mode, turn counting and
Homing Offset; :class:`EncoderFrame` turns that into Present Position. Source: ROBOTIS e-manual; where it is silent,
docs/emulator.md lists what was chosen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from wlr_gym.hardware.dynamixel.protocol import ALERT, CLEAR_TURNS, Error
from wlr_gym.hardware.dynamixel.tables import (
    BAUD_RATES,
    CURRENT_MODE,
    INPUT_VOLTAGE,
    OVERHEATING,
    OVERLOAD,
    POSITION_MODE,
    POSITION_MODES,
    PWM_MODE,
    TABLE_SIZE,
    ControlTable,
    Item,
)

# Not in the e-manual: chosen.
#: Version the servos report.
FIRMWARE = 45
#: Time during which a rebooting servo does not answer, s.
BOOT_TIME = 0.3
#: Distance from Goal Position that counts as arrived, counts.
IN_POSITION = 16
#: Part of a turn by which Homing Offset acts in position mode.
HOMING_IN_POSITION_MODE = 0.25
#: Temperature of a servo that does nothing, and above that in a lasting stall, degC; time constant, s.
AMBIENT, HEATING, THERMAL_TIME = 25.0, 150.0, 120.0
#: Part of the stall torque that trips the servo, and after what time, s.
LARGEST_LOAD, OVERLOAD_TIME = 0.8, 2.0

GOAL_REGISTERS = ("goal_pwm", "goal_current", "goal_velocity", "goal_position")
#: Bit of Drive Mode: profiles say how long a way takes, not how fast it is.
TIME_BASED = 4
#: Highest temperature that its register holds, degC.
HOTTEST = 255
#: One count of Bus Watchdog, s.
_WATCHDOG_UNIT = 0.02


class Registers:
    """Items of a control table.

    Args:
        table: of the servo's model.
        present: item -> works out its count; done when the item is read.

    Attributes:
        memory: the bytes.
        get: item -> the count it was set to last.
    """

    def __init__(self, table: ControlTable, present: Mapping[str, Callable[[], int]]) -> None:
        self.table = table
        self.memory: bytearray = bytearray(TABLE_SIZE)
        self._present = present
        items = table.items.values()
        self._counts = dict.fromkeys(table.items, 0)  # of items that are set; set alone writes it
        self.get: Callable[[str], int] = self._counts.__getitem__
        self._at = {item.address + k: item for item in items for k in range(item.size)}
        self._pointers = {
            item.address: table[name.replace("data", "address")]
            for name, item in table.items.items()
            if name.startswith("indirect_data")
        }
        # Block -> items to work out before it is read, addresses of the bytes it stands for; until a pointer is written.
        self._plans: dict[tuple[int, int], tuple[list[Item], list[int]]] = {}

    # ---- by name ----

    def __getitem__(self, name: str) -> int:
        """Return the count an item holds now."""
        item = self.table[name]
        return self._refresh(item) if name in self._present else self.get(name)

    def set(self, name: str, count: int) -> None:
        """Put a count into an item past all access rules.

        Raises:
            InputError: unknown item, or a count that does not fit.
        """
        item = self.table[name]
        self.memory[item.address : item.address + item.size] = item.encode(count)
        self._counts[name] = int(count)
        if name.startswith("indirect_address"):
            self._plans.clear()
        self._changed(name)

    def _changed(self, name: str) -> None:
        """Take note that an item's count was set."""

    def load_defaults(self, in_eeprom: bool) -> None:
        """Set the items of the EEPROM, or of the RAM, to their defaults."""
        items = [item for item in self.table.items.values() if item.in_eeprom == in_eeprom]
        for item in sorted(items, key=lambda item: isinstance(item.default, str)):  # a copy comes after what it copies
            self.set(item.name, self.get(item.default) if isinstance(item.default, str) else item.default or 0)

    # ---- by address ----

    def read(self, address: int, length: int) -> tuple[Error, bytes]:
        """Return ``length`` bytes from ``address``; gaps read as 0."""
        if length == 0 or address + length > TABLE_SIZE:
            return Error.ACCESS, b""
        if (address, length) not in self._plans:
            places = [self._resolve(place) for place in range(address, address + length)]
            inside = [item for place in places if (item := self._at.get(place)) and item.name in self._present]
            self._plans[address, length] = list(dict.fromkeys(inside)), places
        kept_up, places = self._plans[address, length]
        for item in kept_up:
            self._refresh(item)
        return Error.NONE, bytes([self.memory[place] for place in places])

    def _refresh(self, item: Item) -> int:
        """Work an item out that the servo keeps up to date; return its count."""
        count = self._present[item.name]()
        self.memory[item.address : item.address + item.size] = item.encode(count)
        return count

    def _resolve(self, address: int) -> int:
        """Follow an Indirect Data byte to the byte it stands for."""
        pointer = self._pointers.get(address)
        return address if pointer is None else self.get(pointer.name)

    def check_write(self, address: int, data: bytes) -> tuple[Error, list[tuple[Item, int]]]:
        """Split a write into items with their new counts, and check each; nothing is written."""
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
        if not item.writable or (item.in_eeprom and self.get("torque_enable")):
            return Error.ACCESS
        latched = self.get("bus_watchdog") < 0
        if latched and (item.name in GOAL_REGISTERS or (item.name == "bus_watchdog" and count != 0)):
            return Error.DATA_RANGE
        if item.name == "operating_mode":
            return Error.NONE if count in self.table.operating_modes else Error.DATA_RANGE
        if item.name == "goal_position" and self.get("operating_mode") != POSITION_MODE:
            return Error.NONE if abs(count) <= self.table.extended_range else Error.DATA_RANGE
        if not self._bound(item.low) <= count <= self._bound(item.high):
            return Error.DATA_LIMIT if isinstance(item.high, str) else Error.DATA_RANGE
        return Error.NONE

    def _bound(self, bound: int | str | None) -> int:
        if isinstance(bound, str):
            return -self.get(bound[1:]) if bound.startswith("-") else self.get(bound)
        assert bound is not None, "every writable item has bounds"
        return bound


@dataclass
class Shaft:
    """What the physics hands to a servo each tick."""

    position: float = 0.0  #: rad from encoder count 0, as the encoder says
    velocity: float = 0.0  #: rad/s, as the encoder says
    true_position: float = 0.0
    true_velocity: float = 0.0
    load: float = 0.0  #: motor torque over stall torque, 0 to about 1
    voltage: float = 12.0  #: V at the servo
    #: Asks for the counts of Present Current or Present Load, and for the part of the supply on the motor, -1 to 1.
    output: Callable[[], tuple[int, float]] = lambda: (0, 0.0)
    reference: Callable[[], tuple[float, float]] = lambda: (0.0, 0.0)  #: asks where the profile generator stands: rad, rad/s
    # Faults of the encoder: what it says, also to the servo's own control loop.
    offset: float = 0.0  #: rad that the reading is off
    gain: float = 1.0  #: part of the motion that is counted; 0 = frozen, -1 = backwards
    drift: float = 0.0  #: rad/s by which the reading runs away
    missed: float = 0.0  #: rad that gain and drift have made of it so far
    # Faults of motor and current sensor.
    strength: float = 1.0  #: part of the supply that reaches the motor; -1 = its wires are swapped
    stuck: int | None = None  #: counts of current or load that are repeated; None = they are measured

    @property
    def is_well(self) -> bool:
        """Whether the encoder says what is, and the motor gets what it should."""
        return (self.offset, self.gain, self.drift, self.strength) == (0.0, 1.0, 0.0, 1.0)

    def move(self, position: float, velocity: float, step: float) -> None:
        """Take what the physics made of the shaft in ``step`` s, rad and rad/s."""
        missed = self.missed + (self.gain - 1.0) * (position - self.true_position) + self.drift * step
        self.missed = 0.0 if self.is_well else missed
        self.true_position, self.true_velocity = position, velocity
        self.position, self.velocity = position + self.offset + self.missed, self.gain * velocity + self.drift


@dataclass(frozen=True)
class MotorDrive:
    """What the firmware asks of the motor: SI units, encoder frame."""

    on: bool  #: torque
    mode: int  #: Operating Mode
    goal_position: float  #: rad
    goal_velocity: float  #: rad/s
    goal_current: float  #: A; limit of the current in current-based position mode
    goal_pwm: float  #: part of the supply; limit of the output in every mode but PWM mode
    position_gain: float  #: V/rad on the position error
    velocity_gain: float  #: V s/rad on the velocity error
    velocity_integral_gain: float  #: V/rad on the integral of the velocity error
    profile_velocity: float  #: rad/s; 0 = none
    profile_acceleration: float  #: rad/s2; 0 = none


class EncoderFrame:
    """From the encoder's frame to Present Position: direction, turns counted, Homing Offset.

    Attributes:
        direction: 1, or -1 where Drive Mode reverses it.
    """

    #: Items that decide what Present Position counts from, and which way.
    ITEMS = ("drive_mode", "operating_mode", "homing_offset")

    def __init__(self, table: ControlTable) -> None:
        self.direction = 1
        self._unit, self._turn = table.per_count("present_position"), table.counts.turn
        self._homing_limits = round(HOMING_IN_POSITION_MODE * self._turn), table.extended_range
        self._homing = 0
        self._turns = 0

    def update(self, registers: Registers) -> None:
        """Take direction and offset from :attr:`ITEMS`."""
        in_position_mode = registers.get("operating_mode") == POSITION_MODE
        limit = self._homing_limits[0 if in_position_mode else 1]
        self.direction = -1 if registers.get("drive_mode") & 1 else 1
        self._homing = max(-limit, min(limit, registers.get("homing_offset")))

    def start_turn_count(self, position: float) -> None:
        """Present Position becomes the absolute angle within one turn (plus Homing Offset)."""
        self._turns = self._raw_count(position) // self._turn

    def count(self, position: float) -> int:
        """Return Present Position at a position (rad)."""
        return self._raw_count(position) - self._turn * self._turns + self._homing

    def position(self, count: int) -> float:
        """Return the position (rad) of a Goal Position."""
        return self.direction * (count - self._homing + self._turn * self._turns) * self._unit

    def _raw_count(self, position: float) -> int:
        return self.direction * round(position / self._unit)


class EmulatedServo(Registers):
    """One servo: its registers, and the firmware that works with them.

    Args:
        name: what faults and reports call it.
        table: its control table.
        eeprom: what its EEPROM holds beyond the factory defaults, in counts.
        firmware: version it reports; fast reads need 45.

    Attributes:
        shaft: written by the physics before :meth:`advance`.
        temperature: degC; a reboot does not cool the motor. heating_rate: degC/s that a fault adds.
        dead: no power at the electronics: silent, motor off.
        is_worn: its EEPROM keeps nothing that is written: a fault.
    """

    def __init__(self, name: str, table: ControlTable, eeprom: Mapping[str, int], firmware: int = FIRMWARE) -> None:
        self.name = name
        self.firmware = firmware
        self.shaft: Shaft = Shaft(voltage=table.supply)
        self.temperature, self.heating_rate = AMBIENT, 0.0
        self.dead = self.is_worn = False
        self._drive: MotorDrive | None = None
        self._frame = EncoderFrame(table)
        super().__init__(table, self._make_present_values(table))
        self.load_defaults(in_eeprom=True)
        for item_name, count in {"firmware_version": firmware, **eeprom}.items():
            self.set(item_name, count)
        self.boot(0.0)

    def _changed(self, name: str) -> None:
        self._drive = None
        if name in EncoderFrame.ITEMS:
            self._frame.update(self)

    # ---- resets ----

    def boot(self, silence: float = BOOT_TIME, *, keep_clock: bool = False) -> None:
        """Start the firmware: RAM to its defaults, latches cleared, torque as Startup Configuration says.

        Args:
            silence: s during which it does not answer.
            keep_clock: Realtime Tick goes on.
        """
        self.load_defaults(in_eeprom=False)
        self._overload_time = 0.0
        self._clock = self._clock if keep_clock else 0.0
        self._silence = silence
        self._since_packet = 0.0
        self._shut_down = False
        self._goal_given = False
        self._recount()
        if self.get("startup_configuration") & 1:
            self._torque(True)

    # ---- the line's view ----

    @property
    def answers(self) -> bool:
        """Whether it is powered, booted and speaking Protocol 2."""
        return not self.dead and self._silence <= 0.0 and self.get("protocol_type") == 2

    @property
    def baud_rate(self) -> int:
        """Bits per second."""
        return BAUD_RATES[self.get("baud_rate")]

    @property
    def alert(self) -> int:
        """Alert bit of the status packets."""
        return ALERT if self.get("hardware_error_status") else 0

    def set_power(self, on: bool) -> None:
        """Take the power away, or give it back (then :meth:`boot` it)."""
        if self.dead == on:
            self.dead = not on
            self._drive = None

    def hear(self) -> None:
        """An instruction packet, to whomever, was seen on the line: feeds the Bus Watchdog."""
        self._since_packet = 0.0

    def write(self, address: int, data: bytes) -> Error:
        """Write bytes; either all of it acts or nothing does."""
        error, changes = self.check_write(address, data)
        if error == Error.NONE:
            for item, count in changes:
                self._apply(item, count)
        return error

    def clear(self, parameters: bytes) -> Error:
        """Bring Present Position back into one turn; refused while moving."""
        if parameters != CLEAR_TURNS:
            return Error.DATA_RANGE
        if self["moving"]:
            return Error.RESULT_FAIL
        self._recount()
        return Error.NONE

    # ---- writing ----

    def _apply(self, item: Item, count: int) -> None:
        name = item.name
        if item.in_eeprom and self.is_worn:
            return
        if name == "torque_enable":
            self._torque(bool(count))
            return
        changed = count != self.get(name)
        self.set(name, count)
        if name in GOAL_REGISTERS:
            self._take_goal(name)
        elif name == "operating_mode" and changed:
            self._enter_mode()
        elif name == "pwm_limit":
            self.set("goal_pwm", count)
        elif name == "current_limit":
            self.set("goal_current", count)
        elif name == "bus_watchdog":
            self._since_packet = 0.0
        elif name == "drive_mode" and changed:
            self._recount()

    def _take_goal(self, name: str) -> None:
        self._goal_given = True
        if name == "goal_position" and self.get("drive_mode") & TIME_BASED:  # a new mode asks by itself
            self._profile_start = self.shaft.reference()[0]
        if self.get("drive_mode") & 8 and not self.get("torque_enable"):
            self._torque(True)

    def _torque(self, on: bool) -> None:
        if on and not self.get("torque_enable") and not self._shut_down:
            if self.get("operating_mode") == POSITION_MODE:
                self._start_turn_count()
            if not self._goal_given:
                self._go_to_present()
            self._since_packet = 0.0
            self.set("torque_enable", 1)
        elif not on:
            self._goal_given = False
            self.set("torque_enable", 0)

    def _enter_mode(self) -> None:
        for name, item in self.table.items.items():
            if name.endswith("_gain") and isinstance(item.default, int):
                self.set(name, item.default)
        self.set("profile_velocity", 0)
        self.set("profile_acceleration", 0)
        self.set("goal_pwm", self.get("pwm_limit"))
        if "goal_current" in self.table.items:
            self.set("goal_current", self.get("current_limit"))
        self._goal_given = False
        self._recount()

    def _start_turn_count(self) -> None:
        """Present Position becomes the absolute angle within one turn (plus Homing Offset)."""
        self._frame.start_turn_count(self.shaft.position)
        self._drive = None

    def _recount(self) -> None:
        """Count turns from here, and ask for no motion."""
        self._start_turn_count()
        self._go_to_present()

    def _go_to_present(self) -> None:
        """Setpoints that ask for no motion."""
        self.set("goal_position", self._frame.count(self.shaft.position))
        self.set("goal_velocity", 0)
        self._profile_start = self.shaft.reference()[0]

    # ---- motion ----

    def drive(self) -> MotorDrive:
        """Return what the firmware asks of the motor."""
        if self._drive is None:
            si, get, sign = self.table.per_count, self.get, self._frame.direction
            mode, goal = get("operating_mode"), self._frame.position(get("goal_position"))
            pwm = get("goal_pwm") / self.table.counts.full_pwm
            has_current = "goal_current" in self.table.items
            velocity, acceleration = self._profile(abs(goal - self._profile_start))
            self._drive = MotorDrive(
                on=bool(get("torque_enable")) and not self.dead and self._silence <= 0.0,
                mode=mode,
                goal_position=goal,
                goal_velocity=sign * get("goal_velocity") * si("goal_velocity"),
                goal_current=sign * get("goal_current") * si("goal_current") if has_current else math.inf,
                goal_pwm=sign * pwm if mode == PWM_MODE else abs(pwm),
                position_gain=get("position_p_gain") * si("position_p_gain"),
                velocity_gain=get("velocity_p_gain") * si("velocity_p_gain"),
                velocity_integral_gain=get("velocity_i_gain") * si("velocity_i_gain"),
                profile_velocity=velocity,
                profile_acceleration=acceleration,
            )
        return self._drive

    def _profile(self, way: float) -> tuple[float, float]:
        """Profile velocity and acceleration in SI units; time-based profiles for the ``way`` (rad) to the goal."""
        velocity, acceleration = self.get("profile_velocity"), self.get("profile_acceleration")
        if not self.get("drive_mode") & TIME_BASED:
            si = self.table.per_count
            return velocity * si("profile_velocity"), acceleration * si("profile_acceleration")
        duration, ramp = velocity * 1e-3, min(acceleration, velocity / 2) * 1e-3
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
        limit = self.get("bus_watchdog")
        if limit > 0 and self.get("torque_enable") and self._since_packet > limit * _WATCHDOG_UNIT:
            self._watchdog_stop()
        if error := self._watch_itself(step):
            self.raise_error(error)

    def _watch_itself(self, step: float) -> int:
        """Let temperature and overload go on by ``step`` s; return the bits of Hardware Error Status that hold now."""
        load = abs(self.shaft.load)
        equilibrium = AMBIENT + HEATING * load * load
        self.temperature += step * ((equilibrium - self.temperature) / THERMAL_TIME + self.heating_rate)
        self._overload_time = self._overload_time + step if load > LARGEST_LOAD else 0.0
        error, supply = 0, round(self.shaft.voltage / self.table.counts.voltage)
        if not self.get("min_voltage_limit") <= supply <= self.get("max_voltage_limit"):
            error |= INPUT_VOLTAGE
        if self.temperature > self.get("temperature_limit"):
            error |= OVERHEATING
        if self._overload_time > OVERLOAD_TIME:
            error |= OVERLOAD
        return error

    def pause(self, duration: float) -> None:
        """Let the clock alone go on, by ``duration`` s."""
        self._clock += duration

    def _watchdog_stop(self) -> None:
        """The line went silent: stop, keep torque, latch."""
        self.set("bus_watchdog", -1)
        self.set("profile_velocity", 0)
        self.set("profile_acceleration", 0)
        self._go_to_present()
        mode = self.get("operating_mode")
        if mode == PWM_MODE:
            self.set("goal_pwm", 0)
        if mode == CURRENT_MODE:
            self.set("goal_current", 0)

    def raise_error(self, error: int) -> None:
        """Set bits of Hardware Error Status, until the next reboot; shut down where Shutdown says so."""
        status = self.get("hardware_error_status") | error
        self.set("hardware_error_status", status)
        if status & self.get("shutdown") and not self._shut_down:
            self._shut_down = True
            self._torque(False)

    # ---- reading ----

    def _make_present_values(self, table: ControlTable) -> dict[str, Callable[[], int]]:
        """How to work out the items that the servo itself keeps up to date; done when they are read."""
        shaft, speed = self.shaft, table.per_count("present_velocity")
        volt, full_pwm = table.counts.voltage, table.counts.full_pwm
        return {
            "realtime_tick": lambda: int(self._clock * 1000 + 1e-6) % 32768,
            "present_pwm": lambda: self._frame.direction * round(shaft.output()[1] * full_pwm),
            table.effort: lambda: shaft.stuck if shaft.stuck is not None else self._frame.direction * shaft.output()[0],
            "present_velocity": lambda: self._frame.direction * round(shaft.velocity / speed),
            "present_position": lambda: self._frame.count(shaft.position),
            "velocity_trajectory": lambda: self._frame.direction * round(shaft.reference()[1] / speed),
            "position_trajectory": lambda: self._frame.count(shaft.reference()[0]),
            "present_input_voltage": lambda: max(0, round(shaft.voltage / volt)),
            "present_temperature": lambda: min(round(self.temperature), HOTTEST),
            "moving": lambda: int(abs(round(shaft.velocity / speed)) > self.get("moving_threshold")),
            "moving_status": self._moving_status,
            "led": lambda: int(self._clock) % 2 if self._shut_down else self.get("led"),
        }

    def _moving_status(self) -> int:
        if self.get("operating_mode") not in POSITION_MODES:
            return 0
        goal, present = self.get("goal_position"), self._frame.count(self.shaft.position)
        reference = self._frame.count(self.shaft.reference()[0])
        profile = 0 if self.get("profile_velocity") == 0 else 3 if self.get("profile_acceleration") else 1
        flags = (abs(goal - present) <= IN_POSITION, reference != goal, False, abs(reference - present) > IN_POSITION)
        return profile << 4 | sum(flag << bit for bit, flag in enumerate(flags))
