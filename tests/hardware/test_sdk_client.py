"""ROBOTIS' own client, unmodified, on the emulator's pseudo-terminals."""

import os
import time

import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.config import load_hardware
from wlr_gym.hardware.emulator import Machine, MachineOptions, Server
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.imu import IMU_FRAMES
from wlr_gym.hardware.serial_frames import FrameParser
from wlr_gym.robot import load_robot

sdk = pytest.importorskip("dynamixel_sdk")
pytest.importorskip("termios")
pytest.importorskip("serial")

LEGS = (2, 3, 1, 4)


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """The SDK gives up after 2 LATENCY_TIMER + 2 ms of wall time; a busy test machine may need much longer."""
    monkeypatch.setattr(sdk.port_handler, "LATENCY_TIMER", 10_000)


def until(condition):
    """Wait for what takes its time on a busy machine."""
    deadline = time.monotonic() + 120.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def unanswered(handler, port, servo):
    """Whether a ping gets no answer; where none is expected, waiting long proves nothing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sdk.port_handler, "LATENCY_TIMER", 150)
        return handler.ping(port, servo)[1] == sdk.COMM_RX_TIMEOUT


@pytest.fixture
def server():
    machine = Machine(load_robot("emanual"), load_hardware(), MachineOptions(sensor_noise=False))
    with Server(machine) as server:
        yield server


@pytest.fixture
def stepped():
    machine = Machine(load_robot("emanual"), load_hardware(), MachineOptions(sensor_noise=False, timing=NO_TIME))
    with Server(machine, real_time=False) as server:
        yield server


def connect(server, bus="legs", baud=1_000_000):
    port = sdk.PortHandler(server.ports[bus])
    assert port.setBaudRate(baud)
    return port, sdk.PacketHandler(2.0)


def test_ping_read_write_reboot_clear_and_errors(server):
    port, handler = connect(server)
    assert handler.ping(port, 2) == (1130, sdk.COMM_SUCCESS, 0)
    assert handler.clearMultiTurn(port, 2) == (sdk.COMM_SUCCESS, 0)
    assert unanswered(handler, port, 99)
    assert handler.write1ByteTxRx(port, 2, 64, 1) == (sdk.COMM_SUCCESS, 0)
    assert handler.read1ByteTxRx(port, 2, 64) == (1, sdk.COMM_SUCCESS, 0)
    assert handler.write1ByteTxRx(port, 2, 9, 5) == (sdk.COMM_SUCCESS, 7)  # EEPROM is locked: access error
    assert handler.write4ByteTxRx(port, 2, 116, 5000) == (sdk.COMM_SUCCESS, 6)  # beyond the position limit
    assert handler.write4ByteTxRx(port, 2, 116, 2200) == (sdk.COMM_SUCCESS, 0)
    until(lambda: abs(handler.read4ByteTxRx(port, 2, 132)[0] - 2200) < 10)
    assert handler.reboot(port, 2) == (sdk.COMM_SUCCESS, 0)
    until(lambda: not unanswered(handler, port, 2))
    assert handler.read1ByteTxRx(port, 2, 64) == (0, sdk.COMM_SUCCESS, 0)
    assert handler.regWriteTxRx(port, 2, 65, 1, [1]) == (sdk.COMM_SUCCESS, 2)  # not emulated: instruction error
    port.closePort()


def test_group_reads_and_writes(server):
    port, handler = connect(server)
    writer = sdk.GroupSyncWrite(port, handler, 112, 4)
    for id in LEGS:
        assert writer.addParam(id, [10 + id, 0, 0, 0])
    assert writer.txPacket() == sdk.COMM_SUCCESS
    bulk_writer = sdk.GroupBulkWrite(port, handler)
    bulk_writer.addParam(2, 65, 1, [1])
    bulk_writer.addParam(3, 108, 4, [7, 0, 0, 0])
    assert bulk_writer.txPacket() == sdk.COMM_SUCCESS
    reader = sdk.GroupSyncRead(port, handler, 112, 4)
    for id in LEGS:
        assert reader.addParam(id)
    for read in (reader.txRxPacket, reader.fastSyncRead):
        assert read() == sdk.COMM_SUCCESS
        assert [reader.getData(id, 112, 4) for id in LEGS] == [10 + id for id in LEGS]
    bulk = sdk.GroupBulkRead(port, handler)
    bulk.addParam(2, 65, 1)
    bulk.addParam(3, 108, 4)
    for read in (bulk.txRxPacket, bulk.fastBulkRead):
        assert read() == sdk.COMM_SUCCESS
        assert (bulk.getData(2, 65, 1), bulk.getData(3, 108, 4)) == (1, 7)
    port.closePort()


def test_broadcast_ping_finds_each_bus(server):
    for bus, model, ids in (("legs", 1130, {1, 2, 3, 4}), ("wheels", 1060, {5, 6, 7, 8})):
        port, handler = connect(server, bus)
        found, result = handler.broadcastPing(port)
        assert result == sdk.COMM_SUCCESS
        assert found == {id: [model, 45] for id in ids}
        port.closePort()


def test_wrong_baud_rate_hears_nothing_and_the_right_one_does(server):
    port, handler = connect(server, baud=57_600)
    assert unanswered(handler, port, 2)
    assert port.setBaudRate(1_000_000)
    assert handler.ping(port, 2)[1] == sdk.COMM_SUCCESS
    assert handler.write1ByteTxRx(port, 2, 8, 6)[0] == sdk.COMM_SUCCESS  # to 4 Mbit/s, answered at the old speed
    assert unanswered(handler, port, 2)
    assert port.setBaudRate(4_000_000)
    assert handler.ping(port, 2)[1] == sdk.COMM_SUCCESS
    port.closePort()


def test_two_clients_one_after_the_other(server):
    for _ in range(2):
        port, handler = connect(server)
        assert handler.ping(port, 4)[1] == sdk.COMM_SUCCESS
        port.closePort()


def test_stepped_time_stands_still_between_steps(stepped):
    port, handler = connect(stepped)
    tick = handler.read2ByteTxRx(port, 2, 120)[0]
    time.sleep(0.05)
    assert handler.read2ByteTxRx(port, 2, 120)[0] == tick
    stepped.advance(0.25)
    assert handler.read2ByteTxRx(port, 2, 120)[0] == tick + 250
    assert stepped.command("step 0.5").endswith("0.750 s")
    with pytest.raises(InputError, match="expected step SECONDS"):
        stepped.command("step")
    port.closePort()


def test_step_is_refused_in_real_time(server):
    with pytest.raises(InputError, match="runs in real time"):
        server.command("step 1")


def test_imu_stream(server):
    import serial

    with serial.Serial(server.ports["imu"], 115200, timeout=0.2) as port:
        port.reset_input_buffer()
        parser, frames = FrameParser(IMU_FRAMES), []
        until(lambda: frames.extend(parser.feed(port.read(20 * IMU_FRAMES.size))) or len(frames) > 40)
    assert parser.lost == 0


def test_unplugged_port_is_gone_and_comes_back(tmp_path):
    import termios

    import serial

    machine = Machine(load_robot("emanual"), load_hardware(), MachineOptions(timing=NO_TIME))
    with Server(machine, real_time=False, links=tmp_path) as server:
        link = tmp_path / "legs"
        assert os.path.realpath(link) == server.ports["legs"]
        port = sdk.PortHandler(str(link))
        port.openPort()
        server.command("unplug legs duration=0.5")
        server.advance(0.01)
        assert not link.exists()
        with pytest.raises((OSError, serial.SerialException, termios.error)):  # depending on where it notices
            sdk.PacketHandler(2.0).ping(port, 2)
        server.advance(0.5)
        back = sdk.PortHandler(str(link))
        back.openPort()
        assert sdk.PacketHandler(2.0).ping(back, 2)[1] == sdk.COMM_SUCCESS
        back.closePort()
    assert not link.exists()


def test_an_emulator_that_is_slower_than_time_answers_and_its_clocks_go_on(monkeypatch):
    machine = Machine(load_robot("emanual"), load_hardware(), MachineOptions(sensor_noise=False, timing=NO_TIME))
    step = machine.step
    monkeypatch.setattr(machine, "step", lambda: time.sleep(2 * machine.options.tick) or step())
    with Server(machine) as server:
        port, handler = connect(server)
        until(lambda: server.slipped > 0.3)
        assert handler.ping(port, 2)[1] == sdk.COMM_SUCCESS
        port.closePort()
        moments: list[float] = []
        server.call(lambda: moments.extend([machine.servos["leg_lf"]["realtime_tick"], machine.time + server.slipped]))
    clock, lived = moments
    assert clock == pytest.approx(1e3 * lived, abs=1.0)


def test_a_failure_of_the_simulator_is_told(stepped, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError("in the plant")

    monkeypatch.setattr(stepped.machine, "step", fail)
    with pytest.raises(ZeroDivisionError):  # asked for: told to who asked, and serving goes on
        stepped.advance(0.01)
    assert stepped.command("faults") == "no faults"
    monkeypatch.setattr(stepped, "_listen", fail)
    with pytest.raises(ZeroDivisionError):
        stepped.command("faults")
    stepped._thread.join()
    with pytest.raises(RuntimeError, match="the emulator has failed: in the plant"):
        stepped.command("faults")
    assert isinstance(stepped.failure, ZeroDivisionError)


def test_control_socket(tmp_path):
    import socket

    machine = Machine(load_robot("emanual"), load_hardware(), MachineOptions(timing=NO_TIME))
    path = tmp_path / "control"
    with Server(machine, control=path), socket.socket(socket.AF_UNIX) as client:
        client.settimeout(5)
        client.connect(str(path))
        client.sendall(b"drop legs\n")
        assert b"drop legs" in client.recv(4096)
        client.sendall(b"nonsense\n")
        assert client.recv(4096).startswith(b"error: unknown command")
        client.sendall(b"clear\n")
        assert client.recv(4096) == b"cleared\n\n"
    assert not path.exists()
