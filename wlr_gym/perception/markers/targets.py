"""Ring markers and the targets they form: what is printed, and what the detector looks for.

A marker is a black disc on white with a white disc and a black dot inside, all with the same centre. The two inner radii, as
shares of the outer one, are its code. A target is at least four coplanar markers, one of which (the key) has a code of its
own, so that no turn of the target looks like another.
"""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.settings import SettingsModel, parse_config, read_config
from wlr_gym.robot import Vector3

Array = NDArray[np.float64]

#: Code -> radii of the white disc and of the black dot in it, over the marker's outer radius.
CODES: dict[str, tuple[float, float]] = {
    "body": (0.667, 0.333),
    "body_key": (0.76, 0.50),
    "floor": (0.55, 0.22),
    "floor_key": (0.78, 0.25),
}
CODE_NAMES = tuple(CODES)
QUIET_ZONE = 1.3  # white around a marker must reach this many outer radii


class Marker(SettingsModel):
    """One marker: name, centre (m, target frame), outer radius (m), code (a name in :data:`CODES`)."""

    name: str
    position: Vector3
    radius: float = Field(gt=0)
    code: str


class Target(SettingsModel):
    """Markers in one plane z = constant of a frame, seen from +z.

    Attributes:
        name: of the target.
        frame: what its frame is, in words.
        markers: four or more; exactly one has the code of its own that tells which way round the target is.
        tolerance: m, 1 sigma of a marker's place, along each axis: glue, measurement.
        stretch: 1 sigma of the print's stretch, along x and along y.
        caliper: m, measured between the centres of the markers of :attr:`long_side`; None = not measured.
    """

    name: str
    frame: str = ""
    markers: tuple[Marker, ...]
    tolerance: float = Field(default=0.0005, ge=0, lt=0.1)
    stretch: float = Field(default=0.0, ge=0, lt=0.1)
    caliper: float | None = Field(default=None, gt=0)

    @property
    def positions(self) -> Array:
        """Centres (M, 3) in m, target frame."""
        return np.array([marker.position for marker in self.markers])

    @property
    def radii(self) -> Array:
        """Outer radii (M,) in m."""
        return np.array([marker.radius for marker in self.markers])

    @property
    def slack(self) -> float:
        """1 sigma (m) of how far a marker may be off its stated place: by hand, and by the print's stretch."""
        return math.hypot(self.tolerance, self.stretch * float(np.abs(self.positions[:, :2]).max()))

    @property
    def codes(self) -> NDArray[np.int64]:
        """Numbers of the codes (M,) in :data:`CODE_NAMES`."""
        return np.array([CODE_NAMES.index(marker.code) for marker in self.markers])

    @property
    def long_side(self) -> tuple[int, int]:
        """Indices of the two markers at the ends of the longest side: nearest to parallel to x or y, then farthest apart."""
        apart = np.abs(self.positions[:, None] - self.positions[None])[:, :, :2]
        along = np.where(apart.min(axis=2) < 0.1 * apart.max(axis=2), apart.max(axis=2), 0.0)
        first, second = divmod(int(np.argmax(along)), len(along))
        return first, second

    @property
    def key(self) -> int:
        """Index of the marker with a code of its own."""
        count = Counter(marker.code for marker in self.markers)
        return next(index for index, marker in enumerate(self.markers) if count[marker.code] == 1)


def load_target(source: str | Path | Target) -> Target:
    """Load a target by the name of a file in ``configs/vision/`` or by path.

    Raises:
        InputError: unreadable file, unknown key or code, fewer than four markers, markers not in one plane or overlapping,
            not exactly one key marker, or millimetres for metres.
    """
    if isinstance(source, Target):
        return source
    data, where = read_config("vision", source)
    target = parse_config(Target, data, where)
    _check(target, where)
    return target


def ring_radii(code: int) -> tuple[float, float, float]:
    """Return the radii of a code's three edges over the outer radius, from outside in."""
    return (1.0, *CODES[CODE_NAMES[code]])


def _check(target: Target, where: str) -> None:
    unknown = [marker for marker in target.markers if marker.code not in CODES]
    if unknown:
        raise unknown_name("marker code", unknown[0].code, CODES, f"{where}: marker '{unknown[0].name}'")
    if len(target.markers) < 4:
        raise InputError(f"{where}: {len(target.markers)} markers; a target needs at least 4")
    positions, radii = target.positions, target.radii
    if np.abs(positions).max() > 20 or radii.max() > 1:
        raise InputError(f"{where}: positions up to {np.abs(positions).max():g}: expected metres; these look like millimetres")
    if np.ptp(positions[:, 2]) > 1e-9:
        raise InputError(f"{where}: markers at heights {sorted(set(positions[:, 2]))}; expected one plane (the same z)")
    singular = np.linalg.svd(positions[:, :2] - positions[:, :2].mean(axis=0), compute_uv=False)
    if singular[1] < 0.2 * singular[0]:
        raise InputError(f"{where}: the markers lie nearly on a line; spread them over an area")
    gaps = np.linalg.norm(positions[:, None] - positions[None], axis=2) - QUIET_ZONE * radii[:, None] - radii[None]
    if (gaps + 10 * np.eye(len(radii))).min() < 0:
        raise InputError(f"{where}: markers are so close that one lies in the white margin ({QUIET_ZONE} radii) of another")
    first, second = target.long_side
    drawn = float(np.linalg.norm(positions[first] - positions[second]))
    if target.caliper is not None and abs(target.caliper / drawn - 1) > 0.03:
        names = f"{target.markers[first].name} and {target.markers[second].name}"
        raise InputError(f"{where}: caliper {target.caliper:g}: expected about {drawn:g} (m, between {names})")
    single = [code for code, count in Counter(marker.code for marker in target.markers).items() if count == 1]
    if len(single) != 1 or len({marker.code for marker in target.markers}) != 2:
        raise InputError(f"{where}: expected one marker with a code of its own and one code for all others, got {single}")
