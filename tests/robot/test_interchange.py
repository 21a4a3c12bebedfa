"""Robots of other programs' files: what is read of a URDF, and how another robot is refused."""

import math
import re

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.robot import LEGS, load_robot
from wlr_gym.robot.interchange.recognition import recognise, robot_over, robot_text
from wlr_gym.robot.interchange.urdf import parse_urdf, urdf_text
from wlr_gym.robot.parameters import Parameters

LINK = """
<link name="{name}">
  <inertial><origin xyz="{com}" rpy="{rpy}"/><mass value="{mass}"/>
    <inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/></inertial>
  {shape}
</link>"""
JOINT = """
<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
  <origin xyz="{place}" rpy="{rpy}"/><axis xyz="{axis}"/>{more}</joint>"""


def link(name, mass, com="0 0 0", inertia=(0.01, 0.012, 0.015), rpy="0 0 0", shape=""):
    ixx, iyy, izz = inertia
    return LINK.format(name=name, mass=mass, com=com, rpy=rpy, ixx=ixx, iyy=iyy, izz=izz, shape=shape)


def joint(name, parent, child, place="0 0 0", rpy="0 0 0", axis="0 1 0", kind="continuous", more=""):
    return JOINT.format(name=name, kind=kind, parent=parent, child=child, place=place, rpy=rpy, axis=axis, more=more)


def cylinder(radius, length):
    origin = f'<origin xyz="0 0 0" rpy="{math.pi / 2} 0 0"/>'
    return f'<collision>{origin}<geometry><cylinder radius="{radius}" length="{length}"/></geometry></collision>'


#: Name, hip x, hip y: names and order of somebody else.
CORNERS = (("RR", -0.3, -0.2), ("FL", 0.3, 0.2), ("FR", 0.3, -0.2), ("RL", -0.3, 0.2))
LIMITS = '<limit lower="-1" upper="1.2" effort="20" velocity="10"/><dynamics damping="0.1" friction="0.2"/>'


def foreign(change=lambda text: text, **odd):
    """A URDF with a footprint on the floor, legs that hang down at angle 0, a bracket on each leg, and a camera.

    ``odd`` maps a part to what is different about it: ``leg_FL``, ``wheel_FL`` (arguments of link), ``hip_FL``, ``axle_FL``.
    """
    parts = [
        '<link name="base_footprint"/>',
        link(
            "base_link",
            10.0,
            com="0.01 0 0.02",
            inertia=(0.15, 0.42, 0.55),
            shape='<visual><geometry><box size="0.7 0.4 0.1"/></geometry></visual>',
        ),
        joint("footprint", "base_footprint", "base_link", place="0 0 0.4", kind="fixed"),
        '<link name="camera"/>',
        joint("camera_mount", "base_link", "camera", place="0.3 0 0.1", kind="fixed"),
    ]
    for name, x, y in CORNERS:
        leg = {"mass": 0.5, "com": "0 0 -0.1", "inertia": (0.004, 0.0045, 0.001)} | odd.get(f"leg_{name}", {})
        wheel = {"mass": 0.8, "inertia": (0.002, 0.003, 0.002), "shape": cylinder(0.08, 0.05)} | odd.get(f"wheel_{name}", {})
        hip = {"place": f"{x} {y} 0", "kind": "revolute", "more": LIMITS} | odd.get(f"hip_{name}", {})
        axle = {"place": "0 0 -0.1", "more": LIMITS} | odd.get(f"axle_{name}", {})
        parts += [
            link(f"leg_{name}", **leg),
            link(f"bracket_{name}", 0.1, com="0 0 -0.1", inertia=(1e-4, 1e-4, 1e-4)),
            link(f"tyre_{name}", **wheel),
            joint(f"hip_{name}", "base_link", f"leg_{name}", **hip),
            joint(f"bracket_mount_{name}", f"leg_{name}", f"bracket_{name}", place="0 0 -0.2", kind="fixed"),
            joint(f"axle_{name}", f"bracket_{name}", f"tyre_{name}", **axle),
        ]
    return change('<?xml version="1.0"?>\n<robot name="foreign">' + "".join(parts) + "</robot>")


def read(text, **options):
    return recognise(parse_urdf(text, "robot.urdf"), **options)


def test_numbers_of_a_foreign_urdf():
    found = read(foreign())
    numbers = found.numbers
    assert [one.name for one in found.joints] == [f"{kind}_{c}" for kind in ("hip", "axle") for c in ("FL", "FR", "RL", "RR")]
    assert [one.offset for one in found.joints] == pytest.approx([math.pi / 2] * 4 + [0.0] * 4)
    assert numbers["body"]["mass"] == 10.0
    assert numbers["body"]["size"] == [0.7, 0.4, 0.1]
    assert numbers["body"]["com_offset"] == pytest.approx([0.01, 0.0, 0.02])  # from the box's centre, not from the floor
    assert numbers["hip_position"] == {"x": 0.3, "y": 0.2, "z": 0.0}
    leg = numbers["leg"]
    assert (leg["length"], leg["mass"]) == (pytest.approx(0.3), pytest.approx(0.6))
    assert leg["com_along_leg"] == pytest.approx((0.5 * 0.1 + 0.1 * 0.3) / 0.6)
    across = 0.5 * 0.1 * 0.2**2 / 0.6  # reduced mass times distance squared
    assert leg["inertia"] == pytest.approx([0.0041 + across, 0.0046 + across, 0.0011])
    assert numbers["wheel"] == pytest.approx(
        {"radius": 0.08, "width": 0.05, "mass": 0.8, "spin_inertia": 0.003, "transverse_inertia": 0.002}
    )
    assert numbers["leg_limits"] == pytest.approx([math.pi / 2 - 1.0, math.pi / 2 + 1.2])
    assert numbers["servo"]["wheel"] == {
        "stall_torque": 20.0, "no_load_speed": 10.0, "coulomb_friction": 0.2, "viscous_friction": 0.1
    }  # fmt: skip
    assert "armature" not in numbers["servo"]["leg"]


def test_links_may_be_called_anything():
    """A file in which a macro's ``${prefix}`` was not filled in."""
    text = foreign()
    body = re.search(r'<link name="(\w+)"', text)
    assert body is not None
    named = text.replace(f'"{body[1]}"', f'"${{prefix}}{body[1]}"')
    assert read(named).numbers["body"] == read(text).numbers["body"]


def test_a_joint_that_turns_the_other_way_round():
    """Axis -y: the limits of the file, seen from the other side, and the sign."""
    one = {"axis": "0 -1 0", "more": LIMITS.replace('lower="-1" upper="1.2"', 'lower="-1.2" upper="1"')}
    found = read(foreign(hip_FL=one))
    assert [joint.sign for joint in found.joints[:4]] == [-1.0, 1.0, 1.0, 1.0]
    assert found.numbers["leg_limits"] == pytest.approx([math.pi / 2 - 1.0, math.pi / 2 + 1.2])
    assert not any("leg_limits" in note for note in found.notes)


def test_a_body_frame_that_is_not_in_the_middle_is_said():
    text = foreign(lambda text: re.sub(r'xyz="(-?0\.3) (-?0\.2) 0"', lambda m: f'xyz="{float(m[1]) + 0.1:g} {m[2]} 0"', text))
    found = read(text)
    assert found.numbers["hip_position"]["x"] == pytest.approx(0.3)
    assert found.numbers["body"]["com_offset"] == pytest.approx([-0.09, 0.0, 0.02])
    assert any(note.startswith("body origin: put at (0.1, 0, 0.4) m of link 'base_footprint'") for note in found.notes)


def test_unlike_legs_are_stated_one_by_one(tmp_path):
    """Whether little or much differs, and with --idealise too: a robot file has a place for each."""
    short = {"axle_FL": {"place": "0 0 0"}, "leg_FL": {"mass": 0.7}}
    for options in ({}, {"idealise": True}):
        found = read(foreign(**short), **options)
        assert found.numbers["leg"]["length"] == pytest.approx(0.275)
        single = found.numbers["individual"]
        assert [single[f"leg.length[{leg}]"] for leg in LEGS] == pytest.approx([0.2, 0.3, 0.3, 0.3])
        assert [single[f"leg.mass[{leg}]"] for leg in LEGS] == pytest.approx([0.8, 0.6, 0.6, 0.6])
        assert any("leg.length = 0.2, 0.3, 0.3, 0.3 m: one by one under 'individual'" in note for note in found.notes)
    path = tmp_path / "mine.yaml"
    path.write_text(robot_text("mine", "nominal", found.numbers))
    robot = load_robot(path)
    assert Parameters.nominal(robot)["leg.length"][0] == pytest.approx([0.2, 0.3, 0.3, 0.3])
    again = read(urdf_text(robot)).numbers
    assert again["individual"] == pytest.approx(single, rel=1e-12)


def test_what_no_robot_file_has_one_by_one_is_averaged_or_refused():
    wide = {"wheel_FL": {"shape": cylinder(0.08, 0.051)}}
    assert any("wheel.width = 0.051, 0.05, 0.05, 0.05 m: a robot file has one" in note for note in read(foreign(**wide)).notes)
    wider = {"wheel_FL": {"shape": cylinder(0.08, 0.07)}}
    with pytest.raises(InputError, match=r"robot.urdf: wheel.width = 0.07, 0.05, .* 28.6 % is too much .*--idealise"):
        read(foreign(**wider))
    assert read(foreign(**wider), idealise=True).numbers["wheel"]["width"] == pytest.approx(0.055)


MESH = '<collision><geometry><mesh filename="package://parts/wheel.stl"/></geometry></collision>'


def test_wheels_that_are_meshes_need_a_radius():
    meshes = {f"wheel_{name}": {"shape": MESH} for name, *_ in CORNERS}
    with pytest.raises(InputError, match="no sphere: give its radius, such as --set wheel"):
        read(foreign(**meshes))
    assert read(foreign(**meshes), given={"wheel.radius": 0.09}).numbers["wheel"]["radius"] == 0.09
    single = {"wheel_FL": {"shape": cylinder(0.07, 0.05)}}
    given = read(foreign(**single), given={"wheel.radius": 0.09}).numbers
    assert (given["wheel"]["radius"], given.get("individual")) == (0.09, None)


def test_joints_that_move_freely_or_not_at_all_need_no_axis():
    """As CAD exporters write them: axis 0 0 0 of fixed joints, a world above the body."""
    text = foreign(
        lambda text: text.replace('xyz="0.3 0 0.1" rpy="0 0 0"/><axis xyz="0 1 0"/>', 'xyz="0.3 0 0.1"/><axis xyz="0 0 0"/>')
    )
    assert text.count('axis xyz="0 0 0"') == 1
    assert read(text).numbers == read(foreign()).numbers
    world = with_part(
        '<link name="world"/><joint name="free" type="floating"><parent link="world"/><child link="base_footprint"/></joint>'
    )
    assert read(foreign(world)).numbers == read(foreign()).numbers
    with pytest.raises(InputError, match="joint 'hip_FL' is a free"):
        read(foreign(hip_FL={"kind": "floating"}))


def test_what_no_robot_file_holds_is_said_with_its_number():
    everywhere = {f"leg_{name}": {"com": "0.005 0 -0.1"} for name, *_ in CORNERS}
    found = read(foreign(**everywhere))
    assert sum("centre of mass off the line hip to wheel = 0.004167 m" in note for note in found.notes) == 4
    far = {f"leg_{name}": {"com": "0.05 0 -0.1"} for name, *_ in CORNERS}
    with pytest.raises(InputError, match=r"leg 'leg_FL': centre of mass off the line hip to wheel = .* no number for it"):
        read(foreign(**far))


def without(name):
    """Take a link and its joint out."""

    def change(text):
        text = re.sub(rf'\n<link name="{name}">.*?</link>', "", text, flags=re.S)
        return re.sub(rf'\n<joint [^>]*><parent link="[^"]*"/><child link="{name}"/>.*?</joint>', "", text, flags=re.S)

    return change


def with_part(*parts):
    return lambda text: text.replace("</robot>", "".join(parts) + "</robot>")


ARM = (link("arm", 1.0), joint("shoulder", "base_link", "arm", place="0 0 0.1", axis="0 0 1"))
KNEE = (link("toe", 0.1), joint("knee_FL", "tyre_FL", "toe", place="0 0 -0.1"))
TWIN = (link("second", 0.1), joint("axle_2", "leg_FL", "second", place="0 0 -0.1"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (foreign(with_part(*ARM)), r"5 joints on body 'base_footprint' \(.*'shoulder'\), 9 in all: expected four legs"),
        (foreign(with_part(*KNEE)), "leg 'hip_FL' has more than one hinge: 'knee_FL' follows 'axle_FL'"),
        (foreign(with_part(*TWIN)), r"link 'leg_FL' carries 2 joints \('axle_FL', 'axle_2'\): expected one wheel"),
        (foreign(without("tyre_RL")), "link 'leg_RL' of joint 'hip_RL' carries no wheel"),
        (foreign(hip_FR={"axis": "1 0 0"}), r"joint 'hip_FR' turns about \(1, 0, 0\) of the body: expected its y axis"),
        (foreign(axle_RR={"axis": "0 0 1"}), r"joint 'axle_RR' turns about \(0, 0, 1\)"),
        (foreign(hip_FL={"kind": "prismatic"}), "joint 'hip_FL' is a slide: expected four legs of one hinge"),
        (foreign(hip_FL={"kind": "planar"}), "joint 'hip_FL': type 'planar': expected one of fixed, revolute"),
        (foreign(axle_FL={"more": '<mimic joint="axle_FR"/>'}), "joint 'axle_FL': mimics another joint"),
        (foreign(hip_FL={"place": "-0.25 0.2 0"}), "joints 'hip_FL' and 'hip_RL' are both at the left rear"),
        (foreign(hip_FL={"place": "0.4 0.2 0"}), r"hip_position.x = 0.375, .* m: a robot file has one for all four"),
        (foreign(axle_FL={"place": "0 0 0.2"}), r"leg 'hip_FL': its wheel 'axle_FL' turns about the hip: length = 0 m"),
        (foreign(wheel_FL={"mass": 0.0}), "link 'tyre_FL': mass = 0 kg: expected more than 0"),
        (foreign(wheel_FL={"mass": "heavy"}), "link 'tyre_FL': mass: value = 'heavy': expected 1 numbers"),
        (foreign(wheel_FL={"shape": ""}), "wheel 'tyre_FL' has no cylinder about its axle and no sphere: give its radius"),
        (foreign(wheel_FL={"inertia": (0.002, 0.0, 0.002)}), "link 'tyre_FL': iyy = 0 kg m2: expected more than 0"),
        (foreign(lambda t: t.replace('"hip_FL"', '"hip_FR"')), "two joints are called 'hip_FR'"),
        (foreign(lambda t: t.replace('<link name="tyre_FL"', '<link name="tyre_FR"')), "two links are called 'tyre_FR'"),
        (foreign(hip_FL={"more": '<limit lower="1" upper="-1"/>'}), "'hip_FL': limit: lower = 1 is above upper = -1 rad"),
        (foreign(axle_FL={"axis": "0 0 0"}), "joint 'axle_FL': axis = .* expected a direction"),
        (foreign(lambda t: t.replace('<parent link="leg_FL"/>', '<parent link="leg_F"/>')), "its parent 'leg_F' is no link"),
        (foreign(with_part(link("loose", 1.0))), "expected one link that is no joint's child, found 2: base_footprint, loose"),
        (foreign(lambda t: t.replace("</robot>", "")), "broken XML"),
        (foreign(lambda t: t.replace('name="foreign">', 'xmlns:xacro="x"><xacro:leg/>')), "xacro"),
        ("<sdf/>", "expected a URDF, with <robot> at its top, found <sdf>"),
    ],
)  # fmt: skip
def test_other_robots_are_refused_by_what_differs(text, message):
    with pytest.raises(InputError, match=message):
        read(text)


def test_rotor_inertia_travels_as_drake_reads_it():
    text = urdf_text(load_robot())
    assert '<drake:rotor_inertia value="0.01" />' in text
    doubled = text.replace('<drake:gear_ratio value="1" />', '<drake:gear_ratio value="2" />')
    assert read(doubled).numbers["servo"]["leg"]["armature"] == pytest.approx(0.04)


def test_a_written_file_is_the_robot_that_was_read(tmp_path):
    found = read(foreign())
    path = tmp_path / "mine.yaml"
    path.write_text(robot_text("mine", "nominal", found.numbers, comments={"body.mass": "without legs"}))
    robot = load_robot(path)
    assert robot == robot_over("nominal", "mine", found.numbers, path)
    assert robot.leg.length == found.numbers["leg"]["length"]
    assert robot.servo.leg.kp == load_robot().servo.leg.kp
    assert robot.servo.wheel.armature == load_robot().servo.wheel.armature
    assert "mass: 10.0" in path.read_text()
    assert "# without legs" in path.read_text()


def test_a_rotated_inertia_is_turned_into_the_links_axes():
    turned = foreign(leg_FL={"inertia": (0.0045, 0.004, 0.001), "rpy": f"0 0 {math.pi / 2}"})
    assert np.allclose(read(turned).numbers["leg"]["inertia"], read(foreign()).numbers["leg"]["inertia"], rtol=1e-12)
