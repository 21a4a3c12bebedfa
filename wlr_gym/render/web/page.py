"""The page itself: a server on this machine, how to reach it, its controls and plots; all but the robot."""

from __future__ import annotations

import contextlib
import getpass
import io
import os
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.render.view import LOOK_HEIGHT, FollowCamera, View, directions

if TYPE_CHECKING:
    import viser

Array = NDArray[np.float64]

PORT = 8080  # the usual port; where it is taken, the next free one
HOST = "localhost"  # only this machine: a page on a network could be driven by anyone on it
LEAST_VISER = (1, 1)  # version of viser from which on it has panels, keys and uPlot
UPDATES = 30.0  # updates of the scene per second
_FARTHER = 1.3  # times the distance of pictures: panels stand at both sides
TEXTS = 6.0  # updates of texts and sliders per second


def how_to_open(host: str, port: int) -> str:
    """Return how to open a page that is served there, here and through ssh: sshd tells that by ``SSH_CONNECTION``."""
    try:
        user = getpass.getuser()
    except (OSError, KeyError):  # no name for this user id
        user = "USER"
    shown = "localhost" if host in ("", "0.0.0.0", "::") else host
    here = os.environ.get("SSH_CONNECTION", "").split()
    machine = here[2] if len(here) == 4 else socket.gethostname()
    at = f" -p {here[3]}" if len(here) == 4 and here[3] != "22" else ""
    return (
        f"open http://{shown}:{port} in a browser; Ctrl-C ends\n"
        f"from another machine: ssh{at} -N -L {port}:localhost:{port} {user}@{machine}, then the same"
    )


def open_server(host: str = HOST, port: int = PORT, label: str = "wlr_gym") -> viser.ViserServer:
    """Start a server.

    Args:
        host: name or address to listen on; the default can be reached from this machine, and through ssh, only.
        port: the first one that is tried. label: heading of the controls.

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
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as trial:
            trial.bind(place)
    except OSError as error:
        raise InputError(f"--host {host}: no address of this machine: {error.strerror or error}") from None
    with contextlib.redirect_stdout(io.StringIO()):  # it says where it is in a way of its own
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    scene = server.scene
    scene.world_axes.visible = False
    server.initial_camera.fov = np.radians(42.0)
    # from above: with shadows and reflections, a browser without a graphics card takes 30 times as long
    scene.configure_default_lights(False)
    scene.configure_environment_map(None)
    scene.add_light_hemisphere("/sky", sky_color=(255, 255, 255), ground_color=(150, 150, 160), intensity=2.2)
    scene.add_light_directional("/sun", position=(-1.0, -1.5, 4.0), intensity=1.6)
    return server


def close_server(server: viser.ViserServer) -> None:
    """End a server; ending it again does nothing."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


# ---- where it is seen from -------------------------------------------------------------------------------------------


def eye(camera: FollowCamera) -> tuple[Array, Array]:
    """Return where a camera stands (3,) and what it looks at (3,), m, about a robot at the origin that heads along x."""
    look_at = np.array([0.0, 0.0, LOOK_HEIGHT])
    return look_at - _FARTHER * camera.distance * directions(camera)[0], look_at


def floor_pose(place: Array, yaw: float, up: Array, camera: FollowCamera) -> tuple[Array, Array]:
    """Return quaternion (w, x, y, z) and position of the floor in the eye's world: the floor moves, the robot stays.

    So the mouse turns the eye about the robot wherever that goes, and every browser has its own eye.

    Args:
        place: of the robot in the floor frame, and the floor's height about there (3,), m. yaw: its heading, rad.
        up: (3,) against gravity in the floor frame: it becomes the eye's z, so that a slope is seen as a slope.
        camera: turns with the robot, or keeps its direction.
    """
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec([0.0, 0.0, -yaw if camera.turns else 0.0])
    tilt = Rotation.from_quat([1.0 + up[2], up[1], -up[0], 0.0], scalar_first=True)  # about up x z
    whole = turn * tilt
    return whole.as_quat(scalar_first=True), -whole.apply(place)


def quaternion(turn: Array) -> Array:
    """Return the quaternion (w, x, y, z) of a rotation (3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(turn).as_quat(scalar_first=True)


def html_lines(lines: list[str]) -> str:
    """Return lines of text for the page."""
    import html

    style = "font-size:0.85em; line-height:1.45; padding:0 0.8em 0.4em; font-variant-numeric:tabular-nums"
    return f'<div style="{style}">' + "<br>".join(map(html.escape, lines)) + "</div>"


# ---- controls that every page has ------------------------------------------------------------------------------------


#: What a page calls its cameras; the direction from which it is seen is the mouse's affair.
_CAMERAS = {"goes with the robot": "follow", "turns with the robot": "chase"}
_PLOTS_WIDE = 380  # pixels


class ViewControls:
    """What whoever watches wants to see; ``view`` is what is seen until something else is chosen."""

    def __init__(self, server: viser.ViserServer, view: View) -> None:
        self._first = view
        first = next((text for text, camera in _CAMERAS.items() if camera == view.camera), "goes with the robot")
        with server.gui.add_folder("View", expand_by_default=False):
            self._camera = server.gui.add_dropdown("camera", tuple(_CAMERAS), initial_value=first)
            self._friction = server.gui.add_checkbox("floor's friction", view.friction)
            self._slip = server.gui.add_checkbox("slip", view.slip)
            self._forces = server.gui.add_checkbox("contact forces", view.forces)

    @property
    def view(self) -> View:
        """What to show now."""
        friction, slip, forces = (bool(box.value) for box in (self._friction, self._slip, self._forces))
        camera = _CAMERAS[self._camera.value]
        return replace(self._first, camera=camera, friction=friction, slip=slip, forces=forces, loads=forces)


def plot_panel(server: viser.ViserServer) -> Any:
    """Return a panel at the left edge, the other controls at the right one: what is added within it stands there."""
    server.gui.main_panel.dock_right()
    panel = server.gui.add_panel()
    tab = panel.add_tab("Plots")
    panel.dock_left()
    panel.set_width(_PLOTS_WIDE)
    return tab


# ---- curves over time, drawn by uPlot, which viser's page brings along ------------------------------------------------


COLUMNS = 400  # columns of a plot: more points than it has pixels are not drawn
#: Colours of a plot's curves, and of the line at the present time.
COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#17becf", "#e377c2")
_NOW = "#444444"
_HEIGHT = 190  # pixels; height of a plot
_THIN = 1e-6  # s; half the width of the line at the present time
NOTHING = "(nothing)"


@dataclass(frozen=True, eq=False)
class Curve:
    """A channel over time.

    Attributes:
        label: in the legend. t: (n,) s, rising. values: (n,); NaN where there is none.
        dashed: as of what is simulated beside what was measured. colour: place in :data:`COLOURS`.
    """

    label: str
    t: Array
    values: Array
    dashed: bool = False
    colour: int = 0


def thinned(curve: Curve, begin: float, end: float) -> tuple[Array, Array]:
    """Return a curve between two times with at most about two points per column: the least and the greatest in it.

    Values that are NaN are left out: a line goes to the next one.
    """
    first, last = np.searchsorted(curve.t, [begin, end])
    first, last = max(int(first) - 1, 0), min(int(last) + 1, len(curve.t))
    t, values = curve.t[first:last], curve.values[first:last]
    known = np.isfinite(values)
    t, values = t[known], values[known]
    if len(t) <= 2 * COLUMNS:
        return t, values
    width = -(-len(t) // COLUMNS)
    padded = np.pad(values, (0, -len(values) % width), mode="edge").reshape(-1, width)
    starts = width * np.arange(len(padded))
    kept = np.unique(np.concatenate([starts + padded.argmin(axis=1), starts + padded.argmax(axis=1)]))
    return t[kept], values[kept]


def aligned(curves: Sequence[Curve], begin: float, end: float, now: float) -> tuple[Array, ...]:
    """Return what uPlot draws: common times, a row of values per curve, and a row that is a line at the present time.

    A curve has a value at each of the times between its own: on the line between them, so that what is drawn is the same.
    Before and after all its own times it stays as it is, and the line at the present time runs along the bottom: with a NaN
    in it, uPlot as viser feeds it draws nothing.
    """
    pieces = [thinned(curve, begin, end) for curve in curves]
    shown = np.concatenate([values for _, values in pieces]) if pieces else np.zeros(0)
    low, high = (float(shown.min()), float(shown.max())) if len(shown) else (0.0, 1.0)
    margin = 0.05 * (high - low) or 1e-3
    t = np.unique(np.concatenate([[begin, now - _THIN, now, now + _THIN, end], *(piece for piece, _ in pieces)]))
    t = t[(t >= begin) & (t <= end)]
    rows = [np.interp(t, *piece) if len(piece[0]) else np.zeros(len(t)) for piece in pieces]
    line = np.full(len(t), low - margin)
    place = int(np.searchsorted(t, now))
    line[place : place + 1] = high + margin
    return (t, *rows, line)


class Plots:
    """Plots that whoever watches chooses the channels of.

    Args:
        server: of the page. place: panel that they stand in.
        titles: what can be drawn, and its unit. first: what is drawn until something else is chosen.
    """

    def __init__(self, server: viser.ViserServer, place: Any, titles: Mapping[str, str], first: Sequence[str]) -> None:
        self._server, self._place, self._units = server, place, titles
        with place:
            self._choices: list[Any] = [
                server.gui.add_dropdown(f"plot {k}", (NOTHING, *titles), initial_value=name if name in titles else NOTHING)
                for k, name in enumerate(first, start=1)
            ]
        self._plots: list[Any] = [None] * len(first)
        self._drawn: list[tuple[str, ...]] = [()] * len(first)  # title and curves of each plot

    @property
    def chosen(self) -> list[str]:
        """What each plot shows."""
        return [str(choice.value) for choice in self._choices]

    def offer(self, titles: Mapping[str, str]) -> None:
        """Change what can be drawn; what is drawn stays where it can."""
        self._units = titles
        for choice in self._choices:
            kept = choice.value if choice.value in titles else NOTHING
            choice.options = (NOTHING, *titles)
            choice.value = kept

    def draw(self, curves: Mapping[str, Sequence[Curve]], begin: float, end: float, now: float) -> None:
        """Draw, from ``begin`` to ``end`` (s), the curves of what was chosen."""
        for k, name in enumerate(self.chosen):
            mine = [one for one in curves.get(name, ()) if len(one.t) > 0 and one.t[0] <= end and one.t[-1] >= begin]
            drawn = (name, *(curve.label for curve in mine))
            if self._plots[k] is not None and drawn != self._drawn[k]:
                self._plots[k].remove()
                self._plots[k] = None
            self._drawn[k] = drawn
            if mine and self._plots[k] is None:
                self._plots[k] = self._add(name, mine, aligned(mine, begin, end, now), self._choices[k].order + 0.5)
            elif mine:
                self._plots[k].data = aligned(mine, begin, end, now)

    def _add(self, name: str, curves: Sequence[Curve], data: tuple[Array, ...], order: float) -> Any:
        series: list[dict[str, Any]] = [{"label": "t (s)"}]
        for curve in curves:
            line = {"label": curve.label, "stroke": COLOURS[curve.colour % len(COLOURS)], "width": 1.5}
            series.append(line | ({"dash": (6, 4)} if curve.dashed else {}))
        series.append({"label": "now", "stroke": _NOW, "width": 1})
        unit = self._units.get(name, "")
        with self._place:
            return self._server.gui.add_uplot(
                data,
                tuple(series),  # pyright: ignore[reportArgumentType]
                title=f"{name} ({unit})" if unit else name,
                scales={"x": {"time": False}},
                legend={"show": True},
                height=_HEIGHT,
                order=order,
            )
