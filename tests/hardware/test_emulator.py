"""The emulated robot in emulated time: instructions on the line, order and timing of answers, physics, faults."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.config import load_hardware
from wlr_gym.hardware.dynamixel import protocol
from wlr_gym.hardware.dynamixel.protocol import BROADCAST, Error, Instruction, Packet, Parser, Status, word
from wlr_gym.hardware.emulator import Machine, MachineOptions
from wlr_gym.hardware.emulator.line import NO_TIME, LineTiming
from wlr_gym.hardware.emulator.server import run_command
from wlr_gym.hardware.imu import IMU_FRAMES, accel_per_count
from wlr_gym.hardware.serial_frames import FrameParser
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions
from wlr_gym.physics.servo import motor_constants
from wlr_gym.robot import JOINTS, load_robot
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot("emanual")
HARDWARE = load_hardware()
LEG_IDS = [ROBOT.dynamixel_ids[joint] for joint in JOINTS[:4]]
VELOCITY = 0.229 * 2 * np.pi / 60
POSITION = 2 * np.pi / 4096


def make(timing=NO_TIME, **options):
    return Machine(ROBOT, HARDWARE, MachineOptions(timing=timing, sensor_noise=False, **options))


@pytest.fixture
def machine():
    return make()


def ask(machine, raw, line="legs"):
    """Send bytes to a line; return the answers parsed, whenever they come."""
    emissions = machine.lines[line].receive(raw, machine.time)
    return Parser().feed(b"".join(emission.data for emission in sorted(emissions, key=lambda emission: emission.time)))


def statuses(machine, raw, line="legs"):
    answers = [protocol.as_status(packet) for packet in ask(machine, raw, line)]
    assert None not in answers
    return [answer for answer in answers if answer is not None]


def write(machine, joint, **counts):
    """Write registers of a servo, one after the other."""
    for name, count in counts.items():
        item = machine.servos[joint].table[name]
        assert machine.servos[joint].write(item.address, item.encode(count)) == Error.NONE


# --- instructions


def test_ping_one_and_all(machine):
    assert statuses(machine, protocol.ping(3)) == [Status(3, 0, b"\x6a\x04\x2d")]
    assert [status.id for status in statuses(machine, protocol.ping())] == sorted(LEG_IDS)
    assert statuses(machine, protocol.ping(77)) == []
    assert statuses(machine, protocol.ping(6)) == []  # a wheel: other line
    assert statuses(machine, protocol.ping(6), "wheels")[0].data[:2] == (1060).to_bytes(2, "little")


def test_read_write_and_errors_on_the_line(machine):
    assert statuses(machine, protocol.write(2, 65, b"\1")) == [Status(2, 0, b"")]
    assert statuses(machine, protocol.read(2, 65, 1)) == [Status(2, 0, b"\1")]
    assert statuses(machine, protocol.write(2, 65, b"\2"))[0].fault == Error.DATA_RANGE
    assert statuses(machine, protocol.encode(2, 0x77))[0].fault == Error.INSTRUCTION
    assert statuses(machine, protocol.encode(2, Instruction.READ, b"\1"))[0].fault == Error.DATA_LENGTH


def test_status_return_level_decides_who_answers(machine):
    read, write_led = protocol.read(2, 65, 1), protocol.write(2, 65, b"\1")
    for level, answered in ((2, (1, 1, 1)), (1, (1, 1, 0)), (0, (1, 0, 0))):
        machine.servos["leg_lf"].set("status_return_level", level)
        assert tuple(len(ask(machine, raw)) for raw in (protocol.ping(2), read, write_led)) == answered


def test_broadcasts_act_without_answer(machine):
    assert ask(machine, protocol.write(BROADCAST, 65, b"\1")) == []
    assert all(machine.servos[joint]["led"] == 1 for joint in JOINTS[:4])
    assert ask(machine, protocol.read(BROADCAST, 65, 1)) == []


def test_sync_and_bulk_writes_are_silent_even_when_refused(machine):
    setpoints = {2: (2100).to_bytes(4, "little"), 3: (9999).to_bytes(4, "little")}
    assert ask(machine, protocol.sync_write(116, setpoints)) == []
    assert machine.servos["leg_lf"]["goal_position"] == 2100
    assert machine.servos["leg_rf"]["goal_position"] != 9999
    bulk = b"\1" + word(65) + word(1) + b"\1" + b"\4" + word(112) + word(4) + (9).to_bytes(4, "little")
    assert ask(machine, protocol.encode(BROADCAST, Instruction.BULK_WRITE, bulk)) == []
    assert machine.servos["leg_lr"]["led"] == 1
    assert machine.servos["leg_rr"]["profile_velocity"] == 9


def test_sync_bulk_and_fast_reads_agree(machine):
    address, length = machine.servos["leg_lf"].table.block("present_pwm", "present_position")
    wanted = [machine.servos[joint].read(address, length)[1] for joint in JOINTS[:4]]
    assert [s.data for s in statuses(machine, protocol.sync_read(address, length, LEG_IDS))] == wanted
    blocks = b"".join(bytes([id]) + word(address) + word(length) for id in LEG_IDS)
    assert [s.data for s in statuses(machine, protocol.encode(BROADCAST, Instruction.BULK_READ, blocks))] == wanted
    fast_bulk = protocol.encode(BROADCAST, Instruction.FAST_BULK_READ, blocks)
    for raw in (protocol.sync_read(address, length, LEG_IDS, fast=True), fast_bulk):
        (packet,) = ask(machine, raw)
        answers = protocol.split_fast_status(packet, [length] * 4)
        assert answers is not None
        assert [s.data for s in answers] == wanted
        assert [s.id for s in answers] == LEG_IDS


def test_a_missing_servo_silences_those_behind_it(machine):
    machine.inject("dead leg_lr")
    machine.step()
    assert [s.id for s in statuses(machine, protocol.sync_read(132, 4, LEG_IDS))] == LEG_IDS[:2]
    assert ask(machine, protocol.sync_read(132, 4, LEG_IDS, fast=True)) == []  # cut short: no whole packet


def test_old_firmware_knows_no_fast_reads():
    machine = make(firmware=44)
    assert ask(machine, protocol.sync_read(132, 4, LEG_IDS, fast=True)) == []
    assert len(ask(machine, protocol.sync_read(132, 4, LEG_IDS))) == 4


def test_reboot_takes_its_time(machine):
    write(machine, "leg_lf", led=1)
    assert statuses(machine, protocol.encode(2, Instruction.REBOOT)) == [Status(2, 0, b"")]
    assert statuses(machine, protocol.ping(2)) == []
    machine.advance(0.35)
    assert statuses(machine, protocol.read(2, 65, 1)) == [Status(2, 0, b"\0")]


def test_shadow_id_obeys_without_answer(machine):
    write(machine, "leg_lf", secondary_id=50)
    assert ask(machine, protocol.write(50, 65, b"\1")) == []
    assert machine.servos["leg_lf"]["led"] == 1


def test_a_servo_on_another_baud_rate_hears_nothing(machine):
    raw = protocol.ping(2)
    assert machine.lines["legs"].receive(raw, 0.0, 1_000_000)
    assert not machine.lines["legs"].receive(raw, 0.0, 57_600)
    assert make(factory=True).lines["legs"].receive(protocol.ping(1), 0.0, 57_600)


def test_alert_bit_comes_with_valid_data(machine):
    machine.inject("overload leg_lf duration=0.01")
    machine.advance(0.02)
    (status,) = statuses(machine, protocol.read(2, 70, 1))
    assert status.alert
    assert status.fault == Error.NONE
    assert status.data == b"\x20"


@pytest.fixture(scope="module")
def fuzzed():
    return make()


@given(
    st.sampled_from([1, 2, 77, BROADCAST]),
    st.one_of(st.sampled_from([int(i) for i in Instruction]), st.integers(1, 255)),
    st.binary(max_size=40),
)
@settings(max_examples=400, deadline=None)
def test_no_instruction_however_senseless_breaks_the_emulator(fuzzed, id, instruction, parameters):
    for line in fuzzed.lines.values():
        for emission in line.receive(protocol.encode(id, instruction, parameters), fuzzed.time):
            assert emission.data
    fuzzed.step()


def test_reads_too_long_for_a_packet(machine):
    assert statuses(machine, protocol.sync_read(0, 65535, LEG_IDS))[0].fault == Error.ACCESS
    assert ask(machine, protocol.sync_read(0, 65535, LEG_IDS, fast=True)) == []
    (packet,) = ask(machine, protocol.sync_read(660, 4, LEG_IDS, fast=True))
    answers = protocol.split_fast_status(packet, [4] * 4)
    assert answers is not None
    assert {answer.fault for answer in answers} == {Error.ACCESS}


# --- timing


def test_wire_time_return_delay_and_usb_latency_add_up():
    timing = LineTiming(wire=True, turnaround=50e-6, usb_latency=0.001)
    machine = make(timing)
    (emission,) = machine.lines["legs"].receive(protocol.read(2, 132, 4), 0.0, 1_000_000)
    assert emission.time == pytest.approx((14 + 15) * 10e-6 + 50e-6 + 0.001)
    write(machine, "leg_lf", return_delay_time=250)
    (emission,) = machine.lines["legs"].receive(protocol.read(2, 132, 4), 1.0, 1_000_000)
    assert emission.time - 1.0 == pytest.approx((14 + 15) * 10e-6 + 50e-6 + 500e-6 + 0.001)


def test_full_usb_packets_are_not_held_back():
    machine = make(LineTiming(usb_latency=0.016))
    emissions = machine.lines["legs"].receive(protocol.sync_read(120, 16, LEG_IDS), 0.0, 1_000_000)
    times = [emission.time for emission in emissions]
    assert times == sorted(times)
    assert times[2] < 0.003  # three answers of 27 bytes fill a packet of 62
    assert times[3] > 0.016


def test_answers_to_two_instructions_do_not_overlap():
    machine = make(LineTiming(usb_latency=0.0))
    first = machine.lines["legs"].receive(protocol.sync_read(120, 16, LEG_IDS), 0.0, 57_600)
    machine.servos["leg_lf"].set("baud_rate", 1)
    for servo in machine.lines["legs"].servos:
        servo.set("baud_rate", 1)
    first = machine.lines["legs"].receive(protocol.sync_read(120, 16, LEG_IDS), 0.0, 57_600)
    second = machine.lines["legs"].receive(protocol.ping(2), 0.0, 57_600)
    assert min(e.time for e in second) > max(e.time for e in first)


# --- physics


def test_native_modes_are_the_simulator_bit_for_bit(machine):
    """The same setpoints written to the registers and to a plant of its own: equal readings, to the bit."""
    plant = make_plant("gibbs_appell", ROBOT, 1, PlantOptions(control_period=0.001, sensor_noise=False))
    parameters = Parameters.nominal(ROBOT, 1)
    table = machine.servos["leg_lf"].table
    parameters["servo.kp"][0, :4] = 800 * table.per_count("position_p_gain")
    wheel = machine.servos["wheel_lf"].table
    parameters["servo.kp"][0, 4:] = 1000 * wheel.per_count("velocity_i_gain")
    parameters["servo.kd"][0, 4:] = 100 * wheel.per_count("velocity_p_gain")
    parameters["servo.profile_velocity"][0, :4] = 40 * table.per_count("profile_velocity")
    parameters["servo.profile_acceleration"][0, :4] = 10 * table.per_count("profile_acceleration")
    plant.reset(np.zeros(1, np.uint64), parameters)
    for joint in JOINTS[:4]:
        write(machine, joint, profile_velocity=40, profile_acceleration=10)
    counts = [2200, 1900, 2000, 2150]
    for joint, count in zip(JOINTS, [*counts, 50, -50, 40, -40], strict=True):
        write(machine, joint, **{"goal_position" if joint.startswith("leg") else "goal_velocity": count})
        write(machine, joint, torque_enable=1)
    signs = [machine.hardware.joints[joint].sign for joint in JOINTS]
    zeros = [machine.hardware.joints[joint].zero for joint in JOINTS]
    unit = table.per_count("goal_position")
    legs = [s * (c * unit - z * ROBOT.sensors.encoder.position) for s, c, z in zip(signs, counts, zeros, strict=False)]
    wheels = [s * c * wheel.per_count("goal_velocity") for s, c in zip(signs[4:], (50, -50, 40, -40), strict=True)]
    setpoints = np.array([[*legs, *wheels]])
    for _ in range(300):
        machine.step()
        plant.step(setpoints)
    np.testing.assert_array_equal(machine.plant.truth().values, plant.truth().values)
    expected = [z + s * round(p / POSITION) for s, z, p in zip(signs, zeros, plant.truth().joint_position[0], strict=True)]
    for servo, count in zip(machine.servos.values(), expected, strict=True):
        assert abs((servo["present_position"] - count + 2048) % 4096 - 2048) <= 1


def test_a_plant_with_other_parameters_keeps_them():
    """What registers do not hold stays (friction), and a gain that is off stays off by that factor."""
    parameters = Parameters.nominal(ROBOT, 1)
    parameters["servo.kp"][0, 0] *= 0.5
    parameters["servo.coulomb_friction"][0, 4] = 0.2
    machine = Machine(ROBOT, HARDWARE, MachineOptions(timing=NO_TIME), parameters=parameters)
    for joint in JOINTS:
        write(machine, joint, torque_enable=1)
    machine.step()
    assert machine.plant.parameters["servo.kp"][0, :4] == pytest.approx([27.62, 55.24, 55.24, 55.24], rel=1e-3)
    assert machine.plant.parameters["servo.kp"][0, 4:] == pytest.approx([8.63] * 4, rel=1e-3)
    assert machine.plant.parameters["servo.kd"][0, 4:] == pytest.approx([0.4418] * 4, rel=1e-3)
    assert machine.plant.parameters["servo.coulomb_friction"][0, 4] == 0.2
    assert parameters["servo.kp"][0, 0] == pytest.approx(27.62, rel=1e-3)


@pytest.mark.parametrize("mode", [None, 4, 16, 1])
def test_registers_at_their_ends_do_not_break_the_physics(machine, mode):
    for joint in JOINTS:
        servo = machine.servos[joint]
        if mode is not None:
            write(machine, joint, operating_mode=mode)
        for name in ("velocity_p_gain", "velocity_i_gain", "position_p_gain", "profile_velocity", "profile_acceleration"):
            write(machine, joint, **{name: servo.table[name].high})
        write(machine, joint, torque_enable=1, goal_velocity=servo["velocity_limit"], goal_position=4095)
    machine.inject("sag value=50 after=0.1 duration=0.05")
    machine.advance(0.3)
    assert np.isfinite(machine.plant.truth().values).all()


def test_both_simulators_drive_the_servos_alike():
    positions = {}
    for backend in ("gibbs_appell", "mujoco"):
        machine = make(backend=backend)
        for joint in JOINTS:
            goal = 2150 if joint.startswith("leg") else 40 * machine.hardware.joints[joint].sign
            write(machine, joint, **{"goal_position" if joint.startswith("leg") else "goal_velocity": goal})
            write(machine, joint, torque_enable=1)
        machine.advance(0.4)
        positions[backend] = [servo["present_position"] for servo in machine.servos.values()]
    np.testing.assert_allclose(positions["gibbs_appell"], positions["mujoco"], atol=2)
    assert positions["mujoco"][4] > 80


def test_wheel_in_position_mode_turns_to_its_goal(machine):
    write(
        machine, "wheel_lf", operating_mode=4, profile_velocity=60, profile_acceleration=20, torque_enable=1, goal_position=900
    )
    machine.advance(0.2)
    assert abs(machine.servos["wheel_lf"]["present_velocity"]) <= 75
    machine.advance(1.3)
    assert abs(machine.servos["wheel_lf"]["present_position"] - 900) < 25  # gear friction over the position gain
    assert machine.servos["wheel_lf"]["position_trajectory"] == 900


def test_leg_in_velocity_mode_turns_at_its_goal_speed(machine):
    write(machine, "leg_lf", operating_mode=1, torque_enable=1, goal_velocity=20)
    machine.advance(0.5)
    before = machine.servos["leg_lf"].shaft.position
    machine.advance(0.3)
    assert (machine.servos["leg_lf"].shaft.position - before) / 0.3 == pytest.approx(20 * VELOCITY, rel=0.1)


def test_pwm_mode_gives_the_speed_of_that_voltage(machine):
    """A wheel at half the supply runs at half its no-load speed less what friction costs (floor and gear): never above it."""
    write(machine, "wheel_lf", operating_mode=16, torque_enable=1, goal_pwm=442)
    machine.advance(0.5)
    speed = machine.servos["wheel_lf"].shaft.velocity
    assert 0.7 * 0.5 * 6.388 < speed < 0.5 * 6.388
    assert machine.servos["wheel_lf"]["present_pwm"] == pytest.approx(442, abs=15)


def test_current_mode_in_motion_lags_by_the_back_emf_of_one_tick(machine):
    write(machine, "leg_lf", operating_mode=0, torque_enable=1, goal_current=100)
    machine.advance(0.05)
    start = machine.servos["leg_lf"].shaft.velocity
    seen = []
    for _ in range(40):
        machine.step()
        seen.append(machine.servos["leg_lf"]["present_current"])
    gain_per_tick = (machine.servos["leg_lf"].shaft.velocity - start) / 40
    constant, resistance = motor_constants(7.3, 5.55, 12.0)
    lag = constant / resistance * gain_per_tick / 2.69e-3
    assert np.mean(seen) == pytest.approx(100 - lag, abs=0.6 * lag)
    assert 0 < lag < 10


def test_current_limit_in_current_based_position_mode(machine):
    write(machine, "leg_lf", operating_mode=5, goal_current=60, torque_enable=1, goal_position=3000)
    largest = 0
    for _ in range(200):
        machine.step()
        largest = max(largest, abs(machine.servos["leg_lf"]["present_current"]))
    assert 50 < largest < 75


def all_legs_on(limit):
    """A robot that stands on four powered legs, one of them with a PWM limit and told to move."""
    machine = make()
    write(machine, "leg_lf", goal_pwm=limit)
    for joint in JOINTS[:4]:
        write(machine, joint, torque_enable=1)
    write(machine, "leg_lf", goal_position=2200)
    return machine


def test_pwm_limit_acts_in_position_mode_and_can_be_lifted():
    machine = all_legs_on(limit=60)
    servo = machine.servos["leg_lf"]
    largest = 0
    for _ in range(300):
        machine.step()
        largest = max(largest, abs(servo["present_pwm"]))
    assert 40 < largest < 80
    write(machine, "leg_lf", goal_pwm=885)
    before = servo["present_position"]
    machine.advance(0.003)
    assert abs(servo["present_position"] - before) < 20  # no jump while the laws change hands
    machine.advance(1.5)
    free = all_legs_on(limit=885)
    free.advance(1.8)
    assert (
        abs(servo["present_position"] - free.servos["leg_lf"]["present_position"]) <= 4
    )  # dry friction: 0.1 N m / 33.7 N m/rad


def test_lifting_a_pwm_limit_starts_the_profile_at_the_joint():
    """Under a limit the plant's own profile generator carries the voltage; handing back must not start from there."""
    machine = all_legs_on(limit=60)
    servo = machine.servos["leg_lf"]
    write(machine, "leg_lf", profile_velocity=10, goal_position=2600)
    machine.advance(0.1)
    write(machine, "leg_lf", goal_pwm=885)
    before = servo["present_position"]
    machine.advance(0.05)
    assert abs(servo["present_position"] - before) < 40  # 0.24 rad/s for 50 ms are 8 counts; the rest is the leg's own motion


def test_torque_off_lets_a_wheel_run_down(machine):
    for joint in JOINTS[4:]:
        write(machine, joint, torque_enable=1, goal_velocity=100 * machine.hardware.joints[joint].sign)
    machine.advance(0.5)
    assert machine.servos["wheel_lf"]["present_velocity"] > 80
    for joint in JOINTS[4:]:
        write(machine, joint, torque_enable=0)
    machine.advance(1.0)
    assert abs(machine.servos["wheel_lf"]["present_velocity"]) < 10
    assert machine.servos["wheel_lf"]["present_load"] == 0


def test_imu_streams_gravity_at_its_rate(machine):
    machine.advance(0.1)
    parser = FrameParser(IMU_FRAMES)
    frames = parser.feed(machine.arrived("imu"))
    assert [frame[0] for frame in frames] == list(range(1, 21))
    assert [b[1] - a[1] for a, b in pairwise(frames)] == [5000] * 19
    gravity = accel_per_count(4) * np.array(frames[-1][2:5])
    assert np.linalg.norm(gravity) == pytest.approx(9.81, abs=0.35)  # the robot's constant bias stays


# --- faults


@pytest.mark.parametrize("kind", ["drop", "flip", "truncate"])
def test_a_hit_answer_is_lost_and_the_others_are_not(machine, kind):
    machine.inject(f"{kind} leg_rf")
    raw = protocol.sync_read(132, 4, LEG_IDS)
    emissions = machine.lines["legs"].receive(raw, 0.0)
    packets = Parser().feed(b"".join(emission.data for emission in emissions))
    assert [packet.id for packet in packets] == [id for id in LEG_IDS if id != 3]


def test_probability_is_kept(machine):
    machine.inject("drop probability=0.25")
    raw = protocol.ping(2)
    answered = sum(bool(machine.lines["legs"].receive(raw, 0.0)) for _ in range(2000))
    assert 0.71 < answered / 2000 < 0.79


def test_noise_echo_delay_and_deaf(machine):
    raw, receive = protocol.ping(2), machine.lines["legs"].receive
    machine.inject("noise value=8")
    (emission,) = receive(raw, 0.0)
    assert len(emission.data) == 8 + 14
    machine.clear()
    machine.inject("echo legs")
    assert ask(machine, raw) == [Packet(2, Instruction.PING, b""), Packet(2, Instruction.STATUS, b"\0\x6a\x04\x2d")]
    machine.clear()
    machine.inject("late value=0.07")
    assert receive(raw, 0.0)[0].time == pytest.approx(0.07)
    machine.clear()
    machine.inject("deaf leg_lf")
    assert receive(raw, 0.0) == []
    assert receive(protocol.ping(3), 0.0)


def test_brownout_reboots_the_servos_named(machine):
    for joint in JOINTS[:4]:
        write(machine, joint, torque_enable=1)
    machine.inject("brownout leg_lf leg_rf")
    machine.advance(0.03)
    assert [s.id for s in statuses(machine, protocol.ping())] == [1, 4]
    machine.advance(0.4)
    assert [machine.servos[joint]["torque_enable"] for joint in JOINTS[:4]] == [0, 0, 1, 1]
    assert machine.servos["leg_lf"]["realtime_tick"] < machine.servos["leg_lr"]["realtime_tick"]


def test_sag_shows_in_the_voltage_and_can_trip_the_limit(machine):
    machine.inject("sag value=3 duration=0.1")
    machine.advance(0.05)
    assert machine.servos["leg_lf"]["present_input_voltage"] == 90
    assert machine.servos["leg_lf"]["hardware_error_status"] == 1  # below 9.5 V
    assert machine.servos["wheel_lf"]["hardware_error_status"] == 0  # above 6 V
    machine.advance(0.1)
    assert machine.servos["leg_lf"]["present_input_voltage"] == 120


def test_overheating_is_a_ramp_that_ends_in_a_shutdown(machine):
    write(machine, "wheel_lf", torque_enable=1)
    machine.inject("overheat wheel_lf value=100")
    machine.advance(0.3)
    assert 50 < machine.servos["wheel_lf"]["present_temperature"] < 57
    machine.advance(0.3)
    assert machine.servos["wheel_lf"]["hardware_error_status"] == 4
    assert machine.servos["wheel_lf"]["torque_enable"] == 0
    assert machine.servos["wheel_rf"]["hardware_error_status"] == 0


def test_a_temperature_ends_where_its_register_ends(machine):
    machine.inject("overheat leg_lf value=100")
    machine.advance(4.0)
    assert machine.servos["leg_lf"]["present_temperature"] == 255
    assert "255 degC" in run_command(machine, "status")


def test_faults_start_and_end_on_time(machine):
    machine.inject("dead leg_lf after=0.02 duration=0.01")
    machine.advance(0.015)
    assert statuses(machine, protocol.ping(2))
    machine.advance(0.01)
    assert not statuses(machine, protocol.ping(2))
    machine.advance(0.32)
    assert statuses(machine, protocol.ping(2))


def test_same_seed_same_bytes():
    def run():
        machine = Machine(ROBOT, HARDWARE, MachineOptions(timing=NO_TIME, seed=5))
        machine.inject("flip probability=0.3")
        out = b""
        for _ in range(20):
            machine.advance(0.005)
            out += b"".join(e.data for e in machine.lines["legs"].receive(protocol.sync_read(124, 12, LEG_IDS), machine.time))
        return out + machine.arrived("imu")

    assert run() == run()


# --- refusals


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("dorp legs", "did you mean 'drop'"),
        ("drop leg_lff", "did you mean 'leg_lf'"),
        ("drop legs probabilty=1", "did you mean 'probability'"),
        ("drop legs probability=2", "expected 0 or more up to 1"),
        ("sag value=much", "'much' is no number"),
        ("statsu", "did you mean 'status'"),
        ("clear dorp", "did you mean 'drop'"),
    ],
)
def test_commands_that_cannot_be_understood(machine, text, words):
    with pytest.raises(InputError, match=words):
        run_command(machine, text)


def test_commands(machine):
    assert run_command(machine, "drop wheels probability=0.5 duration=2").endswith("drop wheels probability=0.5 duration=2")
    assert run_command(machine, "faults") == "drop wheels probability=0.5 duration=2"
    assert run_command(machine, "clear drop") == "cleared"
    assert run_command(machine, "faults") == "no faults"
    assert run_command(machine, "status").count("torque off") == 8
    assert "overheat" in run_command(machine, "help")


def test_a_plant_of_another_size_or_period_is_refused():
    with pytest.raises(InputError, match="got 2 stepped every"):
        Machine(ROBOT, HARDWARE, plant=make_plant("gibbs_appell", ROBOT, 2, PlantOptions(control_period=0.001)))
    with pytest.raises(InputError, match=r"got 1 stepped every 0\.02 s"):
        Machine(ROBOT, HARDWARE, plant=make_plant("gibbs_appell", ROBOT, 1))
