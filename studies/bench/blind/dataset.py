"""A robot copy with something hidden in it, runs of it, and a data set of eight, spoilt where that is the case."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from studies.bench.blind import commands, drive
from studies.bench.blind.cases import Hidden, hide
from studies.bench.blind.copies import JOINTS, LEGS, Copy, draw, nominal, with_body_of, yielding
from studies.bench.blind.drive import BlindProfile, build, simulate

#: Profile registers a set may have; 0 = off. Wheels, rad/s2.
ACCELERATIONS = (0.0, 7.490150, 11.235225, 14.980301, 22.470451)
#: Legs, rad/s.
SPEEDS = (0.959233, 1.438849, 1.918466)
#: Legs, rad/s2.
LEG_ACCELERATIONS = (0.0, 7.490150, 14.980301)
#: SI units; of a fingerprint.
RESOLUTION = 1e-4
#: Stands for what was not measured there.
UNSEEN = -(2.0**53)


@dataclass(frozen=True)
class BlindRobot:
    """A robot copy that can be driven.

    Attributes:
        robot: contents of a robot file. copy: what is true of this one. hidden: in it.
        profile: of its servos. camera: whether one sees it.
    """

    robot: Mapping[str, Any]
    copy: Copy
    hidden: Hidden
    profile: BlindProfile
    camera: bool = True

    def drive(self, script: commands.BlindScript, noise: np.random.Generator) -> pd.DataFrame:
        """Return the table of one run."""
        sheet, copy, hidden = dict(self.robot), self.copy, self.hidden
        times = drive.ticks(script.duration, float(sheet["sensors"]["control_rate"]), noise)
        setpoints = script.setpoints(times)
        start = setpoints[0, :4] + 0.02 * noise.standard_normal(4)
        records = simulate(build(copy, hidden), copy, hidden, self.profile, times, setpoints, start, times[-1] + 0.01)
        table = drive.log(records, times, setpoints, copy, hidden, sheet, noise)
        return table if self.camera else table.drop(columns=[name for name in table if name.startswith("cam_")])

    def meta(self, notes: str) -> dict[str, Any]:
        """Return the contents of ``meta.yaml`` of its runs."""
        registers = {name: value for name, value in vars(self.profile).items() if value > 0}
        return {
            "robot": self.robot["name"],
            "profile": registers,
            "ground": "indoor floor",
            "marker_offset": [0.0, 0.0, 0.0],
            "notes": notes,
        }


def copy_of(robot: Mapping[str, Any], seed: int, exact: bool = False, soft: bool = False) -> Copy:
    """Draw a robot copy; see :func:`simulate_runs`."""
    copy = draw(dict(robot), np.random.default_rng([seed, 1]))
    copy = with_body_of(copy, nominal(dict(robot))) if exact else copy
    return yielding(copy, np.random.default_rng([seed, 7])) if soft else copy


def simulate_runs(
    robot: Mapping[str, Any],
    effects: Sequence[Mapping[str, Any]],
    seed: int,
    runs: Sequence[int] = range(8),
    exact: bool = False,
    soft: bool = False,
    camera: bool = True,
) -> tuple[list[pd.DataFrame], dict[str, Any], Copy]:
    """Simulate runs of a data set.

    Args:
        robot: contents of a robot file.
        effects: what is hidden, ``{name, where, parameters}``.
        seed: of the copy, the commands and the noise. With other effects it is the same robot with the same commands.
        runs: which of the eight kinds.
        exact: the nominal robot, but for its clocks and its sensors' biases, instead of a copy within tolerances.
        soft: tyres and gears yield, which differs from one set to the next and is in no robot file.
        camera: whether one was there.

    Returns:
        Tables of the runs, contents of ``meta.yaml``, the robot copy.
    """
    copy = copy_of(robot, seed, exact, soft)
    choose = np.random.default_rng([seed, 2])
    geometry = commands.Geometry(float(robot["leg"]["length"]), float(robot["wheel"]["radius"]))
    scripts = commands.scripts(choose, geometry)
    profile = BlindProfile(
        float(choose.choice(ACCELERATIONS)), float(choose.choice(SPEEDS)), float(choose.choice(LEG_ACCELERATIONS))
    )
    driven = BlindRobot(robot, copy, hide(effects), profile, camera)
    tables = [driven.drive(scripts[kind], np.random.default_rng([seed, 3, kind])) for kind in runs]
    notes = ", ".join(f"run_{n + 1:02d} {commands.NAMES[kind]}" for n, kind in enumerate(runs))
    return tables, driven.meta(f"runs in order: {notes}"), copy


def fingerprint(tables: Sequence[pd.DataFrame]) -> str:
    """Return a SHA-256 of what runs hold, to :data:`RESOLUTION`: below it, processors differ."""
    digest = hashlib.sha256()
    for table in tables:
        digest.update(",".join(table.columns).encode())
        values = table.to_numpy(np.float64)
        digest.update(np.where(np.isnan(values), UNSEEN, np.rint(np.nan_to_num(values) / RESOLUTION)).astype("<i8").tobytes())
    return digest.hexdigest()


def write(folder: Path, tables: Sequence[pd.DataFrame], meta: Mapping[str, Any]) -> None:
    """Write a data set; the folder's name and contents say nothing about what is hidden."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, table in enumerate(tables, start=1):
        table.to_parquet(folder / f"run_{number:02d}.parquet", index=False)
    with open(folder / "meta.yaml", "w", encoding="utf-8") as file:
        yaml.safe_dump(dict(meta), file, sort_keys=False, width=1000)


# ---- bad data: what a workflow must refuse or call bad, never explain by an effect -----------------------------------


Tables = list[pd.DataFrame]


def _wrong_unit(tables: Tables, rng: np.random.Generator) -> Tables:
    """Leg angles in degrees."""
    columns = [f"pos_{leg}" for leg in LEGS]
    return [table.assign(**{name: np.rad2deg(table[name]) for name in columns}) for table in tables]


def _mis_ordered(tables: Tables, rng: np.random.Generator) -> Tables:
    """Rows of every run in another order."""
    return [table.iloc[rng.permutation(len(table))].reset_index(drop=True) for table in tables]


def _nan_ridden(tables: Tables, rng: np.random.Generator) -> Tables:
    """A third of all encoder readings missing."""
    columns = [f"pos_{joint}" for joint in JOINTS]
    return [table.assign(**{name: table[name].where(rng.random(len(table)) > 1 / 3) for name in columns}) for table in tables]


def _flipped_sign(tables: Tables, rng: np.random.Generator) -> Tables:
    """The encoder of one wheel counts backwards, its rate and the rest do not."""
    return [table.assign(pos_wheel_lr=-table["pos_wheel_lr"]) for table in tables]


def _stuck_encoder(tables: Tables, rng: np.random.Generator) -> Tables:
    """One leg's encoder stays at its first reading; so does its rate."""
    return [table.assign(pos_leg_rf=table["pos_leg_rf"].iloc[0], vel_leg_rf=0.0) for table in tables]


def _too_short(tables: Tables, rng: np.random.Generator) -> Tables:
    """A fifth of a second of every run."""
    return [table.iloc[:10] for table in tables]


def _too_few(tables: Tables, rng: np.random.Generator) -> Tables:
    """One run only."""
    return tables[:1]


def _motionless(tables: Tables, rng: np.random.Generator) -> Tables:
    """Six times the second before anything moves."""
    still = [table.iloc[: int(np.count_nonzero(table["t"] < 0.95))] for table in tables]
    return [pd.concat([table.assign(t=table["t"] + lap) for lap in range(6)], ignore_index=True) for table in still]


SPOIL: Mapping[str, Callable[[Tables, np.random.Generator], Tables]] = {
    "wrong_unit": _wrong_unit,
    "mis_ordered": _mis_ordered,
    "nan_ridden": _nan_ridden,
    "flipped_sign": _flipped_sign,
    "stuck_encoder": _stuck_encoder,
    "too_short": _too_short,
    "too_few": _too_few,
    "motionless": _motionless,
}
