"""The library of effects: joints, floor, body and sensors, one definition each.

Names, parameters and places are the project's fixed vocabulary.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.physics.effects.effect import (
    JOINT_SETS,
    LEG_SETS,
    WHEEL_SETS,
    Change,
    Coordinate,
    Coordinates,
    Effect,
    EffectParameter,
    Guess,
    Known,
    Observed,
    Places,
    Search,
    Values,
    add,
    add_shaped,
    add_vector,
    along,
    multiply,
    one_step,
    put,
    put_given,
    steps,
    together,
    xyz,
)
from wlr_gym.physics.model.dynamics import point_inertia
from wlr_gym.physics.plants.forces import COORDINATES
from wlr_gym.robot import JOINTS, LEGS, WHEELS
from wlr_gym.robot.parameter_table import PATCHES, SPECS
from wlr_gym.robot.parameters import Parameters

#: What most effects in a joint change.
TORQUE = "torque in the {}"
EACH_JOINT = tuple((joint,) for joint in JOINTS)
#: N m; a plausible ripple has no larger amplitude.
HIGHEST_RIPPLE = 0.5


def _stribeck_guesses(where: Places, observed: Observed) -> list[Guess]:
    torque = 0.1 if where[0] in LEGS else 0.02
    return [_at_speed(torque, speed) for speed in (0.1, 1.0)]


def _at_speed(torque: float, speed: float) -> Guess:
    change = Change({"extra_static_torque": torque, "stribeck_speed": speed})
    return Guess(((change,),), lambda a: (torque * float(a[0]), speed))


def _wave(where: Places) -> float:
    """Return the amplitude, N m, of the waves that a search for a ripple starts from."""
    return 0.05 if where[0] in LEGS else 0.02


def _ripple_guesses(where: Places, observed: Observed) -> list[Guess]:
    """A sine and a cosine at the period that the joint's own residuals show best."""
    if where[0] not in observed.orders:
        return []
    amplitude, order = _wave(where), observed.orders[where[0]]
    waves = tuple((Change({"amplitude": amplitude, "order": order, "phase": phase}),) for phase in (0.0, math.pi / 2))
    return [Guess(waves, lambda a: (amplitude * float(a[0]), amplitude * float(a[1]), order))]


def _ripple_coordinates(where: Places, observed: Observed) -> Coordinates:
    order = observed.orders[where[0]]
    wave = Coordinate("N m", 0.0, -HIGHEST_RIPPLE, HIGHEST_RIPPLE, _wave(where))
    period = Coordinate("-", order, order - 0.5, order + 0.5, 0.02, is_size=False)
    return Coordinates({"sine": wave, "cosine": wave, "order": period}, _ripple)


def _ripple(values: Sequence[float]) -> dict[str, float]:
    """Amplitude and phase from the two waves a ripple is made of."""
    sine, cosine, order = map(float, values)
    return {"amplitude": math.hypot(sine, cosine), "order": order, "phase": math.atan2(cosine, sine)}


JOINT_EFFECTS: tuple[Effect, ...] = (
    Effect(
        "coulomb_friction",
        "dry friction in a joint on top of its own",
        "-torque sign(rate)",
        JOINTS,
        {"torque": EffectParameter("N m", "friction in motion and at rest", 0, 50, 0.0, (0, 2), 0.3)},
        add("servo.coulomb_friction", "torque"),
        search=Search(
            TORQUE, "random", JOINT_SETS, known={"torque": Known("servo.coulomb_friction[{}]", step=0.03, wheel_step=0.01)}
        ),
    ),
    Effect(
        "viscous_friction",
        "friction proportional to speed, beyond back-EMF, on top of the joint's own",
        "-coefficient rate",
        JOINTS,
        {"coefficient": EffectParameter("N m s/rad", "torque per rate", 0, 10, 0.0, (0, 0.5), 0.1)},
        add("servo.viscous_friction", "coefficient"),
        search=Search(
            TORQUE,
            "straight",
            JOINT_SETS,
            known={"coefficient": Known("servo.viscous_friction[{}]", step=0.2, wheel_step=0.004)},
        ),
    ),
    Effect(
        "load_dependent_friction",
        "gear friction growing with the motor torque it transmits",
        "-ratio abs(motor torque) sign(rate)",
        JOINTS,
        {"ratio": EffectParameter("-", "friction per motor torque", 0, 1, 0.0, (0, 0.4), 0.2)},
        add("servo.load_friction", "ratio"),
        search=Search(TORQUE, "rear_legs", (*JOINT_SETS, JOINTS), steps("ratio", 0.1)),
    ),
    Effect(
        "weak_motor",
        "motor torque below what its current says; not seen in the reported effort",
        "motor torque = scale K I",
        JOINTS,
        {"scale": EffectParameter("-", "factor on the motor's torque", 0, 2, 1.0, (0.3, 1), 0.7)},
        multiply("servo.torque_scale", "scale"),
        "scale",
        search=Search(TORQUE, "rear_legs", JOINT_SETS, steps("scale", -0.1, neutral=1.0)),
    ),
    Effect(
        "command_delay",
        "setpoints act later than written, on top of the robot's own delay",
        "goal(t) = written(t - delay)",
        JOINTS,
        {"delay": EffectParameter("s", "extra time", 0, 0.2, 0.0, (0, 0.06), 0.025)},
        add("command.delay", "delay"),
        search=Search(
            "timing of the {}",
            "chirp",
            (*JOINT_SETS, JOINTS),
            steps("delay", 0.015),
            {"delay": Known("command.delay")},
            relation_of_all="timing of the commands",
        ),
    ),
    Effect(
        "stribeck_friction",
        "dry friction higher at rest than in motion",
        "-extra_static_torque exp(-(rate/stribeck_speed)^2) sign(rate)",
        JOINTS,
        {
            "extra_static_torque": EffectParameter("N m", "friction at rest beyond that in motion", 0, 50, 0.0, (0, 1), 0.3),
            "stribeck_speed": EffectParameter(
                "rad/s", "rate over which it fades", 1e-4, 20, 0.1, (0.02, 3), 0.1, is_size=False
            ),
        },
        add_shaped(
            "extra_static_torque",
            "servo.stribeck_torque",
            {"stribeck_speed": "servo.stribeck_speed"},
            "stick friction",
        ),
        search=Search(TORQUE, "stop_and_go", JOINT_SETS, _stribeck_guesses, one_per_place=True),
    ),
    Effect(
        "supply_sag",
        "supply drops with the total current: internal resistance of battery and cables",
        "V = V0 - resistance sum of abs(I_j)",
        ("body",),
        {"resistance": EffectParameter("ohm", "of the supply", 0, 5, 0.0, (0, 1), 0.3)},
        add("servo.supply_resistance", "resistance"),
        search=Search("supply", "steps", (("body",),), steps("resistance", 0.2)),
    ),
    Effect(
        "backlash",
        "gear play: no torque passes inside the gap; encoder and link on its output side, motor and gear friction on the other",
        "torque = 0 while abs(motor angle - joint angle) < angle/2",
        JOINTS,
        {"angle": EffectParameter("rad", "full width of the gap", 0, 0.5, 0.0, (0, 0.1), 0.035)},
        add("servo.backlash", "angle"),
        search=Search(TORQUE, "stop_and_go", JOINT_SETS, steps("angle", 0.01, 0.03)),
    ),
    Effect(
        "torque_ripple",
        "motor torque periodic in the joint angle q",
        "amplitude sin(order q + phase)",
        JOINTS,
        {
            "amplitude": EffectParameter("N m", "of the torque", 0, 10, 0.0, (0, HIGHEST_RIPPLE), 0.15),
            "order": EffectParameter("-", "periods per turn", 0, 1000, 1.0, (1, 64), 12.0, is_size=False),
            "phase": EffectParameter("rad", "at angle 0", -10, 10, 0.0, (-math.pi, math.pi), 0.0, optional=True, is_size=False),
        },
        add_shaped(
            "amplitude",
            "servo.ripple_amplitude",
            {"order": "servo.ripple_order", "phase": "servo.ripple_phase"},
            "ripple",
        ),
        search=Search(TORQUE, "straight", EACH_JOINT, _ripple_guesses, coordinates=_ripple_coordinates),
    ),
)


# ---- floor, and the wheels on it -------------------------------------------------------------------------------------


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


#: Slip per friction over load of the tread from which a search starts; one of rubber has 0.04 to 0.07.
TREAD = 0.08


def _asymmetry_guesses(where: Places, observed: Observed) -> list[Guess]:
    mu = observed.mean("ground.mu_x")
    return [one_step("mu", -0.25 * mu, mu)]


def _tread_guesses(where: Places, observed: Observed) -> list[Guess]:
    return [one_step("slip_compliance", TREAD, observed.mean("ground.slip_compliance"))]


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


GROUND_EFFECTS: tuple[Effect, ...] = (
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
        "tyre_brush",
        "an elastic tread: friction builds up with the way that the wheel rolls, and holds a parked robot",
        "u' = s - |V|/relaxation_length u, F = -load/(slip_compliance relaxation_length) u up to mu load",
        WHEELS,
        {
            "slip_compliance": EffectParameter(
                "-", "slip per friction over load", 0, 5, "ground.slip_compliance", (0, 0.3), 0.06
            ),
            "relaxation_length": EffectParameter(
                "m",
                "way over which it builds up",
                5e-4,
                0.1,
                "ground.relaxation_length",
                (0.002, 0.02),
                0.005,
                optional=True,
                is_size=False,
            ),
        },
        together(put("ground.slip_compliance", "slip_compliance"), put_given("ground.relaxation_length", "relaxation_length")),
        "level",
        search=Search(
            CONTACT,
            "posture",
            WHEEL_SETS,
            _tread_guesses,
            least={"slip_compliance": 0.01},
            unseen={"relaxation_length": "ground.relaxation_length"},
        ),
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


# ---- body: what it carries and what pulls at it ----------------------------------------------------------------------


def _add_payload(parameters: Parameters, where: Sequence[str], values: Values) -> None:
    """Two loads are one: masses add at their common centre, where their distance leaves the inertia of a dumbbell."""
    if values["mass"] == 0.0:
        return
    old, place = parameters["payload.mass"].copy(), np.array([values[axis] for axis in "xyz"])
    share = values["mass"] / (old + values["mass"])
    apart = place - parameters["payload.position"]
    parameters["payload.inertia"] += point_inertia(old * share, apart)
    together = parameters["payload.position"] + share[:, None] * apart
    parameters["payload.position"] = np.where(share[:, None] == 1.0, place, together)
    parameters["payload.mass"] = old + values["mass"]


def _add_tether(parameters: Parameters, where: Sequence[str], values: Values) -> None:
    """Springs without rest length add up to one: stiffnesses add, anchors average, weighted by stiffness."""
    if values["stiffness"] == 0.0:
        return
    old, anchor = parameters["tether.stiffness"].copy(), np.array([values["x"], values["y"]])
    share = (values["stiffness"] / (old + values["stiffness"]))[:, None]
    parameters["tether.anchor"] = np.where(share == 1.0, anchor, (1.0 - share) * parameters["tether.anchor"] + share * anchor)
    parameters["tether.stiffness"] = old + values["stiffness"]


BODY = (("body",),)
#: Relations that several effects change.
BODY_MASS = "mass of the body"
#: kg and m: the load, in the middle and off it along each axis, from which a search starts.
LOAD = 0.15
ARM = 0.1
#: N; the force from which a search starts.
PULL = 0.5
#: m; a load is carried no farther from the middle of the body.
FARTHEST_LOAD = 0.2
#: m; nor is a tether anchored farther from the floor's origin: from afar it is a constant force.
FARTHEST_ANCHOR = 5.0


def _payload_guesses(where: Places, observed: Observed) -> list[Guess]:
    middle = {"mass": LOAD, "x": 0.0, "y": 0.0, "z": 0.0}
    loads = (middle, *({**middle, axis: ARM} for axis in "xyz"))
    moment = ARM * LOAD
    return [
        Guess(
            tuple((Change(load),) for load in loads),
            lambda a: (max(LOAD * float(a.sum()), 0.0), *(float(v) for v in moment * a[1:])),
        )
    ]


def _payload_coordinates(where: Places, observed: Observed) -> Coordinates:
    """Mass and moments, in place of mass and place."""
    moments = {f"moment_{axis}": Coordinate("kg m", 0.0, -0.2, 0.2, 0.01) for axis in "xyz"}
    return _size_times_place({"mass": Coordinate("kg", 0.0, 0.0, 2.0, 0.1)} | moments, FARTHEST_LOAD)


def _size_times_place(numbers: dict[str, Coordinate], farthest: float) -> Coordinates:
    """A size, and what it is times a place, along each axis; the place is no farther out than ``farthest``."""
    size = next(iter(numbers))

    def placed(values: Sequence[float]) -> dict[str, float]:
        amount = max(float(values[0]), 1e-6)
        places = (float(np.clip(value / amount, -farthest, farthest)) for value in values[1:])
        return {size: amount, **dict(zip("xyz", places, strict=False))}

    def within(values: Sequence[float]) -> tuple[float, ...]:
        most = float(values[0]) * farthest
        return float(values[0]), *(float(np.clip(value, -most, most)) for value in values[1:])

    return Coordinates(numbers, placed, within=within)


def _pulls() -> tuple[dict[str, float], ...]:
    return {"fx": PULL, "fy": 0.0}, {"fx": 0.0, "fy": PULL}


def _tether_guesses(where: Places, observed: Observed) -> list[Guess]:
    spring = Change({"stiffness": 1.0, "x": 0.0, "y": 0.0})
    pulls = ((Change(pull, "external_force"),) for pull in _pulls())
    return [Guess(((spring,), *pulls), lambda a: (max(float(a[0]), 0.0), *(float(v) for v in PULL * a[1:])))]


def _tether_coordinates(where: Places, observed: Observed) -> Coordinates:
    """Stiffness and the pull at the floor's origin, in place of stiffness and anchor."""
    pulls = {f"pull_{axis}": Coordinate("N", 0.0, -20.0, 20.0, 0.2) for axis in "xy"}
    return _size_times_place({"stiffness": Coordinate("N/m", 0.0, 0.0, 20.0, 0.5)} | pulls, FARTHEST_ANCHOR)


def _anchor(severity: float) -> EffectParameter:
    near = (-FARTHEST_ANCHOR, FARTHEST_ANCHOR)
    return EffectParameter("m", "anchor, floor frame", -1e3, 1e3, 0.0, near, severity, optional=True, is_size=False)


BODY_EFFECTS: tuple[Effect, ...] = (
    Effect(
        "payload",
        "extra mass fixed to the body, point-like, at x, y, z in the body frame; joins what it carries already",
        "mass at (x, y, z)",
        ("body",),
        {
            "mass": EffectParameter("kg", "extra mass", 0, 20, 0.0, (0, 2), 0.5),
            **xyz("m", 0.5, FARTHEST_LOAD, (0.08, 0.04, 0.05), "{axis} in the body frame", is_size=False),
        },
        _add_payload,
        search=Search(
            BODY_MASS,
            "all_legs",
            BODY,
            _payload_guesses,
            {"mass": Known("body.mass", any_size=True)}
            | {
                f"moment_{axis}": Known(
                    f"body.com_offset[{axis}]", scale=lambda observed: observed.mean("body.mass"), any_size=True
                )
                for axis in "xyz"
            },
            _payload_coordinates,
        ),
    ),
    Effect(
        "com_offset",
        "body's centre of mass displaced; IMU and marker stay at the geometric origin",
        "centre of mass + (x, y, z)",
        ("body",),
        xyz("m", 0.2, 0.05, (0.02, -0.01, 0.0), "shift along body {axis}"),
        add_vector("body.com_offset", "xyz"),
        search=Search(
            BODY_MASS,
            "all_legs",
            BODY,
            known={axis: Known(f"body.com_offset[{axis}]", step=0.005) for axis in "xyz"},
            components=True,
        ),
    ),
    Effect(
        "external_force",
        "constant force on the body origin in the floor frame (wind, cable drag)",
        "(fx, fy)",
        ("body",),
        {
            "fx": EffectParameter("N", "along floor x", -1e3, 1e3, 0.0, (-5, 5), -2.0, optional=True),
            "fy": EffectParameter("N", "along floor y", -1e3, 1e3, 0.0, (-5, 5), 1.0, optional=True),
        },
        add_vector("external_force", ("fx", "fy")),
        search=Search(BODY_FORCE, "turns", BODY, lambda where, observed: [along(PULL, *_pulls())], components=True),
    ),
    Effect(
        "tether",
        "spring-like pull on the body origin p, horizontal, towards a point on the floor; no rest length",
        "-stiffness (p - (x, y))",
        ("body",),
        {
            "stiffness": EffectParameter("N/m", "of the spring", 0, 1e4, 0.0, (0, 20), 3.0),
            "x": _anchor(-0.5),
            "y": _anchor(0.3),
        },
        _add_tether,
        search=Search(BODY_FORCE, "straight", BODY, _tether_guesses, coordinates=_tether_coordinates),
    ),
)


# ---- sensors: the robot moves as before, what it reads is wrong ------------------------------------------------------


_ANGLES = {
    axis: EffectParameter("rad", f"{axis} from sensor to body", -0.5, 0.5, 0.0, (-0.2, 0.2), severity, optional=True)
    for axis, severity in (("roll", 0.02), ("pitch", 0.06), ("yaw", 0.04))
}

SENSOR = (("sensor",),)


def _imu_guesses(where: Places, observed: Observed) -> list[Guess]:
    neutral, turn = dict.fromkeys(_ANGLES, 0.0), 0.03
    return [along(turn, *({**neutral, axis: turn} for axis in _ANGLES))]


SENSOR_EFFECTS: tuple[Effect, ...] = (
    Effect(
        "joint_zero_offset",
        "zero of the encoder is wrong; the servo regulates the reading",
        "reading = true angle + angle",
        LEGS,
        {"angle": EffectParameter("rad", "reading minus true angle", -0.5, 0.5, 0.0, (-0.1, 0.1), 0.04)},
        add("joint.zero_offset", "angle"),
        search=Search("zero of the {}", "all_legs", LEG_SETS, known={"angle": Known("joint.zero_offset[{}]", step=0.01)}),
    ),
    Effect(
        "gyro_bias",
        "constant rate offset beyond specification",
        "reading = rate + (x, y, z)",
        ("sensor",),
        xyz("rad/s", 1.0, 0.1, (0.0, 0.0, 0.05), "offset about the sensor's {axis}"),
        add_vector("imu.gyro_bias", "xyz"),
        search=Search(
            "reading of the gyroscope",
            "random",
            SENSOR,
            known={axis: Known(f"imu.gyro_bias[{axis}]", step=0.005) for axis in "xyz"},
            components=True,
        ),
    ),
    Effect(
        "imu_misalignment",
        "IMU mounted rotated; angles of two such effects add",
        "reading = (Rz(yaw) Ry(pitch) Rx(roll))^T body-frame vector",
        ("sensor",),
        _ANGLES,
        add_vector("imu.mount", ("roll", "pitch", "yaw")),
        search=Search("mounting of the IMU", "random", SENSOR, _imu_guesses, components=True),
    ),
    Effect(
        "camera_misalignment",
        "camera's floor frame turned by +yaw against the start heading, and scaled; the measured yaw stays",
        "(x, y) measured = scale R(-yaw) (x, y)",
        ("sensor",),
        {
            "yaw": EffectParameter("rad", "turn of the camera's frame", -0.5, 0.5, 0.0, (-0.2, 0.2), 0.06, optional=True),
            "scale": EffectParameter("-", "measured over true length", 0.5, 2, 1.0, (0.8, 1.25), 1.05, optional=True),
        },
        together(add("camera.mount_yaw", "yaw"), multiply("camera.scale", "scale")),
        search=Search(
            "mounting of the camera",
            "s_curve",
            SENSOR,
            known={"yaw": Known("camera.mount_yaw", step=0.02), "scale": Known("camera.scale", step=0.02)},
            components=True,
        ),
    ),
    Effect(
        "camera_delay",
        "vision pose older than its row, on top of the camera's own delay",
        "pose(t - delay)",
        ("sensor",),
        {"delay": EffectParameter("s", "extra age", 0, 0.5, 0.0, (0, 0.15), 0.04)},
        add("camera.delay", "delay"),
        search=Search("timing of the camera", "chirp", SENSOR, known={"delay": Known("camera.delay", step=0.01)}),
    ),
    Effect(
        "flow_misalignment",
        "optical-flow sensor mounted turned by +yaw on the body, and its scale wrong",
        "(x, y) measured = scale R(-yaw) (x, y)",
        ("sensor",),
        {
            "yaw": EffectParameter("rad", "turn of the sensor on the body", -3.2, 3.2, 0.0, (-0.2, 0.2), 0.06, optional=True),
            "scale": EffectParameter("-", "measured over true flow", 0.5, 2, 1.0, (0.8, 1.25), 1.05, optional=True),
        },
        together(add("flow.mount_yaw", "yaw"), multiply("flow.scale", "scale")),
    ),
)


# ---- all of them -----------------------------------------------------------------------------------------------------


class Library(dict[str, Effect]):
    """Effects, each under its own name."""

    def __setitem__(self, name: str, effect: Effect) -> None:
        if effect.name != name:
            raise InputError(f"EFFECTS['{name}']: the effect calls itself '{effect.name}'; expected the same name")
        super().__setitem__(name, effect)


#: Effects by name, joints first, then ground, body and sensors.
EFFECTS = Library(
    {effect.name: effect for family in (JOINT_EFFECTS, GROUND_EFFECTS, BODY_EFFECTS, SENSOR_EFFECTS) for effect in family}
)


# ---- words about effects, for the documentation and the command line -------------------------------------------------


_PLACES = {JOINTS: "joints", LEGS: "legs", WHEELS: "wheels"}


def places(effect: Effect) -> str:
    """Return where an effect can act, in a word: joints, legs, wheels, body, ground or sensor."""
    return _PLACES.get(effect.where, ", ".join(effect.where))


def coordinates() -> list[tuple[list[str], str, str]]:
    """Return where a formula may act: names that act alike, their unit, and what they mean."""
    return [
        (list(JOINTS), "N m", "torque like the motor's: on the child link, opposite on the parent"),
        (_names("body_force_"), "N", "force on the body origin, along the body's axes"),
        (_names("floor_force_"), "N", "force on the body origin, along the floor's axes"),
        (_names("body_torque_"), "N m", "torque on the body about its own x, y and z axes"),
    ]


def _names(start: str) -> list[str]:
    return [name for name in COORDINATES if name.startswith(start)]
