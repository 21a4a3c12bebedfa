"""A bag with other names, degrees, a 200 Hz IMU and its clock 37 ms off: wlr gap names the effect that is hidden in it."""

import numpy as np
import pytest
from foreign_logs import lab_map, lab_messages, write_rosbag2

import wlr_gym
from wlr_gym.data import read_dataset, read_run
from wlr_gym.data.excitations import Motion, excite
from wlr_gym.data.logs import import_log
from wlr_gym.data.record import record_simulation
from wlr_gym.physics.effects import load_patch
from wlr_gym.robot import load_robot

FAULT = """
effects:
  - name: rolling_resistance
    where: [wheel_lf, wheel_rf, wheel_lr, wheel_rr]
    parameters: {coefficient: 0.05}
"""
MOTIONS = ("straight", "turns", "stop_and_go", "random", "posture")


@pytest.mark.slow
def test_the_hidden_effect_is_named(tmp_path):
    robot = load_robot()
    motions = [excite(name, 0, robot) for name in MOTIONS]
    home = np.repeat([robot.home.leg_angle, 0.0], 4)
    setpoints = np.concatenate([part for one in motions for part in (one.setpoints, np.tile(home, (50, 1)))])
    (tmp_path / "fault.yaml").write_text(FAULT)
    quick = Motion("lab", np.repeat(setpoints, 4, axis=0), 0.005, motions[0].profile)
    truth = record_simulation(tmp_path / "truth.parquet", quick, robot, "mujoco", 3, load_patch(tmp_path / "fault.yaml"))
    run = read_run(truth)
    bag = write_rosbag2(tmp_path / "lab", lab_messages({str(name): run[name] for name in run.table.columns}), "mcap")

    line = {"meta": {"profile": motions[0].profile.model_dump()}}  # no bag knows it
    found = lab_map(bag, line)
    import_log(bag, tmp_path / "runs", found, split=20.0)
    assert len(read_dataset(tmp_path / "runs").runs) == len(MOTIONS)
    result = wlr_gym.analyse(tmp_path / "runs", threads=2)
    assert result.verdict == "effect_found"
    (effect,) = result.effects
    assert effect.name == "rolling_resistance"
    assert effect.parameters["coefficient"].value == pytest.approx(0.05, rel=0.15)
