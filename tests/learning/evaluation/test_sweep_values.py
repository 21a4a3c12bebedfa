"""Every sweep sets what its axis says, seen in what the robots were given."""

import numpy as np
import pytest

from wlr_gym.learning.evaluation import Rollout, play, read_subjects
from wlr_gym.learning.evaluation.conditions import LEFT_FRICTION, SLOPE_FRICTION, SWEEPS
from wlr_gym.robot.parameter_table import ELEMENTS

IDLE = read_subjects(["do_nothing"])
LEFT, RIGHT = [0, 2], [1, 3]


def given(name: str, task: str) -> list[tuple[float, Rollout]]:
    """The first, middle and last point of a sweep: its value, and two episodes of two environment steps."""
    sweep = SWEEPS[name]
    chosen = [sweep.points[k] for k in (0, len(sweep.points) // 2, -1)]
    conditions = {condition.label: condition for condition in sweep.conditions({"episode_length": 0.04}, 2)}
    played: list[Rollout] = []
    play(f"WLR-{task}-v0", IDLE, [conditions[sweep.label(p)] for p in chosen], watch=lambda *seen: played.append(seen[-1]))
    return [(point.value, rollout) for point, rollout in zip(chosen, played, strict=True)]


def parameter(rollout: Rollout, name: str) -> np.ndarray:
    """All elements of a parameter (episodes, elements)."""
    return rollout.parameters[:, [name in (element, element.partition("[")[0]) for element in ELEMENTS]]


def test_friction_is_the_same_under_every_wheel():
    for friction, rollout in given("friction", "Velocity"):
        np.testing.assert_allclose(rollout.friction, friction)


def test_split_is_the_ratio_of_right_to_left():
    for ratio, rollout in given("split", "Velocity"):
        np.testing.assert_allclose(rollout.friction[:, LEFT], LEFT_FRICTION)
        np.testing.assert_allclose(rollout.friction[:, RIGHT], ratio * LEFT_FRICTION)


@pytest.mark.parametrize("name", ["slope", "grip"])
def test_slopes_are_so_much_less_steep_than_friction_holds(name):
    for value, rollout in given(name, "Slope"):
        friction, below = (SLOPE_FRICTION, value) if name == "slope" else (value, 2.0)
        np.testing.assert_allclose(rollout.friction, friction)
        steepness = np.degrees(parameter(rollout, "ground.slope[pitch]"))
        np.testing.assert_allclose(steepness, np.degrees(np.arctan(friction)) - below)
        assert (steepness > 0.0).all()  # as the task's own randomisation has it: uphill ahead


@pytest.mark.parametrize(("name", "quantity"), [("latency", "command.delay"), ("payload", "payload.mass")])
def test_delay_and_payload_are_what_the_axis_says(name, quantity):
    for value, rollout in given(name, "Velocity"):
        np.testing.assert_allclose(parameter(rollout, quantity), value)
