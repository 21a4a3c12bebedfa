"""Measure what docs/own_rig.md says of the real servo: ``python rig_page.py RECORDINGS RESULT.json DATA.json``.

RESULT.json is what ``wlr gap RECORDINGS --rig pendulum --out DIR`` wrote; DATA.json is docs/data/xl330_pendulum.json, of which
.ci/docs/tables.py makes the page's table.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from rig_fits import best_fit, position_errors

from wlr_gym.base.files import write_json
from wlr_gym.base.provenance import git_commit
from wlr_gym.gap.rig.pendulum import PendulumProblem
from wlr_gym.gap.rig.pendulum_recordings import read_recordings

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
