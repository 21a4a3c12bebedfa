"""The style of figures: colours that colour-blind readers tell apart, one legend, files."""

import itertools

import numpy as np
import pytest

from wlr_gym.base.plots import COLOURS, legend_below, new_figure, save, text_colour, tidy

#: Linear sRGB as people without red, green and blue cones see it (Machado, Oliveira, Fernandes 2009), and as it is.
SIGHTS = {
    "protanopia": ((0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)),
    "deuteranopia": ((0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881)),
    "tritanopia": ((1.255528, -0.076749, -0.178779), (-0.078411, 0.930809, 0.147602), (0.004733, 0.691367, 0.303900)),
    "usual": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
}
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
WHITE = TO_XYZ.sum(axis=1)


def lab(colour, sight):
    """CIELAB of ``#rrggbb``."""
    value = np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    x, y, z = np.cbrt(TO_XYZ @ np.clip(sight @ linear, 1e-3, 1.0) / WHITE)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("sight", SIGHTS)
def test_colours_differ_to_every_reader(sight):
    """By 20 or more in CIELAB, where 2 can just be seen side by side; matplotlib's own first four reach 7 and 5."""
    seen = [lab(colour, np.array(SIGHTS[sight])) for colour in COLOURS]
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2)) > 20


def test_a_figure_has_one_legend_and_is_written(tmp_path):
    figure = new_figure(4.0, 2.0)
    for axes in figure.subplots(1, 2):
        axes.plot([0, 1], label="driven")
        tidy(axes)
    legend_below(figure)
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["driven"]
    assert save(figure, tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in save(figure, tmp_path / "a.svg").read_bytes()


@pytest.mark.parametrize(
    ("background", "text"),
    [((0.65, 0.0, 0.15), "white"), ((0.9, 0.95, 1.0), "black"), ((0.2, 0.2, 0.58), "white"), ((1.0, 0.7, 0.4, 1.0), "black")],
)
def test_text_is_read_on_its_colour(background, text):
    """The contrast with the background (WCAG 2) is at least that of the other one."""
    assert text_colour(background) == text
