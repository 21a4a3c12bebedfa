"""Comparing plants: differences put in by hand come out, in size, time and name; equal plants show none."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.data import Profile, Run, RunMeta
from wlr_gym.data import comparison as module
from wlr_gym.data.comparison import (
    BOUNDS,
    ComparedPlant,
    Traces,
    compare,
    drive,
    markdown,
    parse_plant,
    resolutions,
    severe_patch,
    summary_table,
)
from wlr_gym.data.excitations import Motion, excite
from wlr_gym.data.record import motion_of
from wlr_gym.data.run_states import standing_at
from wlr_gym.physics.effects import EFFECTS, apply_patch
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, PlantOptions
from wlr_gym.robot import JOINTS, load_robot
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot()
ENGINE = ComparedPlant("gibbs_appell")
MOTION = excite("steps", 1, ROBOT, seconds=3.0)
SIGNALS = resolutions(ROBOT)


@pytest.fixture(scope="module")
def traces() -> Traces:
    return drive(ENGINE, [MOTION], ROBOT)


def case_of(monkeypatch, first: Traces, second: Traces, motion: Motion = MOTION):
    pair = iter((first, second))
    monkeypatch.setattr(module, "drive", lambda *_: next(pair))
    return compare([motion], (ENGINE, ENGINE), ROBOT).cases[0]


def changed(traces: Traces, layout: str, element: str, change: float, start: int = 0, stop: int | None = None) -> Traces:
    """A copy with ``change`` added to one column from tick ``start`` on."""
    values = getattr(traces, layout).copy()
    table = SENSOR_LAYOUT if layout == "sensors" else TRUTH_LAYOUT
    values[start:stop, 0, table.elements.index(element)] += change
    return replace(traces, **{layout: values})


def test_equal_plants_do_not_differ():
    found = compare([MOTION, excite("turns", 0, ROBOT, seconds=1.0)], (ENGINE, ENGINE), ROBOT, halve=True)
    for case in (*found.cases, *(found.half or ())):
        assert case.first is None
        assert case.agreement.broken == ()
        assert all(difference.largest == 0.0 for difference in case.differences.values())
    assert found.own is not None
    assert 0.0 < found.own[0][0].differences["vel_wheel"].rms_in_noise < 20.0  # half the step is another run
    assert "| steps |" in markdown([found], "x")
    assert not found.broken


@pytest.mark.parametrize(
    ("layout", "element", "signal"),
    [
        ("sensors", "joint_position[leg_rf]", "pos_leg"),
        ("sensors", "joint_velocity[wheel_lr]", "vel_wheel"),
        ("sensors", "joint_effort[wheel_rr]", "eff_wheel"),
        ("sensors", "gyro[z]", "gyro"),
        ("sensors", "supply_voltage", "volt"),
        ("sensors", "camera_pose[y]", "cam_xy"),
        ("truth", "position[z]", "true_z"),
        ("truth", "motor_torque[leg_lf]", "motor_torque_leg"),
        ("truth", "contact_force[wheel_lf,z]", "normal_force"),
        ("truth", "slip_velocity[wheel_rf,y]", "slip_across"),
    ],
)
def test_what_is_put_in_comes_out(monkeypatch, traces, layout, element, signal):
    """Seven noise units on one element during the third second: size, time and signal, and nothing in any other."""
    step = 7.0 * SIGNALS[signal].resolution
    case = case_of(monkeypatch, traces, changed(traces, layout, element, step, 100))
    found = case.differences[signal]
    assert found.largest == pytest.approx(step)
    assert found.parted == pytest.approx(2.0)
    assert case.first == (signal, pytest.approx(2.0))
    elements = traces.signals[signal].shape[2]
    assert found.rms_in_noise == pytest.approx(7.0 * np.sqrt(51 / 151 / elements))
    assert [name for name, other in case.differences.items() if other.largest > 0.0] == [signal]


def test_below_the_threshold_nothing_parts(monkeypatch, traces):
    small = changed(traces, "sensors", "gyro[x]", 4.9 * SIGNALS["gyro"].resolution)
    assert case_of(monkeypatch, traces, small).first is None


def test_a_load_shared_in_another_way_is_no_parting(monkeypatch, traces):
    """Squeeze between the wheels of an axle: the split differs, the total does not, and the total is what counts."""
    squeezed = changed(traces, "truth", "contact_force[wheel_lf,y]", 3.0)
    one_sided = case_of(monkeypatch, traces, squeezed)
    balanced = case_of(monkeypatch, traces, changed(squeezed, "truth", "contact_force[wheel_rf,y]", -3.0))
    assert one_sided.first == ("total_across", 0.0)
    assert balanced.first is None
    assert balanced.differences["total_across"].largest == pytest.approx(0.0, abs=1e-12)
    assert balanced.differences["friction_across"].parted == 0.0


def test_agreement_figures(monkeypatch, traces):
    """Position over travel, and torque over its own rms."""
    travel = np.linalg.norm(np.diff(traces.signals["true_xy"][:, 0], axis=0), axis=1).sum()
    moved = case_of(monkeypatch, traces, changed(traces, "truth", "position[x]", 0.03 * travel, 120)).agreement
    assert moved.travel == pytest.approx(travel)
    assert moved.position == pytest.approx(0.03)
    assert moved.broken == ("position",)
    truth = traces.truth.copy()
    truth[:, :, TRUTH_LAYOUT.slices["motor_torque"]] *= np.repeat([1.04, 1.06], 4)
    stronger = case_of(monkeypatch, traces, replace(traces, truth=truth)).agreement
    assert stronger.leg_torque == pytest.approx(0.04)
    assert stronger.wheel_torque == pytest.approx(0.06)
    assert stronger.broken == ("wheel_torque",)


def test_a_robot_that_stands_keeps_the_bound_of_its_position(monkeypatch, traces):
    truth = traces.truth.copy()
    truth[:, :, TRUTH_LAYOUT.slices["position"]] = 0.3
    stands = replace(traces, truth=truth)
    found = case_of(monkeypatch, stands, changed(stands, "truth", "position[x]", 1e-9)).agreement
    assert found.travel == 0.0
    assert found.position == pytest.approx(1e-6)  # over one noise unit of the camera, 1 mm
    assert not found.broken


def test_headings_half_a_turn_around_are_neighbours(monkeypatch, traces):
    quaternion = TRUTH_LAYOUT.slices["quaternion"]

    def heading(yaw: float) -> Traces:
        truth = traces.truth.copy()
        truth[:, 0, quaternion] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
        return replace(traces, truth=truth)

    case = case_of(monkeypatch, heading(np.pi - 0.01), heading(-np.pi + 0.01))
    assert case.agreement.yaw == pytest.approx(0.02)
    assert case.differences["true_yaw"].largest == pytest.approx(0.02)


def test_a_short_motion_is_compared_over_its_own_length(monkeypatch):
    both = drive(ENGINE, [MOTION, MOTION.cut(1.0)], ROBOT)
    late = replace(both, sensors=both.sensors.copy())
    late.sensors[51:, 1] += 1.0
    pair = iter((both, late))
    monkeypatch.setattr(module, "drive", lambda *_: next(pair))
    found = compare([MOTION, MOTION.cut(1.0)], (ENGINE, ENGINE), ROBOT)
    assert all(case.first is None for case in found.cases)


def test_every_motion_is_driven_by_its_own_goals_and_profile():
    """A batch shows what each motion alone shows."""
    other = excite("straight", 0, ROBOT, seconds=2.0)
    together, alone = drive(ENGINE, [MOTION, other], ROBOT), drive(ENGINE, [other], ROBOT)
    assert np.array_equal(together.truth[: len(other.setpoints) + 1, 1], alone.truth[:, 0])


def test_whose_zeros_are_off_begins_at_its_setpoints():
    """References are true angles: a servo that stands where its reading says has no way to go."""
    parameters = Parameters.nominal(ROBOT)
    parameters["joint.zero_offset"] = 0.1
    setpoints = np.array([[*[1.5] * 4, *[0.0] * 4]])
    state = standing_at(setpoints, ROBOT, parameters)
    np.testing.assert_allclose(state.reference_position[:, :4], 1.4)
    np.testing.assert_array_equal(state.reference_position, state.joint_position)
    for compared in (ENGINE, ComparedPlant("mujoco")):
        plant = make_plant(compared.backend, ROBOT, 1, PlantOptions(sensor_noise=False))
        plant.reset(np.zeros(1, np.uint64), parameters, state=state)
        plant.step(setpoints)
        moved = plant.mechanical_state().reference_position[:, :4]
        plant.close()
        np.testing.assert_allclose(moved, 1.4, atol=1e-9)


def test_effects_act_on_both():
    plain = drive(ENGINE, [MOTION], ROBOT)
    payload = drive(ENGINE, [MOTION], ROBOT, patch=severe_patch("payload"))
    at_rest = 49
    weight = payload.signals["normal_force"][at_rest, 0].sum() - plain.signals["normal_force"][at_rest, 0].sum()
    assert weight == pytest.approx(0.5 * ROBOT.gravity, rel=1e-3)


def test_motion_of_a_run_holds_its_commands_until_the_next_row():
    t = np.array([5.0, 5.02, 5.06, 5.08, 5.10])  # a tick is missing
    table = (
        {"t": t} | {f"cmd_{joint}": np.full(5, 1.5) for joint in JOINTS} | {f"pos_{joint}": np.full(5, 1.5) for joint in JOINTS}
    )
    table["cmd_wheel_lf"] = np.array([0.0, 1.0, 2.0, np.nan, 3.0])
    run = Run(pandas.DataFrame(table), RunMeta(profile=Profile(leg_velocity=1.0)), Path("run_07.csv"))
    motion = motion_of(run)
    assert motion.name == "run_07"
    assert motion.profile.leg_velocity == 1.0
    np.testing.assert_array_equal(motion.setpoints[:, 4], [0.0, 1.0, 1.0, 2.0, np.nan, 3.0])


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_has_a_severe_case(name):
    patch = severe_patch(name)
    nominal = Parameters.nominal(ROBOT)
    assert patch.summary() == name
    assert (apply_patch(patch, nominal).values != nominal.values).any()


def test_plants_by_name():
    assert parse_plant("gibbs_appell", 0.002) == ComparedPlant("gibbs_appell", 0.002)
    text = "gibbs_appell:physics_step=0.0005,precision=float32"
    assert parse_plant(text) == ComparedPlant("gibbs_appell", 0.0005, "float32")
    assert parse_plant(text).label == "gibbs_appell, 0.5 ms, float32"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("gibs_appell", "did you mean 'gibbs_appell'"),
        ("dynamixel", "unknown backend 'dynamixel'.*valid: gibbs_appell, mujoco"),
        ("gibbs_appell:step=0.1", "unknown option 'step'"),
        ("gibbs_appell:physics_step=fast", "physics_step = 'fast'"),
        ("gibbs_appell:physics_step=0.0007", "does not divide"),
        ("gibbs_appell:precision=float16", "unknown precision 'float16'"),
    ],
)
def test_a_plant_that_is_none_is_named(text, words):
    with pytest.raises(InputError, match=words):
        parse_plant(text)


def test_bad_arguments_are_named():
    with pytest.raises(InputError, match="at least one motion"):
        compare([], (ENGINE, ENGINE))
    with pytest.raises(InputError, match="different periods"):
        compare([MOTION, excite("turns", period=0.01)], (ENGINE, ENGINE))
    with pytest.raises(InputError, match="threshold = 0"):
        compare([MOTION], (ENGINE, ENGINE), threshold=0.0)
    with pytest.raises(InputError, match="did you mean 'payload'"):
        severe_patch("paylod")


def test_two_simulators_agree():
    """The engine and MuJoCo, on the hardest motion: well within the bounds of the project."""
    found = compare([MOTION], (ENGINE, ComparedPlant("mujoco")), ROBOT)
    agreement = found.cases[0].agreement
    assert all(getattr(agreement, name) < 0.5 * bound for name, bound in BOUNDS.items())
    assert 0.0 < agreement.apart < 1e-3
    assert summary_table([found]).rows[0][-1] == "-"
