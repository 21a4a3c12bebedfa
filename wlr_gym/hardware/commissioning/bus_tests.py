"""Tests of the line: adapters, and a servo that does not answer."""

from __future__ import annotations

import numpy as np

from wlr_gym.hardware.commissioning.contract import Reading, StandQuantity, StandTest
from wlr_gym.hardware.commissioning.person import Person
from wlr_gym.hardware.commissioning.stand import Stand
from wlr_gym.hardware.dynamixel.bus import Block

#: Pings per bus.
_PINGS = 100
#: Bytes of a ping and its answer, bits per byte.
_PING_BYTES, _BITS = 10 + 14, 10
#: An id that no servo has.
_GHOST = 250
_TIMER = "Set the adapter's latency timer to 1 ms (docs/robot.md), use a port without a hub, end what loads the computer."
_CHAIN = "The emulator has this otherwise: report it. Reads that miss a servo cost another time than on the emulator."


def _measure_latency(stand: Stand, person: Person) -> list[Reading]:
    found = []
    for name, bus in stand.hardware.buses.items():
        joint, group = bus.joints[0], stand.servos.groups[name]
        lost = sum(group.statistics.missing.values())
        times = []
        for _ in range(_PINGS):
            start = stand.clock.now()
            stand.servos.ping(joint)
            times.append(stand.clock.now() - start - _PING_BYTES * _BITS / bus.baud_rate)
        median, slow = np.percentile(times, [50, 99]).tolist()
        stand.samples[f"ping_{name}"] = times
        lost = sum(group.statistics.missing.values()) - lost
        found += [
            Reading("adapter_latency", name, median),
            Reading("adapter_jitter", name, slow - median),
            Reading("lost_answers", name, lost / _PINGS),
        ]
    return found


LATENCY = StandTest(
    "latency",
    "Latency and jitter of the adapters",
    "",
    "Nothing moves.",
    (
        StandQuantity("adapter_latency", "s", "median time of a ping beyond its bytes' time on the wire", 0.0015, _TIMER),
        StandQuantity("adapter_jitter", "s", "99 of 100 pings take at most so much longer than the median", 0.002, _TIMER),
        StandQuantity(
            "lost_answers", "-", "part of the pings without an answer", 0.005, "Check cable, ground and termination."
        ),
    ),
    _measure_latency,
)


def _measure_silent_servo(stand: Stand, person: Person) -> list[Reading]:
    found = []
    for name, group in stand.servos.groups.items():
        first, *others = group.servos
        if not others:  # nobody is behind or before the silent one
            continue
        table = group.servos[first]
        block = Block(table, "realtime_tick", "present_position")
        for kind in ("ordinary", "fast"):
            asked = group.on_same_port(dict.fromkeys((first, _GHOST, *others), table))
            asked.fast = kind == "fast"
            start = stand.clock.now()
            asked.ask_all(block)
            answered = asked.answers()
            stand.samples[f"{kind}_read_{name}"] = [stand.clock.now() - start]
            found.append(Reading(f"answers_behind_{kind}", name, sum(id in answered for id in others) / len(others)))
            found.append(Reading(f"answers_before_{kind}", name, float(first in answered)))
        stand.servos.read()  # the line is quiet again
    return found


SILENT_SERVO = StandTest(
    "silent_servo",
    "A read of several servos, one of which does not exist",
    "",
    "Nothing moves.",
    tuple(
        StandQuantity(
            f"answers_{place}_{kind}",
            "-",
            f"part of the servos named {place} the silent one that answer, {kind} read",
            0.1,
            _CHAIN,
        )
        for kind in ("ordinary", "fast")
        for place in ("before", "behind")
    ),
    _measure_silent_servo,
)
