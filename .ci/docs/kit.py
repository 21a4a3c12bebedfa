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
NANO = ["Arduino Nano, 5 V", "5V, GND", "A4 SDA, A5 SCL", "D8 INT", "D12 MISO", "D10 NCS", "D11 MOSI, D13 SCK"]
#: Box -> x, y, width, height, lines of text.
BOXES = {
    "supply": (10, 40, 150, 74, ["Supply", "12.0 V, 10 A or more", "battery: 12 V at most"]),
    "fuse": (190, 47, 110, 60, ["Main fuse", "15 A, 32 V DC", "at the plus pole"]),
    "stop": (330, 40, 150, 74, ["EMERGENCY STOP", "locking, opens +", "25 A DC or more"]),
    "hub1": (550, 20, 140, 58, ["U2D2 power hub", "legs"]),
    "hub2": (550, 180, 140, 58, ["U2D2 power hub", "wheels"]),
    "fuses1": (720, 16, 125, 36, ["2 fuses T 3.15 A", "one per branch"]),
    "fuses2": (720, 176, 125, 36, ["2 fuses T 3.15 A", "one per branch"]),
    "legs": (880, 16, 190, 92, ["4 x XM540-W150-R", "ids 2 then 1, 3 then 4", "1 GND  2 +12 V", "3 D+  4 D-"]),
    "wheels": (880, 176, 190, 92, ["4 x XL430-W250-T", "ids 6 then 5, 7 then 8", "1 GND  2 +12 V", "3 DATA"]),
    "u1": (550, 110, 140, 38, ["U2D2, RS-485"]),
    "u2": (550, 270, 140, 38, ["U2D2, TTL"]),
    "computer": (170, 375, 140, 90, ["Computer", "3 x USB: feeds both", "U2D2 and the Nano"]),
    "nano": (370, 360, 150, 170, NANO),
    "shift": (620, 350, 150, 36, ["MOSFET shifter", "5 V - 3.3 V"]),
    "up": (620, 396, 150, 48, ["74AHCT125 on 5 V", "3.3 V to 5 V"]),
    "down": (620, 458, 150, 48, ["74LVC125 on 3.3 V", "5 V to 3.3 V"]),
    "regulator": (620, 520, 150, 36, ["MCP1700-3302", "5 V to 3.3 V"]),
    "imu": (880, 345, 190, 86, ["MPU-6050 (GY-521)", "VCC 5 V, AD0 to GND", "SDA, SCL, INT"]),
    "flow": (880, 450, 190, 86, ["PMW3901 board", "3.3 V", "NCS, MOSI, MISO, SCK"]),
}  # fmt: skip
GROUND = "GND: Nano, both sensors, shifter, both 74 and their OE, regulator"
#: Wires: points, colour, label, and where it stands.
WIRES = [
    ([(160, 77), (190, 77)], RED, "", None),
    ([(300, 77), (330, 77)], RED, "", None),
    ([(480, 77), (510, 77), (510, 37), (550, 37)], RED, "+12 V", (508, 30)),
    ([(510, 77), (510, 197), (550, 197)], RED, "+12 V", (470, 170)),
    ([(85, 114), (85, 332), (530, 332), (530, 65), (550, 65)], BLACK, "GND of supply and both hubs", (100, 325)),
    ([(530, 226), (550, 226)], BLACK, "", None),
    *(([(690, y + 34), (720, y + 34)], RED, "", None) for y in (0, 160)),
    *(([(845, y + 34), (880, y + 34)], RED, "", None) for y in (0, 160)),
    *(([(690, y + 60), (880, y + 60)], BLACK, "GND", (850, y + 57)) for y in (0, 160)),
    *(([(690, y + 72), (880, y + 72)], BLUE, "data", (850, y + 84)) for y in (0, 160)),
    ([(615, 110), (615, 78)], BLUE, "data, GND", (622, 98)),
    ([(615, 270), (615, 238)], BLUE, "data, GND", (622, 258)),
    ([(310, 390), (325, 390), (325, 129), (550, 129)], GREY, "USB", (440, 124)),
    ([(310, 402), (345, 402), (345, 289), (550, 289)], GREY, "USB", (440, 284)),
    ([(310, 430), (370, 430)], GREY, "USB", (326, 446)),
    ([(520, 368), (620, 368)], GREEN, "SDA, SCL", (530, 363)),
    ([(770, 368), (880, 368)], GREEN, "SDA, SCL", (786, 363)),
    ([(520, 409), (620, 409)], GREEN, "INT", (530, 404)),
    ([(770, 409), (880, 409)], GREEN, "INT", (786, 404)),
    ([(520, 432), (620, 432)], GREEN, "MISO", (530, 427)),
    ([(770, 432), (820, 432), (820, 466), (880, 466)], GREEN, "MISO", (828, 461)),
    ([(520, 484), (620, 484)], GREEN, "NCS, MOSI, SCK", (522, 479)),
    ([(770, 490), (880, 490)], GREEN, "NCS, MOSI, SCK", (776, 485)),
    ([(520, 516), (600, 516), (600, 538), (620, 538)], RED, "5 V", (530, 511)),
    ([(600, 516), (600, 338), (860, 338), (860, 388), (880, 388)], RED, "5 V", (790, 333)),
    ([(600, 376), (620, 376)], RED, "", None),
    ([(600, 420), (620, 420)], RED, "", None),
    ([(770, 538), (850, 538), (850, 520), (880, 520)], RED, "3.3 V, also to shifter and 74LVC125", (700, 572)),
    ([(445, 530), (445, 585), (1085, 585), (1085, 400), (1070, 400)], BLACK, GROUND, (455, 600)),
    ([(1085, 500), (1070, 500)], BLACK, "", None),
    ([(690, 585), (690, 556)], BLACK, "", None),
]  # fmt: skip


def wiring() -> str:
    """Return the wiring diagram as SVG."""
    parts = ['<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1100 612" font-family="sans-serif" font-size="13">']
    parts.append('<rect width="1100" height="612" fill="#fff"/>')
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
