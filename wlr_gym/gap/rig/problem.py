"""Recordings of the test rig as a :class:`wlr_gym.gap.problem.Problem`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.random import generator
from wlr_gym.gap.problem import Candidate, MeasuredSignal, Probe, Quantity, Range, Setting, since_reversal
from wlr_gym.gap.rig.candidates import rig_candidates
from wlr_gym.gap.rig.formula import lanes_read, rig_force
from wlr_gym.gap.rig.kernel import OUTPUTS
from wlr_gym.gap.rig.model import QUANTITIES, model_of
from wlr_gym.gap.rig.recording import Recording
from wlr_gym.gap.rig.replay import Replay
from wlr_gym.gap.validation.data_split import HELD_OUT_SHARE
from wlr_gym.physics.effects.effect import PatchEffect

Array = NDArray[np.float64]

#: One sigma of the encoder, rad: one of 4096 counts per turn, for rounding and for what a magnetic encoder adds to it.
ENCODER_NOISE = 2 * math.pi / 4096
#: Noise units that every residual of a simulation that broke down counts: more than two turns.
LOST = 1e4
#: Signal -> s of free simulation before it starts again from the measured state; None = the whole run.
HORIZONS: Mapping[str, float | None] = {"position": None, "position_within_0.2s": 0.2}
_ANGLE = OUTPUTS.index("angle")


def with_lost(found: Array, measured: Array, simulated: Array) -> Array:
    """Return residuals (S, T, C) in which a setting whose simulation broke down is as far from the data as can be."""
    lost = ~np.isfinite(simulated).all(axis=(1, 2))
    found[lost] = np.where(np.isfinite(measured), LOST, np.nan)
    return found


class RigProblem:
    """Recordings of one servo with a pendulum, and a simulator of it; see :class:`wlr_gym.gap.problem.Problem`.

    Args:
        recordings: of one servo.
        known: effects that are in the model from the start.
        friction_is_known: dry and viscous friction are numbers of the model. Otherwise it has none, and they are candidates.

    Attributes:
        held_out: names of the runs to hold out where the user names none.
    """

    metric = "RMS over whole runs and over windows of 0.2 s of measured-minus-replayed angle, in units of sensor noise"
    #: A servo that sticks elsewhere is off by hundreds of counts, and that is the gap.
    cap = LOST
    steps = 20
    #: A replay costs milliseconds, and a joint that sticks answers far from linearly: every hypothesis is worth a whole fit.
    threads, thorough, tempering, disagreement, misfit = 1, True, 1.0, 0.0, math.inf
    turning: Mapping[str, tuple[str, tuple[str, ...]]] = MappingProxyType({})
    motions: Mapping[str, str] = MappingProxyType({})

    def __init__(
        self, recordings: Sequence[Recording], known: Sequence[PatchEffect] = (), friction_is_known: bool = True
    ) -> None:
        if not recordings:
            raise InputError("no recordings to analyse")
        self.recordings: tuple[Recording, ...] = tuple(recordings)
        self.known: tuple[PatchEffect, ...] = tuple(known)
        self.runs: tuple[str, ...] = tuple(recording.name for recording in recordings)
        self.signals: tuple[MeasuredSignal, ...] = tuple(
            MeasuredSignal(name, "rad", ENCODER_NOISE, "position") for name in HORIZONS
        )
        self.quantities: tuple[Quantity, ...] = tuple(
            quantity for quantity in QUANTITIES if friction_is_known or not quantity.name.endswith("friction")
        )
        self.held_out: tuple[str, ...] = spread_over_conditions(self.recordings)
        self._replays = [Replay(recording) for recording in recordings]

    def times(self, run: int) -> Array:
        """Return the times (rows,) of a run, s."""
        return self.recordings[run].time

    def measured(self, run: int) -> Array:
        """Return the measured angle (rows, signals), rad: the same for every horizon."""
        return np.repeat(self.recordings[run].angle[:, None], len(self.signals), axis=1)

    def simulate(self, settings: Sequence[Setting], runs: Sequence[int]) -> list[Array]:
        """Return what the encoder would have read: (settings, rows, signals) per run, rad."""
        models = [model_of(setting, self.quantities, self.known) for setting in settings]
        zero = np.array([model.numbers["zero"] for model in models])[:, None]
        found = []
        for run in runs:
            replay = self._replays[run]
            found.append(
                np.stack([replay.simulate(models, horizon)[:, :, _ANGLE] + zero for horizon in HORIZONS.values()], axis=2)
            )
        return found

    def remade(self, setting: Setting, runs: Sequence[int], count: int) -> Iterator[list[Array]]:
        """Replay recordings that a model itself would have made; see :meth:`wlr_gym.gap.problem.Problem.remade`.

        They are rounded to counts, and differ by where within a count the servo's zero lies.
        """
        clean = [angles[0, :, 0] for angles in self.simulate([setting], runs)]
        for shift in (0.0, *generator(0, "gap", "zero of the encoder").uniform(-0.5, 0.5, count - 1)):
            made = [
                replace(self.recordings[run], angle=(np.round(angle / ENCODER_NOISE + shift) - shift) * ENCODER_NOISE)
                for run, angle in zip(runs, clean, strict=True)
            ]
            twin = RigProblem(made, self.known, len(self.quantities) == len(QUANTITIES))
            yield [residual[0] for residual in twin.residuals([setting], range(len(made)))]

    def residuals(self, settings: Sequence[Setting], runs: Sequence[int]) -> list[Array]:
        """Replay runs under every setting; see :meth:`wlr_gym.gap.problem.Problem.residuals`."""
        return [self._residuals(run, angles) for run, angles in zip(runs, self.simulate(settings, runs), strict=True)]

    def _residuals(self, run: int, simulated: Array) -> Array:
        """Of one run; a setting whose simulation broke down is as far from the data as can be."""
        measured = self.measured(run)
        return with_lost((measured - simulated) / ENCODER_NOISE, measured, simulated)

    def candidates(
        self, setting: Setting, residuals: Sequence[Array], runs: Sequence[int]
    ) -> tuple[list[Probe], list[Candidate]]:
        """Return the effects to try beyond ``setting``, and the probes of their first guesses."""
        present = {effect.name for effect in (*self.known, *setting.effects)}
        present |= {quantity.name for quantity in self.quantities}
        return rig_candidates(present)

    def reach(self, effect: PatchEffect, setting: Setting, runs: Sequence[int]) -> Mapping[str, Range]:
        """Return over which range of each feature a formula was tried; see :meth:`wlr_gym.gap.problem.Problem.reach`."""
        model = model_of(setting, self.quantities, self.known)
        values = np.concatenate([self._replays[run].simulate([model])[0] for run in runs])
        columns = dict(zip(OUTPUTS, values.T, strict=True))
        read = lanes_read(rig_force(effect), {**columns, "supply": columns["voltage"]}).items()
        return {name: Range(float(np.nanmin(found)), float(np.nanmax(found)), unit) for name, (unit, found) in read}

    def features(self, setting: Setting, runs: Sequence[int]) -> list[Mapping[str, Array]]:
        """Return what residuals are mapped over, (rows,) each, units in the names."""
        model = model_of(setting, self.quantities, self.known)
        found: list[Mapping[str, Array]] = []
        for run in runs:
            recording, replay = self.recordings[run], self._replays[run]
            values = replay.simulate([model])[0]
            columns = {name: values[:, k] for k, name in enumerate(OUTPUTS)}
            found.append(
                {
                    "angle [rad]": columns["angle"],
                    "rate [rad/s]": columns["rate"],
                    "motor torque [N m]": columns["motor_torque"],
                    "voltage [V]": columns["voltage"],
                    "time since reversal [s]": since_reversal(recording.time, columns["rate"]),
                    "time [s]": recording.time,
                    "supply [V]": recording.supply,
                    "temperature [deg C]": recording.temperature,
                    "P gain [register]": np.full(len(recording.time), recording.gain),
                }
            )
        return found


def spread_over_conditions(recordings: Sequence[Recording], share: float = HELD_OUT_SHARE) -> tuple[str, ...]:
    """Return the names of runs to hold out: in turn one of every gain, each of the trajectory that is held out least so far."""
    gains = sorted({recording.gain for recording in recordings})
    chosen: list[Recording] = []
    for turn in range(math.ceil(share * len(recordings))):
        left = [recording for recording in recordings if recording not in chosen]
        left = [recording for recording in left if recording.gain == gains[turn % len(gains)]] or left
        held = [recording.trajectory for recording in chosen]
        chosen.append(min(left, key=lambda recording: held.count(recording.trajectory)))
    return tuple(recording.name for recording in recordings if recording in chosen)
