"""What an emulated servo watches about itself: supply, temperature, load. The numbers are chosen: the e-manual has none."""

from __future__ import annotations

from collections.abc import Callable

from wlr_gym.hardware.dynamixel.tables import INPUT_VOLTAGE, OVERHEATING, OVERLOAD
from wlr_gym.hardware.emulator.motion import Shaft

#: Temperature of a servo that does nothing, degC.
AMBIENT = 25.0
#: Temperature above ambient in a lasting stall, degC.
HEATING = 150.0
#: Time constant of the temperature, s.
THERMAL_TIME = 120.0
#: Part of the stall torque that trips the servo ...
LARGEST_LOAD = 0.8
#: ... after this time, s.
OVERLOAD_TIME = 2.0


class Health:
    """Temperature and overload of one servo.

    Attributes:
        temperature: degC; a reboot does not cool the motor.
        heating_rate: degC/s that a fault adds. strength: part of the supply that reaches the motor.
    """

    def __init__(self) -> None:
        self.temperature = AMBIENT
        self.heating_rate: float = 0.0
        self.strength: float = 1.0
        self._overload_time = 0.0

    def reboot(self) -> None:
        """Forget how long the overload has lasted."""
        self._overload_time = 0.0

    def advance(self, step: float, shaft: Shaft, limit: Callable[[str], int], volt: float) -> int:
        """Let ``step`` seconds pass; return the bits of Hardware Error Status that hold now.

        Args:
            step: s.
            shaft: load and supply.
            limit: item name -> count.
            volt: V per count of the supply.
        """
        load = abs(shaft.load)
        equilibrium = AMBIENT + HEATING * load * load
        self.temperature += step * ((equilibrium - self.temperature) / THERMAL_TIME + self.heating_rate)
        self._overload_time = self._overload_time + step if load > LARGEST_LOAD else 0.0
        error = 0
        if not limit("min_voltage_limit") <= round(shaft.voltage / volt) <= limit("max_voltage_limit"):
            error |= INPUT_VOLTAGE
        if self.temperature > limit("temperature_limit"):
            error |= OVERHEATING
        if self._overload_time > OVERLOAD_TIME:
            error |= OVERLOAD
        return error
