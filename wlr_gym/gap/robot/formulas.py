"""Forces that no effect of the library describes: short formulas on single coordinates, tried beside the named effects.

Each is a sum of terms with one constant per term, so that it vanishes with its constants and its response is linear in them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.format import CHANNELS
from wlr_gym.gap.problem import Candidate, Probe, Start, Unknown
from wlr_gym.physics.effects import UNKNOWN_EFFECT, PatchEffect
from wlr_gym.robot import CORNERS, LEGS, WHEELS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Term:
    """One constant of a formula: its name, unit, the size it is probed with, and its plausible range (either sign)."""

    name: str
    unit: str
    probe: float
    bound: float


@dataclass(frozen=True)
class Law:
    """A formula and where it may act.

    Attributes:
        formula, where: as a formula effect has them.
        terms: its constants that are fitted, each linear in the force.
        fixed: name, unit and value of constants that are not.
    """

    formula: str
    terms: tuple[Term, ...]
    where: tuple[str, ...]
    fixed: tuple[tuple[str, str, float], ...] = ()


def _other(name: str) -> str:
    """The same joint on the other side."""
    return name[:-2] + {"l": "r", "r": "l"}[name[-2]] + name[-1]


def _coupled(kind: tuple[str, ...]) -> tuple[tuple[str, ...], ...]:
    """Places of a coupling between the two sides: a joint, or both of an axle."""
    return (*((one,) for one in kind), kind[:2], kind[2:])


def _driven(torque: str, places: tuple[str, ...], bound: float, slope: float) -> Law:
    """Dry friction that grows with the torque of another motor than the joint's own; full from a rate of about 2 / slope.

    An explicit force must be soft: bound x torque x slope x step / inertia below 2. Wheels have 3e-4 kg m2 and up to 0.1 N m,
    their legs up to 1.3.
    """
    return Law(f"-r * abs({torque}) * tanh(s * rate)", (Term("r", "-", 0.1 * bound, bound),), places, (("s", "s/rad", slope),))


_LAWS: tuple[Law, ...] = (
    *(Law("c - k * angle", (Term("c", "N m", 0.1, 3.0), Term("k", "N m/rad", 0.2, 5.0)), (leg,)) for leg in LEGS),
    *(Law("c - f * wind_up", (Term("c", "N m", 0.1, 3.0), Term("f", "N m", 0.1, 2.0)), (leg,)) for leg in LEGS),
    *(Law("a * cos(angle) + b * sin(angle)", (Term("a", "N m", 0.1, 3.0), Term("b", "N m", 0.1, 3.0)), (leg,)) for leg in LEGS),
    *(Law("-d * rate * abs(rate)", (Term("d", "N m s2/rad2", 0.1, 3.0),), (leg,)) for leg in LEGS),
    *(Law("c", (Term("c", "N m", 0.02, 0.5),), (wheel,)) for wheel in WHEELS),
    *(Law("-d * rate * abs(rate)", (Term("d", "N m s2/rad2", 0.002, 0.1),), (wheel,)) for wheel in WHEELS),
    *(Law(f"-k * leg_rate_{_other(leg)[4:]}", (Term("k", "N m s/rad", 0.05, 3.0),), (leg,)) for leg in LEGS),
    *(Law(f"-k * wheel_rate_{_other(wheel)[6:]}", (Term("k", "N m s/rad", 0.004, 0.2),), (wheel,)) for wheel in WHEELS),
    *(_driven("leg_torque_opposite", places, 1.0, 20.0) for places in _coupled(LEGS)),
    *(_driven("wheel_torque_opposite", places, 0.8, 6.0) for places in _coupled(WHEELS)),
    *(_driven("wheel_torque", (leg,), 1.0, 20.0) for leg in LEGS),
    *(_driven("leg_torque", (wheel,), 0.2, 2.0) for wheel in WHEELS),
    *(
        Law(
            f"a * sin(wheel_angle_{corner}) + b * cos(wheel_angle_{corner})",
            (Term("a", "N m", 0.3, 20.0), Term("b", "N m", 0.3, 20.0)),
            (f"body_torque_{axis}",),
        )
        for corner in CORNERS
        for axis in ("roll", "pitch")
    ),
    Law("-d * velocity_x", (Term("d", "N s/m", 2.0, 50.0),), ("body_force_x",)),
    Law("-d * velocity_x * abs(velocity_x)", (Term("d", "N s2/m2", 10.0, 200.0),), ("body_force_x",)),
    Law("-d * yaw_rate", (Term("d", "N s/rad", 0.5, 20.0),), ("body_force_x",)),
    Law("-d * velocity_y", (Term("d", "N s/m", 4.0, 100.0),), ("body_force_y",)),
    Law("-d * velocity_x", (Term("d", "N s/m", 2.0, 50.0),), ("body_force_y",)),
    Law("-d * yaw_rate", (Term("d", "N s/rad", 0.5, 20.0),), ("body_force_y",)),
    Law("-d * yaw_rate", (Term("d", "N m s/rad", 0.2, 5.0),), ("body_torque_yaw",)),
    Law("-d * yaw_rate * abs(yaw_rate)", (Term("d", "N m s2/rad2", 0.4, 10.0),), ("body_torque_yaw",)),
    Law("-d * velocity_x", (Term("d", "N s", 0.4, 10.0),), ("body_torque_yaw",)),
    Law("-d * velocity_y", (Term("d", "N s", 0.8, 20.0),), ("body_torque_yaw",)),
)


def _wave(place: str, unit: str, size: float, bound: float) -> Law:
    """A push or twist that comes and goes with time."""
    return Law("a * sin(w * time) + b * cos(w * time)", (Term("a", unit, size, bound), Term("b", unit, size, bound)), (place,))


_WAVES = (
    _wave("floor_force_x", "N", 0.5, 20.0),
    _wave("floor_force_y", "N", 0.5, 20.0),
    _wave("body_torque_yaw", "N m", 0.05, 2.0),
)
#: Hz; where a wave is looked for.
WAVE_FREQUENCIES = np.arange(0.2, 5.0, 0.01)
#: Hz; the neighbourhood it must stand out of.
NEIGHBOURHOOD = 0.5
#: Channels that a push or a twist of the body moves.
_SHAKEN = [
    CHANNELS.index(name)
    for name in CHANNELS
    if name.startswith(("eff_wheel", "vel_wheel", "gyro_z", "acc_x", "acc_y", "cam_x", "cam_y", "cam_yaw"))
]


def formula_candidates(times: Sequence[Array] = (), residuals: Sequence[Array] = ()) -> tuple[list[Probe], list[Candidate]]:
    """Return probes and candidates of all formulas.

    Args:
        times: (rows,) per run, s since its first row; none = no formula of time.
        residuals: (rows, channels) per run, of the model without them: what frequency a wave in time has.
    """
    offered = [_offered(law) for law in _LAWS]
    if times:
        rate = 2.0 * np.pi * wave_frequency(times, residuals)
        beat = Unknown("w", "rad/s", rate, rate - 0.4, rate + 0.4, 0.02, is_size=False)
        offered += [_offered(law, (beat,)) for law in _WAVES]
    return [probe for probes, _ in offered for probe in probes], [candidate for _, candidate in offered]


def _offered(law: Law, shape: tuple[Unknown, ...] = ()) -> tuple[list[Probe], Candidate]:
    """A law's probes and candidate; ``shape``: unknowns in which it is not linear, probed where they begin."""
    units = {term.name: term.unit for term in law.terms} | {name: unit for name, unit, _ in law.fixed}
    units |= {unknown.name: unknown.unit for unknown in shape}
    fixed = {name: value for name, _, value in law.fixed}
    begin = {unknown.name: unknown.neutral for unknown in shape}
    probes = []
    for term in law.terms:
        values = {other.name: term.probe * (other is term) for other in law.terms}
        effect = PatchEffect(UNKNOWN_EFFECT, law.where, values | fixed | begin, law.formula, units)
        probes.append(Probe(" ".join([UNKNOWN_EFFECT, *law.where, law.formula, term.name]), (effect,)))
    sizes = tuple(Unknown(t.name, t.unit, 0.0, -t.bound, t.bound, 0.5 * t.probe) for t in law.terms)
    start = Start(tuple((probe.key,) for probe in probes), _values([term.probe for term in law.terms], tuple(begin.values())))
    return probes, Candidate(UNKNOWN_EFFECT, law.where, (*sizes, *shape), (start,), law.formula, units, fixed)


@cache
def tried_effects() -> tuple[PatchEffect, ...]:
    """Return one effect of every formula that is tried, waves included."""
    nowhere = np.zeros((0, len(CHANNELS)))
    _, candidates = formula_candidates([np.zeros(0)], [nowhere])
    return tuple(candidate.effect([unknown.neutral for unknown in candidate.unknowns]) for candidate in candidates)


def wave_frequency(times: Sequence[Array], residuals: Sequence[Array]) -> float:
    """Return the frequency (Hz) that stands out most in what is left, at the same phase since the start of every run.

    Of the power over the median of its neighbourhood: what a model lacks is largest at low frequencies anyway.
    """
    totals, rows = np.zeros((len(_SHAKEN), len(WAVE_FREQUENCIES)), complex), np.zeros(len(_SHAKEN))
    for t, residual in zip(times, residuals, strict=True):
        turn = np.exp(-2j * np.pi * np.outer(WAVE_FREQUENCIES, t))
        for k, c in enumerate(_SHAKEN):
            known = np.isfinite(residual[:, c])
            if known.any():
                totals[k] += turn[:, known] @ (residual[known, c] - residual[known, c].mean())
                rows[k] += known.sum()
    power = (np.abs(totals) ** 2 / np.maximum(rows, 1)[:, None]).sum(axis=0)
    near = round(NEIGHBOURHOOD / (WAVE_FREQUENCIES[1] - WAVE_FREQUENCIES[0]))
    background = [np.median(power[max(k - near, 0) : k + near + 1]) for k in range(len(power))]
    return float(WAVE_FREQUENCIES[int(np.argmax(power / np.maximum(background, 1e-12)))])


def _values(sizes: Sequence[float], begin: tuple[float, ...]) -> Callable[[Array], tuple[float, ...]]:
    return lambda amplitude: (*(float(size * a) for size, a in zip(sizes, amplitude, strict=True)), *begin)
