"""Two films beside each other."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.render.overlay import banner

Picture = NDArray[np.uint8]

GAP = 4


def side_by_side(left: Iterable[Picture], right: Iterable[Picture], titles: tuple[str, str] = ("", "")) -> Iterator[Picture]:
    """Put two films (pictures of one height) next to each other, each under its title; the shorter one holds its last picture.

    Raises:
        InputError: pictures of different heights, or an empty film.
    """
    last: list[Picture | None] = [None, None]
    for pair in zip_longest(left, right):
        last = [new if new is not None else old for new, old in zip(pair, last, strict=True)]
        yield _join(last, titles)


def _join(pictures: list[Picture | None], titles: tuple[str, str]) -> Picture:
    one, two = pictures
    if one is None or two is None:
        raise InputError(f"film '{titles[0 if one is None else 1]}' has no pictures")
    if one.shape[0] != two.shape[0]:
        raise InputError(f"pictures are {one.shape[0]} and {two.shape[0]} pixels high, expected one height for both films")
    height = one.shape[0]
    parts = [one, np.full((height, GAP, 3), 255, np.uint8), two]
    if any(titles):
        strip = max(18, height // 16)
        labels = [banner(picture.shape[1], title, strip) for picture, title in zip((one, two), titles, strict=True)]
        top = np.hstack([labels[0], np.full((strip, GAP, 3), 255, np.uint8), labels[1]])
        return np.vstack([top, np.hstack(parts)])
    return np.hstack(parts)
