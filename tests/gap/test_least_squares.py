"""Steps within bounds against the conditions that a minimum satisfies."""

import numpy as np
import pytest

from wlr_gym.gap.estimation.fit import bounded_minimum


@pytest.mark.parametrize("held", [False, True])
def test_bounded_minimum_satisfies_the_conditions_of_a_minimum(held):
    """No free number has a slope, and none that is held would return; several are active and depend on each other."""
    rng = np.random.default_rng(4)
    for _ in range(150):
        size = 12
        rows = rng.standard_normal((size, size + 3))
        rows[1], rows[3] = rows[0] + 0.2 * rows[1], 0.3 * rows[3] - rows[2]  # nearly the same, nearly opposite
        matrix, gradient = rows @ rows.T + 1e-3 * np.eye(size), 5.0 * rng.standard_normal(size)
        low, high = -rng.uniform(0.0, 1.0, size), rng.uniform(0.0, 1.0, size)
        low[5], high[5] = -np.inf, np.inf
        if held:
            low[7] = high[7] = 0.0
        x = bounded_minimum(matrix, gradient, low, high)
        assert (x >= low).all()
        assert (x <= high).all()
        slope = matrix @ x + gradient
        tolerance = 1e-6 * np.abs(gradient).max()
        at_low, at_high = x <= low + 1e-9, x >= high - 1e-9
        assert (np.abs(slope[~at_low & ~at_high]) < tolerance).all()
        assert (slope[at_low & ~at_high] > -tolerance).all()
        assert (slope[at_high & ~at_low] < tolerance).all()
