"""What only the Gibbs-Appell plant promises; the contract all plants keep is in test_conformance.py."""

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from simulators import ROBOT

from wlr_gym.base.errors import InputError
from wlr_gym.physics.plants.base import TRUTH_LAYOUT, PlantOptions
from wlr_gym.physics.plants.gibbs_appell.kernel import outputs
from wlr_gym.physics.plants.gibbs_appell.plant import GibbsAppellPlant
from wlr_gym.physics.plants.sensors import RAW_LAYOUT
from wlr_gym.robot import JOINTS, WHEELS


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
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        PlantOptions(**options)


def test_options_are_numbers_of_any_kind():
    """The kinds that ``Settings`` takes; a step in single precision is another number than it looks."""
    kinds: Any = {"control_period": Fraction(1, 50), "physics_step": np.float64(0.002), "threads": np.int64(2)}
    options = PlantOptions(**kinds)
    assert options == PlantOptions(physics_step=0.002, threads=2)
    assert [type(getattr(options, name)) for name in kinds] == [float, float, int]
    with pytest.raises(InputError, match=r"physics_step 0\.00100000004\d+ s does not divide"):
        PlantOptions(physics_step=np.float32(0.001))  # type: ignore[arg-type]


@pytest.mark.parametrize("options", [{"threads": 1.5}, {"physics_step": "a"}, {"precision": 64}])
def test_options_of_the_wrong_kind_are_refused(options):
    with pytest.raises(InputError, match=next(iter(options))):
        PlantOptions(**options)
