"""``python -m studies.bench adapt``: how much of what a hidden fault costs a policy is won back, by whom.

Cases are fixed beforehand: faults on two copies of the robot each. Named faults are as large as the library holds for
plausible: smaller ones cost the shipped policy nothing that two dozen episodes would show. Laws that no library names are
drawn by the blind test, which shares no code with what names effects, and written here as formulas. What acts in the emulated
robot is the library's own implementation: analyser and fault share the law of every named effect. ``shared`` says so, case by
case.

Every case is an emulated robot on MuJoCo with a step of 2 ms (the training's plant: the engine, 1 ms). Contenders drive the
same fresh episodes on it. Cheap contenders come first in all cases; then those that need the gap workflow, where the truth
helps most first. A study resumes contender by contender.
"""

from __future__ import annotations

import json
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import quantile_test

from studies.bench.blind.cases import strange
from studies.tables import hand_over, markdown_table, plain_console
from wlr_gym.base.errors import check_name
from wlr_gym.base.files import keep_request, make_output_folder
from wlr_gym.base.provenance import git_commit
from wlr_gym.base.text import tally
from wlr_gym.cli.options import JsonOption
from wlr_gym.envs.tasks.randomization import load_randomization
from wlr_gym.gap.analysis import BAD_DATA, NOT_EXCITED
from wlr_gym.gap.decision import Decided
from wlr_gym.gap.estimation import fit, half_widths, nominal_model, widened
from wlr_gym.gap.report.result import Result
from wlr_gym.gap.robot.problem import open_robot
from wlr_gym.gap.workflow import SCATTER
from wlr_gym.learning.adaptation.adapt import find_uncertainty, task_randomization
from wlr_gym.learning.adaptation.driving import EmulatedRobot, episodes_of, errors_of, paired, share_regained
from wlr_gym.learning.adaptation.retraining import accept_policy, train_in, train_supervised
from wlr_gym.learning.adaptation.state import Asked, Progress, open_folder
from wlr_gym.learning.adaptation.uncertainty import Family, Uncertainty, uncertainty_of
from wlr_gym.learning.evaluation.metrics import Bootstrap, Estimate
from wlr_gym.learning.evaluation.subjects import identity, read_subjects
from wlr_gym.physics.effects import Patch, load_patch
from wlr_gym.robot import JOINTS, WHEELS, Robot, load_robot, robot_hash
from wlr_gym.robot.parameter_table import ELEMENTS
from wlr_gym.robot.parameters import Parameters

LEFT = ("wheel_lf", "wheel_lr")
#: Effect -> where, parameters, and for six of them the parameters of the second severity.
NAMED: Mapping[str, tuple[tuple[str, ...], Mapping[str, float], Mapping[str, float] | None]] = {
    "joint_zero_offset": (("leg_rr",), {"angle": -0.1}, {"angle": -0.05}),
    "friction_asymmetry": (LEFT, {"mu": 0.12}, {"mu": 0.25}),
    "gyro_bias": (("sensor",), {"z": 0.05}, {"z": 0.02}),
    "weak_motor": (LEFT, {"scale": 0.4}, {"scale": 0.65}),
    "command_delay": (JOINTS, {"delay": 0.06}, {"delay": 0.04}),
    "wheel_radius_error": (LEFT, {"scale": 0.91}, {"scale": 0.96}),
    "external_force": (("body",), {"fx": -3.0, "fy": 2.0}, None),
    "tyre_creep": (WHEELS, {"creep_speed": 0.2}, None),
    "payload": (("body",), {"mass": 1.5, "x": -0.12, "y": 0.1, "z": 0.08}, None),
    "backlash": (WHEELS, {"angle": 0.09}, None),
    "com_offset": (("body",), {"x": -0.045, "y": 0.04, "z": 0.0}, None),
    "coulomb_friction": (LEFT, {"torque": 0.3}, None),
}
PAIRS = (("joint_zero_offset", "command_delay"), ("friction_asymmetry", "gyro_bias"))
#: Severity of the blind test at which its laws are drawn.
STRANGE_SEVERITY = 6.0
#: Laws outside the library: coordinate and formula; ``None`` = the leg at which the law is drawn.
OUTSIDE: Mapping[str, tuple[str | None, str, Mapping[str, str]]] = {
    "leg_spring": (None, "-stiffness * (leg_angle - rest)", {"stiffness": "N m/rad", "rest": "rad"}),
    "body_drag": ("body_force_x", "-coefficient * velocity_x * abs(velocity_x)", {"coefficient": "N s2/m2"}),
    "veer": ("body_force_y", "coefficient * velocity_x", {"coefficient": "N s/m"}),
}
COPIES = 2
#: Of the copies: tolerances of the robot's file, and a floor as it is known.
COPY = {"name": "a copy", "base": "nominal", "events": {"floor_friction": {"low": 0.5, "high": 0.7}}}


@dataclass(frozen=True)
class AdaptCase:
    """One robot with a fault.

    Attributes:
        name: of the case. kind: ``named``, ``second`` (severity), ``pair`` or ``outside``.
        effects: what is hidden, as a patch says it.
        copy: number of the copy. shared: the law that acts is the one that the analyser tries.
    """

    name: str
    kind: str
    effects: tuple[Mapping[str, Any], ...]
    copy: int
    shared: bool

    def parameters(self, robot: Robot) -> Parameters:
        """Return the parameters of the copy, without the fault."""
        seeds = np.array([5000 + self.copy], np.uint64)
        return load_randomization(COPY, robot).parameters(seeds, seeds)


def cases() -> tuple[AdaptCase, ...]:
    """Return all cases: copy by copy, so that a part of them is a sample of all."""
    faults = [("named", name, (_named(name),)) for name in NAMED]
    faults += [("pair", "+".join(both), tuple(_named(name, second=True) for name in both)) for both in PAIRS]
    faults += [("outside", name, (_outside(name),)) for name in OUTSIDE]
    faults += [("second", f"{name}_2", (_named(name, second=True),)) for name in NAMED if NAMED[name][2] is not None]
    return tuple(
        AdaptCase(f"{title}_copy{copy}", kind, effects, copy, kind != "outside")
        for copy in range(COPIES)
        for kind, title, effects in faults
    )


def chosen_cases(names: tuple[str, ...]) -> tuple[AdaptCase, ...]:
    """Return the cases of these names, or the first so many of one number; all without names.

    Raises:
        InputError: an unknown name.
    """
    there = {one.name: one for one in cases()}
    if not names:
        return tuple(there.values())
    if len(names) == 1 and names[0].isdigit():
        return tuple(there.values())[: int(names[0])]
    for name in names:
        check_name("case", name, there)
    return tuple(there[name] for name in names)


def _named(name: str, second: bool = False) -> Mapping[str, Any]:
    where, first, other = NAMED[name]
    return {"name": name, "where": list(where), "parameters": dict(other if second and other else first)}


def _outside(name: str) -> Mapping[str, Any]:
    drawn = strange(name, STRANGE_SEVERITY, np.random.default_rng([27, list(OUTSIDE).index(name)]))
    where, formula, units = OUTSIDE[name]
    return {
        "name": "unknown_effect",
        "where": [where] if where is not None else drawn["where"],
        "formula": formula,
        "parameters": dict(drawn["parameters"]),
        "units": dict(units),
    }


# ---- the study -------------------------------------------------------------------------------------------------------


POLICY, ENVIRONMENT = "velocity_slip_aware", "WLR-Velocity-v0"
#: Contender -> what it is. The first three need no gap workflow.
CONTENDERS = {
    "none": "no adaptation",
    "truth": "the truth patched in, the copy's numbers too",
    "wide": "retrained once with wider randomisation",
    "ours": "wlr adapt",
    "calibrated": "calibration only, no naming",
}
CHEAP = ("none", "truth", "wide")
LINES_FILE = "adapt.jsonl"
#: s; of the MuJoCo plant behind the emulated robot.
PHYSICS_STEP = 0.002
#: Share of the old policy's error by which the truth must help for a case to count.
HELPS = 0.10
#: Seed of the first episode that is driven for the comparison.
FIRST_SEED = 500_000

Say = Callable[[str], object]


@dataclass(frozen=True)
class AdaptStudyOptions(JsonOption):
    out: Path
    """Folder for results; an interrupted study resumes from it."""
    cases: tuple[str, ...] = ()
    """Names of cases, or how many of them; default: all."""
    contenders: tuple[str, ...] = tuple(CONTENDERS)
    """Some of none, truth, wide, ours, calibrated."""
    quick: bool = False
    """Tiny sizes: shows that it runs; the numbers mean nothing."""


#: How much of each is driven and trained; see :class:`wlr_gym.learning.adaptation.Asked` for all but the first two, which are
#: every contender's episodes and their length (s).
FULL: Mapping[str, Any] = {
    "drives": 24, "seconds": 10.0, "steps": 7_500_000, "episodes": 256,
    "excitations": ["straight", "turns", "stop_and_go", "posture"], "budget_runs": 1,
}  # fmt: skip
QUICK: Mapping[str, Any] = {
    "drives": 2, "seconds": 1.0, "steps": 16_384, "episodes": 8,
    "excitations": ["straight", "turns", "stop_and_go"], "budget_runs": 0,
}  # fmt: skip


@dataclass(frozen=True)
class AdaptStudy:
    """One study: its folder, its cases, who takes part, and its sizes, as in :data:`FULL`."""

    out: Path
    cases: tuple[AdaptCase, ...]
    contenders: tuple[str, ...] = tuple(CONTENDERS)
    sizes: Mapping[str, Any] = field(default_factory=lambda: FULL)

    def asked(self, case: AdaptCase) -> Asked:
        """Return what an adaptation is asked in a case."""
        sizes = dict(self.sizes)
        return Asked(
            policy=POLICY,
            identity=identity(read_subjects([POLICY])[0]),
            environment=ENVIRONMENT,
            robot=robot_hash(load_robot()),
            driven="emulated",
            effects=[dict(one) for one in case.effects],
            backend="mujoco",
            drive_seconds=sizes.pop("seconds"),
            seed=case.copy,
            **sizes,
        )


def run(options: AdaptStudyOptions) -> int:
    """Adapt a policy to robots with hidden faults, and others beside it; print and write the table."""
    for name in options.contenders:
        check_name("contender", name, CONTENDERS)
    sizes = QUICK if options.quick else FULL
    study = AdaptStudy(options.out, chosen_cases(options.cases), options.contenders, sizes)
    lines = run_adapt_study(study, plain_console.print)
    return hand_over(options.out / "adapt.md", markdown(lines), lines, options.json, options.out / LINES_FILE)


def run_adapt_study(study: AdaptStudy, say: Say = print) -> list[dict[str, Any]]:
    """Do what is left of a study, and return all its lines.

    Raises:
        InputError: a folder that cannot be written to, or one of a study of another size.
    """
    make_output_folder(study.out)
    keep_request(study.out / "size.json", study.sizes)
    there = read_lines(study.out / LINES_FILE)
    for case, contender in _order(study, there):
        began = time.monotonic()
        line = _line(study, case, contender)
        line |= {"wall_seconds": round(time.monotonic() - began, 1), "commit": git_commit()}
        with (study.out / LINES_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
        there.append(line)
        error = float(np.mean(line["errors"]))
        say(f"{case.name}, {CONTENDERS[contender]}: tracking error {error:.3f}, {line['wall_seconds']:.0f} s")
    return there


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a study; none without a file."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return [json.loads(line) for line in lines]


def _order(study: AdaptStudy, lines: Sequence[Mapping[str, Any]]) -> Iterator[tuple[AdaptCase, str]]:
    """Yield what is left: cheap contenders of all cases, then the others; ``lines`` grows meanwhile."""
    done = {(one["case"], one["contender"]) for one in lines}

    def left(cases: Iterable[AdaptCase], names: Iterable[str]) -> Iterator[tuple[AdaptCase, str]]:
        return ((case, name) for case in cases for name in names if (case.name, name) not in done)

    yield from left(study.cases, [name for name in CHEAP if name in study.contenders])
    by_use = sorted(study.cases, key=lambda one: -truth_helps(lines, one.name))
    yield from left(by_use, [name for name in study.contenders if name not in CHEAP])


def truth_helps(lines: Sequence[Mapping[str, Any]], case: str) -> float:
    """Return by what share of the old policy's error the truth helps in a case; NaN-free: 0 where it is not known."""
    means = {one["contender"]: float(np.mean(one["errors"])) for one in lines if one["case"] == case}
    return 1.0 - means["truth"] / means["none"] if {"none", "truth"} <= means.keys() else 0.0


# ---- one contender in one case ---------------------------------------------------------------------------------------


def _line(study: AdaptStudy, case: AdaptCase, contender: str) -> dict[str, Any]:
    own, hidden = load_robot(), load_patch([dict(one) for one in case.effects])
    robot = EmulatedRobot(own, hidden, "mujoco", PHYSICS_STEP, case.parameters(own))
    progress = open_folder(study.out / "work" / case.name, study.asked(case), lambda text, share: None, 1)
    progress.save()
    policy, said = POLICY, {}
    if contender == "truth":
        make_output_folder(progress.out / "truth_model")
        randomization, folder = task_randomization(ENVIRONMENT), progress.out / "truth_model"
        policy = _train(progress, "truth", uncertainty_of(exact_result(case, own), hidden, randomization, own, folder).training)
    elif contender == "wide":
        policy = _wide(study, own)
    elif contender == "ours":
        policy, said = _ours(progress, robot, own)
    elif contender == "calibrated":
        policy, said = _calibrated(progress, robot, own)
    seeds = [FIRST_SEED + 1000 * case.copy + k for k in range(study.sizes["drives"])]
    step = f"drives_{'none' if policy == POLICY else contender}"  # the old policy drives every episode once
    driven = episodes_of(progress, step, {"driven": policy}, robot, seeds)["driven"]
    return {
        "case": case.name,
        "kind": case.kind,
        "effects": [dict(one) for one in case.effects],
        "shared_law": case.shared,
        "contender": contender,
        "errors": errors_of(driven).tolist(),
        "stopped": [one.reason for one in driven if not one.whole],
        "driving_seconds": sum(one.seconds for one in driven),
        **said,
    }


def _train(progress: Progress, name: str, family: Family) -> str:
    """Train on from the old policy with a family, in a folder of its own; return the policy."""
    train_in(progress, name, family)
    return str(progress.out / name / "policy")


def exact_result(case: AdaptCase, own: Robot) -> Result:
    """Return what a gap result would say that knew everything."""
    true, nominal = case.parameters(own).values[0], Parameters.nominal(own).values[0]
    differs = np.flatnonzero(true != nominal)
    calibration = {ELEMENTS[k]: {"nominal": float(nominal[k]), "fitted": float(true[k]), "unit": "-"} for k in differs}
    effects = [
        {
            "name": one["name"],
            "where": list(one["where"]),
            "confidence": 1.0,
            "parameters": {name: {"value": value, "ci95": None, "unit": "-"} for name, value in one["parameters"].items()},
        }
        for one in case.effects
    ]
    nothing = {"equivalent": [], "localisation": {}, "gap": None, "runs": {"fit": [], "heldout": []}, "patch": "patch.yaml"}
    return Result.model_validate(nothing | {"verdict": "effect_found", "effects": effects, "calibration": calibration})


def _wide(study: AdaptStudy, own: Robot) -> str:
    """Return the policy that is trained once, with wider randomisation, for all cases."""
    asked = study.asked(study.cases[0]).model_copy(update={"seed": 0})
    progress = Progress(study.out / "work", asked)
    if (progress.out / "wide" / "policy").is_dir():
        return str(progress.out / "wide" / "policy")
    randomization = load_randomization("wide", own).config.model_dump(mode="json", exclude_none=True)
    return _train(progress, "wide", Family("wide", randomization))


def _ours(progress: Progress, robot: EmulatedRobot, own: Robot) -> tuple[str, dict[str, Any]]:
    decided, found = find_uncertainty(progress, robot, own)
    said: dict[str, Any] = {"verdict": "" if decided.result is None else decided.result.verdict}
    said |= {"found": [dict(one.content()) for one in found.patch.effects] if found is not None else []}
    said |= {"ended": decided.history.ended, "recording_seconds": progress.steps["runs"].driving + decided.history.seconds}
    policy, outcome = _trained(progress, found, own)
    return policy, said | outcome


def _calibrated(progress: Progress, robot: EmulatedRobot, own: Robot) -> tuple[str, dict[str, Any]]:
    """Return the policy that is adapted with calibrated numbers alone, from the same runs."""
    decided, _ = find_uncertainty(progress, robot, own)
    if decided.result is None or decided.result.verdict in (BAD_DATA, NOT_EXCITED):
        return POLICY, {"kept": "old"}
    inner = Progress(progress.out / "calibrated", progress.asked, progress.tell)
    result = calibration_alone(decided, progress.out / "runs")
    found = uncertainty_of(result, Patch(), task_randomization(ENVIRONMENT), own, inner.folder("model"))
    return _trained(inner, found, own)


def _trained(progress: Progress, found: Uncertainty | None, own: Robot) -> tuple[str, dict[str, Any]]:
    if found is None:
        return POLICY, {"kept": "old"}
    train_supervised(progress, found, own)
    numbers = accept_policy(progress, found, own).numbers
    return numbers["policy"], {"kept": numbers["kept"], "losses": numbers["losses"]}


def calibration_alone(decided: Decided, data: Path) -> Result:
    """Return a result with the calibration of the same runs without any effect."""
    assert decided.result is not None
    problem, _ = open_robot(data)
    assert problem is not None
    runs = decided.result.runs
    fitted = [k for k, name in enumerate(problem.runs) if name in runs.fit]
    scatter = SCATTER * problem.tempering
    found = widened(fit(nominal_model(problem), fitted, scatter=scatter))
    calibration = {}
    for quantity, value, half in zip(problem.quantities, found.model.quantities, half_widths(found), strict=False):
        interval = [value - half, value + half] if math.isfinite(half) else None
        known = {"nominal": quantity.nominal, "fitted": float(value), "unit": quantity.unit, "sigma": quantity.sigma}
        calibration[quantity.name] = known | {"ci95": interval}
    content = decided.result.model_dump(mode="json")
    content |= {"verdict": "nothing_missing", "effects": [], "evidence": [], "thresholds": [], "calibration": calibration}
    return Result.model_validate(content)


# ---- tables ----------------------------------------------------------------------------------------------------------


Array = NDArray[np.float64]
Line = Mapping[str, Any]
#: case -> contender -> its line.
Table = dict[str, dict[str, Line]]


def by_case(lines: Sequence[Line]) -> Table:
    """Return the lines by case and contender; of repeated ones the last."""
    found: Table = {}
    for line in lines:
        found.setdefault(line["case"], {})[line["contender"]] = line
    return found


def helps(case: Mapping[str, Line]) -> bool | None:
    """Whether the truth helps enough for a case to count; None = not known."""
    if not {"none", "truth"} <= case.keys():
        return None
    return float(_errors(case["truth"]).mean()) <= (1.0 - HELPS) * float(_errors(case["none"]).mean())


def regained(case: Mapping[str, Line], contender: str = "ours") -> Estimate:
    """Return (old - contender) / (old - truth), %, paired over the episodes."""
    return share_regained(*(_errors(case[name]) for name in ("none", contender, "truth")))


def better(case: Mapping[str, Line], ours: str, theirs: str) -> Estimate:
    """Return by how much one contender is better than another, % of the other's, paired over the episodes."""
    return paired(_errors(case[ours]), _errors(case[theirs]))


def markdown(lines: Sequence[Line]) -> str:
    """Return the tables as Markdown."""
    table = by_case(lines)
    header = ["case", "shared law", *CONTENDERS.values(), "found", "kept", "regained (%)", "driven for it (s)", "took (min)"]
    cases = markdown_table(header, [_row(name, case) for name, case in table.items()])
    commits = tally(Counter(line["commit"] for line in lines))
    return "\n".join([f"Contenders driven by commit: {commits}.", "", *cases, "", *summary(table), ""])


def summary(table: Table) -> list[str]:
    """Return what all cases say together, one sentence a line."""
    known = {name: one for name, case in table.items() if (one := helps(case)) is not None}
    counted = [name for name, one in known.items() if one]
    against = sum(better(table[name], "truth", "none").mean < 0.0 for name in known)
    said = [
        f"- The truth makes the policy at least {HELPS:.0%} better in {len(counted)} of {len(known)} cases, worse in {against}."
    ]
    for contender in ("ours", "calibrated"):
        theirs = [name for name in counted if contender in table[name]]
        if theirs:
            shares = np.array([regained(table[name], contender).mean for name in theirs])
            enough = f"at least 50 in {(shares >= 50.0).sum()} of {len(shares)}"
            said.append(
                f"- Regained by '{CONTENDERS[contender]}' in {len(theirs)} of these, %: median {_median(shares)}; {enough}."
            )
    adapted = [name for name, case in table.items() if {"ours", "none"} <= case.keys()]
    if adapted:
        gains = [better(table[name], "ours", "none") for name in adapted]
        worse = [name for name, gain in zip(adapted, gains, strict=True) if gain.high < 0.0]
        median = _median(np.array([gain.mean for gain in gains]))
        said.append(
            f"- Tracking error after adaptation: {median} % smaller (median); beyond the interval smaller in "
            f"{sum(gain.low > 0.0 for gain in gains)} of {len(adapted)}, larger in {len(worse)} ({', '.join(worse) or '-'})."
        )
        kept = sum(table[name]["ours"].get("kept") == "old" for name in adapted)
        said.append(f"- The acceptance test kept the old policy in {kept} of {len(adapted)} cases.")
    for other in ("wide", "calibrated", "none"):
        both = [name for name, case in table.items() if {"ours", other} <= case.keys()]
        if both:
            found = _all(table, both, "ours", other)
            said.append(f"- Ours against '{CONTENDERS[other]}', {len(both)} cases: {_interval(found)} % better.")
    return said


def _median(shares: Array) -> str:
    """Return the median over cases, each with a training of its own, and its exact interval (of the order statistics)."""
    found = quantile_test(shares, p=0.5).confidence_interval()
    few = np.isnan(found.low) or np.isnan(found.high)  # below six cases there is none
    return f"{np.median(shares):.0f}" if few else f"{np.median(shares):.0f} [{found.low:.0f}, {found.high:.0f}]"


def _all(table: Table, names: Sequence[str], ours: str, theirs: str) -> Estimate:
    """Ours against theirs over several cases, each case a block of episodes, in units of its old policy's error."""
    length = min(len(_errors(table[name]["none"])) for name in names)
    blocks = []
    for who in (ours, theirs):
        scaled = [_errors(table[name][who])[:length] / _errors(table[name]["none"]).mean() for name in names]
        blocks.append(np.stack([np.array(scaled), np.ones((len(names), length))], axis=2))
    return Bootstrap(len(names), length).reduction(*blocks)


def _row(name: str, case: Mapping[str, Line]) -> list[str]:
    any_line = next(iter(case.values()))
    errors = [f"{_errors(case[one]).mean():.3f}" if one in case else "" for one in CONTENDERS]
    ours = case.get("ours", {})
    found = ", ".join(dict.fromkeys(one["name"] for one in ours.get("found", []))) or ("nothing" if ours else "")
    share = _interval(regained(case)) if helps(case) and ours else ""
    times = [f"{ours['recording_seconds']:.0f}", f"{ours['wall_seconds'] / 60.0:.1f}"] if "wall_seconds" in ours else ["", ""]
    return [name, "yes" if any_line["shared_law"] else "no", *errors, found, str(ours.get("kept", "")), share, *times]


def _interval(found: Estimate) -> str:
    return f"{found.mean:.0f} [{found.low:.0f}, {found.high:.0f}]"


def _errors(line: Line) -> Array:
    return np.array(line["errors"], np.float64)
