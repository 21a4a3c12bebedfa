"""Effects in the sensors: the robot moves as before, what it reads is wrong."""

from __future__ import annotations

from wlr_gym.physics.effects.effect import Effect, EffectParameter, add, add_vector, multiply, together, xyz
from wlr_gym.physics.effects.search import LEG_SETS, Guess, Known, Observed, Places, Search, along
from wlr_gym.robot import LEGS

_ANGLES = {
    axis: EffectParameter("rad", f"{axis} from sensor to body", -0.5, 0.5, 0.0, (-0.2, 0.2), severity, optional=True)
    for axis, severity in (("roll", 0.02), ("pitch", 0.06), ("yaw", 0.04))
}

SENSOR = (("sensor",),)


def _imu_guesses(where: Places, observed: Observed) -> list[Guess]:
    neutral, turn = dict.fromkeys(_ANGLES, 0.0), 0.03
    return [along(turn, *({**neutral, axis: turn} for axis in _ANGLES))]


EFFECTS: tuple[Effect, ...] = (
    Effect(
        "joint_zero_offset",
        "zero of the encoder is wrong; the servo regulates the reading",
        "reading = true angle + angle",
        LEGS,
        {"angle": EffectParameter("rad", "reading minus true angle", -0.5, 0.5, 0.0, (-0.1, 0.1), 0.04)},
        add("joint.zero_offset", "angle"),
        search=Search("zero of the {}", "all_legs", LEG_SETS, known={"angle": Known("joint.zero_offset[{}]", step=0.01)}),
    ),
    Effect(
        "gyro_bias",
        "constant rate offset beyond specification",
        "reading = rate + (x, y, z)",
        ("sensor",),
        xyz("rad/s", 1.0, 0.1, (0.0, 0.0, 0.05), "offset about the sensor's {axis}"),
        add_vector("imu.gyro_bias", "xyz"),
        search=Search(
            "reading of the gyroscope",
            "random",
            SENSOR,
            known={axis: Known(f"imu.gyro_bias[{axis}]", step=0.005) for axis in "xyz"},
            components=True,
        ),
    ),
    Effect(
        "imu_misalignment",
        "IMU mounted rotated; angles of two such effects add",
        "reading = (Rz(yaw) Ry(pitch) Rx(roll))^T body-frame vector",
        ("sensor",),
        _ANGLES,
        add_vector("imu.mount", ("roll", "pitch", "yaw")),
        search=Search("mounting of the IMU", "random", SENSOR, _imu_guesses, components=True),
    ),
    Effect(
        "camera_misalignment",
        "camera's floor frame turned by +yaw against the start heading, and scaled; the measured yaw stays",
        "(x, y) measured = scale R(-yaw) (x, y)",
        ("sensor",),
        {
            "yaw": EffectParameter("rad", "turn of the camera's frame", -0.5, 0.5, 0.0, (-0.2, 0.2), 0.06, optional=True),
            "scale": EffectParameter("-", "measured over true length", 0.5, 2, 1.0, (0.8, 1.25), 1.05, optional=True),
        },
        together(add("camera.mount_yaw", "yaw"), multiply("camera.scale", "scale")),
        search=Search(
            "mounting of the camera",
            "s_curve",
            SENSOR,
            known={"yaw": Known("camera.mount_yaw", step=0.02), "scale": Known("camera.scale", step=0.02)},
            components=True,
        ),
    ),
    Effect(
        "camera_delay",
        "vision pose older than its row, on top of the camera's own delay",
        "pose(t - delay)",
        ("sensor",),
        {"delay": EffectParameter("s", "extra age", 0, 0.5, 0.0, (0, 0.15), 0.04)},
        add("camera.delay", "delay"),
        search=Search("timing of the camera", "chirp", SENSOR, known={"delay": Known("camera.delay", step=0.01)}),
    ),
    Effect(
        "flow_misalignment",
        "optical-flow sensor mounted turned by +yaw on the body, and its scale wrong",
        "(x, y) measured = scale R(-yaw) (x, y)",
        ("sensor",),
        {
            "yaw": EffectParameter("rad", "turn of the sensor on the body", -3.2, 3.2, 0.0, (-0.2, 0.2), 0.06, optional=True),
            "scale": EffectParameter("-", "measured over true flow", 0.5, 2, 1.0, (0.8, 1.25), 1.05, optional=True),
        },
        together(add("flow.mount_yaw", "yaw"), multiply("flow.scale", "scale")),
    ),
)
