"""What an emulated servo's firmware asks of the motor, and what the physics hands back.

Everything is in the encoder's own frame: radians from count 0, positive as the encoder counts, before Drive Mode, turn counting
and Homing Offset; :class:`EncoderFrame` turns that into Present Position.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from wlr_gym.hardware.dynamixel.tables import POSITION_MODE, PWM_MODE, ControlTable
from wlr_gym.hardware.emulator.registers import Registers

#: Part of a turn by which Homing Offset acts in position mode.
HOMING_IN_POSITION_MODE = 0.25
#: Bit of Drive Mode: profiles say how long a way takes, not how fast it is.
TIME_BASED = 4


@dataclass
class Shaft:
    """What the physics hands to a servo each tick.

    Attributes:
        position, velocity: rad from encoder count 0, rad/s, as the encoder says.
        true_position, true_velocity: as it is.
        load: motor torque over stall torque, 0 to about 1.
        voltage: V at the servo.
        output: asks for the counts of Present Current or Present Load, and for the part of the supply on the motor, -1 to 1.
        reference: asks where the profile generator stands: rad and rad/s.
    """

    position: float = 0.0
    velocity: float = 0.0
    true_position: float = 0.0
    true_velocity: float = 0.0
    load: float = 0.0
    voltage: float = 12.0
    output: Callable[[], tuple[int, float]] = lambda: (0, 0.0)
    reference: Callable[[], tuple[float, float]] = lambda: (0.0, 0.0)


class ShaftEncoder:
    """What a servo's encoder says of its shaft.

    Attributes:
        offset: rad that it is off. is_frozen: it repeats its reading.
    """

    def __init__(self) -> None:
        self.offset = 0.0
        self.is_frozen = False
        self._position = 0.0

    @property
    def is_true(self) -> bool:
        """Whether it says what is."""
        return self.offset == 0.0 and not self.is_frozen

    def read(self, position: float, velocity: float) -> tuple[float, float]:
        """Return position (rad) and velocity (rad/s) as the firmware sees them."""
        if self.is_frozen:
            return self._position, 0.0
        self._position = position + self.offset
        return self._position, velocity


@dataclass(frozen=True)
class MotorDrive:
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


class EncoderFrame:
    """From the encoder's frame to Present Position: direction, turns counted, Homing Offset.

    Args:
        table: of the servo.

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


def motor_drive(registers: Registers, frame: EncoderFrame, profile_start: float, is_powered: bool) -> MotorDrive:
    """Return what the firmware asks of the motor.

    Args:
        registers: of the servo.
        frame: of its encoder.
        profile_start: rad, where the way to the goal began.
        is_powered: the electronics work.
    """
    si, get = registers.table.per_count, registers.get
    sign = frame.direction
    goal = frame.position(get("goal_position"))
    velocity, acceleration = _profile(registers, abs(goal - profile_start))
    mode = get("operating_mode")
    pwm = get("goal_pwm") / registers.table.counts.full_pwm
    has_current = "goal_current" in registers.table.items
    return MotorDrive(
        on=bool(get("torque_enable")) and is_powered,
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


def _profile(registers: Registers, way: float) -> tuple[float, float]:
    """Profile velocity and acceleration in SI units; time-based profiles for the ``way`` (rad) to the goal."""
    velocity, acceleration = registers.get("profile_velocity"), registers.get("profile_acceleration")
    if not registers.get("drive_mode") & TIME_BASED:
        si = registers.table.per_count
        return velocity * si("profile_velocity"), acceleration * si("profile_acceleration")
    duration, ramp = velocity * 1e-3, min(acceleration, velocity / 2) * 1e-3
    if duration == 0.0 or way == 0.0:
        return 0.0, 0.0
    speed = way / (duration - ramp)
    return speed, speed / ramp if ramp > 0.0 else 0.0
