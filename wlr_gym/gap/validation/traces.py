"""Traces of the channels that hold most of the gap, each of the held-out run where it is largest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wlr_gym.gap.analysis import Place, Trace
from wlr_gym.gap.estimation.model import FittedModel
from wlr_gym.gap.problem import Problem

#: Traces of an analysis.
MOST = 6
#: Shown where nothing stands out.
USUAL = ("gyro_z", "cam_x", "eff_leg_lf", "vel_wheel_lf", "position")


def informative_traces(
    problem: Problem, heldout: Sequence[int], models: Sequence[FittedModel], places: Sequence[Place]
) -> tuple[Trace, ...]:
    """Return measured and replayed traces of held-out runs, channels in the order of their share of the gap.

    Args:
        problem: the system.
        heldout: runs.
        models: as its file says; calibrated; with the effects.
        places: where the gap is.
    """
    names = [signal.name for signal in problem.signals]
    wanted = [place.name for place in places] + [name for name in USUAL if name in names]
    chosen = list(dict.fromkeys(wanted))[:MOST]
    settings = [model.setting for model in models]
    replayed = problem.simulate(settings, heldout)
    residuals = problem.residuals(settings[1:], heldout)
    found = []
    for name in chosen:
        c = names.index(name)
        sizes = [float(np.nan_to_num(np.nansum(r[0][:, c] ** 2))) for r in residuals]
        k = int(np.argmax(sizes))
        measured = problem.measured(heldout[k])[:, c]
        if not np.isfinite(measured).any():
            continue
        lines = [replayed[k][m][:, c] for m in range(3)]
        errors = [residuals[k][m][:, c] * problem.signals[c].noise for m in range(2)]
        run, unit = problem.runs[heldout[k]], problem.signals[c].unit
        found.append(Trace(run, name, unit, problem.times(heldout[k]), measured, *lines, *errors))
    return tuple(found)
