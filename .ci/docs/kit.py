"""Pictures of docs/build.md, from the robot's parts, and its wiring diagram: ``python .ci/docs/kit.py`` writes them."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from wlr_gym.robot import load_robot
from wlr_gym.robot.parts import make_kit, posed

FIGURES = Path(__file__).resolve().parents[2] / "docs" / "figures"
COLOURS = {
    **dict.fromkeys(("body_plate_lower", "body_plate_upper", "leg_arm"), "0.85 0.75 0.45 1"),
    **dict.fromkeys(("hip_block", "wheel", "ballast_foot", "imu_stand"), "0.25 0.45 0.75 1"),
    **dict.fromkeys(("hip_servo", "wheel_servo"), "0.2 0.2 0.22 1"),
    **dict.fromkeys(("ballast", "post"), "0.65 0.67 0.7 1"),
    "marker_plate": "0.95 0.95 0.95 1",
    "tyre": "0.1 0.1 0.1 1",
}
ELECTRONICS = ("power_hub", "adapter", "sensor_board", "imu", "flow_sensor")
#: Picture -> which pieces are there, camera's distance (mm), azimuth and elevation (deg), and what it looks at (mm).
STEPS = {
    "kit_1_legs": (("leg_arm", "wheel_servo", "wheel", "tyre"), 330, 150, -15, (175, 130, -70)),
    "kit_2_hips": (("body_plate_lower", "hip_block", "hip_servo"), 750, 130, -35, (0, 0, 0)),
    "kit_3_inside": (
        ("body_plate_lower", "hip_block", "hip_servo", "post", "imu_stand", *ELECTRONICS),
        750,
        130,
        -40,
        (0, 0, 0),
    ),
    "kit_4_whole": (("",), 900, 130, -20, (0, 0, -50)),
}


def pictures() -> None:
    """Render each step."""
    robot = load_robot("kit")
    pieces = posed(make_kit(robot), robot, [np.pi / 2] * 4)
    for name, (wanted, distance, azimuth, elevation, target) in STEPS.items():
        spec = mujoco.MjSpec()
        spec.visual.headlight.ambient = [0.45, 0.45, 0.45]
        spec.visual.global_.offwidth, spec.visual.global_.offheight = 1440, 960
        spec.add_texture(
            name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
            rgb1=[1, 1, 1], rgb2=[1, 1, 1], width=8, height=48,
        )  # fmt: skip
        for k, (piece, solid) in enumerate(pieces):
            one_leg = name != "kit_1_legs" or (solid.bounding_box()[0] > 0 and solid.bounding_box()[1] > 0)
            if piece in ("cables", "leg_screws") or not one_leg or not any(piece.startswith(word) for word in wanted):
                continue
            shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            mesh = solid.to_mesh()
            corners = np.asarray(mesh.vert_properties)[:, :3][np.asarray(mesh.tri_verts)]  # facets keep their edges
            spec.add_mesh(name=f"m{k}", uservert=corners.ravel() * 1e-3, userface=np.arange(3 * len(corners)), inertia=shell)
            rgba = [float(part) for part in COLOURS.get(piece, "0.2 0.55 0.3 1").split()]
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"m{k}", rgba=rgba)
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        camera = mujoco.MjvCamera()
        camera.distance, camera.azimuth, camera.elevation = distance * 1e-3, azimuth, elevation
        camera.lookat[:] = np.array(target) * 1e-3
        with mujoco.Renderer(model, 960, 1440) as renderer:
            renderer.update_scene(data, camera)
            image = Image.fromarray(renderer.render())
        dark = np.argwhere(np.asarray(image).min(axis=2) < 250)
        (top, left), (bottom, right) = dark.min(axis=0) - 20, dark.max(axis=0) + 20
        image = image.crop((max(left, 0), max(top, 0), right, bottom))
        image.thumbnail((640, 480), Image.Resampling.LANCZOS)
        image.quantize(64).save(FIGURES / f"{name}.png", optimize=True)


# ---- wiring ----

RED, BLACK, BLUE, GREEN, GREY = "#c62828", "#222", "#1565c0", "#2e7d32", "#777"
NANO = ["Arduino Nano, 5 V", "5V, GND", "A4 SDA, A5 SCL", "D8 INT", "D10 NCS", "D11 MOSI, D12 MISO", "D13 SCK"]
#: Box -> x, y, width, height, lines of text.
BOXES = {
    "supply": (10, 40, 160, 74, ["Supply", "12.0 V, 10 A or more", "battery: 12 V at most"]),
    "stop": (230, 40, 160, 74, ["EMERGENCY STOP", "locking, opens +", "25 A DC or more"]),
    "fuse1": (450, 30, 110, 38, ["Fuse 10 A"]),
    "fuse2": (450, 190, 110, 38, ["Fuse 10 A"]),
    "hub1": (620, 20, 150, 58, ["U2D2 power hub", "legs"]),
    "hub2": (620, 180, 150, 58, ["U2D2 power hub", "wheels"]),
    "legs": (830, 20, 200, 76, ["4 x XM540-W150-R", "ids 2, 3, 1, 4, chained", "1 GND  2 +12 V  3 D+  4 D-"]),
    "wheels": (830, 180, 200, 76, ["4 x XL430-W250-T", "ids 6, 7, 5, 8, chained", "1 GND  2 +12 V  3 DATA"]),
    "u1": (620, 110, 150, 38, ["U2D2, RS-485"]),
    "u2": (620, 270, 150, 38, ["U2D2, TTL"]),
    "computer": (230, 350, 160, 90, ["Computer", "3 x USB: feeds both", "U2D2 and the Nano"]),
    "nano": (450, 370, 150, 150, NANO),
    "shift": (660, 395, 130, 100, ["5 V to 3.3 V", "SDA, SCL: MOSFET", "SPI: 74LVC125"]),
    "imu": (850, 340, 180, 86, ["MPU-6050 (GY-521)", "VCC 5 V, AD0 to GND", "SDA, SCL, INT"]),
    "flow": (850, 450, 180, 86, ["PMW3901 board", "3.3 V from the Nano", "NCS, MOSI, MISO, SCK"]),
}  # fmt: skip
#: Wires: points, colour, label, and where it stands.
WIRES = [
    ([(170, 65), (230, 65)], RED, "+12 V", (178, 58)),
    ([(390, 65), (420, 65), (420, 49), (450, 49)], RED, "", None),
    ([(420, 65), (420, 209), (450, 209)], RED, "+12 V", (426, 170)),
    ([(560, 49), (620, 49)], RED, "+12 V", (568, 42)),
    ([(560, 209), (620, 209)], RED, "", None),
    (
        [(95, 114), (95, 325), (600, 325), (600, 70), (620, 70)],
        BLACK,
        "GND of supply and both hubs",
        (110, 318),
    ),
    ([(600, 230), (620, 230)], BLACK, "", None),
    ([(770, 35), (830, 35)], RED, "", None),
    ([(770, 195), (830, 195)], RED, "", None),
    ([(695, 110), (695, 78)], BLUE, "data", (702, 98)),
    ([(695, 270), (695, 238)], BLUE, "data", (702, 258)),
    ([(770, 50), (830, 50)], BLUE, "", None),
    ([(770, 210), (830, 210)], BLUE, "", None),
    ([(390, 372), (405, 372), (405, 129), (620, 129)], GREY, "USB", (520, 124)),
    ([(390, 384), (430, 384), (430, 289), (620, 289)], GREY, "USB", (520, 284)),
    ([(390, 410), (450, 410)], GREY, "USB", (400, 426)),
    ([(600, 440), (660, 440)], GREEN, "5 V", (615, 433)),
    ([(790, 425), (820, 425), (820, 383), (850, 383)], GREEN, "", None),
    ([(790, 465), (820, 465), (820, 493), (850, 493)], GREEN, "3.3 V", (783, 510)),
]


def wiring() -> str:
    """Return the wiring diagram as SVG."""
    parts = ['<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1050 560" font-family="sans-serif" font-size="13">']
    parts.append('<rect width="1050" height="560" fill="#fff"/>')
    for points, colour, label, place in WIRES:
        path = " ".join(f"{x},{y}" for x, y in points)
        parts.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2.5"/>')
        if label and place:
            parts.append(f'<text x="{place[0]}" y="{place[1]}" fill="{colour}" font-size="12">{label}</text>')
    for name, (x, y, width, height, lines) in BOXES.items():
        fill = "#ffe0e0" if name == "stop" else "#f4f6f8"
        parts.append(f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="6" fill="{fill}" stroke="#333"/>')
        top = y + (height - 17 * len(lines)) / 2 + 13
        for k, line in enumerate(lines):
            weight = ' font-weight="bold"' if k == 0 else ' font-size="12"'
            parts.append(f'<text x="{x + width / 2}" y="{top + 17 * k:g}" text-anchor="middle"{weight}>{line}</text>')
    return "\n".join([*parts, "</svg>\n"])


if __name__ == "__main__":
    (FIGURES / "wiring.svg").write_text(wiring())
    pictures()
