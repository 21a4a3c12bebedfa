"""Check what ``python -m build`` made: ``python .ci/check_dist.py SDIST WHEEL_OF_THE_SDIST WHEEL_OF_THE_CLONE``.

The source distribution holds every file of the clone's git index and nothing else: the studies, tests and documents too. Both
wheels hold the same files: the package with its configs, agents and type marker.
"""

from __future__ import annotations

import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NEEDED = (
    "wlr_gym/py.typed",
    "wlr_gym/__init__.pyi",
    "wlr_gym/configs/task/velocity.yaml",
    "wlr_gym/agents/shipped/velocity_slip_aware.onnx",
)


def sdist_files(path: Path) -> set[str]:
    """Return the files of a source distribution, relative to its folder."""
    with tarfile.open(path) as archive:
        return {name.partition("/")[2] for name in archive.getnames()}


def wheel_files(path: Path) -> dict[str, int]:
    """Return file -> checksum of a wheel, without its record."""
    with zipfile.ZipFile(path) as archive:
        return {item.filename: item.CRC for item in archive.infolist() if not item.filename.endswith("/RECORD")}


def tracked_files() -> set[str]:
    """Return the files that git tracks here and that are there."""
    answer = subprocess.run(["git", "-C", str(ROOT), "ls-files", "-z"], capture_output=True, text=True, check=True)
    return {name for name in answer.stdout.split("\0") if name and (ROOT / name).is_file()}


def complaints(sdist: Path, from_sdist: Path, from_clone: Path) -> list[str]:
    """Return what is wrong, in words."""
    expected, found = tracked_files() | {"PKG-INFO"}, sdist_files(sdist)
    one, other = wheel_files(from_sdist), wheel_files(from_clone)
    lists = {
        "missing in the source distribution": expected - found,
        "in the source distribution, but not in git": found - expected,
        "other in the wheel made from it than in that of the clone": {name for name, _ in one.items() ^ other.items()},
        "missing in the wheel": set(NEEDED) - set(one),
        "outside the package in the wheel": {name for name in one if not name.startswith(("wlr_gym/", "wlr_gym-"))},
        "not shipped in the wheel": _data_files(expected) - set(one),
    }
    return [f"{fault}: {', '.join(sorted(names)[:10])}" for fault, names in lists.items() if names]


def _data_files(tracked: set[str]) -> set[str]:
    """Return what of the clone must be in a wheel, as it is named there."""
    package = {name for name in tracked if name.startswith("wlr_gym/")}
    return package | {f"wlr_gym/{name}" for name in tracked if name.startswith(("configs/", "agents/"))}


if __name__ == "__main__":
    faults = complaints(*map(Path, sys.argv[1:4]))
    for fault in faults:
        print(fault, file=sys.stderr)
    sys.exit(bool(faults))
