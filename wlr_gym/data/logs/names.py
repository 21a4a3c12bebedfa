"""What names in a log say: which joint, which quantity, which unit."""

from __future__ import annotations

import re
from dataclasses import dataclass

_FRONT, _REAR = {"front", "fore", "f"}, {"rear", "back", "hind", "aft", "b", "h"}
_LEFT, _RIGHT = {"left", "l"}, {"right"}
#: Two letters that name a corner, in either order.
_CORNERS = {
    "lf": "lf", "fl": "lf", "rf": "rf", "fr": "rf", "lr": "lr", "rl": "lr", "lb": "lr", "bl": "lr", "lh": "lr", "hl": "lr",
    "rr": "rr", "rb": "rr", "br": "rr", "rh": "rr", "hr": "rr",
}  # fmt: skip
_WHEEL = ("wheel", "whl", "tire", "tyre", "drive", "roll", "rad")
_LEG = ("leg", "hip", "knee", "thigh", "shoulder", "swing", "arm", "limb", "susp", "lift")
_QUANTITIES = {
    "pos": {"pos", "position", "positions", "angle", "angles", "q", "theta", "encoder", "enc", "ang"},
    "vel": {"vel", "velocity", "velocities", "speed", "speeds", "dq", "qd", "omega", "rate", "w"},
    "eff": {"eff", "effort", "efforts", "torque", "tau", "current", "load", "trq"},
}
_COMMAND = {
    "cmd", "cmds", "command", "commands", "goal", "goals", "target", "targets", "setpoint", "setpoints", "ref", "reference",
    "desired", "des", "action", "trajectory", "request",
}  # fmt: skip
_UNITS = {
    "deg": "deg", "degs": "deg", "degree": "deg", "degrees": "deg", "dps": "deg/s", "rpm": "rpm", "ma": "mA", "amps": "A",
    "mv": "mV", "mm": "mm", "cm": "cm", "rad": "rad", "rads": "rad/s", "nm": "N m", "mnm": "mN m", "counts": "count",
    "ticks": "count", "mg": "mg",
}  # fmt: skip


@dataclass(frozen=True)
class NameFacts:
    """What a name says; None where it says nothing.

    Attributes:
        corner: lf, rf, lr or rr.
        part: leg or wheel.
        quantity: pos, vel or eff.
        command: it is a setpoint.
        unit: one of :mod:`wlr_gym.data.logs.map`.
    """

    corner: str | None
    part: str | None
    quantity: str | None
    command: bool
    unit: str | None


def words(name: str) -> list[str]:
    """Return the words of a name in lower case: ``FL_hipPos2`` is fl, hip, pos, 2."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)]


def read_name(name: str) -> NameFacts:
    """Return what a name of a field, joint or column says."""
    found = words(name)
    quantity = next((kind for word in found for kind, known in _QUANTITIES.items() if word in known), None)
    unit = next((_UNITS[word] for word in reversed(found) if word in _UNITS), None)
    return NameFacts(corner_of(found), _part(found), quantity, any(word in _COMMAND for word in found), unit)


def corner_of(found: list[str]) -> str | None:
    """Return the corner that words name."""
    for word in found:
        if word in _CORNERS:
            return _CORNERS[word]
        for part in (*_WHEEL, *_LEG):  # flwheel, wheelfl
            rest = word.replace(part, "", 1)
            if rest != word and rest in _CORNERS:
                return _CORNERS[rest]
    said = set(found)
    end = "f" if said & _FRONT else "r" if said & _REAR else None
    side = "l" if said & _LEFT else "r" if said & _RIGHT else None
    if "r" in said:  # the one of right and rear that is not said otherwise
        side, end = side or "r", end or "r"
    return f"{side}{end}" if side and end else None


def _part(found: list[str]) -> str | None:
    """Return leg or wheel, by the word that comes last: ``leg_wheel_fl`` is a wheel on a leg."""
    part = None
    for word in found:
        if any(word.startswith(known) or word.endswith(known) for known in _WHEEL[:-1]) or word == "w":
            part = "wheel"
        elif any(word.startswith(known) or word.endswith(known) for known in _LEG):
            part = part or "leg"
    return part
