"""What a healthy robot does, and what a bus and a computer do now and then, is no fault; and what interrupts a stop."""

import numpy as np
import pytest
from robot_rig import HARDWARE, JOINTS, PERIOD, ROBOT, Phase, Rig, hardware_with

from wlr_gym.base.errors import InputError
from wlr_gym.data.format import Profile
from wlr_gym.hardware.emulator import Machine, MachineOptions
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.link import emulated_link
from wlr_gym.hardware.loop import ControlLoop
from wlr_gym.hardware.safety import preflight

HOME = np.full(4, np.pi / 2)


def square(t, wheels=6.2, legs=0.0):
    """Setpoints that turn back every 2 s, wheels as fast as they go."""
    sign = 1.0 if t % 4.0 < 2.0 else -1.0
    return np.r_[HOME + sign * legs, np.full(4, sign * wheels)]


def drive(rig, seconds, setpoints=square):
    for tick in range(round(seconds / PERIOD)):
        rig.loop.tick(setpoints(tick * PERIOD))


def test_lost_answers_of_fast_wheels_are_no_jumps():
    """The answer of the second read comes later, and the wheel has turned on."""
    rig = Rig()
    rig.loop.start()
    rig.inject("drop probability=0.03")
    drive(rig, 8.0)


@pytest.mark.parametrize("pause", [0.025, 0.05, 0.15])
def test_a_pause_before_a_read_is_no_jump(pause, monkeypatch):
    """The computer does something else between looking at the clock and asking."""
    rig = Rig()
    rig.loop.start()
    drive(rig, 2.0 - PERIOD)
    read, calls = rig.link.servos._read, []

    def late(blocks):
        calls.append(1)
        if len(calls) == 3:
            rig.loop.clock.wait_until(rig.loop.clock.now() + pause)
        return read(blocks)

    monkeypatch.setattr(rig.link.servos, "_read", late)
    drive(rig, 0.4)


@pytest.mark.slow
@pytest.mark.parametrize("acceleration", [8.0, 11.2, 14.0, 20.0, 40.0])
def test_wheels_whose_profile_is_slow_are_not_away(acceleration):
    rig = Rig(profile=Profile(wheel_acceleration=acceleration))
    rig.loop.start()
    drive(rig, 6.0)


@pytest.mark.slow
@pytest.mark.parametrize(("velocity", "acceleration"), [(1.0, 1.0), (3.0, 2.0), (5.0, 3.0)])
def test_legs_whose_profile_is_slow_may_turn_back(velocity, acceleration):
    rig = Rig(profile=Profile(leg_velocity=velocity, leg_acceleration=acceleration))
    rig.loop.start()
    drive(rig, 6.5, lambda t: square(0.0 if t < 0.5 else t + 1.5, wheels=0.0, legs=0.8))


def test_wheels_that_are_allowed_little_voltage_are_not_away():
    """Half of the supply by the hardware file: half of the speed."""
    bus = HARDWARE.buses["wheels"]
    hardware = HARDWARE.model_copy(
        update={"buses": HARDWARE.buses | {"wheels": bus.model_copy(update={"eeprom": bus.eeprom | {"pwm_limit": 443}})}}
    )
    machine = Machine(ROBOT, hardware, MachineOptions(timing=NO_TIME))
    for joint in JOINTS[4:]:
        machine.servos[joint].set("pwm_limit", 443)
    loop = ControlLoop(ROBOT, hardware, emulated_link(machine), PERIOD)
    loop.start()
    for tick in range(300):
        loop.tick(square(tick * PERIOD))
    loop.close()


def test_motors_switched_while_answers_are_lost_have_not_lost_torque():
    rig = Rig()
    rig.loop.start()
    rig.inject("drop probability=0.03")
    rng = np.random.default_rng(3)
    for _ in range(700):
        on = np.r_[np.ones(4, bool), rng.random(4) < 0.5]
        rig.loop.tick(square(0.0, wheels=1.0), on)


@pytest.mark.parametrize("call", [1, 2, 3])
def test_an_interrupt_while_torque_goes_off_leaves_none_on(call, monkeypatch):
    rig = Rig()
    rig.loop.start()
    drive(rig, 0.2)
    servos = rig.link.servos
    send, calls = servos.torque_off_unacknowledged, []

    def interrupted():
        calls.append(1)
        if len(calls) < call:
            send()
        elif len(calls) == call:
            raise KeyboardInterrupt
        else:
            send()

    monkeypatch.setattr(servos, "torque_off_unacknowledged", interrupted)
    if call < 3:  # two calls a stop
        with pytest.raises(KeyboardInterrupt):
            rig.loop.close()
    else:
        rig.loop.close()
    assert not rig.torque().any()
    assert "CUT THE POWER" not in rig.loop.reason
    assert rig.loop.phase in (Phase.TORQUE_OFF, Phase.FAULT)


def test_an_adapter_that_answers_late_is_no_servo_that_does_not_obey():
    """Its answers come too late for a control step, not for switching off."""
    rig = Rig()
    rig.loop.start()
    rig.inject("late_answers value=0.02")
    rig.inject("drop wheels duration=0.6")
    with pytest.raises(Exception, match="silence") as stopped:
        drive(rig, 2.0, lambda t: square(t, wheels=1.0))
    assert "CUT THE POWER" not in str(stopped.value)
    assert not rig.torque().any()


def test_a_computer_that_slept_is_called_that():
    """The servos' clocks went on, its own did not: no servo was rebooted."""
    rig = Rig()
    slept = [7.0]
    rig.link.asleep = lambda: slept[0]
    rig.loop.start()
    drive(rig, 0.2)
    rig.machine.pause(5.0)
    slept[0] += 5.0
    with pytest.raises(Exception, match=r"suspend: the computer was suspended for 5\.00 s"):
        drive(rig, 0.1)
    assert not rig.torque().any()


def test_an_imu_that_is_unplugged_is_silent_and_not_frozen():
    rig = Rig()
    rig.loop.start()
    rig.inject("unplug imu")
    with pytest.raises(Exception, match="imu") as stopped:
        drive(rig, 3.0, lambda t: square(t, wheels=1.0))
    assert "same six values" not in str(stopped.value)


def test_a_supply_that_would_stop_the_run_is_found_before_it():
    hardware = hardware_with(low_voltage=12.6)
    rig = Rig(machine=Machine(ROBOT, hardware, MachineOptions(timing=NO_TIME)), low_voltage=12.6)
    with rig.link.servos as servos:
        wrong = [check for check in preflight.check_servos(servos, ROBOT, hardware) if not check.ok]
    assert {check.what for check in wrong} == {"supply"}
    assert wrong[0].expected.startswith("12.6")


def test_a_leg_whose_range_leaves_the_turn_of_its_servo_is_found():
    """A mirrored leg with the zero of one that is not."""
    joints = HARDWARE.joints | {"leg_rf": HARDWARE.joints["leg_rf"].model_copy(update={"zero": 1024})}
    hardware = HARDWARE.model_copy(update={"joints": joints})
    machine = Machine(ROBOT, hardware, MachineOptions(timing=NO_TIME))
    with emulated_link(machine).servos as servos:
        wrong = [check for check in preflight.check_servos(servos, ROBOT, hardware) if not check.ok]
    assert [(check.where, check.what) for check in wrong] == [("leg_rf", "range")]


def test_a_control_period_that_trips_the_watchdog_is_refused():
    with pytest.raises(InputError, match=r"control period 0\.2 s: expected less than"):
        ControlLoop(ROBOT, HARDWARE, emulated_link(Machine(ROBOT, HARDWARE)), 0.2)
