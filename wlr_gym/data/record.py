"""Motions from and to files; simulated runs: what the robot's own log would hold after it was driven through a motion."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import LARGEST_NOISE_SEED, InputError, require_seed
from wlr_gym.base.files import make_output_folder, replace_file
from wlr_gym.base.text import row_words
from wlr_gym.data.excitations import CONTROL_PERIOD, SETTLE, Motion
from wlr_gym.data.format import COMMANDS, Profile, RunMeta
from wlr_gym.data.replay import held_setpoints, profile_parameters
from wlr_gym.data.run_states import standing_at
from wlr_gym.data.runs import Run, Simulation, departures, floor_of_meta, read_meta, start_of, write_csv, write_meta, write_run
from wlr_gym.data.sensors import channels, sensed_columns
from wlr_gym.physics.effects import EFFECTS, Patch, apply_patch, load_patch
from wlr_gym.physics.floor import lay_floor
from wlr_gym.physics.plants import check_simulator, make_plant
from wlr_gym.physics.plants.base import PlantOptions
from wlr_gym.robot import JOINTS, LEGS, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: rad, rad/s: setpoints beyond are in another unit.
_LARGEST = np.repeat([2.0 * np.pi, 30.0], 4)


# ---- motions as files ------------------------------------------------------------------------------------------------


def write_commands(folder: Path, motion: Motion) -> Path:
    """Write a motion's setpoints as ``folder/<name>.csv`` (``t``, ``cmd_*``; empty = torque off), profile in ``meta.yaml``."""
    make_output_folder(folder)
    write_meta(folder, RunMeta(profile=motion.profile))
    t = np.array([round(tick * motion.period, 9) for tick in range(len(motion.setpoints))])
    columns = {"t": t, **dict(zip(COMMANDS, motion.setpoints.T, strict=True))}
    path = folder / f"{motion.name}.csv"
    replace_file(path, lambda temporary: write_csv(temporary, columns))
    return path


def read_commands(path: Path) -> Motion:
    """Read a motion at the control rate from a command file or a whole run; its profile from the ``meta.yaml`` beside it.

    Args:
        path: file with the columns ``t`` and ``cmd_*``; others are not looked at. Each row's setpoints hold until the next row.

    Raises:
        InputError: no such file, a column that is missing, times that do not increase, setpoints that are not rad and rad/s.
    """
    import pandas

    if not path.is_file() or path.suffix.lower() not in (".csv", ".parquet"):
        raise InputError(f"{path}: expected a .csv or .parquet file with the columns t and cmd_*")
    try:
        table = pandas.read_csv(path) if path.suffix.lower() == ".csv" else pandas.read_parquet(path)
        wanted = ("t", *COMMANDS)
        missing = [name for name in wanted if name not in table.columns]
        if missing:
            found = ", ".join(map(str, table.columns[:10]))
            hint = "; separated by ';'? expected ','" if ";" in found else ""
            raise InputError(f"{path}: column '{missing[0]}' is missing{hint}; found: {found}")
        columns = table[list(wanted)].to_numpy(np.float64)
    except (OSError, UnicodeDecodeError, TypeError, ValueError) as error:
        raise error if isinstance(error, InputError) else InputError(f"{path}: cannot be read: {error}") from None
    t, setpoints = columns[:, 0], columns[:, 1:]
    if len(t) < 2 or not (np.isfinite(t).all() and (np.diff(t) > 0.0).all()):
        raise InputError(f"{path}: column 't': expected two rows or more, finite and increasing")
    if (beyond := np.abs(np.nan_to_num(setpoints)) > _LARGEST).any() or np.isinf(setpoints).any():
        row, joint = map(int, np.argwhere(beyond | np.isinf(setpoints))[0])
        unit, other = ("rad", "degrees") if joint < len(LEGS) else ("rad/s", "degrees/s or rpm")
        place = f"{row_words(path, row)}, column 'cmd_{JOINTS[joint]}': {setpoints[row, joint]:g}"
        most = _LARGEST[joint]
        raise InputError(f"{path}: {place}: expected {-most:.3g} to {most:.3g} {unit}; in {other}?")
    return Motion(path.stem, setpoints[_held_rows(t - t[0])], CONTROL_PERIOD, read_meta(path.parent).profile)


def _held_rows(t: Array) -> NDArray[np.intp]:
    """Return the row that holds in the middle of each control step; rows (R,) are at ``t``, from 0 on, s."""
    ticks = round(t[-1] / CONTROL_PERIOD) + 1
    return np.searchsorted(t, CONTROL_PERIOD * (np.arange(ticks) + 0.5), side="right") - 1


def motion_of(run: Run) -> Motion:
    """Return the commands of a measured run at the control rate, each row's from its time on; NaN = torque off."""
    commanded = np.stack([np.isfinite(run[f"cmd_{joint}"]) for joint in JOINTS], axis=1)
    setpoints = np.where(commanded, held_setpoints(run), np.nan)[_held_rows(run["t"] - run["t"][0])]
    return Motion(run.name, setpoints, CONTROL_PERIOD, run.meta.profile)


# ---- runs ------------------------------------------------------------------------------------------------------------


def record_simulation(
    path: Path,
    motion: Motion,
    robot: Robot,
    backend: str,
    seed: int = 0,
    patch: Patch | None = None,
    meta: RunMeta | None = None,
) -> Path:
    """Drive a simulator through a motion and write the run, its ``meta.yaml`` and the record that repeats it bit for bit.

    The robot stands at the first setpoints until it has settled; a leg without one stands at home.

    Args:
        path: of the run.
        motion: setpoints; NaN = torque off.
        robot: what is driven.
        backend: one of :data:`wlr_gym.physics.plants.SIMULATORS`.
        seed: of the sensors' noise.
        patch: effects that are added.
        meta: for ``meta.yaml``; its profile is the motion's. The robot drives on its floor, drawn by ``seed``.

    Raises:
        InputError: unknown backend or floor, a seed that is out of range, or a folder whose ``meta.yaml`` says something else.
    """
    check_simulator(backend)
    require_seed("seed =", seed, LARGEST_NOISE_SEED)
    patch = patch or load_patch(None)
    floor = floor_of_meta(meta or RunMeta(), path.parent, robot)
    parameters = profile_parameters(Parameters.nominal(robot), motion.profile)
    parameters = apply_patch(patch, lay_floor(floor.drawn(seed), parameters))
    options, seeds = PlantOptions(control_period=motion.period), np.array([seed], np.uint64)
    torque_on = np.isfinite(motion.setpoints)
    columns, stand = sensed_columns(robot), motion.start(robot)[None]
    rows = np.empty((len(motion.setpoints), len(columns)))
    with closing(make_plant(backend, robot, 1, options, patch.forces)) as plant:
        plant.reset(seeds, parameters, state=standing_at(stand, robot, parameters))
        for _ in range(round(SETTLE / motion.period)):
            plant.step(stand, torque_on[:1])
        start = replace(plant.mechanical_state(), time=np.zeros(1))  # the run begins here
        sensors = plant.reset(seeds, parameters, state=start)
        for tick, setpoints in enumerate(motion.setpoints):
            rows[tick] = channels(sensors, 0, columns)
            on = torque_on[tick : tick + 1]
            sensors = plant.step(np.nan_to_num(setpoints)[None], None if on.all() else on)
    record = Simulation(
        backend=backend,
        **{name: getattr(options, name) for name in ("control_period", "physics_step", "precision", "sensor_noise")},
        seed=seed,
        parameters=departures(parameters.values[0], Parameters.nominal(robot).values[0]),
        formulas=[effect.content() for effect in patch.effects if effect.name not in EFFECTS],
        start=start_of(start, 0),
    )
    table = {"t": motion.period * np.arange(len(rows)), **dict(zip(COMMANDS, motion.setpoints.T, strict=True))}
    table |= dict(zip(columns, rows.T, strict=True))
    return write_run(path, table, meta_of(motion, robot, meta), record, robot)


def meta_of(motion: Motion, robot: Robot, meta: RunMeta | None = None) -> RunMeta:
    """Return the meta data of runs of a motion: robot and servo profile filled in."""
    given = meta or RunMeta()
    return given.model_copy(update={"robot": given.robot or robot.name, "profile": motion.profile})


def same_profile(motions: Sequence[Motion]) -> Profile:
    """Return the servo profile of all motions; different ones are refused: runs of one folder share ``meta.yaml``."""
    for motion in motions:
        if motion.profile != motions[0].profile:
            names = f"{motions[0].name} and {motion.name}"
            raise InputError(f"{names} are driven with different servo profiles: record them into different folders")
    return motions[0].profile
