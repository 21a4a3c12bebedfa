"""Make runs of a recording, part by part: as much of it is in memory as a part needs; cuts are where the robot is quiet."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from wlr_gym.data.logs.map import LogMap, Resolved
from wlr_gym.data.logs.rows import MadeRun, NoRowsError, Samples, check_sources, make_run, rows_topic
from wlr_gym.data.logs.topic_store import TopicStore
from wlr_gym.data.logs.topics import Share
from wlr_gym.robot import JOINTS, WHEELS

#: s, and numbers of the log, that a part may have (250 s of 40 channels at 200 Hz); ``split`` may ask for longer ones.
LONGEST, NUMBERS = 600.0, 2_000_000
#: Share of a part's length by which a cut may be moved to where the robot is quieter.
_PLAY = 0.25
#: s that samples of a part go on at its ends.
_AROUND = 0.1
#: Usual steps, and s, from which on what is between two rows is a hole; s below which a piece between holes is no run.
_HOLE, _LEAST_HOLE, _LEAST_PIECE = 5.0, 0.5, 1.0


def runs_of(
    recording: TopicStore, found: LogMap, resolved: Mapping[str, Resolved], split: float | None, tell: Share
) -> Iterator[MadeRun]:
    """Yield the runs that a map makes of a recording.

    One, or of one that is longer than :data:`LONGEST`, or has more than :data:`NUMBERS`, several; with ``split``, runs of about
    so many seconds, none of them across a hole. What is to be said of all of them goes into the recording's notes.

    Raises:
        InputError: what :func:`wlr_gym.data.logs.rows.make_run` raises; parts without rows are left out, and said.
    """
    check_sources(recording.name, resolved)
    edges = _edges(recording, found, resolved, split)
    if len(edges) < 3:
        yield from _parts(make_run(recording.whole(), found, resolved), split)
        return
    recording.notes.append(f"cut into {len(edges) - 1} parts, where the robot is quietest")
    start, begin, refused = edges[0], edges[0], 0
    for k, edge in enumerate(edges[1:], 1):
        here = f"{(begin - start) * 1e-9:.0f} s on: "
        play = round(_PLAY * min(edge - edges[k - 1], edges[k + 1] - edge)) if k + 1 < len(edges) else 0
        try:
            made, begin = _part_until(recording, found, resolved, (begin, edge), play)
        except NoRowsError as error:
            refused, begin = refused + 1, edge
            if refused == len(edges) - 1:
                raise
            recording.notes.append(f"{here}no run: {str(error).partition(': ')[2]}")
        else:
            yield from _parts(replace(made, notes=tuple(here + note for note in made.notes)), split)
        tell(k / (len(edges) - 1))


def _part_until(
    recording: TopicStore, found: LogMap, resolved: Mapping[str, Resolved], span: tuple[int, int], play: int
) -> tuple[MadeRun, int]:
    """Return the rows of a span (ns), its end moved by up to ``play`` to where the robot is quiet, and that end."""
    begin, edge = span
    end = edge + play

    def when(topic: str) -> tuple[str, int, int]:
        clock = found.use(topic)
        offset = round(clock.offset * 1e9)
        return clock.use, begin - offset, end - offset

    made = make_run(recording.between(when), found, resolved, (begin, end))
    t, middle = made.table["t"], (edge - made.origin) * 1e-9
    last = _quiet_row(made, middle, play * 1e-9 / _PLAY) if play and 0.0 < middle < t[-1] else 0
    if last < 2:  # nothing to be cut
        return _part(made, 0, len(t)), end
    return _part(made, 0, last), made.origin + round(float(t[last]) * 1e9)


def _edges(recording: TopicStore, found: LogMap, resolved: Mapping[str, Resolved], split: float | None) -> list[int]:
    """Return where parts begin and end, ns on the common clock; none where the recording is a part itself."""
    rows = rows_topic(found, resolved)
    if rows not in recording:
        return []
    clock = found.use(rows)
    spans = recording.spans(rows, clock.use)
    seconds = len(spans) * float(np.median([last - first for first, last in spans])) * 1e-9  # whatever a stray header says
    longest = max(min(LONGEST, seconds * NUMBERS / max(recording.numbers, 1)), split or 0.0)
    count = min(math.ceil(seconds / longest), len(spans)) if longest > 0.0 else 1
    begins = sorted({first for first, _ in spans})
    inner = [begins[k * len(begins) // count] for k in range(1, count)]
    edges = sorted({begins[0], *inner, max(last for _, last in spans) + 1})
    return [edge + round(clock.offset * 1e9) for edge in edges]


# ---- cutting what is in memory ---------------------------------------------------------------------------------------


def _parts(made: MadeRun, split: float | None) -> Iterator[MadeRun]:
    """Yield a recording whole, or in parts of about ``split`` seconds, none of them across a hole."""
    if split is None:
        yield made
        return
    t = made.table["t"]
    holes = np.flatnonzero(np.diff(t) > max(_HOLE * float(np.median(np.diff(t))), _LEAST_HOLE)) + 1
    pieces = list(itertools.pairwise([0, *holes.tolist(), len(t)]))
    kept = [(first, last) for first, last in pieces if t[last - 1] - t[first] >= _LEAST_PIECE] or pieces
    if len(kept) < len(pieces):
        text = f"{len(pieces) - len(kept)} pieces between holes are shorter than {_LEAST_PIECE:g} s and are left out"
        made = replace(made, notes=(*made.notes, text))
    for first, last in kept:
        piece = made if len(pieces) == 1 else _part(made, first, last)
        whole = float(piece.table["t"][-1])
        count = max(round(whole / split), 1)
        cuts = [_quiet_row(piece, k * whole / count, whole / count) for k in range(1, count)]
        edges = [0, *cuts, len(piece.table["t"])]
        for begin, end in itertools.pairwise(edges):
            yield piece if len(edges) == 2 else _part(piece, begin, end)


def _quiet_row(made: MadeRun, middle: float, length: float) -> int:
    """Return the row near a time at which the joints are asked to move least."""
    t = made.table["t"]
    rows = np.flatnonzero(np.abs(t - middle) <= _PLAY * length)
    motion = np.zeros(len(t))
    for joint in JOINTS:
        motion += np.abs(np.gradient(made.table[f"pos_{joint}"], t))
    width = max(int(0.3 / float(np.median(np.diff(t)))), 1)
    smooth = np.convolve(motion, np.ones(width) / width, mode="same")
    cost = smooth[rows] + 0.01 * np.abs(t[rows] - middle) / length
    return int(rows[np.argmin(cost)])


def _part(made: MadeRun, first: int, last: int) -> MadeRun:
    table = {name: values[first:last].copy() for name, values in made.table.items()}
    begin, end = float(table["t"][0]), float(table["t"][-1])
    samples = {}
    for name, one in made.samples.items():
        inside = (one.t >= begin - _AROUND) & (one.t <= end + _AROUND)
        samples[name] = Samples(one.t[inside] - begin, one.values[inside])
    for wheel in (f"pos_{wheel}" for wheel in WHEELS):  # wheels count from the run's start
        start = table[wheel][0]
        table[wheel] -= start
        samples[wheel] = Samples(samples[wheel].t, samples[wheel].values - start)
    table["t"] -= begin
    return replace(made, table=table, samples=samples, origin=made.origin + round(begin * 1e9))


def write_samples(path: Path, made: MadeRun) -> None:
    """Write every sample at its own time: channel, t (s, the run's clock), value (SI units)."""
    import pyarrow
    import pyarrow.parquet

    schema = pyarrow.schema([("channel", pyarrow.string()), ("t", pyarrow.float64()), ("value", pyarrow.float64())])
    with pyarrow.parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        for name, one in made.samples.items():
            columns = [pyarrow.array([name] * len(one.t)), pyarrow.array(one.t), pyarrow.array(one.values)]
            writer.write_table(pyarrow.table(columns, schema=schema))
