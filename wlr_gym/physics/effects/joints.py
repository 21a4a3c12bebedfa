"""Effects in the joints: gears, motors, their supply, and how commands reach them."""

from __future__ import annotations

import math

from wlr_gym.physics.effects.effect import Effect, EffectParameter, add, add_shaped, multiply
from wlr_gym.robot import JOINTS, LEGS

EFFECTS: tuple[Effect, ...] = (
    Effect(
        "coulomb_friction",
        "dry friction in a joint on top of its own",
        "-torque sign(rate)",
        JOINTS,
        {"torque": EffectParameter("N m", "friction in motion and at rest", 0, 50, 0.0, (0, 2), 0.3)},
        add("servo.coulomb_friction", "torque"),
    ),
    Effect(
        "viscous_friction",
        "friction proportional to speed, beyond back-EMF, on top of the joint's own",
        "-coefficient rate",
        JOINTS,
        {"coefficient": EffectParameter("N m s/rad", "torque per rate", 0, 10, 0.0, (0, 0.5), 0.1)},
        add("servo.viscous_friction", "coefficient"),
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
    ),
    Effect(
        "load_dependent_friction",
        "gear friction growing with the motor torque it transmits",
        "-ratio abs(motor torque) sign(rate)",
        JOINTS,
        {"ratio": EffectParameter("-", "friction per motor torque", 0, 1, 0.0, (0, 0.4), 0.2)},
        add("servo.load_friction", "ratio"),
    ),
    Effect(
        "backlash",
        "gear play: no torque passes inside the gap; encoder and link on its output side, motor and gear friction on the other",
        "torque = 0 while abs(motor angle - joint angle) < angle/2",
        JOINTS,
        {"angle": EffectParameter("rad", "full width of the gap", 0, 0.5, 0.0, (0, 0.1), 0.035)},
        add("servo.backlash", "angle"),
    ),
    Effect(
        "torque_ripple",
        "motor torque periodic in the joint angle q",
        "amplitude sin(order q + phase)",
        JOINTS,
        {
            "amplitude": EffectParameter("N m", "of the torque", 0, 10, 0.0, (0, 0.5), 0.15),
            "order": EffectParameter("-", "periods per turn", 0, 1000, 1.0, (1, 64), 12.0, is_size=False),
            "phase": EffectParameter("rad", "at angle 0", -10, 10, 0.0, (-math.pi, math.pi), 0.0, optional=True, is_size=False),
        },
        add_shaped(
            "amplitude",
            "servo.ripple_amplitude",
            {"order": "servo.ripple_order", "phase": "servo.ripple_phase"},
            "ripple",
        ),
    ),
    Effect(
        "weak_motor",
        "motor torque below what its current says; not seen in the reported effort",
        "motor torque = scale K I",
        JOINTS,
        {"scale": EffectParameter("-", "factor on the motor's torque", 0, 2, 1.0, (0.3, 1), 0.7)},
        multiply("servo.torque_scale", "scale"),
        "scale",
    ),
    Effect(
        "supply_sag",
        "supply drops with the total current: internal resistance of battery and cables",
        "V = V0 - resistance sum of abs(I_j)",
        ("body",),
        {"resistance": EffectParameter("ohm", "of the supply", 0, 5, 0.0, (0, 1), 0.3)},
        add("servo.supply_resistance", "resistance"),
    ),
    Effect(
        "command_delay",
        "goals act later than written, on top of the robot's own delay",
        "goal(t) = written(t - delay)",
        JOINTS,
        {"delay": EffectParameter("s", "extra time", 0, 0.2, 0.0, (0, 0.06), 0.025)},
        add("command.delay", "delay"),
    ),
    Effect(
        "joint_zero_offset",
        "zero of the encoder is wrong; the servo regulates the reading",
        "reading = true angle + angle",
        LEGS,
        {"angle": EffectParameter("rad", "reading minus true angle", -0.5, 0.5, 0.0, (-0.1, 0.1), 0.04)},
        add("joint.zero_offset", "angle"),
    ),
)
