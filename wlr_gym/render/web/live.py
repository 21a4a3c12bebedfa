"""A page that shows a plant while it runs, in real time, and takes the keys that drive it."""

from __future__ import annotations

import threading
import time as clock
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.plants.base import TRUTH_LAYOUT, Truth
from wlr_gym.render.scene import describe, legend
from wlr_gym.render.teleop import DOWN, LEFT, RESET, RIGHT, SPACE, UP
from wlr_gym.render.view import View
from wlr_gym.render.viewer import KeyCallback, Pace
from wlr_gym.render.web.figure import Figure, PageFloor, arrows_of
from wlr_gym.render.web.page import (
    HOST,
    PORT,
    TEXTS,
    Curve,
    Plots,
    ViewControls,
    aim,
    close_server,
    html_lines,
    open_server,
    plot_panel,
    say,
)
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters

#: Key of the page -> key code, as the window reports it, and what it does. Arrow keys turn the eye of the page.
KEYS = {
    "I": (UP, "faster"),
    "K": (DOWN, "slower, backwards"),
    "J": (LEFT, "turn left"),
    "L": (RIGHT, "turn right"),
    "space": (SPACE, "stop"),
    "R": (RESET, "start anew"),
}
HELP = "keys on the page: I K speed, J L turning, space: stop, R: start anew; the mouse turns and moves the view"
#: s of the past that plots show.
WINDOW = 20.0
#: What plots can show: channels of the truth, by element or all of a kind in one plot.
_TITLES = {
    name: channel.unit
    for channel in TRUTH_LAYOUT.channels.values()
    for name in dict.fromkeys((channel.name, *channel.elements))
}
_FIRST = ("linear_velocity_in_body[x]", "slip_velocity", "contact_force")
#: Curves of one plot at most: of a kind with more elements, the first ones.
_MOST = 12


class WebViewer:
    """Shows one robot on a page of the browser, no faster than real time; as :class:`wlr_gym.render.viewer.Viewer`.

    Args:
        robot: supplies the sizes that are no parameters.
        view: what to show; the size is the browser's own affair.
        on_key: called with the key codes of :mod:`wlr_gym.render.teleop`, from a thread of the server; None = nobody drives.
        host, port: where the page is served.
        pace: waits for the next tick (tests).

    Raises:
        MissingPackageError: no viser here (extra ``web``).
        InputError: no such address, or no free port.
    """

    def __init__(
        self,
        robot: Robot,
        view: View | None = None,
        on_key: KeyCallback | None = None,
        host: str = HOST,
        port: int = PORT,
        pace: Pace | None = None,
    ) -> None:
        self.view: View = view or View(forces=True)
        self._pace = pace or Pace()
        self.server, self.address = open_server(host, port, "wlr play")
        aim(self.server, self.view.camera)
        self._figure = Figure(self.server, "robot", robot)
        self._ground = PageFloor(self.server)
        self._text: Any = self.server.gui.add_html("")
        if on_key is not None:
            self._add_keys(on_key)
        self._look = ViewControls(self.server, self.view)
        self._past = Past()
        self._plots = Plots(self.server, plot_panel(self.server), _TITLES, _FIRST)
        self._told = -np.inf
        say(self.address)

    def show(
        self,
        truth: Truth,
        parameters: Parameters,
        row: int = 0,
        *,
        period: float,
        time: float | None = None,
        command: Mapping[str, float] | None = None,
        title: str = "",
    ) -> bool:
        """Show one robot and wait until its control period is over; the arguments are those of the window's viewer.

        Returns:
            True: browsers come and go, the page stays.
        """
        view = self._look.view
        self._past.note(truth, row, 0.0 if time is None else time)
        with self.server.atomic():
            stage = self._figure.pose(truth, parameters, row)
            self._figure.point(arrows_of(stage, truth, parameters, row, view))
            self._ground.show(stage, truth, parameters, row, view)
            self._ground.look(stage, truth, parameters, row, view.camera)
        now = clock.monotonic()
        if now >= self._told + 1.0 / TEXTS:
            self._told = now
            lines = describe(truth, parameters, row, time, command, title, slip=view.slip)
            self._text.content = html_lines([*lines, *legend(parameters, row, view)])
            self._draw_plots()
        self._pace.wait(period)
        return True

    def close(self) -> None:
        """End the page."""
        close_server(self.server)

    def _add_keys(self, on_key: KeyCallback) -> None:
        lock = threading.Lock()

        def press(code: int) -> Callable[[object], None]:
            def pressed(_: object) -> None:
                with lock:
                    on_key(code)

            return pressed

        with self.server.gui.add_folder("Drive"):
            for key, (code, what) in KEYS.items():
                self.server.gui.add_command(what, hotkey=key).on_trigger(press(code))  # pyright: ignore[reportArgumentType]
                self.server.gui.add_button(f"{what}  [{key}]").on_click(press(code))

    def _draw_plots(self) -> None:
        t, values = self._past.arrays()
        if len(t) < 2:
            return
        curves = {name: curves_of(name, t, values) for name in self._plots.chosen if name in _TITLES}
        self._plots.draw(curves, t[0], max(t[-1], t[0] + 1.0), t[-1])


class Past:
    """The last :data:`WINDOW` seconds of one robot's truth."""

    def __init__(self) -> None:
        self._rows: deque[tuple[float, NDArray[np.float64]]] = deque()

    def note(self, truth: Truth, row: int, time: float) -> None:
        """Add the present; a time that goes back begins anew."""
        if self._rows and time <= self._rows[-1][0]:
            self._rows.clear()
        self._rows.append((time, truth.values[row].copy()))
        while time - self._rows[0][0] > WINDOW:
            self._rows.popleft()

    def arrays(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return times (n,), s, and the truth (n, width) at them."""
        rows = list(self._rows)
        return np.array([time for time, _ in rows]), np.array([values for _, values in rows])


def curves_of(name: str, t: NDArray[np.float64], values: NDArray[np.float64]) -> list[Curve]:
    """Return the curves of a channel of the truth, or of one element of it."""
    elements = TRUTH_LAYOUT.channels[name].elements if name in TRUTH_LAYOUT.channels else [name]
    index = TRUTH_LAYOUT.elements.index
    return [Curve(one, t, values[:, index(one)], colour=n) for n, one in enumerate(elements[:_MOST])]
