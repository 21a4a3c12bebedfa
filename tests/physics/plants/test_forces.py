"""Formula forces: which laws are accepted, and that the compiled kernel gives what the formula says."""

from __future__ import annotations

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.data.run_states import quaternion
from wlr_gym.physics.plants.base import TRUTH_LAYOUT
from wlr_gym.physics.plants.forces import (
    COORDINATES,
    FEATURES,
    INPUTS,
    MEMORY,
    WIND_UP,
    Force,
    compile_forces,
    force_source,
    force_values,
    generalised_forces,
    make_force,
)
from wlr_gym.physics.plants.sensors import rotation
from wlr_gym.robot import CORNERS, JOINTS

COUNT = 33
SPRING = make_force(["leg_lr"], "-k * (leg_angle - a0)", {"k": 0.8, "a0": 1.2}, {"k": "N m/rad", "a0": "rad"})
DRAG = make_force(["floor_force_x"], "-c * floor_velocity_x * abs(velocity_y)", {"c": 2.0}, {"c": "N s2/m2"})


@pytest.fixture(scope="module")
def state() -> dict[str, np.ndarray]:
    """Inputs of COUNT robots in all attitudes, with an Euler angle each that the quaternion is made of."""
    rng = np.random.default_rng(5)
    inputs = {name: rng.normal(size=COUNT) for name in INPUTS}
    yaw, pitch, roll = rng.uniform(-3, 3, COUNT), rng.uniform(-1.4, 1.4, COUNT), rng.uniform(-3, 3, COUNT)
    for k, axis in enumerate("wxyz"):
        inputs[f"quaternion_{axis}"] = quaternion(yaw, pitch, roll)[:, k]
    memory = {name: rng.uniform(-1, 1, COUNT) for name in MEMORY}
    return inputs | memory | {"yaw": yaw, "pitch": pitch, "roll": roll}


def matrix(state, precision="float64"):
    return np.stack([state[name] for name in INPUTS]).astype(precision)


def run(forces, state, precision="float64", values=None):
    kernel = compile_forces(forces, precision)
    out = np.full((len(COORDINATES), COUNT), np.nan, precision)
    values = np.repeat(kernel.values[:, None], COUNT, axis=1) if values is None else values
    memory = np.stack([state[name] for name in MEMORY]).astype(precision)
    kernel.evaluate(matrix(state, precision), np.ascontiguousarray(values, precision), memory, out, 0.001)
    return dict(zip(COORDINATES, out, strict=True))


def factor_unit(name: str, target: str) -> str:
    """Unit of the constant that turns a feature, or that of a corner, into ``target``."""
    feature = FEATURES.get(name) or FEATURES[name.rpartition("_")[0]]
    numerator, _, denominator = feature.unit.partition("/")
    return f"{target} {denominator}".strip() + "".join(f"/{unit}" for unit in numerator.split())


def of(where: str, name: str, state) -> np.ndarray:
    """The value of one feature, through a force that is nothing else."""
    force = make_force([where], f"c * {name}", {"c": 1.0}, {"c": factor_unit(name, COORDINATES[where])})
    return run([force], state)[where]


def assert_sum(where: str, expected: dict[str, np.ndarray], state) -> None:
    """Compare features, each with a weight of its own, in one formula: one compilation."""
    weights = {f"c{n}": 0.1 * (n + 1) for n in range(len(expected))}
    units = {c: factor_unit(name, "N m") for c, name in zip(weights, expected, strict=True)}
    formula = " + ".join(f"{c} * {name}" for c, name in zip(weights, expected, strict=True))
    found = run([make_force([where], formula, weights, units)], state)[where]
    total = sum(weight * values for weight, values in zip(weights.values(), expected.values(), strict=True))
    np.testing.assert_allclose(found, total, rtol=1e-12)


def test_spring_pulls_its_own_joint_only(state):
    forces = run([SPRING], state)
    np.testing.assert_allclose(forces.pop("leg_lr"), -0.8 * (state["joint_position_2"] - 1.2), rtol=1e-14)
    assert not np.any(list(forces.values()))


def test_inputs_are_the_truths_columns():
    columns = {name.replace("[", "_").replace("]", "").replace(",", "_") for name in TRUTH_LAYOUT.elements}
    for place, joint in enumerate(JOINTS):
        columns |= {c.replace(joint, str(place)) for c in columns if c.endswith(joint)}
        columns |= {c.replace(joint, str(place - 4)) for c in columns if f"_{joint}_" in c}
    assert set(INPUTS) - columns == {"supply_voltage"}


def test_attitude_is_that_of_the_quaternion(state):
    for name in ("roll", "pitch", "yaw"):
        np.testing.assert_allclose(of("body_force_x", name, state), state[name], atol=1e-12)


def test_floor_velocity_is_the_body_velocity_turned(state):
    body = np.stack([state[f"linear_velocity_in_body_{a}"] for a in "xyz"], axis=1)
    floor = np.einsum("nij,nj->ni", rotation(state["yaw"], state["pitch"], state["roll"]), body)
    for k, axis in enumerate("xy"):
        np.testing.assert_allclose(of("floor_force_y", f"floor_velocity_{axis}", state), floor[:, k], atol=1e-12)


@pytest.mark.parametrize("joint", JOINTS)
def test_features_of_a_joint_and_of_its_corner(state, joint):
    j, corner = JOINTS.index(joint), JOINTS.index(joint) % 4
    expected = {
        "angle": state[f"joint_position_{j}"],
        "rate": state[f"joint_velocity_{j}"],
        "wind_up": state[f"wind_up_{j}"],
        "motor_torque": state[f"motor_torque_{j}"],
        "leg_angle": state[f"joint_position_{corner}"],
        "leg_rate": state[f"joint_velocity_{corner}"],
        "leg_torque": state[f"motor_torque_{corner}"],
        "wheel_angle": state[f"joint_position_{4 + corner}"],
        "wheel_rate": state[f"joint_velocity_{4 + corner}"],
        "wheel_torque": state[f"motor_torque_{4 + corner}"],
        "leg_torque_opposite": state[f"motor_torque_{(1, 0, 3, 2)[corner]}"],
        "wheel_torque_opposite": state[f"motor_torque_{(5, 4, 7, 6)[corner]}"],
        "normal_force": state[f"contact_force_{corner}_z"],
        "slip_velocity_x": state[f"slip_velocity_{corner}_x"],
        "slip_velocity_y": state[f"slip_velocity_{corner}_y"],
        "slip_speed": np.hypot(state[f"slip_velocity_{corner}_x"], state[f"slip_velocity_{corner}_y"]),
    }
    assert set(expected) == {name for name, feature in FEATURES.items() if feature.scope != "robot"}
    assert_sum(joint, expected, state)
    there = {f"{name}_{CORNERS[corner]}": values for name, values in expected.items() if FEATURES[name].scope == "corner"}
    assert_sum("body_torque_yaw", there, state)


def test_several_places_get_the_law_of_their_own_joint(state):
    force = make_force(JOINTS, "-d * rate", {"d": 0.3}, {"d": "N m s/rad"})
    forces = run([force], state)
    for j, joint in enumerate(JOINTS):
        np.testing.assert_allclose(forces[joint], -0.3 * state[f"joint_velocity_{j}"], rtol=1e-14)


def test_the_kernel_moves_time_and_the_wind_up_it_is_asked_for_on():
    """A joint that turns on at one rate winds up along an exponential of its way, and after turning back falls twice as far."""
    force = make_force(["leg_lf"], "-t * wind_up", {"t": 0.5}, {"t": "N m"})
    inputs, memory = np.zeros((len(INPUTS), 1)), np.zeros((len(MEMORY), 1))
    memory[2] = 0.3
    out = np.zeros((len(COORDINATES), 1))
    step, rate, row = 1e-4, 0.4, INPUTS.index("joint_velocity_0")
    kernel = compile_forces([force])
    for sign, start in ((1.0, 0.0), (-1.0, None)):
        start = memory[1, 0] if start is None else start
        inputs[row] = sign * rate
        for _ in range(2000):
            kernel.evaluate(inputs, kernel.values[:, None], memory, out, step)
        way = 2000 * step * rate / WIND_UP
        assert memory[1, 0] == pytest.approx(sign + (start - sign) * np.exp(-way), abs=2e-3)
    kernel.evaluate(inputs, kernel.values[:, None], memory, out, 0.0)
    assert out[list(COORDINATES).index("leg_lf"), 0] == -0.5 * memory[1, 0]
    assert memory[0, 0] == pytest.approx(0.4)
    assert memory[2, 0] == 0.3  # no formula asks for it


def test_forces_on_one_place_add_and_constants_stay_apart(state):
    other = make_force(["leg_lr", "wheel_lf"], "k * sin(angle)", {"k": 0.25}, {"k": "N m"})
    both, first, second = run([SPRING, other], state), run([SPRING], state), run([other], state)
    for name in COORDINATES:
        np.testing.assert_allclose(both[name], first[name] + second[name], rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_same_bits_alone_and_in_a_batch(state, precision):
    laws = [
        SPRING,
        DRAG,
        make_force(["wheel_rf"], "-c * normal_force * tanh(slip_speed / v) * exp(-abs(rate) / w)",
                   {"c": 0.01, "v": 0.1, "w": 2.0}, {"c": "m", "v": "m/s", "w": "rad/s"}),
        make_force(["body_torque_pitch"], "k * sin(yaw) + k * pitch", {"k": 0.4}, {"k": "N m"}),
        make_force(["floor_force_z"], "a * sin(w * time)", {"a": 0.7, "w": 1.3}, {"a": "N", "w": "rad/s"}),
    ]  # fmt: skip
    kernel, whole = compile_forces(laws, precision), run(laws, state, precision)
    inputs, values = matrix(state, precision), kernel.values[:, None].astype(precision)
    for k in range(COUNT):
        alone = np.zeros((len(COORDINATES), 1), precision)
        memory = np.array([[state[name][k]] for name in MEMORY], precision)
        kernel.evaluate(np.ascontiguousarray(inputs[:, k : k + 1]), values, memory, alone, 0.001)
        assert np.array_equal(alone[:, 0], np.stack(list(whole.values()))[:, k])
    reference = generalised_forces(laws, state)
    for name, value in whole.items():
        bound = 1e-12 if precision == "float64" else 2e-4
        np.testing.assert_allclose(value, reference.get(name, 0.0), rtol=bound, atol=bound)


def test_constants_are_data_and_may_differ_between_robots(state):
    stiff = Force(SPRING.where, SPRING.formula, {"k": 5.0, "a0": 0.0})
    assert force_source([SPRING], "float64") == force_source([stiff], "float64")
    assert compile_forces([SPRING]).evaluate is compile_forces([stiff]).evaluate
    assert force_values([SPRING, DRAG]).tolist() == [0.8, 1.2, 2.0]
    values = np.stack([np.linspace(0, 1, COUNT), np.linspace(-1, 1, COUNT)])
    found = run([SPRING], state, values=values)["leg_lr"]
    np.testing.assert_allclose(found, -values[0] * (state["joint_position_2"] - values[1]), rtol=1e-14)


def test_a_formula_that_is_zero_is_exactly_zero(state):
    assert not np.any(list(run([make_force(["leg_lf"], "0 * angle", {}, {})], state).values()))


def test_the_users_text_never_reaches_the_kernel():
    force = make_force(["leg_lf"], "-evil_name * angle", {"evil_name": 1.0}, {"evil_name": "N m/rad"})
    assert "evil" not in force_source([force], "float64")


@pytest.mark.parametrize(
    ("where", "formula", "parameters", "units", "words"),
    [
        (["leg_fl"], "0", {}, {}, ["unknown where 'leg_fl'", "did you mean 'leg_"]),
        ([], "0", {}, {}, ["where = []", "leg_lf"]),
        (["leg_lf"], "k * leg_angl", {"k": 1}, {"k": "N m"}, ["unknown name 'leg_angl'", "did you mean 'leg_angle'"]),
        (["leg_lf"], "k * leg_angle", {"k": 1}, {}, ["parameter 'k': its unit is missing"]),
        (["leg_lf"], "k * leg_angle", {}, {"k": "N m"}, ["unknown parameter 'k'"]),
        (["leg_lf"], "k * leg_angle", {}, {}, ["unknown name 'k'"]),
        (["leg_lf"], "k * leg_angle", {"k": 1, "b": 2}, {"k": "N m", "b": "m"}, ["'b' does not occur"]),
        (["leg_lf"], "k * leg_angle", {"k": "much"}, {"k": "N m"}, ["k = 'much'", "finite number"]),
        (["leg_lf"], "k * leg_angle", {"k": float("nan")}, {"k": "N m"}, ["k = nan"]),
        (["leg_lf"], "k * leg_angle", {"k": 1}, {"k": "N m/deg"}, ["unknown unit 'deg'"]),
        (["leg_lf"], "rate * leg_angle", {"rate": 1}, {"rate": "N m"}, ["'rate'", "name of a feature"]),
        (["leg_lf"], "leg_rate_rr * 1", {"leg_rate_rr": 1}, {"leg_rate_rr": "N m"}, ["name of a feature"]),
        (["leg_lf"], "k * leg_angle", {"k": 1}, {"k": "N"}, ["is in N; leg_lf takes N m"]),
        (["body_force_x"], "k * velocity_x", {"k": 1}, {"k": "N m s/m"}, ["body_force_x takes N"]),
        (["leg_lf", "body_force_x"], "k * pitch", {"k": 1}, {"k": "N m"}, ["body_force_x takes N"]),
        (["body_torque_yaw"], "k * rate", {"k": 1}, {"k": "N m s"}, ["'rate' belongs to a joint", "body_torque_yaw is none"]),
        (["body_torque_yaw"], "k * leg_rate", {"k": 1}, {"k": "N m s"}, ["name a corner: leg_rate_lf"]),
        (["leg_lf"], "k * leg_rate + leg_angle", {"k": 1}, {"k": "N m s"}, ["do not go together"]),
        (["leg_lf"], "warmth", {}, {}, ["unknown name 'warmth'"]),
        (["leg_lf"], "1", {}, {}, ["is in pure number; leg_lf takes N m"]),
    ],
)
def test_bad_forces_are_refused(where, formula, parameters, units, words):
    with pytest.raises(InputError) as error:
        make_force(where, formula, parameters, units)
    for word in words:
        assert word in str(error.value)
