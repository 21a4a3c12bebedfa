"""Effects on the body: what it carries and what pulls at it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from wlr_gym.physics.effects.effect import Effect, EffectParameter, Values, add_vector, xyz
from wlr_gym.physics.effects.search import Change, Coordinate, Coordinates, Guess, Known, Observed, Places, Search, along
from wlr_gym.physics.model.dynamics import point_inertia
from wlr_gym.robot.parameters import Parameters


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
BODY_FORCE = "force on the body"
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
    return Coordinates({"mass": Coordinate("kg", 0.0, 0.0, 2.0, 0.1), **moments}, _load, within=_no_farther(FARTHEST_LOAD))


def _no_farther(distance: float) -> Callable[[Sequence[float]], tuple[float, ...]]:
    """Keep a size, and what it is times a place, where the place is no farther out than ``distance``."""

    def within(values: Sequence[float]) -> tuple[float, ...]:
        most = float(values[0]) * distance
        return float(values[0]), *(float(np.clip(value, -most, most)) for value in values[1:])

    return within


def _load(values: Sequence[float]) -> dict[str, float]:
    """Mass and place of a load from its mass and moments; none is carried farther out than plausible."""
    mass = max(float(values[0]), 1e-6)
    moments = zip("xyz", values[1:], strict=True)
    return {"mass": mass, **{axis: float(np.clip(moment / mass, -FARTHEST_LOAD, FARTHEST_LOAD)) for axis, moment in moments}}


def _pulls() -> tuple[dict[str, float], ...]:
    return {"fx": PULL, "fy": 0.0}, {"fx": 0.0, "fy": PULL}


def _tether_guesses(where: Places, observed: Observed) -> list[Guess]:
    spring = Change({"stiffness": 1.0, "x": 0.0, "y": 0.0})
    pulls = ((Change(pull, "external_force"),) for pull in _pulls())
    return [Guess(((spring,), *pulls), lambda a: (max(float(a[0]), 0.0), *(float(v) for v in PULL * a[1:])))]


def _tether_coordinates(where: Places, observed: Observed) -> Coordinates:
    """Stiffness and the pull at the floor's origin, in place of stiffness and anchor."""
    pulls = {f"pull_{axis}": Coordinate("N", 0.0, -20.0, 20.0, 0.2) for axis in "xy"}
    springs = {"stiffness": Coordinate("N/m", 0.0, 0.0, 20.0, 0.5), **pulls}
    return Coordinates(springs, _anchored, within=_no_farther(FARTHEST_ANCHOR))


def _anchor(severity: float) -> EffectParameter:
    near = (-FARTHEST_ANCHOR, FARTHEST_ANCHOR)
    return EffectParameter("m", "anchor, floor frame", -1e3, 1e3, 0.0, near, severity, optional=True, is_size=False)


def _anchored(values: Sequence[float]) -> dict[str, float]:
    """Stiffness and anchor from stiffness and the pull at the floor's origin."""
    stiffness = max(float(values[0]), 1e-6)
    pulls = zip("xy", values[1:], strict=True)
    places = {axis: float(np.clip(pull / stiffness, -FARTHEST_ANCHOR, FARTHEST_ANCHOR)) for axis, pull in pulls}
    return {"stiffness": stiffness, **places}


EFFECTS: tuple[Effect, ...] = (
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
