"""Effects of the floor, and of the wheels on it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.physics.effects.effect import Effect, EffectParameter, Values, add, add_vector, multiply, put
from wlr_gym.robot import WHEELS
from wlr_gym.robot.parameter_table import PATCHES, SPECS
from wlr_gym.robot.parameters import Parameters

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


def _mu(neutral: float | str, severity: float, doc: str, low: float = 0.05) -> EffectParameter:
    return EffectParameter("-", doc, 0, 5, neutral, (low, 1.5), severity)


def _edge(doc: str, neutral: float, severity: float, *, optional: bool = False) -> EffectParameter:
    return EffectParameter("m", doc, -UNBOUNDED, UNBOUNDED, neutral, (-5, 5), severity, optional, is_size=False)


EFFECTS: tuple[Effect, ...] = (
    Effect(
        "friction_level",
        "friction coefficient of the floor, all wheels",
        "mu_x = mu_y = mu",
        ("ground",),
        {"mu": _mu("ground.mu_x", 0.25, "absolute coefficient")},
        _set_friction,
        "level",
    ),
    Effect(
        "friction_asymmetry",
        "friction coefficient of the named wheels; the others keep theirs",
        "mu_x = mu_y = mu of these wheels",
        WHEELS,
        {"mu": _mu("ground.mu_x", 0.25, "absolute coefficient")},
        _set_friction,
        "asymmetry",
    ),
    Effect(
        "friction_anisotropy",
        "lateral coefficient differs from the longitudinal one",
        "mu_y = ratio mu_x",
        ("ground",),
        {"ratio": EffectParameter("-", "mu_y/mu_x", 0, 5, 1.0, (0.3, 1.5), 0.5)},
        _set_anisotropy,
        "area or ratio",
    ),
    Effect(
        "friction_patch",
        "an area of the floor with other friction; up to four, of overlapping ones the later holds",
        "mu_x = mu for x_min < x < x_max, y_min < y < y_max under the wheel; mu_y/mu_x as elsewhere",
        ("ground",),
        {
            "mu": _mu("ground.mu_x", 0.2, "absolute coefficient along the wheel's heading"),
            "x_min": _edge("floor frame", 0.0, 0.2),
            "x_max": _edge("floor frame; no patch where it equals x_min", 0.0, 1.2),
            "y_min": _edge("floor frame; left out: no bound", -UNBOUNDED, -UNBOUNDED, optional=True),
            "y_max": _edge("floor frame; left out: no bound", UNBOUNDED, UNBOUNDED, optional=True),
        },
        _lay_patch,
        "area or ratio",
    ),
    Effect(
        "slip_weakening",
        "friction falls with slip speed v from mu_s (the floor's own) to mu_k",
        "mu(v) = mu_k + (mu_s - mu_k) exp(-v/slip_speed)",
        ("ground",),
        {
            "mu_k": _mu("ground.mu_x", 0.3, "coefficient along the heading at fast slip; a patch falls by the same factor"),
            "slip_speed": EffectParameter(
                "m/s", "slip speed over which it falls", 1e-3, 10, 0.1, (0.02, 1), 0.1, is_size=False
            ),
        },
        _set_weakening,
        "area or ratio",
    ),
    Effect(
        "tyre_creep",
        "friction builds up with slip speed v below saturation, along the whole slip vector",
        "F = mu N tanh(v/creep_speed)",
        WHEELS,
        {"creep_speed": EffectParameter("m/s", "slip speed at 76 % of the limit", 0, 1, 0.0, (0, 0.3), 0.03)},
        put("ground.creep_speed", "creep_speed"),
        "level",
    ),
    Effect(
        "rolling_resistance",
        "torque opposing the wheel's spin over the floor; N normal force, a wheel radius",
        "-coefficient N a sign(spin)",
        WHEELS,
        {"coefficient": EffectParameter("-", "torque over normal force and radius", 0, 1, 0.0, (0, 0.15), 0.05)},
        add("ground.rolling_resistance", "coefficient"),
    ),
    Effect(
        "wheel_radius_error",
        "a wheel larger or smaller than nominal",
        "radius = scale x nominal",
        WHEELS,
        {"scale": EffectParameter("-", "factor on the radius", 0.5, 2, 1.0, (0.9, 1.1), 1.025)},
        multiply("wheel.radius", "scale"),
        "scale",
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
    ),
)
