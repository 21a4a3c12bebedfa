"""``wlr envs``."""

from wlr_gym.cli import main
from wlr_gym.envs.registry import ENVIRONMENTS


def test_list_has_every_environment(capsys):
    assert main(["envs"]) == 0
    shown = capsys.readouterr().out
    assert all(env_id in shown for env_id in ENVIRONMENTS)


def test_description_has_units_and_terms(capsys):
    assert main(["envs", "WLR-Velocity-v0"]) == 0
    shown = capsys.readouterr().out
    for text in ("command[linear_velocity_x]", "rad/s", "track_yaw_rate", "gyro[z]"):
        assert text in shown


def test_unknown_environment(capsys):
    assert main(["envs", "WLR-Velocty-v0"]) == 2
    assert "did you mean 'WLR-Velocity-v0'?" in capsys.readouterr().err
