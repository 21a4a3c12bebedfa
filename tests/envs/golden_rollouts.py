"""Roll-outs of all tasks through the public interface, and what is kept of them to compare later versions with.

``python tests/envs/golden_rollouts.py`` writes the golden file anew: where behaviour was changed on purpose, and says so.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import llvmlite.binding
import mujoco
import numba
import numpy as np

import wlr_gym  # noqa: F401

FILE = Path(__file__).parents[1] / "golden" / "environment_rollouts.json"
ROBOTS = 3
STEPS = 25
#: Infos that came after the file was written.
YOUNGER = {"episode_measures"}
#: s; shorter than the roll-outs, so that each has an episode's end and a next episode.
EPISODE_LENGTH = 0.4
TASKS = ("Velocity", "Path", "Posture", "Slope")
#: Both simulators, double and single precision, randomised and not: name -> keywords of the environment.
VARIANTS: dict[str, dict[str, Any]] = {
    "engine": {"backend": "gibbs_appell", "randomization": "wide", "observation": "dict"},
    "engine_float32": {"backend": "gibbs_appell", "randomization": "nominal", "precision": "float32"},
    "engine_free_wheel": {"backend": "gibbs_appell", "randomization": "none", "free_wheels": ["wheel_lf"]},
    "mujoco": {"backend": "mujoco", "randomization": "wide"},
    "mujoco_effect": {
        "backend": "mujoco",
        "randomization": "nominal",
        "effects": {"name": "friction_level", "parameters": {"mu": 0.4}},
    },
}


def arithmetic() -> str:
    """Return a digest of what bits depend on besides the code: processor, elementary functions of numpy, compiler, MuJoCo."""
    x = np.linspace(0.01, 3.0, 1000)
    functions = b"".join(function(x).tobytes() for function in (np.sin, np.cos, np.exp, np.log, np.arctan, np.tanh))
    versions = (llvmlite.binding.get_host_cpu_name(), numba.__version__, mujoco.__version__)
    return hashlib.sha256(functions + repr(versions).encode()).hexdigest()[:16]


def rollouts() -> dict[str, tuple[str, dict[str, Any]]]:
    """Return name -> id and keywords of the environment."""
    return {f"{task}-{name}": (f"WLR-{task}-v0", keywords) for task in TASKS for name, keywords in VARIANTS.items()}


def roll_out(env_id: str, keywords: dict[str, Any]) -> dict[str, Any]:
    """Return ``bits``, a digest of all that ``reset`` and ``step`` returned, and ``reward``, each robot's sum."""
    env = gym.make_vec(env_id, num_envs=ROBOTS, episode_length=EPISODE_LENGTH, **keywords)
    digest, reward = hashlib.sha256(), np.zeros(ROBOTS)
    rng = np.random.default_rng(0)
    _add(digest, env.reset(seed=11))
    for step in range(STEPS):
        wave = 0.5 * np.sin(0.3 * step * np.arange(1, 9))
        answer = env.step(np.clip(wave + 0.4 * rng.standard_normal((ROBOTS, 8)), -1, 1).astype(np.float32))
        _add(digest, answer)
        reward += answer[1]
    env.close()
    return {"bits": digest.hexdigest()[:16], "reward": reward.round(6).tolist()}


def _add(digest: Any, value: Any) -> None:
    if isinstance(value, dict):
        for key in sorted(key for key in value if key.lstrip("_") not in YOUNGER):
            digest.update(key.encode())
            _add(digest, value[key])
    elif isinstance(value, tuple):
        for item in value:
            _add(digest, item)
    else:
        digest.update(np.ascontiguousarray(value).tobytes())


if __name__ == "__main__":
    found = {name: roll_out(*environment) for name, environment in rollouts().items()}
    kept = json.loads(FILE.read_text(encoding="utf-8"))
    known = kept["arithmetic"] if kept["rollouts"] == found else []  # other machines that found these bits
    golden = {"arithmetic": sorted({*known, arithmetic()}), "rollouts": found}
    FILE.write_text(json.dumps(golden, indent=1) + "\n", encoding="utf-8")
