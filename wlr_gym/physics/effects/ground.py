"""Effects of the floor, and of the wheels on it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.physics.effects.effect import Effect, EffectParameter, Values, add, add_vector, multiply, put
from wlr_gym.physics.effects.search import (
    WHEEL_SETS,
    Change,
    Coordinate,
    Coordinates,
    Guess,
    Known,
    Observed,
    Places,
    Search,
    steps,
)
from wlr_gym.robot import WHEELS
from wlr_gym.robot.parameter_table import PATCHES, SPECS
from wlr_gym.robot.parameters import Parameters

#: Plausible coefficients of a floor.
PLAUSIBLE_MU = (0.05, 1.5)
#: m; farther than any robot drives: an area whose y bounds are left out has none.
UNBOUNDED = SPECS["patch.y_max"].high


def _set_friction(parameters: Parameters, where: Sequence[str], values: Values) -> None:
    for wheel in WHEELS if "ground" in where else where:
        parameters[f"ground.mu_x[{wheel}]"] = values["mu"]
        parameters[f"ground.mu_y[{wheel}]"] = values["mu"]


def _set_anisotropy(parameters: Parameters, where: Sequence[str], values: Values) -> None:
    parameters["ground.mu_y"] = values["ratio"] * parameters["ground.mu_x"]


def _set_weakening(parameters: Parameters, where: Sequence[str], values: Values) -> None:
    """Friction only falls: a floor that grips less than mu_k at rest, as randomisation may draw, stays as it is."""
    mu_k = values["mu_k"]
    highest = np.maximum(parameters["ground.mu_x"], mu_k)
    parameters["ground.kinetic_ratio"] = mu_k / np.where(highest > 0.0, highest, 1.0)
    parameters["ground.weakening_speed"] = values["slip_speed"]


def _lay_patch(parameters: Parameters, where: Sequence[str], values: Values) -> None:
    """Take each robot's first empty area; one of no size is none."""
    for axis in "xy":
        if values[f"{axis}_min"] > values[f"{axis}_max"]:
            low, high = values[f"{axis}_min"], values[f"{axis}_max"]
            raise InputError(f"{axis}_min = {low:g} m is above {axis}_max = {high:g} m")
    if values["x_min"] == values["x_max"] or values["y_min"] == values["y_max"]:
        return
    empty = (parameters["patch.x_max"] <= parameters["patch.x_min"]) | (parameters["patch.y_max"] <= parameters["patch.y_min"])
    if not empty.any(axis=1).all():
        robot = int(np.argmin(empty.any(axis=1)))
        raise InputError(f"the floor holds {len(PATCHES)} patches, and all are taken (robot {robot} of the batch)")
    rows, slots = np.arange(len(parameters)), np.argmax(empty, axis=1)
    for name, value in values.items():
        parameters[f"patch.{name}"][rows, slots] = value


def _mu(severity: float, doc: str) -> EffectParameter:
    return EffectParameter("-", doc, 0, 5, "ground.mu_x", PLAUSIBLE_MU, severity)


def _edge(doc: str, neutral: float, severity: float, *, optional: bool = False) -> EffectParameter:
    return EffectParameter("m", doc, -UNBOUNDED, UNBOUNDED, neutral, (-5, 5), severity, optional, is_size=False)


#: m; width of the strips of floor in which another friction is looked for.
STRIP = 0.15
#: Most strips; a longer floor gets wider ones.
MOST_STRIPS = 24
#: Most neighbouring strips of one area.
WIDEST_AREA = 12
#: m; an area that is looked for may lie so far beyond the floor that was reached.
BEYOND = 10.0
#: By how much more than others a patch must improve a fit: what a bumpy floor does goes with place too. On floors of 0.045 to
#: 0.14 mm rms without a patch one gained up to 52 (fall of minus two log posterior); true ones of severity 1 and more, 288 on.
BUMPY_FLOOR = 80.0
#: Across, an area that is looked for has no end.
ACROSS = {"y_min": -UNBOUNDED, "y_max": UNBOUNDED}

GROUND = (("ground",),)
#: Relations that several effects change.
FLOOR = "friction of the floor"
CONTACT = "contact of the {}"
BODY_FORCE = "force on the body"


def _asymmetry_guesses(where: Places, observed: Observed) -> list[Guess]:
    mu = observed.mean("ground.mu_x")
    less = -0.25 * mu
    return [Guess(((Change({"mu": mu + less}),),), lambda a: (mu + less * float(a[0]),))]


def _weakening_guesses(where: Places, observed: Observed) -> list[Guess]:
    return [_weakening(observed.mean("ground.mu_x"), speed) for speed in (0.05, 0.3)]


def _weakening(mu: float, speed: float) -> Guess:
    change = Change({"mu_k": 0.8 * mu, "slip_speed": speed})
    return Guess(((change,),), lambda a: (mu * (1 - 0.2 * float(a[0])), speed))


def _reached(observed: Observed) -> tuple[float, float] | None:
    """Least and greatest x, m, of the floor in which an area can lie; None = the robot has hardly moved."""
    if observed.travel[1] - observed.travel[0] < STRIP:
        return None
    return observed.travel[0] - 0.2, observed.travel[1] + 0.2


def _patch_guesses(where: Places, observed: Observed) -> list[Guess]:
    """Strips of floor across x: an area starts as the best run of neighbouring strips."""
    reached = _reached(observed)
    if reached is None:
        return []
    low, high = reached
    edges = np.linspace(low, high, min(MOST_STRIPS, math.ceil((high - low) / STRIP)) + 1)
    mu = observed.mean("ground.mu_x")
    less = -0.25 * mu
    strips = [Change({"mu": mu + less, "x_min": a, "x_max": b, **ACROSS}) for a, b in itertools.pairwise(edges)]
    return [
        _area(tuple(strips[first:last]), float(edges[first]), float(edges[last]), mu, less)
        for first in range(len(strips))
        for last in range(first + 1, min(len(strips), first + WIDEST_AREA) + 1)
    ]


def _area(strips: tuple[Change, ...], low: float, high: float, mu: float, less: float) -> Guess:
    middle, width = 0.5 * (low + high), high - low
    return Guess((strips,), lambda a: (mu + less * float(a[0]), middle, width))


def _patch_coordinates(where: Places, observed: Observed) -> Coordinates:
    """Coefficient, middle and width, in place of coefficient and edges."""
    reached, mu = _reached(observed), observed.mean("ground.mu_x")
    assert reached is not None  # there are guesses
    low, high = reached
    coordinates = {
        "mu": Coordinate("-", mu, *PLAUSIBLE_MU, 0.05 * (PLAUSIBLE_MU[1] - PLAUSIBLE_MU[0])),
        "x_middle": Coordinate("m", 0.0, low - BEYOND, high + BEYOND, 0.02, is_size=False),
        "x_width": Coordinate("m", 0.0, 0.02, high - low + BEYOND, 0.02, is_size=False),
    }
    return Coordinates(coordinates, _edges, ACROSS)


def _edges(values: Sequence[float]) -> dict[str, float]:
    mu, middle, width = map(float, values)
    return {"mu": mu, "x_min": middle - 0.5 * width, "x_max": middle + 0.5 * width}


EFFECTS: tuple[Effect, ...] = (
    Effect(
        "friction_level",
        "friction coefficient of the floor outside its patches, all wheels",
        "mu_x = mu_y = mu",
        ("ground",),
        {"mu": _mu(0.25, "absolute coefficient")},
        _set_friction,
        "level",
        search=Search(FLOOR, "turns", GROUND, known={"mu": Known("ground.mu", step=-0.1)}),
    ),
    Effect(
        "friction_asymmetry",
        "friction coefficient of the named wheels outside the floor's patches; the others keep theirs",
        "mu_x = mu_y = mu of these wheels",
        WHEELS,
        {"mu": _mu(0.25, "absolute coefficient")},
        _set_friction,
        "asymmetry",
        search=Search(CONTACT, "turns", WHEEL_SETS[:-1], _asymmetry_guesses),
    ),
    Effect(
        "friction_anisotropy",
        "lateral coefficient differs from the longitudinal one",
        "mu_y = ratio mu_x",
        ("ground",),
        {"ratio": EffectParameter("-", "mu_y/mu_x", 0, 5, 1.0, (0.3, 1.5), 0.5)},
        _set_anisotropy,
        "area or ratio",
        search=Search(FLOOR, "turns", GROUND, steps("ratio", -0.2, neutral=1.0)),
    ),
    Effect(
        "slip_weakening",
        "friction falls with slip speed v from mu_s (the floor's own) to mu_k",
        "mu(v) = mu_k + (mu_s - mu_k) exp(-v/slip_speed)",
        ("ground",),
        {
            "mu_k": _mu(0.3, "coefficient along the heading at fast slip; a patch falls by the same factor"),
            "slip_speed": EffectParameter(
                "m/s", "slip speed over which it falls", 1e-3, 10, 0.1, (0.02, 1), 0.1, is_size=False
            ),
        },
        _set_weakening,
        "area or ratio",
        search=Search(FLOOR, "turns", GROUND, _weakening_guesses),
    ),
    Effect(
        "rolling_resistance",
        "torque opposing the wheel's spin over the floor; N normal force, a wheel radius",
        "-coefficient N a sign(spin)",
        WHEELS,
        {"coefficient": EffectParameter("-", "torque over normal force and radius", 0, 1, 0.0, (0, 0.15), 0.05)},
        add("ground.rolling_resistance", "coefficient"),
        search=Search(CONTACT, "straight", WHEEL_SETS, steps("coefficient", 0.02)),
    ),
    Effect(
        "tyre_creep",
        "friction builds up with slip speed v below saturation, along the whole slip vector",
        "F = mu N tanh(v/creep_speed)",
        WHEELS,
        {"creep_speed": EffectParameter("m/s", "slip speed at 76 % of the limit", 0, 1, 0.0, (0, 0.3), 0.03)},
        put("ground.creep_speed", "creep_speed"),
        "level",
        search=Search(CONTACT, "straight", WHEEL_SETS, steps("creep_speed", 0.02), least={"creep_speed": 0.003}),
    ),
    Effect(
        "wheel_radius_error",
        "a wheel larger or smaller than nominal",
        "radius = scale x nominal",
        WHEELS,
        {"scale": EffectParameter("-", "factor on the radius", 0.5, 2, 1.0, (0.9, 1.1), 1.025)},
        multiply("wheel.radius", "scale"),
        "scale",
        search=Search(
            "radius of the {}",
            "straight",
            WHEEL_SETS,
            known={"scale": Known("wheel.radius[{}]", 0.01, scale=lambda observed: 1.0 / observed.mean("wheel.radius"))},
        ),
    ),
    Effect(
        "floor_slope",
        "floor inclined; positive = uphill along floor x (pitch) and y (roll)",
        "gravity turned by pitch and roll",
        ("ground",),
        {
            "pitch": EffectParameter("rad", "uphill along floor x", -1.2, 1.2, 0.0, (-0.15, 0.15), 0.06, optional=True),
            "roll": EffectParameter("rad", "uphill along floor y", -1.2, 1.2, 0.0, (-0.15, 0.15), 0.03, optional=True),
        },
        add_vector("ground.slope", ("pitch", "roll")),
        search=Search(
            BODY_FORCE,
            "turns",
            GROUND,
            known={axis: Known(f"ground.slope[{axis}]", step=0.01) for axis in ("pitch", "roll")},
            components=True,
        ),
    ),
    Effect(
        "friction_patch",
        "an area of the floor with other friction; up to four, of overlapping ones the later holds",
        "mu_x = mu for x_min < x < x_max, y_min < y < y_max under the wheel; mu_y/mu_x as elsewhere",
        ("ground",),
        {
            "mu": _mu(0.2, "absolute coefficient along the wheel's heading"),
            "x_min": _edge("floor frame", 0.0, 0.2),
            "x_max": _edge("floor frame; no patch where it equals x_min", 0.0, 1.2),
            "y_min": _edge("floor frame; left out: no bound", -UNBOUNDED, -UNBOUNDED, optional=True),
            "y_max": _edge("floor frame; left out: no bound", UNBOUNDED, UNBOUNDED, optional=True),
        },
        _lay_patch,
        "area or ratio",
        search=Search(FLOOR, "straight", GROUND, _patch_guesses, coordinates=_patch_coordinates, surcharge=BUMPY_FLOOR),
    ),
)
