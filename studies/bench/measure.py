"""How a measurement is made and kept: rounds of A B A B ..., medians, and the spread of the ratio pair by pair."""

from __future__ import annotations

import math
import os
import platform
import statistics
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from wlr_gym.base.provenance import git_commit, versions

#: Runs some work and returns its rate (1/s) or its time (s).
Contender = Callable[[], float]
Name = TypeVar("Name", bound=Hashable)
#: Whether a bar is met, in words.
YES_NO = {True: "yes", False: "NO", None: "-"}
#: Called with the share of a measurement that is done.
TellShare = Callable[[float], None]


@dataclass(frozen=True)
class Size:
    """How much work: ``rounds`` per contender; ``quick`` shrinks everything to see that it runs; ``tell``: how far it is."""

    rounds: int = 5
    quick: bool = False
    tell: TellShare = lambda share: None

    def __call__(self, full: int, quick: int) -> int:
        """Return the amount of work to do."""
        return quick if self.quick else full


@dataclass(frozen=True)
class Measurement:
    """One line of the report: a value (ours), what it is held against, and the bar of the project.

    Attributes:
        name: of the measurement it belongs to. what: in words. unit: of ``ours`` and ``peer``.
        ours: one value per round. peer: those of the fastest peer, None where there is none. peer_name: which one.
        bar: least ratio to the peer, or, without a peer, the upper limit of ``ours``; None = for information.
        others: median of every slower peer.
        at_least: the peer did not get to the end in every round: its values are upper bounds and the ratios lower ones.
    """

    name: str
    what: str
    unit: str
    ours: tuple[float, ...]
    peer: tuple[float, ...] | None = None
    peer_name: str = ""
    bar: float | None = None
    others: Mapping[str, float] | None = None
    at_least: bool = False

    @property
    def ratios(self) -> tuple[float, ...]:
        """Ours over the peer's, pair by pair; empty without a peer.

        Where it got nothing done: infinite, or 0 if ours did not either.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            return tuple(np.nan_to_num(np.divide(self.ours, self.peer), posinf=math.inf).tolist()) if self.peer else ()

    @property
    def met(self) -> bool | None:
        """Whether the bar is met by the median; None without a bar."""
        if self.bar is None:
            return None
        return statistics.median(self.ratios) >= self.bar if self.peer else statistics.median(self.ours) < self.bar

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain JSON types."""
        return {
            "name": self.name, "what": self.what, "unit": self.unit, "ours": summary(self.ours),
            "peer_name": self.peer_name or None, "peer": summary(self.peer) if self.peer else None,
            "ratio": summary(self.ratios) if self.peer else None, "bar": self.bar, "met": self.met,
            "other_peers": dict(self.others or {}), "at_least": self.at_least,
        }  # fmt: skip


def summary(values: Sequence[float]) -> dict[str, Any]:
    """Return median, extremes and all values."""
    return {"median": statistics.median(values), "min": min(values), "max": max(values), "values": list(values)}


def interleave(
    contenders: Mapping[Name, Contender], rounds: int, *, warm_up: bool = True, tell: TellShare = lambda share: None
) -> dict[Name, tuple[float, ...]]:
    """Run every contender once unmeasured (compilation, caches), then ``rounds`` times in turn; return their values."""
    unmeasured = len(contenders) if warm_up else 0
    turns = [*contenders.items()] * rounds
    for contender in contenders.values() if warm_up else ():
        contender()
    values: dict[Name, list[float]] = {name: [] for name in contenders}
    for done, (name, contender) in enumerate(turns):
        tell((unmeasured + done) / (unmeasured + len(turns)))
        values[name].append(contender())
    return {name: tuple(series) for name, series in values.items()}


def against_fastest(
    name: str, what: str, unit: str, ours: tuple[float, ...], peers: Mapping[str, tuple[float, ...]], bar: float | None
) -> Measurement:
    """Return the measurement against the peer with the highest median rate."""
    medians = {peer: statistics.median(values) for peer, values in peers.items()}
    best = max(medians, key=lambda peer: medians[peer])
    others = {peer: value for peer, value in medians.items() if peer != best}
    return Measurement(name, what, unit, ours, peers[best], best, bar, others)


def rate(work: Callable[[], object], amount: float, clock: Callable[[], float] = time.perf_counter) -> float:
    """Return ``amount`` over the time ``work`` takes by a clock, 1/s."""
    start = clock()
    work()
    return amount / max(clock() - start, 1e-9)


def machine() -> dict[str, Any]:
    """Return what the numbers depend on: date, processor, cores, load at the start, versions, commit."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "processor": names[0] if names else platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "load_average": list(os.getloadavg()) if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "versions": versions(),
        "git_commit": git_commit(),
    }


def speed_cells(row: Mapping[str, Any]) -> tuple[str, str, str, str]:
    """Return what tables say of a measurement, as of ``as_dict``: ours, the peer's, the ratio [min..max], the bar."""
    peer, ratio, bar, least = row["peer"], row["ratio"], row["bar"], row.get("at_least")
    ours = _value(row["ours"], row["unit"])
    limit = "-" if bar is None else f">= {bar:g}" if peer else f"< {bar:g} {row['unit']}"
    limit = f"{limit}: missed" if row["met"] is False else limit
    if not peer:
        return ours, "-", "-", limit
    theirs = f"{_value(peer, row['unit'])} ({row['peer_name']})"
    apart = "{median:.3g} [{min:.3g}..{max:.3g}]".format(**ratio)
    # of a peer that was given up the time is a lower bound
    return ours, f"none; given up at {theirs}" if least else theirs, f">= {apart}" if least else apart, limit


def _value(found: Mapping[str, Any], unit: str) -> str:
    if unit == "s" and found["min"] < found["max"]:
        return "{median:.3g} s [{min:.3g}..{max:.3g}]".format(**found)
    per = {"1/s": "/s", "1/h": "/h"}.get(unit, f" {unit}")
    return f"{short(found['median'])}{per}".rstrip()


def short(value: float) -> str:
    """Return ``2.5 M``, ``2.5 k`` or ``2.5``."""
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if value >= size:
            return f"{value / size:.3g} {letter}"
    return f"{value:.3g}"
