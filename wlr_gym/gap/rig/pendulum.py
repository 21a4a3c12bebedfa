"""One servo that swings a pendulum as a rig of the gap workflow: its effects, its law, its model, its problem.

The law is the simulators' drive law (:mod:`wlr_gym.physics.plants.drive`) on one joint with one link. Gear, motor and friction
are :func:`wlr_gym.physics.plants.drive.push` itself, so an effect found on the rig is the effect of the library. Laws of the
rig alone (torque that falls behind the current, a torque limit, friction quadratic in load, a warm winding) act through the
strength of the motor and the ratio of load-dependent friction that the drive law reads.

Servo: XL330-M288-T by its data sheet (ROBOTIS e-manual: stall torque 0.52 N m, no load 103 rev/min, both at 5 V). That its gear
has dry and viscous friction is known; how much is fitted. Its recordings: :mod:`wlr_gym.gap.rig.pendulum_recordings`.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, check_name
from wlr_gym.base.random import generator
from wlr_gym.gap.analysis import IntakeFinding, few_runs
from wlr_gym.gap.problem import MeasuredSignal, Quantity, Setting, Unknown, since_reversal
from wlr_gym.gap.rig.pendulum_recordings import DUTY_PER_GAIN, Recording, findings, read_recordings
from wlr_gym.gap.rig.problem import RigLaw, RigProblem, smoothed_state
from wlr_gym.gap.validation.data_split import HELD_OUT_SHARE
from wlr_gym.physics import servo
from wlr_gym.physics.codegen import Graph, emit, load_module, ops
from wlr_gym.physics.effects import EFFECTS, EffectParameter, Patch, PatchEffect
from wlr_gym.physics.effects.effect import Change, Guess, one_step
from wlr_gym.physics.plants import drive

Array = NDArray[np.float64]
Numbers = dict[str, float]
Value = Any
Lanes = Mapping[str, Value]

#: The rig's one joint, where its effects act.
JOINT = "servo"
#: Data sheet: N m at stall.
STALL_TORQUE = 0.52
#: Data sheet: rad/s without load.
NO_LOAD_SPEED = 103 * 2 * math.pi / 60
#: V, of both.
DATA_SHEET_VOLTAGE = 5.0
#: m/s2.
GRAVITY = 9.81
#: deg C at which the winding has its nominal resistance.
REFERENCE_TEMPERATURE = 25.0
#: Of the gear's teeth where it has play, N m/rad.
TEETH_STIFFNESS = 50.0
#: N m; a limit that no torque reaches.
NO_TORQUE_LIMIT = 10.0
#: One sigma of the encoder, rad: one of 4096 counts per turn, for rounding and for what a magnetic encoder adds to it.
ENCODER_NOISE = 2 * math.pi / 4096
#: s of free simulation before it starts again from the measured state.
WINDOWS = (math.inf, 0.2)
#: Substep, s. Half of it changes the mean error over the real runs by 0.1 %.
STEP = 2e-3
#: A row's goal is computed this long before the row's timestamp, s (time stamps of the chirp runs: 3.5 to 3.7 ms); how much
#: later the servo has it is the model's delay.
GOAL_LEAD = 0.0035

#: What calibration may move. The motor is given as in its data sheet (:func:`wlr_gym.physics.servo.motor_constants` makes
#: torque constant and resistance of it), which says nothing of friction, rotor and delay: wide tolerances about a small
#: servo's.
QUANTITIES: tuple[Quantity, ...] = (
    Quantity("stall_torque", "N m", STALL_TORQUE, 0.25 * STALL_TORQUE, 0.1, 2.0),
    Quantity("no_load_speed", "rad/s", NO_LOAD_SPEED, 0.15 * NO_LOAD_SPEED, 3.0, 40.0),
    Quantity("armature", "kg m2", 0.001, 0.001, 1e-5, 0.01),
    Quantity("length_error", "m", 0.0, 0.002, -0.02, 0.02),
    Quantity("arm_mass", "kg", 0.02, 0.02, 0.0, 0.2),
    Quantity("delay", "s", 0.002, 0.003, -0.003, 0.05),
    Quantity("zero", "rad", 0.0, 0.02, -0.2, 0.2),
    Quantity("coulomb_friction", "N m", 0.03, 0.03, 0.0, 0.5),
    Quantity("viscous_friction", "N m s/rad", 0.005, 0.01, 0.0, 0.2),
)
#: Names of these.
CALIBRATED = frozenset(quantity.name for quantity in QUANTITIES)


# ---- its effects -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class RigEffect(RigLaw):
    """An effect as the rig knows it.

    Attributes:
        acts: number of the model -> parameter that changes it.
        how: from the number and the parameter to the changed number.
        least: below these values of its parameters it is another effect.
    """

    acts: Mapping[str, str]
    how: Callable[[float, float], float] = operator.add
    least: Mapping[str, float] = field(default_factory=dict)

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """What is fitted: its parameters, within their priors; every one counts as a size."""
        found = []
        for name, parameter in self.parameters.items():
            low, high = parameter.prior
            step = 0.02 * (min(high, 2.0) - low)
            low = max(low, self.least.get(name, low))
            found.append(Unknown(name, parameter.unit, float(parameter.neutral), low, high, step))
        return tuple(found)

    def apply(self, numbers: Numbers, effect: PatchEffect) -> None:
        """Write the effect with its parameters into ``numbers``."""
        for target, key in self.acts.items():
            parameter = self.parameters[key]
            if key not in effect.parameters and not parameter.optional:
                raise InputError(f"{effect.name}: has no '{key}' ({parameter.unit})")
            value = float(effect.parameters.get(key, float(parameter.neutral)))
            numbers[target] = self.how(numbers[target], value)


def _put(old: float, new: float) -> float:
    return new


def _library(name: str, guesses: tuple[Guess, ...], **more: Any) -> RigEffect:
    return RigEffect("", EFFECTS[name].parameters, guesses, **more)


def _steps(parameter: str, *sizes: float, neutral: float = 0.0) -> tuple[Guess, ...]:
    return tuple(one_step(parameter, size, neutral) for size in sizes)


def _limit(torque: float) -> Guess:
    """A limit grows as less of its response is wanted."""
    return Guess(((Change({"torque": torque}),),), lambda a: (min(torque / max(float(a[0]), 1e-3), NO_TORQUE_LIMIT),))


def _stribeck(speed: float, torque: float = 0.02) -> Guess:
    change = Change({"extra_static_torque": torque, "stribeck_speed": speed})
    return Guess(((change,),), lambda a: (torque * float(a[0]), speed))


def _ripple(order: float, amplitude: float = 0.02) -> Guess:
    """A sine and a cosine."""
    phases = (0.0, 0.5 * math.pi)
    return Guess(
        tuple((Change({"amplitude": amplitude, "order": order, "phase": phase}),) for phase in phases),
        lambda a: (amplitude * float(np.hypot(a[0], a[1])), order, float(np.arctan2(a[1], a[0]))),
    )


#: Effects by name. Those of the library have its law and parameters; the others are the rig's own. Of equally good ones the
#: first is selected.
RIG_EFFECTS: dict[str, RigEffect] = {
    "coulomb_friction": _library("coulomb_friction", _steps("torque", 0.03), acts={"coulomb_friction": "torque"}),
    "viscous_friction": _library("viscous_friction", _steps("coefficient", 0.005), acts={"viscous_friction": "coefficient"}),
    "load_dependent_friction": _library("load_dependent_friction", _steps("ratio", 0.1, 0.3), acts={"load_friction": "ratio"}),
    "backlash": _library("backlash", _steps("angle", 0.01, 0.03, 0.06), acts={"play": "angle"}),
    "weak_motor": _library("weak_motor", _steps("scale", -0.1, neutral=1.0), acts={"torque_scale": "scale"}, how=operator.mul),
    "command_delay": _library("command_delay", _steps("delay", 0.01, 0.03), acts={"delay": "delay"}),
    "torque_saturation": RigEffect(
        "torque falls behind the current: K I / (1 + coefficient |I|)",
        {"coefficient": EffectParameter("1/A", "loss per current", 0, 10, 0.0, (0, 2), 0.3)},
        _steps("coefficient", 0.2, 0.6),
        acts={"saturation": "coefficient"},
    ),
    "quadratic_load_friction": RigEffect(
        "gear friction growing with the square of the motor torque: -coefficient torque^2 sign(rate)",
        {"coefficient": EffectParameter("1/(N m)", "friction per torque squared", 0, 20, 0.0, (0, 2), 0.3)},
        _steps("coefficient", 0.2),
        refines="load_dependent_friction",  # the next term in the load
        acts={"quadratic_friction": "coefficient"},
    ),
    "warm_winding": RigEffect(
        "resistance grows with the temperature the servo reports: R (1 + coefficient (T - 25 deg C)); copper: 0.0039/K",
        {"coefficient": EffectParameter("1/K", "relative, per degree", -0.01, 1, 0.0, (0, 0.0045), 0.0039)},
        _steps("coefficient", 0.0039),
        acts={"thermal": "coefficient"},
    ),
    "torque_limit": RigEffect(
        "motor torque stays below a limit: |motor torque| <= torque; the data sheet's stall torque is reached, within 15 %",
        {"torque": EffectParameter("N m", "the limit", 0.01, NO_TORQUE_LIMIT, NO_TORQUE_LIMIT, (0.45, NO_TORQUE_LIMIT), 0.6)},
        tuple(_limit(torque) for torque in (0.5, 0.6, 0.75)),
        acts={"torque_limit": "torque"},
        how=_put,
    ),
    "stribeck_friction": _library(
        "stribeck_friction",
        tuple(_stribeck(speed) for speed in (0.05, 0.2, 0.8)),
        refines="coulomb_friction",  # more of it at rest than in motion
        acts={"stribeck_torque": "extra_static_torque", "stribeck_speed": "stribeck_speed"},
        how=_put,
    ),
    "torque_ripple": _library(
        "torque_ripple",
        tuple(_ripple(float(order)) for order in (6, 8, 12, 16, 24, 32, 48, 64)),
        acts={"ripple_amplitude": "amplitude", "ripple_order": "order", "ripple_phase": "phase"},
        how=_put,
        least={"order": 6.0},  # slower, it does not repeat within the swing and is an error of the load or of its zero
    ),
}
#: What the effects change, where none is.
_NEUTRAL: Numbers = {
    target: float(effect.parameters[key].neutral) for effect in RIG_EFFECTS.values() for target, key in effect.acts.items()
}


# ---- its law, one substep --------------------------------------------------------------------------------------------

#: Numbers of one model: lanes of the drive law for its joint 0, then the rig's. ``gain`` is duty per rad; ``gravity`` N m at a
#: right angle; ``inertia`` kg m2, of all that turns with the link; ``coulomb``, ``torque_limit`` N m; ``saturation`` 1/A;
#: ``quadratic_friction`` 1/(N m); ``thermal`` 1/K.
PARAMETERS = (
    "volt_gain", "back_emf_damping", "viscous", "weight", "inverse_constant",
    "stribeck_torque", "inverse_stribeck_speed",
    "ripple_amplitude", "ripple_order", "ripple_phase",
    "half_play", "rotor_inertia", "teeth_stiffness", "teeth_damping",
    "gain", "zero", "gravity", "inertia", "coulomb", "torque_scale", "load_friction",
    "saturation", "torque_limit", "quadratic_friction", "thermal",
)  # fmt: skip
#: What the measurement prescribes in each substep: goal (rad), supply (V), torque on (1 or 0), warmth (K above reference).
INPUTS = ("goal", "supply", "on", "warmth")
#: rad, rad/s, rotor's lead in the play (rad), rotor's rate (rad/s).
STATE = ("angle", "rate", "rotor_lead", "rotor_rate")
#: Columns of what :func:`simulate` returns: state, voltage (V), motor torque before gear friction and dry friction (N m).
OUTPUTS = ("angle", "rate", "voltage", "motor_torque", "friction_torque")


def substep(lanes: Lanes, step: Value, features: frozenset[str]) -> dict[str, Value]:
    """Return STATE after a substep and what OUTPUTS adds: drift half a step, kick, drift the other half.

    Args:
        lanes: PARAMETERS, INPUTS and STATE; scalars, or nodes of a graph.
        step: s.
        features: families of the drive law to trace.
    """
    half = 0.5 * step
    rate, rotor_rate = lanes["rate"], lanes["rotor_rate"]
    angle = lanes["angle"] + half * rate
    lead = lanes["rotor_lead"] + half * (rotor_rate - rate)
    joint = drive.Joint(angle, rate, angle + lanes["zero"])
    voltage = lanes["supply"] * ops.clip(lanes["gain"] * (lanes["goal"] - joint.reading), -1.0, 1.0)

    gear = {**lanes, **{f"{name}0": lane for name, lane in lanes.items()}}  # under the names the drive law gives its joint 0
    gear |= {"rotor_lead0": lead, "rotor_rate0": rotor_rate, "on0": lanes["on"], "idle_current0": 0.0}
    motor_rate = drive.motor_rate(gear, 0, joint, features)
    strength, load_friction = _strength_and_load_friction(lanes, voltage, motor_rate)
    gear |= {"torque_scale0": strength, "load_friction0": load_friction, "gear_bound0": step * lanes["coulomb"]}
    pushed = drive.push(gear, 0, voltage, joint, step, half, features)

    # rotor's rate without friction, and what a friction impulse on the rotor adds to it
    mass = 1.0 / (lanes["inertia"] + pushed.damping)
    momentum = lanes["inertia"] * rate - step * (lanes["gravity"] * ops.sin(angle)) + pushed.impulse
    free = pushed.rotor_free + pushed.share * (mass * momentum)
    mobility = pushed.rotor_gain + pushed.share * pushed.share * mass
    friction = ops.clip(-(free / mobility), -pushed.bound, pushed.bound)
    new_rate = mass * (momentum + pushed.share * friction)

    done = drive.finish({**gear, **drive.kept_for_finish(pushed, 0)}, 0, voltage, rate, new_rate, friction, step, features)
    new_rotor_rate = done.get("rotor_rate0", new_rate)
    return {
        "angle": angle + half * new_rate,
        "rate": new_rate,
        "rotor_lead": lead + half * (new_rotor_rate - new_rate),
        "rotor_rate": new_rotor_rate,
        "voltage": voltage,
        "motor_torque": done["motor_torque0"],
        "friction_torque": friction * (1.0 / step),
    }


def _strength_and_load_friction(lanes: Lanes, voltage: Value, motor_rate: Value) -> tuple[Value, Value]:
    """Factor on the motor's torque, and friction per torque, at the voltage and the motor's rate of this substep.

    winding: 1/(1 + thermal warmth); torque per current: 1/(1 + saturation |I|); torque limit: at most ``torque_limit``;
    friction per torque: load_friction + quadratic_friction |torque|.
    """
    winding = 1.0 / (1.0 + lanes["thermal"] * lanes["warmth"])
    unsaturated = winding * ops.absolute(lanes["volt_gain"] * voltage - lanes["back_emf_damping"] * motor_rate)
    current = unsaturated * lanes["inverse_constant"]
    strength = lanes["torque_scale"] / (1.0 + lanes["saturation"] * current)
    torque = strength * unsaturated
    limited = lanes["torque_limit"] / ops.maximum(torque, lanes["torque_limit"])
    load_friction = lanes["load_friction"] + lanes["quadratic_friction"] * (limited * torque)
    return winding * strength * limited, load_friction


# ---- its law compiled: many models over one run, restarted where a window begins -------------------------------------

_DRIVER = '''
@compiled(error_model="numpy")
def simulate(P, lag, setpoints, inputs, starts, begun, step, out):
    """See the function of this name below. P: parameters; inputs: supply, switch, warmth."""
    count = setpoints.shape[0]
    for m in range(P.shape[0]):
        {read_parameters}
        whole = int(math.floor(lag[m]))
        part = lag[m] - whole
        angle = rate = rotor_lead = rotor_rate = 0.0
        for i in range(count):
            new = min(max(i - whole, 0), count - 1)
            old = min(max(i - whole - 1, 0), count - 1)
            goal = (1.0 - part) * setpoints[new] + part * setpoints[old]
            supply, on, warmth = inputs[i, 0], inputs[i, 1], inputs[i, 2]
            if starts[i] >= 0:
                angle, rate = begun[starts[i], 0] - zero, begun[starts[i], 1]
                rotor_rate = rate
                rotor_lead = half_play * np.sign(goal - angle - zero) * on
            out[m, i, 0] = angle
            out[m, i, 1] = rate
{substep}
            out[m, i, 2] = voltage
            out[m, i, 3] = motor_torque
            out[m, i, 4] = friction_torque
'''


@functools.cache
def _compiled(with_play: bool) -> ModuleType:
    owner = Graph()
    lanes = {name: owner.input(name) for name in (*PARAMETERS, *INPUTS, *STATE)}
    outputs = substep(lanes, owner.input("step"), frozenset({"drive", "backlash"} if with_play else {"drive"}))
    source = _DRIVER.format(
        read_parameters="; ".join(f"{name} = P[m, {k}]" for k, name in enumerate(PARAMETERS)),
        substep="\n".join(emit(outputs, str, lambda name, text: f"{name} = {text}", " " * 12)),
    )
    return load_module("rig_play" if with_play else "rig", source, "compiling the test rig (once)")


def simulate(
    parameters: Array,
    lag: Array,
    setpoints: Array,
    inputs: Array,
    starts: NDArray[np.int64],
    begun: Array,
    step: float,
) -> Array:
    """Simulate models over one run.

    Args:
        parameters: (models, parameters) in the order of :data:`PARAMETERS`.
        lag: (models,) how much later setpoints act than they were written, in substeps; fractions mix neighbours.
        setpoints: (n,) mean goal of every substep as written, rad.
        inputs: (n, 3) supply (V), torque on (0 or 1), warmth (K).
        starts: (n,) row of ``begun`` to restart from before the substep, or -1; the first must not be -1.
        begun: (k, 2) encoder reading (rad) and rate (rad/s) where windows begin.
        step: s.

    Returns:
        (models, n, 5) :data:`OUTPUTS`; angle (true: without the encoder's zero) and rate at the start of each substep, the
        others within it.
    """
    out = np.empty((len(parameters), len(setpoints), len(OUTPUTS)))
    has_play = parameters[:, PARAMETERS.index("half_play")] > 0.0
    for with_play in (False, True):
        chosen = np.flatnonzero(has_play == with_play)
        if len(chosen):
            part = np.empty((len(chosen), *out.shape[1:]))
            _compiled(with_play).simulate(parameters[chosen], lag[chosen], setpoints, inputs, starts, begun, step, part)
            out[chosen] = part
    return out


# ---- its model over a recording --------------------------------------------------------------------------------------


def model_of(setting: Setting, known: Sequence[PatchEffect] = ()) -> Numbers:
    """Return the numbers of a setting's model by name: its quantities, then the effects that are known, then its own.

    Raises:
        InputError: an effect the rig does not know, or a parameter missing.
    """
    numbers = dict(_NEUTRAL)
    numbers.update({q.name: float(value) for q, value in zip(QUANTITIES, setting.quantities, strict=True)})
    for effect in (*known, *setting.effects):
        check_name("effect of the test rig", effect.name, RIG_EFFECTS)
        RIG_EFFECTS[effect.name].apply(numbers, effect)
    return numbers


def pack(models: Sequence[Numbers], recording: Recording, step: float) -> Array:
    """Return what the compiled law reads (models, len(PARAMETERS)) for one recording's load and gain."""
    table = {name: np.array([model[name] for model in models]) for name in models[0]}
    arm, length = table["arm_mass"], recording.length + table["length_error"]
    armature, play = table["armature"], table["play"]
    constant, resistance = servo.motor_constants(table["stall_torque"], table["no_load_speed"], DATA_SHEET_VOLTAGE)
    link = (recording.mass + arm / 3.0) * length**2
    with_rotor = link + armature
    back_emf_damping = constant**2 / resistance
    moved = np.where(play > 0.0, armature, with_rotor)
    lanes = {
        "volt_gain": constant / resistance,
        "back_emf_damping": back_emf_damping,
        "inverse_constant": 1.0 / constant,
        "viscous": table["viscous_friction"],
        "weight": drive.fitted_weight(step * (back_emf_damping * table["torque_scale"] + table["viscous_friction"]) / moved),
        "inverse_stribeck_speed": 1.0 / table["stribeck_speed"],
        "half_play": 0.5 * play,
        "rotor_inertia": armature,
        "teeth_stiffness": np.full(len(models), TEETH_STIFFNESS),
        "teeth_damping": drive.TEETH_DAMPING * np.sqrt(TEETH_STIFFNESS * armature),
        "gain": np.full(len(models), recording.gain * DUTY_PER_GAIN),
        "gravity": GRAVITY * length * (recording.mass + arm / 2.0),
        "inertia": np.where(play > 0.0, link, with_rotor),
        "coulomb": table["coulomb_friction"],
    }
    return np.stack([lanes[name] if name in lanes else table[name] for name in PARAMETERS], axis=1)


class Replay:
    """One recording as input of the simulation: setpoints, supply and switch on a fixed grid, and states to start from."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        time = recording.t
        count = max(2, int((time[-1] - time[0]) / STEP) + 1)
        self._grid = time[0] + STEP * np.arange(count + 1)
        written = time - GOAL_LEAD  # each row's goal holds until the next is written
        edges = np.concatenate([[self._grid[0] - 1.0], written[1:], [self._grid[-1] + 1.0]])
        integral = np.concatenate([[0.0], np.cumsum(np.diff(edges) * recording.goal)])
        self.goals: Array = np.diff(np.interp(self._grid, edges, integral)) / STEP
        middle = self._grid[:-1] + 0.5 * STEP
        row = np.clip(np.searchsorted(written, middle, side="right") - 1, 0, len(time) - 1)
        self._inputs = np.stack(
            [
                np.interp(middle, time, recording.supply),
                recording.enabled[row].astype(np.float64),
                np.interp(middle, time, recording.temperature) - REFERENCE_TEMPERATURE,
            ],
            axis=1,
        )
        self.angle, self.rate = smoothed_state(time, recording.angle)
        place = (time - time[0]) / STEP
        self._below = np.clip(place.astype(np.int64), 0, count - 2)
        self._share = place - self._below

    def simulate(self, models: Sequence[Numbers], length: float = math.inf) -> Array:
        """Return (models, rows, 5) :data:`OUTPUTS` at the rows of the recording.

        Args:
            models: what to simulate.
            length: s between restarts from the measured state; infinite = one simulation from the first row on.
        """
        count = len(self.goals)
        every = count if math.isinf(length) else max(1, round(length / STEP))
        restarts = np.arange(0, count, every)
        starts = np.full(count, -1)
        starts[restarts] = np.arange(len(restarts))
        time = self.recording.t
        begun = np.stack([np.interp(self._grid[restarts], time, state) for state in (self.angle, self.rate)], axis=1)
        lag = np.array([model["delay"] for model in models]) / STEP
        found = simulate(pack(models, self.recording, STEP), lag, self.goals, self._inputs, starts, begun, STEP)
        below, above = found[:, self._below], found[:, self._below + 1]
        return below + (above - below) * self._share[:, None]


# ---- the problem -----------------------------------------------------------------------------------------------------


class PendulumProblem(RigProblem):
    """Recordings of one servo with a pendulum, and a simulator of it; see :class:`wlr_gym.gap.rig.problem.RigProblem`.

    A servo that sticks elsewhere is off by hundreds of counts, and that is the gap: only what broke down is capped.

    Args:
        recordings: of one servo.
        known: effects that are in the model from the start.
    """

    metric = "RMS over whole runs and over windows of 0.2 s of measured-minus-replayed angle, in units of sensor noise"
    in_model = CALIBRATED

    def __init__(self, recordings: Sequence[Recording], known: Sequence[PatchEffect] = ()) -> None:
        if not recordings:
            raise InputError("no recordings to analyse")
        position = MeasuredSignal("position", "rad", ENCODER_NOISE, "position")
        super().__init__(JOINT, recordings, (position,), QUANTITIES, RIG_EFFECTS, WINDOWS, known)
        self.recordings: tuple[Recording, ...] = tuple(recordings)
        self.held_out: tuple[str, ...] = spread_over_conditions(self.recordings)
        self.replays: list[Replay] = [Replay(recording) for recording in recordings]

    def replayed(self, settings: Sequence[Setting], run: int, length: float) -> Array:
        """Return what the encoder would have read (settings, rows, 1), begun anew after every ``length`` s, rad."""
        models = [model_of(setting, self.known) for setting in settings]
        zero = np.array([model["zero"] for model in models])
        return self.replays[run].simulate(models, length)[:, :, :1] + zero[:, None, None]

    def remade(self, setting: Setting, runs: Sequence[int], count: int) -> Iterator[list[Array]]:
        """Replay recordings that a model itself would have made; see :meth:`wlr_gym.gap.problem.Problem.remade`.

        They are rounded to counts, and differ by where within a count the servo's zero lies.
        """
        clean = [angles[0, :, 0] for angles in self.simulate([setting], runs)]
        for shift in (0.0, *generator(0, "gap", "zero of the encoder").uniform(-0.5, 0.5, count - 1)):
            made = [
                replace(self.recordings[run], angle=(np.round(angle / ENCODER_NOISE + shift) - shift) * ENCODER_NOISE)
                for run, angle in zip(runs, clean, strict=True)
            ]
            twin = PendulumProblem(made, self.known)
            yield [residual[0] for residual in twin.residuals([setting], range(len(made)))]

    def features(self, setting: Setting, runs: Sequence[int]) -> list[Mapping[str, Array]]:
        """Return what residuals are mapped over, (rows,) each, units in the names."""
        found: list[Mapping[str, Array]] = []
        for run in runs:
            recording = self.recordings[run]
            columns = dict(zip(OUTPUTS, self.replays[run].simulate([model_of(setting, self.known)])[0].T, strict=True))
            found.append(
                {
                    "angle [rad]": columns["angle"],
                    "rate [rad/s]": columns["rate"],
                    "motor torque [N m]": columns["motor_torque"],
                    "voltage [V]": columns["voltage"],
                    "time since reversal [s]": since_reversal(recording.t, columns["rate"]),
                    "time [s]": recording.t,
                    "supply [V]": recording.supply,
                    "temperature [deg C]": recording.temperature,
                    "P gain [register]": np.full(len(recording.t), recording.gain),
                }
            )
        return found


def spread_over_conditions(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return the names of runs to hold out: in turn one of every gain, each of the trajectory that is held out least so far."""
    gains = sorted({recording.gain for recording in recordings})
    chosen: list[Recording] = []
    for turn in range(math.ceil(HELD_OUT_SHARE * len(recordings))):
        left = [recording for recording in recordings if recording not in chosen]
        left = [recording for recording in left if recording.gain == gains[turn % len(gains)]] or left
        held = [recording.trajectory for recording in chosen]
        chosen.append(min(left, key=lambda recording: held.count(recording.trajectory)))
    return tuple(recording.name for recording in recordings if recording in chosen)


def open_pendulum(data: str | Path, known: Patch | None = None) -> tuple[PendulumProblem | None, list[IntakeFinding]]:
    """Return the problem, and what was noticed about the data; None where the data are too bad to go on.

    Args:
        data: folder of recordings.
        known: effects that are in the model from the start.

    Raises:
        InputError: files that are no such recordings, an effect the rig does not know.
    """
    recordings = read_recordings(data)
    found = list(findings(recordings))
    bad = {finding.run for finding in found if finding.fatal}
    good = [recording for recording in recordings if recording.name not in bad]
    if "" in bad:
        return None, found
    if too_few := few_runs(len(good), len(recordings), "record more"):
        return None, [*found, *too_few]
    return PendulumProblem(good, known.effects if known else ()), found
