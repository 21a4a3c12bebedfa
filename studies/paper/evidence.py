"""What the paper's claims are checked with: both tests, and side experiments with one change each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from studies.paper.experiments import TESTS, PaperTest, Record, drive, error_of_ignoring_slip
from studies.paper.ideal import IdealMotion, ideal_motion
from wlr_gym.physics.effects import Patch, apply_patch, load_patch
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters

#: N m; dry friction added to the gear of each free rear wheel, so that there is slip to speak of.
DRAG = 0.07
#: Straight on, in the posture the first test starts with: most of the weight on the rear wheels.
_STRAIGHT = PaperTest("straight", "legs at 30 degrees", TESTS["test_1"].start, TESTS["test_1"].start)


def _drag(left: float = DRAG, right: float = DRAG) -> list[dict[str, object]]:
    return [
        {"name": "coulomb_friction", "where": [wheel], "parameters": {"torque": torque}}
        for wheel, torque in (("wheel_lr", left), ("wheel_rr", right))
    ]


def _with(name: str, where: Sequence[str], **parameters: float) -> dict[str, object]:
    return {"name": name, "where": list(where), "parameters": parameters}


#: Robots of the side experiments: label -> patch. "drag" is what each of the others is compared with.
VARIANTS: Mapping[str, Patch] = {
    "drag": load_patch(_drag()),
    "mu 0.3": load_patch([*_drag(), _with("friction_level", ["ground"], mu=0.3)]),
    "mu 0.9": load_patch([*_drag(), _with("friction_level", ["ground"], mu=0.9)]),
    "centre of mass 3 cm back": load_patch([*_drag(), _with("com_offset", ["body"], x=-0.03)]),
    "centre of mass 3 cm ahead": load_patch([*_drag(), _with("com_offset", ["body"], x=0.03)]),
    "2 kg more": load_patch([*_drag(), _with("payload", ["body"], mass=2.0)]),
    "more drag left": load_patch(_drag(0.12, 0.02)),
    "left front wheel 2 % small": load_patch([_with("wheel_radius_error", ["wheel_lf"], scale=0.98)]),
}


def variant_row(label: str) -> int:
    """Return which robot of a record of the variants has this label."""
    return list(VARIANTS).index(label)


@dataclass(frozen=True, eq=False)
class PaperEvidence:
    """What claims are checked with.

    Attributes:
        robot: nominal. plant: records of both tests on one simulator. ideal: both tests without slip.
        variants: both tests with :data:`VARIANTS`, one robot each. free, driven: yaw (rad) at the end of a straight drive, rear
            wheels free or driven, of two robots: left wheel 5 % small and right one 5 % large, behind or in front.
    """

    robot: Robot
    plant: Mapping[str, Record]
    ideal: Mapping[str, IdealMotion]
    variants: Mapping[str, Record]
    free: tuple[float, float]
    driven: tuple[float, float]

    def variant_error(self, test: str, label: str) -> float:
        """Error of ignoring slip of one of the variants."""
        return float(error_of_ignoring_slip(self.robot, self.variants[test])[variant_row(label)])


def gather(robot: Robot, plant: Mapping[str, Record], threads: int = 1) -> PaperEvidence:
    """Make the side experiments on the Gibbs-Appell engine; ``plant``: both tests on a nominal robot."""
    nominal = Parameters.nominal(robot)
    rows = Parameters(np.concatenate([apply_patch(patch, nominal).values for patch in VARIANTS.values()]))
    variants = {name: drive("gibbs_appell", test, robot, rows, threads=threads) for name, test in TESTS.items()}
    unequal = [
        load_patch([_with("wheel_radius_error", [left], scale=0.95), _with("wheel_radius_error", [right], scale=1.05)])
        for left, right in (("wheel_lr", "wheel_rr"), ("wheel_lf", "wheel_rf"))
    ]
    uneven = Parameters(np.concatenate([apply_patch(patch, nominal).values for patch in unequal]))
    yaw = []
    for rear_driven in (False, True):
        record = drive("gibbs_appell", replace(_STRAIGHT, rear_driven=rear_driven), robot, uneven, threads=threads)
        behind, in_front = map(float, record.attitude[-1, :, 0])
        yaw.append((behind, in_front))
    ideal = {name: ideal_motion(test) for name, test in TESTS.items()}
    return PaperEvidence(robot, plant, ideal, variants, *yaw)
