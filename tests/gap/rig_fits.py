"""The rig's model fitted to recordings, and how well it replays them.

What docs/own_rig.md says of the real servo: ``python rig_fits.py RECORDINGS RESULT.json DATA.json``. RESULT.json is what
``wlr gap RECORDINGS --rig pendulum --out DIR`` wrote; DATA.json is docs/data/xl330_pendulum.json, of which .ci/docs/tables.py
makes the page's table.
"""

import json
import sys
from pathlib import Path

import numpy as np

from wlr_gym.base.files import write_json
from wlr_gym.base.provenance import git_commit
from wlr_gym.gap.estimation import FittedModel, fit, nominal_model
from wlr_gym.gap.rig.pendulum import ENCODER_NOISE, JOINT, RIG_EFFECTS, PendulumProblem
from wlr_gym.gap.rig.pendulum_recordings import read_recordings
from wlr_gym.gap.rig.problem import law_candidates


def nominal(problem):
    return nominal_model(problem).quantities


def position_errors(problem, setting, runs):
    """Mean absolute error of the angle over whole runs, rad."""
    return np.array([float(np.abs(r[0, :, 0]).mean()) * ENCODER_NOISE for r in problem.residuals([setting], runs)])


def best_fit(problem, runs, effects, autocorrelation_time=None):
    """The better of two fits: from the data sheet, and from a stronger motor with less friction."""
    candidates = {}
    for present in ("coulomb_friction", "load_dependent_friction"):
        candidates |= {c.name: c for c in law_candidates(RIG_EFFECTS, JOINT, {present})[1]}
    stronger = nominal(problem).copy()
    names = [quantity.name for quantity in problem.quantities]
    for name, value in {"stall_torque": 0.735, "armature": 0.0018, "coulomb_friction": 0.02}.items():
        stronger[names.index(name)] = value
    fits = []
    for quantities in (nominal(problem), stronger):
        model = FittedModel(problem, quantities)
        for name, values in effects.items():
            model = model.with_effect(candidates[name], values)
        fits.append(fit(model, runs, autocorrelation_time=autocorrelation_time, steps=25))
    return min(fits, key=lambda found: found.cost)


# ---- what the page says ----------------------------------------------------------------------------------------------

SATURATION, LOAD = {"torque_saturation": (0.4,)}, {"load_dependent_friction": (0.2,)}
MODELS = (
    {},
    LOAD,
    SATURATION,
    LOAD | SATURATION,
    LOAD | {"quadratic_load_friction": (0.3,)},
    LOAD | {"torque_limit": (0.65,)},
    LOAD | {"warm_winding": (0.004,)},
)
TAKEN = ("verdict", "effects", "gap", "runs")


def measured(problem: PendulumProblem, effects: dict[str, tuple[float, ...]]) -> dict[str, object]:
    """Mean error of the angle of a model fitted to all runs, and its effects' numbers."""
    runs = range(len(problem.runs))
    model = best_fit(problem, runs, effects).model
    error = 1e3 * float(position_errors(problem, model.setting, runs).mean())
    numbers = {effect.name: dict(effect.parameters) for effect in model.patch}
    print(f"{error:.1f} mrad {numbers}", flush=True)
    return {"effects": numbers, "error_mrad": error}


def main(recordings: str, result: str, data: str) -> None:
    problem = PendulumProblem(read_recordings(Path(recordings)))
    found = json.loads(Path(result).read_text(encoding="utf-8"))
    workflow = {name: found[name] for name in TAKEN} | {"commit": found["provenance"]["git_commit"]}
    models = [measured(problem, effects) for effects in MODELS]
    write_json(Path(data), {"commit": git_commit(), "models": models, "workflow": workflow})


if __name__ == "__main__":
    main(*sys.argv[1:])
