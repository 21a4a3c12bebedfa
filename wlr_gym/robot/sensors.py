"""What a robot can measure, and how badly: the section ``sensors`` of its file."""

from __future__ import annotations

from typing import Any

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from wlr_gym.base.settings import SettingsModel

Vector3 = tuple[float, float, float]


class Encoder(SettingsModel):
    """One register count of position (rad) and velocity (rad/s)."""

    position: float = Field(ge=0)
    velocity: float = Field(ge=0)


class EffortSensor(SettingsModel):
    """1 sigma noise of the torque estimate (N m)."""

    leg_noise: float = Field(ge=0)
    wheel_noise: float = Field(ge=0)


class ImuSensor(SettingsModel):
    """Bandwidth (Hz), noise per 50 Hz sample and constant bias, 1 sigma (rad/s, m/s2)."""

    bandwidth: float = Field(gt=0)
    gyro_noise: float = Field(ge=0)
    accel_noise: float = Field(ge=0)
    gyro_bias: float = Field(ge=0)
    accel_bias: float = Field(ge=0)


class CameraSensor(SettingsModel):
    """Frame rate (Hz) and 1 sigma noise of the floor pose (m, rad)."""

    rate: float = Field(gt=0)
    position_noise: float = Field(ge=0)
    yaw_noise: float = Field(ge=0)


class FlowSensor(SettingsModel):
    """Optical-flow sensor that looks along body -z. Numbers: data sheet of the PixArt PMW3901MB unless marked [chosen].

    Attributes:
        position: of its lens in the body frame (m).
        field_of_view: full angle (rad), seen by a row of ``pixels``.
        counts_per_pixel: counts of motion per pixel of shift; not in the data sheet, found by others on the chip.
        rate: frames per second.
        noise: 1 sigma of one frame's counts at rest on good texture [chosen]; frames are independent.
        speed_noise: further 1 sigma, share of the frame's counts [chosen].
        quality, quality_noise: surface quality on good texture, share of the register's range, and its 1 sigma [chosen].
        least_quality: below it a reading is not valid: 0x19 of 255.
        least_height: shortest distance to the floor at which it works (m).
        greatest_rate: fastest turn of the floor that it measures (rad/s).
    """

    position: Vector3
    field_of_view: float = Field(0.733, gt=0, lt=3.0)
    pixels: int = Field(35, ge=1)
    counts_per_pixel: float = Field(10.0, gt=0)
    rate: float = Field(121.0, gt=0)
    noise: float = Field(0.65, ge=0)
    speed_noise: float = Field(0.03, ge=0)
    quality: float = Field(0.35, gt=0, le=1)
    quality_noise: float = Field(0.03, ge=0)
    least_quality: float = Field(0.098, ge=0, le=1)
    least_height: float = Field(0.08, ge=0)
    greatest_rate: float = Field(7.4, gt=0)

    @property
    def count(self) -> float:
        """One count of motion (rad)."""
        return self.field_of_view / self.pixels / self.counts_per_pixel


class SensorSet(SettingsModel):
    """What the robot can measure, and how badly; ``volt_count`` is one register count of the supply (V).

    ``flow`` is an optical-flow sensor, where one is fitted.
    """

    control_rate: float = Field(gt=0)
    encoder: Encoder
    effort: EffortSensor
    volt_noise: float = Field(ge=0)
    volt_count: float = Field(0.1, ge=0)
    imu: ImuSensor
    camera: CameraSensor
    flow: FlowSensor | None = None

    @property
    def flow_noise(self) -> float:
        """1 sigma of an optical-flow reading of one control period, at rest on good texture (rad/s); 0 without a sensor."""
        return 0.0 if self.flow is None else self.flow.noise * self.flow.count * (self.flow.rate * self.control_rate) ** 0.5

    @property
    def has_flow(self) -> float:
        """1 where an optical-flow sensor is fitted, else 0."""
        return 0.0 if self.flow is None else 1.0

    @model_serializer(mode="wrap")
    def _without_what_is_not_fitted(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        content = write(self)
        return content if self.flow is not None else {key: value for key, value in content.items() if key != "flow"}
