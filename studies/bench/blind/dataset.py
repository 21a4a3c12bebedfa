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


def copy_of(robot: Mapping[str, Any], seed: int, exact: bool = False, soft: bool = False, bumps: float | None = None) -> Copy:
    """Draw a robot copy; see :func:`simulate_runs`."""
    copy = draw(dict(robot), np.random.default_rng([seed, 1]))
    copy = with_body_of(copy, nominal(dict(robot))) if exact else copy
    return yielding(copy, np.random.default_rng([seed, 7]), bumps) if soft else copy


def simulate_runs(
    robot: Mapping[str, Any],
    effects: Sequence[Mapping[str, Any]],
    seed: int,
    runs: Sequence[int] = range(8),
    exact: bool = False,
    soft: bool = False,
    camera: bool = True,
    bumps: float | None = None,
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
        bumps: rms height of the floor where tyres and gears yield, m; None = drawn.

    Returns:
        Tables of the runs, contents of ``meta.yaml``, the robot copy.
    """
    copy = copy_of(robot, seed, exact, soft, bumps)
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


def _motionless(table: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Six times the second before anything moves."""
    still = table.iloc[: int(np.count_nonzero(table["t"] < 0.95))]
    return pd.concat([still.assign(t=still["t"] + lap) for lap in range(6)], ignore_index=True)


#: What happens to every run. The fewest runs are in ``too_few``: one.
SPOIL: Mapping[str, Callable[[pd.DataFrame, np.random.Generator], pd.DataFrame]] = {
    # leg angles in degrees
    "wrong_unit": lambda table, rng: table.assign(**{name: np.rad2deg(table[name]) for name in _angles(LEGS)}),
    # rows in another order
    "mis_ordered": lambda table, rng: table.iloc[rng.permutation(len(table))].reset_index(drop=True),
    # a third of all encoder readings missing
    "nan_ridden": lambda table, rng: table.assign(
        **{name: table[name].where(rng.random(len(table)) > 1 / 3) for name in _angles(JOINTS)}
    ),
    # the encoder of one wheel counts backwards, its rate and the rest do not
    "flipped_sign": lambda table, rng: table.assign(pos_wheel_lr=-table["pos_wheel_lr"]),
    # one leg's encoder stays at its first reading; so does its rate
    "stuck_encoder": lambda table, rng: table.assign(pos_leg_rf=table["pos_leg_rf"].iloc[0], vel_leg_rf=0.0),
    # a fifth of a second
    "too_short": lambda table, rng: table.iloc[:10],
    "too_few": lambda table, rng: table,
    "motionless": _motionless,
}


def _angles(joints: Sequence[str]) -> list[str]:
    return [f"pos_{joint}" for joint in joints]


def spoilt(how: str, tables: Sequence[pd.DataFrame], rng: np.random.Generator) -> list[pd.DataFrame]:
    """Return the runs of a data set with what :data:`SPOIL` does to them."""
    return [SPOIL[how](table, rng) for table in (tables[:1] if how == "too_few" else tables)]
