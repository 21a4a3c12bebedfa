"""Propose the clocks of IMU and pose: how far each is off the joints' clock, from all pairs of motions that show it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.check import integral
from wlr_gym.data.logs.align import Lag, find_lag
from wlr_gym.data.logs.signals import GUESS, LIKELY, SURE, BodyMotion, LogSignals, behind

Array = NDArray[np.float64]

#: s, 1 sigma: how far a pair of motions may be apart by what the robot does, and not by clocks. Heading and gyroscope are one
#: motion. Wheels roll as the body drives straight; in turns they first slip, and the body follows later.
_SAME, _STRAIGHT, _PUSHED, _TURNING = 0.001, 0.003, 0.004, 0.025
#: s, 1 sigma: what delivery to the recorder takes more for one topic than for another.
_DELIVERY = 0.015
#: Correlation below which a pair says nothing.
_LEAST = 0.85
#: Offsets below this many sigmas, or this many s, are left at 0.
_SIGMAS, _LEAST_OFFSET = 3.0, 0.003


@dataclass(frozen=True)
class Pair:
    """One estimate: ``topic`` is ``lag`` behind ``reference`` (s to be added to its times), 1 sigma, and what showed it."""

    topic: str
    reference: str
    lag: float
    sigma: float
    by: str


def set_clocks(
    look: LogSignals, body: BodyMotion | None, wheels: BodyMotion | None, heading: Array | None, pushed: Array | None
) -> None:
    """Set the clocks of the topics of pose and IMU; the joints' counts.

    Args:
        look: with the clocks that are roughly right.
        body: motion by the pose.
        wheels: motion by the wheels, without slip.
        heading: gyroscope about the vertical, raw, at the times of ``gyro_x``; None = not known.
        pushed: accelerometer along the robot, raw, at the times of ``acc_x``; None = not known.
    """
    pairs = [pair for pair in _pairs(look, body, wheels, heading, pushed) if pair.topic != pair.reference]
    joints = look.chosen["pos_wheel_lf"].topic if look.has("pos_wheel_lf") else ""
    unknown = sorted({name for pair in pairs for name in (pair.topic, pair.reference)} - {joints, *look.given.clocks})
    others = {look.chosen[column].topic for column in ("cam_x", "gyro_x") if look.has(column)} - {joints, *look.given.clocks}
    for topic in sorted(others - set(unknown)):
        look.note(f"clocks.{topic}", GUESS, f"left as it is: no motion shows it{_gross(look, topic)}")
    if not unknown:
        return
    for topic, (offset, sigma) in zip(unknown, _solve(pairs, unknown), strict=True):
        _set(look, topic, offset, sigma, [pair for pair in pairs if topic in (pair.topic, pair.reference)])


def _pairs(
    look: LogSignals, body: BodyMotion | None, wheels: BodyMotion | None, heading: Array | None, pushed: Array | None
) -> Iterator[Pair]:
    delay = 1.0 / (2.0 * np.pi * look.robot.sensors.imu.bandwidth)  # the IMU's own filter, which every simulator has
    joints = look.chosen["pos_wheel_lf"].topic if wheels is not None else ""
    pose = look.chosen["cam_x"].topic if body is not None else ""
    imu_topic = look.chosen["gyro_x"].topic if look.has("gyro_x") else ""
    straight = wheels.straight if wheels is not None else None
    if body is not None and wheels is not None:
        lag = find_lag(body.t, body.forward, wheels.t, wheels.forward, straight)
        yield from _pair(pose, joints, lag, _STRAIGHT, "the way that the wheels roll")
    if heading is not None:
        t, imu = look.raw("gyro_x")[0], look.chosen["gyro_x"].topic
        turned = integral(t, heading)
        if body is not None:
            lag = find_lag(t, turned, body.t, body.heading)
            yield from _pair(imu, pose, lag, _SAME, "gyroscope and heading", delay)
        if wheels is not None:
            lag = find_lag(t, turned, wheels.t, wheels.heading)
            yield from _pair(imu, joints, lag, _TURNING, "how the wheels turn the robot", delay)
    yield from _received(look, joints, {pose, imu_topic} - {joints, ""})
    if pushed is not None and wheels is not None:
        t, imu = look.raw("acc_x")[0], look.chosen["acc_x"].topic
        lag = find_lag(t, integral(t, pushed - pushed.mean()), wheels.t, np.gradient(wheels.forward, wheels.t), straight)
        yield from _pair(imu, joints, lag, _PUSHED, "pushes as the wheels speed up", delay)


def _received(look: LogSignals, joints: str, topics: Collection[str]) -> Iterator[Pair]:
    """Yield what the recorder's clock shows: messages arrive soon after they were measured."""
    base = behind(look.log, joints) if joints else None
    for topic in sorted(topics):
        late = behind(look.log, topic)
        if base is not None and late is not None:
            rest = late - base - look.clock(topic).offset
            yield Pair(topic, joints, rest, _DELIVERY, "when they were received")


def _pair(topic: str, reference: str, lag: Lag | None, own: float, by: str, delay: float = 0.0) -> Iterator[Pair]:
    if lag is not None and abs(lag.correlation) > _LEAST and np.isfinite(lag.sigma):
        yield Pair(topic, reference, lag.seconds + delay, float(np.hypot(lag.sigma, own)), by)


def _solve(pairs: Sequence[Pair], unknown: Sequence[str]) -> list[tuple[float, float]]:
    """Return offset and sigma of each unknown clock: least squares over all pairs."""
    rows = np.array([[(name == pair.topic) - float(name == pair.reference) for name in unknown] for pair in pairs])
    weight = np.array([1.0 / pair.sigma for pair in pairs])
    scaled = rows * weight[:, None]
    offsets = np.linalg.lstsq(scaled, weight * np.array([pair.lag for pair in pairs]), rcond=None)[0]
    spread = np.sqrt(np.diag(np.linalg.pinv(scaled.T @ scaled)))
    tied = np.abs(scaled).sum(axis=0) > 0.0
    return [
        (float(offset), float(sigma) if known else np.inf) for offset, sigma, known in zip(offsets, spread, tied, strict=True)
    ]


def _set(look: LogSignals, topic: str, offset: float, sigma: float, pairs: Sequence[Pair]) -> None:
    clock = look.clock(topic)
    by = "; ".join(f"{pair.by}: {1e3 * pair.lag:+.1f} ms" for pair in pairs)
    text = f"{1e3 * offset:+.1f} ms, 1 sigma {1e3 * sigma:.1f} ms ({by}){_gross(look, topic)}"
    sure = SURE if sigma < 0.003 else LIKELY if sigma < 0.01 else GUESS
    if abs(offset) < max(_LEAST_OFFSET, _SIGMAS * sigma):
        look.note(f"clocks.{topic}", sure, f"left as it is: {text}")
        return
    look.clocks[topic] = clock.model_copy(update={"offset": round(clock.offset + offset, 4)})
    look.note(f"clocks.{topic}", sure, f"moved by {text}")


def _gross(look: LogSignals, topic: str) -> str:
    offset = look.clock(topic).offset
    return f"; its header counts from another moment ({offset:.3f} s)" if offset else ""
