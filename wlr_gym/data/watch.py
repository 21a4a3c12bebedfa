"""Runs to be watched: a film of a measured run beside its simulation, and recordings that a page plays.

In a film both sides are drawn from the same channels in the same way: joints from the encoders, x, y and yaw from the camera
(smoothed), height and tilt from the legs, as of a robot that stands on the floor there. Slip is not measured, so none is
drawn, and no friction. Both cameras look at the place of the measured robot: a simulated one that drifts is seen to drift.

A page opens at once; what takes a simulator is worked out by a thread while it is watched:

- the ghost: a plant driven with the run's setpoints, started anew from the measured robot every few seconds;
- of a run that a simulator logged: the same simulation once more, which knows slip, forces and floor to the bit.

There the measured robot is drawn from encoders, camera and gyroscope, smoothed as for a replay; where no frame is near, it
moves as its wheels roll and its gyroscope turns.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.format import CHANNELS, COLUMNS
from wlr_gym.data.replay import ReplayResult, prepare, replayed_rows, simulated_rows
from wlr_gym.data.run_states import frame_near, has_camera, measured_state, rolled_poses, slip_of
from wlr_gym.data.runs import Run
from wlr_gym.physics.effects import Patch
from wlr_gym.physics.floor import FloorSource
from wlr_gym.physics.plants.base import TRUTH_LAYOUT, PlantState, Truth, settle, standing_state
from wlr_gym.render.view import View
from wlr_gym.render.web.page import Curve
from wlr_gym.render.web.player import Moment
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

FPS = 12.5
VIEW = View(size=(480, 360), friction=False, slip=False)


def film_length(run: Run) -> int:
    """Return the number of pictures in a run's film."""
    return len(_film_times(run))


def replay_film(result: ReplayResult, parameters: Parameters, backend: str, view: View = VIEW) -> Iterator[Picture]:
    """Yield pictures at :data:`FPS`: the recorded run at the left, its simulation from start to end at the right.

    Args:
        result: the run and its replay.
        parameters: (1) that it was replayed with.
        backend: name of the simulator, for the title.
        view: what to show.
    """
    from wlr_gym.render import side_by_side

    simulated = replace(result.run, table=result.run.table.assign(**result.full))
    times = _film_times(result.run)
    many = Parameters(np.repeat(parameters.values, len(times), axis=0))
    states = [measured_state(run, times, standing_state(result.robot, many), many) for run in (result.run, simulated)]
    for state in states:
        settle(result.robot, many, state)
    truths = [truth_of(state) for state in states]
    titles = ("recorded: camera and encoders", f"simulated ({backend}): same commands, open loop")
    middle = truths[0].position[:, :2]
    left, right = (_pictures(result, truth, many, times, middle, view) for truth in truths)
    yield from side_by_side(left, right, titles)


def _pictures(
    result: ReplayResult, truth: Truth, parameters: Parameters, times: Array, middle: Array, view: View
) -> Iterator[Picture]:
    from wlr_gym.render import Scene

    scene, name = Scene(result.robot, view), result.run.name
    try:
        for row, time in enumerate(times - times[0]):
            yield scene.draw(truth, parameters, row, time=float(time), title=name, look_at=middle[row])
    finally:
        scene.close()


def truth_of(state: PlantState) -> Truth:
    """Return a truth (N) that knows the motion of ``state`` and nothing else: forces and slip are 0."""
    truth = Truth(np.zeros((len(state), TRUTH_LAYOUT.width)))
    velocities = ("linear_velocity_in_body", "angular_velocity_in_body", "joint_velocity")
    for name in ("position", "quaternion", "joint_position", *velocities):
        truth[name][:] = getattr(state, name)
    return truth


def _film_times(run: Run) -> Array:
    t = run["t"]
    return np.arange(t[0], t[-1], 1.0 / FPS)


# ---- recordings ------------------------------------------------------------------------------------------------------


#: s between the points at which the ghost starts anew from the measured robot.
SEGMENT = 10.0
#: s around a time whose samples say where the robot is then.
_AROUND = 1.0
#: Elements of the truth that can be plotted where a simulator knows them.
_TRUE = {
    f"true {name}": name
    for name in ("slip_velocity", "contact_force", "linear_velocity_in_body", "position", "effective_friction")
}


class Track:
    """What a simulator knows of a run, row by row, as far as it has come.

    Attributes:
        truths: (rows, :data:`TRUTH_LAYOUT` width); NaN where it has not come.
        channels: (rows, channels); NaN there, too.
        parameters: from which row on which parameters (1) held.
        done: rows.
        trouble: why it does not go on; empty = all is well.
    """

    def __init__(self, rows: int, channels: int) -> None:
        self.truths, self.channels = (np.full((rows, width), np.nan) for width in (TRUTH_LAYOUT.width, channels))
        self.parameters: list[tuple[int, Parameters]] = []
        self.done, self.trouble = 0, ""

    def moment(self, row: int) -> Moment | None:
        """Return the robot at a row; None = it has not come so far."""
        if row >= self.done:
            return None
        values = next(one for start, one in reversed(self.parameters) if start <= row)
        return Moment(Truth(self.truths[row : row + 1]), values)


class RunRecording:
    """A run that a page plays, see :class:`wlr_gym.render.web.player.Playable`.

    Args:
        run: a run.
        robot: file or config name; None = as the run's meta data say.
        backend: simulator of the ghost; None = no ghost.
        patch: what is added to the ghost's nominal model.
        segment: s between the points at which the ghost starts anew from the measured robot; inf = never.
        floor: as ``floor=`` of an environment; None = the run's.

    Attributes:
        name: of the run.
        length: s.
        ghost, true: the replayed robot, and the run's own simulation.

    Raises:
        InputError: no such robot or floor, a patch that does not fit it, or a run that is too short to be replayed.
    """

    def __init__(
        self,
        run: Run,
        robot: str | Path | None = None,
        backend: str | None = "gibbs_appell",
        patch: Patch | None = None,
        segment: float = SEGMENT,
        floor: FloorSource = None,
    ) -> None:
        self.run, self._backend, self._patch, self._segment = run, backend, patch, segment
        self.robot: Robot
        self.robot, self._model = prepare(run, robot, effects=patch, floor=floor)
        self._t = run["t"] - run["t"][0]
        self.name, self.length = run.name, float(self._t[-1])
        self._rolled = rolled_poses(run, self.robot)
        rows = len(self._t)
        self.ghost, self.true = Track(rows, len(CHANNELS)), Track(rows, 0)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._work, name="ghost", daemon=True)
        self._thread.start()

    @property
    def titles(self) -> Mapping[str, str]:
        """Channels and groups of channels -> unit."""
        names = [name for name in COLUMNS if name != "t" and name in self.run]
        groups = {COLUMNS[name].group: COLUMNS[name].unit for name in names}
        titles = groups | {name: COLUMNS[name].unit for name in names}
        if self.run.simulation is None and self._backend is None:
            return titles
        return titles | {title: TRUTH_LAYOUT.channels[name].unit for title, name in _TRUE.items()}

    def at(self, time: float) -> Moment:
        """Return the robot: as it was simulated, where that is known, else as it was measured."""
        moment = self.true.moment(self._row(time))
        return moment if moment is not None else self._measured(time)

    def ghost_at(self, time: float) -> Moment | None:
        """Return the replayed robot, as far as it has come."""
        return self.ghost.moment(self._row(time))

    def curves(self, title: str) -> list[Curve]:
        """Return the measured channels, and the replayed ones dashed; of a truth the run's, and the ghost's dashed."""
        if title in _TRUE:
            return self._true_curves(_TRUE[title])
        names = [name for name in COLUMNS if name in self.run and title in (name, COLUMNS[name].group)]
        curves = []
        for k, name in enumerate(names):
            curves.append(Curve(name, self._t, self.run[name], colour=k))
            if name in CHANNELS and self.ghost.done > 1:
                curves.append(Curve(f"{name}, replayed", *self._replayed_channel(name), dashed=True, colour=k))
        return curves

    def lines(self, time: float) -> list[str]:
        """Return what robot and ghost are."""
        lines = []
        if self.run.simulation is not None:
            known = self.true.moment(self._row(time)) is not None
            lines.append("robot: as simulated" if known else "robot: as its sensors say; simulating the run again ...")
        else:
            lines.append("robot: measured; floor as in the model")
        if self._backend is not None:
            anew = "" if np.isinf(self._segment) else f", anew every {self._segment:g} s"
            share = f"{100 * self.ghost.done / len(self._t):.0f} %"
            state = "" if self.ghost.done == len(self._t) else f" ({share} worked out)"
            lines.append(f"ghost: replayed on {self._backend}{anew}{state}")
        return lines + [f"stopped: {track.trouble}" for track in (self.true, self.ghost) if track.trouble]

    def wait(self) -> None:
        """Wait until all is worked out."""
        self._thread.join()

    def close(self) -> None:
        """Give up what is being worked out."""
        self._closed.set()  # seen at the next row; a kernel that is being compiled is not waited for
        self._thread.join(0.5)

    # ---- what is measured -------------------------------------------------------------------------------------------

    def _row(self, time: float) -> int:
        """Return the last row that is not after a time."""
        return max(int(np.searchsorted(self._t, time + 1e-9, side="right")) - 1, 0)

    def _measured(self, time: float) -> Moment:
        first, last = np.searchsorted(self._t, [time - _AROUND, time + _AROUND])
        near = replace(self.run, table=self.run.table.iloc[max(int(first) - 1, 0) : int(last) + 1])
        when = np.array([self.run["t"][0] + time])
        background = standing_state(self.robot, self._model)
        x, y, yaw = (np.interp(time, self._t, self._rolled[:, k]) for k in range(3))
        background.position[0, :2] = x, y
        background.quaternion[0] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
        state = measured_state(near, when, background, self._model)
        settle(self.robot, self._model, state)
        seen = has_camera(near) and bool(frame_near(near, when, self._model["camera.delay"][0])[0])
        truth = truth_of(state)
        if seen:
            truth["slip_velocity"][:] = slip_of(self.robot, self._model, state).reshape(1, 8)
        return Moment(truth, self._model, slip=seen, forces=False)

    # ---- what is worked out -----------------------------------------------------------------------------------------

    def _work(self) -> None:
        if self.run.simulation is not None:
            self._fill(self.true, partial(simulated_rows, self.run, self.robot))
        if (backend := self._backend) is not None:
            ghost = partial(replayed_rows, self.run, self.robot, self._model, backend, self._patch, self._segment)
            self._fill(self.ghost, ghost)

    def _fill(self, track: Track, rows: Callable[[], Iterator[tuple[Parameters, Truth, Array]]]) -> None:
        try:
            for row, (parameters, truth, channels) in enumerate(rows()):
                if self._closed.is_set():
                    return
                if not track.parameters or not np.array_equal(track.parameters[-1][1].values, parameters.values):
                    track.parameters.append((row, parameters.copy()))
                track.truths[row] = truth.values[0]
                if track.channels.shape[1]:
                    track.channels[row] = channels
                track.done = row + 1
        except InputError as error:
            track.trouble = str(error)

    def _replayed_channel(self, name: str) -> tuple[Array, Array]:
        """Return times and values; what the camera shows is older than the ghost's pose by its delay."""
        done = self.ghost.done
        t, values, measured = self._t[:done], self.ghost.channels[:done, CHANNELS.index(name)], self.run[name][:done]
        if name.startswith("cam_"):
            t = t + float(self._model["camera.delay"][0])
        if name == "cam_yaw":  # continuous, and by whole turns next to the measured one
            values, known = np.unwrap(values), np.isfinite(measured)
            turns = np.median(measured[known] - values[known]) / (2.0 * np.pi) if known.any() else 0.0
            values = values + 2.0 * np.pi * np.round(turns)
        return t, values

    def _true_curves(self, name: str) -> list[Curve]:
        curves = []
        for track, what, dashed in ((self.true, "", False), (self.ghost, ", replayed", True)):
            values = track.truths[: track.done, TRUTH_LAYOUT.slices[name]]
            for k, element in enumerate(TRUTH_LAYOUT.channels[name].elements if track.done > 1 else []):
                curves.append(Curve(f"{element}{what}", self._t[: track.done], values[:, k], dashed=dashed, colour=k))
        return curves


def open_recordings(
    runs: Sequence[Run], robot: str | Path | None, backend: str | None, patch: Patch, segment: float, floor: FloorSource = None
) -> Callable[[int], RunRecording]:
    """Return what opens each of some runs; what :class:`RunRecording` refuses of any of them is refused here."""
    for run in runs:
        prepare(run, robot, effects=patch, floor=floor)
    return lambda place: RunRecording(runs[place], robot, backend, patch, segment, floor)
