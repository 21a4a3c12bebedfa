"""Effects in the joints: gears, motors, their supply, and how commands reach them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from wlr_gym.physics.effects.effect import Effect, EffectParameter, add, add_shaped, multiply
from wlr_gym.physics.effects.search import (
    JOINT_SETS,
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
from wlr_gym.robot import JOINTS, LEGS

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


EFFECTS: tuple[Effect, ...] = (
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
