"""The emulated robot on pseudo-terminals: one for each bus and each sensor, and a control socket for faults.

Linux and macOS. One thread does everything, so emulated time and bytes are in order. On a pseudo-terminal bytes take no time;
:class:`wlr_gym.hardware.emulator.line.LineTiming` says when answers may appear, and they are held back until then.
"""

from __future__ import annotations

import contextlib
import os
import re
import select
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np

from wlr_gym.base.errors import InputError, check_name, unknown_name
from wlr_gym.base.files import make_output_folder
from wlr_gym.hardware.dynamixel.tables import error_names
from wlr_gym.hardware.emulator.faults import FAULTS
from wlr_gym.hardware.emulator.machine import Machine

#: Emulated time may fall behind by this much (s); beyond, it slips. Short of what trips a Bus Watchdog: bytes wait meanwhile.
LARGEST_LAG = 0.05
#: s by which it may be behind when bytes have come in, and servos say what time it is.
ANSWER_LAG = 0.005
_TERMINAL = re.compile(r"/dev/(pts/|ttys)\d+")  # what our links point to, now or until an emulator was killed
_TCGETS2 = 0x802C542A  # Linux ioctl: terminal settings with the speed as a number
_HELP = """\
status | faults | clear [KIND] | turn JOINT DEGREES | straighten LEG | help
KIND [WHERE ...] [probability=] [value=] [after=] [duration=]
"""


def run_command(machine: Machine, text: str) -> str:
    """Carry out one line of text (a fault, ``clear``, ``faults``, ``status``, ``turn``, ``straighten``, ``help``); answer it.

    Raises:
        InputError: it cannot be understood.
    """
    word, *rest = text.split() or ["help"]
    if word in FAULTS:
        return f"{machine.time:.3f} s: {machine.inject(text)}"
    match word:
        case "clear":
            kind = rest[0] if rest else None
            if kind is not None:
                check_name("fault", kind, FAULTS)
            machine.clear(kind)
            return "cleared"
        case "turn":
            try:
                joint, degrees = rest
                angle = float(np.deg2rad(float(degrees)))
            except ValueError:
                raise InputError(f"'{text}': expected turn JOINT DEGREES") from None
            machine.turn(joint, angle)
            return f"{joint} turned by {degrees} deg"
        case "straighten":
            machine.straighten(" ".join(rest))
            return f"{rest[0]} hangs straight down"
        case "faults":
            return "\n".join(machine.faults.listing(machine.time)) or "no faults"
        case "status":
            return _status(machine)
        case "help":
            lines = []
            for name, kind in FAULTS.items():
                value = f" (value: {kind.unit}, default {kind.value:g})" if kind.unit else ""
                lines.append(f"  {name:9} {kind.doc}{value}")
            return _HELP + "\n".join(lines)
    raise unknown_name("command", word, ["faults", "status", "help", "clear", "turn", "straighten", *FAULTS])


def _status(machine: Machine) -> str:
    """One line per servo: torque, mode, position, velocity, supply, temperature, errors."""
    lines = [f"{machine.time:.3f} s"]
    for joint, servo in machine.servos.items():
        errors = ", ".join(error_names(servo["hardware_error_status"])) or "no error"
        power = "no power" if servo.dead else "torque on" if servo["torque_enable"] else "torque off"
        lines.append(
            f"{joint:9} id {servo['id']:3}  {power:10}  mode {servo['operating_mode']:2}"
            f"  position {servo['present_position']:6}  velocity {servo['present_velocity']:4}"
            f"  {servo['present_input_voltage'] / 10:4.1f} V  {servo['present_temperature']:3} degC  {errors}"
        )
    return "\n".join(lines)


class Port:
    """One pseudo-terminal, of which a client opens the far side.

    Args:
        link: where to put a link of a fixed name to it; None = nowhere.

    Attributes:
        master: our side; None = unplugged.
        path: of the far side.
    """

    def __init__(self, link: Path | None) -> None:
        self._link = link
        self.master: int | None = None
        self.path = ""
        self.plug()

    def plug(self) -> None:
        """Make the terminal, raw from the start: echo and newline translation would corrupt packets."""
        import tty

        self.master, self._slave = os.openpty()  # the open far side keeps the near side from failing between clients
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.path = os.ttyname(self._slave)
        if self._link is not None:
            temporary = self._link.with_name(f".{self._link.name}-{os.getpid()}")
            temporary.symlink_to(self.path)
            temporary.replace(self._link)

    def unplug(self) -> None:
        """Take the terminal away: clients get an input/output error, as from a real adapter."""
        if self.master is None:
            return
        os.close(self.master)
        os.close(self._slave)
        self.master = None
        if self._link is not None:
            self._link.unlink(missing_ok=True)

    def read(self) -> bytes:
        """Return what the client wrote."""
        if self.master is not None:
            with contextlib.suppress(OSError):
                return os.read(self.master, 4096)
        return b""

    def write(self, data: bytes) -> None:
        """Pass bytes to the client; what nobody reads is lost when the buffer is full."""
        if self.master is not None:
            with contextlib.suppress(OSError):
                os.write(self.master, data)

    def baud_rate(self) -> int | None:
        """Return the speed the client set, bit/s; None where the system does not tell."""
        if not sys.platform.startswith("linux"):
            return None
        import fcntl

        settings = fcntl.ioctl(self._slave, _TCGETS2, bytes(44))
        return struct.unpack("4I20s2I", settings)[-1]


class Server:
    """Serves a :class:`Machine` on pseudo-terminals, in a thread of its own while its context lasts.

    Args:
        machine: the robot.
        real_time: emulated time follows the clock; False = it passes only in :meth:`advance`.
        links: folder for links of fixed names (bus names, ``imu``, ``flow``) to the terminals; None = none.
        control: path of a Unix socket that takes command lines (see :meth:`command`); None = none.

    Attributes:
        slipped: s of emulated time given up because the computer was too busy.
        failure: what ended serving, if it was not the end of the context.
        origin: this computer's monotonic clock minus emulated time, s; grows when emulated time slips.

    Raises:
        InputError: links or control cannot be made.
    """

    def __init__(
        self, machine: Machine, *, real_time: bool = True, links: Path | None = None, control: Path | None = None
    ) -> None:
        self.machine = machine
        self.slipped = self.origin = 0.0
        self.failure: Exception | None = None
        self._real_time = real_time
        names = (*machine.hardware.buses, *machine.sensors)
        if links is not None:
            make_output_folder(links, "--links")
            for path in (links / name for name in names):
                if path.exists() and not (path.is_symlink() and _TERMINAL.fullmatch(os.readlink(path))):
                    raise InputError(f"--links {links}: '{path.name}' in it is no emulator's link; expected another folder")
        self._control, self._clients = None if control is None else _listen_at(control), list[socket.socket]()
        try:
            self._ports = {name: Port(None if links is None else links / name) for name in names}
        except OSError as error:
            self._close_control()
            raise InputError(f"ports cannot be made: {error}") from None
        self._wake, self._waker = os.pipe()
        self._requests: list[tuple[Callable[[], Any], Future[Any]]] = []
        self._lock = threading.Lock()
        self._is_over = False
        self._thread = threading.Thread(target=self._serve, name="wlr-emulator", daemon=True)

    @property
    def ports(self) -> dict[str, str]:
        """Bus name, ``imu`` or ``flow`` -> path to open; changes when an adapter was unplugged and is back."""
        return {name: port.path for name, port in self._ports.items()}

    def __enter__(self) -> Server:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._is_over = True
        os.write(self._waker, b"x")
        self._thread.join()
        for port in self._ports.values():
            port.unplug()
        self._close_control()
        os.close(self._wake)
        os.close(self._waker)

    def _close_control(self) -> None:
        if self._control is not None:
            Path(self._control.getsockname()).unlink(missing_ok=True)
            for peer in (self._control, *self._clients):
                peer.close()

    def call(self, action: Callable[[], Any]) -> Any:
        """Run ``action`` between two ticks, in the serving thread, and return its result; any thread may ask."""
        future: Future[Any] = Future()
        with self._lock:
            if self.failure is not None:
                raise RuntimeError(f"the emulator has failed: {self.failure}") from self.failure
            is_ours = threading.current_thread() is self._thread or not self._thread.is_alive()
            if not is_ours:
                self._requests.append((action, future))
        if is_ours:
            return action()
        os.write(self._waker, b"x")
        return future.result()

    def command(self, text: str) -> str:
        """Carry out one command line (see :func:`run_command`; without real time ``step SECONDS``, too); any thread may ask."""
        word, *rest = text.split() or ["help"]
        if word != "step":
            return self.call(lambda: run_command(self.machine, text))
        if self._real_time:
            raise InputError("step: this emulator runs in real time")
        try:
            duration = float(rest[0])
        except (IndexError, ValueError):
            raise InputError(f"'{text}': expected step SECONDS") from None
        self.advance(duration)
        return f"{self.machine.time:.3f} s"

    def advance(self, duration: float) -> None:
        """Let ``duration`` seconds of emulated time pass (without real time)."""

        def act() -> None:
            for _ in range(round(duration / self.machine.options.tick)):
                self._step()
                self._emit()

        self.call(act)

    # ---- the serving thread ----

    def _serve(self) -> None:
        self.origin = time.monotonic() - self.machine.time
        try:
            while not self._is_over:
                ready = self._wait()
                if self._real_time:
                    self._slip(LARGEST_LAG)
                    now = self._now()  # not asked again: who is slower than time would never listen
                    while self.machine.time + self.machine.options.tick <= now:
                        self._step()
                self._listen(ready)
                self._emit()
        except Exception as error:
            with self._lock:
                self.failure = error
            for _, future in self._requests:
                future.set_exception(error)

    def _now(self) -> float:
        return time.monotonic() - self.origin if self._real_time else self.machine.time

    def _wait(self) -> list[str]:
        """Wait until something is due or comes in; serve requests and sockets; return the ports that have bytes."""
        masters = {name: port.master for name, port in self._ports.items() if port.master is not None}
        sockets = [] if self._control is None else [self._control, *self._clients]
        timeout = None
        if self._real_time:
            due = min(self.machine.time + self.machine.options.tick, self.machine.next_arrival)
            timeout = max(0.0, due - self._now())
        ready, _, _ = select.select([*masters.values(), self._wake, *sockets], [], [], timeout)
        if self._wake in ready:
            os.read(self._wake, 4096)
            self._listen(list(self._ports))  # what was written before the request comes before it
            self._serve_requests()
        for peer in sockets:
            if peer in ready:
                self._serve_socket(peer)
        return [name for name, master in masters.items() if master in ready]

    def _slip(self, largest: float) -> None:
        """Give up the time (s) by which emulated time is further behind."""
        if self._real_time and (more := self._now() - self.machine.time - largest) > 0.0:
            self.slipped += more
            self.origin += more
            self.machine.pause(more)

    def _step(self) -> None:
        self.machine.step()
        for name, port in self._ports.items():
            is_plugged = self.machine.is_plugged[name]
            if is_plugged and port.master is None:
                port.plug()
            elif not is_plugged:
                port.unplug()

    def _listen(self, names: list[str]) -> None:
        for name in names:
            port = self._ports[name]
            if data := port.read():
                self._slip(ANSWER_LAG)
                self.machine.receive(name, data, self._now(), port.baud_rate())

    def _emit(self) -> None:
        now = self._now()
        for name, port in self._ports.items():
            if data := self.machine.arrived(name, now):
                port.write(data)

    def _serve_requests(self) -> None:
        with self._lock:
            requests, self._requests = self._requests, []
        for action, future in requests:
            try:
                future.set_result(action())
            except Exception as error:
                future.set_exception(error)

    def _serve_socket(self, peer: socket.socket) -> None:
        if peer is self._control:
            self._clients.append(peer.accept()[0])
            return
        data = peer.recv(65536)
        if not data:
            self._clients.remove(peer)
            peer.close()
        for line in data.decode("utf-8", "replace").splitlines():
            try:
                answer = self.command(line)
            except InputError as error:
                answer = f"error: {error}"
            with contextlib.suppress(OSError):
                peer.sendall(answer.encode() + b"\n\n")


def _listen_at(path: Path) -> socket.socket:
    if path.exists() and not path.is_socket():
        raise InputError(f"--control {path}: is there and no socket; expected a new path")
    control = socket.socket(socket.AF_UNIX)
    try:
        if control.connect_ex(str(path)) == 0:
            raise InputError(f"--control {path}: another emulator listens there; expected a new path")
        path.unlink(missing_ok=True)
        control.bind(str(path))
    except OSError as error:
        raise InputError(f"--control {path}: cannot be a socket: {error.strerror or error}") from None
    control.listen()
    return control
