"""Blind test of the gap workflow: data sets with sealed truths, analysed one by one, scored at the end.

The sets come from :mod:`studies.bench.blind`, which shares no code with the workflow. Results of finished sets stay in
the output folder, so an interrupted test goes on where it stopped, and a longer one adds to a shorter one. Each says which
truth and which runs it is about, and which commit made it: results of other data are refused, those of other commits counted.
What the score is made of is also kept in one small file, from which a test goes on in another folder or on another machine.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import operator
import os
import shutil
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml

from studies.bench.blind.cases import (
    FIRST_SCORED_SEED,
    FIRST_TYRE_SEED,
    FURTHER_NULLS,
    SETS,
    TYRE_SETS,
    BlindCase,
    case,
    tyre_case,
)
from studies.bench.blind.score import FAILED, score
from studies.tables import hand_over, markdown_table, plain_console
from wlr_gym.base.errors import InputError, Interval
from wlr_gym.base.files import make_output_folder, write_json, write_text
from wlr_gym.base.jobs import Job, Send, serve, spread
from wlr_gym.base.paths import data_directory
from wlr_gym.base.provenance import git_commit
from wlr_gym.base.text import duration, tally
from wlr_gym.cli.options import JsonOption, ray_address

#: Folder of a data set, folder for the analysis' files -> contents of result.json.
Analyser = Callable[[Path, Path], Mapping[str, Any]]
#: Of a result: what the score is made of.
_ANSWER = ("verdict", "message", "effects", "equivalent", "gap", "wall_seconds", "blind_test")
#: Sets of a whole test.
ALL_SETS = SETS + FURTHER_NULLS


@dataclass(frozen=True)
class Plan:
    """A blind test.

    Attributes:
        out: folder for data, results, truths and the score.
        sets: how many data sets.
        processes: how many of them at a time.
        first_seed: of the first set; the others follow. From :data:`FIRST_TYRE_SEED` on they are those about tyres.
        keep_data: leave the data sets there (3 MB each); they can be made again from their seeds.
        runs: which of the eight kinds of runs every set has; empty = its own.
    """

    out: Path
    sets: int
    processes: int = 2
    first_seed: int = FIRST_SCORED_SEED
    keep_data: bool = False
    runs: tuple[int, ...] = ()

    def cases(self) -> list[BlindCase]:
        """Return the data sets, in the order they are analysed: the further nulls spread among the others."""
        cases = [self.case(index) for index in range(self.sets)]
        if self.first_seed >= FIRST_TYRE_SEED:
            return cases
        turns = [index / SETS if index < SETS else (index - SETS) / FURTHER_NULLS for index in range(self.sets)]
        return [one for _, one in sorted(zip(turns, cases, strict=True), key=lambda pair: pair[0])]

    def case(self, index: int) -> BlindCase:
        """Return data set number ``index``."""
        return (tyre_case if self.first_seed >= FIRST_TYRE_SEED else case)(index, self.first_seed)

    def result_file(self, one: BlindCase) -> Path:
        """Return where the result of a set is kept."""
        return self.out / "results" / f"{one.name}.json"

    def log_file(self, one: BlindCase) -> Path:
        """Return where the output of a set's process goes; it stays where the analysis failed."""
        return self.out / "work" / f"{one.name}.log"


@dataclass(frozen=True)
class BlindTestOptions(JsonOption):
    out: Path
    """Folder for data sets, results, truths and the score; an interrupted test resumes from it."""
    sets: Annotated[int, Interval(least=1)] | None = None
    """Data sets; left out: 400, of which 240 are of all kinds and 160 more without an effect; of those about tyres 90."""
    tyres: bool = False
    """Sets about tyres instead: elastic treads, and two of three without an effect, on a floor with bumps of 0.1 mm."""
    processes: Annotated[int, Interval(least=1)] = 2
    """Data sets at a time."""
    ray: tuple[str, ...] | None = None
    """Run on Ray: alone, it is started on this machine; with an address (auto, 10.0.0.1:6379), that cluster is used."""
    answers: Path | None = None
    """answers.json of another folder; its sets are not analysed again, but for those that failed."""


def run(options: BlindTestOptions) -> int:
    """Test the gap workflow on data sets with hidden truths; print and write its score."""
    first, sets = (FIRST_TYRE_SEED, TYRE_SETS) if options.tyres else (FIRST_SCORED_SEED, ALL_SETS)
    out, plan = options.out, Plan(options.out, options.sets or sets, options.processes, first)
    report = run_blind_test(plan, say=plain_console.print, answers=options.answers, ray=ray_address(options.ray))
    return hand_over(out / "score.md", markdown(report), report, options.json, out / "score.json", out / "answers.json")


def analyse_folder(folder: Path, out: Path) -> Mapping[str, Any]:
    """Run the gap workflow on a folder; return its result file. The report with its pictures is not drawn."""
    from wlr_gym.gap.report.result import write_result
    from wlr_gym.gap.workflow import analyse

    make_output_folder(out)
    done = analyse(folder, threads=1)
    return read_result(write_result(done, out))


def run_blind_test(
    plan: Plan,
    analyser: str = "studies.bench.gap:analyse_folder",
    say: Callable[[str], object] = print,
    answers: Path | None = None,
    ray: str | None = None,
) -> dict[str, Any]:
    """Make the data sets, analyse them, score them.

    Args:
        plan: what to do.
        analyser: what is tested, as ``module:function`` that other processes can import.
        say: shown progress.
        answers: ``answers.json`` of another folder, whose sets are not analysed again, but for those that failed.
        ray: None = processes of this machine; ``local`` = a Ray that is started here; otherwise the address of a cluster whose
            nodes share ``plan.out``.

    Returns:
        The score, as in ``score.json``.

    Raises:
        InputError: the output folder cannot be written to; it, or ``answers``, holds results or truths of another test.
    """
    cases = plan.cases()
    earlier = {}
    if answers is not None:
        found = read_answers(answers)
        for one in (one for one in cases if one.name in found):
            _check_origin(plan, one, found[one.name], answers, "leave out --answers")
            if found[one.name]["verdict"] != FAILED:  # the reason may be the other machine's
                earlier[one.name] = found[one.name]
    for name in ("", "results", "data", "sealed", "work"):
        make_output_folder(plan.out / name)
    say(f"truths sealed in {plan.out / 'sealed'}: sha256 {seal(plan, cases)}")
    for one in cases:
        if one.name in earlier and not plan.result_file(one).is_file():
            write_json(plan.result_file(one), earlier[one.name])
    there = _kept(plan, cases)
    left = [one for one in cases if one.name not in there]
    if len(left) < len(cases):
        say(f"{len(cases) - len(left)} of {len(cases)} results are there already")
    _run(plan, left, analyser, say, ray)
    report = score(_kept(plan, cases), {one.name: one.as_dict() for one in cases})
    write_json(plan.out / "score.json", report)
    write_answers(plan.out)
    return report


def write_answers(out: Path) -> None:
    """Write what the score is made of, of all results in a test's folder, to ``answers.json`` there: a line per set."""
    results = {file.stem: read_result(file) for file in sorted((out / "results").glob("*.json"))}
    short = {name: {key: result[key] for key in _ANSWER if key in result} for name, result in results.items()}
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(answer)}" for name, answer in short.items())
    write_text(out / "answers.json", f"{{\n{lines}\n}}\n")


def read_answers(path: Path) -> dict[str, dict[str, Any]]:
    """Read what was found in each set, by its name.

    Raises:
        InputError: no such file, or it holds no answers.
    """
    try:
        answers = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as answers of a blind test: {error}") from error
    if not isinstance(answers, dict):
        raise InputError(f"{path}: expected a mapping of sets to answers")

    def has(value: Any, *keys: str) -> bool:
        return isinstance(value, dict) and set(keys) <= value.keys()

    for name, answer in answers.items():
        if not has(answer) or not isinstance(answer.get("verdict"), str):
            raise InputError(f"{path}: {name}: expected a mapping with a verdict")
        effects = answer.get("effects", [])
        if not isinstance(effects, list) or not all(has(one, "name", "parameters") for one in effects):
            raise InputError(f"{path}: {name}: effects: expected a list of mappings with name and parameters")
        if not has(answer.get("blind_test"), "truth_sha256", "runs"):
            raise InputError(f"{path}: {name}: blind_test: expected a mapping with truth_sha256 and runs")
    return answers


def score_answers(path: Path) -> dict[str, Any]:
    """Score the ``answers.json`` of one test, whole or begun; nothing is analysed. Its first seed is its smallest.

    Raises:
        InputError: no answers, or one is about another truth or other runs than the set of its name now.
    """
    answers = read_answers(path)
    seeds = [int(name.removeprefix("set_")) for name in answers]
    plan = Plan(Path(), sets=max(seeds) - min(seeds) + 1, first_seed=min(seeds))
    cases = [one for one in plan.cases() if one.name in answers]
    for one in cases:
        _check_origin(plan, one, answers[one.name], path, "run the test again")
    return score(answers, {one.name: one.as_dict() for one in cases})


def seal(plan: Plan, cases: Sequence[BlindCase]) -> str:
    """Write the truths to a file of their own, away from the data, and return its SHA-256.

    Raises:
        InputError: a seal that is there already, of a shorter or longer test, holds other truths of the same sets.
    """
    truths, folder = {one.name: _plain(one.as_dict()) for one in cases}, plan.out / "sealed"
    for file in sorted(folder.glob("truths_*.yaml")):
        try:
            sealed = yaml.safe_load(file.read_text(encoding="utf-8"))
        except (yaml.YAMLError, UnicodeDecodeError):
            sealed = None
        if not isinstance(sealed, dict):
            raise InputError(f"{file}: holds no truths; use another --out")
        if other := sorted(name for name in sealed.keys() & truths.keys() if sealed[name] != truths[name]):
            what = f"holds other truths than these seeds give now ({len(other)} sets, first {other[0]})"
            raise InputError(f"{file}: {what}; use another --out")
    text = yaml.safe_dump(truths, sort_keys=True)
    file = folder / f"truths_{plan.first_seed}_{plan.sets}.yaml"
    write_text(file, text)
    return hashlib.sha256(text.encode()).hexdigest()


def _origin(plan: Plan, one: BlindCase) -> dict[str, Any]:
    """Return what a result is about, and the commit of the code that makes it."""
    return {"commit": git_commit(), **_subject(plan, one)}


def _subject(plan: Plan, one: BlindCase) -> dict[str, Any]:
    truth = json.dumps(_plain(one.as_dict()), sort_keys=True)
    runs, camera = list(plan.runs or one.runs), one.camera
    return {"truth_sha256": hashlib.sha256(truth.encode()).hexdigest(), "runs": runs, "camera": camera}


def _kept(plan: Plan, cases: Sequence[BlindCase]) -> dict[str, dict[str, Any]]:
    """Read the results that are there.

    Raises:
        InputError: one is about another truth or other runs than the set of its name now.
    """
    found = {}
    for one in cases:
        file = plan.result_file(one)
        if file.is_file():
            found[one.name] = read_result(file)
            _check_origin(plan, one, found[one.name], file, "use another --out, or delete the file to analyse the set again")
    return found


def _check_origin(plan: Plan, one: BlindCase, result: Mapping[str, Any], file: Path, advice: str) -> None:
    """Refuse a result of other data; results that do not say what they are about are taken as they are."""
    made, now = result.get("blind_test") or {}, _subject(plan, one)
    for key, what in (("truth_sha256", "another hidden truth"), ("runs", "other runs"), ("camera", "other sensors")):
        if key in made and made[key] != now[key]:
            raise InputError(f"{file}: is about {what} ({made[key]}) than set {one.name} has now ({now[key]}); {advice}")


def _plain(value: Any) -> Any:
    return json.loads(json.dumps(value))


def read_result(path: Path) -> dict[str, Any]:
    """Read the result of one set."""
    return json.loads(path.read_text(encoding="utf-8"))


def _run(plan: Plan, cases: Sequence[BlindCase], analyser: str, say: Callable[[str], object], ray: str | None) -> None:
    """Work through the sets, each in a process of its own, and say after each how long the rest will take."""
    begin, jobs = time.monotonic(), []
    for one in cases:
        task = {**vars(plan), "out": str(plan.out.resolve()), "index": one.seed - plan.first_seed, "analyser": analyser}
        plan.log_file(one).unlink(missing_ok=True)
        jobs.append(Job(one.name, "studies.bench.gap", task, str(plan.log_file(one).resolve())))
    with ExitStack() as stack:
        if ray is None:
            ended = spread(jobs, plan.processes)
        else:
            from wlr_gym.learning.sweep.ray import LOCAL, connected, spread_on_ray

            stack.enter_context(connected(ray, plan.processes if ray == LOCAL else None))
            ended = spread_on_ray(jobs, plan.processes)
        named = {one.name: one for one in cases}
        for done, end in enumerate(ended, 1):
            one = named[end.name]
            file, message = plan.result_file(one), _without(plan.out, end.error)
            if not file.is_file():  # its process died
                write_json(file, {"verdict": FAILED, "message": message, "blind_test": _origin(plan, one)})
            result, passed = read_result(file), time.monotonic() - begin
            if result["verdict"] != FAILED:
                plan.log_file(one).unlink(missing_ok=True)
            write_answers(plan.out)
            said = f"{one.name}: {result['verdict']}, {result.get('wall_seconds', 0):.0f} s"
            rest = passed / done * (len(cases) - done)
            say(f"{done}/{len(cases)}  {said}  {duration(passed)} passed, about {duration(rest)} to go")


def _work(task: Mapping[str, Any], send: Send) -> None:
    """Do one set, in a process of its own."""
    module, _, function = task["analyser"].partition(":")
    fields = {name: value for name, value in task.items() if name not in ("index", "analyser")}
    plan = Plan(**{**fields, "out": Path(task["out"]), "runs": tuple(task["runs"])})
    run_case(plan, plan.case(task["index"]), getattr(importlib.import_module(module), function))


def run_case(plan: Plan, one: BlindCase, analyser: Analyser) -> None:
    """Make one set, analyse it, keep the result.

    Whatever the analysis raises is its answer: an :class:`InputError` refuses the data, anything else is a failure.
    """
    folder, out, origin = plan.out / "data" / one.name, plan.out / "work" / one.name, _origin(plan, one)
    origin["data_sha256"] = make_data(folder, one, plan.runs)
    begin = time.monotonic()
    try:
        result: dict[str, Any] = dict(analyser(folder, out))
    except InputError as error:
        result = {"verdict": "refused", "message": _without(plan.out, str(error)), "traceback": traceback.format_exc()}
    except Exception as error:
        message = _without(plan.out, f"{type(error).__name__}: {error}")
        result = {"verdict": FAILED, "message": message, "traceback": traceback.format_exc()}
    result |= {"wall_seconds": time.monotonic() - begin, "blind_test": origin}
    write_json(plan.result_file(one), _plain(result))
    if not plan.keep_data:
        shutil.rmtree(folder)
    shutil.rmtree(out, ignore_errors=True)


def _without(out: Path, text: str) -> str:
    """A message without the test's own folder: answers go from machine to machine."""
    return text.replace(f"{out}{os.sep}", "")


def make_data(folder: Path, one: BlindCase, runs: Sequence[int] = ()) -> str:
    """Simulate one data set with its own runs, or with ``runs``, and write it; return the hash of its data."""
    import numpy as np

    from studies.bench.blind.copies import read_robot
    from studies.bench.blind.dataset import fingerprint, simulate_runs, spoilt, write

    robot = read_robot(data_directory("configs") / "robot" / "nominal.yaml")
    tables, meta, _ = simulate_runs(
        robot, one.effects, one.seed, runs or one.runs, one.kind == "none", True, one.camera, one.bumps
    )
    if one.spoilt:
        tables = spoilt(one.spoilt, tables, np.random.default_rng([one.seed, 5]))
    shutil.rmtree(folder, ignore_errors=True)
    write(folder, tables, meta)
    return fingerprint(tables)


# ---- the score as a table --------------------------------------------------------------------------------------------


#: Whether a target is reached: ``not shown`` is a value that reaches it with a 95 % bound that does not; empty: no target.
Met = Literal["yes", "no", "not shown", ""]
#: On which side of a number its 95 % bound lies, and its target: that of good things "at least".
Side = Literal["at least", "at most"]


@dataclass(frozen=True)
class ScoreLine:
    """One line of the report: a number beside its target."""

    what: str
    value: str
    target: str = ""
    met: Met = ""


def lines(report: Mapping[str, Any]) -> list[ScoreLine]:
    """Return the numbers that the workflow is judged by, in the order of the targets."""
    alarms, single, pairs, outside = report["false_alarms"], report["single"], report["pairs"], report["outside"]
    left, size, sure = report["left"], single["mean_set_size"], single["confidence"]
    mean_size = ScoreLine("mean size of that set, where found", "-", "<= 1.5")
    if size is not None:
        mean_size = replace(mean_size, value=f"{size:.3g}", met="yes" if size <= 1.5 else "no")
    confidence = f"{sure['mean_confidence']:.2f}, right {sure['right']:.2f} of {sure['count']}" if sure["count"] else "-"
    return [
        judged("false alarms, nominal robot", alarms["none"], "at most"),
        judged("false alarms, parameters only", alarms["parameters"], "at most"),
        judged("false alarms, all", alarms["all"], "at most", 0.02),
        judged("right name first, severity >= 2", single["top1"], "at least", 0.95),
        judged("right name first, severity 1", single["top1_at_one"], "at least", 0.80),
        judged("truth in the equivalence set", single["in_set"], "at least", 0.95),
        mean_size,
        judged("a further name beside the right one", single["extra_name"], "at most"),
        ScoreLine("mean confidence of the first name", confidence),
        judged("right place, where named", single["place"], "at least", 0.98),
        judged("both of a pair named", pairs["both"], "at least", 0.85),
        judged("both of a pair and nothing else", pairs["exact"], "at least"),
        judged("median error of size", single["size_error"], "at most", 0.03),
        judged("median error of place or form", single["shape_error"], "at most"),
        judged("order of a ripple", single["order"], "at least"),
        coverage(single["interval_coverage"]),
        judged("median gap reduction, where found", single["gap_reduction"], "at least", 0.9),
        judged("median gap reduction, misses as 0", single["gap_reduction_of_all"], "at least", 0.9),
        judged("median error left, noise floors: named rightly, severity >= 2", left["named"], "at most"),
        judged("median error left, noise floors: nothing hidden", left["nothing hidden"], "at most"),
        never("gap grew, interval below 0", single["gap_grew_surely"]),
        never("gap grew by more than 2 %", single["gap_grew"]),
        judged("outside the library: formula or unknown, no name", outside["unknown"], "at least", 0.95),
        judged("outside the library: not misnamed", outside["not_misnamed"], "at least"),
        judged("bad data caught", report["bad_data"], "at least", 1.0),
        never("good data refused", alarms["refused_good_data"]),
        never("analyses that crashed", report["crashed"]),
    ]


def judged(what: str, numbers: Mapping[str, Any], side: Side, target: float | None = None) -> ScoreLine:
    """Hold a share, or a median, and its 95 % bound against a target."""
    is_share = "share" in numbers
    found = numbers["share" if is_share else "median"]
    bound = numbers["bound95" if is_share else {"at least": "at_least95", "at most": "at_most95"}[side]]
    reaches, sign = (operator.ge, ">=") if side == "at least" else (operator.le, "<=")
    form = ".0%" if is_share else "g"
    goal = "" if target is None else f"{sign} {target:{form}}"
    if not numbers["count"]:
        return ScoreLine(what, "-", goal)
    if is_share:
        value = _share(numbers, side)
    else:
        value = f"{found:.3g} of {numbers['count']} ({'no bound' if bound is None else f'{side} {bound:.3g}'})"
    if target is None:
        return ScoreLine(what, value)
    shown = bound is not None and reaches(bound, target)
    return ScoreLine(what, value, goal, "no" if not reaches(found, target) else "yes" if shown else "not shown")


def never(what: str, share: Mapping[str, Any]) -> ScoreLine:
    """Something that must not happen in any of these sets: no bound could show that it never does."""
    met: Met = "" if not share["count"] else "no" if share["hits"] else "yes"
    return ScoreLine(what, _share(share, "at most"), "0", met)


def coverage(share: Mapping[str, Any]) -> ScoreLine:
    """Intervals may be too narrow or too wide."""
    met: Met = ""
    if share["count"]:
        shown = share["bound95"] >= 0.92 and share["bound95_above"] <= 0.98
        met = "no" if not 0.92 <= share["share"] <= 0.98 else "yes" if shown else "not shown"
    return ScoreLine("95 % intervals that hold", _share(share, "at least"), "92-98 %", met)


def _share(share: Mapping[str, Any], side: Side) -> str:
    if not share["count"]:
        return "-"
    return f"{share['hits']}/{share['count']} = {share['share']:.0%} ({side} {share['bound95']:.0%})"


def markdown(report: Mapping[str, Any]) -> str:
    """Return the report as Markdown tables: numbers beside targets, severities, confusion matrix."""
    judgements = [(line.what, line.value, line.target, line.met) for line in lines(report) if line.value != "-"]
    severities = [
        (severity, shares["found"]["count"], *(f"{shares[key]['share']:.0%}" for key in ("found", "top1", "in_set")))
        for severity, shares in report["single"]["by_severity"].items()
    ]
    recorded = [
        (kind, _share(shares["alarms"], "at most"), _share(shares["top1"], "at least"))
        for kind, shares in report["by_recording"].items()
    ]
    confusion = []
    for hidden, said in sorted(report["confusion"].items()):
        ordered = sorted(said.items(), key=lambda item: (item[0] != hidden, -item[1], item[0]))
        confusion.append((hidden, tally(dict(ordered))))
    parts = [
        [f"Sets analysed by commit: {tally(report['commits'])}."],
        markdown_table(("", "measured (95 % bound)", "target", "met"), judgements),
        markdown_table(("severity", "sets", "found", "right name first", "in the set"), severities),
        markdown_table(("recorded", "false alarms", "right name first, severity >= 2"), recorded),
        ["Single effects from severity 1 on; in brackets laws outside the library:"],
        markdown_table(("hidden", "what the results say"), confusion),
    ]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


if __name__ == "__main__":
    serve(_work)
