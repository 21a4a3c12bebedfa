"""Real processes on real (pseudo-)terminals: kill -9, signals, the watchdog process. Few and short."""

import os
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")
pytest.importorskip("termios")

from robot_rig import HARDWARE, ROBOT, hardware_file

from wlr_gym.data.runs import read_run
from wlr_gym.hardware.dynamixel.bus import BusGroup
from wlr_gym.hardware.dynamixel.tables import load_table
from wlr_gym.hardware.emulator import Machine, MachineOptions, Server
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.safety.watchdog import Guard, switch_off

DRIVER = """
import sys, numpy as np
from pathlib import Path
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions
from wlr_gym.physics.plants.base import RobotOptions
from wlr_gym.hardware.loop import StoppedError
from wlr_gym.hardware.operator import stop_on_signals
from wlr_gym.robot import load_robot

options = RobotOptions(hardware=sys.argv[1], log=Path(sys.argv[2]))
plant = make_plant("dynamixel", load_robot(), 1, PlantOptions(), hardware=options)
try:
    with stop_on_signals(plant.loop.operator):
        plant.reset()
        setpoints = np.array([[1.5, 1.6, 1.5, 1.6, 2.0, 2.0, 2.0, 2.0]])
        for tick in range(100000):
            plant.step(setpoints)
            if tick == 10:
                print("driving", plant.loop._guard.process.pid, flush=True)
except StoppedError as stop:
    print("stopped:", stop)
finally:
    plant.close()
"""

PATIENCE = 120.0  # s: a busy computer may take this long


@pytest.fixture
def server():
    machine = Machine(ROBOT, HARDWARE, MachineOptions(timing=NO_TIME, tick=0.002))
    with Server(machine) as server:
        yield server


def start_driver(folder, server, **safety):
    """Return the driving process, once it drives, and its watchdog's process id."""
    words = [sys.executable, "-c", DRIVER, str(hardware_file(folder, server.ports, **safety)), str(folder / "log")]
    driver = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert driver.stdout is not None
    line = driver.stdout.readline()
    assert line.startswith("driving"), line
    return driver, int(line.split()[1])


def torque(server) -> list[bool]:
    return server.call(lambda: [bool(servo["torque_enable"]) for servo in server.machine.servos.values()])


def latched(server):
    return server.call(lambda: all(servo["bus_watchdog"] == -1 for servo in server.machine.servos.values()))


def wait_until(condition):
    """Return how long it took (s), and the longest time between two looks (s): how busy this computer was."""
    start, last, longest = time.monotonic(), time.monotonic(), 0.0
    while not condition():
        time.sleep(0.005)
        now = time.monotonic()
        longest, last = max(longest, now - last), now
        assert now - start < PATIENCE
    return time.monotonic() - start, longest


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_kill_9_is_no_way_past_torque_off(tmp_path, server):
    driver, watchdog = start_driver(tmp_path, server)
    assert all(torque(server))
    driver.kill()
    driver.wait()
    wait_until(lambda: not any(torque(server)))
    wait_until(lambda: not alive(watchdog))
    assert (tmp_path / "log" / "guard.jsonl").read_text().count("torque off") == 1
    run = read_run(tmp_path / "log" / "partial_run_01.csv")  # all that was seen, readable as it is
    assert len(run.table) >= 10


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_signals_end_a_driving_process_in_good_order(tmp_path, server, name):
    driver, watchdog = start_driver(tmp_path, server)
    driver.send_signal(getattr(signal, name))
    output, _ = driver.communicate(timeout=PATIENCE)
    assert driver.returncode == 0
    assert f"stopped: stop: {name}" in output
    assert not any(torque(server))
    wait_until(lambda: not alive(watchdog))
    assert len(read_run(tmp_path / "log" / "run_01.csv").table) > 10
    assert not (tmp_path / "log" / "guard.jsonl").exists()  # nothing was left for it


def test_the_watchdog_process_ends_when_it_is_told(server):
    guard = Guard(ROBOT, HARDWARE)
    guard.start()
    process = guard.process
    assert process is not None
    process.send_signal(signal.SIGINT)  # the terminal's Ctrl-C is not for it
    process.send_signal(signal.SIGTERM)
    assert process.poll() is None
    guard.release()
    assert process.wait(PATIENCE) == 0


def test_the_watchdog_process_waits_for_an_adapter_that_is_gone(server):
    groups = [
        BusGroup(
            name, server.ports[name], bus.baud_rate, {ROBOT.dynamixel_ids[j]: load_table(bus.model) for j in bus.joints}, 30.0
        )
        for name, bus in HARDWARE.buses.items()
    ]
    for servo in server.machine.servos.values():
        servo.write(64, b"\x01")
    groups[0].port.port_name = "/dev/none"
    assert switch_off(groups, 0.3) == {"legs": {1, 2, 3, 4}}
    assert torque(server) == [True] * 4 + [False] * 4
    groups[0].port.port_name = server.ports["legs"]
    assert switch_off(groups, 3.0) == {}
    assert not any(torque(server))


def test_a_driver_that_hangs_is_killed_and_torque_goes_off(tmp_path, server):
    """SIGSTOP: no signal is handled any more, and the port stays locked."""
    driver, watchdog = start_driver(tmp_path, server, heartbeat=0.8, watchdog=0.7)
    driver.send_signal(signal.SIGSTOP)
    wait_until(lambda: not any(torque(server)))
    assert driver.wait(PATIENCE) == -signal.SIGKILL
    wait_until(lambda: not alive(watchdog))
    assert '"driver": "hangs"' in (tmp_path / "log" / "guard.jsonl").read_text()


@pytest.mark.slow
def test_a_driver_whose_watchdog_process_is_gone_stops(tmp_path, server):
    driver, watchdog = start_driver(tmp_path, server)
    os.kill(watchdog, signal.SIGKILL)
    output, _ = driver.communicate(timeout=PATIENCE)
    assert "computer: the watchdog process is gone" in output
    assert not any(torque(server))


@pytest.mark.realtime
@pytest.mark.parametrize(("end", "bounds"), [(signal.SIGKILL, (0.25, 1.0)), (signal.SIGSTOP, (1.5, 1.5))])
def test_the_bounds_after_a_driver_ends_or_hangs(tmp_path, end, bounds):
    """Wheels stand and torque is off within so many seconds, on a computer that has time (one try of ten)."""
    times = []
    for attempt in range(10):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        stands, off, busy = seconds_after(end, folder)
        times.append((stands, off, busy))
        if stands < bounds[0] and off < bounds[1]:
            return
    if min(busy for *_, busy in times) > 0.05:
        pytest.skip(f"this computer is too busy: {times}")
    pytest.fail(f"{times}")


def seconds_after(end, folder):
    """Return after how many s all wheels stand, after how many torque is off, and the longest time between two looks (s)."""
    machine = Machine(ROBOT, HARDWARE, MachineOptions(timing=NO_TIME))
    with Server(machine) as server:
        driver, _ = start_driver(folder, server, watchdog=HARDWARE.safety.watchdog, heartbeat=0.8)
        driver.send_signal(end)
        stands, busy = wait_until(lambda: latched(server) or not any(torque(server)))
        off, busy_then = wait_until(lambda: not any(torque(server)))
        driver.wait()
    return stands, stands + off, max(busy, busy_then)
