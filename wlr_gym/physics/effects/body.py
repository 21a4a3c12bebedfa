"""Effects on the body: what it carries and what pulls at it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wlr_gym.physics.effects.effect import Effect, EffectParameter, Values, add_vector, xyz
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


EFFECTS: tuple[Effect, ...] = (
    Effect(
        "payload",
        "extra mass fixed to the body, point-like, at x, y, z in the body frame; joins what it carries already",
        "mass at (x, y, z)",
        ("body",),
        {
            "mass": EffectParameter("kg", "extra mass", 0, 20, 0.0, (0, 2), 0.5),
            **xyz("m", 0.5, 0.2, (0.08, 0.04, 0.05), "{axis} in the body frame", is_size=False),
        },
        _add_payload,
    ),
    Effect(
        "com_offset",
        "body's centre of mass displaced; IMU and marker stay at the geometric origin",
        "centre of mass + (x, y, z)",
        ("body",),
        xyz("m", 0.2, 0.05, (0.02, -0.01, 0.0), "shift along body {axis}"),
        add_vector("body.com_offset", "xyz"),
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
    ),
    Effect(
        "tether",
        "spring-like pull on the body origin p, horizontal, towards a point on the floor; no rest length",
        "-stiffness (p - (x, y))",
        ("body",),
        {
            "stiffness": EffectParameter("N/m", "of the spring", 0, 1e4, 0.0, (0, 20), 3.0),
            "x": EffectParameter("m", "anchor, floor frame", -1e3, 1e3, 0.0, (-5, 5), -0.5, optional=True, is_size=False),
            "y": EffectParameter("m", "anchor, floor frame", -1e3, 1e3, 0.0, (-5, 5), 0.3, optional=True, is_size=False),
        },
        _add_tether,
    ),
)
