"""Frames without markers that look as if they had some: what a detector must not take for a pose."""

from __future__ import annotations

from typing import Any

import numpy as np

from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.targets import CODES
from wlr_gym.perception.scene import Image, Look, develop


def clutter(seed: int, camera: Camera) -> Image:
    """A frame full of discs, rings, targets with other radii, boxes, lines and words, but without our markers."""
    import cv2

    rng = np.random.default_rng(seed)
    height, width = camera.height, camera.width
    image: Any = cv2.resize(rng.uniform(60, 200, (9, 16)).astype(np.uint8), (width, height), interpolation=cv2.INTER_CUBIC)

    def place() -> tuple[int, int]:
        return int(rng.integers(0, width)), int(rng.integers(0, height))

    for _ in range(60):
        shade, (x, y) = float(rng.choice([20, 235, rng.uniform(0, 255)])), place()
        kind = rng.integers(0, 6)
        if kind == 0:
            cv2.rectangle(image, (x, y), (x + int(rng.integers(5, 160)), y + int(rng.integers(5, 120))), shade, -1)
        elif kind == 1:
            axes = int(rng.integers(4, 50)), int(rng.integers(4, 50))
            cv2.ellipse(image, (x, y), axes, rng.uniform(0, 180), 0, 360, shade, int(rng.choice([-1, 2, 5])), cv2.LINE_AA)
        elif kind == 2:
            cv2.line(image, (x, y), place(), shade, int(rng.integers(1, 6)), cv2.LINE_AA)
        elif kind == 3:
            cv2.putText(image, "R0BO0 8@Q", (x, y), cv2.FONT_HERSHEY_DUPLEX, rng.uniform(0.4, 2.5), shade, 2, cv2.LINE_AA)
        else:
            _other_rings(image, rng, (x, y))
    return develop(image.astype(np.float32), Look(blur=rng.uniform(0.3, 2), noise=rng.uniform(0, 10)), seed)


def _other_rings(image: Image, rng: np.random.Generator, place: tuple[int, int]) -> None:
    """Draw concentric discs whose radii are no code's (or light on dark, or too many)."""
    import cv2

    radius, aspect, turn = rng.uniform(8, 60), rng.uniform(0.5, 1), rng.uniform(0, 180)
    while True:
        shares = np.sort(rng.uniform(0.1, 0.95, int(rng.integers(1, 5))))[::-1]
        dark_outside = bool(rng.integers(0, 2))
        alike = len(shares) == 2 and dark_outside and min(np.hypot(*(shares - code)) for code in CODES.values()) < 0.15
        if not alike:
            break
    for k, share in enumerate((1.0, *shares)):
        axes = max(1, int(radius * share)), max(1, int(radius * share * aspect))
        shade = 20.0 if (k % 2 == 0) == dark_outside else 235.0
        cv2.ellipse(image, place, axes, turn, 0, 360, shade, -1, cv2.LINE_AA)
