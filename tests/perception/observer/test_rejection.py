"""Camera and optical flow in the slip observer: they come and go, fail, and are not believed then."""

from __future__ import annotations

import numpy as np
import pytest

from studies.observer.runs import PERIOD, Runs, changed, estimated, observe, simulate, without_flow
from wlr_gym.perception.observer import SlipObserver, trust
from wlr_gym.perception.observer.observer import load_trust
from wlr_gym.physics.plants.base import SENSOR_LAYOUT
from wlr_gym.robot import load_robot
from wlr_gym.robot.description import FlowSensor

POSE, IS_NEW = SENSOR_LAYOUT.slices["camera_pose"], SENSOR_LAYOUT.slices["camera_is_new"].start
FLOW, FLOW_IS_NEW = SENSOR_LAYOUT.slices["flow"], SENSOR_LAYOUT.slices["flow_is_new"].start
NOMINAL = load_robot("nominal")
WITH_FLOW = NOMINAL.model_copy(
    update={"sensors": NOMINAL.sensors.model_copy(update={"flow": FlowSensor.model_validate({"position": (0.0, 0.0, -0.035)})})}
)


@pytest.fixture(scope="module")
def runs() -> Runs:
    return simulate("gibbs_appell", "slippery", "commands", 8, 6.0, seed=21, robot=WITH_FLOW)


def error_of(runs: Runs, found: np.ndarray) -> np.ndarray:
    """Error of the velocity (T + 1, N, 2), m/s."""
    return estimated(found, "linear_velocity_in_body") - runs.true("linear_velocity_in_body")[..., :2]


def test_what_is_there_differs_from_robot_to_robot_and_changes_on_the_way(runs):
    def change(sensors):
        sensors[:, :4, IS_NEW] = 0.0  # no camera
        sensors[150:, 4:6, IS_NEW] = 0.0  # camera lost
        sensors[:150, 6:, IS_NEW] = 0.0  # camera found
        sensors[:, ::2, FLOW_IS_NEW] = 0.0

    mixed = changed(runs, change)
    together = observe(mixed, camera=True)
    for i in range(8):
        alone = observe(Runs(runs.robot, np.ascontiguousarray(mixed.sensors[:, i : i + 1]), runs.truth), camera=True)
        np.testing.assert_array_equal(together[:, i : i + 1], alone)
    sigma = estimated(together, "linear_velocity_sigma")[..., 0]
    assert (sigma[-50:, 6:].mean(0) < 0.7 * sigma[-50:, ::2][:, :2].mean()).all()  # a camera is worth having
    np.testing.assert_array_equal(together[:150, 5:6], observe(runs, camera=True)[:150, 5:6])


def test_flow_stands_in_for_the_camera(runs):
    skid = slice(25, None)
    none, flow = (np.sqrt((error_of(r, observe(r, camera=False))[skid] ** 2).mean()) for r in (without_flow(runs), runs))
    assert flow < 0.9 * none
    assert estimated(observe(runs, camera=False), "flow_rejected").mean() < 0.01


def test_scale_and_rotation_of_the_flow_sensor_are_learned_from_wheels_that_grip():
    runs = simulate("gibbs_appell", "none", "commands", 8, 8.0, seed=3, robot=WITH_FLOW, flow__scale=1.05, flow__mount_yaw=0.05)
    observer, everyone = SlipObserver(runs.robot, PERIOD, 8, False), np.ones(8, bool)
    observer.reset(everyone, runs.sensors[0])
    for readings in runs.sensors[1:]:
        observer.update(everyone, readings)
    scale, rotation = observer._states["lens"].T
    assert np.abs(np.median(scale) - (1 / 1.05 - 1)) < 0.02
    assert np.abs(np.median(rotation) - 0.05) < 0.02


FAULTS = {
    "one wild frame": lambda s, at: s.__setitem__((slice(at, at + 2), slice(None), POSE.start), 3.0),
    "garbage for a second": lambda s, at: s.__setitem__(
        (slice(at, at + 50), slice(None), POSE), np.random.default_rng(1).uniform(-1, 1, (50, s.shape[1], 3))
    ),
    "moved by 5 cm": lambda s, at: s[at:, :, POSE].__iadd__((0.05, 0.02, 0.05)),
    "another marker for a second": lambda s, at: s[at : at + 50, :, POSE].__iadd__((0.3, 0.0, 0.0)),
    "frozen": lambda s, at: s.__setitem__((slice(at, None), slice(None), POSE), s[at - 1, :, POSE]),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("at", [60, 150])
def test_a_wrong_pose_is_refused_and_said_to_be(runs, fault, at):
    plain = without_flow(runs)
    wrong = changed(plain, lambda sensors: FAULTS[fault](sensors, at))
    good, found, blind = observe(plain, camera=True), observe(wrong, camera=True), observe(plain, camera=False)
    assert estimated(found, "camera_rejected")[at : at + 60].max(axis=0).all()
    assert not estimated(good, "camera_rejected")[at : at + 60].any()
    off, lost = (np.abs(estimated(f, "position") - estimated(good, "position"))[at:].max() for f in (found, blind))
    assert off < lost + 5e-3
    speed = np.abs(error_of(runs, found)[at:]).max()
    assert speed < 1.2 * max(np.abs(error_of(runs, good)[at:]).max(), np.abs(error_of(runs, blind)[at:]).max()) + 2e-3


@pytest.mark.parametrize("wrong", [(0.0, 0.0), (3.0, -3.0)])
def test_wrong_flow_is_refused_and_said_to_be(runs, wrong):
    def change(sensors):
        sensors[150:, :, FLOW] = wrong
        sensors[:, :, IS_NEW] = 0.0

    found, blind = observe(changed(runs, change), camera=False), observe(without_flow(runs), camera=False)
    assert estimated(found, "flow_rejected")[160:250].mean() > 0.3  # a robot at rest may well read 0
    ours, theirs = (np.sqrt((error_of(runs, f)[150:250] ** 2).mean()) for f in (found, blind))
    assert ours < theirs + 5e-3


def test_the_compiled_network_is_the_one_that_was_trained():
    """Second implementation, with matrices."""
    runs = simulate("gibbs_appell", "split", "commands", 1, 0.5, seed=2)
    observer, everyone = SlipObserver(runs.robot, PERIOD, 1, False), np.ones(1, bool)
    observer.reset(everyone, runs.sensors[0])
    net = load_trust()

    def squash(x):
        x = np.clip(x, -3, 3)
        return x * (27 + x * x) / (27 + 9 * x * x)

    for readings in runs.sensors[1:]:
        memory = observer._states["memory"][0].copy()
        observer.update(everyone, readings)
        own = np.concatenate([observer._work["seen_by"][0][:, : trust.CLUES], memory, memory[[2, 3, 0, 1]]], axis=1)
        alike = np.concatenate([observer._work["alike"][0][: trust.CLUES_ALIKE], memory.mean(0)])
        total = own @ net["gate"].T + net["gate_alike"] @ alike + net["gate_bias"]
        share = 0.5 + 0.5 * squash(0.5 * total[:, : trust.MEMORY])
        memory += share * (squash(total[:, trust.MEMORY :]) - memory)
        said = np.concatenate([own[:, : trust.CLUES], memory], axis=1) @ net["output"].T
        said += net["output_alike"] @ alike[: trust.CLUES_ALIKE] + net["output_bias"]
        np.testing.assert_allclose(observer._states["memory"][0], memory, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(observer._states["trust"][0], np.exp(np.clip(said[:, :2], 0, 14.5)), rtol=1e-9)


@pytest.mark.slow
def test_the_filter_that_was_trained_is_the_compiled_one():
    """studies/observer/training.py writes the filter again in torch."""
    torch = pytest.importorskip("torch")
    from studies.observer import training

    runs = simulate("gibbs_appell", "slippery", "commands", 4, 2.0, seed=4)
    d = {name: torch.from_numpy(values) for name, values in training._prepared(runs).items()}
    net = training.Trust()
    net.start_from(load_trust())
    for name, values in net.arrays().items():
        np.testing.assert_allclose(values, load_trust()[name], rtol=1e-5)
    never = {f"{name}_{end}": torch.full((4,), 1000) for name in ("camera", "flow") for end in ("on", "off")}
    zero = torch.zeros(101, 4, 2)
    sensors = never | {"camera_noise": zero, "flow_noise": zero, "flow_scale": torch.zeros(4)}
    state, errors, sigmas = training.begin(d, net), [], []
    with torch.no_grad():
        for i in range(1, 101):
            state, error, variance = training.advance(d, i, state, net, sensors)
            errors.append(error.numpy())
            sigmas.append(np.sqrt(variance.numpy()))
    found = observe(runs, camera=False)
    np.testing.assert_allclose(np.array(errors), error_of(runs, found)[1:], atol=1e-3)
    np.testing.assert_allclose(np.array(sigmas), estimated(found, "linear_velocity_sigma")[1:], rtol=0.05, atol=1e-4)
