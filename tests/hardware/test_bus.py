"""Bus groups on the emulator: each defect of the SDK's port driver shown there and absent here, faults, clocks, blocks."""

import os
import select
import threading
import time

import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.config import load_hardware, with_ports
from wlr_gym.hardware.dynamixel import protocol
from wlr_gym.hardware.dynamixel.tables import load_table
from wlr_gym.hardware.emulator import Machine, MachineOptions, Server
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.robot import load_robot

sdk = pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")
pytest.importorskip("termios")

from robot_rig import jabbering_port  # noqa: E402

from wlr_gym.hardware.dynamixel.bus import (  # noqa: E402
    Block,
    BusGroup,
    TickClock,
)
from wlr_gym.hardware.dynamixel.port import DynamixelPort  # noqa: E402
from wlr_gym.hardware.dynamixel.protocol import BusGoneError, NoAnswerError, RefusedError, RestlessLineError  # noqa: E402
from wlr_gym.hardware.safety import preflight  # noqa: E402
from wlr_gym.hardware.serial_frames import PortInUseError, SerialDevice  # noqa: E402
from wlr_gym.hardware.servos import Servos  # noqa: E402

TABLE = load_table("XM540-W150-R")
FAST_BLOCK = Block(TABLE, "realtime_tick", "present_position")
LEGS = {2: TABLE, 3: TABLE, 1: TABLE, 4: TABLE}
#: s a busy test machine may need to let the emulator's thread answer.
PATIENCE = 0.15


@pytest.fixture
def server():
    """The emulator in stepped time: what a test sees depends on no clock but the time-outs."""
    machine = Machine(load_robot("emanual"), load_hardware(), MachineOptions(sensor_noise=False, timing=NO_TIME))
    with Server(machine, real_time=False) as server:
        yield server


@pytest.fixture
def group(server):
    with connect(server) as group:
        yield group


def connect(server, patience=PATIENCE):
    """A group on the emulator's legs; the servos' clocks are compared with emulated time."""
    return BusGroup("legs", server.ports["legs"], 1_000_000, LEGS, patience, lambda: server.machine.time)


def read_all(group, block):
    group.ask_all(block)
    return group.answers()


# --- what it is for


def test_items_by_name(group):
    assert group.ping(2) == (1130, 45)
    group.write(2, "goal_current", -1)
    assert group.read(2, "goal_current") == -1
    with pytest.raises(RefusedError, match=r"bus legs, id 2: write led = 7: refused \(data range error\)"):
        group.write(2, "led", 7)
    with pytest.raises(InputError, match="no servo with id 9; there are 1, 2, 3, 4"):
        group.read(9, "led")
    with pytest.raises(InputError, match="did you mean 'goal_current'"):
        group.read(2, "goal_curent")


def test_blocks_of_all_servos_fast_and_not(group, server):
    for id in LEGS:
        group.write(id, "profile_velocity", 10 + id)
    block = Block(TABLE, "profile_acceleration", "goal_position")
    for fast in (True, False):
        group.fast = fast
        assert {id: r.counts["profile_velocity"] for id, r in read_all(group, block).items()} == {id: 10 + id for id in LEGS}
    assert group.statistics.fallbacks == 0
    readings = read_all(group, FAST_BLOCK)
    assert set(readings) == set(LEGS)
    assert readings[2].counts["present_position"] == server.machine.servos["leg_lf"]["present_position"]
    assert "moving_status" in readings[2].counts


def test_block_with_gaps_decodes_like_single_items(group):
    block = Block(TABLE, "torque_enable", "position_p_gain")
    counts = read_all(group, block)[3].counts
    assert counts["position_p_gain"] == 800
    assert counts == {name: group.read(3, name) for name in counts}


def test_write_to_all_at_once(group):
    group.write_all("goal_position", {2: 2100, 4: 1990})
    assert (group.read(2, "goal_position"), group.read(4, "goal_position")) == (2100, 1990)


def test_scan(group):
    assert group.scan() == dict.fromkeys((1, 2, 3, 4), (1130, 45))


def test_fast_reads_fall_back_for_good_on_old_firmware():
    machine = Machine(load_robot("emanual"), load_hardware(), MachineOptions(firmware=44, timing=NO_TIME))
    with Server(machine, real_time=False) as server, connect(server) as group:
        for _ in range(4):
            assert set(read_all(group, FAST_BLOCK)) == set(LEGS)
        assert not group.fast
        assert group.statistics.fallbacks == 3


def test_stuffed_counts_come_through_both_ways(server, group):
    """FF FF FD in a count: the SDK sends it unstuffed, and removes stuffing wrongly."""
    server.machine.servos["leg_lf"].set("operating_mode", 4)
    group.write(2, "goal_position", -131073)  # FF FF FD FF
    assert server.machine.servos["leg_lf"]["goal_position"] == -131073
    assert group.read(2, "goal_position") == -131073
    data = b"\xff\xff\xfd\xff\xfd\xfd"
    for k, byte in enumerate(data):
        server.machine.servos["leg_lf"].set(f"indirect_data_{k + 1}", byte)
    group.fast = False
    assert bytes(read_all(group, Block(TABLE, "indirect_data_1", "indirect_data_6"))[2].counts.values()) == data


def test_an_alert_shows_in_group_reads(server, group):
    server.machine.inject("overload leg_rf duration=0.005")
    server.advance(0.01)
    readings = read_all(group, FAST_BLOCK)
    assert {id for id, reading in readings.items() if reading.alert} == {3}
    assert group.statistics.alerts == {3: 1}


def test_one_missing_servo_costs_only_itself(server, group):
    server.machine.inject("drop leg_rf")  # its answer is lost; the others were heard on the line
    group.fast = False
    assert set(read_all(group, FAST_BLOCK)) == {1, 2, 4}
    assert group.statistics.missing == {3: 1}


def test_an_exception_in_the_middle_does_not_block_torque_off(server, group, monkeypatch):
    for id in LEGS:
        group.write(id, "torque_enable", 1)
    with monkeypatch.context() as patch:
        patch.setattr(DynamixelPort, "readPort", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            read_all(group, FAST_BLOCK)
    assert group.torque_off() == set()
    assert not any(server.machine.servos[joint]["torque_enable"] for joint in ("leg_lf", "leg_rf", "leg_lr", "leg_rr"))


# --- the SDK's defects, by number (wlr_gym/hardware/dynamixel/port.py)


def sdk_port(server):
    port = sdk.PortHandler(server.ports["legs"])
    port.openPort()
    return port, sdk.Protocol2PacketHandler()


def test_defect_1_time_out_is_what_was_asked_for(server):
    server.machine.inject("dead")
    server.advance(0.002)
    port, handler = sdk_port(server)
    start = time.monotonic()
    handler.ping(port, 2)
    assert time.monotonic() - start > 0.033
    port.closePort()
    with connect(server, 0.005) as group:
        spent = []
        while not spent or (min(spent) > 0.025 and len(spent) < 200):  # one try, of a computer that has time, is enough
            start = time.monotonic()
            with pytest.raises(NoAnswerError, match="bus legs, id 2: ping: no answer"):
                group.ping(2)
            spent.append(time.monotonic() - start)
        assert 0.005 < min(spent) < 0.025


def test_defect_2_waiting_takes_no_processor_time(server):
    server.machine.inject("dead")
    server.advance(0.002)
    with connect(server, 0.5) as group:
        start, busy = time.monotonic(), time.thread_time()
        with pytest.raises(NoAnswerError):
            group.ping(2)
        assert time.monotonic() - start > 0.45
        assert time.thread_time() - busy < 0.1


def test_defect_3_late_answer_is_not_taken_for_the_next(server, group):
    """Answers to a read that was given up come while the next read of the same servo waits: another length, then the same."""
    group.write(2, "profile_velocity", 5)
    group.write(2, "profile_acceleration", 9)
    line = server.machine.lines["legs"]
    late = protocol.encode_status(2, 0, (777).to_bytes(2, "little"))
    answer = line.receive
    line.receive = lambda data, now, baud=None: [type(e)(e.time, late + e.data) for e in answer(data, now, baud)]
    assert group.read(2, "profile_velocity") == 5  # the two bytes in front do not fit
    line.receive = answer
    group.port.suspect = 1  # the exchange before was given up ...
    server.call(lambda: server._ports["legs"].write(protocol.encode_status(2, 0, (777).to_bytes(4, "little"))))
    assert group.read(2, "profile_velocity") == 5  # ... so what is on its way is let pass first
    assert group.statistics.discarded > 0


def test_a_question_asked_twice_and_answered_late_twice_does_not_answer_the_next(server, group):
    """The first answer comes after the question was repeated; the second one while the next question would be asked."""
    limit = group.read(2, "velocity_limit")
    line, held = server.machine.lines["legs"], []
    answer = line.receive
    line.receive = lambda data, now, baud=None: held.append(answer(data, now, baud)) or []
    with pytest.raises(NoAnswerError):
        group.read(2, "velocity_limit")
    (late,) = held
    line.receive = lambda data, now, baud=None: held.append(answer(data, now, baud)) or late
    assert group.read(2, "velocity_limit") == limit
    line.receive = answer
    second = b"".join(emission.data for emission in held[-1])
    port = server._ports["legs"]
    timer = threading.Timer(0.02, lambda: server.call(lambda: port.write(second)))
    group.port.patience = 0.5  # the line is waited on, and the late answer passes
    timer.start()
    assert group.read(2, "max_position_limit") == 4095
    assert group.statistics.discarded >= len(second)


def test_defect_3_in_group_reads(server, group):
    """A leftover of another length from one of the servos asked comes first."""
    line = server.machine.lines["legs"]
    answer = line.receive
    late = protocol.encode_status(3, 0, b"\1\2\3\4")
    line.receive = lambda data, now, baud=None: [type(e)(e.time, late + e.data) for e in answer(data, now, baud)]
    for fast in (True, False):
        group.fast = fast
        assert set(read_all(group, FAST_BLOCK)) == set(LEGS)


def test_defect_4_unplugging_is_one_kind_of_error(server, group):
    group.ping(2)
    server.command("unplug legs")
    server.advance(0.002)
    for act in (lambda: group.ping(2), lambda: read_all(group, FAST_BLOCK), group.torque_off):
        with pytest.raises(BusGoneError, match="is gone"):
            act()


def test_defect_7_a_port_in_use_is_refused_untouched_until_it_is_closed():
    import termios
    import tty

    ours, theirs = os.openpty()
    tty.setraw(theirs)
    try:
        first, second = (DynamixelPort(os.ttyname(theirs), 1000000, 0.005) for _ in range(2))
        first.openPort()
        os.write(ours, b"answer")
        second.baudrate = 57600
        with pytest.raises(PortInUseError, match="in use by another program"):
            second.openPort()
        assert termios.tcgetattr(theirs)[4] == termios.B1000000  # and who has it is not disturbed
        assert os.read(first.ser.serial.fileno(), 99) == b"answer"
        first.closePort()
        second.openPort()
        os.write(ours, b"answer")
        sdk.PortHandler(os.ttyname(theirs)).openPort()  # the SDK, while another one has it
        assert termios.tcgetattr(theirs)[4] == termios.B1000000
        assert not select.select([theirs], [], [], 0.0)[0]
        second.closePort()
        assert not second.is_open
    finally:
        os.close(ours)
        os.close(theirs)


def test_defect_5_missing_port_is_named(tmp_path):
    path = str(tmp_path / "ttyUSB7")
    with pytest.raises(OSError, match="ttyUSB7"):
        sdk.PortHandler(path).openPort()
    group = BusGroup("legs", path, 1_000_000, LEGS)
    with pytest.raises(InputError, match=r"ttyUSB7: cannot be opened: No such file or directory; see wlr doctor$"):
        group.open()
    group.close()
    with pytest.raises(InputError, match="baud rate 4500000"):
        BusGroup("legs", path, 4_500_000, LEGS).open()


# --- faults on the line


@pytest.mark.parametrize("fault", ["echo legs", "noise probability=0.5", "noise value=3"])
def test_what_must_not_matter(server, group, fault):
    server.machine.inject(fault)
    for fast in (True, False):
        group.fast = fast
        for _ in range(5):
            assert set(read_all(group, FAST_BLOCK)) == set(LEGS)
    group.write(2, "led", 1)
    assert group.read(2, "led") == 1


@pytest.mark.parametrize("fault", ["drop probability=0.2", "flip probability=0.2", "truncate probability=0.2"])
def test_what_is_lost_is_reported_missing_and_never_wrong(server, fault):
    server.machine.inject(fault)
    with connect(server, 0.02) as group:
        group.fast = False
        ids = load_robot("emanual").dynamixel_ids
        truth = {id: server.machine.servos[joint]["present_position"] for joint, id in ids.items()}
        seen = 0
        for _ in range(40):
            for id, reading in read_all(group, FAST_BLOCK).items():
                assert reading.counts["present_position"] == truth[id]
                seen += 1
        assert 80 < seen < 158
        assert sum(group.statistics.missing.values()) == 160 - seen


def test_torque_off_gets_through_heavy_loss(server):
    for joint in ("leg_lf", "leg_rf", "leg_lr", "leg_rr"):
        server.machine.servos[joint].set("torque_enable", 1)
    server.machine.inject("drop probability=0.4")
    server.machine.inject("deaf probability=0.3")
    with connect(server, 0.02) as group:
        left = group.torque_off(retries=30)
    assert left == set()
    assert not any(server.machine.servos[joint]["torque_enable"] for joint in ("leg_lf", "leg_rf", "leg_lr", "leg_rr"))


def test_a_packet_that_was_sent_in_part_does_not_count_as_sent(group, monkeypatch):
    """The adapter is stuck: nobody heard the goal, or the torque-off, that it cut short."""
    write = SerialDevice.write
    monkeypatch.setattr(SerialDevice, "write", lambda self, data: write(self, data[:-1]))
    for act in (
        lambda: group.write_all("torque_enable", {2: 0}),
        lambda: group.ask_all(FAST_BLOCK),
        lambda: group.ping(2),
    ):
        with pytest.raises(BusGoneError, match=r"is gone: it took \d+ of \d+ bytes"):
            act()
    assert group.port.gone


# --- a line that never falls quiet: an open pair, another device's stream


def test_torque_off_goes_out_on_a_line_that_never_falls_quiet():
    with jabbering_port() as (path, sent), BusGroup("legs", path, 1_000_000, LEGS, 0.2) as group:
        with pytest.raises(NoAnswerError, match=r"no answer$"):
            group.ping(2)
        start = time.monotonic()
        with pytest.raises(RestlessLineError, match="never quiet: check wiring, are two ports swapped"):
            group.ping(2)
        sent()
        group.write_all("torque_enable", dict.fromkeys(LEGS, 0))
        assert time.monotonic() - start < 10.0
        assert protocol.sync_write(64, dict.fromkeys(LEGS, b"\0")) in sent()
        assert read_all(group, FAST_BLOCK) == {}
        assert group.scan() == {}


def test_a_line_that_never_falls_quiet_does_not_keep_the_other_bus_from_torque_off():
    with jabbering_port() as (legs, to_legs), jabbering_port() as (wheels, to_wheels):
        hardware = with_ports(load_hardware(), {"legs": legs, "wheels": wheels})
        servos = Servos(load_robot("emanual"), hardware, 0.2)
        servos.open()
        assert not servos.read().answered.any()
        for sent in (to_legs, to_wheels):
            sent()
        start = time.monotonic()
        servos.torque_off_unacknowledged()
        assert time.monotonic() - start < 10.0
        for sent, ids in ((to_legs, LEGS), (to_wheels, (6, 7, 5, 8))):
            assert protocol.sync_write(64, dict.fromkeys(ids, b"\0")) in sent()
        (check,) = preflight.check_servos(servos, load_robot("emanual"), hardware, ["leg_lf"])
        servos.close()
    assert check.found == "none, the line is never quiet"
    assert "Are two ports swapped" in check.remedy


# --- the servo's clock


def feed(clock, samples):
    return [clock.age(round(tick) % 32768, now) for now, tick in samples]


@pytest.mark.parametrize("speed", [0.99, 1.0, 1.01])
def test_steady_readings_are_fresh_whatever_the_clocks_speed(speed):
    samples = [(100.0 + 0.02 * k + 0.001 * (k % 3), 5000 + 20.0 * speed * k) for k in range(3000)]  # wraps on the way
    answers = feed(TickClock(), samples)
    assert max(age for age, _ in answers) < 0.004
    assert not any(restarted for _, restarted in answers)


def test_a_first_reading_that_waited_for_us_is_no_reason_to_call_the_next_one_a_reboot():
    clock = TickClock()
    assert clock.age(5000, 10.3, waited=0.302) == (0.0, False)  # nobody knows better than that it is 0 to 0.302 s old
    assert clock.age(5320, 10.32, waited=0.002) == (0.0, False)
    assert clock.age(5340 + 100, 10.34, waited=0.002) == (0.0, True)  # now the clocks are known


def test_an_answer_to_an_earlier_request_is_told_by_its_age():
    clock = TickClock()
    feed(clock, [(0.02 * k, 20.0 * k) for k in range(100)])
    age, restarted = clock.age(1980 - 40, 2.0)  # what it would have said 60 ms before
    assert age == pytest.approx(0.06, abs=0.003)
    assert not restarted
    assert clock.age(2020, 2.02) == (0.0, False)


def test_a_reboot_is_told_from_lateness():
    clock = TickClock()
    feed(clock, [(0.02 * k, 7000 + 20.0 * k) for k in range(100)])
    assert clock.age(320, 2.32) == (0.0, True)
    assert clock.age(340, 2.34) == (0.0, False)


@pytest.mark.parametrize("seconds", [0.05, 1.5])
def test_an_answer_that_waited_for_us_is_old_but_not_stale(server, seconds):
    """While one bus times out, or this program is not given the processor, the other bus' answer lies in the buffer."""
    waited = 0.0
    group = BusGroup("legs", server.ports["legs"], 1_000_000, LEGS, PATIENCE, lambda: server.machine.time + waited)
    with group:
        assert set(read_all(group, FAST_BLOCK)) == set(LEGS)
        group.ask_all(FAST_BLOCK)
        waited = seconds
        readings = group.answers()
    assert set(readings) == set(LEGS)
    assert readings[2].age == pytest.approx(seconds, rel=0.03)  # clocks may drift by 2 %
    assert not readings[2].restarted
    assert group.statistics.stale == {}


def test_stale_readings_are_dropped_and_counted(server, group):
    group.fast = False
    line = server.machine.lines["legs"]
    receive = line.receive
    assert set(read_all(group, FAST_BLOCK)) == set(LEGS)
    old = receive(protocol.sync_read(FAST_BLOCK.address, FAST_BLOCK.length, list(LEGS)), 0.0)
    server.advance(0.1)
    line.receive = lambda data, now, baud=None: old
    assert read_all(group, FAST_BLOCK) == {}
    assert group.statistics.stale == dict.fromkeys(LEGS, 1)
    line.receive = receive
    server.advance(0.02)
    assert set(read_all(group, FAST_BLOCK)) == set(LEGS)


def test_defect_6_waits_without_end_for_a_device_that_takes_no_bytes():
    import tty

    def fill(port):
        for _ in range(1000):
            port.writePort(b"x" * 100)

    master, slave = os.openpty()
    tty.setraw(slave)
    theirs = sdk.PortHandler(os.ttyname(slave))
    theirs.openPort()
    filling = threading.Thread(target=fill, args=(theirs,), daemon=True)
    filling.start()
    filling.join(0.3)
    assert filling.is_alive()
    ours = DynamixelPort(os.ttyname(slave), 1_000_000, 0.01)
    ours.openPort()
    with pytest.raises(BusGoneError):
        fill(ours)
    while filling.is_alive():  # let go of the thread
        os.read(master, 65536)
        filling.join(0.001)
    theirs.closePort()
    ours.closePort()
    os.close(master)
    os.close(slave)
