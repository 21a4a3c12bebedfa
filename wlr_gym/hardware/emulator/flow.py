"""The emulated flow sensor: what its microcontroller sends of the plant's flow, frame by frame."""

from __future__ import annotations

import math

import numpy as np

from wlr_gym.hardware.config import FlowPort
from wlr_gym.hardware.emulator.faults import FaultBoard
from wlr_gym.hardware.emulator.line import Emission
from wlr_gym.hardware.flow.frames import FlowFrame, encode_frame
from wlr_gym.hardware.flow.reading import FULL_QUALITY, FlowConversion
from wlr_gym.physics.plants.base import Sensors
from wlr_gym.robot.sensors import FlowSensor

#: Shutter on a floor of good texture in a lit room, and at its longest.
_SHUTTER, _LONGEST_SHUTTER = 0x0400, 0x1FFF
#: Frames after which the last bit of the surface quality changes, of a plant without noise.
_DITHER = 3


class EmulatedFlow:
    """Chip and microcontroller.

    Args:
        port: the chip's axes; of its calibration nothing: what is wrong with the sensor is the plant's.
        sensor: of the robot's file.
        faults: shared with the rest of the robot.
        tick: s of emulated time.
    """

    def __init__(self, port: FlowPort, sensor: FlowSensor, faults: FaultBoard, tick: float) -> None:
        self._convert = FlowConversion(port.model_copy(update={"calibration": type(port.calibration)()}), sensor)
        self._sensor, self._faults, self._tick = sensor, faults, tick
        self._frames = 0
        self._sent_at = 0.0
        self._last = FlowFrame(0, 0, 0, 0, 0, 0, 0)

    def step(self, time: float, paused: float, sensors: Sensors) -> list[Emission]:
        """Return what is sent at a tick, s: a frame for each of the chip's.

        Args:
            time: s of emulated time.
            paused: s for which it stood still while quartzes went on.
            sensors: of the plant at this tick.
        """
        is_valid = bool(sensors.flow_is_new[0])
        if not is_valid and time - self._sent_at < 1.0 / self._sensor.rate + self._tick:
            return []
        self._sent_at = time
        self._frames += 1
        interval = 1.0 / self._sensor.rate
        end = time - float(sensors.flow_age[0]) if is_valid else time
        flow = sensors.flow[0] if is_valid else np.zeros(2)
        quality = float(sensors.flow_quality[0]) if is_valid else 0.0
        frame = self._frame(time, round((end + paused) * 1e6), flow, quality, interval)
        raw, delay = self._faults.mangle(time, encode_frame(frame), ["flow"])
        if not raw or self._faults.happens(time, "dead", ["flow"]):
            return []
        return [Emission(time + delay, raw)]

    def _frame(self, time: float, microseconds: int, flow: np.ndarray, quality: float, interval: float) -> FlowFrame:
        """Return what is sent, with what the faults make of it."""
        active = self._faults.active
        if (turned := active(time, "flow_turned", ["flow"])) is not None:
            c, s = math.cos(turned.value), math.sin(turned.value)
            flow = np.array([c * flow[0] + s * flow[1], c * flow[1] - s * flow[0]])
        if (scale := active(time, "flow_scale", ["flow"])) is not None:
            flow = scale.value * flow
        x, y = self._convert.counts(flow, interval)
        if (stuck := active(time, "flow_saturated", ["flow"])) is not None:
            x = y = round(stuck.value)
        squal, shutter = round(quality * FULL_QUALITY), _SHUTTER if quality > 0.0 else _LONGEST_SHUTTER
        squal += self._frames // _DITHER % 2 if squal else 0
        if (bare := active(time, "flow_texture", ["flow"])) is not None:
            x, y, squal, shutter = 0, 0, round(bare.value), _LONGEST_SHUTTER
        if active(time, "flow_frozen", ["flow"]) is not None:
            x, y, squal, shutter = self._last.x, self._last.y, self._last.quality, self._last.shutter
        self._last = FlowFrame(
            self._frames % 65536, microseconds % 2**32, round(interval * 1e6), x, y, min(squal, 255), shutter
        )
        return self._last
