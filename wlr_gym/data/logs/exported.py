"""Read back runs that :mod:`wlr_gym.data.logs.write` wrote: channels to the bit, times to 1 ns."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.settings import parse_config
from wlr_gym.data.format import RunMeta
from wlr_gym.data.logs.messages import JOINT_STATES, PLACES, RUN, read_content, seconds
from wlr_gym.data.logs.open import quiet, read_logs
from wlr_gym.data.logs.topics import LOG, Log, Share
from wlr_gym.data.simulation_record import Simulation
from wlr_gym.robot import Robot, load_robot

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ExportedRun:
    """A run as it was exported.

    Attributes:
        table: columns by name, (rows,).
        meta, simulation: what stood beside it.
        robot: whose run it is, where it travelled by content.
        notes: what is odd about the file.
    """

    table: dict[str, Array]
    meta: RunMeta
    simulation: Simulation | None
    robot: Robot | None
    notes: tuple[str, ...]


def read_exported(path: str | Path, tell: Share = quiet) -> ExportedRun:
    """Read a run back from an MCAP file or a rosbag2 of :func:`wlr_gym.data.logs.write.export_run`.

    Raises:
        InputError: no such file, or another program's.
    """
    fields: dict[str, set[str]] = {RUN: set()}
    for topic, field in PLACES.values():
        fields.setdefault(topic, set()).add(field)
    (log,) = read_logs(path, fields, tell=tell)
    if RUN not in log.topics or not log.topics[RUN].text:
        raise InputError(f"{path}: no message on '{RUN}': another program's log; import it with a map")
    content = read_content(log.topics[RUN].text, log.name)
    if JOINT_STATES not in log.topics:
        raise InputError(f"{log.name}: no message on '{JOINT_STATES}': the run has no row")
    times = log.topics[JOINT_STATES].clock(LOG)
    table = {"t": np.array([seconds(int(time), content["clock_offset"]) for time in times])}
    for column in content["columns"]:
        if column != "t":
            table[column] = _column(log, column, times)
    meta = parse_config(RunMeta, content["meta"], f"{log.name}, topic '{RUN}', meta")
    record = content["simulation"]
    simulation = parse_config(Simulation, record, f"{log.name}, topic '{RUN}', simulation") if record else None
    robot = load_robot(content["robot"]) if content.get("robot") else None
    return ExportedRun(table, meta, simulation, robot, log.notes)


def _column(log: Log, column: str, times: NDArray[np.int64]) -> Array:
    """Values at the rows' times; NaN where a row's message is not there."""
    topic, field = PLACES[column]
    values = np.full(len(times), np.nan)
    if topic in log.topics and field in log.topics[topic].fields:
        at, found = log.topics[topic].series(field, LOG, log.name)
        rows = np.minimum(np.searchsorted(times, at), len(times) - 1)
        mine = times[rows] == at  # of a file that was cut off, a row may lack some of its messages
        values[rows[mine]] = found[mine]
    return values
