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
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from pathlib import Path

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import make_output_folder
from wlr_gym.hardware.emulator.machine import Machine, run_command

#: Emulated time may fall behind by this much (s); beyond, it slips. Short of what trips a Bus Watchdog: bytes wait meanwhile.
LARGEST_LAG = 0.05
#: s by which it may be behind when bytes have come in, and servos say what time it is.
ANSWER_LAG = 0.005
_TERMINAL = re.compile(r"/dev/(pts/|ttys)\d+")  # what our links point to, now or until an emulator was killed
_TCGETS2 = 0x802C542A  # Linux ioctl: terminal settings with the speed as a number


class Port:
    """One pseudo-terminal, of which a client opens the far side.

    Args:
        name: bus name, ``imu`` or ``flow``.
        link: where to put a link of a fixed name to it; None = nowhere.
    """

    def __init__(self, name: str, link: Path | None) -> None:
        self.name = name
        self._link = link
        self.master = -1
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
        if self.master >= 0:
            os.close(self.master)
            os.close(self._slave)
            self.master = -1
            if self._link is not None:
                self._link.unlink(missing_ok=True)

    @property
    def plugged(self) -> bool:
        """Whether it is there."""
        return self.master >= 0

    def read(self) -> bytes:
        """Return what the client wrote."""
        try:
            return os.read(self.master, 4096)
        except (BlockingIOError, OSError):
            return b""

    def write(self, data: bytes) -> None:
        """Pass bytes to the client; what nobody reads is lost when the buffer is full."""
        with contextlib.suppress(BlockingIOError, OSError):
            os.write(self.master, data)

    def baud_rate(self) -> int | None:
        """Return the speed the client set, bit/s; None where the system does not tell."""
        if not sys.platform.startswith("linux"):
            return None
        import fcntl

        settings = fcntl.ioctl(self._slave, _TCGETS2, bytes(44))
        return struct.unpack("4I20s2I", settings)[-1]


class Server:
    """Serves a :class:`Machine` on pseudo-terminals, in a thread of its own or in the caller's.

    Use as a context manager, or call :meth:`start` and :meth:`stop`; or :meth:`serve` until :meth:`stop` or an exception.

    Args:
        machine: the robot.
        real_time: emulated time follows the clock; False = it passes only in :meth:`advance`.
        links: folder for links of fixed names (bus names, ``imu``, ``flow``) to the terminals; None = none.
        control: path of a Unix socket that takes command lines (see :func:`run_command`); None = none.

    Attributes:
        slipped: s of emulated time given up because the computer was too busy.
        failure: what ended serving, if it was not :meth:`stop`.
        origin: this computer's monotonic clock minus emulated time, s; grows when emulated time slips.

    Raises:
        InputError: links or control cannot be made.
    """

    def __init__(
        self, machine: Machine, *, real_time: bool = True, links: Path | None = None, control: Path | None = None
    ) -> None:
        self.machine = machine
        self.slipped = 0.0
        self.failure: Exception | None = None
        self._real_time = real_time
        self._names = [*machine.hardware.buses, *machine.sensors]
        if links is not None:
            _make_folder(links, self._names)
        self._control = _listen(control) if control is not None else None
        self._ports = self._make_ports(links)
        self._control_path = control
        self._clients: list[socket.socket] = []
        self._wake, self._waker = os.pipe()
        self._requests: list[tuple[Callable[[], object], Future[object]]] = []
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._running = False
        self.origin = 0.0

    def _make_ports(self, links: Path | None) -> dict[str, Port]:
        try:
            return {name: Port(name, None if links is None else links / name) for name in self._names}
        except OSError as error:
            if self._control is not None:
                Path(self._control.getsockname()).unlink()
            raise InputError(f"ports cannot be made: {error}") from None

    @property
    def ports(self) -> dict[str, str]:
        """Bus name, ``imu`` or ``flow`` -> path to open; changes when an adapter was unplugged and is back."""
        return {name: port.path for name, port in self._ports.items()}

    # ---- life ----

    def __enter__(self) -> Server:
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def start(self) -> None:
        """Serve in a thread."""
        self._thread = threading.Thread(target=self.serve, name="wlr-emulator", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End serving and take the ports away."""
        self._running = False
        os.write(self._waker, b"x")
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        for port in self._ports.values():
            port.unplug()
        for client in self._clients:
            client.close()
        if self._control is not None and self._control_path is not None:
            self._control.close()
            self._control_path.unlink(missing_ok=True)
        os.close(self._wake)
        os.close(self._waker)

    def call(self, action: Callable[[], object]) -> object:
        """Run ``action`` between two ticks, in the serving thread, and return its result (any thread may ask)."""
        if self._thread is None:
            return action()
        future: Future[object] = Future()
        with self._lock:
            if self.failure is not None:
                raise RuntimeError(f"the emulator has failed: {self.failure}") from self.failure
            self._requests.append((action, future))
        os.write(self._waker, b"x")
        return future.result()

    def command(self, text: str) -> str:
        """Carry out one command line (see :func:`run_command`; ``step S`` here too); any thread may ask.

        Raises:
            InputError: it cannot be understood.
        """
        return str(self.call(lambda: self._carry_out(text)))

    def advance(self, duration: float) -> None:
        """Let ``duration`` seconds of emulated time pass (without real time)."""
        self.call(lambda: self._advance(duration))

    # ---- the loop ----

    def serve(self) -> None:
        """Serve until :meth:`stop`."""
        self._running = True
        self.origin = time.monotonic() - self.machine.time
        try:
            while self._running:
                ready = self._wait()
                self._catch_up()
                self._listen(ready)
                self._emit()
        except Exception as error:
            with self._lock:
                self.failure = error
            for _, future in self._requests:
                future.set_exception(error)
            if self._thread is None:
                raise

    def _now(self) -> float:
        return time.monotonic() - self.origin if self._real_time else self.machine.time

    def _wait(self) -> list[str]:
        """Wait until something is due or comes in; serve requests and sockets; return the ports that have bytes."""
        watched = [port.master for port in self._ports.values() if port.plugged] + [self._wake]
        sockets = [s for s in (self._control, *self._clients) if s is not None]
        timeout = None
        if self._real_time:
            due = min(self.machine.time + self.machine.options.tick, self.machine.next_arrival)
            timeout = max(0.0, due - self._now())
        ready, _, _ = select.select([*watched, *sockets], [], [], timeout)
        if self._wake in ready:
            os.read(self._wake, 4096)
            self._listen(list(self._ports))  # what was written before the request comes before it
            self._serve_requests()
        for peer in sockets:
            if peer in ready:
                self._serve_socket(peer)
        return [name for name, port in self._ports.items() if port.plugged and port.master in ready]

    def _catch_up(self) -> None:
        if not self._real_time:
            return
        self._slip(LARGEST_LAG)
        now = self._now()  # not asked again: who is slower than time would never listen
        while self.machine.time + self.machine.options.tick <= now:
            self._step()

    def _slip(self, largest: float) -> None:
        """Give up the time (s) by which emulated time is further behind."""
        if self._real_time and (more := self._now() - self.machine.time - largest) > 0.0:
            self.slipped += more
            self.origin += more
            self.machine.pause(more)

    def _advance(self, duration: float) -> None:
        for _ in range(round(duration / self.machine.options.tick)):
            self._step()
            self._emit()

    def _step(self) -> None:
        self.machine.step()
        for name, port in self._ports.items():
            if port.plugged and not self.machine.is_plugged[name]:
                port.unplug()
            elif self.machine.is_plugged[name] and not port.plugged:
                port.plug()

    def _listen(self, names: list[str]) -> None:
        for name in names:
            port = self._ports[name]
            data = port.read() if port.plugged else b""
            if data and name in self.machine.lines:  # the microcontrollers of the sensors take no orders
                self._slip(ANSWER_LAG)
                self.machine.receive(name, data, self._now(), port.baud_rate())

    def _emit(self) -> None:
        now = self._now()
        for name, port in self._ports.items():
            data = self.machine.arrived(name, now)
            if data and port.plugged:
                port.write(data)

    # ---- commands ----

    def _serve_requests(self) -> None:
        with self._lock:
            requests, self._requests = self._requests, []
        for action, future in requests:
            try:
                future.set_result(action())
            except Exception as error:
                future.set_exception(error)

    def _carry_out(self, text: str) -> str:
        word, *rest = text.split() or ["help"]
        if word != "step":
            return run_command(self.machine, text)
        if self._real_time:
            raise InputError("step: this emulator runs in real time")
        try:
            duration = float(rest[0])
        except (IndexError, ValueError):
            raise InputError(f"'{text}': expected step SECONDS") from None
        self._advance(duration)
        return f"{self.machine.time:.3f} s"

    def _serve_socket(self, peer: socket.socket) -> None:
        if peer is self._control:
            self._clients.append(peer.accept()[0])
            return
        data = peer.recv(65536)
        if not data:
            self._clients.remove(peer)
            peer.close()
            return
        for line in data.decode("utf-8", "replace").splitlines():
            try:
                answer = self._carry_out(line)
            except InputError as error:
                answer = f"error: {error}"
            with contextlib.suppress(OSError):
                peer.sendall(answer.encode() + b"\n\n")


def _make_folder(links: Path, names: Sequence[str]) -> None:
    make_output_folder(links, "--links")
    for path in (links / name for name in names):
        if path.exists() and not (path.is_symlink() and _TERMINAL.fullmatch(os.readlink(path))):
            raise InputError(f"--links {links}: '{path.name}' in it is no emulator's link; expected another folder")


def _listen(path: Path) -> socket.socket:
    control = socket.socket(socket.AF_UNIX)
    if path.exists() and not path.is_socket():
        raise InputError(f"--control {path}: is there and no socket; expected a new path")
    try:
        if control.connect_ex(str(path)) == 0:
            raise InputError(f"--control {path}: another emulator listens there; expected a new path")
        path.unlink(missing_ok=True)
        control.bind(str(path))
    except OSError as error:
        raise InputError(f"--control {path}: cannot be a socket: {error.strerror or error}") from None
    control.listen()
    return control
