"""Body and legs on the floor: against MuJoCo's own box and capsules, statics, friction at rest and in motion, energy, bits."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from energy import mechanical_energy
from rig import BACKENDS, ROBOT, WEIGHT, G, drive, lock, make_plant
from scipy.spatial.transform import Rotation

from wlr_gym.base.errors import InputError
from wlr_gym.physics import plants
from wlr_gym.physics.plants import body
from wlr_gym.physics.plants.base import TRUTH_LAYOUT, PlantOptions, Truth, standing_state
from wlr_gym.physics.plants.body import spots_at
from wlr_gym.robot import CORNER_SIGNS, SHANK_RADIUS
from wlr_gym.robot.parameters import Parameters

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)

BELLY = 0.5 * ROBOT.body.size[2]
#: Legs that point up: wheels are off the floor, and the robot lies on its belly.
UP = np.array([-0.6] * 4 + [0.0] * 4)
SPRING = float(Parameters.nominal(ROBOT)["body.normal_stiffness"][0])
KERB = 0.1
SIDES = np.array([1.0, -1.0])


def _lying(count, edit=None, backend="gibbs_appell", height: Any = BELLY, speed=None, attitude=None, **options):
    """Return robots with their legs up whose belly is at a height."""

    def place(state):
        state.position[:, 2] = height
        state.joint_position[:, :4] = state.reference_position[:, :4] = UP[:4]
        if attitude is not None:
            state.quaternion[:] = attitude
        if speed is not None:
            state.linear_velocity_in_body[:] = speed

    return make_plant(count, edit, place, backend=backend, **options)


# ---- where they touch: MuJoCo's own geoms as the second opinion ------------------------------------------------------


def _bare_model(height):
    """A box with a capsule for every leg, a plane, and a box for a kerb that begins at x = 0."""
    spec, kinds = mujoco.MjSpec(), mujoco.mjtGeom
    spec.compiler.degree = False
    robot = spec.worldbody.add_body(name="robot")
    robot.add_freejoint()
    robot.add_geom(name="box", type=kinds.mjGEOM_BOX, size=np.array(ROBOT.body.size) / 2)
    for i, (x, y) in enumerate(CORNER_SIGNS):
        leg = robot.add_body(name=f"leg{i}", pos=[ROBOT.hip_position.x * x, ROBOT.hip_position.y * y, ROBOT.hip_position.z])
        leg.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
        rod = [0, 0, 0, ROBOT.leg.length, 0, 0]
        leg.add_geom(name=f"leg{i}", type=kinds.mjGEOM_CAPSULE, fromto=rod, size=[SHANK_RADIUS, 0, 0])
    spec.worldbody.add_geom(name="floor", type=kinds.mjGEOM_PLANE, size=[9, 9, 1])
    spec.worldbody.add_geom(name="kerb", type=kinds.mjGEOM_BOX, size=[2, 5, height / 2], pos=[2, 0, height / 2])
    return spec.compile()


def _sharp_kerb(count, height=KERB):
    parameters = Parameters.nominal(ROBOT, count)
    parameters["piece.height[piece_1]"], parameters["piece.edge_radius[piece_1]"] = height, 1e-4
    return parameters


def _poses(seed, count, tilt):
    rng = np.random.default_rng(seed)
    angles = np.stack([rng.uniform(-np.pi, np.pi, count), *rng.uniform(-tilt, tilt, (2, count))], axis=1)
    return rng, angles, Rotation.from_euler("ZYX", angles).as_quat(scalar_first=True)


def _depths(parameters, position, quaternion, legs):
    """Depths (N, 20) of body and shanks."""
    truth = Truth(np.zeros((len(position), TRUTH_LAYOUT.width)))
    truth.position[:], truth.quaternion[:], truth.joint_position[:, :4] = position, quaternion, legs
    return spots_at(ROBOT, parameters, truth, np.zeros((len(position), len(body.SPOTS), 3))).depth


def _distance(model, data, names, obstacles):
    """Least distance of geoms from obstacles (m), and where on the geom it is."""
    best, where = np.inf, np.zeros(3)
    for name in names:
        for obstacle in obstacles:
            segment = np.zeros(6)
            found = mujoco.mj_geomDistance(model, data, model.geom(name).id, model.geom(obstacle).id, 1.0, segment)
            if found < best:
                best, where = found, segment[:3].copy()
    return best, where


def _drop_until(model, data, names, obstacles, pose, legs, depth=0.0):
    """Lower a robot until a geom is ``depth`` deep in an obstacle; return its height, and where it touches."""
    low, high, where = -0.2, 0.8, None
    data.qpos[:], data.qpos[7:] = 0.0, legs
    data.qpos[:7] = pose
    for _ in range(40):
        data.qpos[2] = 0.5 * (low + high)
        mujoco.mj_kinematics(model, data)
        found, where = _distance(model, data, names, obstacles)
        low, high = (low, data.qpos[2]) if found > -depth else (data.qpos[2], high)
    return high, where


def test_the_body_touches_first_where_mujocos_box_does():
    """Lowered at any heading and tilt on to the floor and a kerb's edge: 0.1 mm earlier nothing, 0.3 mm deeper something."""
    count = 60
    rng, _, quaternion = _poses(0, count, 0.4)
    position = np.stack([rng.uniform(-0.3, 0.3, count), np.zeros(count), np.zeros(count)], axis=1)
    model, legs = _bare_model(KERB), np.full(4, -1.5)
    data = mujoco.MjData(model)
    for row in range(count):
        pose = np.concatenate([position[row], quaternion[row]])
        position[row, 2], _ = _drop_until(model, data, ["box"], ["floor", "kerb"], pose, legs)
    parameters, legs = _sharp_kerb(count), np.tile(legs, (count, 1))
    above, below = (_depths(parameters, position + np.array([0, 0, rise]), quaternion, legs) for rise in (1e-4, -5e-4))
    assert np.isneginf(above).all()
    assert np.isfinite(below[:, :8]).any(axis=1).sum() > count / 2
    assert np.isfinite(below[:, 12:]).any(axis=1).sum() > 5
    assert (np.isfinite(below).any(axis=1)).all()
    assert below.max() < 6e-4


def test_a_shank_touches_a_kerb_where_mujocos_capsule_does():
    """The left front one, lowered on to the edge somewhere between hip and wheel."""
    count = 60
    rng, _, quaternion = _poses(1, count, 0.2)
    legs = rng.uniform(0.3, 2.8, (count, 4))
    along = np.stack([np.cos(legs[:, 0]), np.zeros(count), -np.sin(legs[:, 0])], axis=1)
    crossing = np.array([ROBOT.hip_position.x, ROBOT.hip_position.y, 0.0])
    crossing = crossing + rng.uniform(0.2, 0.8, (count, 1)) * ROBOT.leg.length * along
    position = -Rotation.from_quat(quaternion, scalar_first=True).apply(crossing) * [1.0, 0.0, 0.0]
    model = _bare_model(KERB)
    data, is_between = mujoco.MjData(model), np.zeros(count, bool)
    for row in range(count):
        pose = np.concatenate([position[row], quaternion[row]])
        position[row, 2], where = _drop_until(model, data, ["leg0"], ["kerb"], pose, legs[row])
        leg = model.body("leg0").id
        share = data.xmat[leg].reshape(3, 3)[:, 0] @ (where - data.xpos[leg]) / ROBOT.leg.length
        is_between[row] = 0.02 < share < 0.98  # at its end is the wheel
    parameters = _sharp_kerb(count)
    above, below = (_depths(parameters, position + np.array([0, 0, rise]), quaternion, legs)[:, 8] for rise in (2e-4, -5e-4))
    assert is_between.sum() > count / 3
    assert np.isneginf(above[is_between]).all()
    assert (below[is_between] > 0.0).all()
    assert below[is_between].max() < 6e-4


def test_what_touches_a_kerb_between_the_axles():
    """Front wheels on it, rear wheels before it, legs 115 mm behind: shanks from 60 mm on, the body's rear from 110 mm on."""
    for height, shanks, rear in ((0.05, False, False), (0.06, True, False), (0.1, True, False), (0.11, True, True)):
        count, leg, radius = 400, np.arccos(-0.115 / ROBOT.leg.length), ROBOT.wheel.radius
        turn = Rotation.from_euler("y", -np.arcsin(height / (2 * ROBOT.hip_position.x)))
        front, back = (
            turn.apply([x + ROBOT.leg.length * np.cos(leg), 0, -ROBOT.leg.length * np.sin(leg)])
            for x in ROBOT.hip_position.x * SIDES
        )
        x = np.linspace(-front[0], -radius - back[0], count)
        position = np.stack([x, 0 * x, np.full(count, radius - back[2])], axis=1)
        quaternion = np.tile(turn.as_quat(scalar_first=True), (count, 1))
        depths = np.isfinite(_depths(_sharp_kerb(count, height), position, quaternion, np.full((count, 4), leg)))
        assert depths[:, 8:12].any() == shanks
        assert depths[:, [2, 3]].any() == rear
        assert not depths[:, [0, 1]].any()


# ---- at rest ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_robot_that_is_dropped_lies_on_its_belly(backend):
    """It sinks by its weight over four springs, and the forces that are told add up to its weight."""
    plant = _lying(3, backend=backend, height=BELLY + np.array([0.0, 0.02, 0.05]))
    truth, found = drive(plant, 2.0, UP), plant.contacts()
    assert truth.position[:, 2] == pytest.approx(BELLY - WEIGHT / (4 * SPRING), abs=2e-6)
    assert truth.body_clearance.min() > -1e-3
    assert np.abs(truth.linear_velocity_in_body).max() < 1e-6
    force = np.einsum("nci,ncij->nj", found.force, np.stack([found.heading, found.lateral, found.normal], axis=2))
    assert force == pytest.approx(np.tile([0.0, 0.0, WEIGHT], (3, 1)), abs=1e-3 * WEIGHT)
    assert np.isfinite(found.depth[:, 8:12]).all()
    assert found.point[:, 8:12, 2].mean(axis=1) == pytest.approx(-WEIGHT / (4 * SPRING), abs=2e-6)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("heading", [0.0, 0.7])
def test_parked_on_its_belly_on_a_slope_it_stays(backend, heading):
    """20 degrees at friction 0.6: less than a micrometre in 10 s."""
    attitude = Rotation.from_euler("z", heading).as_quat(scalar_first=True)
    plant = _lying(1, {"ground.slope[pitch]": np.radians(20.0)}, backend, attitude=attitude)
    before = drive(plant, 2.0, UP).position
    after = drive(plant, 10.0, UP).position
    assert np.abs(after - before).max() < 1e-6


@pytest.mark.parametrize("backend", BACKENDS)
def test_it_slides_down_a_slope_that_is_steeper_than_its_friction(backend):
    slope, mu = np.radians([25.0, 35.0]), np.array([0.4, 0.6])

    def edit(parameters):
        lock(parameters)
        parameters["ground.slope[pitch]"], parameters["body.mu"] = slope, mu

    plant = _lying(2, edit, backend, height=BELLY - 2e-4)
    start = drive(plant, 1.0, UP).linear_velocity_in_body[:, 0]
    end = drive(plant, 1.0, UP).linear_velocity_in_body[:, 0]
    assert end - start == pytest.approx(-G * (np.sin(slope) - mu * np.cos(slope)), rel=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_it_lies_over_a_kerbs_edge(backend):
    """Its belly across the edge of a kerb, its centre of mass over the top: corners and edge carry the weight, and it rests."""

    def edit(parameters):
        lock(parameters)
        parameters["piece.height[piece_1]"], parameters["piece.x[piece_1]"] = KERB, -0.05

    plant = _lying(1, edit, backend, height=KERB + BELLY, attitude=[1.0, 0.0, 0.0, 0.0])
    truth, found = drive(plant, 2.0, UP), plant.contacts()
    force = np.einsum("nci,ncij->nj", found.force, np.stack([found.heading, found.lateral, found.normal], axis=2))
    assert force == pytest.approx(np.array([[0.0, 0.0, WEIGHT]]), abs=1e-3 * WEIGHT)
    assert (found.force[0, [20, 21], 2] > 0.1 * WEIGHT).all()  # both sides of the underside, on the edge
    assert found.point[0, [20, 21], 0] == pytest.approx(-0.05, abs=4e-3)
    assert truth.position[0, 2] == pytest.approx(KERB + BELLY, abs=5e-4)


# ---- in motion -------------------------------------------------------------------------------------------------------


def test_a_bouncing_fall_never_gains_energy():
    """Springs keep what they take: between bounces the mechanical energy only falls."""
    count = 12
    rng, _, quaternion = _poses(2, count, 1.5)

    def edit(parameters):
        lock(parameters)
        parameters["body.normal_damping"], parameters["body.mu"] = rng.uniform(0, 30, count), rng.uniform(0, 0.8, count)

    plant = _lying(count, edit, height=0.35, attitude=quaternion, period=0.005)
    energy, in_air = [], []
    for _ in range(200):
        plant.step(np.tile(UP, (count, 1)))
        energy.append(mechanical_energy(plant.parameters, plant.truth()))
        depth = plant.contacts().depth
        in_air.append(np.isneginf(depth[:, 8:]).all(axis=1) & (depth[:, :4] < 0).all(axis=1))
    energy, in_air = np.array(energy), np.array(in_air)
    flying = np.where(in_air, energy, np.inf)
    gained = np.where(in_air, energy - np.minimum.accumulate(flying, axis=0), 0.0)
    assert in_air[80:].any()
    assert gained.max() < 2e-3 * energy[0].max()


@pytest.mark.slow
def test_robots_dropped_on_a_plank_gain_no_energy():
    """In any attitude, with undamped tyres: corners and edges hand over without a kick."""
    count, rng = 32, np.random.default_rng(0)
    attitude = Rotation.from_quat(np.random.RandomState(0).normal(size=(count, 4))).as_quat(scalar_first=True)
    legs = rng.uniform(-3.1, 3.1, (count, 4))

    def edit(parameters):
        lock(parameters)
        plank = {"height": 0.08, "x": -0.03, "length": 0.06}
        for name, value in plank.items():
            parameters[f"piece.{name}[piece_1]"] = value
        parameters["ground.normal_damping"] = 0.0

    def place(state):
        state.position[:, 2], state.position[:, 0] = 0.45, rng.uniform(-0.1, 0.1, count)
        state.quaternion[:], state.angular_velocity_in_body[:] = attitude, rng.uniform(-3.0, 3.0, (count, 3))
        state.joint_position[:, :4] = state.reference_position[:, :4] = legs

    plant = make_plant(count, edit, place, period=0.001)
    setpoints, energy = np.concatenate([legs, np.zeros((count, 4))], axis=1), []
    for _ in range(1000):
        plant.step(setpoints)
        energy.append(mechanical_energy(plant.parameters, plant.truth()))
    assert (np.max(energy, axis=0) < 1.001 * energy[0]).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_start_inside_the_floor_is_refused(backend):
    with pytest.raises(
        InputError, match=r"state: the body or a leg of robot 1 is 0.02\d* m deep in the floor: expected at most"
    ):
        _lying(2, backend=backend, height=[BELLY, BELLY - 0.02])
    kerb = {"piece.height[piece_1]": KERB, "piece.x[piece_1]": 0.1}
    with pytest.raises(InputError, match=r"robot 0 is 0.0\d+ m deep in the floor"):
        _lying(1, kerb, backend=backend, height=BELLY + 0.04)


@pytest.mark.parametrize("floor", ["plane", "kerb"])
def test_both_simulators_agree(floor):
    """Robots that tumble on to their belly, slide and come to rest: within 1 mm, against a kerb 3 mm."""
    count = 4
    _, angles, _ = _poses(3, count, 0.3)
    quaternion = Rotation.from_euler("ZYX", angles * [0.1, 1.0, 1.0]).as_quat(scalar_first=True)

    def edit(parameters):
        lock(parameters)
        if floor == "kerb":
            parameters["piece.height[piece_1]"], parameters["piece.x[piece_1]"] = 0.06, 0.25

    ours, theirs = (
        drive(_lying(count, edit, backend, height=0.2, speed=[0.4, 0.1, 0.0], attitude=quaternion), 0.5, UP)
        for backend in BACKENDS
    )
    assert ours.position == pytest.approx(theirs.position, abs=1e-3 if floor == "plane" else 3e-3)


# ---- bits ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("backend", "precision"),
    [("gibbs_appell", "float64"), pytest.param("gibbs_appell", "float32", marks=pytest.mark.slow), ("mujoco", "float64")],
)
def test_bits_depend_on_no_neighbour_thread_or_place_in_the_batch(backend, precision):
    """Robots that lie, fall and drive beside each other; on a plane, on waves, at a kerb."""
    count = 37

    def run(rows, threads=1):
        rows = np.asarray(rows)
        parameters, rng = Parameters.nominal(ROBOT, count), np.random.default_rng(4)
        parameters["wave.height[wave_1]"] = 0.01 * (np.arange(count) % 3 == 1)
        parameters["piece.height[piece_1]"] = 0.05 * (np.arange(count) % 3 == 2)
        parameters["piece.x"] = 0.3
        parameters = Parameters(parameters.values[rows])
        state = standing_state(ROBOT, parameters)
        state.position[:, 2] += rng.uniform(-0.03, 0.1, count)[rows]
        state.joint_position[:, :4] = state.reference_position[:, :4] = rng.uniform(-0.5, 2.0, (count, 4))[rows]
        plant: Any = plants.make_plant(backend, ROBOT, len(rows), PlantOptions(precision=precision, threads=threads))
        plant.reset(rows.astype(np.uint64), parameters, state=state)
        for draw in rng.uniform(-1.0, 1.0, (30, count, 8))[:, rows]:
            plant.step(np.array([0.5] * 4 + [6.0] * 4) + draw)
        values, state = plant.truth().values.copy(), plant.get_state()
        plant.step(np.tile(UP, (len(rows), 1)))
        further = plant.truth().values.copy()
        plant.set_state(state)  # what bristles hold is part of the state
        plant.step(np.tile(UP, (len(rows), 1)))
        assert np.array_equal(plant.truth().values, further)
        return values, (np.isfinite(plant.contacts().depth[:, 8:])).any(axis=1)

    together, touching = run(range(count))
    assert np.isfinite(together).all()
    assert 5 < touching.sum() < 32
    assert np.array_equal(run(range(count), threads=2)[0], together)
    assert np.array_equal(run(range(count)[::-1])[0][::-1], together)
    for alone in (2, 5) if precision == "float32" else (2, 5, 8):
        assert np.array_equal(run([alone])[0][0], together[alone])
