"""The picture of a training."""

import numpy as np

from wlr_gym.base.plots import COLOURS, GREY
from wlr_gym.learning.evaluation.plots import learning_curve

SIZES = {"slip": -0.8, "tracking": 1.0, "energy": -0.1, "posture": -0.02, "error": -0.7, "torque": 0.0, "action": -0.3}
CURVE = [
    {"steps": 1e6 * k, "reward_per_second": 1.0, **{f"term.{name}": k * size for name, size in SIZES.items()}} for k in (1, 2)
]


def test_terms_that_matter_have_a_curve_and_the_others_one():
    right = learning_curve(CURVE, {"pid": 1.5}).axes[1]
    assert [line.get_label() for line in right.lines] == ["tracking", "slip", "error", "action", "3 others"]
    assert [line.get_color() for line in right.lines] == [*COLOURS[:4], GREY]
    np.testing.assert_allclose(np.asarray(right.lines[-1].get_ydata()), [-0.12, -0.24])
    few = [{key: row[key] for key in ("steps", "reward_per_second", "term.slip")} for row in CURVE]
    assert [line.get_label() for line in learning_curve(few, {}).axes[1].lines] == ["slip"]
