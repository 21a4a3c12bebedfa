"""Whether the host keeps up with the robot: bus cycles, and ``wlr deploy`` in real time, with and without a camera.

A cycle reads all eight servos and writes all setpoints, ours against dynamixel-sdk's own group classes. The other side is a
process of its own that answers on pseudo-terminals with what the emulator answered to the same bytes the first time, so that
little but the host's side is measured: no wire time, no USB latency, no emulator at work.

Drives take a minute at 50 Hz, with the emulated robot in another process. The live camera sees a recorded film, so that only
what runs on the robot's computer is measured, at 30 frames per second; and frames that are rendered from the emulated robot
while it drives, as many as there is time for.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from studies.bench.measure import Measurement, Size, interleave, rate
from wlr_gym.base.errors import require_package
from wlr_gym.base.provenance import write_yaml
from wlr_gym.hardware.camera.reading import CameraFile, load_camera_file
from wlr_gym.hardware.camera.rendered import RenderedCamera, RobotPose
from wlr_gym.hardware.config import Hardware, load_hardware, with_ports
from wlr_gym.hardware.dynamixel.tables import Item, load_table
from wlr_gym.hardware.log import read_events
from wlr_gym.robot import JOINTS, LEGS, Robot, load_robot

if TYPE_CHECKING:
    from wlr_gym.hardware.emulator import Machine

_PEER = "dynamixel-sdk, GroupSyncRead (fast) and GroupSyncWrite"
#: First and last item of what is read every tick.
_FIRST = "realtime_tick"
_LAST = "present_position"
_TICKS_PER_SECOND = 50
#: s beyond its own that a drive may take to start, to ramp up and to stop; one that takes longer hangs.
_GRACE = 60.0
_DRIVE = """
import sys
from wlr_gym.cli import main
file, seconds, log, *rest = sys.argv[1:]
sys.exit(main(["deploy", "--emulated", "--hardware", file, "--seconds", seconds, "--out", log, *rest]))
"""
#: Safety limits that let a drive on a busy computer go on: an answer that comes late makes a tick late, and is counted there.
_PATIENT = {
    "patience": 0.2, "read_time": 1.0, "late": 10_000, "late_share": 1.0, "silence": 3.0, "coast": 1.0, "imu_silence": 3.0,
    "watchdog": 2.5, "heartbeat": 10.0,
}  # fmt: skip
Cycle = Callable[[], None]


def measure_bus(size: Size) -> list[Measurement]:
    """Bus cycles against the peer's, and deadlines kept in a real-time drive."""
    require_package("dynamixel_sdk", "robot")
    require_package("serial", "robot")
    return [*_measure_cycle(size), *_measure_deadlines(size)]


def _measure_cycle(size: Size) -> list[Measurement]:
    """Cycles per second, processor time of a cycle, and the time from the readings' arrival to the setpoints' departure."""
    cycles = size(1000, 20)
    hardware = load_hardware()
    robot = load_robot(hardware.robot or "nominal")
    with _answering(robot, hardware) as ports, contextlib.ExitStack() as stack:
        wired = with_ports(hardware, ports)
        ours, delay = stack.enter_context(_our_cycle(robot, wired))
        peer = stack.enter_context(_sdk_cycle(robot, wired))
        clocks = {"wall": time.perf_counter, "processor": time.process_time}
        rates = {
            name: interleave({"ours": _rate(ours, cycles, clock), "peer": _rate(peer, cycles, clock)}, size.rounds)
            for name, clock in clocks.items()
        }
        latency = [[1e6 * delay() for _ in range(cycles)] for _ in range(size.rounds)]
    what = "bus cycle, 8 servos, 2 buses, SI values"
    per_cycle = tuple(1e6 / one for one in rates["wall"]["ours"])
    return [
        Measurement("bus", what, "1/s", rates["wall"]["ours"], rates["wall"]["peer"], _PEER),
        Measurement("bus", f"{what}, processor time", "1/s", rates["processor"]["ours"], rates["processor"]["peer"], _PEER),
        Measurement("bus", "whole cycle without wire time", "us", per_cycle, bar=1000.0),
        Measurement("bus", "read to write, median", "us", tuple(float(np.median(times)) for times in latency)),
        Measurement("bus", "read to write, p99", "us", tuple(float(np.percentile(times, 99)) for times in latency)),
    ]


def _measure_deadlines(size: Size) -> list[Measurement]:
    """Ticks that drives at 50 Hz missed, of all rounds; how late the others started and setpoints left, once a round."""
    seconds = size(60, 2)
    drives = [drive_in_real_time(seconds, ["pid"]) for _ in range(size.rounds)]
    what = f"{seconds} s at {_TICKS_PER_SECOND} Hz on the emulated robot"
    missed = float(sum(drive["missed"] for drive in drives))  # not per round: a median would leave out the worst
    late, sent = (tuple(1e3 * drive[name]["p99"] for drive in drives) for name in ("jitter", "latency"))
    return [
        Measurement("bus", f"{what}, ticks missed in {size.rounds} rounds", "ticks", (missed,), bar=1.0),
        Measurement("bus", f"{what}, start after the deadline, p99", "us", late, bar=3000.0),
        Measurement("bus", f"{what}, read to write, p99", "us", sent),
    ]


def drive_in_real_time(seconds: int, words: Sequence[str]) -> dict[str, Any]:
    """Run ``wlr deploy`` on an emulated robot as a user does; return the control loop's statistics.

    Args:
        seconds: to drive. words: policy and further options.

    Raises:
        RuntimeError: it failed, or hung.
    """
    import yaml

    hardware = load_hardware()
    hardware = hardware.model_copy(update={"safety": hardware.safety.model_copy(update=_PATIENT)})
    with tempfile.TemporaryDirectory(prefix="wlr-bench-") as folder:
        file, log = Path(folder) / "hardware.yaml", Path(folder) / "log"
        file.write_text(yaml.safe_dump(hardware.model_dump(mode="json")), encoding="utf-8")
        command = [sys.executable, "-c", _DRIVE, str(file), str(seconds), str(log), *words]
        try:
            done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=seconds + _GRACE)
        except subprocess.TimeoutExpired as error:
            raise RuntimeError(f"the emulated robot was not driven to the end within {error.timeout:g} s") from None
        if done.returncode != 0:
            raise RuntimeError(f"the emulated robot was not driven to the end:\n{done.stdout}{done.stderr}")
        return read_events(log / "run_01.csv")[-1]["statistics"]


def _rate(cycle: Cycle, count: int, clock: Callable[[], float]) -> Callable[[], float]:
    def cycles() -> None:
        for _ in range(count):
            cycle()

    return lambda: rate(cycles, count, clock)


# ---- the contenders --------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _our_cycle(robot: Robot, hardware: Hardware) -> Iterator[tuple[Cycle, Callable[[], float]]]:
    """A cycle of :class:`wlr_gym.hardware.servos.Servos`, and one that returns the s between readings and setpoints."""
    from wlr_gym.hardware.servos import Servos

    setpoints = np.where(np.arange(len(JOINTS)) < len(LEGS), np.pi / 2, 1.0)
    with Servos(robot, hardware, 1.0, lambda: 0.0) as servos:  # recorded answers: the servos' clocks stand still
        servos.supervise()

        def cycle() -> None:
            if not servos.read().answered.all():
                raise RuntimeError("an answer was lost on a pseudo-terminal")
            servos.write_setpoints(setpoints)

        def delay() -> float:
            servos.read()
            start = time.perf_counter()
            servos.write_setpoints(setpoints)
            return time.perf_counter() - start

        yield cycle, delay


@contextlib.contextmanager
def _sdk_cycle(robot: Robot, hardware: Hardware) -> Iterator[Cycle]:
    """The same cycle as a user of the SDK writes it: read, values in SI units, setpoints in counts, write, bus after bus."""
    buses = [_SdkBus(robot, hardware, name) for name in hardware.buses]

    def cycle() -> None:
        for bus in buses:
            bus.read()
        for bus in buses:
            bus.write(1.57 if bus.is_legs else 1.0)

    try:
        yield cycle
    finally:
        for bus in buses:
            bus.port.closePort()


class _SdkBus:
    def __init__(self, robot: Robot, hardware: Hardware, name: str) -> None:
        import dynamixel_sdk as sdk

        bus = hardware.buses[name]
        table = load_table(bus.model)
        self.is_legs = bus.joints[0] in LEGS
        self.ids = [robot.dynamixel_ids[joint] for joint in bus.joints]
        self.port, handler = sdk.PortHandler(bus.port), sdk.PacketHandler(2.0)
        if not (self.port.openPort() and self.port.setBaudRate(bus.baud_rate)):
            raise RuntimeError(f"dynamixel-sdk cannot open {bus.port}")
        address, length = table.block(_FIRST, _LAST)
        effort = "present_current" if "present_current" in table.items else "present_load"
        self.wanted = [(table[item], table.per_count(item)) for item in (effort, "present_velocity", _LAST)]
        self.reader = sdk.GroupSyncRead(self.port, handler, address, length)
        goal = table["goal_position" if self.is_legs else "goal_velocity"]
        self.goal_count = table.per_count(goal.name)
        self.writer = sdk.GroupSyncWrite(self.port, handler, goal.address, goal.size)
        for id in self.ids:
            self.reader.addParam(id)

    def read(self) -> list[list[float]]:
        """Return effort, velocity and position of each servo in SI units."""
        while self.reader.fastSyncRead() != 0:  # 34 ms are over: this computer has much else to do
            pass
        return [[self._value(id, item) * unit for item, unit in self.wanted] for id in self.ids]

    def _value(self, id: int, item: Item) -> int:
        value = self.reader.getData(id, item.address, item.size)
        return value - (1 << 8 * item.size) if item.signed and value >> (8 * item.size - 1) else value

    def write(self, setpoint: float) -> None:
        """Write the same setpoint (rad, rad/s) to each servo."""
        count = round(setpoint / self.goal_count)
        for id in self.ids:
            self.writer.addParam(id, list(count.to_bytes(4, "little")))
        self.writer.txPacket()
        self.writer.clearParam()


# ---- the other side --------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _answering(robot: Robot, hardware: Hardware) -> Iterator[dict[str, str]]:
    """Bus name -> pseudo-terminal on which a process of its own answers."""
    import tty

    from wlr_gym.hardware.emulator import Machine, MachineOptions
    from wlr_gym.hardware.emulator.line import NO_TIME

    machine = Machine(robot, hardware, MachineOptions(timing=NO_TIME, sensor_noise=False))
    for joint in JOINTS:
        machine.servos[joint].set("torque_enable", 1)
    pairs = {name: os.openpty() for name in hardware.buses}
    for _, slave in pairs.values():
        tty.setraw(slave)
    process = os.fork()
    if process == 0:
        with contextlib.suppress(BaseException):
            _answer(machine, {master: name for name, (master, _) in pairs.items()})
        os._exit(0)
    try:
        yield {name: os.ttyname(slave) for name, (_, slave) in pairs.items()}
    finally:
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
        for master, slave in pairs.values():
            os.close(master)
            os.close(slave)
        machine.close()


def _answer(machine: Machine, names: Mapping[int, str]) -> None:
    known: dict[tuple[int, bytes], bytes] = {}
    while True:
        for master in select.select(list(names), [], [])[0]:
            key = master, os.read(master, 4096)
            if key not in known:
                emissions = machine.lines[names[master]].receive(key[1], machine.time)
                known[key] = b"".join(emission.data for emission in emissions)
            if known[key]:
                os.write(master, known[key])


# ---- the live camera beside the control loop -------------------------------------------------------------------------


#: Frames of the film: a circle, so that its end joins its beginning.
_FRAMES = 120
#: m, radius of the circle.
_CIRCLE = 0.15
_POLICY = "velocity_slip_aware"
_RATE = 30.0


def measure_perception(size: Size) -> list[Measurement]:
    """Frames per second, ticks missed, and the age of poses, with a film and with rendered frames."""
    for package, extra in (("cv2", "vision"), ("dynamixel_sdk", "robot"), ("serial", "robot")):
        require_package(package, extra)
    seconds, rounds, rows = size(30, 2), min(size.rounds, 3), []
    with tempfile.TemporaryDirectory(prefix="wlr-bench-") as folder:
        film = _film(Path(folder), load_camera_file("emulated"), load_robot(), size(_FRAMES, 12))
        for kind, camera, bar in (("film", str(film), 1.0), ("rendered as it drives", "emulated", None)):
            drives = [drive_in_real_time(seconds, [_POLICY, "--camera", camera]) for _ in range(rounds)]
            seen = [drive["camera"] for drive in drives]
            rates, late = tuple(one["rate"] for one in seen), tuple(1e3 * one["work"]["p99"] for one in seen)
            missed = float(sum(drive["missed"] for drive in drives))
            what = f"{seconds} s at 50 Hz beside the camera, {kind}"
            rows += [
                Measurement("perception", f"{what}: frames per second of {_RATE:g}", "1/s", rates),
                Measurement("perception", f"{what}: ticks missed in {rounds} rounds", "ticks", (missed,), bar=bar),
                Measurement("perception", f"{what}: pictures to poses, p99", "us", late),
            ]
    return rows


def _film(folder: Path, file: CameraFile, robot: Robot, frames: int) -> Path:
    """Render a film of a robot that drives in a circle; return the camera's file that shows it."""
    camera = RenderedCamera(file, robot)
    height = robot.leg.length + robot.wheel.radius - robot.hip_position.z
    pictures = []
    for number in range(frames):
        angle = 2 * math.pi * number / frames
        place = np.array([_CIRCLE * math.sin(angle), _CIRCLE * (1 - math.cos(angle)), height])
        turn = np.array([math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)])
        pose = RobotPose(0.0, place, turn, np.full(4, math.pi / 2))
        pictures.append(camera.picture(camera.exposure(number), [pose, pose]))
    np.save(folder / "film.npy", np.stack(pictures))
    content = file.model_copy(update={"device": str(folder / "film.npy"), "rate": _RATE}).model_dump(mode="json")
    path = folder / "film.yaml"
    write_yaml(path, content)
    return path
