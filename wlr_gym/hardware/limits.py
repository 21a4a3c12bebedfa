"""The robot's safety limits: the ``safety`` section of ``configs/hardware/*.yaml``."""

from __future__ import annotations

from pydantic import Field, model_validator

from wlr_gym.base.settings import SettingsModel


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

    leg_margin: float = Field(default=0.05, ge=0.0)
    leg_taper: float = Field(default=0.1, gt=0.0)
    leg_speed: float = Field(default=8.0, gt=0.0)
    leg_lead: float = Field(default=0.45, gt=0.0)
    wheel_speed: float = Field(default=6.4, gt=0.0)
    wheel_acceleration: float = Field(default=200.0, gt=0.0)
    load: float = Field(default=0.7, gt=0.0, le=1.0)
    load_time: float = Field(default=1.0, gt=0.0)
    current: float = Field(default=10.0, gt=0.0)
    current_time: float = Field(default=0.5, gt=0.0)
    tilt: float = Field(default=0.7, gt=0.0, le=1.6)
    tilt_time: float = Field(default=0.1, ge=0.0)
    tilt_horizon: float = Field(default=0.2, ge=0.0)
    warm: float = 62.0
    hot: float = 68.0
    low_voltage: float = Field(default=10.2, gt=0.0)
    low_voltage_time: float = Field(default=0.5, ge=0.0)
    coast: float = Field(default=0.06, ge=0.0)
    silence: float = Field(default=0.4, gt=0.0)
    imu_silence: float = Field(default=0.1, gt=0.0)
    imu_frozen: float = Field(default=0.1, gt=0.0)
    jump_speed: float = Field(default=1.5, ge=1.0)
    jump_noise: float = Field(default=0.03, ge=0.0)
    frozen_leg: float = Field(default=0.03, gt=0.0)
    frozen_wheel: float = Field(default=0.5, gt=0.0)
    leg_error: float = Field(default=0.2, gt=0.0)
    leg_error_time: float = Field(default=0.3, gt=0.0)
    wheel_error: float = Field(default=2.0, gt=0.0)
    wheel_error_time: float = Field(default=0.5, gt=0.0)
    late: int = Field(default=5, ge=1)
    late_share: float = Field(default=0.1, gt=0.0, le=1.0)
    deadman: float | None = Field(default=None, gt=0.0)
    watchdog: float = Field(default=0.2, ge=0.02, le=2.54)
    heartbeat: float = Field(default=0.8, gt=0.0)
    patience: float = Field(default=0.004, gt=0.0)
    read_time: float = Field(default=0.014, gt=0.0)
    start_speed: float = Field(default=1.0, gt=0.0)
    start_error: float = Field(default=0.3, gt=0.0)
    stop_time: float = Field(default=0.6, ge=0.0)
    off_time: float = Field(default=2.0, ge=0.0)

    @model_validator(mode="after")
    def _limits_are_in_order(self) -> SafetyLimits:
        if not self.coast < self.silence:
            raise ValueError(f"coast {self.coast:g} s must be shorter than silence {self.silence:g} s")
        if not self.leg_error < self.leg_lead:
            raise ValueError(
                f"leg_error {self.leg_error:g} rad must be below leg_lead {self.leg_lead:g} rad, or it never shows"
            )
        if not self.watchdog < self.heartbeat:
            raise ValueError(f"watchdog {self.watchdog:g} s must be shorter than heartbeat {self.heartbeat:g} s")
        if not self.warm < self.hot:
            raise ValueError(f"warm {self.warm:g} degC must be below hot {self.hot:g} degC")
        return self
