"""A small analytic system: sums of known shapes, with numbers to calibrate, effects to find, and coloured noise.

Everything is in noise units and one tolerance of a quantity moves its shape by ``STRENGTH``. Responses are linear in quantities
and in most effects; ``play`` starts with its square, ``ripple`` has an amplitude and a phase.
"""

from functools import cache
from typing import Any

import numpy as np

from wlr_gym.gap.problem import Candidate, MeasuredSignal, Probe, Problem, Quantity, Start, Unknown
from wlr_gym.physics.effects import PatchEffect

NOISE = np.array([0.1, 2.0, 0.001])
CHANNELS = ("speed", "torque", "place")
QUANTITIES = ("gain", "offset", "mass")
DECOYS = tuple(f"decoy_{k}" for k in range(5))
#: Response, in noise units, to one tolerance of a quantity.
STRENGTH = 1.0
#: Tolerances that calibration may move a number.
REACH = 2.5
SIGMA = np.array([0.05, 2.0, 0.3])
NOMINAL = np.array([1.0, 0.0, 7.0])
#: Plausible range of the effects' values.
RANGES = {"weak": (0.0, 0.5), "play": (0.0, 3.0), "copy": (-20.0, 20.0)}


@cache
def shapes(name, runs, rows):
    """Smooth random shape (runs, rows, channels) of unit mean square, the same for the same name."""
    rng = np.random.default_rng([ord(letter) for letter in name])
    t = np.arange(rows)[None, :, None, None]
    frequency, phase = (
        rng.uniform(0.01, 0.2, (2, runs, 1, len(CHANNELS), 6)) * np.array([1.0, 100.0])[:, None, None, None, None]
    )
    waves = np.sin(frequency * t + phase).sum(axis=-1) * rng.uniform(0.3, 1.0, (1, 1, len(CHANNELS)))
    waves /= np.sqrt(np.mean(waves**2))
    waves.setflags(write=False)
    return waves


def coloured(rng, shape, ar1):
    """AR(1) noise of unit variance along the first axis."""
    white = rng.standard_normal(shape)
    series = white.copy()
    for k in range(1, len(series)):
        series[k] = ar1 * series[k - 1] + np.sqrt(1.0 - ar1**2) * white[k]
    return series


class Toy(Problem):
    """A :class:`wlr_gym.gap.problem.Problem` that costs microseconds.

    Args:
        truth: quantities' distance from nominal in tolerances, by name.
        effects: PatchEffects that the measurements hold.
        seed: of the noise.
        white, error: size of white noise and of the simulator's coloured error, in noise units.
        ar1: of that error, correlation of neighbouring rows.
    """

    metric, cap, steps = "RMS in noise units", 50.0, 4

    def __init__(self, truth=None, effects=(), seed=0, *, runs=5, rows=200, white=1.0, error=0.0, ar1=0.9, reach=REACH):
        self.runs = tuple(f"run_{k + 1}" for k in range(runs))
        self.rows, self.calls = rows, 0
        self.signals = tuple(MeasuredSignal(c, "1", n, "all") for c, n in zip(CHANNELS, NOISE, strict=True))
        self.quantities = tuple(
            Quantity(name, "1", n, s, n - reach * s, n + reach * s)
            for name, n, s in zip(QUANTITIES, NOMINAL, SIGMA, strict=True)
        )
        moved = NOMINAL + SIGMA * np.array([(truth or {}).get(name, 0.0) for name in QUANTITIES])
        rng = np.random.default_rng([seed, 7])
        self._measured = []
        for r in range(runs):
            clean = self._response(moved, tuple(effects), r)
            noise = white * rng.standard_normal(clean.shape) + error * coloured(rng, clean.shape, ar1)
            self._measured.append((clean + noise) * NOISE)

    def shape(self, name):
        return shapes(name, len(self.runs), self.rows)

    def _response(self, quantities, effects, run):
        scaled = (quantities - NOMINAL) / SIGMA
        for effect in effects:
            if effect.name == "level":  # takes the place of a quantity
                scaled = np.array([effect.parameters["size"], *scaled[1:]])
        total = self.shape("base")[run].copy()
        for name, amount in zip(QUANTITIES, scaled, strict=True):
            total += STRENGTH * amount * self.shape(name)[run]
        for effect in effects:
            total += self.effect_response(effect, run)
        return total

    def effect_response(self, effect, run):
        """Response (rows, channels) in noise units."""
        values = effect.parameters
        if effect.name == "level":
            return 0.0
        if effect.name == "copy":  # the same as the quantity, without its tolerance
            return STRENGTH * values["size"] * self.shape("gain")[run]
        if effect.name == "twin":
            return 2.0 * values["size"] * self.shape("drag left")[run]
        if effect.name == "play":
            return values["size"] ** 2 * self.shape("play")[run]
        if effect.name == "ripple":
            sine, cosine = self.shape("ripple sine")[run], self.shape("ripple cosine")[run]
            return values["amplitude"] * (np.cos(values["phase"]) * sine + np.sin(values["phase"]) * cosine)
        return sum(values["size"] * self.shape(f"{effect.name} {place}")[run] for place in effect.where)

    def times(self, run) -> Any:
        return 0.02 * np.arange(self.rows)

    def measured(self, run):
        return self._measured[run]

    def simulate(self, settings, runs):
        self.calls += len(settings)
        return [np.stack([self._response(s.quantities, s.effects, r) for s in settings]) * NOISE for r in runs]

    def residuals(self, settings, runs):
        return [(self._measured[r] - made) / NOISE for r, made in zip(runs, self.simulate(settings, runs), strict=True)]

    def remade(self, setting, runs, count) -> Any:
        for k in range(count):
            rng = np.random.default_rng([k, 11])
            yield [rng.standard_normal((self.rows, len(CHANNELS))) for _ in runs]

    def reach(self, effect, setting, runs) -> Any:
        return {}

    def features(self, setting, runs) -> Any:
        return [{"shape of drag": self.shape("drag left")[r][:, 0], "time": self.times(r)} for r in runs]

    def candidates(self, setting: Any, residuals: Any, runs: Any):
        lists = [self._drag(), self._single("twin"), self._single("weak", 0.2), self._play(), self._ripple(), self._copy()]
        lists += [self._single(name) for name in DECOYS]
        return [p for probes, _ in lists for p in probes], [c for _, candidates in lists for c in candidates]

    def _drag(self):
        probes = [Probe(f"drag {place}", (sized("drag", 0.5, place),)) for place in ("left", "right")]
        sets = (("left",), ("right",), ("left", "right"))
        candidates = [
            Candidate("drag", places, (unknown("drag"),), (Start((tuple(f"drag {p}" for p in places),), half),))
            for places in sets
        ]
        return probes, candidates

    def _single(self, name, size=0.5):
        start = Start(((name,),), lambda a: (size * float(a[0]),))
        return [Probe(name, (sized(name, size),))], [Candidate(name, ("body",), (unknown(name),), (start,))]

    def _play(self):
        start = Start((("play",),), lambda a: (0.5 * float(np.sqrt(max(a[0], 0.0))),))
        return [Probe("play", (sized("play", 0.5),))], [Candidate("play", ("body",), (unknown("play"),), (start,))]

    def _ripple(self):
        phases = {"ripple 0": 0.0, "ripple 1": np.pi / 2}
        probes = [Probe(key, (PatchEffect("ripple", ("body",), {"amplitude": 0.5, "phase": p}),)) for key, p in phases.items()]
        numbers = (Unknown("amplitude", "1", 0.0, 0.0, 10.0, 0.1), Unknown("phase", "rad", 0.0, -3.2, 3.2, 0.1))
        start = Start((("ripple 0",), ("ripple 1",)), polar)
        return probes, [Candidate("ripple", ("body",), numbers, (start,))]

    def _copy(self):
        start = Start((("gain",),), lambda a: (float(a[0]),))
        return [], [Candidate("copy", ("body",), (unknown("copy"),), (start,))]


def unknown(name):
    low, high = RANGES.get(name, (-10.0, 10.0))
    return Unknown("size", "1", 0.0, low, high, 0.05 * (high - low))


def half(amplitude):
    return (0.5 * float(amplitude[0]),)


def polar(amplitude):
    return 0.5 * float(np.hypot(*amplitude)), float(np.arctan2(amplitude[1], amplitude[0]))


def sized(name, size, *where):
    """The effect ``name`` of one size."""
    return PatchEffect(name, where or ("body",), {"size": size})


def candidate(problem, name, where=None):
    """One of the problem's candidates."""
    _, found = problem.candidates(None, [], [])
    return next(c for c in found if c.name == name and (where is None or c.where == tuple(where)))
