"""The law of the rig compiled: many models over one run, restarted where a window begins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.rig import law
from wlr_gym.gap.rig.formula import total_force
from wlr_gym.physics.codegen import Graph, emit, load_module
from wlr_gym.physics.plants.forces import Force, force_values

Array = NDArray[np.float64]

#: Columns of what :func:`simulate` returns.
OUTPUTS = ("angle", "rate", "voltage", "motor_torque", "friction_torque")

_DRIVER = '''
@njit(cache=True, nogil=True, error_model="numpy")
def simulate(P, V, lag, setpoints, inputs, starts, begun, step, out):
    """See the function of this name below. P: parameters; V: constants of the formulas; inputs: supply, switch, warmth."""
    count = setpoints.shape[0]
    for m in range(P.shape[0]):
        {read_parameters}
        {read_values}
        whole = int(math.floor(lag[m]))
        part = lag[m] - whole
        angle = rate = rotor_lead = rotor_rate = motor_torque = 0.0
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


class _Inputs(Mapping[str, Any]):
    """Every lane as an input of the graph."""

    def __init__(self, owner: Graph) -> None:
        self._owner = owner

    def __getitem__(self, name: str) -> Any:
        return self._owner.input(name)

    def __iter__(self) -> Any:
        raise TypeError("lanes are read by name")

    def __len__(self) -> int:
        raise TypeError("lanes are read by name")


def _module(with_play: bool, forces: Sequence[Force]) -> ModuleType:
    owner = Graph()
    lanes = _Inputs(owner)
    features = frozenset({"drive", "backlash"} if with_play else {"drive"})
    constants = [f"value_{k}" for k in range(sum(len(force.parameters) for force in forces))]
    force = total_force(forces, lanes, [owner.input(name) for name in constants]) if forces else 0.0
    outputs = law.substep(lanes, owner.input("step"), features, force)
    body = emit(outputs, str, lambda name, text: f"{name} = {text}", " " * 12)
    reading = "; ".join(f"{name} = P[m, {k}]" for k, name in enumerate(law.PARAMETERS))
    values = "; ".join(f"{name} = V[m, {k}]" for k, name in enumerate(constants)) or "pass"
    source = _DRIVER.format(read_parameters=reading, read_values=values, substep="\n".join(body))
    return load_module("rig_play" if with_play else "rig", source, "compiling the test rig (once)")


#: Compiled modules by what they were traced from.
_modules: dict[tuple[Any, ...], ModuleType] = {}


def _compiled(with_play: bool, forces: Sequence[Force]) -> ModuleType:
    key = (with_play, *((force.formula, tuple(force.parameters)) for force in forces))
    if key not in _modules:
        _modules[key] = _module(with_play, forces)
    return _modules[key]


def simulate(
    parameters: Array,
    lag: Array,
    setpoints: Array,
    inputs: Array,
    starts: NDArray[np.int64],
    begun: Array,
    step: float,
    forces: Sequence[Force] = (),
    values: Array | None = None,
) -> Array:
    """Simulate models over one run.

    Args:
        parameters: (models, parameters) in the order of :data:`law.PARAMETERS`.
        lag: (models,) how much later setpoints act than they were written, in substeps; fractions mix neighbours.
        setpoints: (n,) mean goal of every substep as written, rad.
        inputs: (n, 3) supply (V), torque on (0 or 1), warmth (K).
        starts: (n,) row of ``begun`` to restart from before the substep, or -1; the first must not be -1.
        begun: (k, 2) encoder reading (rad) and rate (rad/s) where windows begin.
        step: s.
        forces: formula forces, the same laws for all models.
        values: (models, constants) of the forces, one after the other; None = their own.

    Returns:
        (models, n, 5) :data:`OUTPUTS`; angle (true: without the encoder's zero) and rate at the start of each substep, the
        others within it.
    """
    if values is None:
        values = np.repeat(force_values(forces)[None], len(parameters), axis=0)
    out = np.empty((len(parameters), len(setpoints), len(OUTPUTS)))
    with_play = parameters[:, law.PARAMETERS.index("half_play")] > 0.0
    for chosen, is_with_play in ((np.flatnonzero(~with_play), False), (np.flatnonzero(with_play), True)):
        if len(chosen):
            part = np.empty((len(chosen), *out.shape[1:]))
            kernel = _compiled(is_with_play, forces).simulate
            kernel(parameters[chosen], values[chosen], lag[chosen], setpoints, inputs, starts, begun, step, part)
            out[chosen] = part
    return out
