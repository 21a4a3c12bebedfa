"""Tables of what was measured once, kept in docs/data: slip observer, camera, films, the real servo. The pages say by what."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import fmean
from typing import Any

from studies.learning import read_data

DATA = Path(__file__).resolve().parents[2] / "docs" / "data"
OBSERVER_HEADER = ("floor, drive", "v x", "its 99 %", "v y", "slip", "in 2 sigma", "error/sigma")
OBSERVER_HEADER += ("camera: v x", "slip", "in 2 sigma", "error/sigma")
FLOW_HEADER = ("error of v x (mm/s)", "neither", "flow", "camera", "camera and flow")
SERVO_HEADER = ("added to Coulomb and viscous friction", "mean error of the angle (mrad)")
CAMERA_HEADER = ("tracking error", "slippery", "ice", "split")
VISION_HEADER = ("rms error, camera at 2 m", "ours", "AprilTag 3", "ArUco", "the paper's method")
#: Rows of the table; observer.json has more.
_SHOWN = [(floor, "commands") for floor in ("nominal", "wide", "split", "ice")]
_SHOWN += [("ice", "excitation"), ("slippery", "commands")]
_SHOWN += [(floor, "velocity_slip_aware") for floor in ("slippery", "split")]


def observer_rows() -> Iterator[list[str]]:
    """Yield how far off the slip observer is; errors are rms."""
    found = {(row["floor"], row["drive"]): row for row in _read("observer")["rows"] if row["backend"] == "gibbs_appell"}
    for floor, drive in _SHOWN:
        without, camera = found[floor, drive]["neither"], found[floor, drive]["camera"]
        speeds = [without[name] for name in ("v_x_mm_s", "v_x_99_percent_mm_s", "v_y_mm_s", "slip_mm_s")]
        seen = [camera[name] for name in ("v_x_mm_s", "slip_mm_s")]
        yield [f"{floor}, {drive}", *map("{:.1f}".format, speeds), *_held(without), *map("{:.1f}".format, seen), *_held(camera)]


def _held(found: dict[str, float]) -> tuple[str, str]:
    return f"{found['within_2_sigma_percent']:.0f}", f"{found['error_over_sigma']:.2f}"


def flow_rows() -> Iterator[list[str]]:
    """Yield how far off it is with optical flow, with a camera, with both."""
    for row in _read("observer")["rows"]:
        if "flow" in row:
            yield [row["floor"], *(f"{row[sensors]['v_x_mm_s']:.1f}" for sensors in FLOW_HEADER[1:])]


def servo_rows() -> Iterator[list[str]]:
    """Yield how well models replay the real servo's recordings."""
    for model in _read("xl330_pendulum")["models"]:
        effects = [f"`{name}` {value:.2g}" for name, numbers in model["effects"].items() for value in numbers.values()]
        yield [", ".join(effects) or "nothing", f"{model['error_mrad']:.1f}"]


def camera_rows() -> Iterator[list[str]]:
    """Yield the tracking error of the chain from servo protocol and rendered frames to the policy: means over episodes."""
    found: dict[str, dict[str, float]] = {}
    for row in _read("bench")["rows"]:
        if row["name"] == "camera" and row["bar"] is None:
            floor, _, what = row["what"].partition(",")
            found.setdefault(what.partition("tracking error ")[2], {})[floor] = fmean(row["ours"]["values"])
    for what, errors in found.items():
        yield [what, *(f"{errors[floor]:.3f}" for floor in CAMERA_HEADER[1:])]


def vision_rows() -> Iterator[list[str]]:
    """Yield errors of the body's pose beside printed tags and the paper's method, in the same scenes."""
    found = {(row["what"], row["method"]): row for row in _read("vision")["vision"]}
    for quantity in ("xy", "yaw"):
        for place in ("overhead", "45 deg"):
            what = f"body {quantity}, {place} at 2 m"
            yield [f"body {quantity}, {place}", *(_error(found, what, header) for header in VISION_HEADER[1:])]


def _error(found: dict[tuple[str, str], dict[str, Any]], what: str, header: str) -> str:
    starts = {"ours": ("ours", ""), "AprilTag 3": ("tags APRILTAG_36H11 AprilTag 3", ""), "ArUco": ("tags 5X5_100", "")}
    method, legs = starts.get(header, ("paper's method", ", legs moved"))
    (row,) = [row for (name, by), row in found.items() if name == what + legs and by.startswith(method)]
    return f"{row['value']:.2g} {row['unit']}"


def _read(name: str) -> Any:
    return read_data(DATA / f"{name}.json")


#: Name in a page's mark -> header, and what makes the rows.
TABLES: dict[str, tuple[tuple[str, ...], Callable[[], Iterator[list[str]]]]] = {
    "observer": (OBSERVER_HEADER, observer_rows),
    "flow": (FLOW_HEADER, flow_rows),
    "servo": (SERVO_HEADER, servo_rows),
    "camera": (CAMERA_HEADER, camera_rows),
    "vision": (VISION_HEADER, vision_rows),
}
