import pytest
from fake_plant import FakePlant

from wlr_gym.physics import plants


@pytest.fixture
def fake(monkeypatch):
    """Replace the plants by the kinematic one; returns a dict of its options (``fall_at``) and the plants made so far."""
    made = {"fall_at": float("inf"), "plants": []}

    def make(backend, robot, count, options, forces=(), hardware=None):
        plant = FakePlant(robot, count, options, made["fall_at"])
        made["plants"].append(plant)
        return plant

    monkeypatch.setattr(plants, "make_plant", make)
    return made
