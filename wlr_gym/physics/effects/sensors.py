"""Effects in the sensors: the robot moves as before, what it reads is wrong."""

from __future__ import annotations

from wlr_gym.physics.effects.effect import Effect, EffectParameter, add, add_vector, multiply, together, xyz

_ANGLES = {
    axis: EffectParameter("rad", f"{axis} from sensor to body", -0.5, 0.5, 0.0, (-0.2, 0.2), severity, optional=True)
    for axis, severity in (("roll", 0.02), ("pitch", 0.06), ("yaw", 0.04))
}

EFFECTS: tuple[Effect, ...] = (
    Effect(
        "gyro_bias",
        "constant rate offset beyond specification",
        "reading = rate + (x, y, z)",
        ("sensor",),
        xyz("rad/s", 1.0, 0.1, (0.0, 0.0, 0.05), "offset about the sensor's {axis}"),
        add_vector("imu.gyro_bias", "xyz"),
    ),
    Effect(
        "imu_misalignment",
        "IMU mounted rotated; angles of two such effects add",
        "reading = (Rz(yaw) Ry(pitch) Rx(roll))^T body-frame vector",
        ("sensor",),
        _ANGLES,
        add_vector("imu.mount", ("roll", "pitch", "yaw")),
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
    ),
    Effect(
        "camera_delay",
        "vision pose older than its row, on top of the camera's own delay",
        "pose(t - delay)",
        ("sensor",),
        {"delay": EffectParameter("s", "extra age", 0, 0.5, 0.0, (0, 0.15), 0.04)},
        add("camera.delay", "delay"),
    ),
)
