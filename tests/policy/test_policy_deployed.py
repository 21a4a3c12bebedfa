"""A policy file on the emulated robot: what the trained network, the file and the control loop answer is the same."""

import numpy as np
import pytest

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")

from policy_log import act_again

from wlr_gym.hardware.deployment import deploy
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.policy import make_policy

ID = "WLR-Velocity-v0"


def test_log_file_and_network_agree(trained, exported, tmp_path):
    keywords = {"backend": "dynamixel", "hardware": {"emulated": True, "log": tmp_path}, "episode_length": 3.0}
    core = make_core(ID, 1, keywords)
    result = deploy(core, make_policy(exported, core.contract()), seed=3)
    assert result.run is not None
    assert result.ticks == 150
    given, answered = act_again(core, make_policy(exported, core.contract()), result.run)
    assert np.abs(np.diff(given, axis=0)).max() > 0.1
    np.testing.assert_array_equal(answered, given)
    _, of_network = act_again(core, make_policy(trained, core.contract()), result.run)
    np.testing.assert_allclose(of_network, given, atol=2e-6)
    core.close()
