"""The robot's side of the workflow: what calibration may move, what may be missing, which data are refused."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas
import pytest
from engine_runs import META, ROBOT, posture_and_turns, record, spaced
from gap_examples import EFFECT_FOUND

from wlr_gym.base.errors import InputError
from wlr_gym.cli import main
from wlr_gym.data import Run, read_run
from wlr_gym.data.excitations import excite
from wlr_gym.data.format import CHANNELS, COMMANDS
from wlr_gym.data.record import record_simulation
from wlr_gym.data.replay import replay
from wlr_gym.data.runs import write_run
from wlr_gym.gap.analysis import LEAST_RUNS, ParameterEstimate
from wlr_gym.gap.estimation import FittedModel, level, mean_squares, nominal_model
from wlr_gym.gap.problem import Setting, Unknown
from wlr_gym.gap.report.recommendation import relation_of
from wlr_gym.gap.report.result import read_result, write_result
from wlr_gym.gap.robot.candidates import (
    formula_candidates,
    knobs,
    robot_candidates,
    shown_by,
    wave_frequency,
    wave_order,
    write,
)
from wlr_gym.gap.robot.problem import LOST, WORTH_APART, RobotProblem, open_robot
from wlr_gym.gap.robot.replay import PHYSICS_STEP
from wlr_gym.gap.robot.windows import RunClock
from wlr_gym.gap.selection.hypotheses import within_tolerance
from wlr_gym.gap.validation.held_out import noise_floor
from wlr_gym.gap.workflow import analyse, found_effect
from wlr_gym.physics.effects import (
    EFFECTS,
    UNKNOWN_EFFECT,
    Effect,
    EffectParameter,
    Patch,
    PatchEffect,
    apply_patch,
    load_patch,
)
from wlr_gym.physics.effects.effect import WHEEL_SETS, Search, multiply, steps
from wlr_gym.robot import JOINTS, LEGS, WHEELS, load_robot
from wlr_gym.robot.parameter_table import SPECS, read_tolerances
from wlr_gym.robot.parameters import Parameters

NOMINAL = Parameters.nominal(ROBOT)
KNOBS = {knob.quantity.name: knob for knob in knobs(ROBOT, PHYSICS_STEP)}
RESISTANCE = {"name": "rolling_resistance", "where": list(WHEELS), "parameters": {"coefficient": 0.1}}

# ---- quantities ------------------------------------------------------------------------------------------------------


#: One sigma, relative or in SI units.
RELATIVE = {"body.mass": 0.03, "wheel.radius[wheel_rr]": 0.005, "servo.kp[leg_lf]": 0.05, "servo.stall_torque[wheel_lr]": 0.05}
ABSOLUTE = {
    "servo.viscous_friction[leg_rf]": 0.01,
    "servo.viscous_friction[wheel_rf]": 0.002,
    "joint.zero_offset[leg_lr]": math.radians(0.5),
    "camera.mount_yaw": math.radians(0.5),
    "ground.slope[pitch]": math.radians(0.2),
    "body.com_offset[z]": 0.003,
    "camera.delay": 0.010,
    "command.delay": 0.005,
}


@pytest.mark.parametrize("name", [*RELATIVE, *ABSOLUTE])
def test_tolerances_are_those_of_the_file(name):
    quantity, nominal = KNOBS[name].quantity, float(NOMINAL[KNOBS[name].elements[0]][0])
    assert quantity.nominal == nominal
    assert quantity.sigma == pytest.approx(ABSOLUTE[name] if name in ABSOLUTE else RELATIVE[name] * abs(nominal))


def test_floor_and_latency_are_one_number_for_all():
    assert len(KNOBS["ground.mu"].elements) == 2 * len(WHEELS)
    assert len(KNOBS["command.delay"].elements) == len(JOINTS)
    assert not [name for name in KNOBS if name.startswith(("ground.mu_", "command.delay["))]
    values = np.array([[knob.quantity.nominal for knob in KNOBS.values()]] * 2)
    values[1, list(KNOBS).index("ground.mu")] = 0.31
    table = Parameters(np.repeat(NOMINAL.values, 2, axis=0))
    write(list(KNOBS.values()), values, table)
    assert np.array_equal(table.values[0], NOMINAL.values[0])
    assert (table["ground.mu_x"][1] == 0.31).all()
    assert (table["ground.mu_y"][1] == 0.31).all()
    assert (table["servo.kp"][1] == NOMINAL["servo.kp"][0]).all()


def test_a_floor_that_grips_less_across_stays_one():
    less = ROBOT.model_copy(update={"ground": ROBOT.ground.model_copy(update={"mu_y": 0.5 * ROBOT.ground.mu_x})})
    (floor,) = [knob for knob in knobs(less, PHYSICS_STEP) if knob.quantity.name == "ground.mu"]
    table = Parameters.nominal(less)
    write([floor], np.array([[0.4]]), table)
    assert (table["ground.mu_x"] == 0.4).all()
    assert (table["ground.mu_y"] == 0.2).all()


def test_what_is_known_exactly_does_not_move():
    sure = ROBOT.model_copy(update={"tolerances": {**ROBOT.tolerances, **read_tolerances({"body.mass": 0})}})
    assert {knob.quantity.name for knob in knobs(sure, PHYSICS_STEP)} == KNOBS.keys() - {"body.mass"}


def test_every_tolerance_of_the_file_is_used():
    parameters = {element.partition("[")[0] for knob in KNOBS.values() for element in knob.elements}
    for key in ROBOT.tolerances:
        wanted = {"ground.mu": "ground.mu_x", "joint_zero": "joint.zero_offset"}.get(key, key)
        assert wanted in parameters or key == "leg.inertia", key


def test_ranges_are_a_few_tolerances_within_what_the_simulator_accepts():
    for knob in KNOBS.values():
        quantity, spec = knob.quantity, SPECS[knob.elements[0].partition("[")[0]]
        assert spec.low <= quantity.low <= quantity.nominal <= quantity.high <= spec.high
        assert quantity.low < quantity.high
        assert quantity.sigma > 0.0
        assert quantity.high - quantity.nominal <= 4.01 * quantity.sigma
        assert quantity.unit == spec.unit
    assert KNOBS["command.delay"].quantity.low == 0.0


@pytest.mark.parametrize(
    ("key", "text", "name", "sigma"),
    [
        ("command.delay", "5 ms", "command.delay", 0.005),
        ("body.com_offset", "3 mm", "body.com_offset[x]", 0.003),
        ("servo.kp", "5 %", "servo.kp[wheel_lf]", 0.05 * 8.63),
        ("body.mass", "50 g", "body.mass", 0.05),
        ("servo.coulomb_friction", "20 mN m (legs), 3 mN m (wheels)", "servo.coulomb_friction[wheel_lf]", 3e-3),
    ],
)
def test_tolerances_in_other_units(tmp_path, key, text, name, sigma):
    (tmp_path / "robot.yaml").write_text(f"base: nominal\nname: other\ntolerances: {{{key}: {text!r}}}\n")
    found = {knob.quantity.name: knob.quantity for knob in knobs(load_robot(tmp_path / "robot.yaml"), PHYSICS_STEP)}
    assert found[name].sigma == pytest.approx(sigma, rel=1e-12)


# ---- candidates ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tried():
    """Probes and candidates beside a robot that drove half a metre."""
    rng = np.random.default_rng(0)
    measured = rng.standard_normal((300, len(CHANNELS)))
    measured[:, CHANNELS.index("cam_x")] = np.linspace(0.0, 0.6, 300)
    sigmas = {name: knob.quantity.sigma for name, knob in KNOBS.items()}
    drifting = {name for name, knob in KNOBS.items() if knob.quantity.drifts}
    return robot_candidates(NOMINAL, sigmas, [measured], [measured], [rng.standard_normal(measured.shape)], drifting)


def test_every_effect_of_the_library_is_tried(tried):
    assert {candidate.name for candidate in tried[1]} == {name for name, effect in EFFECTS.items() if effect.search}


def test_components_of_a_vector_are_tried_alone(tried):
    angles = [candidate for candidate in tried[1] if candidate.name == "imu_misalignment"]
    assert [[unknown.name for unknown in one.unknowns] for one in angles] == [
        ["roll", "pitch", "yaw"], ["roll"], ["pitch"], ["yaw"]
    ]  # fmt: skip
    whole, *_, yaw = angles
    assert yaw.starts[0].directions == whole.starts[0].directions[2:]
    assert yaw.starts[0].values(np.array([2.0])) == whole.starts[0].values(np.array([0.0, 0.0, 2.0]))[2:]
    turned = apply_patch(Patch((yaw.effect((0.1,)),)), NOMINAL)  # what is left out is neutral
    assert turned["imu.mount"][0] == pytest.approx(NOMINAL["imu.mount"][0] + np.array([0.0, 0.0, 0.1]))
    centre = [candidate for candidate in tried[1] if candidate.name == "com_offset"]
    assert [len(candidate.tolerances) for candidate in centre] == [3, 1, 1, 1]
    assert [t.quantities for t in centre[2].tolerances if t is not None] == [("body.com_offset[y]",)]
    assert not [candidate for candidate in tried[1] if candidate.name == "payload"][1:]


def test_what_runs_hardly_show_of_an_effect_is_assumed_and_said(tried, tmp_path):
    tread = next(candidate for candidate in tried[1] if candidate.name == "tyre_brush")
    assert [unknown.name for unknown in tread.unknowns] == ["slip_compliance"]
    length = float(NOMINAL["ground.relaxation_length"][0, 0])
    assert tread.effect((0.1,)).parameters == {"slip_compliance": 0.1, "relaxation_length": length}
    fitted = {"slip_compliance": ParameterEstimate(0.1, 0.08, 0.12, "-")}
    effect = found_effect(tread, fitted, 1.0, 50.0)
    result = read_result(write_result(replace(EFFECT_FOUND, effects=(effect,)), tmp_path))
    stated = result.effects[0].parameters["relaxation_length"]
    assert (stated.value, stated.ci95, stated.unit) == (length, None, "m")
    (written,) = load_patch(tmp_path / "patch.yaml").effects
    assert written.parameters == {"slip_compliance": 0.1, "relaxation_length": length}


def test_a_tread_is_sought_beyond_that_of_the_robot_file():
    soft = Parameters.nominal(load_robot({"base": "nominal", "name": "soft", "ground": {"slip_compliance": 0.05}}))
    still = np.zeros((100, len(CHANNELS)))
    probes, candidates = robot_candidates(soft, {}, [still], [still], [still])
    tread = next(candidate for candidate in candidates if candidate.name == "tyre_brush")
    assert tread.unknowns[0].neutral == pytest.approx(0.05)
    (start,) = tread.starts
    assert start.values(np.zeros(1)) == pytest.approx((0.05,))
    (probe,) = (probe.effects[0] for probe in probes if probe.key == start.directions[0][0])
    assert start.values(np.ones(1)) == pytest.approx((probe.parameters["slip_compliance"],))


def test_a_tether_is_anchored_near_and_a_load_carried_within_the_robot(tried):
    """From afar a tether is a constant force, and a load outside the robot a moved centre of mass."""
    tether, load = (next(c for c in tried[1] if c.name == name) for name in ("tether", "payload"))
    assert tether.kept((0.02, -0.02, 0.6)) == pytest.approx((0.02, -0.02, 0.1))
    assert tether.parameters((0.02, -0.02, 0.1)) == pytest.approx({"stiffness": 0.02, "x": -1.0, "y": 5.0})
    assert load.kept((0.5, 0.05, -0.2, 0.1)) == pytest.approx((0.5, 0.05, -0.1, 0.1))


def test_effects_that_meet_a_known_number_know_its_tolerance(tried, good):
    problem = RobotProblem([good])
    nominal = nominal_model(problem)
    names = [quantity.name for quantity in problem.quantities]

    def tolerable(name, place, values, moved=(), tolerances=0.0, count=1):
        chosen = next(c for c in tried[1] if c.name == name and c.where[0] == place and len(c.where) == count)
        quantities = nominal.quantities.copy()
        for k, quantity in enumerate(problem.quantities):
            quantities[k] += tolerances * quantity.sigma * (quantity.name in moved)
        return within_tolerance(FittedModel(problem, quantities).with_effect(chosen, values))

    sigma = {name: problem.quantities[names.index(name)].sigma for name in names}
    radius = sigma["wheel.radius[wheel_lf]"] / ROBOT.wheel.radius
    assert tolerable("wheel_radius_error", "wheel_lf", (1.0 - 2.4 * radius,))
    assert not tolerable("wheel_radius_error", "wheel_lf", (1.0 + 2.6 * radius,))
    # number and effect count together
    assert not tolerable("wheel_radius_error", "wheel_lf", (1.0 + radius,), ["wheel.radius[wheel_lf]"], 2.0)
    assert tolerable("wheel_radius_error", "wheel_lf", (1.0 + 3.0 * radius,), ["wheel.radius[wheel_lf]"], -1.0)
    offset = sigma["body.com_offset[y]"]
    assert tolerable("com_offset", "body", (0.0, 2.4 * offset, 0.0))
    assert not tolerable("com_offset", "body", (0.0, -2.6 * offset, 0.0))
    # the level of the floor takes the place of the number, wherever calibration has moved that
    level = sigma["ground.mu"]
    assert tolerable("friction_level", "ground", (0.6 - 2.4 * level,), ["ground.mu"], -2.5)
    assert not tolerable("friction_level", "ground", (0.6 - 2.6 * level,), ["ground.mu"], -2.5)
    assert not tolerable("backlash", "leg_lf", (1e-6,))
    assert not tolerable("gyro_bias", "sensor", (1e-6, 0.0, 0.0))  # a bias drifts
    # a host's latency is one number for all joints: what only some of them lack is an effect
    latency = sigma["command.delay"]
    assert tolerable("command_delay", "leg_lf", (2.4 * latency,), count=8)
    assert not tolerable("command_delay", "leg_lf", (2.6 * latency,), count=8)
    assert not tolerable("command_delay", "leg_lf", (1e-6,), count=4)
    assert not tolerable("payload", "body", (1e-6, 0.0, 0.0, 0.0))  # any load is one


def test_a_load_is_known_no_better_than_the_body_it_adds_to(tried):
    load = next(c for c in tried[1] if c.name == "payload")
    mass = ROBOT.body.mass
    assert [met.size for met in load.tolerances] == pytest.approx([0.03 * mass, *[0.003 * mass] * 3])
    assert [met.quantities for met in load.tolerances] == [("body.mass",), *((f"body.com_offset[{axis}]",) for axis in "xyz")]


def test_places_are_places_of_the_effect(tried):
    for candidate in tried[1]:
        assert candidate.where
        load_patch([candidate.effect(neutral_values(candidate)).content()])
    labels = [(candidate.label, *(unknown.name for unknown in candidate.unknowns)) for candidate in tried[1]]
    assert len(labels) == len(set(labels))
    for name in ("coulomb_friction", "weak_motor", "backlash"):
        wheres = [c.where for c in tried[1] if c.name == name]
        for single in (*LEGS, *WHEELS):
            assert (single,) in wheres
        for whole in (LEGS, WHEELS):
            assert tuple(whole) in wheres


def neutral_values(candidate):
    return [float(np.clip(u.neutral, u.low, u.high)) for u in candidate.unknowns]


def test_probe_keys_are_unique_and_known_to_the_starts(tried):
    probes, candidates = tried
    keys = [probe.key for probe in probes]
    assert len(keys) == len(set(keys))
    for candidate in candidates:
        for start in candidate.starts:
            for name in (name for direction in start.directions for name in direction):
                assert name in keys or name in KNOBS, name


def test_probes_are_effects_the_simulator_takes(tried):
    for probe in tried[0]:
        changed = apply_patch(Patch(probe.effects), NOMINAL)
        assert np.isfinite(changed.values).all()
        assert not np.array_equal(changed.values, NOMINAL.values), probe.key


def test_starts_give_plausible_effects(tried):
    """Small amplitudes of either sign: some first guess of every candidate lies in its range and is an effect."""
    for candidate in tried[1]:
        inside = 0
        for start in candidate.starts:
            for sign in (1.0, -1.0):
                values = start.values(sign * 0.3 * np.ones(len(start.directions)))
                assert len(values) == len(candidate.unknowns)
                assert np.isfinite(values).all()
                if all(u.low <= v <= u.high for u, v in zip(candidate.unknowns, values, strict=True)):
                    inside += 1
                    load_patch([candidate.effect(values).content()])
        assert inside, candidate.label


def test_one_probe_is_its_own_best_guess(tried):
    """Amplitude 1 of a one-way start is the probe itself."""
    probes = {probe.key: probe.effects[0] for probe in tried[0]}
    checked = 0
    for candidate in tried[1]:
        for start in candidate.starts:
            if len(start.directions) == 1 and len(candidate.where) == 1 and len(start.directions[0]) == 1:
                key = start.directions[0][0]
                if key in probes and probes[key].name == candidate.name:
                    guess = candidate.effect(start.values(np.ones(1))).parameters
                    for name, value in probes[key].parameters.items():
                        left_out = EFFECTS[candidate.name].parameters[name].neutral
                        assert guess.get(name, left_out) == pytest.approx(value), candidate.label
                    checked += 1
    assert checked > 40


def test_one_tolerance_of_a_number_is_its_effect(tried):
    """Where a start goes by a quantity, amplitude 1 must change the model by one tolerance of it."""
    checked = 0
    for candidate in tried[1]:
        for start in candidate.starts:
            names = [name for direction in start.directions for name in direction]
            if len(start.directions) != 1 or not all(name in KNOBS for name in names):
                continue
            patched = apply_patch(Patch((candidate.effect(start.values(np.ones(1))),)), NOMINAL)
            for name in names:
                for element in KNOBS[name].elements:
                    change = float(patched[element][0] - NOMINAL[element][0])
                    assert change == pytest.approx(KNOBS[name].quantity.sigma, rel=1e-6), (candidate.label, name)
                    checked += 1
    assert checked > 30


def test_ripple_is_looked_for_at_its_own_order():
    angle, rng = np.linspace(0, 40, 800), np.random.default_rng(1)
    measured, residual = np.zeros((2, 800, len(CHANNELS)))
    measured[:, CHANNELS.index("pos_wheel_lf")] = angle
    residual[:, CHANNELS.index("eff_wheel_lf")] = np.sin(12 * angle + 0.7) + 0.5 * rng.standard_normal(800)
    residual[rng.random(800) < 0.2] = np.nan
    assert wave_order("wheel_lf", [measured], [residual]) == 12.0
    swing, bend = np.zeros((2, 800, len(CHANNELS)))
    swing[:, CHANNELS.index("pos_leg_lf")] = 1.0 + 0.4 * np.sin(angle)
    bend[:, CHANNELS.index("eff_leg_lf")] = np.sin(swing[:, CHANNELS.index("pos_leg_lf")])  # one period per turn: any bend
    order = wave_order("leg_lf", [swing], [bend])
    assert order is not None
    assert order >= 1.5 * 2 * np.pi / 0.8
    assert wave_order("leg_rf", [swing], [bend]) is None  # it stood still


def test_patch_of_floor_needs_a_floor_that_was_driven():
    still = np.zeros((100, len(CHANNELS)))
    sigmas = {name: knob.quantity.sigma for name, knob in KNOBS.items()}

    def names(measured, simulated):
        return {candidate.name for candidate in robot_candidates(NOMINAL, sigmas, [measured], [simulated], [still])[1]}

    assert "friction_patch" not in names(still, still)
    drove, blind = still.copy(), still.copy()
    drove[:, CHANNELS.index("cam_x")] = np.linspace(0.0, 0.6, 100)
    blind[:, CHANNELS.index("cam_x")] = np.nan
    assert "friction_patch" in names(blind, drove)  # without a camera the model says where it was
    assert "friction_patch" not in names(blind, np.full_like(still, np.nan))  # a simulation may break down


def test_an_effect_registered_in_one_place_is_all_that_it_takes(monkeypatch, capsys):
    """It acts, is documented, and is looked for with its places, tolerance-free probes, relation and motion."""
    hot = Effect(
        "hot_winding",
        "a hot motor: its winding's resistance is higher",
        "stall torque = scale x nominal",
        JOINTS,
        {"scale": EffectParameter("-", "cold over hot resistance", 0.2, 1.0, 1.0, (0.6, 1.0), 0.7)},
        multiply("servo.stall_torque", "scale"),
        "scale",
        Search("winding of the {}", "rear_legs", WHEEL_SETS, steps("scale", -0.1, neutral=1.0)),
    )
    monkeypatch.setitem(EFFECTS, hot.name, hot)
    moved = np.zeros((100, len(CHANNELS)))
    probes, candidates = robot_candidates(NOMINAL, {}, [moved], [moved], [moved])
    found = [candidate for candidate in candidates if candidate.name == hot.name]
    assert tuple(candidate.where for candidate in found) == WHEEL_SETS
    assert found[0].unknowns == (Unknown("scale", "-", 1.0, 0.6, 1.0, 0.05 * (1.0 - 0.6), least=0.2, most=1.0),)  # its bounds
    assert [len(start.directions[0]) for candidate in (found[0], found[-1]) for start in candidate.starts] == [1, 4]
    assert [dict(probe.effects[0].parameters) for probe in probes if probe.effects[0].name == hot.name] == [{"scale": 0.9}] * 4
    (patched,) = apply_patch(load_patch([found[0].effect((0.8,)).content()]), NOMINAL)["servo.stall_torque[wheel_lf]"]
    assert patched == pytest.approx(0.8 * NOMINAL["servo.stall_torque[wheel_lf]"][0])
    assert relation_of(found[0]) == "winding of the left front wheel"
    assert shown_by()[hot.name] == "rear_legs"
    assert main(["effects"]) == main(["effects", hot.name]) == 0
    assert capsys.readouterr().out.count(hot.name) == 2


# ---- formulas --------------------------------------------------------------------------------------------------------


def formulas_with_waves():
    return formula_candidates([np.linspace(0.0, 10.0, 500)], [np.ones((500, len(CHANNELS)))])


def test_formulas_parse_and_vanish_with_their_constants():
    probes, candidates = formulas_with_waves()
    assert {candidate.name for candidate in candidates} == {UNKNOWN_EFFECT}
    state = {"angle": 0.7, "rate": -1.3, "wind_up": 0.4, "time": 3.7}
    state |= {"abs": abs, "cos": math.cos, "sin": math.sin, "tanh": math.tanh}
    state |= {f"{kind}_torque{which}": 0.4 for kind in ("leg", "wheel") for which in ("", "_opposite")}
    state |= {f"wheel_angle_{side}": 0.3 for side in ("lf", "rf", "lr", "rr")}
    state |= {"velocity_x": 0.4, "velocity_y": -0.1, "yaw_rate": 0.8}
    state |= {f"{kind}_rate_{side}": 0.5 for kind in ("leg", "wheel") for side in ("lf", "rf", "lr", "rr")}
    for candidate in candidates:
        patch = load_patch([candidate.effect([0.1] * len(candidate.unknowns)).content()])
        assert len(patch.forces) == 1
        sizes = [unknown for unknown in candidate.unknowns if unknown.is_size]
        constants = {unknown.name: unknown.neutral for unknown in candidate.unknowns} | dict(candidate.fixed)
        assert set(candidate.units) == set(constants)
        assert eval(candidate.formula, {}, {**state, **constants}) == pytest.approx(0.0)
        for unknown in sizes:  # linear in each constant
            one, two = (eval(candidate.formula, {}, {**state, **constants, unknown.name: size}) for size in (1.0, 2.0))
            assert two == pytest.approx(2 * one)
            assert abs(one) > 0.0
            assert (unknown.low, unknown.neutral) == (-unknown.high, 0.0)
    assert len({probe.key for probe in probes}) == len(probes) == sum(u.is_size for c in candidates for u in c.unknowns)


def test_every_formula_that_is_found_can_be_written_and_loaded(tmp_path):
    for k, candidate in enumerate(formulas_with_waves()[1]):
        values = candidate.effect([0.1] * len(candidate.unknowns)).parameters
        fitted = {u.name: ParameterEstimate(values[u.name], 0.0, 0.2, u.unit) for u in candidate.unknowns}
        done = replace(EFFECT_FOUND, effects=(found_effect(candidate, fitted, 1.0, 50.0),))
        folder = tmp_path / str(k)
        folder.mkdir()
        write_result(done, folder)
        (loaded,) = load_patch(folder / "patch.yaml").effects
        assert loaded == candidate.effect([values[u.name] for u in candidate.unknowns])


def test_a_wave_that_all_runs_share_is_found_beside_larger_ones_that_differ():
    rng = np.random.default_rng(4)
    column = CHANNELS.index("eff_wheel_lf")
    times = [np.arange(0.0, length, 0.02) for length in (12.0, 17.0, 24.0, 15.0)]
    residuals = []
    for k, t in enumerate(times):
        left = np.full((len(t), len(CHANNELS)), np.nan)
        slow = np.cumsum(rng.standard_normal(len(t)))  # what any model lacks: most at low frequencies
        left[:, column] = 0.1 * slow + 3.0 * np.sin(2 * np.pi * (0.3 + 0.2 * k) * t) + 1.0 * np.sin(2 * np.pi * 0.87 * t + 2.0)
        residuals.append(left)
    assert wave_frequency(times, residuals) == pytest.approx(0.87, abs=0.02)


# ---- opening a folder ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def good():
    return record(posture_and_turns, spaced(4.0), noise=3)


def folder_of(path, run, count=3, change=None):
    for k in range(count):
        table = run.table.copy()
        if change is not None:
            table = change(table, k)
        write_run(path / f"run_{k + 1:02d}.csv", table, META)
    return path


def kinds(found):
    return {(f.run, f.kind) for f in found if f.fatal}


def test_good_folder_opens(tmp_path, good):
    problem, findings = open_robot(folder_of(tmp_path, good))
    assert isinstance(problem, RobotProblem)
    assert problem.runs == ("run_01", "run_02", "run_03")
    assert kinds(findings) == set()
    assert [s.name for s in problem.signals] == list(CHANNELS)


def test_too_few_runs(tmp_path, good):
    problem, findings = open_robot(folder_of(tmp_path, good, LEAST_RUNS - 1))
    assert problem is None
    assert ("", "few_runs") in kinds(findings)
    assert "wlr record" in findings[-1].said


def test_short_run_is_left_out(tmp_path, good):
    def cut(table, k):
        return table[:100] if k == 1 else table

    problem, findings = open_robot(folder_of(tmp_path, good, 4, cut))
    assert problem is not None
    assert problem.runs == ("run_01", "run_03", "run_04")
    assert kinds(findings) == {("run_02", "short")}


TURN = 2 * np.pi


def mirrored(joint):
    def turn(table):
        angle = table[f"pos_{joint}"]
        return table.assign(**{f"pos_{joint}": 2.0 * angle.iloc[0] - angle, f"vel_{joint}": -table[f"vel_{joint}"]})

    return turn


@pytest.mark.parametrize(
    ("kind", "channel", "change", "words"),
    [
        ("dead", "pos_leg_rf", lambda table: table.assign(pos_leg_rf=table["pos_leg_rf"].iloc[0]), "dead encoder"),
        ("mirrored", "pos_leg_lr", mirrored("leg_lr"), "check the sign"),
        ("mirrored", "pos_wheel_rf", mirrored("wheel_rf"), "check the sign"),
        ("mirrored", "eff_leg_rr", lambda table: table.assign(eff_leg_rr=-table["eff_leg_rr"]), "turn the sign"),
        ("mirrored", "acc_z", lambda table: table.assign(acc_z=-table["acc_z"]), "check its mounting"),
        ("wrap", "pos_wheel_rf", lambda table: table.assign(pos_wheel_rf=(table["pos_wheel_rf"] + 3.0) % TURN), "numpy.unwrap"),
        ("missing", "cmd", lambda table: table.assign(**dict.fromkeys(COMMANDS, np.nan)), "nothing to replay"),
    ],
)
def test_what_is_wrong_in_every_run_is_named_with_its_channel_and_remedy(tmp_path, good, kind, channel, change, words):
    problem, findings = open_robot(folder_of(tmp_path, good, 3, lambda table, k: change(table)))
    assert problem is None
    assert {("run_01", kind), ("", "few_runs")} <= kinds(findings)
    found = [f for f in findings if f.kind == kind]
    assert [f.channel for f in found] == [channel] * 3
    assert words in found[0].said


def test_dead_encoder_in_runs_that_do_not_ask_it_to_move(tmp_path, good):
    def die(table, k):
        held = {} if k == 0 else {"cmd_leg_rf": table["cmd_leg_rf"].iloc[0]}
        return table.assign(pos_leg_rf=table["pos_leg_rf"].iloc[0], vel_leg_rf=0.0, **held)

    problem, findings = open_robot(folder_of(tmp_path, good, 4, die))
    assert problem is None
    assert {(f"run_0{k}", "dead") for k in range(1, 5)} <= kinds(findings)


@pytest.mark.parametrize("rate", ["vel_wheel_lr", "gyro_z"])
def test_a_rate_against_its_angle(tmp_path, good, rate):
    def turning(table, k):  # half a radian to and fro, seen by the camera where it sees anything
        yaw = 0.5 * np.sin(2.0 * table["t"])
        return table.assign(cam_yaw=yaw.where(table["cam_yaw"].notna()), gyro_z=np.cos(2.0 * table["t"]))

    def turned_round(table, k):  # the same about a heading of pi, told within a turn
        return turning(table, k).assign(cam_yaw=lambda told: (told["cam_yaw"] + 2 * np.pi) % (2 * np.pi) - np.pi)

    assert kinds(open_robot(folder_of(tmp_path / "right", good, 3, turning))[1]) == set()
    assert kinds(open_robot(folder_of(tmp_path / "round", good, 3, turned_round))[1]) == set()
    flipped = folder_of(
        tmp_path / "wrong", good, 3, lambda table, k: turning(table, k).assign(**{rate: -turning(table, k)[rate]})
    )
    problem, findings = open_robot(flipped)
    assert problem is None
    assert [f.channel for f in findings if f.kind == "mirrored"] == [rate] * 3


def test_a_robot_asked_for_is_used_and_a_sensor_without_noise_is_refused(tmp_path, good):
    folder, heavy = folder_of(tmp_path / "runs", good), tmp_path / "heavy.yaml"
    heavy.write_text("base: nominal\nname: heavy\nbody: {mass: 2.0}\n", encoding="utf-8")
    problem, _ = open_robot(folder, robot=heavy)
    assert problem is not None
    assert (problem.robot.name, problem.robot.body.mass) == ("heavy", 2.0)
    heavy.write_text("base: nominal\nname: deaf\nsensors: {camera: {position_noise: 0}}\n", encoding="utf-8")
    with pytest.raises(InputError, match="robot 'deaf': sensors: 'cam_x' has no noise"):
        open_robot(folder, robot=heavy)


def in_degrees(table):
    angles = [f"{kind}_{leg}" for kind in ("pos", "cmd") for leg in LEGS]
    return table.assign(**{name: table[name] * 180 / math.pi for name in angles})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (in_degrees, r"run_02.*degrees"),
        (
            lambda table: table.assign(pos_wheel_lf=table["pos_wheel_lf"].where(table.index != 7)),
            r"run_02.*row 7.*pos_wheel_lf",
        ),
        (lambda table: table.iloc[[*range(20), 21, 20, *range(22, len(table))]], r"run_02.*t must increase"),
    ],
)
def test_what_is_no_run_is_refused(tmp_path, good, change, words):
    folder = folder_of(tmp_path, good)
    change(pandas.read_csv(folder / "run_02.csv")).to_csv(folder / "run_02.csv", index=False)
    with pytest.raises(InputError, match=words):
        open_robot(folder)


def test_runs_of_different_profiles_are_refused(good):
    other = Run(
        good.table, META.model_copy(update={"profile": META.profile.model_copy(update={"leg_velocity": 9.0})}), Path("x")
    )
    with pytest.raises(InputError, match="different servo profiles"):
        RobotProblem([good, other])


@pytest.mark.slow
def test_sensors_that_say_nothing_leave_finite_residuals(good):
    table = good.table.copy()
    table[["gyro_x", "eff_wheel_lf", "volt"]] = np.nan
    table.loc[50:90, ["acc_x", "cam_x"]] = np.nan
    problem = RobotProblem([Run(table.drop(columns=["vel_leg_lf"]), META, Path("run_01.parquet"))] * 1)
    residual = problem.residuals([nominal_model(problem).setting], [0])[0][0]
    quiet = [CHANNELS.index(name) for name in ("gyro_x", "eff_wheel_lf", "volt", "vel_leg_lf")]
    assert np.isnan(residual[:, quiet]).all()
    others = np.sqrt(np.nanmean(np.delete(residual, quiet, axis=1) ** 2, axis=0))
    assert others.max() < 3.0


def test_motions_that_show_a_camera_are_for_robots_with_one(good):
    blind = replace(good, table=good.table.drop(columns=[name for name in good.table if name.startswith("cam_")]))
    named = {name for name in RobotProblem([good]).motions if name.startswith("camera_")}
    assert named
    assert set(RobotProblem([good]).motions) - set(RobotProblem([blind]).motions) == named


def test_where_no_camera_saw_it_a_window_starts_from_the_simulation(good):
    """The last frame half a second away tells nothing of a heading: a parabola through noise would."""
    table = good.table.copy()
    hidden = (table["t"] > 1.2) & (table["t"] < 2.8)
    table.loc[hidden, [name for name in table if name.startswith("cam_")]] = np.nan
    clock = RunClock(Run(table, META, Path("run_01.csv")))
    assert np.isnan(clock.anchors.pose[0]).all()
    assert np.isfinite(RunClock(good).anchors.pose).all()


def test_a_hole_in_the_log_starts_no_window(good):
    table = good.table[(good.table["t"] < 0.5) | (good.table["t"] > 3.5)].reset_index(drop=True)
    clock = RunClock(Run(table, META, Path("run_01.csv")), window=0.5)
    assert all(window.stop > window.start for window in clock.windows)
    assert len(set(clock.anchors.tick.tolist())) == len(clock.windows) - 1


# ---- the problem -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_known_effects_and_formulas_are_part_of_the_model(good):
    problem = RobotProblem([good], known=[RESISTANCE])
    plain = RobotProblem([good])
    setting = nominal_model(plain).setting
    added = replace(setting, effects=load_patch([RESISTANCE]).effects)
    assert np.array_equal(problem.residuals([setting], [0])[0], plain.residuals([added], [0])[0], equal_nan=True)
    _, formulas = formula_candidates()
    drag = next(c for c in formulas if c.where == ("body_force_x",)).effect([5.0])
    settings = [setting, Setting(setting.quantities, (drag,)), added]
    mixed = plain.residuals(settings, [0])[0]
    assert mixed[0] == pytest.approx(plain.residuals([setting], [0])[0][0], abs=1e-3, nan_ok=True)
    assert np.nanmax(np.abs(mixed[1] - mixed[0])) > 1.0
    assert np.nanmax(np.abs(mixed[2] - mixed[0])) > 1.0


@pytest.mark.slow  # compiles the engine with all effects and formulas
def test_company_does_not_change_a_bit(good):
    """Alone, beside others like it, and beside effects for which another kernel is needed."""
    problem = RobotProblem([good])
    plain = nominal_model(problem).setting
    weak = PatchEffect("slip_weakening", ("ground",), {"mu_k": 0.4, "slip_speed": 0.05})
    special = [replace(plain, effects=(effect,)) for effect in (*load_patch([RESISTANCE]).effects, weak)]
    alone = [problem.residuals([setting], [0])[0][0] for setting in (plain, *special)]
    assert len({residual.tobytes() for residual in alone}) == 3
    for many in (1, WORTH_APART):
        among = problem.residuals([special[0], *[plain] * many, special[1]], [0])[0]
        assert np.array_equal(among[0], alone[1], equal_nan=True)
        assert np.array_equal(among[1], alone[0], equal_nan=True)
        assert np.array_equal(among[many], alone[0], equal_nan=True)
        assert np.array_equal(among[-1], alone[2], equal_nan=True)


@pytest.mark.slow
def test_a_formula_that_is_known_and_tried_again_is_two_forces(good):
    """Frequencies do not add up, and constants go by their names, in whatever order a file has them."""
    units = {"a": "N", "b": "N", "w": "rad/s"}
    law, where = "a * sin(w * time) + b * cos(w * time)", ("floor_force_x",)
    known = PatchEffect(UNKNOWN_EFFECT, where, {"w": 6.0, "b": 0.5, "a": 3.0}, law, units)
    nothing = PatchEffect(UNKNOWN_EFFECT, where, {"a": 0.0, "b": 0.0, "w": 9.0}, law, units)
    problem = RobotProblem([good], known=[known.content()])
    setting = nominal_model(problem).setting
    alone = problem.residuals([setting], [0])[0][0]
    beside = problem.residuals([setting, replace(setting, effects=(nothing,))], [0])[0]
    assert beside[0] == pytest.approx(alone, abs=1e-3, nan_ok=True)
    assert beside[1] == pytest.approx(alone, abs=1e-3, nan_ok=True)
    plain = RobotProblem([good]).residuals([setting], [0])[0][0]
    assert np.nanmax(np.abs(plain - alone)) > 1.0


@pytest.mark.slow
def test_time_of_a_formula_is_that_of_the_run_however_it_is_replayed(tmp_path):
    """Recorded by the command's own code, replayed in segments and in the gap workflow's windows; 0.5 s off is another law."""

    def push(late):
        law = "a * sin(w * time + p)"
        numbers, units = {"a": 5.0, "w": 3.0, "p": 3.0 * late}, {"a": "N", "w": "rad/s", "p": "rad"}
        return {"name": UNKNOWN_EFFECT, "where": ["floor_force_x"], "formula": law, "parameters": numbers, "units": units}

    motion = excite("straight", 0, seconds=6.0)
    run = read_run(record_simulation(tmp_path / "run_01.parquet", motion, ROBOT, "gibbs_appell", 0, load_patch([push(0.0)])))
    errors = []
    for late in (0.0, 0.5):
        problem = RobotProblem([run], known=[push(late)])
        whole = replay(run, effects=[push(late)]).errors["eff_wheel_lf"].as_dict()["segment_in_noise_units"]
        errors.append((level(mean_squares([problem.residuals([nominal_model(problem).setting], [0])[0][0]], 50.0)), whole))
    assert max(errors[0]) < 1.6
    assert min(errors[1]) > 3.0


@pytest.mark.slow
def test_floor_is_what_a_perfect_model_reaches(good):
    problem = RobotProblem([good])
    setting = nominal_model(problem).setting
    floor = noise_floor(nominal_model(problem), [0])
    assert 0.9 < floor < 1.25
    first, second = problem.remade(setting, [0], 2)
    assert level(mean_squares(first, problem.cap)) == floor  # however many are made
    assert level(mean_squares(second, problem.cap)) == pytest.approx(floor, rel=0.1)
    assert not np.array_equal(first[0], second[0], equal_nan=True)
    _, again = RobotProblem([good], threads=2).remade(setting, [0], 2)
    assert np.array_equal(again[0], second[0], equal_nan=True)
    assert np.array_equal(np.isnan(first[0]), np.isnan(problem.residuals([setting], [0])[0][0]))


def test_features_are_rows_of_the_run(good):
    problem = RobotProblem([good])
    features = problem.features(nominal_model(problem).setting, [0])[0]
    assert {"joint_velocity[wheel_lf]", "slip_speed[wheel_rr]", "time_since_reversal[leg_lf]"} <= set(features)
    assert all(len(values) == len(good["t"]) and np.isfinite(values).all() for values in features.values())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameter", "size"), [("rolling_resistance", "coefficient", 0.1), ("tyre_brush", "slip_compliance", 0.15)]
)
def test_an_effect_of_the_wheels_is_found_in_four_runs(tmp_path, name, parameter, size):
    hidden = {"name": name, "where": list(WHEELS), "parameters": {parameter: size}}
    for k, kind in enumerate(("straight", "turns", "stop_and_go", "s_curve")):
        motion = excite(kind, k, seconds=6.0)
        meta = META.model_copy(update={"profile": motion.profile})

        def commands(t, setpoints=motion.setpoints):
            return setpoints[min(round(t / 0.02), len(setpoints) - 1)]

        run = record(commands, spaced(5.9), [hidden], meta=meta, noise=k)
        write_run(tmp_path / f"run_{k + 1:02d}.csv", run.table, meta)
    found = analyse(tmp_path)
    assert found.verdict == "effect_found"
    assert found.effects[0].name == name
    assert found.effects[0].where == tuple(WHEELS)
    value = found.effects[0].parameters[parameter]
    assert value.value == pytest.approx(size, rel=0.2)
    assert value.low < size < value.high
    assert found.gap is not None
    assert found.gap.reduction > 0.5


@pytest.mark.slow
def test_what_a_robot_cannot_have_beside_its_effects_is_not_tried(good):
    """A joint has one Stribeck speed: where one is found, or given as known, another is no candidate."""
    problem = RobotProblem([good])
    wheels = PatchEffect("stribeck_friction", ("wheel_lf", "wheel_rf"), {"extra_static_torque": 0.1, "stribeck_speed": 0.5})
    setting = nominal_model(problem).setting
    found = replace(setting, effects=(wheels,))
    residuals = [np.zeros_like(problem.measured(0))]
    probes, candidates = problem.candidates(found, residuals, [0])
    left = places_tried(candidates, "stribeck_friction")
    assert not {("wheel_lf",), ("wheel_rf",), ("wheel_lf", "wheel_lr")} & left
    assert {("wheel_lr",), ("leg_lf",), ("leg_lf", "leg_rf")} <= left
    assert {candidate.name for candidate in candidates} == {c.name for c in problem.candidates(setting, residuals, [0])[1]}
    problem.parameters([replace(found, effects=(wheels, *probe.effects)) for probe in probes])
    probed = replace(
        wheels, parameters={"extra_static_torque": 0.1, "stribeck_speed": 0.1}
    )  # as a probe's: no fit could move it
    given = RobotProblem([good], known=Patch((probed,)))
    assert ("wheel_lf",) not in places_tried(given.candidates(setting, residuals, [0])[1], "stribeck_friction")


def test_where_a_formula_was_tried(good):
    problem = RobotProblem([good])
    setting = nominal_model(problem).setting

    def reach(where, formula, units):
        return problem.reach(PatchEffect(UNKNOWN_EFFECT, where, dict.fromkeys(units, 0.1), formula, units), setting, [0])

    spring = reach(("leg_lr",), "c - k * angle", {"c": "N m", "k": "N m/rad"})
    angles = good["pos_leg_lr"]
    assert list(spring) == ["angle_leg_lr"]
    assert (spring["angle_leg_lr"].low, spring["angle_leg_lr"].high) == pytest.approx((angles.min(), angles.max()), abs=0.02)
    assert spring["angle_leg_lr"].unit == "rad"
    drag = reach(("body_force_x",), "-d * velocity_x * abs(yaw_rate)", {"d": "N s2/m/rad"})
    assert set(drag) == {"velocity_x", "yaw_rate"}
    gyro = good["gyro_z"]
    assert (drag["yaw_rate"].low, drag["yaw_rate"].high) == pytest.approx((gyro.min(), gyro.max()), abs=0.05)
    wave = reach(("floor_force_x",), "a * sin(w * time)", {"a": "N", "w": "rad/s"})
    assert wave["time"].high == pytest.approx(good["t"][-1] - good["t"][0])
    both = reach(("wheel_lf", "wheel_rf"), "-r * wheel_torque_opposite", {"r": "-"})
    assert set(both) == {"wheel_torque_opposite_lf", "wheel_torque_opposite_rf"}


def places_tried(candidates, name):
    return {candidate.where for candidate in candidates if candidate.name == name}


@pytest.mark.slow  # compiles the engine with all effects and formulas
def test_a_simulation_that_breaks_down_is_far_from_the_data_and_harms_no_other():
    """A force that blows the robot up (a drag that pushes, and grows with its cube) is a bad hypothesis, not an error."""
    run = record(posture_and_turns, spaced(5.0))
    problem = RobotProblem([run], ROBOT)
    model = nominal_model(problem).setting
    units = {"d": "N m s3/rad3"}
    wild = PatchEffect(UNKNOWN_EFFECT, ("body_torque_yaw",), {"d": -1e6}, "-d * yaw_rate * yaw_rate * yaw_rate", units)
    calm = replace(wild, parameters={"d": 0.1})
    alone = problem.residuals([replace(model, effects=(calm,))], [0])[0]
    both = problem.residuals([replace(model, effects=(wild,)), replace(model, effects=(calm,))], [0])[0]
    assert np.array_equal(both[1], alone[0], equal_nan=True)
    measured = np.isfinite(alone[0])
    assert np.array_equal(np.isfinite(both[0]), measured)
    assert (both[0][measured] == LOST).all()
