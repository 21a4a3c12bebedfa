"""The engine as a plant: order of its outputs, single precision, bits, and what its kernels are compiled anew for."""

from __future__ import annotations

import json
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulators import ROBOT, random_setpoints, rollout

import wlr_gym
from wlr_gym.base import compiled
from wlr_gym.base.errors import InputError
from wlr_gym.physics.codegen import compilation
from wlr_gym.physics.plants.base import TRUTH_LAYOUT, PlantOptions, PlantState, standing_state
from wlr_gym.physics.plants.forces import make_force
from wlr_gym.physics.plants.gibbs_appell import kernel as engine
from wlr_gym.physics.plants.gibbs_appell.kernel import outputs
from wlr_gym.physics.plants.gibbs_appell.plant import TILES_AT_A_TIME, GibbsAppellPlant
from wlr_gym.physics.plants.mujoco import kernel as mujoco
from wlr_gym.physics.plants.mujoco.step import ON_RELIEF
from wlr_gym.physics.plants.sensors import RAW_LAYOUT
from wlr_gym.robot import JOINTS, WHEEL_SLICE, WHEELS
from wlr_gym.robot.parameters import Parameters


def kernel_name(element):
    """The kernel's name of a TRUTH_LAYOUT element."""
    channel, _, labels = element.partition("[")
    labels = labels.rstrip("]").split(",") if labels else []
    numbers = {name: JOINTS.index(name) for name in JOINTS}
    numbers |= {} if channel in ("motor_torque", "friction_torque", "joint_position", "joint_velocity") else {
        wheel: corner for corner, wheel in enumerate(WHEELS)
    }  # fmt: skip
    own = f"shown_{channel}" if channel.endswith("_energy") else channel
    return "_".join([own, *(str(numbers.get(label, label)) for label in labels)])


def test_kernel_writes_its_columns_in_the_layouts_order():
    assert list(outputs()[: TRUTH_LAYOUT.width]) == [kernel_name(element) for element in TRUTH_LAYOUT.elements]
    raw = outputs()[TRUTH_LAYOUT.width :]
    assert len(raw) == RAW_LAYOUT.width + 1  # the heading's cosine and sine stand for the yaw
    assert raw[-2:] == ("heading_cosine", "heading_sine")


def test_unknown_precision_is_refused_with_the_nearest():
    with pytest.raises(InputError, match=r"unknown precision 'float46'.*'float64'.*valid: float32, float64"):
        GibbsAppellPlant(ROBOT, 1, PlantOptions(precision="float46"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"physics_step": 0.0}, r"physics_step 0.0 s must be in \(0, control_period"),
        ({"physics_step": 0.03}, r"physics_step 0.03 s must be in"),
        ({"physics_step": 0.003}, "does not divide the control period"),
        ({"threads": 0}, "threads = 0, expected 1 or more"),
        ({"threads": 1.5}, "threads"),
        ({"physics_step": "a"}, "physics_step"),
        ({"precision": 64}, "precision"),
    ],
)
def test_options_that_cannot_be_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        PlantOptions(**options)


def test_options_are_numbers_of_any_kind():
    """The kinds that ``EnvironmentOptions`` takes; a step in single precision is another number than it looks."""
    kinds: Any = {"control_period": Fraction(1, 50), "physics_step": np.float64(0.002), "threads": np.int64(2)}
    options = PlantOptions(**kinds)
    assert options == PlantOptions(physics_step=0.002, threads=2)
    assert [type(getattr(options, name)) for name in kinds] == [float, float, int]
    with pytest.raises(InputError, match=r"physics_step 0\.00100000004\d+ s does not divide"):
        PlantOptions(physics_step=np.float32(0.001))  # type: ignore[arg-type]


# ---- single precision over hours and kilometres: it follows double precision as well as at the start -----------------


COUNT = 16
QUIET = {"sensor_noise": False}


def start(parameters: Parameters, angle: float, place: float) -> PlantState:
    """Standing, with wheels that have turned by ``angle`` (rad), ``place`` (m) from the origin."""
    state = standing_state(ROBOT, parameters)
    state.joint_position[:, WHEEL_SLICE] += angle
    state.reference_position[:, WHEEL_SLICE] += angle
    state.position[:, :2] += place
    return state


def setpoints() -> np.ndarray:
    """Ahead, back, arcs and turns on the spot."""
    legs = np.full((COUNT, 4), ROBOT.home.leg_angle)
    rng = np.random.default_rng(1)
    speed, turn = rng.uniform(-6, 6, (COUNT, 1)), rng.uniform(-2, 2, (COUNT, 1))
    return np.hstack([legs, speed + turn * np.array([[-1.0, 1.0, -1.0, 1.0]])])


def drive(
    precision: str, ticks: int, angle: float = 0.0, place: float = 0.0, strip: float | None = None
) -> dict[str, np.ndarray]:
    """Return travel (m), yaw (rad) and wheel turns (rad) since the start; ``strip``: friction of a part of the floor."""
    plant = GibbsAppellPlant(ROBOT, COUNT, PlantOptions(precision=precision, **QUIET))
    parameters = Parameters.nominal(ROBOT, COUNT)
    if strip is not None:
        parameters["patch.mu"][:, 0] = strip
        for bound, value in {"x_min": 0.5, "x_max": 1.0, "y_min": -9.0, "y_max": 9.0}.items():
            parameters[f"patch.{bound}"][:, 0] = place + value
    readings = plant.reset(parameters=parameters, state=start(parameters, angle, place))
    given, travel, yaw = setpoints(), np.zeros(COUNT), np.zeros(COUNT)
    begin, last = readings["joint_position"].copy(), plant._raw[:, -3:].copy()
    for _ in range(ticks):
        readings = plant.step(given)
        pose = plant._raw[:, -3:]
        travel += np.linalg.norm(pose[:, :2] - last[:, :2], axis=1)
        yaw += (pose[:, 2] - last[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
        last = pose.copy()
    turned = (readings["joint_position"] - begin)[:, WHEEL_SLICE]
    place_now = plant.truth()["position"][:, :2] - place
    return {"travel": travel, "yaw": yaw, "turned": turned.copy(), "place": place_now}


def test_wheels_that_have_turned_far_and_places_far_away_change_nothing() -> None:
    near, far = drive("float32", 250, strip=0.3), drive("float32", 250, angle=1e5, place=900.0, strip=0.3)
    double = drive("float64", 250, strip=0.3)
    for name, bound in {"travel": 2e-4, "yaw": 5e-4, "turned": 2e-3, "place": 1e-3}.items():
        assert np.abs(near[name] - double[name]).max() < bound, name
        assert np.abs(far[name] - double[name]).max() < bound, name


def test_encoders_and_places_have_no_jumps_and_states_go_on() -> None:
    plant = GibbsAppellPlant(ROBOT, COUNT, PlantOptions(precision="float32", **QUIET))
    state = start(plant.parameters, 3.0, 1e3)
    readings = plant.reset(state=state)
    given, before, place = setpoints(), readings["joint_position"].copy(), plant.truth()["position"].copy()
    np.testing.assert_allclose(plant.mechanical_state().reference_position, state.reference_position, atol=1e-6)
    np.testing.assert_allclose(plant.truth()["joint_position"], state.joint_position, atol=1e-6)
    for _ in range(60):  # more than a turn of a wheel
        readings = plant.step(given)
        assert np.abs(readings["joint_position"] - before)[:, WHEEL_SLICE].max() < 0.2
        assert np.abs(plant.truth()["position"] - place).max() < 0.01
        before, place = readings["joint_position"].copy(), plant.truth()["position"].copy()
    assert np.ptp(before[:, WHEEL_SLICE]) > 6.0
    other = GibbsAppellPlant(ROBOT, COUNT, PlantOptions(precision="float32", **QUIET))
    other.reset(state=plant.mechanical_state())
    np.testing.assert_array_equal(other.truth()["joint_position"], plant.truth()["joint_position"])
    np.testing.assert_array_equal(other.truth()["position"], plant.truth()["position"])
    np.testing.assert_allclose(
        other.mechanical_state().reference_position, plant.mechanical_state().reference_position, atol=1e-7
    )


@pytest.mark.slow
def test_formulas_see_the_whole_wheel_angle() -> None:
    angles = []
    for precision in ("float32", "float64"):
        force = make_force(("body_force_x",), "k * wheel_angle_lf", {"k": 1e-3}, {"k": "N/rad"})
        plant = GibbsAppellPlant(ROBOT, 1, PlantOptions(precision=precision, **QUIET), (force,))
        plant.reset(state=start(plant.parameters, 5000.0, 0.0))
        for _ in range(25):
            plant.step(np.hstack([np.full((1, 4), ROBOT.home.leg_angle), np.zeros((1, 4))]))
        angles.append(plant.truth()["motor_torque"][0, WHEEL_SLICE].mean())
    assert abs(angles[1]) > 0.01  # 5 N on the body
    assert angles[0] == pytest.approx(angles[1], rel=1e-3)


@pytest.mark.slow
def test_an_hour_of_driving() -> None:
    """Travel within 0.1 %, and yaw within 0.1 % of robots that turn by more than 0.015 rad/s (a slower turn is as far off)."""
    hour = 3600 * 50
    single, double = drive("float32", hour), drive("float64", hour)
    assert np.abs(single["travel"] / double["travel"] - 1.0).max() < 1e-3
    assert np.abs(single["turned"] / double["turned"] - 1.0).max() < 1e-3
    turning = np.abs(double["yaw"]) > 0.015 * 3600.0
    assert turning.sum() >= 12
    assert np.abs(single["yaw"] / double["yaw"] - 1.0)[turning].max() < 1e-3
    assert np.abs(single["yaw"] - double["yaw"]).max() < 0.06


# --- the same bits alone, in a batch, on any threads, and again -------------------------------------------------------


GOLDEN = Path(__file__).parents[2] / "golden" / "engine_rollout.json"


def random_parameters(count, seed=3):
    """Robots that differ from each other; row i depends on i alone."""
    parameters = Parameters.nominal(ROBOT, count)
    for row in range(count):
        rng = np.random.default_rng([seed, row])
        parameters["ground.mu_x"][row] = rng.uniform(0.2, 0.9, 4)
        parameters["ground.mu_y"][row] = rng.uniform(0.2, 0.9, 4)
        parameters["body.com_offset"][row] = rng.uniform(-0.01, 0.01, 3)
        parameters["wheel.radius"][row] *= rng.uniform(0.98, 1.02, 4)
        parameters["command.delay"][row] = rng.uniform(0.0, 0.03)
    return parameters


def test_two_threads_are_really_used():
    count = 16 * TILES_AT_A_TIME
    plant = GibbsAppellPlant(ROBOT, count, PlantOptions(threads=2))
    assert plant._pool is not None
    plant.close()
    assert plant._pool is None
    plant.step(np.zeros((count, 8)))  # goes on without threads


def test_float32_follows_float64():
    parameters, setpoints, seeds = random_parameters(16), random_setpoints(16, 25), np.arange(16, dtype=np.uint64)
    double, single = (
        rollout("gibbs_appell", parameters, setpoints, seeds, precision)[0][-1] for precision in ("float64", "float32")
    )
    error = np.abs(double[:, :3] - single[:, :3]).max()
    assert error < 1e-5
    assert not np.array_equal(double, single)


def test_golden_rollout():
    """Pose of eight different robots after 2 s of random driving.

    Compared to 1e-8 m, not bit by bit: the kernel is strict IEEE arithmetic, but numpy's exp and sin, which prepare its
    constants, differ by a rounding from one kind of processor to the next.
    """
    truth, _ = rollout("gibbs_appell", random_parameters(8), random_setpoints(8, 100), np.arange(8, dtype=np.uint64))
    golden = json.loads(GOLDEN.read_text())
    expected = np.array([[float.fromhex(number) for number in row] for row in golden["position_and_quaternion"]])
    np.testing.assert_allclose(truth[-1, :, :7], expected, atol=1e-8, rtol=0)


# ---- a cached kernel is of the code that is loaded: its key holds every module that takes part in its trace ----------


PACKAGE = Path(wlr_gym.__file__).parent
RELIEF = ("relief", "waves", "bumps", "piece", "pieces")
FAMILIES = frozenset({"drive", "backlash", "ground", "compliance", "rolling_resistance", "forces", *RELIEF})


def called_files(function):
    """The package's files of which something runs while ``function`` does."""
    seen = set()

    def profile(frame, event, argument):
        seen.add(frame.f_code.co_filename)

    sys.setprofile(profile)
    try:
        function()
    finally:
        sys.setprofile(None)
    return {Path(name).relative_to(PACKAGE) for name in seen if Path(name).is_relative_to(PACKAGE)}


@pytest.mark.parametrize(
    ("kernel", "source"),
    [(engine, lambda: engine.kernel_source(FAMILIES, "float64", 8)), (mujoco, lambda: mujoco.kernel_source(ON_RELIEF))],
    ids=["gibbs_appell", "mujoco"],
)
def test_the_key_holds_every_module_of_the_trace(kernel, source):
    held = {Path(module.__file__).relative_to(PACKAGE) for module in kernel.TRACED}
    assert called_files(source) <= held


@pytest.mark.parametrize("changed", [compiled, compilation])
def test_kernels_are_compiled_anew_with_other_intrinsics(monkeypatch, changed):
    def name():
        return compilation.load_module("test_key", "ONE = 1\n").__name__

    before = name()
    monkeypatch.setattr(compilation, "source_of", lambda *modules: "other" if changed in modules else "")
    assert before != name()
