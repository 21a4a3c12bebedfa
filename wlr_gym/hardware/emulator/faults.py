"""Faults on command: what can go wrong on the bus, in a servo and at the supply.

A fault is one line of text: ``KIND [WHERE ...] [probability=P] [value=X] [after=S] [duration=S]``, for example
``drop wheels probability=0.01`` or ``dead leg_lf after=2 duration=0.5``. WHERE is a joint, a bus, ``imu``, ``flow`` or
``camera``; none = everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from wlr_gym.base.errors import InputError, check_name
from wlr_gym.hardware.camera.reading import CAMERA_FAULTS


class FaultKind(NamedTuple):
    """What a kind of fault does, its value's default and unit, and how long it lasts unless told (s)."""

    doc: str
    value: float = 0.0
    unit: str = ""
    duration: float = math.inf


#: Kinds of faults. The first group hits bytes on their way to the host (packet by packet, with the probability given).
FAULTS: dict[str, FaultKind] = {
    "drop": FaultKind("the answer is lost on its way to the host"),
    "delay": FaultKind("the answer comes later than it should", 0.002, "s"),
    "late": FaultKind("the answer comes when the host has given up", 0.05, "s"),
    "flip": FaultKind("one random bit of the answer is wrong"),
    "truncate": FaultKind("the end of the answer is missing"),
    "noise": FaultKind("random bytes come before the answer", 8, "bytes"),
    "echo": FaultKind("the host's own bytes come back before the answers (adapter without echo suppression)"),
    "deaf": FaultKind("the instruction does not reach the servo"),
    "dead": FaultKind("the servo has no power: silent, motor off; comes back rebooted"),
    "brownout": FaultKind("the supply breaks down for the duration: every servo named reboots", duration=0.05),
    "unplug": FaultKind("the adapter is pulled out; at the end it is back, perhaps under another name"),
    "overload": FaultKind("the servo finds itself overloaded: error, shutdown"),
    "overheat": FaultKind("the servo heats up", 2.0, "degC/s"),
    "sag": FaultKind("the supply drops", 3.0, "V"),
    "torque_lost": FaultKind("Torque Enable is cleared, without an error", duration=0.005),
    "reboot_matching_tick": FaultKind("the servo reboots, and its Realtime Tick goes on as if it had not", duration=0.005),
    "encoder_frozen": FaultKind("the encoder repeats its reading, whatever the shaft does"),
    "encoder_jump": FaultKind("the encoder is off from here on", 0.5, "rad"),
    "encoder_gain": FaultKind("the encoder counts this part of the motion from here on", 0.3, "of it"),
    "encoder_drift": FaultKind("the encoder's reading drifts", 0.153, "rad/s"),
    "encoder_reversed": FaultKind("the encoder counts backwards from here on"),
    "motor_reversed": FaultKind("the motor's wires are swapped: it turns the wrong way"),
    "current_stuck": FaultKind("the register of current or load repeats this", 0, "counts"),
    "slow_servo": FaultKind("the motor gets but a part of the voltage it should", 0.05, "of it"),
    "limit_changed": FaultKind("something else holds the servo's Goal PWM at this", 200, "counts"),
    "duplicate_id": FaultKind("a second servo with the same id answers at the same time: both answers are garbled"),
    "late_answers": FaultKind("the adapter holds every answer back, as a hub or a wrong latency timer does", 0.006, "s"),
    "eeprom_worn": FaultKind("what is written to the servo's EEPROM is acknowledged, and not kept"),
    "imu_axis_dead": FaultKind("one axis reads 0: 0 to 2 = accelerometer x, y, z, 3 to 5 = gyroscope x, y, z", 2, "axis"),
    "imu_axis_constant": FaultKind("one axis repeats its reading; numbers as of imu_axis_dead", 5, "axis"),
    "imu_axis_saturated": FaultKind("one axis reads the end of its range; numbers as of imu_axis_dead", 2, "axis"),
    "imu_frozen": FaultKind("the chip repeats its values; the microcontroller numbers and stamps them anew"),
    "flow_texture": FaultKind("the floor has no texture: the flow sensor's surface quality is this", 8, "counts"),
    "flow_frozen": FaultKind("the flow sensor repeats its counts"),
    "flow_scale": FaultKind("the flow sensor counts this much", 1.2, "of the true flow"),
    "flow_turned": FaultKind("the flow sensor has turned on the body", 1.5708, "rad"),
    "flow_saturated": FaultKind("the flow sensor counts this much in every frame", 120, "counts"),
    "imu_stale": FaultKind("the microcontroller sends the same frame again and again"),
    **{name: FaultKind(*what) for name, what in CAMERA_FAULTS.items()},
}
_REPLY_FAULTS = ("drop", "delay", "late", "flip", "truncate", "noise", "duplicate_id")
#: Bytes of an answer before the error byte, which are the same in both of two servos with one id.
_SAME = 8
#: Key of a fault -> its largest value.
_LARGEST = {"probability": 1.0, "value": math.inf, "after": math.inf, "duration": math.inf}


@dataclass(frozen=True)
class Fault:
    """One fault."""

    kind: str  #: key of :data:`FAULTS`
    where: tuple[str, ...] = ()  #: joints, buses, ``imu``, ``flow`` or ``camera``; empty = everywhere
    probability: float = 1.0  #: chance per packet, for faults that hit bytes
    value: float = 0.0  #: see :data:`FAULTS`
    after: float = 0.0  #: s from when it was asked for until it starts
    duration: float = math.inf  #: s it lasts

    def __str__(self) -> str:
        kind = FAULTS[self.kind]
        parts = [self.kind, *self.where]
        parts += [f"probability={self.probability:g}"] if self.probability < 1.0 else []
        parts += [f"value={self.value:g}"] if kind.unit else []
        parts += [f"after={self.after:g}"] if self.after > 0.0 else []
        parts += [f"duration={self.duration:g}"] if math.isfinite(self.duration) else []
        return " ".join(parts)


def parse_fault(text: str, places: Collection[str]) -> Fault:
    """Read a fault from a line of text.

    Args:
        text: see the module's head.
        places: names that WHERE may be.

    Raises:
        InputError: unknown kind, place or key, or a value that is no number in range; names the nearest valid one.
    """
    kind, *words = text.split() or [""]
    check_name("fault", kind, FAULTS)
    where = tuple(word for word in words if "=" not in word)
    for place in where:
        check_name("place", place, places, f"fault '{text}'")
    numbers = {"value": FAULTS[kind].value, "duration": FAULTS[kind].duration}
    for key, _, number in (word.partition("=") for word in words if "=" in word):
        check_name("key", key, _LARGEST, f"fault '{text}'")
        try:
            numbers[key] = float(number)
        except ValueError:
            raise InputError(f"fault '{text}': {key} = '{number}' is no number") from None
        if not 0.0 <= numbers[key] <= _LARGEST[key]:
            up_to = " up to 1" if key == "probability" else ""
            raise InputError(f"fault '{text}': {key} = {number}, expected 0 or more{up_to}")
    return Fault(kind, where, **numbers)


class FaultBoard:
    """Faults that were asked for, with the time they hold.

    Args:
        seed: of the random choices (which packets, which bits).
    """

    def __init__(self, seed: int = 0) -> None:
        self._random = np.random.default_rng(seed)
        self._faults: list[tuple[float, float, Fault]] = []

    def add(self, fault: Fault, now: float) -> None:
        """Take a fault asked for at ``now`` (s)."""
        start = now + fault.after
        self._faults.append((start, start + fault.duration, fault))

    def clear(self, kind: str | None = None) -> None:
        """Forget all faults, or those of one kind."""
        self._faults = [entry for entry in self._faults if kind is not None and entry[2].kind != kind]

    def active(self, now: float, kind: str, places: Sequence[str]) -> Fault | None:
        """Return a fault of ``kind`` that holds at any of ``places`` now; None = there is none."""
        return next((fault for fault in self._holding(now, places) if fault.kind == kind), None)

    def values(self, now: float, places: Sequence[str]) -> dict[str, float]:
        """Return the kinds of fault that hold at any of ``places`` now, and the value of the first of each."""
        return {fault.kind: fault.value for fault in reversed(self._holding(now, places))}

    def _holding(self, now: float, places: Sequence[str]) -> list[Fault]:
        return [
            fault
            for start, end, fault in self._faults
            if start <= now < end and (not fault.where or any(place in fault.where for place in places))
        ]

    @property
    def any(self) -> bool:
        """Whether there is anything to look after."""
        return bool(self._faults)

    def listing(self, now: float) -> list[str]:
        """Return the faults that hold now or will."""
        return [str(fault) for _, end, fault in self._faults if now < end]

    def happens(self, now: float, kind: str, places: Sequence[str]) -> Fault | None:
        """As :meth:`active`, but only with the fault's probability."""
        if not self._faults:
            return None
        fault = self.active(now, kind, places)
        return fault if fault is not None and self._random.random() < fault.probability else None

    def mangle(self, now: float, raw: bytes, places: Sequence[str]) -> tuple[bytes, float]:
        """Return what arrives of ``raw`` (perhaps nothing), and how much later (s)."""
        if not self._faults:
            return raw, 0.0
        hits = {kind: fault for kind in _REPLY_FAULTS if (fault := self.happens(now, kind, places)) is not None}
        if "drop" in hits:
            return b"", 0.0
        if "flip" in hits:
            bit = int(self._random.integers(8 * len(raw)))
            raw = bytes(byte ^ (1 << bit % 8 if k == bit // 8 else 0) for k, byte in enumerate(raw))
        if "duplicate_id" in hits:
            others = self._random.bytes(len(raw))
            raw = bytes(byte & other if k >= _SAME else byte for k, (byte, other) in enumerate(zip(raw, others, strict=True)))
        if "truncate" in hits:
            raw = raw[: int(self._random.integers(1, len(raw)))]
        if "noise" in hits:
            raw = self._random.bytes(round(hits["noise"].value)) + raw
        return raw, sum(hits[kind].value for kind in ("delay", "late") if kind in hits)
