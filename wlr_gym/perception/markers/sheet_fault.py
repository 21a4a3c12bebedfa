"""Say why a target is not found among the markers of a picture: wrong sheets, swapped ones, too few."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.detection import Detection
from wlr_gym.perception.markers.pose import find_laid_target
from wlr_gym.perception.markers.targets import CODE_NAMES, Target


def sheet_fault(detections: Sequence[Detection], target: Target, camera: Camera) -> str:
    """Why ``target`` is not found, in words that end a sentence; what was seen is named."""
    count = len(target.markers)
    seen = Counter(CODE_NAMES[detection.code] for detection in detections)
    own = Counter(marker.code for marker in target.markers)
    found = ", ".join(f"{number} {name}" for name, number in sorted(seen.items())) or "no marker"
    if not any(seen[code] for code in own):
        others = f"; {found} seen: are the sheets or the files of floor and robot swapped?" if seen else ""
        return f"0 of the {count} markers of '{target.name}' seen{others}"
    key = target.markers[target.key].code
    if seen[key] > 1:
        return f"{found} seen, but '{target.name}' has one {key}: is a sheet of it there twice?"
    swaps = list(_swaps(detections, target, camera))
    if swaps:
        names = " or ".join(f"'{target.markers[target.key].name}' and '{name}'" for name in swaps)
        return f"the sheets {names} of '{target.name}' lie in each other's places"
    together = sum(seen[code] for code in own)
    return (
        f"{together} of the {count} markers of '{target.name}' seen, and at least 4 must fit together (check their positions "
        "in the target file, and the light)"
    )


def _swaps(detections: Sequence[Detection], target: Target, camera: Camera) -> Iterator[str]:
    """Names of the markers that, with the key's sheet in their place and theirs in its, fit what is seen."""
    key = target.key
    for other, marker in enumerate(target.markers):
        if other == key:
            continue
        markers = list(target.markers)
        markers[key] = markers[key].model_copy(update={"code": marker.code})
        markers[other] = marker.model_copy(update={"code": target.markers[key].code})
        if find_laid_target(detections, target.model_copy(update={"markers": tuple(markers)}), camera):
            yield marker.name
