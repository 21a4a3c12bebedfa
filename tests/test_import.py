"""``import wlr_gym`` and ``wlr --help`` stay light: optional and heavy packages load when they are used."""

import subprocess
import sys

import pytest

HEAVY = ("torch", "stable_baselines3", "mujoco", "numba", "cv2", "matplotlib", "pandas", "scipy", "sympy", "tyro")


def modules_after(code: str) -> set[str]:
    script = f"{code}\nimport sys\nprint('\\n'.join(sys.modules))"
    answer = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(answer.stdout.splitlines())


@pytest.mark.parametrize(
    "code",
    [
        "import wlr_gym",
        "from wlr_gym.cli import main; main(['--help'])",
        "import gymnasium, wlr_gym; gymnasium.spec('WLR-Velocity-v0')",
    ],
)
def test_heavy_packages_are_not_touched(code):
    assert modules_after(code).isdisjoint(HEAVY)
