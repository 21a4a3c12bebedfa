"""Which camera sees the robot, and what it sees, loaded from ``configs/camera/*.yaml``."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from wlr_gym.base.paths import named_by, named_in
from wlr_gym.base.settings import SettingsModel, parse_config, read_config, require_keys
from wlr_gym.perception.markers.camera import Camera, load_camera
from wlr_gym.perception.markers.targets import Target, load_target

#: What a calibration without a readout costs: a film tells it, a live pose cannot.
UNKNOWN_READOUT = "its calibration states no readout: with a rolling shutter its poses are off while the robot moves"


class EmulatedScene(SettingsModel):
    """How the camera of an emulated robot is set up; of no meaning to a real one.

    Attributes:
        height: m of the lens above the floor. tilt: rad from straight down.
        blur: px, 1 sigma of the lens's blur. noise: grey levels, 1 sigma.
        exposure: s. latency: s from mid-exposure until the frame has arrived.
        dropout: share of frames that are lost on the way.
        clutter: things on the floor that are no markers: discs, rings of other radii, boxes.
        samples: rays a side in pixels with an edge.
        seed: of noise, losses, clutter.
    """

    height: float = Field(default=2.5, gt=0.2, le=20.0)
    tilt: float = Field(default=0.0, ge=-1.2, le=1.2)
    blur: float = Field(default=0.8, ge=0.0, le=10.0)
    noise: float = Field(default=4.0, ge=0.5, le=50.0)
    exposure: float = Field(default=0.005, ge=0.0, le=0.05)
    latency: float = Field(default=0.04, ge=0.0, le=0.5)
    dropout: float = Field(default=0.0, ge=0.0, lt=1.0)
    clutter: int = Field(default=0, ge=0, le=500)
    samples: int = Field(default=4, ge=1, le=16)
    seed: int = Field(default=0, ge=0)


class CameraFile(SettingsModel):
    """A camera above the floor, as one ``configs/camera/*.yaml`` describes it.

    Attributes:
        name: of it.
        device: number of the camera (0 = /dev/video0), or its path; a path that ends in ``.npy`` is a recorded film, an array
            (frames, H, W) of grey levels that is shown over and over.
        calibration: file of ``wlr calibrate camera``, seen from this file first, or its content.
        body, floor: markers on the robot and on the floor: files, seen from this file first, or names in ``configs/vision/``.
        rate: frames per second that are asked for.
        delay: s from mid-exposure to a frame's time stamp (or, where the driver has none, to its arrival), where it is known.
        emulated: how it is set up over an emulated robot.
    """

    name: str
    device: int | str = 0
    calibration: Camera
    body: Target
    floor: Target
    rate: float = Field(default=30.0, gt=1.0, le=500.0)
    delay: float = Field(default=0.0, ge=0.0, le=0.2)
    emulated: EmulatedScene = EmulatedScene()

    @property
    def doubt(self) -> str:
        """What is not known of the camera that its poses suffer from; empty = nothing."""
        return "" if self.calibration.readout is not None else UNKNOWN_READOUT

    @property
    def is_film(self) -> bool:
        """Whether it is a recorded film."""
        return isinstance(self.device, str) and self.device.endswith(".npy")


def load_camera_file(source: str | Path | CameraFile) -> CameraFile:
    """Load a camera by config name or path, with the files that it names.

    Raises:
        InputError: unreadable file, unknown or missing key, a calibration or target that cannot be read.
    """
    if isinstance(source, CameraFile):
        return source
    data, where = read_config("camera", source)
    require_keys(CameraFile, data, where)
    content = dict(data)
    for key in ("body", "floor"):
        if isinstance(target := data.get(key, key), str):
            with named_by(where, key):
                content[key] = load_target(named_in(where, target))
    if isinstance(calibration := data.get("calibration"), str):
        with named_by(where, "calibration"):
            content["calibration"] = load_camera(named_in(where, calibration))
    return parse_config(CameraFile, content, where)
