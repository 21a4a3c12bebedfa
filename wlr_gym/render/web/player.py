"""A page that plays recordings: robot and ghost, a time axis, and plots of any channel."""

from __future__ import annotations

import threading
import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from wlr_gym.physics.plants.base import Truth
from wlr_gym.render.scene import describe, legend
from wlr_gym.render.view import View
from wlr_gym.render.viewer import Pace
from wlr_gym.render.web.figure import Figure, PageFloor, arrows_of
from wlr_gym.render.web.page import (
    HOST,
    PORT,
    TEXTS,
    UPDATES,
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

#: Times real time that a recording can be played at.
SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "5", "10")
#: s that plots show around the present; the whole recording is drawn less often, for it is more to send.
WINDOWS = {"4 s": 4.0, "20 s": 20.0, "all": np.inf}
_ALL_PER_SECOND = 2.0
#: What is shown until something else is chosen.
_VIEW = View(forces=True)


@dataclass(frozen=True, eq=False)
class Moment:
    """A robot at one time.

    Attributes:
        truth: (1).
        parameters: (1).
        slip, forces: whether the truth knows them; what it does not is not drawn.
    """

    truth: Truth
    parameters: Parameters
    slip: bool = True
    forces: bool = True


class Playable(Protocol):
    """What is played. Times are s since its beginning."""

    @property
    def name(self) -> str:
        """Of the recording."""
        ...

    @property
    def robot(self) -> Robot:
        """Supplies the sizes that are no parameters."""
        ...

    @property
    def length(self) -> float:
        """s."""
        ...

    @property
    def titles(self) -> Mapping[str, str]:
        """What can be plotted -> its unit."""
        ...

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


class Player:
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
        self._open, self._names = open, list(names)
        self.recording: Playable = open(0)
        self.server, self.address = open_server(host, port, "wlr view")
        aim(self.server, _VIEW.camera)
        self._ground = PageFloor(self.server)
        self._figures: dict[str, Figure] = {}
        self._lock = threading.Lock()
        self._time, self._drawn, self._told, self._plotted = 0.0, -1.0, -np.inf, -np.inf
        self._chosen = 0
        self._add_controls(first)
        say(self.address)

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
        close_server(self.server)

    # ---- what is shown ----------------------------------------------------------------------------------------------

    def update(self) -> None:
        """Bring the page to the present time; a scene that has not changed is not sent again, but by the texts' rate."""
        self._choose()
        now, time = clock.monotonic(), self._time
        texts = now >= self._told + 1.0 / TEXTS
        if time != self._drawn or texts:
            self._draw(time, texts)
            self._drawn = time
        if texts:
            self._told = now
            self._slider.value = round(time, 2)
            self._plot(now, time)

    def _draw(self, time: float, texts: bool) -> None:
        recording, view = self.recording, self._look.view
        moment, ghost = recording.at(time), recording.ghost_at(time) if self._show_ghost.value else None
        seen = replace(view, slip=view.slip and moment.slip, forces=view.forces and moment.forces)
        with self.server.atomic():
            stage = self._figures["robot"].pose(moment.truth, moment.parameters)
            self._figures["robot"].point(arrows_of(stage, moment.truth, moment.parameters, 0, seen))
            self._ground.show(stage, moment.truth, moment.parameters, 0, view)
            self._ground.look(stage, moment.truth, moment.parameters, 0, view.camera)
            if ghost is None:
                self._figures["ghost"].hide()
            else:  # it has arrows only where the robot has none of its own
                seen = replace(view, slip=False, forces=view.forces and not moment.forces)
                stage = self._figures["ghost"].pose(ghost.truth, ghost.parameters)
                self._figures["ghost"].point(arrows_of(stage, ghost.truth, ghost.parameters, 0, seen))
        if texts:
            lines = [*describe(moment.truth, moment.parameters, 0, time, None, recording.name, slip=moment.slip)]
            self._text.content = html_lines([*lines, *recording.lines(time), *legend(moment.parameters, 0, view)])

    def _plot(self, now: float, time: float) -> None:
        width = WINDOWS[str(self._window.value)]
        if np.isinf(width) and now < self._plotted + 1.0 / _ALL_PER_SECOND:
            return
        self._plotted = now
        length = self.recording.length
        begin = 0.0 if np.isinf(width) else float(np.clip(time - 0.5 * width, 0.0, max(length - width, 0.0)))
        end = length if np.isinf(width) else min(begin + width, length)
        titles = [title for title in self._plots.chosen if title in self.recording.titles]
        self._plots.draw({title: self.recording.curves(title) for title in titles}, begin, end, time)

    # ---- controls ---------------------------------------------------------------------------------------------------

    def _add_controls(self, first: Sequence[str]) -> None:
        gui = self.server.gui
        self._run: Any = gui.add_dropdown("run", tuple(self._names), initial_value=self._names[0])
        self._text: Any = gui.add_html("")
        self._playing = True
        self._button: Any = gui.add_button("pause  [space]")
        self._slider: Any = gui.add_slider("time (s)", 0.0, max(round(self.recording.length, 2), 0.01), 0.01, 0.0)
        self._speed: Any = gui.add_dropdown("speed", SPEEDS, initial_value="1")
        self._show_ghost: Any = gui.add_checkbox("ghost: replayed", True)
        self._look = ViewControls(self.server, _VIEW)
        place = plot_panel(self.server)
        with place:
            self._window: Any = gui.add_dropdown("shown", tuple(WINDOWS), initial_value="20 s")
        self._plots = Plots(self.server, place, self.recording.titles, first)
        self._button.on_click(lambda _: self._turn())
        gui.add_command("play or pause", hotkey="space").on_trigger(lambda _: self._turn())
        gui.add_command("1 s back", hotkey="J").on_trigger(lambda _: self.seek(self._time - 1.0))
        gui.add_command("1 s on", hotkey="L").on_trigger(lambda _: self.seek(self._time + 1.0))
        self._slider.on_update(lambda event: self.seek(float(event.target.value)) if event.client is not None else None)
        self._figures = self._new_figures()

    def _turn(self) -> None:
        self._playing = not self._playing
        self._button.label = "pause  [space]" if self._playing else "play  [space]"

    def _new_figures(self) -> dict[str, Figure]:
        robot = self.recording.robot
        return {"robot": Figure(self.server, "robot", robot), "ghost": Figure(self.server, "ghost", robot, ghost=True)}

    def _choose(self) -> None:
        """Open another recording, where whoever watches has chosen one."""
        chosen = self._run.options.index(self._run.value)
        if chosen == self._chosen:
            return
        self._chosen = chosen
        self.recording.close()
        self.recording = self._open(chosen)
        self._figures = self._new_figures()
        self._plots.offer(self.recording.titles)
        self._slider.max = max(round(self.recording.length, 2), 0.01)
        self._drawn = -1.0
        self.seek(0.0)
