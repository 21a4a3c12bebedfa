"""The blind tests' own simulator against closed forms: it must be right before it may judge anybody."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

import studies.bench.blind as blind
from studies.bench.blind import cases, drive
from studies.bench.blind.cases import LATER, NAMED, STRANGE, hide
from studies.bench.blind.copies import Copy, draw, nominal, read_robot, yielding
from wlr_gym.base.paths import data_directory

ROBOT = read_robot(data_directory("configs") / "robot" / "nominal.yaml")
DOWN = np.full(4, np.pi / 2)
SHARP = drive.BlindProfile(0.0, 0.0, 0.0)
MASS = 3.0
GRAVITY = 9.81
WHEELS = ["wheel_lf", "wheel_rf", "wheel_lr", "wheel_rr"]


def effect(name, where, **parameters):
    return {"name": name, "where": where, "parameters": parameters}


def simulate(setpoints, duration, effects=(), copy: Copy | None = None, start=DOWN, profile=SHARP):
    """Drive with wheel setpoints (4,) or setpoints (n, 8), one per 20 ms."""
    copy = nominal(ROBOT) if copy is None else copy
    setpoints = np.asarray(setpoints, dtype=float)
    times = np.arange(0.0, duration, 0.02)
    if setpoints.ndim == 1:
        setpoints = np.tile(np.concatenate([start, setpoints]), (len(times), 1))
    hidden = hide(effects)
    return drive.simulate(
        drive.build(copy, hidden), copy, hidden, profile, times, setpoints, np.asarray(start, dtype=float), duration
    )


def speed(records):
    return np.gradient(records[:, 0], drive.SAMPLE)


def acceleration(records, axis):
    position = records[:, axis]
    time = drive.SAMPLE * np.arange(len(position))
    return 2 * np.polyfit(time, position, 2)[0]


def test_shares_no_code_with_what_it_tests():
    forbidden = {"plants", "effects", "servo", "parameters", "runs", "gap", "robot", "model", "codegen", "tasks", "envs"}
    for file in Path(blind.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            for name in names:
                parts = name.split(".")
                assert parts[0] != "wlr_gym" or parts[1] not in forbidden, f"{file.name} imports {name}"


def test_stands_still_and_carries_its_weight():
    records = simulate(np.zeros(4), 1.0)
    assert records[:, 38:42].sum(axis=1) == pytest.approx(MASS * GRAVITY, rel=1e-4)
    assert np.ptp(records[:, :3], axis=0).max() < 1e-5
    sag = MASS * GRAVITY / 4 / 7400
    assert records[-1, 2] == pytest.approx(0.135 + 0.034 - sag, abs=2e-6)
    assert records[-1, 36] == pytest.approx(GRAVITY, abs=1e-4)


@pytest.mark.parametrize(("axis", "which"), [(0, "pitch"), (1, "roll")])
def test_slides_down_a_steep_slope_at_the_closed_form_and_sticks_on_a_gentle_one(axis, which):
    steep, gentle = np.arctan(0.6) + 0.02, np.arctan(0.6) - 0.05
    records = simulate(np.zeros(4), 0.5, [effect("floor_slope", ["ground"], **{which: steep})])
    assert acceleration(records, axis) == pytest.approx(-GRAVITY * (np.sin(steep) - 0.6 * np.cos(steep)), rel=0.01)
    held = simulate(np.zeros(4), 0.5, [effect("floor_slope", ["ground"], **{which: gentle})])
    assert abs(held[-1, axis] - held[0, axis]) < 2e-5


def test_friction_coefficients_act_where_they_should():
    slope = effect("floor_slope", ["ground"], roll=0.5)
    down = -GRAVITY * np.sin(0.5)

    def expected(mu):
        return down + mu * GRAVITY * np.cos(0.5)

    level = simulate(np.zeros(4), 0.3, [slope, effect("friction_level", ["ground"], mu=0.3)])
    assert acceleration(level, 1) == pytest.approx(expected(0.3), rel=0.01)
    across = simulate(np.zeros(4), 0.3, [slope, effect("friction_anisotropy", ["ground"], ratio=0.5)])
    assert acceleration(across, 1) == pytest.approx(expected(0.3), rel=0.01)
    weak = simulate(np.zeros(4), 0.3, [slope, effect("slip_weakening", ["ground"], mu_k=0.2, slip_speed=0.01)])
    assert acceleration(weak, 1) == pytest.approx(expected(0.2), rel=0.02)
    patch = effect("friction_patch", ["ground"], mu=0.1, x_min=-9.0, x_max=9.0, y_min=-99.0, y_max=99.0)
    assert acceleration(simulate(np.zeros(4), 0.3, [slope, patch]), 1) == pytest.approx(expected(0.1), rel=0.01)
    far = effect("friction_patch", ["ground"], mu=0.1, x_min=50.0, x_max=60.0)
    kept = simulate(np.zeros(4), 0.3, [effect("floor_slope", ["ground"], roll=0.3), far])
    assert np.ptp(kept[:, 1]) < 1e-5


def test_creep_speed_under_a_steady_pull():
    creep, pull = 0.05, 6.0
    records = simulate(
        np.zeros(4), 1.0, [effect("tyre_creep", WHEELS, creep_speed=creep), effect("external_force", ["body"], fx=pull)]
    )
    expected = creep * np.arctanh(pull / (0.6 * MASS * GRAVITY))
    assert speed(records)[500:].mean() == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("compliance", [0.05, 0.2])
def test_an_elastic_tread_slips_in_proportion_to_traction(compliance):
    tread = effect("tyre_brush", WHEELS, slip_compliance=compliance, relaxation_length=0.005)
    records = simulate(np.full(4, 4.0), 2.5, [tread, effect("external_force", ["body"], fx=-6.0)])
    rim = 0.034 * records[2000:, 19:23].mean()
    assert 1 - speed(records)[2000:].mean() / rim == pytest.approx(compliance * 6.0 / (MASS * GRAVITY), rel=0.02)


def test_an_elastic_tread_gives_way_and_holds_a_parked_robot():
    tread = effect("tyre_brush", WHEELS, slip_compliance=0.5, relaxation_length=0.01)
    slope = [effect("floor_slope", ["ground"], pitch=0.05), effect("coulomb_friction", WHEELS, torque=5.0)]
    soft, rigid = simulate(np.zeros(4), 1.0, [tread, *slope]), simulate(np.zeros(4), 1.0, slope)
    assert soft[-1, 0] - rigid[-1, 0] == pytest.approx(-0.5 * 0.01 * np.tan(0.05), rel=0.05)
    assert abs(soft[-1, 0] - soft[-300, 0]) < 2e-6


def test_bumps_push_along_their_normal():
    """Nearly without friction a robot on a slope of the floor itself is pushed down it; vertical forces leave it there."""
    waves = np.zeros((8, 4))
    waves[0] = 0.1, 0.5, 0.0, 0.0
    icy = [effect("friction_level", ["ground"], mu=0.01)]
    for steepness in (0.0, 1.0):
        copy = replace(nominal(ROBOT), floor_waves=waves, steepness=steepness)
        pushed = acceleration(simulate(np.zeros(4), 0.3, icy, copy), 0)
        assert pushed == pytest.approx(-steepness * (0.05 - 0.01) * GRAVITY, rel=0.08, abs=1e-3)
    assert yielding(nominal(ROBOT), np.random.default_rng(0), 1e-4).steepness == 1.0


def test_a_flattened_tyre_rolls_on_less_than_its_radius():
    """On the radius at rest, less the share of what a load presses it deeper."""
    share, load = 0.5, effect("payload", ["body"], mass=1.5, x=0.0, y=0.0, z=0.0)
    copy = replace(nominal(ROBOT), flattening=share)
    for loads, deeper in (((), 0.0), ((load,), 1.5 * GRAVITY / 4 / 7400)):
        records = simulate(np.full(4, 4.0), 2.0, loads, copy)
        rolled = np.ptp(records[1000:, 0]) / np.ptp(records[1000:, 11:15], axis=0).mean()
        assert rolled == pytest.approx(0.034 - share * deeper, abs=2e-6)


def test_an_uneven_floor_carries_where_it_is():
    """One long wave at its steepest: the robot stands a height up, and as oblique as the floor."""
    height, number = 1e-3, 0.5
    waves = np.zeros((8, 4))
    waves[0] = height, number, 0.0, 0.0
    waves[1] = 2 * height, 0.0, 0.0, np.pi / 2
    records = simulate(np.zeros(4), 0.5, copy=replace(nominal(ROBOT), floor_waves=waves))
    flat = simulate(np.zeros(4), 0.5)
    assert records[-1, 2] - flat[-1, 2] == pytest.approx(2 * height, rel=1e-3)
    pitch = -2 * records[-1, 5]  # nose up where the floor rises along x
    assert pitch == pytest.approx(height * number, rel=1e-2)


def test_motor_torque_in_steady_driving_is_what_resists():
    constant = 12.0 / 6.388
    plain = simulate(np.full(4, 4.0), 3.0)
    total = constant * plain[2000:, 27:31].mean(axis=0).sum()
    assert total == pytest.approx(4 * 0.03, rel=1e-3)

    def extra(*effects):
        return constant * simulate(np.full(4, 4.0), 3.0, effects)[2000:, 27:31].mean(axis=0).sum() - total

    assert extra(effect("coulomb_friction", ["wheel_lf"], torque=0.05)) == pytest.approx(0.05, rel=0.01)
    assert extra(effect("viscous_friction", ["wheel_rr"], coefficient=0.02)) == pytest.approx(0.02 * 4.0, rel=0.01)
    assert extra(effect("rolling_resistance", WHEELS, coefficient=0.1)) == pytest.approx(0.1 * MASS * GRAVITY * 0.034, rel=0.01)
    assert extra(effect("external_force", ["body"], fx=-1.0)) == pytest.approx(0.034, rel=0.01)
    assert extra(effect("body_drag", ["body"], coefficient=50.0)) == pytest.approx(50 * 0.136**2 * 0.034, rel=0.01)
    ratio = effect("load_dependent_friction", WHEELS, ratio=0.2)
    assert extra(ratio) == pytest.approx(0.12 / 0.8 - 0.12, rel=0.01)
    weak = simulate(np.full(4, 4.0), 3.0, [effect("weak_motor", WHEELS, scale=0.5)])
    assert constant * weak[2000:, 27:31].mean(axis=0).sum() == pytest.approx(2 * total, rel=0.01)


def test_distance_is_radius_times_angle():
    larger = [effect("wheel_radius_error", WHEELS, scale=1.05)]
    for effects, radius in (((), 0.034), (larger, 0.034 * 1.05)):
        records = simulate(np.full(4, 3.0), 3.0, effects)
        moved, turned = records[-1] - records[1000], (records[-1] - records[1000])[11:15].mean()
        assert moved[0] == pytest.approx(radius * turned, rel=2e-3)


def lifted() -> Copy:
    """A copy whose left front wheel is too small to reach the floor, leaning on the other three."""
    copy = nominal(ROBOT)
    radius = copy.radius.copy()
    radius[0] = 0.02
    return replace(copy, radius=radius, com=np.array([-0.06, -0.06, 0.0]))


def test_free_wheel_answers_a_step_as_a_dc_motor():
    constant, stall = 12.0 / 6.388, 1.5
    resistance, inertia, dry = constant * 12.0 / stall, 2.684e-4 + 1.156e-5, 0.03
    setpoints = np.tile(np.concatenate([DOWN, np.zeros(4)]), (50, 1))
    setpoints[10:, 4] = 3.0
    records = simulate(setpoints, 0.6, copy=lifted())
    assert records[:, 38].max() == 0.0, "the wheel is in the air"
    # state: reference angle ahead, rate, 1; from the step on
    gain = constant / resistance
    matrix = np.zeros((3, 3))
    matrix[0, 1], matrix[0, 2] = -1.0, 3.0
    matrix[1, 0], matrix[1, 1] = gain * 8.63 / inertia, -gain * (constant + 0.4418) / inertia
    matrix[1, 2] = (gain * 0.4418 * 3.0 - dry) / inertia
    begin = 201  # ms; the goal is written at 200
    expected = [expm(matrix * k * 1e-3) @ [0.0, 0.0, 1.0] for k in range(1, 300)]
    assert records[begin : begin + 299, 19] == pytest.approx([state[1] for state in expected], abs=0.04)


def test_free_wheel_coasts_against_dry_and_viscous_friction():
    setpoints = np.tile(np.concatenate([DOWN, np.zeros(4)]), (100, 1))
    setpoints[:50, 4], setpoints[50:, 4] = 3.0, np.nan
    viscous = 1e-4
    records = simulate(setpoints, 1.2, [effect("viscous_friction", ["wheel_lf"], coefficient=viscous)], copy=lifted())
    inertia, dry, first = 2.684e-4 + 1.156e-5, 0.03, records[1000, 19]
    assert records[1020:, 27].max() == 0.0, "no current with the torque off"
    time = 1e-3 * np.arange(20)
    expected = (first + dry / viscous) * np.exp(-viscous / inertia * time) - dry / viscous
    assert records[1000:1020, 19] == pytest.approx(expected, abs=0.06)
    assert abs(records[1060:, 19]).max() < 1e-3


def test_supply_drops_with_the_currents():
    records = simulate(np.array([5.0, -5.0, 5.0, -5.0]), 2.0, [effect("supply_sag", ["body"], resistance=0.5)])
    drop = 12.0 - records[1000:, 37]
    assert drop.mean() == pytest.approx(0.5 * np.abs(records[1000:, 23:31]).sum(axis=1).mean(), rel=0.01)
    assert drop.mean() > 0.1


def test_payload_and_centre_of_mass_move_the_load():
    heavier = simulate(np.zeros(4), 0.5, [effect("payload", ["body"], mass=0.5, x=0.1, y=0.0, z=0.0)])[-1]
    assert heavier[38:42].sum() == pytest.approx((MASS + 0.5) * GRAVITY, rel=1e-4)
    moment = 0.175 * (heavier[38:40].sum() - heavier[40:42].sum())
    assert moment == pytest.approx(0.5 * GRAVITY * 0.1, rel=0.05)
    shifted = simulate(np.zeros(4), 0.5, [effect("com_offset", ["body"], x=0.0, y=0.02, z=0.0)])[-1]
    assert 0.16 * (shifted[38] + shifted[40] - shifted[39] - shifted[41]) == pytest.approx(2.8 * GRAVITY * 0.02, rel=0.05)


def test_zero_offset_turns_the_leg_the_other_way():
    moved = simulate(np.zeros(4), 0.5, [effect("joint_zero_offset", ["leg_lf"], angle=0.05)], copy=lifted())
    assert moved[-1, 7] == pytest.approx(np.pi / 2 - 0.05, abs=0.10 / 33), "but for the dry friction of its gear"


def test_play_lets_the_robot_roll_by_its_width():
    def between(*effects):
        """How far a forward and a backward push move the robot apart."""
        ends = [simulate(np.zeros(4), 1.0, [*effects, effect("external_force", ["body"], fx=f)])[-1, 0] for f in (0.3, -0.3)]
        return ends[0] - ends[1]

    angle = 0.04
    assert between(effect("backlash", WHEELS, angle=angle)) - between() == pytest.approx(angle * 0.034, rel=0.01)


def test_command_delay_shifts_in_time():
    setpoints = np.tile(np.concatenate([DOWN, np.zeros(4)]), (50, 1))
    setpoints[10:, 4:] = 3.0
    on_time, late = simulate(setpoints, 0.8), simulate(setpoints, 0.8, [effect("command_delay", WHEELS, delay=0.05)])
    assert late[250:700, 19] == pytest.approx(on_time[200:650, 19], abs=1e-3)


_CASES = [(name, "named") for name in (*NAMED, *LATER)] + [(name, "strange") for name in STRANGE]
_SENSOR_ONLY = {"gyro_bias", "imu_misalignment", "camera_misalignment", "camera_delay"}


@pytest.mark.parametrize(("name", "kind"), [one for one in _CASES if one[0] not in _SENSOR_ONLY])
def test_every_law_changes_the_motion(name, kind):
    """A parameter that never reaches the simulator would be a truth that nobody can find."""
    rng = np.random.default_rng(1)
    hidden = cases.named(name, 4.0, rng) if kind == "named" else cases.strange(name, 4.0, rng)
    if name == "friction_patch":
        hidden["parameters"] |= {"x_min": -0.15, "x_max": 0.3}
    time = np.arange(100)[:, None] * 0.02
    legs = DOWN + 0.2 * np.sin(4 * time + np.array([0, 0, 1, 1]))
    wheels = 4 * np.sin(3 * time) * np.array([1, -1, 1, -1]) + 3 * np.sin(2 * time)
    setpoints = np.concatenate([legs, wheels], axis=1)
    plain, changed = simulate(setpoints, 2.0), simulate(setpoints, 2.0, [hidden])
    currents, place, supply = (np.abs(changed[:, part] - plain[:, part]).max() for part in (slice(23, 31), slice(0, 2), 37))
    assert currents > 1e-2 or place > 1e-3 or supply > 0.05


def test_copies_stay_within_twice_their_tolerances():
    base = nominal(ROBOT)
    for seed in range(20):
        copy = draw(ROBOT, np.random.default_rng(seed))
        assert np.abs(copy.kp / base.kp - 1).max() <= 0.1 + 1e-12
        assert np.abs(copy.coulomb / base.coulomb - 1).max() <= 0.5 + 1e-12
        assert abs(copy.mass / base.mass - 1) <= 0.06 + 1e-12
        for inertia in (copy.inertia, *copy.leg_inertia):
            assert 2 * inertia.max() < inertia.sum()
        assert 0 <= copy.command_delay <= 0.01
        assert copy.viscous.min() >= 0
        assert np.ptp(copy.radius) > 0, "every wheel is its own"
