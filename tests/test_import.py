"""``import wlr_gym`` and ``wlr --help`` stay light: optional and heavy packages load when they are used."""

import subprocess
import sys

import pytest

HEAVY = (
    "torch", "stable_baselines3", "mujoco", "numba", "cv2", "matplotlib", "pandas", "pyarrow", "scipy", "sympy", "onnx",
    "onnxruntime", "pydantic", "yaml", "tyro", "rich", "ray", "optuna",
)  # fmt: skip


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


def test_the_package_adds_nothing_to_gymnasium():
    own = modules_after("import wlr_gym") - modules_after("import gymnasium")
    assert own == {"wlr_gym", "wlr_gym.envs", "wlr_gym.envs.registry", "wlr_gym.base", "wlr_gym.base.errors"}
