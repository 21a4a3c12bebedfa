"""A baseline for the gap workflow: a classifier that names effects from the scores of the first screening alone.

Multinomial logistic regression on the logarithms of the predicted improvements, one per name, trained on data of the engine:
the runs of one set, replayed by models whose numbers are drawn within their tolerances, half of them with an effect of the
library or a formula. It answers the sets of the blind test from the same screening that the workflow began with, and is scored
alike.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import logsumexp, softmax

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import make_output_folder, write_json
from wlr_gym.base.jobs import Job, Send, serve, spread
from wlr_gym.base.progress import time_left
from wlr_gym.gap.analysis import UNKNOWN, Evidence
from wlr_gym.gap.problem import Candidate, Problem, Setting
from wlr_gym.gap.selection.screening import Score

Array = NDArray[np.float64]
_MODULE = "studies.bench.gap_classifier"
#: Name -> the best candidate of this name in the first screening: predicted improvement, place, first guess.
Screen = Mapping[str, Mapping[str, Any]]

#: Motions of the runs that training sets replay.
MOTIONS = ("straight", "posture", "turns", "s_curve", "stop_and_go", "rear_legs", "all_legs", "random")
#: Class of sets without an effect.
NOTHING = "nothing_missing"
#: Share of training sets without an effect.
NULLS = 0.5
#: Weight of the squared coefficients per training set.
RIDGE = 1e-2
#: Draws of a number are cut at so many tolerances.
CUT = 2.0
#: Sizes of training effects, as a share of the plausible range from neutral, log-uniform.
SIZES = (0.05, 1.0)


def first_screen(evidence: Sequence[Evidence]) -> dict[str, dict[str, Any]]:
    """Return the screen of an analysis' first round, from its evidence."""
    found: dict[str, dict[str, Any]] = {}
    for one in sorted(evidence, key=lambda entry: -entry.screened):
        if one.round == 1:
            found.setdefault(one.name, {"gain": one.screened, "where": list(one.where), "values": dict(one.values)})
    return found


def screen_of(scores: Sequence[Score]) -> dict[str, dict[str, Any]]:
    """Return the same of scores, best first."""
    found: dict[str, dict[str, Any]] = {}
    for score in scores:
        candidate = score.candidate
        values = candidate.parameters(score.values)
        found.setdefault(candidate.name, {"gain": score.gain, "where": list(candidate.where), "values": values})
    return found


# ---- training data ---------------------------------------------------------------------------------------------------


def drawn_setting(problem: Problem, candidates: Sequence[Candidate], rng: np.random.Generator) -> tuple[Setting, str]:
    """Draw a model: every number within its tolerance, and in half of all cases one effect; return its name, too."""
    shifts = np.clip(rng.standard_normal(len(problem.quantities)), -CUT, CUT)
    quantities = np.array([one.nominal + one.sigma * shift for one, shift in zip(problem.quantities, shifts, strict=True)])
    quantities = np.clip(quantities, [one.low for one in problem.quantities], [one.high for one in problem.quantities])
    if rng.random() < NULLS:
        return Setting(quantities), NOTHING
    names = sorted({candidate.name for candidate in candidates})
    name = names[int(rng.integers(len(names)))]
    places = [candidate for candidate in candidates if candidate.name == name]
    candidate = places[int(rng.integers(len(places)))]
    share = float(np.exp(rng.uniform(*np.log(SIZES))))
    values = []
    for one in candidate.unknowns:
        ends = [end for end in (one.low, one.high) if abs(end - one.neutral) > 1e-12]
        end = ends[int(rng.integers(len(ends)))]
        values.append(one.neutral + share * (end - one.neutral) if one.is_size else rng.uniform(one.low, one.high))
    return Setting(quantities, (candidate.effect(candidate.kept(values)),)), name


def training_screen(runs: Path, seed: int) -> dict[str, Any]:
    """Return the screen of one training set and the name of what is missing; ``runs``: a set of the robot without an effect.

    A drawn model whose simulation breaks down is drawn anew.
    """
    from wlr_gym.gap.robot.problem import RobotProblem, open_robot
    from wlr_gym.gap.selection.search import screened
    from wlr_gym.gap.validation.data_split import informative_split
    from wlr_gym.gap.workflow import calibrated_fit
    from wlr_gym.physics.effects import load_patch

    template, _ = open_robot(runs, load_patch(None), "gibbs_appell", 1, None)
    if template is None:
        raise InputError(f"{runs}: expected runs of the robot that can be used")
    rng = np.random.default_rng([seed, 8])
    nominal = Setting(np.array([one.nominal for one in template.quantities]))
    every = range(len(template.runs))
    zeros = [np.zeros_like(template.measured(run)) for run in every]
    _, candidates = template.candidates(nominal, zeros, every)
    while True:
        setting, name = drawn_setting(template, candidates, rng)
        made = template.recorded(setting, seed)
        if made:
            break
    problem = RobotProblem(made, template.robot)
    fitted, _, columns = informative_split(problem)
    base = calibrated_fit(problem, fitted, columns)
    return {"missing": name, "screen": screen_of(screened(problem, fitted, base).scores)}


def template_runs(folder: Path) -> Path:
    """Record the eight runs that training sets replay, of the nominal robot on the engine; those that are there stay."""
    from wlr_gym.data.excitations import excite
    from wlr_gym.data.record import record_simulation
    from wlr_gym.robot import load_robot

    make_output_folder(folder)
    for number, name in enumerate(MOTIONS, 1):
        path = folder / f"run_{number:02d}.csv"
        if not path.is_file():
            record_simulation(path, excite(name), load_robot(), "gibbs_appell")
    return folder


def training_sets(out: Path, count: int, processes: int = 2, say: Callable[[str], None] = print) -> list[dict[str, Any]]:
    """Return training sets, one file each in ``out``: those that are there are not made again. Half a minute each.

    Raises:
        RuntimeError: a set cannot be made; the others stay.
    """
    runs, log = template_runs(out / "runs"), str((out / "work.log").resolve())
    files = {f"set_{seed:04d}": out / f"set_{seed:04d}.json" for seed in range(count)}
    tasks = {name: {"runs": str(runs.resolve()), "seed": seed} for seed, name in enumerate(files) if not files[name].is_file()}
    jobs = [Job(name, _MODULE, {**task, "file": str(files[name].resolve())}, log) for name, task in tasks.items()]
    begin = time.monotonic()
    for done, ended in enumerate(spread(jobs, processes), 1):
        if ended.error:
            raise RuntimeError(f"training {ended.name}: {ended.error}; see {log}")
        say(f"training set {done} of {len(jobs)}  {time_left(time.monotonic() - begin, done / len(jobs))}")
    return [json.loads(file.read_text(encoding="utf-8")) for file in files.values()]


def _work(task: Mapping[str, Any], send: Send) -> None:
    """Make one set, in a process of its own."""
    write_json(Path(task["file"]), training_screen(Path(task["runs"]), task["seed"]))


# ---- the classifier --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Classifier:
    """Logistic regression.

    Attributes:
        names: features: names whose predicted improvements are read.
        classes: what it may answer.
        weight, bias: (classes, features), (classes).
    """

    names: tuple[str, ...]
    classes: tuple[str, ...]
    weight: Array
    bias: Array

    def probabilities(self, screens: Sequence[Screen]) -> Array:
        """Return the probability of each class (screens, classes)."""
        return np.asarray(softmax(features(screens, self.names) @ self.weight.T + self.bias, axis=1))


def features(screens: Sequence[Screen], names: Sequence[str]) -> Array:
    """Return logarithms of the predicted improvements (screens, names); a name that was not scored gains nothing."""
    gains = [[max(float(screen.get(name, {}).get("gain", 0.0)), 0.0) for name in names] for screen in screens]
    return np.log1p(np.array(gains, dtype=np.float64).reshape(len(screens), len(names)))


def train(sets: Sequence[Mapping[str, Any]]) -> Classifier:
    """Fit a classifier to training sets: maximum likelihood with a ridge.

    Raises:
        InputError: sets of fewer than two classes.
    """
    names = tuple(sorted({name for one in sets for name in one["screen"]}))
    classes = tuple(sorted({str(one["missing"]) for one in sets}))
    if len(classes) < 2:
        raise InputError(f"{len(sets)} training sets of {len(classes)} classes: expected two classes or more")
    x = features([one["screen"] for one in sets], names)
    y = np.array([classes.index(one["missing"]) for one in sets])
    wanted: Array = np.eye(len(classes))[y]
    shape = (len(classes), len(names) + 1)

    def loss(flat: Array) -> tuple[float, Array]:
        both = flat.reshape(shape)
        weight, bias = both[:, :-1], both[:, -1]
        logits = x @ weight.T + bias
        total = np.asarray(logsumexp(logits, axis=1))
        missed = np.exp(logits - total[:, None]) - wanted
        value = float((total - logits[np.arange(len(y)), y]).mean() + 0.5 * RIDGE * (weight**2).sum())
        slope = np.concatenate([missed.T @ x / len(y) + RIDGE * weight, missed.mean(axis=0)[:, None]], axis=1)
        return value, slope.ravel()

    fitted = minimize(loss, np.zeros(shape).ravel(), jac=True, method="L-BFGS-B").x.reshape(shape)
    return Classifier(names, classes, fitted[:, :-1], fitted[:, -1])


def answer(classifier: Classifier, screen: Screen) -> dict[str, Any]:
    """Return what the classifier says of a set, as a result of the workflow: the best place and first guess of its name."""
    shares = classifier.probabilities([screen])[0]
    best = int(np.argmax(shares))
    name = classifier.classes[best]
    if name == NOTHING:
        return {"verdict": NOTHING, "effects": []}
    found = screen.get(name, {"where": [], "values": {}})
    parameters = {key: {"value": value, "ci95": None} for key, value in found["values"].items()}
    effect = {"name": name, "where": found["where"], "parameters": parameters, "confidence": float(shares[best])}
    return {"verdict": UNKNOWN if name == UNKNOWN else "effect_found", "effects": [effect]}


def answers_of(classifier: Classifier, results: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return its answers to the sets of a blind test, by their names; what was no answer of the workflow stays none."""
    return {
        name: {**answer(classifier, result["screen"]), "blind_test": result.get("blind_test", {})}
        if result.get("screen")
        else dict(result)
        for name, result in results.items()
    }


if __name__ == "__main__":
    serve(_work)
