"""One emulated servo: what its firmware does with instructions and time.

:class:`Registers` is its control table, :class:`Health` what it watches about itself. No motion here:
:meth:`EmulatedServo.drive` is what the firmware asks of the motor, and :class:`Shaft` what the physics made of it, both in the
encoder's own frame. Source: ROBOTIS e-manual; where it is silent, docs/emulator.md lists what was chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from wlr_gym.hardware.dynamixel.protocol import ALERT, CLEAR_TURNS, Error
from wlr_gym.hardware.dynamixel.tables import (
    BAUD_RATES,
    CURRENT_MODE,
    POSITION_MODE,
    POSITION_MODES,
    PWM_MODE,
    ControlTable,
    Item,
)
from wlr_gym.hardware.emulator.health import Health
from wlr_gym.hardware.emulator.motion import TIME_BASED, EncoderFrame, MotorDrive, Shaft, ShaftEncoder, motor_drive
from wlr_gym.hardware.emulator.registers import GOAL_REGISTERS, Registers

# Not in the e-manual: chosen.
#: Version the servos report.
FIRMWARE = 45
#: Time during which a rebooting servo does not answer, s.
BOOT_TIME = 0.3
#: Distance from Goal Position that counts as arrived, counts.
IN_POSITION = 16

#: Highest temperature that its register holds, degC.
HOTTEST = 255
#: One count of Bus Watchdog, s.
_WATCHDOG_UNIT = 0.02
_KEPT = {0xFF: (), 0x01: ("id",), 0x02: ("id", "baud_rate")}


class EmulatedServo:
    """One servo.

    Args:
        name: what faults and reports call it.
        table: its control table.
        eeprom: what its EEPROM holds beyond the factory defaults, in counts.
        firmware: version it reports; fast reads need 45.

    Attributes:
        registers: its control table's content.
        shaft: written by the physics before :meth:`advance`.
        encoder: what it sees of the shaft.
        health: temperature and load.
        dead: no power at the electronics: silent, motor off.
        set, read: see :class:`Registers`.
    """

    def __init__(self, name: str, table: ControlTable, eeprom: Mapping[str, int], firmware: int = FIRMWARE) -> None:
        self.name = name
        self.table = table
        self.firmware = firmware
        self.shaft: Shaft = Shaft(voltage=table.supply)
        self.encoder: ShaftEncoder = ShaftEncoder()
        self.health: Health = Health()
        self.dead = False
        self._drive: MotorDrive | None = None
        self._frame = EncoderFrame(table)
        self.registers: Registers = Registers(table, self._make_present_values(), self._register_changed)
        self._get = self.registers.get
        self.set = self.registers.set
        self.read = self.registers.read
        self._load_eeprom()
        for item_name, count in eeprom.items():
            self.set(item_name, count)
        self.boot(0.0)

    def __getitem__(self, name: str) -> int:
        """Return the count an item holds now."""
        return self.registers[name]

    def _register_changed(self, name: str) -> None:
        self._drive = None
        if name in EncoderFrame.ITEMS:
            self._frame.update(self.registers)

    # ---- resets ----

    def _load_eeprom(self) -> None:
        self.registers.load_defaults(in_eeprom=True)
        self.set("firmware_version", self.firmware)

    def boot(self, silence: float = BOOT_TIME, *, keep_clock: bool = False) -> None:
        """Start the firmware: RAM to its defaults, latches cleared, torque as Startup Configuration says.

        Args:
            silence: s during which it does not answer.
            keep_clock: Realtime Tick goes on.
        """
        self.registers.load_defaults(in_eeprom=False)
        self.health.reboot()
        self._registered = None
        self._clock = self._clock if keep_clock else 0.0
        self._silence = silence
        self._since_packet = 0.0
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
        self._load_eeprom()
        for name, count in kept.items():
            self.set(name, count)
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

    def write(self, address: int, data: bytes) -> Error:
        """Write bytes; either all of it acts or nothing does."""
        error, changes = self.registers.check_write(address, data)
        if error == Error.NONE:
            for item, count in changes:
                self._apply(item, count)
        return error

    def register(self, address: int, data: bytes) -> Error:
        """Keep a write back until :meth:`action`."""
        error, _ = self.registers.check_write(address, data)
        if error == Error.NONE:
            self._registered = (address, data)
            self.set("registered_instruction", 1)
        return error

    def action(self) -> Error:
        """Carry out the registered write."""
        if self._registered is None:
            return Error.INSTRUCTION
        address, data = self._registered
        self._registered = None
        self.set("registered_instruction", 0)
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

    def _apply(self, item: Item, count: int) -> None:
        name = item.name
        if name == "torque_enable":
            self._torque(bool(count))
            return
        changed = count != self._get(name)
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
            self._start_turn_count()
            self._go_to_present()

    def _take_goal(self, name: str) -> None:
        self._goal_given = True
        if name == "goal_position" and self._get("drive_mode") & TIME_BASED:  # a new mode asks by itself
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
        self.set("goal_pwm", self._get("pwm_limit"))
        if "goal_current" in self.table.items:
            self.set("goal_current", self._get("current_limit"))
        self._goal_given = False
        self._start_turn_count()
        self._go_to_present()

    def _start_turn_count(self) -> None:
        """Present Position becomes the absolute angle within one turn (plus Homing Offset)."""
        self._frame.start_turn_count(self.shaft.position)
        self._drive = None

    def _go_to_present(self) -> None:
        """Setpoints that ask for no motion."""
        self.set("goal_position", self._frame.count(self.shaft.position))
        self.set("goal_velocity", 0)
        self._profile_start = self.shaft.reference()[0]

    # ---- motion ----

    def drive(self) -> MotorDrive:
        """Return what the firmware asks of the motor."""
        if self._drive is None:
            powered = not self.dead and self._silence <= 0.0
            self._drive = motor_drive(self.registers, self._frame, self._profile_start, powered)
        return self._drive

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
        if error := self.health.advance(step, self.shaft, self._get, self.table.counts.voltage):
            self.raise_error(error)

    def pause(self, duration: float) -> None:
        """Let the clock alone go on, by ``duration`` s."""
        self._clock += duration

    def _watchdog_stop(self) -> None:
        """The line went silent: stop, keep torque, latch."""
        self.set("bus_watchdog", -1)
        self.set("profile_velocity", 0)
        self.set("profile_acceleration", 0)
        self._go_to_present()
        mode = self._get("operating_mode")
        if mode == PWM_MODE:
            self.set("goal_pwm", 0)
        if mode == CURRENT_MODE:
            self.set("goal_current", 0)

    def raise_error(self, error: int) -> None:
        """Set bits of Hardware Error Status, until the next reboot; shut down where Shutdown says so."""
        status = self._get("hardware_error_status") | error
        self.set("hardware_error_status", status)
        if status & self._get("shutdown") and not self._shut_down:
            self._shut_down = True
            self._torque(False)

    # ---- reading ----

    def _make_present_values(self) -> dict[str, Callable[[], int]]:
        """How to work out the items that the servo itself keeps up to date; done when they are read."""
        si, shaft = self.table.per_count, self.shaft
        effort, full_pwm = self.table.effort, self.table.counts.full_pwm
        speed, volt = si("present_velocity"), self.table.counts.voltage
        return {
            "realtime_tick": lambda: int(self._clock * 1000 + 1e-6) % 32768,
            "present_pwm": lambda: self._frame.direction * round(shaft.output()[1] * full_pwm),
            effort: lambda: self._frame.direction * shaft.output()[0],
            "present_velocity": lambda: self._frame.direction * round(shaft.velocity / speed),
            "present_position": lambda: self._frame.count(shaft.position),
            "velocity_trajectory": lambda: self._frame.direction * round(shaft.reference()[1] / speed),
            "position_trajectory": lambda: self._frame.count(shaft.reference()[0]),
            "present_input_voltage": lambda: max(0, round(shaft.voltage / volt)),
            "present_temperature": lambda: min(round(self.health.temperature), HOTTEST),
            "moving": lambda: int(abs(round(shaft.velocity / speed)) > self._get("moving_threshold")),
            "moving_status": self._moving_status,
            "led": lambda: int(self._clock) % 2 if self._shut_down else self._get("led"),
        }

    def _moving_status(self) -> int:
        if self._get("operating_mode") not in POSITION_MODES:
            return 0
        goal, present = self._get("goal_position"), self._frame.count(self.shaft.position)
        reference = self._frame.count(self.shaft.reference()[0])
        profile = 0 if self._get("profile_velocity") == 0 else 3 if self._get("profile_acceleration") else 1
        flags = (abs(goal - present) <= IN_POSITION, reference != goal, False, abs(reference - present) > IN_POSITION)
        return profile << 4 | sum(flag << bit for bit, flag in enumerate(flags))
