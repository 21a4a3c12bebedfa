"""The page itself: a server on this machine, how to reach it, what stands on it before any robot does."""

from __future__ import annotations

import contextlib
import getpass
import io
import os
import socket
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.render.camera import CAMERAS, LOOK_HEIGHT, FollowCamera

if TYPE_CHECKING:
    import viser

Array = NDArray[np.float64]

#: The usual port; where it is taken, the next free one.
PORT = 8080
#: Only this machine: a page on a network could be driven by anyone on it.
HOST = "localhost"
#: Version of viser from which on it has panels, keys and uPlot.
LEAST_VISER = (1, 1)
#: Updates of the scene per second.
UPDATES = 30.0
#: Times the distance of pictures: panels stand at both sides.
_FARTHER = 1.3
#: Updates of texts and sliders per second.
TEXTS = 6.0


@dataclass(frozen=True)
class Address:
    """Where a page is served.

    Attributes:
        host: name or address that it listens on.
        port: on which it listens.
    """

    host: str
    port: int

    @property
    def url(self) -> str:
        """What to open on this machine."""
        shown = "localhost" if self.host in ("", "0.0.0.0", "::") else self.host
        return f"http://{shown}:{self.port}"

    def lines(self, environment: dict[str, str] | None = None) -> list[str]:
        """Return how to open the page, here and through ssh: that is told by ``SSH_CONNECTION``, as sshd sets it."""
        environment = dict(os.environ) if environment is None else environment
        try:
            user = getpass.getuser()
        except (OSError, KeyError):  # no name for this user id
            user = "USER"
        here = environment.get("SSH_CONNECTION", "").split()
        machine = here[2] if len(here) == 4 else socket.gethostname()
        port = f" -p {here[3]}" if len(here) == 4 and here[3] != "22" else ""
        return [
            f"open {self.url} in a browser; Ctrl-C ends",
            f"from another machine: ssh{port} -N -L {self.port}:localhost:{self.port} {user}@{machine}, then the same",
        ]


def open_server(host: str = HOST, port: int = PORT, label: str = "wlr_gym") -> tuple[viser.ViserServer, Address]:
    """Start a server and return it with its address.

    Args:
        host: name or address to listen on; the default can be reached from this machine, and through ssh, only.
        port: the first one that is tried.
        label: heading of the controls.

    Raises:
        MissingPackageError: no viser here (extra ``web``).
        InputError: no such address, no free port, or a viser that is too old.
    """
    if not 1 <= port <= 65535:
        raise InputError(f"--port {port}: expected 1 to 65535")
    require_package("viser", "web")
    import viser

    if tuple(int(part) for part in viser.__version__.split(".")[:2]) < LEAST_VISER:
        least = ".".join(map(str, LEAST_VISER))
        raise InputError(f"viser {viser.__version__} is too old: pip install 'wlr-gym[web]' brings {least} or later")
    _check_address(host)
    with contextlib.redirect_stdout(io.StringIO()):  # it says where it is in a way of its own
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    server.scene.world_axes.visible = False
    server.initial_camera.fov = np.radians(42.0)
    _light(server)
    return server, Address(host, int(server.get_port()))


def close_server(server: viser.ViserServer) -> None:
    """End a server; ending it again does nothing."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _light(server: viser.ViserServer) -> None:
    """Light the scene from above: with shadows and reflections, a browser without a graphics card takes 30 times as long."""
    scene = server.scene
    scene.configure_default_lights(False)
    scene.configure_environment_map(None)
    scene.add_light_hemisphere("/sky", sky_color=(255, 255, 255), ground_color=(150, 150, 160), intensity=2.2)
    scene.add_light_directional("/sun", position=(-1.0, -1.5, 4.0), intensity=1.6)


def _check_address(host: str) -> None:
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as trial:
            trial.bind(place)
    except OSError as error:
        raise InputError(f"--host {host}: no address of this machine: {error.strerror or error}") from None


def say(address: Address) -> None:
    """Print how to open a page."""
    print("\n".join(address.lines()), flush=True)


# ---- where it is seen from -------------------------------------------------------------------------------------------


def aim(server: viser.ViserServer, camera: str) -> None:
    """Put the eye of whoever opens the page where a camera of pictures is, about a robot at the origin of the eye's world."""
    position, look_at = eye(CAMERAS[camera])
    server.initial_camera.position = tuple(position)
    server.initial_camera.look_at = tuple(look_at)


def eye(camera: FollowCamera) -> tuple[Array, Array]:
    """Return where a camera stands (3,) and what it looks at (3,), m, about a robot at the origin that heads along x."""
    flat, rise = np.cos(camera.elevation), np.sin(camera.elevation)
    forward = np.array([flat * np.cos(camera.azimuth), flat * np.sin(camera.azimuth), rise])
    look_at = np.array([0.0, 0.0, LOOK_HEIGHT])
    return look_at - _FARTHER * camera.distance * forward, look_at


def floor_pose(place: Array, yaw: float, up: Array, camera: FollowCamera) -> tuple[Array, Array]:
    """Return quaternion (w, x, y, z) and position of the floor in the eye's world: the floor moves, the robot stays.

    So the mouse turns the eye about the robot wherever that goes, and every browser has its own eye.

    Args:
        place: (x, y, ...) of the robot in the floor frame, m.
        yaw: its heading, rad.
        up: (3,) against gravity in the floor frame: it becomes the eye's z, so that a slope is seen as a slope.
        camera: turns with the robot, or keeps its direction.
    """
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec([0.0, 0.0, -yaw if camera.turns else 0.0])
    tilt = Rotation.from_quat([1.0 + up[2], up[1], -up[0], 0.0], scalar_first=True)  # about up x z
    whole = turn * tilt
    return whole.as_quat(scalar_first=True), -whole.apply([place[0], place[1], 0.0])


def html_lines(lines: list[str]) -> str:
    """Return lines of text for the page."""
    import html

    style = "font-size:0.85em; line-height:1.45; padding:0 0.8em 0.4em; font-variant-numeric:tabular-nums"
    return f'<div style="{style}">' + "<br>".join(map(html.escape, lines)) + "</div>"
