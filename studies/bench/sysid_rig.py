"""The calibration of the test rig, ours and that of ``mujoco.sysid``: one servo that swings a pendulum.

Both get the same simulated recordings, move the same seven numbers within the same bounds from the same start, and minimise the
same sum: squared residuals of the angle over whole runs in units of encoder noise, plus squared distances from nominal in
tolerances. The recordings are of neither side's simulation: the law of the rig at a twentieth of the step that both fit with.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

import copy
from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from studies.bench.sysid_contest import Contest, PeerProblem, PeerRun, contest_between
from wlr_gym.base.random import generator
from wlr_gym.gap.problem import Setting
from wlr_gym.gap.rig import pendulum
from wlr_gym.gap.rig.pendulum import (
    DATA_SHEET_VOLTAGE,
    ENCODER_NOISE,
    GRAVITY,
    QUANTITIES,
    STEP,
    PendulumProblem,
    Replay,
    RigModel,
    model_of,
    pack,
)
from wlr_gym.gap.rig.pendulum_recordings import DUTY_PER_GAIN, Recording
from wlr_gym.physics import servo

Array = NDArray[np.float64]

#: Not fitted: behind one voltage, no run tells back-EMF from viscous friction; a delay is not a parameter of a MuJoCo model.
KNOWN = ("no_load_speed", "delay")
_FREE = np.array([quantity.name not in KNOWN for quantity in QUANTITIES])
_NOMINAL = np.array([quantity.nominal for quantity in QUANTITIES])
#: Substeps of the recordings' simulation in one step of the fits.
FINE = 20
#: Steps between two rows.
ROW = 5
#: Load (kg), distance from the axis (m) and P gain register of each run.
RUNS = ((0.1, 0.15, 200.0), (0.2, 0.1, 400.0), (0.1, 0.1, 800.0), (0.3, 0.1, 300.0))
#: V.
SUPPLY = 5.0


class WholeRuns(PendulumProblem):
    """The rig's problem with the numbers that both sides can fit, and one signal: the angle over whole runs."""

    def __init__(self, recordings: Sequence[Recording]) -> None:
        super().__init__(recordings)
        self.quantities = tuple(quantity for quantity, free in zip(QUANTITIES, _FREE, strict=True) if free)
        self.signals, self.windows = self.signals[:1], self.windows[:1]
        for replay in self.replays:  # every run starts at rest where the encoder reads 0, and both sides are told
            replay.angle[0] = replay.rate[0] = 0.0

    def model(self, setting: Setting) -> RigModel:
        """Return the model of a setting, with the numbers that are not fitted."""
        return model_of(Setting(all_numbers(setting.quantities)), QUANTITIES)


def all_numbers(free: Array) -> Array:
    """Return the rig's numbers (9,) with those that are fitted put in."""
    numbers = _NOMINAL.copy()
    numbers[_FREE] = free
    return numbers


def true_numbers(rng: np.random.Generator) -> Array:
    """Draw what is behind the recordings: within 0.6 tolerances of nominal, off every bound."""
    free = [quantity for quantity, is_free in zip(QUANTITIES, _FREE, strict=True) if is_free]
    return np.array([q.nominal + 0.6 * q.sigma * rng.uniform(-1.0, 1.0) for q in free])


def rig_contest(seconds: float) -> Contest:
    """Return the contest over recordings of this length (s)."""
    problem, truth = make_rig(seconds)
    return contest_between(f"pendulum, {len(RUNS)} runs of {seconds:g} s", problem, truth, peer_of(problem))


def make_rig(seconds: float) -> tuple[WholeRuns, Array]:
    """Return the problem of recordings of this length (s), and the numbers (7,) behind them."""
    rng = generator(0, "bench", "sysid")
    truth = true_numbers(rng)
    return WholeRuns([_recorded(k, seconds, truth, rng) for k in range(len(RUNS))]), truth


def peer_of(problem: WholeRuns) -> PeerProblem:
    """Return the same problem for ``mujoco.sysid``."""
    return PeerProblem(problem.quantities, [_peer_run(replay) for replay in problem.replays])  # the same setpoints and starts


def _peer_run(replay: Replay) -> PeerRun:
    recording, model = replay.recording, _pendulum()
    delay = round(_NOMINAL[[q.name for q in QUANTITIES].index("delay")] / STEP)
    setpoints = replay.goals[np.maximum(np.arange(len(replay.goals)) - delay, 0)]
    at_rows = (np.arange(1, len(recording.t)) * ROW) - 1

    def build(values: Array) -> mujoco.MjModel:
        return _with_numbers(copy.copy(model), recording, values)

    def residual(values: Array, state: Array) -> Array:
        return (recording.angle[1:] - state[at_rows, 1]) / ENCODER_NOISE

    start = np.array([0.0, replay.angle[0], replay.rate[0]])
    times = recording.t[0] + STEP * np.arange(len(setpoints) + 1)
    control = np.append(setpoints, setpoints[-1:])[:, None]
    return PeerRun(model, build, times, control, start, residual)


def _pendulum() -> mujoco.MjModel:
    """The pendulum: one hinge whose position is the encoder's reading, and the servo's voltage law as a limited actuator."""
    spec = mujoco.MjSpec()
    spec.option.timestep = STEP
    spec.option.gravity = 0.0, 0.0, -GRAVITY
    link = spec.worldbody.add_body(name="link", explicitinertial=True, mass=1.0, inertia=[1e-3, 1e-3, 1e-3], ipos=[0, 0, -0.1])
    link.add_joint(
        name="servo",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=[0, 1, 0],
        damping=[1.0, 0.0, 0.0],
        frictionloss=0.1,
        armature=1e-3,
        solref_friction=[2.0 * STEP, 1.0],  # as stiff as the step allows: MuJoCo's friction creeps
    )
    spec.add_actuator(
        name="servo",
        target="servo",
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        forcerange=[-1.0, 1.0],
    )
    return spec.compile()


def _with_numbers(model: mujoco.MjModel, recording: Recording, values: Array) -> mujoco.MjModel:
    """Write the rig's numbers into a model: fields, not a new compilation, which would cost the peer more."""
    numbers = dict(zip((q.name for q in QUANTITIES), all_numbers(values), strict=True))
    constant, resistance = servo.motor_constants(numbers["stall_torque"], numbers["no_load_speed"], DATA_SHEET_VOLTAGE)
    length, arm = recording.length + numbers["length_error"], numbers["arm_mass"]
    mass = recording.mass + arm
    centre = length * (recording.mass + arm / 2.0) / mass
    model.body_mass[1] = mass
    # a reading of zero is a link that hangs at minus the encoder's zero
    model.body_ipos[1] = centre * np.sin(numbers["zero"]), 0.0, -centre * np.cos(numbers["zero"])
    model.body_inertia[1] = (recording.mass + arm / 3.0) * length**2 - mass * centre**2
    model.dof_armature[0] = numbers["armature"]
    model.dof_damping[0] = numbers["viscous_friction"] + constant**2 / resistance
    model.dof_frictionloss[0] = numbers["coulomb_friction"]
    limit = SUPPLY * constant / resistance
    gain = limit * recording.gain * DUTY_PER_GAIN
    model.actuator_gainprm[0, 0], model.actuator_biasprm[0, 1] = gain, -gain
    model.actuator_forcerange[0] = -limit, limit
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _recorded(run: int, seconds: float, truth: Array, rng: np.random.Generator) -> Recording:
    """Simulate a run with fine steps and read it with a noisy encoder."""
    mass, length, gain = RUNS[run]
    rows = round(seconds / (ROW * STEP)) + 1
    time: Array = ROW * STEP * np.arange(rows, dtype=np.float64)
    goal = sum(
        a * np.sin(2 * np.pi * (f * time + p))
        for a, f, p in zip((0.8, 0.4, 0.2), rng.uniform(0.3, 2.0, 3), rng.random(3), strict=True)
    )
    zeros, ones = np.zeros(rows), np.ones(rows)
    empty = Recording(
        f"run{run}", "sines", mass, length, None, gain, SUPPLY, time, zeros, zeros, zeros, zeros, SUPPLY * ones, 25.0 * ones,
        np.asarray(goal), ones > 0.0,
    )  # fmt: skip
    setpoints = np.repeat(Replay(empty)._goals, FINE)
    step = STEP / FINE
    inputs = np.tile([SUPPLY, 1.0, 0.0], (len(setpoints), 1))
    starts = np.full(len(setpoints), -1)
    starts[0] = 0
    model = model_of(Setting(all_numbers(truth)), QUANTITIES)
    lag = np.array([model.numbers["delay"]]) / step
    found = pendulum.simulate(pack([model], empty, step), lag, setpoints, inputs, starts, np.zeros((1, 2)), step)[0]
    angle = found[:: FINE * ROW, 0][:rows] + model.numbers["zero"]
    noisy = angle + np.sqrt(1.0 - 1.0 / 12.0) * ENCODER_NOISE * rng.standard_normal(rows)
    counted = ENCODER_NOISE * np.round(noisy / ENCODER_NOISE)
    return Recording(**{**vars(empty), "angle": counted})
