"""Made-up analyses, one per verdict, as large as real ones."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from wlr_gym.data.format import CHANNELS, COLUMNS
from wlr_gym.data.sensors import channel_noise
from wlr_gym.gap.analysis import (
    Adequacy,
    Analysis,
    ByChannel,
    Calibrated,
    ChannelGap,
    Constancy,
    Detectable,
    Equivalent,
    Evidence,
    FoundEffect,
    GapFigures,
    HeatMap,
    IntakeFinding,
    ParameterEstimate,
    Place,
    Pulled,
    Recommendation,
    Relation,
    RunGap,
    Statistic,
    Trace,
)
from wlr_gym.gap.problem import Range
from wlr_gym.physics.effects import EFFECTS
from wlr_gym.robot import JOINTS, load_robot

FIT = tuple(f"run_{k:02d}" for k in (1, 2, 4, 5, 7, 8))
HELDOUT = ("run_03", "run_06", "run_09")
NOISE = channel_noise(load_robot())


def heat_map(seed=0):
    rng = np.random.default_rng(seed)
    edges = (-6, -4, -2, -0.5, 0.5, 2, 4, 6)
    bins = tuple(f"{a:g} to {b:g}" for a, b in pairwise(edges))
    values = np.sqrt(rng.chisquare(8, (len(CHANNELS), len(bins))) / 8)
    for row, name in enumerate(CHANNELS):
        if name.endswith(("wheel_lf", "wheel_rf")):
            values[row] *= 1 + 5 * np.array([1, 0.9, 0.8, 0.1, 0.8, 0.9, 1])
    values[-3, :2] = np.nan
    return HeatMap(CHANNELS, bins, values, "joint_velocity[wheel_lf]")


def trace(run, channel, size=1.0, seed=0):
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 20.0, 0.02) + 12.5
    noise = NOISE[channel]
    shape = np.sin(2 * np.pi * 0.2 * t) * np.clip(t - 13.5, 0, 1)
    truth = size * shape + 0.15 * size * np.sign(shape)
    measured = truth + noise * rng.standard_normal(t.size)
    if COLUMNS[channel].may_be_nan:
        measured[rng.random(t.size) > 0.55] = np.nan
    before, calibrated = size * shape * 0.9, size * shape
    errors = (measured - calibrated, measured - truth)
    return Trace(run, channel, COLUMNS[channel].unit, t, measured, before, calibrated, truth, *errors)


def statistic(value, expected, limit, p):
    return Statistic(value, expected, limit, p, value / expected)


def by_channel(whole, each, **others):
    return ByChannel(**vars(statistic(*whole)), channels={name: statistic(*others.get(name, each)) for name in CHANNELS})


ADEQUACY = Adequacy(
    19,
    by_channel(
        (1.19, 1.02, 1.03, 0.05),
        (1.02, 1.01, 1.05, 0.4),
        acc_z=(1.31, 1.0, 1.04, 0.05),
        eff_leg_lf=(1.32, 1.18, 1.25, 0.05),
    ),
    by_channel((7.6, 7.0, 7.6, 0.1), (1.5, 1.0, 1.2, 0.05), acc_z=(6.9, 6.8, 7.9, 0.25), eff_leg_lf=(41.7, 35.7, 40.3, 0.05)),
    Constancy(
        **vars(statistic(2.8, 2.0, 2.4, 0.05)),
        pulled_most=Pulled(**vars(statistic(12.7, 6.4, 7.8, 0.05)), number="ground.mu", run="run_05"),
    ),
)


def evidence():
    found = [
        Evidence(
            1, "rolling_resistance", ("wheel_lf", "wheel_rf"), {"coefficient": 0.0412}, 5312.4, 5120.0, "selected",
            "explains more than any other, in 6 of 6 runs", dict.fromkeys(FIT, 885.4),
        ),
        Evidence(
            1, "coulomb_friction", ("wheel_lf", "wheel_rf"), {"torque": 0.046}, 4870.0, 5003.0, "worse fit",
            "improves the fit by 92 % of what the selected effect does", dict.fromkeys(FIT, 811.0),
        ),
        Evidence(
            1, "external_force", ("body",), {"fx": -0.2, "fy": 0.0}, 310.0, 402.0, "worse fit",
            "pulls to one side only; these runs drive both ways",
        ),
        Evidence(
            1, "torque_ripple", ("wheel_lf",), {"amplitude": 0.6}, 290.0, 350.0, "implausible", "amplitude ends at its bound"
        ),
    ]  # fmt: skip
    for k, name in enumerate(name for name, effect in EFFECTS.items() if effect.search):
        for place in JOINTS if EFFECTS[name].where == JOINTS else EFFECTS[name].where[:1]:
            score = 200.0 * np.exp(-0.35 * k)
            found.append(
                Evidence(
                    1, name, (place,), {}, score * 0.4, score, "rejected at screening", "its predicted improvement is too small"
                )
            )
    found.append(
        Evidence(
            2, "viscous_friction", ("leg_lr",), {"coefficient": 0.01}, 31.0, 40.0, "too little", "less than chance may give"
        )
    )
    return tuple(found)


RELATIONS = (
    Relation("contact of the left front wheel", "rolling_resistance", "", 2611.0),
    Relation("torque in the left front wheel", "coulomb_friction", "", 2490.0),
    Relation("force on the body", "external_force", "", 402.0),
    Relation("body force x", "unknown_effect", "-k * velocity_x * absolute(velocity_x)", 57.0),
)
CALIBRATION = {
    "ground.mu": Calibrated(0.6, 0.652, "-", 0.09, 0.0157),
    "servo.kp[leg_lf]": Calibrated(15.3, 15.61, "V/rad", 0.77, 0.39),
    "body.mass": Calibrated(1.83, 1.812, "kg", 0.05, 0.022),
    "servo.kp[leg_rf]": Calibrated(15.3, 15.2, "V/rad", 0.77, 0.39),
    "command.delay": Calibrated(0.012, 0.0153, "s", 0.003, 0.00039),
}
GAP = GapFigures("rms residual of 1 s windows, noise units", 7.42, 1.13, 7.91, 5.24, 1.21, 1.0, 0.951, (0.912, 0.973))

EFFECT_FOUND = Analysis(
    data="twin/rolling_resistance",
    verdict="effect_found",
    summary="",
    intake=(
        IntakeFinding("run_02", "", "gap", "3 rows are missing at 4.12 s; they are bridged"),
        IntakeFinding("", "cam_z", "missing", "no run has it; height is not compared"),
    ),
    fit_runs=FIT,
    heldout_runs=HELDOUT,
    effects=(
        FoundEffect(
            "rolling_resistance",
            ("wheel_lf", "wheel_rf"),
            {"coefficient": ParameterEstimate(0.0412, 0.0383, 0.0447, "-")},
            0.97,
            5312.4,
        ),
    ),
    equivalent=(
        Equivalent(
            ("rolling_resistance", "coulomb_friction"), "straight with a payload: rolling resistance grows with the load"
        ),
    ),
    calibration=CALIBRATION,
    evidence=evidence(),
    relations=RELATIONS,
    localisation=(
        Place("eff_wheel_lf", 0.44, "opposes the motion, the same at every speed"),
        Place("eff_wheel_rf", 0.41, "opposes the motion, the same at every speed"),
        Place("cam_x", 0.15, "follows from the wheels"),
    ),
    heat_maps=(heat_map(), heat_map(1)),
    traces=(
        trace("run_03", "eff_wheel_lf", 0.3),
        trace("run_03", "vel_wheel_lf", 5.0, 1),
        trace("run_06", "cam_x", 0.8, 2),
        trace("run_06", "gyro_z", 1.2, 3),
    ),
    gap=GAP,
    run_gaps=tuple(
        RunGap(name, name in HELDOUT, 7.0 + 0.3 * k, 5.0 + 0.1 * k, 1.1 + 0.02 * k, 0.93 + 0.005 * k)
        for k, name in enumerate(sorted((*FIT, *HELDOUT)))
    ),
    channel_gaps=tuple(
        ChannelGap(name, COLUMNS[name].unit, NOISE[name], 3.0 + k, 2.0 + 0.5 * k, 1.0 + 0.01 * k, COLUMNS[name].group)
        for k, name in enumerate(CHANNELS)
    ),
    detectable={"viscous_friction": Detectable("coefficient", 0.0081, "N m s/rad")},
    recommendations=(Recommendation("straight", "with 0.5 kg on the body it tells rolling resistance from dry friction"),),
    adequacy=ADEQUACY,
    seconds={"intake": 1.2, "calibration": 61.0, "naming": 130.4},
    provenance={"backend": "gibbs_appell"},
)

NOTHING_MISSING = replace(
    EFFECT_FOUND,
    data="twin/none_a",
    verdict="nothing_missing",
    effects=(),
    equivalent=(),
    evidence=tuple(one for one in EFFECT_FOUND.evidence if one.outcome == "rejected at screening"),
    gap=replace(
        GAP, heldout_before=2.31, heldout_calibrated=1.04, heldout_after=1.04, reduction=0.0, reduction_ci95=(0.0, 0.0)
    ),
    detectable={
        "rolling_resistance": Detectable("coefficient", 0.0041, "-"),
        "backlash": Detectable("angle", 0.0087, "rad"),
        "payload": Detectable("mass", 0.061, "kg"),
    },
)

UNKNOWN_EFFECT = replace(
    EFFECT_FOUND,
    data="twin/spring",
    verdict="unknown_effect",
    effects=(
        FoundEffect(
            "unknown_effect", ("leg_lr",),
            {"k": ParameterEstimate(0.81, 0.74, 0.88, "N m/rad"),
             "a0": ParameterEstimate(1.21, 1.17, 1.25, "rad")}, 0.9, 2210.0,
            "-k * (leg_angle - a0)", {"k": "N m/rad", "a0": "rad"}, {"leg_angle_lr": Range(0.9, 2.1, "rad")},
        ),
    ),
    equivalent=(),
)  # fmt: skip

NOT_EXCITED = Analysis(
    data="twin/still",
    verdict="not_excited",
    summary="",
    fit_runs=FIT,
    heldout_runs=HELDOUT,
    calibration=CALIBRATION,
    detectable={"backlash": Detectable("angle", 0.31, "rad")},
    recommendations=(
        Recommendation("turns", "without turns the friction of single wheels stays hidden"),
        Recommendation("posture", "the legs did not move"),
    ),
)

BAD_DATA = Analysis(
    data="twin/broken",
    verdict="bad_data",
    summary="",
    intake=(
        IntakeFinding(
            "run_01", "pos_leg_lf", "units", "pos_leg_lf reaches 87: degrees, not rad? Convert and try again", fatal=True
        ),
        IntakeFinding("", "", "few_runs", "2 runs: at least 4 are needed", fatal=True),
        IntakeFinding("run_02", "volt", "dead", "volt never changes"),
    ),
)

ALL = {one.verdict: one for one in (EFFECT_FOUND, NOTHING_MISSING, UNKNOWN_EFFECT, NOT_EXCITED, BAD_DATA)}
