"""What an output folder must say about itself: resolved config, command, versions, git commit, seed."""

from __future__ import annotations

import importlib.metadata
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import yaml

from wlr_gym.base.files import write_text
from wlr_gym.base.paths import PACKAGE

PACKAGES = (
    "wlr-gym", "numpy", "numba", "gymnasium", "mujoco", "torch", "stable-baselines3", "onnx", "onnxruntime",
    "opencv-python-headless",
)  # fmt: skip
CONFIG_FILE = "config.yaml"
PROVENANCE_FILE = "provenance.yaml"


def record_provenance(folder: Path, config: Mapping[str, Any], seed: int | None = None) -> None:
    """Create ``folder`` and write ``config.yaml`` (resolved settings) and ``provenance.yaml`` (where it comes from) into it."""
    folder.mkdir(parents=True, exist_ok=True)
    write_yaml(folder / CONFIG_FILE, dict(config))
    write_yaml(folder / PROVENANCE_FILE, provenance(seed))


def provenance(seed: int | None = None) -> dict[str, Any]:
    """Return command (as a shell takes it), time, seed, git commit and versions as plain YAML types."""
    return {
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "seed": seed,
        "git_commit": git_commit(),
        "versions": versions(),
        "platform": f"{platform.system()} {platform.machine()}",
    }


def versions() -> dict[str, str]:
    """Return Python's version and those of the installed packages that decide the numbers."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def git_commit() -> str | None:
    """Return the commit of the clone this package runs from, ``-dirty`` when files differ; None outside a clone."""
    clone = PACKAGE.parent
    if not (clone / ".git").exists():
        return None
    try:
        answer = subprocess.run(
            ["git", "-C", str(clone), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            capture_output=True, text=True, timeout=10, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip()


def write_yaml(path: Path, content: Any) -> None:
    """Write ``content`` as YAML, keys in the order given."""
    write_text(path, yaml.safe_dump(content, sort_keys=False, allow_unicode=True))
