"""Text and a legend, written into a picture."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from wlr_gym.render.colours import friction_colour

Picture = NDArray[np.uint8]

# Colours (red, green, blue, opacity), 0 to 255.
PAPER = (255, 255, 255, 205)
INK = (25, 28, 32, 255)
#: Pixels; width of the friction bar.
BAR = 120
#: Friction coefficients at its ends.
BAR_RANGE = (0.0, 1.0)
#: Pixels.
MARGIN = 8


@dataclass(frozen=True)
class Note:
    """A short text at a place of the picture (column, row)."""

    text: str
    place: tuple[float, float]


@functools.cache
def font(height: int) -> ImageFont.FreeTypeFont:
    """Return DejaVu Sans, which Matplotlib carries along, in pixels of height."""
    import matplotlib

    return ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf", height)


def write(
    picture: Picture, lines: Sequence[str], legend: Sequence[str] = (), bar: bool = True, notes: Sequence[Note] = ()
) -> Picture:
    """Return the picture with lines at the top left, a friction bar and a legend at the bottom left, and notes in the scene."""
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image, "RGBA")
    size = max(9, round(picture.shape[0] / 34))  # pixels; height of the letters
    for note in notes:
        _note(draw, note, image.size, size)
    if lines:
        _box(draw, lines, size)
    if bar or legend:
        _legend(draw, legend, bar, image.size, size)
    return np.asarray(image)


def banner(width: int, text: str, height: int) -> Picture:
    """Return a white strip (height, width, 3) with a centred text, made smaller where it would not fit."""
    image = Image.new("RGB", (width, height), "white")
    size = round(0.6 * height)
    while size > 7 and font(size).getlength(text) > width - 2 * MARGIN:
        size -= 1
    ImageDraw.Draw(image).text((width / 2, height / 2), text, font=font(size), fill=INK[:3], anchor="mm")
    return np.asarray(image)


def _box(draw: ImageDraw.ImageDraw, lines: Sequence[str], size: int) -> None:
    step = round(1.35 * size)
    wide = max(font(size).getlength(line) for line in lines)
    draw.rounded_rectangle((MARGIN, MARGIN, wide + 3 * MARGIN, step * len(lines) + 2 * MARGIN), 4, fill=PAPER)
    for index, line in enumerate(lines):
        draw.text((2 * MARGIN, 1.5 * MARGIN + step * index), line, font=font(size), fill=INK)


def _legend(draw: ImageDraw.ImageDraw, lines: Sequence[str], bar: bool, size: tuple[int, int], height: int) -> None:
    step, letters = round(1.35 * height), font(height)
    wide = max([letters.getlength(line) for line in lines] + [BAR + letters.getlength("µ 0  1") + MARGIN] * bar)
    row = size[1] - 1.5 * MARGIN - step * (len(lines) + bar)
    draw.rounded_rectangle((MARGIN, row - MARGIN / 2, 3 * MARGIN + wide, size[1] - MARGIN), 4, fill=PAPER)
    if bar:
        _bar(draw, row, letters, height)
    for index, line in enumerate(lines, start=int(bar)):
        draw.text((2 * MARGIN, row + step * index), line, font=letters, fill=INK)


def _bar(draw: ImageDraw.ImageDraw, row: float, letters: ImageFont.FreeTypeFont, height: int) -> None:
    low, high = BAR_RANGE
    start = 2 * MARGIN + letters.getlength(f"µ {low:g} ")
    draw.text((2 * MARGIN, row), f"µ {low:g}", font=letters, fill=INK)
    for column in range(BAR):
        red, green, blue = friction_colour(low + (high - low) * column / (BAR - 1))
        colour = (round(255 * red), round(255 * green), round(255 * blue), 255)
        draw.line((start + column, row + 2, start + column, row + height), fill=colour)
    draw.text((start + BAR + MARGIN / 2, row), f"{high:g}", font=letters, fill=INK)


def _note(draw: ImageDraw.ImageDraw, note: Note, size: tuple[int, int], height: int) -> None:
    column, row = note.place
    half = 0.5 * font(height).getlength(note.text)
    if not (half <= column <= size[0] - half and height <= row <= size[1] - height):
        return
    draw.text(
        (column, row), note.text, font=font(height), fill=INK, anchor="mm", stroke_width=2, stroke_fill=(255, 255, 255, 200)
    )
