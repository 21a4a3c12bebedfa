"""Labels of the picture of accuracy against speed: none covers a point, a line or another label."""

from itertools import combinations

from studies.bench.engine import Label, place_labels
from wlr_gym.base.plots import new_figure


def test_labels_cover_neither_points_nor_each_other():
    figure = new_figure(4.0, 4.0)
    axes = figure.subplots()
    points = [(0.5, 0.5), (0.53, 0.5), (0.5, 0.53), (0.53, 0.53)]
    axes.plot([0.0, 1.0], [0.5, 0.5])
    axes.plot(*zip(*points, strict=True), "o")
    place_labels(figure, axes, [Label(x, y, "label", "black") for x, y in points])
    boxes = [text.get_window_extent() for text in axes.texts]
    assert len(boxes) == 4
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
    assert not any(box.contains(*axes.transData.transform(point)) for box in boxes for point in points)
