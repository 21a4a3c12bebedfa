"""Ways in which measured data are bad: what a workflow must refuse or call bad, never explain by an effect."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pandas as pd

from studies.bench.blind.copies import JOINTS, LEGS

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
