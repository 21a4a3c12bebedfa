"""The robot's safety limits: the ``safety`` section of ``configs/hardware/*.yaml``."""

from __future__ import annotations

from typing import Any

from pydantic import Field, ValidationError, ValidationInfo, ValidatorFunctionWrapHandler, field_validator, model_validator
from pydantic_core import PydanticCustomError

from wlr_gym.base.errors import InputError
from wlr_gym.base.refusals import expected
from wlr_gym.base.settings import SettingsModel


def _limit(default: float | None, unit: str, *, le: float, **low: Any) -> Any:
    """Return the field of a limit; ``le`` is far above what anyone sets on purpose: a value beyond it has another unit."""
    return Field(default=default, le=le, json_schema_extra={"unit": unit}, **low)


#: s: longest silence of the operator that may be allowed.
LONGEST_DEADMAN = 10.0


class SafetyLimits(SettingsModel):
    """Limits of a robot, SI units; the reasons stand in ``configs/hardware/nominal.yaml``.

    Attributes:
        leg_margin, leg_taper: rad that leg setpoints stay inside the robot file's limits, and over which they slow down before.
        leg_speed: rad/s that leg setpoints may change by.
        leg_lead: rad that a leg's setpoint may be ahead of the leg.
        wheel_speed, wheel_acceleration: rad/s and rad/s2 of wheel setpoints.
        load, load_time: share of stall torque, and for how long (s) a motor may be above it.
        current, current_time: A of all motors together, and for how long (s) they may be above it.
        tilt, tilt_time, tilt_horizon: rad the body may lean, s it must last, s that the tilt is predicted ahead.
        warm, hot: degC from which wheels are slowed down, and at which the robot stops.
        low_voltage, low_voltage_time: V, and for how long (s) the supply may be below.
        coast, silence: s without an answer for which old setpoints hold, and after which torque goes off.
        imu_silence: s without a reading of the IMU.
        imu_frozen: s that the IMU may repeat exactly the same values.
        jump_speed, jump_noise: fastest believable speed of a joint, over its motor's no-load speed, and rad on top of it: a
            reading beyond, confirmed by a second one, is a fault.
        frozen_leg, frozen_wheel: rad a joint should have turned while its reading stayed exactly the same.
        leg_error, leg_error_time: rad that a leg may be away from its setpoint without coming nearer, and for how long (s).
        wheel_error, wheel_error_time: rad/s that a wheel may be off its speed, and for how long (s).
        late, late_share: ticks in a row, and share of the last second's, that may start more than a period late.
        deadman: s that the operator may be silent; None = no operator needed.
        watchdog: s of silence on the line after which servos stop by themselves.
        heartbeat: s between control steps after which the watchdog process kills this one and switches torque off.
        patience: s an answer may take beyond its time on the wire.
        read_time: s that 99 of 100 reads of all joints may take at the start.
        start_speed: rad/s of the legs on the way to the start pose, on average.
        start_error: rad that a leg may be away from the start pose when the way there is over.
        stop_time: s from wheels ordered to stop until torque goes off.
        off_time: s to go on trying to switch torque off where servos do not confirm it.
    """

    leg_margin: float = _limit(0.05, "rad", ge=0.0, le=0.5)
    leg_taper: float = _limit(0.1, "rad", gt=0.0, le=1.0)
    leg_speed: float = _limit(8.0, "rad/s", gt=0.0, le=20.0)
    leg_lead: float = _limit(0.45, "rad", gt=0.0, le=1.6)
    wheel_speed: float = _limit(6.4, "rad/s", gt=0.0, le=40.0)
    wheel_acceleration: float = _limit(200.0, "rad/s2", gt=0.0, le=2000.0)
    load: float = _limit(0.7, "of stall torque", gt=0.0, le=1.0)
    load_time: float = _limit(1.0, "s", gt=0.0, le=5.0)
    current: float = _limit(10.0, "A", gt=0.0, le=100.0)
    current_time: float = _limit(0.5, "s", gt=0.0, le=5.0)
    tilt: float = _limit(0.7, "rad", gt=0.0, le=1.6)
    tilt_time: float = _limit(0.1, "s", ge=0.0, le=2.0)
    tilt_horizon: float = _limit(0.2, "s", ge=0.0, le=2.0)
    warm: float = _limit(62.0, "degC", le=80.0)
    hot: float = _limit(68.0, "degC", le=80.0)
    low_voltage: float = _limit(10.2, "V", gt=0.0, le=30.0)
    low_voltage_time: float = _limit(0.5, "s", ge=0.0, le=5.0)
    coast: float = _limit(0.06, "s", ge=0.0, le=1.0)
    silence: float = _limit(0.4, "s", gt=0.0, le=3.0)
    imu_silence: float = _limit(0.1, "s", gt=0.0, le=3.0)
    imu_frozen: float = _limit(0.1, "s", gt=0.0, le=3.0)
    jump_speed: float = _limit(1.5, "of no-load speed", ge=1.0, le=10.0)
    jump_noise: float = _limit(0.03, "rad", ge=0.0, le=0.5)
    frozen_leg: float = _limit(0.03, "rad", gt=0.0, le=0.5)
    frozen_wheel: float = _limit(0.5, "rad", gt=0.0, le=6.3)
    leg_error: float = _limit(0.2, "rad", gt=0.0, le=1.6)
    leg_error_time: float = _limit(0.3, "s", gt=0.0, le=5.0)
    wheel_error: float = _limit(2.0, "rad/s", gt=0.0, le=10.0)
    wheel_error_time: float = _limit(0.5, "s", gt=0.0, le=5.0)
    late: int = _limit(5, "ticks", ge=1, le=10_000)
    late_share: float = _limit(0.1, "of the ticks", gt=0.0, le=1.0)
    deadman: float | None = _limit(None, "s", gt=0.0, le=LONGEST_DEADMAN)
    watchdog: float = _limit(0.2, "s", ge=0.02, le=2.54)
    heartbeat: float = _limit(0.8, "s", gt=0.0, le=10.0)
    patience: float = _limit(0.004, "s", gt=0.0, le=1.0)
    read_time: float = _limit(0.014, "s", gt=0.0, le=1.0)
    start_speed: float = _limit(1.0, "rad/s", gt=0.0, le=10.0)
    start_error: float = _limit(0.3, "rad", gt=0.0, le=1.0)
    stop_time: float = _limit(0.6, "s", ge=0.0, le=5.0)
    off_time: float = _limit(2.0, "s", ge=0.0, le=10.0)

    @field_validator("*", mode="wrap")
    @classmethod
    def _refusals_tell_the_unit(cls, value: Any, check: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
        try:
            return check(value)
        except ValidationError as error:
            context = {"reason": expected(error.errors()[0]), "unit": unit_of(str(info.field_name))}
            raise PydanticCustomError("limit", "{reason} ({unit})", context) from None

    @model_validator(mode="after")
    def _limits_are_in_order(self) -> SafetyLimits:
        for low, high, why in (
            ("coast", "silence", ""),
            ("leg_error", "leg_lead", ", or it never shows"),
            ("watchdog", "heartbeat", ""),
            ("warm", "hot", ""),
        ):
            below, above = getattr(self, low), getattr(self, high)
            if not below < above:
                unit = unit_of(low)
                raise InputError(f"safety.{low} = {below:g} {unit}: expected below {high} = {above:g} {unit}{why}")
        return self


def require_deadman(name: str, seconds: float) -> None:
    """Raise :class:`InputError` where the silence that an operator is allowed is none, or so long that it has another unit."""
    if not 0.0 < seconds <= LONGEST_DEADMAN:
        raise InputError(f"{name} {seconds:g} s: expected more than 0 and at most {LONGEST_DEADMAN:g} s")


def unit_of(limit: str) -> str:
    """Return the unit of a limit."""
    extra = SafetyLimits.model_fields[limit].json_schema_extra
    return str(extra["unit"]) if isinstance(extra, dict) else ""
