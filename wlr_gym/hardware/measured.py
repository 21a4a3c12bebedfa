"""What was measured on a robot: the ``measured`` section of its hardware file, written by ``wlr commission``."""

from __future__ import annotations

from pydantic import Field

from wlr_gym.base.settings import SettingsModel


class MeasuredValue(SettingsModel):
    """One value that was measured on the robot.

    Attributes:
        value: in ``unit``.
        unit: SI unit; ``-`` is a pure number.
        date: day it was measured.
    """

    value: float
    unit: str
    date: str


#: Joint or bus -> value.
MeasuredValues = dict[str, MeasuredValue]


class Measured(SettingsModel):
    """What ``wlr commission`` measured on this robot, by joint or bus; docs/commissioning.md says how. For people and analyses.

    Attributes:
        adapter_latency, adapter_jitter: s of a ping beyond its bytes' time on the wire: median; 99th percentile beyond it.
        answers_behind_ordinary, answers_behind_fast: part of the servos that answer behind a silent one, by kind of read.
        wheel_follows_given, wheel_follows_kept: speed at torque-on, over a setpoint written before, and one left from before.
        leg_follows_given, leg_follows_kept: way at torque-on, over the way to such setpoints.
        watchdog_stop_time: s from the last packet until the Bus Watchdog has stopped a wheel: its way over its speed.
        velocity_loop_time: s, time constant of a wheel's way to a new speed.
        integral_cycle: s, control cycle of the wheel's servo that this means.
        load_per_pwm: Present Load over PWM from speed to speed of a free wheel: 0 = it is torque, 1 = it is PWM.
        running_load: load of a free wheel, or of a leg on its way, part of stall torque.
        stall_load: load of a held wheel or leg over PWM and supply.
        stall_current: A of a held wheel, at full voltage.
        joint_zero: rad that a leg reads when it hangs straight down, less pi/2.
    """

    adapter_latency: MeasuredValues = Field(default_factory=dict)
    adapter_jitter: MeasuredValues = Field(default_factory=dict)
    answers_behind_ordinary: MeasuredValues = Field(default_factory=dict)
    answers_behind_fast: MeasuredValues = Field(default_factory=dict)
    wheel_follows_given: MeasuredValues = Field(default_factory=dict)
    wheel_follows_kept: MeasuredValues = Field(default_factory=dict)
    leg_follows_given: MeasuredValues = Field(default_factory=dict)
    leg_follows_kept: MeasuredValues = Field(default_factory=dict)
    watchdog_stop_time: MeasuredValues = Field(default_factory=dict)
    velocity_loop_time: MeasuredValues = Field(default_factory=dict)
    integral_cycle: MeasuredValues = Field(default_factory=dict)
    load_per_pwm: MeasuredValues = Field(default_factory=dict)
    running_load: MeasuredValues = Field(default_factory=dict)
    stall_load: MeasuredValues = Field(default_factory=dict)
    stall_current: MeasuredValues = Field(default_factory=dict)
    joint_zero: MeasuredValues = Field(default_factory=dict)
