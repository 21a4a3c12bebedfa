"""The rig's model fitted to recordings, and how well it replays them."""

import numpy as np

from wlr_gym.gap.estimation.fit import fit
from wlr_gym.gap.estimation.model import FittedModel, nominal_model
from wlr_gym.gap.rig.pendulum import ENCODER_NOISE, JOINT, RIG_EFFECTS
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
        model = FittedModel(quantities)
        for name, values in effects.items():
            model = model.with_effect(candidates[name], values)
        fits.append(fit(problem, runs, model, autocorrelation_time=autocorrelation_time, steps=25))
    return min(fits, key=lambda found: found.cost)
