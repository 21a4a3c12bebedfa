"""Logs of runs on the robot: measured runs, written row by row while it moves, with what the safety gate did beside them.

Each row and event goes to the file at once, so that a process that is killed leaves all it saw. While a run is going on its
files are called ``partial_run_01.csv`` and so on, which no data set takes for a run; they can be read all the same.
"""

from __future__ import annotations

import io
import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import make_output_folder
from wlr_gym.data.format import CAMERA, COLUMNS, COMMANDS, RunMeta
from wlr_gym.data.sensor_columns import SENSED, channels
from wlr_gym.data.write import write_meta
from wlr_gym.hardware.safety.rules import View
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, Sensors

PARTIAL = "partial_"
_HEADER = [name for name in COLUMNS if name == "t" or name in COMMANDS or (name in SENSED and name not in CAMERA)]
_ORDER = [("t", *COMMANDS, *SENSED).index(name) for name in _HEADER]


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


class Table:
    """A CSV file that grows row by row, under its partial name until it is finished.

    Args:
        path: final name.
        header: names of the columns.
    """

    def __init__(self, path: Path, header: list[str]) -> None:
        self.path = path
        self.rows = 0
        self._partial = path.with_name(PARTIAL + path.name)
        self._file = self._partial.open("xb", buffering=0)
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
            self._partial.unlink()
        else:
            self._partial.replace(self.path)


class RunLog:
    """The files of one start: ``ramp_01.csv`` (the way to the start pose), ``run_01.csv``, ``run_01.events.jsonl``.

    Both tables are measured runs (docs/run_format.md); a ramp's name keeps it out of the data set. With a policy there is also
    ``run_01.policy.csv``: per row of the run, what it was commanded and what it answered.

    Args:
        folder: made if it is not there; runs are numbered on from those in it.
        meta: written as ``meta.yaml``.

    Raises:
        InputError: the folder cannot be written to, or its ``meta.yaml`` says something else.
    """

    def __init__(self, folder: Path, meta: RunMeta) -> None:
        make_output_folder(folder)
        write_meta(folder, meta)
        self.folder = folder
        self.number = 1 + max((_number(path) for path in folder.iterdir()), default=0)
        self._tables: dict[str, Table] = {}
        self._current = ""
        self._last = -np.inf
        self.events_path = folder / f"{PARTIAL}{self.name('run')}.events.jsonl"
        self._events = self.events_path.open("xb", buffering=0)

    def name(self, kind: str) -> str:
        """Return the stem of a file, such as ``run_01``."""
        return f"{kind}_{self.number:02d}"

    @property
    def run(self) -> Path:
        """Where the run will be once it is finished."""
        return self.folder / f"{self.name('run')}.csv"

    def begin(self, kind: str) -> None:
        """Write rows to ``ramp`` or ``run`` from here on."""
        self._current = kind
        if kind not in self._tables:
            self._tables[kind] = Table(self.folder / f"{self.name(kind)}.csv", _HEADER)

    def row(self, time: float, sensors: Sensors, goals: np.ndarray) -> None:
        """Write what was read at ``time`` (s) and what was then asked for; NaN = motor off."""
        if self._current and time > self._last:  # a tick that was interrupted is looked at twice
            self._last = time
            values = np.concatenate([[time], goals, channels(sensors, 0)])
            self._tables[self._current].add(values[_ORDER])

    def policy(self, names: list[str], values: np.ndarray) -> None:
        """Write what the policy was commanded and answered for the row that comes next."""
        if "policy" not in self._tables:
            self._tables["policy"] = Table(self.folder / f"{self.name('run')}.policy.csv", names)
        self._tables["policy"].add(values)

    def event(self, time: float, kind: str, **content: Any) -> None:
        """Write what happened at ``time`` (s)."""
        if not self._events.closed:
            line = {"t": round(time, 6), "event": kind, **content}
            _append(self._events, json.dumps(line))

    def finish(self) -> None:
        """Close the files and give them their names."""
        for table in self._tables.values():
            table.finish()
        if not self._events.closed:
            self._events.close()
            self.events_path.replace(self.folder / f"{self.name('run')}.events.jsonl")


def read_events(run: Path) -> list[dict[str, Any]]:
    """Return the events beside a run, finished or partial.

    Raises:
        InputError: there are none.
    """
    path = run.with_name(run.stem + ".events.jsonl")
    try:
        return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    except (OSError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None


def sensors_of(view: View, wheel_zero: np.ndarray, started: float) -> Sensors:
    """Return what was seen as a plant's sensors (1, W); wheels from where they stood at the run's start.

    There is no camera: its pose stays 0 and is never new, its age counts from the start.
    """
    sensors = Sensors(np.zeros((1, SENSOR_LAYOUT.width)))
    sensors.joint_position[0] = view.position
    sensors.joint_position[0, 4:] -= wheel_zero
    sensors.joint_velocity[0], sensors.joint_effort[0] = view.velocity, view.effort
    sensors.gyro[0], sensors.accelerometer[0] = view.gyro, view.accelerometer
    sensors.supply_voltage[0] = np.mean(view.voltage)
    sensors.joint_age[0], sensors.imu_age[0] = view.silence.max(), view.imu_silence
    sensors.camera_age[0] = view.time - started
    return sensors


def _number(path: Path) -> int:
    found = re.match(rf"(?:{PARTIAL})?(?:run|ramp)_(\d+)\.", path.name)
    return int(found.group(1)) if found else 0
