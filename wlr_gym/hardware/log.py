"""Logs of runs on the robot: measured runs, written row by row while it moves, and the interventions of the command limiter.

Each row and event goes to the file at once, so that a process that is killed leaves all it read. While a run is going on its
files are called ``partial_run_01.csv`` and so on, which no data set takes for a run; they can be read all the same.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import make_output_folder
from wlr_gym.data.format import CAMERA, COLUMNS, COMMANDS, RunMeta
from wlr_gym.data.runs import note_robot, write_meta
from wlr_gym.data.sensors import LIVE_CAMERA, channels, sensed_columns
from wlr_gym.hardware.link import Link
from wlr_gym.hardware.safety.rules import Decision
from wlr_gym.hardware.safety.status import RobotStatus
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, Sensors
from wlr_gym.robot import JOINTS, WHEEL_SLICE, Robot

if TYPE_CHECKING:
    from wlr_gym.data.logs.messages import McapStream

PARTIAL = "partial_"
#: Of a log, finished or not, with its number.
_NAME = re.compile(rf"(?:{PARTIAL})?(?:run|ramp)_(\d+)\.")
#: Phases of the control loop that begin a table, and its kind.
_TABLES = {"ramp": "ramp", "running": "run"}


def _append(file: io.FileIO, line: str) -> None:
    """Add a line, whole or not at all: a disk that fills up takes a part of it, and tells by the number alone."""
    data, done = (line + "\n").encode(), 0
    try:
        while done < len(data):
            done += file.write(data[done:])
    except OSError:
        if done:
            file.seek(-done, os.SEEK_END)
            file.truncate()
        raise


class CsvTable:
    """A CSV file that grows row by row, under a partial name until it is finished and gets its own (``path``)."""

    def __init__(self, path: Path, header: list[str]) -> None:
        self.path = path
        self.rows = 0
        self._file = _partial(path).open("xb", buffering=0)
        _append(self._file, ",".join(header))

    def add(self, values: np.ndarray) -> None:
        """Write one row; NaN is an empty cell. Numbers read back as the same float64."""
        cells = ("" if value != value else repr(value) for value in values.tolist())
        _append(self._file, ",".join(cells))
        self.rows += 1

    def finish(self) -> None:
        """Close and rename; a table without a row is taken away."""
        if self._file.closed:
            return
        self._file.close()
        if self.rows == 0:
            _partial(self.path).unlink()
        else:
            _partial(self.path).replace(self.path)


class RunRecorder:
    """Logs the runs of a control loop. A log that cannot be written (a full disk) is noted, and prevents nothing.

    Files of a start: ``ramp_01.csv`` (the way to the start pose), ``run_01.csv``, ``run_01.events.jsonl``. Both tables are
    measured runs (docs/run_format.md); a ramp's name keeps it out of the data set. With a policy there is also
    ``run_01.policy.csv``: per row of the run, what it was commanded and what it answered.

    Args:
        folder: of the logs, made if it is not there; runs are numbered on from those in it. None = none is written.
        meta: of the runs; written as ``meta.yaml``, with the robot.
        robot: whose runs they are. link: to it; has the clock, the camera whose poses are logged, an emulated one's seed.

    Attributes:
        columns: of a row.
        number: of the present or last start; 0 = none.
        trouble: why the log cannot be written; empty = it can.
        origin: what was known where the run began: wheel angles and the camera's age count from there; None = not begun.
        stream: where rows of the run go besides; it has these columns.
    """

    def __init__(self, folder: Path | None, meta: RunMeta, robot: Robot, link: Link) -> None:
        self.folder, self.meta, self._robot = folder, meta, robot
        self._sensed = sensed_columns(robot)
        given = ("t", *COMMANDS, *self._sensed, *LIVE_CAMERA)
        left_out = (*CAMERA, *LIVE_CAMERA) if link.camera is None else ()
        self.columns: list[str] = [name for name in COLUMNS if name in given and name not in left_out]
        self._order = [given.index(name) for name in self.columns]
        self.number, self.trouble = 0, ""
        self.stream: McapStream | None = None
        self.origin: RobotStatus | None = None
        self._clock, self._seed = link.clock, link.seed
        self._checks: list[str] = []
        self._tables: dict[str, CsvTable] = {}
        self._current, self._last = "", -np.inf  # table that rows go to, and time of the last row
        self._events: io.FileIO | None = None
        self._rules: set[str] = set()
        self._flow_trouble = ""
        self._camera: str | None = None  # why it gave no pose in the last control step

    def path(self, kind: str = "run", ending: str = ".csv") -> Path:
        """Return where a file of the last start will be once it is finished, such as ``run_01.csv``."""
        assert self.folder is not None
        return self.folder / f"{kind}_{self.number:02d}{ending}"

    @property
    def run(self) -> Path | None:
        """The last run, once it is finished; None where nothing was logged."""
        return self.path() if self.number and self.path().is_file() else None

    @property
    def files(self) -> list[Path]:
        """The files of the last start, once they are finished; of one that ended before its run, the way to its start pose."""
        paths = [*(table.path for table in self._tables.values()), self.path(ending=".events.jsonl")] if self.number else []
        return [path for path in paths if path.is_file()]

    def new_run(self, checks: list[str] | None = None) -> None:
        """Begin a log with what the preflight found; None = it was not made again.

        Raises:
            InputError: the folder cannot be written to, or its ``meta.yaml`` says something else.
        """
        self._checks = self._checks if checks is None else checks
        if self.folder is None:
            return
        self._finish()
        make_output_folder(self.folder)
        write_meta(self.folder, note_robot(self.folder, self._robot, self.meta))
        self.trouble = ""
        used = (_NAME.match(path.name) for path in self.folder.iterdir())
        self.number = 1 + max((int(name[1]) for name in used if name), default=0)
        self._tables, self._current, self._last = {}, "", -np.inf
        self._events = _partial(self.path(ending=".events.jsonl")).open("xb", buffering=0)
        self._event(self._clock.now(), "checks", found=self._checks)
        if self._seed is not None:
            self._event(self._clock.now(), "emulated", noise_seed=self._seed)

    def phase(self, name: str, reason: str) -> None:
        """Note that a phase begins; ``ramp`` and ``running`` begin a table."""
        with self._writing() as is_possible:
            if is_possible:
                self._event(self._clock.now(), "phase", phase=name, reason=reason)
                if name in _TABLES:
                    self._current = _TABLES[name]
                    self._table(self._current, self.path(self._current), self.columns)

    def step(self, status: RobotStatus, decision: Decision, setpoints: np.ndarray, count: int) -> None:
        """Write the row of a control step, and an event for each rule that begins to act.

        Args:
            status: what was known of the robot.
            decision: of the command limiter.
            setpoints: (8,) as the servos' registers hold them, rad and rad/s; NaN = motor off.
            count: readings of the joints so far.
        """
        with self._writing() as is_possible:
            if not is_possible:
                return
            if self._current and status.time > self._last:  # the readings of an interrupted control step come twice
                self._last = status.time
                sensors = sensors_of(status, self.origin)
                values = np.concatenate([[status.time], setpoints, channels(sensors, 0, self._sensed), sensors.camera_age])
                row = values[self._order]
                self._tables[self._current].add(row)
                if self.stream is not None and self._current == "run":
                    self.stream.add(float(row[0]), row[1:].tolist())
            rules = {verdict.rule: {"level": verdict.level.name, "text": verdict.text} for verdict in decision.verdicts}
            rules |= {rule: {"joints": [JOINTS[k] for k in np.flatnonzero(mask)]} for rule, mask in decision.limited.items()}
            for rule in rules.keys() - self._rules:
                self._event(status.time, "intervention", rule=rule, row=count, **rules[rule])
            self._rules = set(rules)
            self._note_sensors(status, count)

    def _note_sensors(self, status: RobotStatus, count: int) -> None:
        """Write an event where camera or flow begin to be missing, for a reason, or odd, and where they are well again."""
        if (camera := status.camera) is not None and camera.reason != self._camera:
            self._camera = camera.reason
            self._event(status.time, "camera", row=count, no_pose=self._camera or None, doubt=camera.doubt or None)
        if (flow := status.flow) is not None and (flow.trouble or flow.is_new):
            kind = (flow.trouble or flow.note).partition(":")[0]
            if kind != self._flow_trouble:
                self._event(status.time, "flow", row=count, trouble=flow.trouble, note=flow.note)
                self._flow_trouble = kind

    def policy(self, names: list[str], values: np.ndarray) -> None:
        """Write what the policy was commanded and answered for the row that comes next."""
        with self._writing() as is_possible:
            if is_possible:
                self._table("policy", self.path(ending=".policy.csv"), names).add(values)

    def end(self, reason: str, statistics: dict[str, Any]) -> None:
        """Write how the run ended, and give the files their names."""
        with self._writing():
            self._event(self._clock.now(), "end", reason=reason, statistics=statistics)
        with self._writing():
            self._finish()

    def _table(self, kind: str, path: Path, header: list[str]) -> CsvTable:
        """Return a table of this start, begun where it is not there yet."""
        if kind not in self._tables:
            self._tables[kind] = CsvTable(path, header)
        return self._tables[kind]

    def _event(self, time: float, kind: str, **content: Any) -> None:
        """Write what happened at ``time`` (s)."""
        if self._events is not None and not self._events.closed:
            _append(self._events, json.dumps({"t": round(time, 6), "event": kind, **content}))

    def _finish(self) -> None:
        for table in self._tables.values():
            table.finish()
        if self._events is not None and not self._events.closed:
            self._events.close()
            events = self.path(ending=".events.jsonl")
            _partial(events).replace(events)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[bool]:
        """Tell whether there is a log that takes more; note why it takes none from here on."""
        try:
            yield self.number > 0 and not self.trouble
        except OSError as error:
            self.trouble = self.trouble or f"the log cannot be written: {error}"


def read_events(run: Path) -> list[dict[str, Any]]:
    """Return the events beside a run, finished or partial."""
    path = run.with_name(run.stem + ".events.jsonl")
    try:
        return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    except (OSError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None


def sensors_of(status: RobotStatus, origin: RobotStatus | None) -> Sensors:
    """Return what was read as a plant's sensors (1, W); wheels from where they stood at the run's start, if it has begun.

    Without a camera its pose stays 0 and is never new, and its age counts from the start; so it does until the first pose.
    """
    sensors = Sensors(np.zeros((1, SENSOR_LAYOUT.width)))
    began, wheels = (0.0, 0.0) if origin is None else (origin.time, origin.position[WHEEL_SLICE])
    sensors.joint_position[0] = status.position
    sensors.joint_position[0, WHEEL_SLICE] -= wheels
    sensors.joint_velocity[0], sensors.joint_effort[0] = status.velocity, status.effort
    sensors.gyro[0], sensors.accelerometer[0] = status.gyro, status.accelerometer
    sensors.supply_voltage[0] = np.mean(status.voltage)
    sensors.joint_age[0], sensors.imu_age[0] = status.silence.max(), status.imu_silence
    sensors.camera_age[0] = sensors.flow_age[0] = status.time - began
    if status.flow is not None:
        sensors.flow[0], sensors.flow_quality[0] = status.flow.flow, status.flow.quality
        sensors.flow_age[0], sensors.flow_is_new[0] = status.flow.age, status.flow.is_new
    if (camera := status.camera) is not None:
        sensors.camera_pose[0], sensors.camera_age[0] = camera.pose, status.time - camera.time
        sensors.camera_is_new[0] = camera.is_new
    return sensors


def _partial(path: Path) -> Path:
    return path.with_name(PARTIAL + path.name)
