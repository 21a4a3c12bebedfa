"""The servo with its pendulum: its law against closed forms, recordings, and the workflow on benches and a real servo."""

import dataclasses
import itertools
import json
import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike
from rig_bench import Bench, contents, write
from rig_fits import best_fit, nominal, position_errors

from wlr_gym.base.errors import InputError
from wlr_gym.gap.analysis import Analysis, FoundEffect, ParameterEstimate
from wlr_gym.gap.estimation import fit, nominal_model
from wlr_gym.gap.problem import Setting
from wlr_gym.gap.report.result import patch_of
from wlr_gym.gap.rig import pendulum
from wlr_gym.gap.rig.pendulum import (
    ENCODER_NOISE,
    GOAL_LEAD,
    JOINT,
    NO_TORQUE_LIMIT,
    QUANTITIES,
    RIG_EFFECTS,
    PendulumProblem,
    Replay,
    model_of,
    open_pendulum,
    pack,
)
from wlr_gym.gap.rig.pendulum_recordings import Recording, findings, read_recording, read_recordings
from wlr_gym.gap.rig.problem import LOST, law_candidates, smoothed_state
from wlr_gym.gap.selection.search import search_effects
from wlr_gym.gap.validation.data_split import named_split
from wlr_gym.gap.workflow import analyse, known_patch
from wlr_gym.physics.effects import Patch, PatchEffect, save_patch
from wlr_gym.physics.plants.drive import TEETH_DAMPING, fitted_weight
from wlr_gym.physics.servo import motor_constants, motor_torque

K, R = motor_constants(0.52, 10.8, 5.0)
STEP = 1e-3
NEUTRAL = {
    "volt_gain": K / R, "back_emf_damping": K * K / R, "inverse_constant": 1.0 / K, "viscous": 0.0, "weight": 0.5,
    "stribeck_torque": 0.0, "inverse_stribeck_speed": 1.0, "ripple_amplitude": 0.0, "ripple_order": 1.0, "ripple_phase": 0.0,
    "half_play": 0.0, "rotor_inertia": 0.001, "teeth_stiffness": 50.0, "teeth_damping": TEETH_DAMPING * math.sqrt(50 * 0.001),
    "gain": 1e6, "zero": 0.0, "gravity": 0.48, "inertia": 0.006, "coulomb": 0.0, "torque_scale": 1.0, "load_friction": 0.0,
    "saturation": 0.0, "torque_limit": 10.0, "quadratic_friction": 0.0, "thermal": 0.0,
}  # fmt: skip
FREE = {"gravity": 0.0}
ANGLE, RATE, VOLTAGE, TORQUE, FRICTION = range(5)


def run(seconds, angle=0.0, rate=0.0, goal: ArrayLike = 0.0, supply=7.4, on=1.0, warmth=0.0, lag=0.0, step=STEP, **changes):
    """Simulate one model; the default gain makes the servo put the whole supply on its motor, towards ``goal``."""
    count = round(seconds / step)
    parameters = NEUTRAL | changes
    moved = parameters["rotor_inertia"] if parameters["half_play"] else parameters["inertia"]
    damping = parameters["back_emf_damping"] * parameters["torque_scale"] + parameters["viscous"]
    parameters["weight"] = float(fitted_weight(np.array(step * damping / moved)))
    setpoints = np.broadcast_to(np.asarray(goal, float), (count,)).copy()
    inputs = np.stack([np.broadcast_to(np.asarray(v, float), (count,)) for v in (supply, on, warmth)], axis=1)
    starts = np.full(count, -1)
    starts[0] = 0
    row = np.array([[parameters[name] for name in pendulum.PARAMETERS]])
    return pendulum.simulate(row, np.array([lag]), setpoints, inputs, starts, np.array([[angle, rate]]), step)[0]


# --- pendulum


def test_small_swings_have_the_pendulums_period():
    found = run(5.0, angle=0.01, on=0.0)
    time = np.arange(len(found)) * STEP
    omega = math.sqrt(0.48 / 0.006)
    np.testing.assert_allclose(found[:, ANGLE], 0.01 * np.cos(omega * time), atol=0.01 * 2e-3)


def test_large_swings_keep_their_energy_and_gain_none():
    def energy(found):
        return 0.5 * 0.006 * found[:, RATE] ** 2 - 0.48 * np.cos(found[:, ANGLE])

    errors = []
    for step in (2e-3, 1e-3):
        e = energy(run(20.0, angle=2.5, on=0.0, step=step))
        errors.append(np.ptp(e))
        assert abs(e[-1000:].mean() - e[:1000].mean()) < 1e-4
    assert errors[1] < 0.3 * errors[0]


def test_viscous_friction_alone_decays_exactly_at_any_step():
    for step in (1e-3, 2e-2):
        found = run(1.0, rate=3.0, on=0.0, viscous=0.05, back_emf_damping=0.0, step=step, **FREE)
        time = np.arange(len(found)) * step
        np.testing.assert_allclose(found[:, RATE], 3.0 * np.exp(-time * 0.05 / 0.006), rtol=1e-9)


def test_dry_friction_holds_the_pendulum_without_creep_up_to_its_bound():
    angle = 0.5
    load = 0.48 * math.sin(angle)
    held = run(3.0, angle=angle, on=0.0, coulomb=1.001 * load)
    assert (held[:, RATE] == 0.0).all()
    assert (held[:, ANGLE] == angle).all()
    np.testing.assert_allclose(held[:, FRICTION], load, rtol=1e-12)
    assert abs(run(3.0, angle=angle, on=0.0, coulomb=0.999 * load)[:, RATE]).max() > 1e-3


def test_dry_friction_stops_a_free_wheel_after_the_work_it_can_do():
    found = run(1.0, rate=4.0, on=0.0, coulomb=0.05, **FREE)
    assert found[-1, RATE] == 0.0
    assert found[-1, ANGLE] == pytest.approx(0.5 * 0.006 * 16 / 0.05, rel=1e-3)


# --- motor


def test_step_of_voltage_gives_the_motors_exponential():
    found = run(1.0, goal=1e3, supply=6.0, **FREE)
    time = np.arange(len(found)) * STEP
    np.testing.assert_allclose(found[:, RATE], 6.0 / K * (1.0 - np.exp(-time * K * K / R / 0.006)), rtol=1e-9, atol=1e-12)


def test_motor_torque_is_that_of_servo_py():
    found = run(0.3, goal=1e3, supply=6.0, **FREE)
    middle = 0.5 * (found[1:, RATE] + found[:-1, RATE])
    np.testing.assert_allclose(found[:-1, TORQUE], motor_torque(K, R, 6.0, middle), rtol=1e-3)


def test_open_winding_neither_drives_nor_brakes():
    found = run(1.0, rate=5.0, goal=1e3, on=0.0, **FREE)
    np.testing.assert_allclose(found[:, RATE], 5.0, rtol=1e-12)
    assert (found[:, TORQUE] == 0.0).all()


def test_duty_is_proportional_to_the_error_and_ends_at_the_supply():
    blocked = {"coulomb": 50.0, "gain": 0.7}
    errors = np.array([-3.0, -0.5, 0.25, 5.0])
    volts = [run(0.01, goal=e + 0.1, angle=0.0, supply=7.0, zero=0.1, **blocked)[-1, VOLTAGE] for e in errors]
    # the reading starts at 0: the true angle at -zero
    np.testing.assert_allclose(volts, 7.0 * np.clip(0.7 * (errors + 0.1), -1, 1), rtol=1e-12)


def test_delay_shifts_the_response_also_by_parts_of_a_step():
    ramp = np.minimum(np.arange(2000) * STEP, 1.0)
    prompt = run(2.0, goal=ramp, gain=2.0)
    for lag in (7.0, 7.5):
        late = run(2.0, goal=ramp, gain=2.0, lag=lag)
        time = np.arange(2000) * STEP
        shifted = np.interp(time - lag * STEP, time, prompt[:, ANGLE])
        assert np.abs(late[:, ANGLE] - shifted).max() < 2e-4
        assert np.abs(late[:, ANGLE] - prompt[:, ANGLE]).max() > 5e-3


# --- effects


@pytest.mark.parametrize(
    ("changes", "torque"),
    [
        ({"saturation": 0.6}, K / R * 7.4 / (1.0 + 0.6 * 7.4 / R)),  # falls behind the current
        ({"torque_limit": 0.3}, 0.3),
        ({"torque_limit": 0.3, "supply": 1.0}, K / R),  # less is left alone
        ({"thermal": 0.0039, "warmth": 20.0}, K / R * 7.4 / 1.078),
        ({"torque_scale": 0.7}, 0.7 * K / R * 7.4),
    ],
)
def test_what_changes_the_motors_torque(changes, torque):
    """Motor at full supply against a brake."""
    assert run(0.01, goal=1e3, coulomb=50.0, **FREE, **changes)[-1, TORQUE] == pytest.approx(torque, rel=1e-12)


@pytest.mark.parametrize(
    ("change", "bound"),
    [({"load_friction": 0.2}, lambda t: 0.02 + 0.2 * t), ({"quadratic_friction": 0.5}, lambda t: 0.02 + 0.5 * t * t)],
)
def test_friction_grows_with_the_motors_torque(change, bound):
    """Steadily turning, the motor's torque is the friction's bound; at rest it is what must be overcome."""
    found = run(3.0, goal=1e3, supply=3.0, coulomb=0.02, **change, **FREE)
    assert found[-1, RATE] > 1.0
    torque = found[-1, TORQUE]
    assert torque == pytest.approx(bound(torque), rel=1e-6)
    assert -found[-1, FRICTION] == pytest.approx(torque, rel=1e-6)


def test_stribeck_friction_fades_with_speed():
    changes = {"coulomb": 0.02, "stribeck_torque": 0.05, "inverse_stribeck_speed": 1.0 / 0.5}
    stuck = run(1.0, goal=1e3, supply=0.99 * 0.07 * R / K, **changes, **FREE)
    assert (stuck[:, RATE] == 0.0).all()
    rate, friction = run(3.0, goal=1e3, supply=1.05 * 0.07 * R / K, **changes, **FREE)[-1, [RATE, FRICTION]]
    assert -friction == pytest.approx(0.02 + 0.05 * math.exp(-((rate / 0.5) ** 2)), rel=1e-6)


def test_ripple_is_a_potential():
    found = run(5.0, rate=4.0, on=0.0, ripple_amplitude=0.01, ripple_order=5.0, ripple_phase=0.3, **FREE)
    energy = 0.5 * 0.006 * found[:, RATE] ** 2 + 0.01 / 5.0 * np.cos(5.0 * found[:, ANGLE] + 0.3)
    assert np.ptp(energy) < 2e-4 * energy.mean()
    assert np.ptp(found[:, RATE]) > 0.1


def test_inside_its_play_the_link_swings_without_rotor_and_gear_friction():
    """Rotor held by its friction: a swing smaller than the play has the bare link's period and keeps its size."""
    found = run(3.0, angle=0.02, on=0.0, half_play=0.05, coulomb=0.1, inertia=0.005)
    time = np.arange(len(found)) * STEP
    np.testing.assert_allclose(found[:, ANGLE], 0.02 * np.cos(math.sqrt(0.48 / 0.005) * time), atol=0.02 * 3e-3)


def test_beyond_its_play_the_rotor_goes_along():
    """A slow pull of the motor takes up the play, then moves link and rotor as one."""
    lost = run(1.0, goal=1e3, supply=1.0, half_play=0.05, coulomb=0.01, inertia=0.005, **FREE)
    rigid = run(1.0, goal=1e3, supply=1.0, coulomb=0.01, **FREE)
    assert lost[-1, RATE] == pytest.approx(rigid[-1, RATE], rel=2e-2)


def test_a_link_rests_on_teeth_that_the_gears_friction_holds():
    """Gravity presses the link against its play; the rotor's dry friction carries it, without creep."""
    found = run(4.0, angle=0.5, on=0.0, half_play=0.01, coulomb=0.3, inertia=0.005)
    rest = found[-500:]
    assert np.abs(rest[:, RATE]).max() < 1e-9
    assert 0.44 < rest[-1, ANGLE] < 0.49  # past the gap; the blow may push the rotor on by (load x gap)/(friction - load)
    np.testing.assert_allclose(rest[:, FRICTION], 0.48 * np.sin(rest[:, ANGLE]), rtol=1e-6)


def test_arm_and_load_give_gravity_and_inertia():
    """A load at its end and a uniform arm: m l + m_arm l/2 and m l^2 + m_arm l^2/3."""
    recording = read_recording_of(mass=0.49, length=0.098)
    numbers = {quantity.name: quantity.nominal for quantity in QUANTITIES} | {"arm_mass": 0.06, "length_error": 0.002}
    model = model_of(Setting(np.array(list(numbers.values()))))
    lanes = dict(zip(pendulum.PARAMETERS, pack([model], recording, STEP)[0], strict=True))
    assert lanes["gravity"] == pytest.approx(9.81 * 0.1 * (0.49 + 0.03))
    assert lanes["inertia"] == pytest.approx(0.01 * (0.49 + 0.02) + numbers["armature"])
    assert lanes["volt_gain"] == pytest.approx(0.52 / 5.0)
    assert lanes["gain"] == pytest.approx(200 * 4096 / (2 * math.pi) / (256 * 885))


def read_recording_of(mass, length):
    none = np.zeros(0)
    return Recording("none", "none", mass, length, 200.0, *([none] * 6), enabled=none.astype(bool))


# --- the compiled law is the scalar one


@pytest.mark.parametrize("half_play", [0.0, 0.004])
def test_kernel_does_what_the_law_says(half_play):
    changes = {
        "half_play": half_play, "coulomb": 0.02, "viscous": 0.004, "stribeck_torque": 0.01, "load_friction": 0.15,
        "ripple_amplitude": 0.01, "ripple_order": 3.0, "saturation": 0.2, "torque_limit": 0.5, "quadratic_friction": 0.2,
        "thermal": 0.0039, "torque_scale": 0.9, "gain": 2.0, "zero": 0.02,
    }  # fmt: skip
    goal = np.sin(np.arange(1500) * 7 * STEP)
    found = run(1.5, goal=goal, warmth=9.0, **changes)
    parameters = NEUTRAL | changes
    moved = parameters["rotor_inertia"] if half_play else parameters["inertia"]
    damping = parameters["back_emf_damping"] * 0.9 + 0.004
    parameters["weight"] = float(fitted_weight(np.array(STEP * damping / moved)))
    features = frozenset({"drive", "backlash"} if half_play else {"drive"})
    lead = half_play * np.sign(goal[0] - 0.0)
    state = {"angle": -0.02, "rate": 0.0, "rotor_lead": lead, "rotor_rate": 0.0}
    for k in range(1500):
        assert found[k, ANGLE] == pytest.approx(state["angle"], abs=1e-9)
        lanes = {**parameters, **state, "goal": goal[k], "supply": 7.4, "on": 1.0, "warmth": 9.0}
        new = pendulum.substep(lanes, STEP, features)
        assert found[k, TORQUE] == pytest.approx(new["motor_torque"], abs=1e-7)
        state = {name: float(new[name]) for name in pendulum.STATE}
    assert np.ptp(found[:, ANGLE]) > 0.2


# ---- recordings ------------------------------------------------------------------------------------------------------


pendulum_patch = partial(known_patch, rig="pendulum")
REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "xl330_pendulum"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return write(tmp_path_factory.mktemp("rig"), Bench(), gains=(100, 400), duration=3.0)


def kinds(recordings, run=None):
    return {f.kind for f in findings(recordings) if run is None or f.run == run}


def test_states_come_from_the_rows_around(made):
    recording = read_recordings(made)[0]
    angle, rate = smoothed_state(recording.t, np.sin(3.0 * recording.t))
    np.testing.assert_allclose(angle, np.sin(3.0 * recording.t), atol=1e-6)
    np.testing.assert_allclose(rate[4:-4], 3.0 * np.cos(3.0 * recording.t[4:-4]), atol=1e-4)


def test_goals_hold_from_row_to_row_and_keep_their_area(made):
    recording = read_recordings(made)[0]
    replay = Replay(recording)
    middle = recording.t[0] + pendulum.STEP * (np.arange(len(replay.goals)) + 0.5)
    row = np.clip(np.searchsorted(recording.t - GOAL_LEAD, middle, side="right") - 1, 0, None)
    inside = np.abs(replay.goals - recording.goal[row]) < 1e-12
    assert inside.mean() > 0.55  # the others hold the change of a goal
    assert replay.goals.sum() == pytest.approx(recording.goal[row].sum(), rel=2e-3)


# --- refusals


def broken(folder, **changes):
    one = contents(Bench(), [100], ["sin_sin"], duration=0.5)[0]
    entries = [dict(entry) for entry in one["entries"]]
    changes.pop("edit", lambda e: None)(entries) if "edit" in changes else None
    path = folder / "broken.json"
    path.write_text(json.dumps(one | {"entries": entries} | changes))
    return path


def put(row, key, value):
    def edit(entries):
        entries[row][key] = value

    return edit


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"edit": put(7, "position", None)}, "entry 7: position = None: expected a finite number rad"),
        ({"edit": put(7, "position", float("nan"))}, "entry 7: position = nan: expected a finite number rad"),
        ({"edit": put(9, "timestamp", 0.0)}, "entry 9: timestamp 0 s is not after"),
        ({"edit": put(3, "input_volts", 0)}, "entry 3: input_volts = 0: expected more than 0 V"),
        ({"edit": lambda entries: entries[5].pop("goal_position")}, "entry 5: has no 'goal_position'"),
        ({"edit": lambda entries: entries.__delitem__(slice(20, None))}, "20 entries; a run needs 50"),
        ({"mass": -1}, "mass = -1: expected more than 0 kg"),
        ({"kp": "high"}, "kp = 'high': expected more than 0"),
        ({"entries": 3}, "a list 'entries'"),
    ],
)
def test_what_is_no_recording_is_refused_with_its_place(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        read_recording(broken(tmp_path, **changes))


def test_missing_header_key_is_named(tmp_path):
    one = contents(Bench(), [100], ["sin_sin"], duration=0.5)[0]
    del one["length"]
    (tmp_path / "a.json").write_text(json.dumps(one | {"lenght": 0.1}))
    with pytest.raises(InputError, match=r"has no 'length' \(did you mean 'lenght'"):
        read_recordings(tmp_path)


def test_folders_without_recordings_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        read_recordings(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"holds no \*\.json"):
        read_recordings(tmp_path)
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(InputError, match="broken JSON"):
        read_recordings(tmp_path)


# --- intake


def test_nothing_is_odd_about_a_clean_set(made):
    assert findings(read_recordings(made)) == ()


def test_intake_notices_what_is_odd(made):
    recordings = read_recordings(made)
    one = recordings[0]
    rest = recordings[1:]

    def with_one(**changes):
        return kinds([dataclasses.replace(one, **changes), *rest], one.name)

    late = one.t + 0.1 * (np.arange(len(one.t)) > 200)
    assert "gap" in with_one(t=late)
    assert "dead" in with_one(angle=np.zeros_like(one.angle))
    assert "off" in with_one(enabled=one.t < 2.0)


def test_wrong_units_and_signs_are_fatal(made):
    recordings = read_recordings(made)
    one = recordings[0]
    for changes in (
        {"angle": np.degrees(one.angle), "goal": np.degrees(one.goal)},
        {"speed": -one.speed},
        {"speed": 9.5 * one.speed},
    ):
        fatal = [f for f in findings([dataclasses.replace(one, **changes), *recordings[1:]]) if f.fatal]
        assert [f.kind for f in fatal] == ["units"] * len(fatal)
        assert fatal
        assert {f.run for f in fatal} == {one.name}


# --- opening a folder


def test_held_out_runs_cover_gains_and_trajectories(made):
    recordings = read_recordings(made)
    held_out = PendulumProblem(recordings).held_out
    held = [recording for recording in recordings if recording.name in held_out]
    assert len(held) == len(held_out) == 2
    assert len({recording.gain for recording in held}) == 2
    assert len({recording.trajectory for recording in held}) == 2


def with_one_in_degrees(folder):
    """Write four runs; the angles of run_0 are in degrees."""
    for k, one in enumerate(contents(Bench(), [100] * 4, ["sin_sin"] * 4, duration=1.0)):
        for entry in one["entries"] if k == 0 else ():
            entry["position"] = 57.3 * entry["position"]
            entry["goal_position"] = 57.3 * entry["goal_position"]
        (folder / f"run_{k}.json").write_text(json.dumps(one))
    return folder


def test_opening_leaves_out_what_cannot_be_used(made, tmp_path):
    problem, found = open_pendulum(made)
    assert problem is not None
    assert len(problem.runs) == 6
    assert not any(f.fatal for f in found)
    problem, found = open_pendulum(with_one_in_degrees(tmp_path))
    assert problem is not None
    assert problem.runs == ("run_1", "run_2", "run_3")
    assert {f.run for f in found if f.fatal} == {"run_0"}
    (tmp_path / "run_3.json").unlink()
    problem, found = open_pendulum(tmp_path)
    assert problem is None
    assert found[-1].kind == "few_runs"
    assert found[-1].fatal


@pytest.mark.parametrize(
    ("name", "sizes", "number", "together"),
    [
        ("load_dependent_friction", ({"ratio": 0.08}, {"ratio": 0.07}), "load_friction", 0.15),
        ("weak_motor", ({"scale": 0.9}, {"scale": 0.8}), "torque_scale", 0.72),
        ("torque_limit", ({"torque": 0.5}, {"torque": 0.4}), "torque_limit", 0.4),
    ],
)
def test_a_law_given_twice_acts_twice(name, sizes, number, together):
    numbers = {"load_friction": 0.0, "torque_scale": 1.0, "torque_limit": NO_TORQUE_LIMIT}
    for parameters in sizes:
        RIG_EFFECTS[name].apply(numbers, PatchEffect(name, (), parameters))
    assert numbers[number] == pytest.approx(together)


def test_the_patch_that_an_analysis_of_the_rig_writes_can_be_given_back(made, tmp_path):
    """Every effect that it may find, through the file; a known effect acts as the same effect in a setting does."""
    found = []
    each = (
        law_candidates(RIG_EFFECTS, JOINT, present)[1] for present in ({"load_dependent_friction", "coulomb_friction"}, set())
    )
    for candidate in itertools.chain(*each):
        values = candidate.parameters(candidate.kept([0.5 * (u.low + u.high) for u in candidate.unknowns]))
        estimates = {name: ParameterEstimate(value, value, value, "-") for name, value in values.items()}
        found.append(FoundEffect(candidate.name, candidate.where, estimates, 0.9, 100.0))
    written = patch_of(Analysis("made", "effect_found", "", effects=tuple(found)))
    patch = pendulum_patch(save_patch(written, tmp_path / "patch.yaml"))
    assert patch.effects == written.effects
    assert patch.provenance == written.provenance
    one = Patch(tuple(effect for effect in patch.effects if effect.name == "torque_saturation")[:1])
    problem, plain = open_pendulum(made, one)[0], open_pendulum(made)[0]
    assert problem is not None
    assert plain is not None
    numbers = nominal_model(plain).quantities
    (known,), (added,), (without,) = (
        own.simulate([setting], [3])
        for own, setting in ((problem, Setting(numbers)), (plain, Setting(numbers, one.effects)), (plain, Setting(numbers)))
    )
    assert (known == added).all()
    assert np.abs(known - without).max() > 1e-3


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"name": "torque_saturaton"}, r"effect 1: unknown effect .*did you mean 'torque_saturation'"),
        ({"name": "rolling_resistance", "parameters": {"coefficient": 0.1}}, "unknown effect 'rolling_resistance'"),
        ({"name": "weak_motor", "where": ["wheel_lf"], "parameters": {"scale": 0.9}}, "unknown where 'wheel_lf'; valid: servo"),
        ({"name": "weak_motor", "parameters": {"skale": 0.9}}, r"unknown key 'skale' \(did you mean 'scale'"),
        ({"name": "torque_saturation", "parameters": {"coefficient": 11}}, r"coefficient = 11 is outside \[0, 10\]"),
        ({"name": "unknown_effect", "formula": "-b * rate"}, "unknown effect 'unknown_effect'"),
    ],
)
def test_patches_that_the_rig_cannot_take_are_refused(entry, words):
    with pytest.raises(InputError, match=words):
        pendulum_patch({"effects": [entry]})


def test_a_run_that_cannot_be_used_cannot_be_held_out(tmp_path):
    with pytest.raises(InputError, match=r"--heldout run_0: the run cannot be used: "):
        analyse(with_one_in_degrees(tmp_path), rig="pendulum", heldout=("run_0",))


@pytest.mark.skipif(not REAL.is_dir(), reason="the real recordings are not beside the repository")
def test_real_recordings_are_read_and_flagged():
    recordings = read_recordings(REAL)
    assert len(recordings) == 12
    found = findings(recordings)
    assert not any(f.fatal for f in found)
    assert len({f.run for f in found if f.kind == "off"}) == 3
    assert min(r.supply.min() for r in recordings) == 5.7
    assert max(r.supply.max() for r in recordings) == 9.2


# ---- the problem -----------------------------------------------------------------------------------------------------


LOADED = Bench(load_ratio=0.15)


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    return PendulumProblem(read_recordings(write(tmp_path_factory.mktemp("loaded"), LOADED, gains=(100, 300, 800))))


def split(problem):
    return named_split(problem.runs, problem.held_out)


def true_quantities(problem, bench):
    values = dict(zip([q.name for q in problem.quantities], nominal(problem), strict=True))
    link = 0.49 * 0.1**2
    values |= {
        "stall_torque": 5.0 * bench.torque_constant / bench.resistance,
        "no_load_speed": 5.0 / bench.torque_constant,
        "armature": bench.inertia - link,
        "length_error": bench.gravity / (9.81 * 0.49) - 0.1,
        "arm_mass": 0.0,
        "delay": bench.delay,
        "coulomb_friction": bench.coulomb,
        "viscous_friction": bench.viscous,
    }
    values["armature"] -= 0.49 * ((0.1 + values["length_error"]) ** 2 - 0.1**2)
    return np.array(list(values.values()))


def test_the_true_model_replays_an_independent_bench_to_its_noise(loaded):
    truth = Setting(
        true_quantities(loaded, LOADED), (PatchEffect("load_dependent_friction", ("servo",), {"ratio": LOADED.load_ratio}),)
    )
    runs = range(len(loaded.runs))
    errors = position_errors(loaded, truth, runs)
    assert np.median(errors) < 1e-3
    assert errors.max() < 6e-3  # the bench's friction, smooth at rest, creeps while it holds a load
    assert position_errors(loaded, Setting(truth.quantities), runs).min() > 10e-3
    shortly = np.concatenate([r[0, :, 1] for r in loaded.residuals([truth], runs)])
    assert np.sqrt(np.mean(shortly**2)) < 4.0


def test_residuals_are_in_counts_of_the_encoder_and_by_run(loaded):
    setting = Setting(nominal(loaded))
    (one,) = loaded.residuals([setting, setting], [2])
    rows = len(loaded.times(2))
    assert one.shape == (2, rows, 2)
    assert (one[0] == one[1]).all()
    (angles,) = loaded.simulate([setting], [2])
    np.testing.assert_allclose(one[0] * ENCODER_NOISE, loaded.measured(2) - angles[0], atol=1e-12)
    assert np.abs(one[0, :3]).max() < 3.0  # starts where the measurement does
    whole, within = (np.concatenate([r[0, :, k] for r in loaded.residuals([setting], range(9))]) for k in (0, 1))
    assert np.std(within) < 0.8 * np.std(whole)  # short windows forget, the whole run drifts off


def test_encoder_zero_moves_gravity_and_not_the_start(loaded):
    values = nominal(loaded)
    shifted = values.copy()
    shifted[[q.name for q in loaded.quantities].index("zero")] = 0.1
    plain, moved = loaded.simulate([Setting(values), Setting(shifted)], [0])[0]
    assert abs(moved[0, 0] - plain[0, 0]) < 1e-12
    assert np.abs(moved - plain).max() > 0.01


def test_every_effect_is_neutral_where_it_says_and_acts_elsewhere(loaded):
    values = nominal(loaded)
    strongest = 6
    (plain,) = loaded.simulate([Setting(values)], [strongest])
    for name, effect in RIG_EFFECTS.items():
        neutral = {key: float(p.neutral) for key, p in effect.parameters.items()}
        severe = {key: p.severity for key, p in effect.parameters.items()} | ({"torque": 0.2} if name == "torque_limit" else {})
        settings = [Setting(values, (PatchEffect(name, ("servo",), numbers),)) for numbers in (neutral, severe)]
        (found,) = loaded.simulate(settings, [strongest])
        assert (found[0] == plain[0]).all(), name
        assert np.abs(found[1] - plain[0]).max() > 1e-3, name


def test_every_probe_is_felt_and_candidates_start_from_them(loaded):
    probes, _ = law_candidates(RIG_EFFECTS, JOINT, {"load_dependent_friction", "coulomb_friction"})
    probes = [probe for probe in probes if not probe.key.startswith("torque_limit")]  # this bench does not reach them
    settings = [Setting(nominal(loaded), probe.effects) for probe in probes]
    base, *found = (r for r in loaded.residuals([Setting(nominal(loaded)), *settings], [6])[0])
    for probe, residual in zip(probes, found, strict=True):
        assert np.abs(residual - base).max() > 0.1, probe.key
    probes, candidates = law_candidates(RIG_EFFECTS, JOINT, set())
    keys = {probe.key for probe in probes}
    for candidate in candidates:
        for start in candidate.starts:
            assert {key for direction in start.directions for key in direction} <= keys
            assert len(start.values(np.ones(len(start.directions)))) == len(candidate.unknowns)


def test_candidates_leave_out_what_is_there_and_keep_the_order_of_a_series(loaded):
    def names(*present):
        effects = tuple(PatchEffect(n, ("servo",), {"ratio": 0.1}) for n in present)
        return {c.name for c in loaded.candidates(Setting(nominal(loaded), effects), [], [])[1]}

    assert "load_dependent_friction" in names()
    assert not names() & {"coulomb_friction", "viscous_friction", "quadratic_load_friction"}
    with_load = names("load_dependent_friction")
    assert "load_dependent_friction" not in with_load
    assert "quadratic_load_friction" in with_load


def test_features_name_what_residuals_are_mapped_over(loaded):
    (features,) = loaded.features(Setting(nominal(loaded)), [3])
    rows = len(loaded.times(3))
    assert all(values.shape == (rows,) and np.isfinite(values).all() for values in features.values())
    assert features["time since reversal [s]"].min() == 0.0
    assert np.abs(features["motor torque [N m]"]).max() > 0.05


def test_unknown_effects_and_missing_parameters_are_refused(loaded):
    for effect, message in (
        (PatchEffect("rolling_resistance", ("servo",), {"coefficient": 0.1}), "unknown effect of the test rig"),
        (PatchEffect("backlash", ("servo",), {}), "backlash: has no 'angle'"),
    ):
        with pytest.raises(InputError, match=message):
            loaded.residuals([Setting(nominal(loaded), (effect,))], [0])
    with pytest.raises(InputError, match="no recordings"):
        PendulumProblem([])


def test_a_simulation_that_breaks_down_is_as_far_off_as_can_be(loaded):
    """A servo that feeds itself speed: neither is that nothing, nor are its rows before the end anything."""
    setting = Setting(nominal(loaded))
    running_away = Setting(setting.quantities, (PatchEffect("viscous_friction", ("servo",), {"coefficient": -5.0}),))
    (simulated,) = loaded.simulate([running_away], [4])
    assert not np.isfinite(simulated).all()
    (plain,), (both,) = (loaded.residuals(settings, [4]) for settings in ([setting], [setting, running_away]))
    assert (both[0] == plain[0]).all()
    assert (both[1] == LOST).all()
    assert np.abs(both[0]).max() < LOST


# --- the workflow on it


def named(problem, runs):
    """Name effects by the quick way: these benches answer smoothly."""
    problem.thorough = False
    return search_effects(fit(nominal_model(problem), runs, steps=12))


def test_hidden_load_dependent_friction_is_named_and_measured(loaded):
    fitted, held = split(loaded)
    found = named(loaded, fitted).fit.model
    assert [candidate.name for candidate, _ in found.effects] == ["load_dependent_friction"]
    assert found.effects[0][1][0] == pytest.approx(LOADED.load_ratio, rel=0.1)
    without = fit(nominal_model(loaded), fitted, steps=12).model
    after, before = (position_errors(loaded, m.setting, held).mean() for m in (found, without))
    assert after < 0.3 * before


def test_other_numbers_alone_are_no_effect(tmp_path):
    bench = Bench(torque_constant=0.5, resistance=4.8, coulomb=0.04, viscous=0.008, inertia=0.0068, gravity=0.5)
    problem = PendulumProblem(read_recordings(write(tmp_path, bench, gains=(100, 400))))
    assert named(problem, range(len(problem.runs))).fit.model.effects == ()


# --- the real servo


@pytest.fixture(scope="module")
def real():
    return PendulumProblem(read_recordings(REAL))


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="the real recordings are not beside the repository")
def test_real_servo_lacks_load_dependent_friction_and_a_torque_that_falls_behind(real):
    """Against the Coulomb-viscous base; runs held out as the workflow would."""
    fitted, held = split(real)
    load, behind = {"load_dependent_friction": (0.2,)}, {"torque_saturation": (0.4,)}
    both = best_fit(real, fitted, load | behind)
    autocorrelation_time = both.noise.autocorrelation_time
    base, only_load, only_behind, stribeck, with_stribeck, warm = (
        best_fit(real, fitted, effects, autocorrelation_time)
        for effects in (
            {},
            load,
            behind,
            {"stribeck_friction": (0.03, 0.1)},
            load | behind | {"stribeck_friction": (0.03, 0.1)},
            load | {"warm_winding": (0.004,)},
        )
    )
    assert both.cost < min(only_load.cost, only_behind.cost) - 60
    gain = {
        name: base.cost - found.cost for name, found in (("load", only_load), ("behind", only_behind), ("stribeck", stribeck))
    }
    assert gain["stribeck"] < 0.3 * min(gain["load"], gain["behind"])  # alone it takes the place of what is missing
    assert with_stribeck.cost > both.cost - 60
    assert warm.cost > both.cost + 60
    assert warm.model.effects[-1][1][0] == pytest.approx(0.0045)  # at the edge of what a winding can do

    def heldout(found):
        return 1e3 * position_errors(real, found.model.setting, held).mean()

    assert 45 < heldout(base) < 75
    assert heldout(both) < 0.6 * heldout(base)
    assert heldout(with_stribeck) > 0.9 * heldout(both)


@pytest.mark.skipif(not REAL.is_dir(), reason="the real recordings are not beside the repository")
def test_real_servo_replays_better_with_both(real):
    """The quick form: numbers found by the slow one, replayed on every run."""
    names = [quantity.name for quantity in real.quantities]
    base, both = nominal(real).copy(), nominal(real).copy()
    for values, numbers in ((base, BASE), (both, BOTH)):
        for name, value in numbers.items():
            values[names.index(name)] = value
    effects = (
        PatchEffect("load_dependent_friction", ("servo",), {"ratio": 0.25}),
        PatchEffect("torque_saturation", ("servo",), {"coefficient": 0.32}),
    )
    runs = range(len(real.runs))
    before = 1e3 * position_errors(real, Setting(base), runs).mean()
    after = 1e3 * position_errors(real, Setting(both, effects), runs).mean()
    assert 55 < before < 75
    assert after < 0.5 * before


BASE = {
    "stall_torque": 0.36, "no_load_speed": 11.0, "armature": 0.0016, "delay": 0.0, "zero": -0.018, "coulomb_friction": 0.041,
    "viscous_friction": 0.0,
}  # fmt: skip
BOTH = {
    "stall_torque": 0.77, "no_load_speed": 13.9, "armature": 0.0018, "delay": 0.006, "zero": -0.02, "coulomb_friction": 0.021,
    "viscous_friction": 0.006,
}  # fmt: skip
