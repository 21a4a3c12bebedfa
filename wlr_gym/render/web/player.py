"""Pages: a plant while it runs, in real time, with the keys that drive it; and recordings, with a time axis and a ghost.

Both have the robot and its floor, what is to be said, and plots of any channel.
"""

from __future__ import annotations

import threading
import time as clock
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.plants.base import TRUTH_LAYOUT, Truth
from wlr_gym.render.scene import describe, legend
from wlr_gym.render.teleop import DOWN, LEFT, RESET, RIGHT, SPACE, UP
from wlr_gym.render.view import CAMERAS, View
from wlr_gym.render.viewer import KeyCallback, Pace
from wlr_gym.render.web.figure import Figure, PageFloor, arrows_of
from wlr_gym.render.web.page import (
    HOST,
    PORT,
    TEXTS,
    UPDATES,
    Curve,
    Plots,
    ViewControls,
    close_server,
    eye,
    html_lines,
    open_server,
    plot_panel,
)
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters


class _Page:
    """A page of the browser: its server, the robots on the floor, and when its texts are due.

    Args:
        label: heading of the controls.
        view: what to show; the size is the browser's own affair.
        host, port: where the page is served.

    Raises:
        MissingPackageError: no viser here (extra ``web``).
        InputError: no such address, or no free port.
    """

    def __init__(self, label: str, view: View, host: str, port: int) -> None:
        self.view = view
        self.server, self.address = open_server(host, port, label)
        position, look_at = eye(CAMERAS[view.camera])
        self.server.initial_camera.position = tuple(position)
        self.server.initial_camera.look_at = tuple(look_at)
        self._ground = PageFloor(self.server)
        self._told = -np.inf

    def _show(self, figure: Figure, truth: Truth, parameters: Parameters, row: int, view: View, arrows: View) -> None:
        """Pose the robot that the page goes along with, with the arrows that a view has, and the floor under it."""
        stage = figure.pose(truth, parameters, row)
        figure.point(arrows_of(stage, truth, parameters, row, arrows))
        self._ground.show(stage, truth, parameters, row, view)

    def _texts_are_due(self) -> bool:
        now = clock.monotonic()
        due = now >= self._told + 1.0 / TEXTS
        self._told = now if due else self._told
        return due

    def close(self) -> None:
        """End the page."""
        close_server(self.server)


# ---- a plant while it runs -------------------------------------------------------------------------------------------


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


class WebViewer(_Page):
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
        super().__init__("wlr play", view or View(forces=True), host, port)
        self._pace = pace or Pace()
        self._figure = Figure(self.server, "robot", robot)
        self._text: Any = self.server.gui.add_html("")
        if on_key is not None:
            self._add_keys(on_key)
        self._look = ViewControls(self.server, self.view)
        self._past: deque[tuple[float, NDArray[np.float64]]] = deque()  # time and truth
        self._plots = Plots(self.server, plot_panel(self.server), _TITLES, _FIRST)
        print("\n".join(self.address.lines()), flush=True)

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
        self._note(truth, row, time or 0.0)
        with self.server.atomic():
            self._show(self._figure, truth, parameters, row, view, view)
        if self._texts_are_due():
            lines = describe(truth, parameters, row, time, command, title, slip=view.slip)
            self._text.content = html_lines([*lines, *legend(parameters, row, view)])
            if len(self._past) > 1:
                curves = {name: self.curves(name) for name in self._plots.chosen if name in _TITLES}
                begin, now = self._past[0][0], self._past[-1][0]
                self._plots.draw(curves, begin, max(now, begin + 1.0), now)
        self._pace.wait(period)
        return True

    def _note(self, truth: Truth, row: int, time: float) -> None:
        """Keep the present and the last :data:`WINDOW` seconds; a time that goes back begins anew."""
        if self._past and time <= self._past[-1][0]:
            self._past.clear()
        self._past.append((time, truth.values[row].copy()))
        while time - self._past[0][0] > WINDOW:
            self._past.popleft()

    def curves(self, name: str) -> list[Curve]:
        """Return the past of a channel of the truth, element by element, or of one element of it."""
        t, values = np.array([time for time, _ in self._past]), np.array([values for _, values in self._past])
        elements = TRUTH_LAYOUT.channels[name].elements if name in TRUTH_LAYOUT.channels else [name]
        columns = {one: values[:, TRUTH_LAYOUT.elements.index(one)] for one in elements[:_MOST]}
        return [Curve(one, t, column, colour=n) for n, (one, column) in enumerate(columns.items())]

    def _add_keys(self, on_key: KeyCallback) -> None:
        lock = threading.Lock()

        def press(code: int) -> None:
            with lock:
                on_key(code)

        with self.server.gui.add_folder("Drive"):
            for key, (code, what) in KEYS.items():
                self.server.gui.add_command(what, hotkey=key).on_trigger(lambda _, code=code: press(code))  # pyright: ignore
                self.server.gui.add_button(f"{what}  [{key}]").on_click(lambda _, code=code: press(code))


# ---- recordings ------------------------------------------------------------------------------------------------------


#: Times real time that a recording can be played at.
SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "5", "10")
#: s that plots show around the present; the whole recording is drawn less often, for it is more to send.
WINDOWS = {"4 s": 4.0, "20 s": 20.0, "all": np.inf}
_ALL_PER_SECOND = 2.0


@dataclass(frozen=True, eq=False)
class Moment:
    """A robot at one time.

    Attributes:
        truth, parameters: (1).
        slip, forces: whether the truth knows them; what it does not is not drawn.
    """

    truth: Truth
    parameters: Parameters
    slip: bool = True
    forces: bool = True


class Playable(Protocol):
    """What is played. Times are s since its beginning.

    Attributes:
        name: of the recording. robot: supplies the sizes that are no parameters. length: s.
        titles: what can be plotted -> its unit.
    """

    @property
    def name(self) -> str: ...
    @property
    def robot(self) -> Robot: ...
    @property
    def length(self) -> float: ...
    @property
    def titles(self) -> Mapping[str, str]: ...

    def at(self, time: float) -> Moment:
        """Return the robot."""
        ...

    def ghost_at(self, time: float) -> Moment | None:
        """Return its ghost; None = there is none, or none yet."""
        ...

    def curves(self, title: str) -> Sequence[Curve]:
        """Return what is known of a title of ``titles``."""
        ...

    def lines(self, time: float) -> list[str]:
        """Return what is to be said: what the robot and the ghost are, and how far these have been worked out."""
        ...

    def close(self) -> None:
        """Give up what is being worked out."""
        ...


class Player(_Page):
    """Plays recordings on a page of the browser.

    Args:
        names: of the recordings.
        open: return a recording by its place in ``names``; called when it is chosen.
        first: titles that are plotted at the beginning.
        host, port: where the page is served.

    Raises:
        MissingPackageError: no viser here (extra ``web``).
        InputError: no such address, or no free port; and what ``open`` raises.
    """

    def __init__(
        self,
        names: Sequence[str],
        open: Callable[[int], Playable],
        first: Sequence[str],
        host: str = HOST,
        port: int = PORT,
    ) -> None:
        self._open, self._chosen = open, 0
        self.recording: Playable = open(0)
        super().__init__("wlr view", View(forces=True), host, port)
        self._lock = threading.Lock()
        self._time, self._drawn, self._plotted = 0.0, -1.0, -np.inf
        self._add_controls(names, first)
        self._add_figures()
        print("\n".join(self.address.lines()), flush=True)

    # ---- time -------------------------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """s since the beginning of the recording."""
        return self._time

    def seek(self, time: float) -> None:
        """Go to a time, as far as the recording has it."""
        with self._lock:
            self._time = float(np.clip(time, 0.0, self.recording.length))

    def advance(self, seconds: float) -> None:
        """Let real time pass: while it plays, the recording goes on, from its end to its beginning."""
        if self._playing:
            later = self._time + seconds * float(self._speed.value)
            self.seek(later if self._time < self.recording.length else 0.0)

    def run(self, stop: Callable[[], bool] = lambda: False, pace: Pace | None = None) -> None:
        """Play until ``stop`` says so: :data:`wlr_gym.render.web.page.UPDATES` updates a second.

        Args:
            stop: asked before each update.
            pace: waits for the next one (tests).
        """
        pace, last = pace or Pace(), clock.monotonic()
        try:
            while not stop():
                now = clock.monotonic()
                self.advance(now - last)
                last = now
                self.update()
                pace.wait(1.0 / UPDATES)
        finally:
            self.close()

    def close(self) -> None:
        """End the page, and what is being worked out for it."""
        self.recording.close()
        super().close()

    # ---- what is shown ----------------------------------------------------------------------------------------------

    def update(self) -> None:
        """Bring the page to the present time; a scene that has not changed is not sent again, but by the texts' rate."""
        if (chosen := self._run.options.index(self._run.value)) != self._chosen:
            self._change_to(chosen)
        time, texts = self._time, self._texts_are_due()
        if time != self._drawn or texts:
            self._draw(time, texts)
            self._drawn = time
        if texts:
            self._slider.value = round(time, 2)
            self._plot(time)

    def _draw(self, time: float, texts: bool) -> None:
        recording, view = self.recording, self._look.view
        moment, ghost = recording.at(time), recording.ghost_at(time) if self._show_ghost.value else None
        arrows = replace(view, slip=view.slip and moment.slip, forces=view.forces and moment.forces)
        with self.server.atomic():
            self._show(self._robot, moment.truth, moment.parameters, 0, view, arrows)
            if ghost is None:
                self._ghost.hide()
            else:  # it has arrows only where the robot has none of its own
                arrows = replace(view, slip=False, forces=view.forces and not moment.forces)
                stage = self._ghost.pose(ghost.truth, ghost.parameters)
                self._ghost.point(arrows_of(stage, ghost.truth, ghost.parameters, 0, arrows))
        if texts:
            lines = describe(moment.truth, moment.parameters, 0, time, None, recording.name, slip=moment.slip)
            self._text.content = html_lines([*lines, *recording.lines(time), *legend(moment.parameters, 0, view)])

    def _plot(self, time: float) -> None:
        width, length, now = WINDOWS[str(self._window.value)], self.recording.length, clock.monotonic()
        begin, end = 0.0, length
        if np.isfinite(width):
            begin = float(np.clip(time - 0.5 * width, 0.0, max(length - width, 0.0)))
            end = min(begin + width, length)
        elif now < self._plotted + 1.0 / _ALL_PER_SECOND:
            return
        self._plotted = now
        titles = [title for title in self._plots.chosen if title in self.recording.titles]
        self._plots.draw({title: self.recording.curves(title) for title in titles}, begin, end, time)

    # ---- controls ---------------------------------------------------------------------------------------------------

    def _add_controls(self, names: Sequence[str], first: Sequence[str]) -> None:
        gui = self.server.gui
        self._run: Any = gui.add_dropdown("run", tuple(names), initial_value=names[0])
        self._text: Any = gui.add_html("")
        self._playing = True
        self._button: Any = gui.add_button("pause  [space]")
        self._slider: Any = gui.add_slider("time (s)", 0.0, max(round(self.recording.length, 2), 0.01), 0.01, 0.0)
        self._speed: Any = gui.add_dropdown("speed", SPEEDS, initial_value="1")
        self._show_ghost: Any = gui.add_checkbox("ghost: replayed", True)
        self._look = ViewControls(self.server, self.view)
        place = plot_panel(self.server)
        with place:
            self._window: Any = gui.add_dropdown("shown", tuple(WINDOWS), initial_value="20 s")
        self._plots = Plots(self.server, place, self.recording.titles, first)
        self._button.on_click(lambda _: self._turn())
        gui.add_command("play or pause", hotkey="space").on_trigger(lambda _: self._turn())
        gui.add_command("1 s back", hotkey="J").on_trigger(lambda _: self.seek(self._time - 1.0))
        gui.add_command("1 s on", hotkey="L").on_trigger(lambda _: self.seek(self._time + 1.0))
        self._slider.on_update(lambda event: self.seek(float(event.target.value)) if event.client is not None else None)

    def _turn(self) -> None:
        self._playing = not self._playing
        self._button.label = "pause  [space]" if self._playing else "play  [space]"

    def _add_figures(self) -> None:
        self._robot = Figure(self.server, "robot", self.recording.robot)
        self._ghost = Figure(self.server, "ghost", self.recording.robot, ghost=True)

    def _change_to(self, chosen: int) -> None:
        """Open another recording."""
        self._chosen = chosen
        self.recording.close()
        self.recording = self._open(chosen)
        self._add_figures()
        self._plots.offer(self.recording.titles)
        self._slider.max = max(round(self.recording.length, 2), 0.01)
        self._drawn = -1.0
        self.seek(0.0)
