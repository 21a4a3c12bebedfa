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
import os
import shutil
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from rich.console import Console

from studies.bench.blind.cases import FIRST_SCORED_SEED, FURTHER_NULLS, SETS, BlindCase, case
from studies.bench.blind.score import FAILED, score
from wlr_gym.base.errors import InputError, Interval
from wlr_gym.base.files import make_output_folder, write_json, write_text
from wlr_gym.base.jobs import Ended, Job, Send, serve, spread
from wlr_gym.base.paths import data_directory
from wlr_gym.base.provenance import git_commit
from wlr_gym.base.text import duration, tally
from wlr_gym.cli import OK
from wlr_gym.cli.options import JsonOption, ray_address
from wlr_gym.cli.terminal import print_json

#: Folder of a data set, folder for the analysis' files -> contents of result.json.
Analyser = Callable[[Path, Path], Mapping[str, Any]]
#: Of a result: what the score is made of.
_ANSWER = ("verdict", "message", "effects", "equivalent", "gap", "wall_seconds", "blind_test")
_MODULE = "studies.bench.gap"
#: Sets of a whole test.
ALL_SETS = SETS + FURTHER_NULLS


@dataclass(frozen=True)
class Plan:
    """A blind test.

    Attributes:
        out: folder for data, results, truths and the score.
        sets: how many data sets.
        processes: how many of them at a time.
        first_seed: of the first set; the others follow.
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
        cases = [case(index, self.first_seed) for index in range(self.sets)]
        return sorted(cases, key=self._turn)

    def _turn(self, one: BlindCase) -> float:
        index = one.seed - self.first_seed
        return index / SETS if index < SETS else (index - SETS) / FURTHER_NULLS

    def result_file(self, one: BlindCase) -> Path:
        """Return where the result of a set is kept."""
        return self.out / "results" / f"{one.name}.json"


@dataclass(frozen=True)
class BlindTestOptions(JsonOption):
    out: Path
    """Folder for data sets, results, truths and the score; an interrupted test resumes from it."""
    sets: Annotated[int, Interval(least=1)] = ALL_SETS
    """Data sets; the default has 240 of all kinds and 160 more without an effect."""
    processes: Annotated[int, Interval(least=1)] = 2
    """Data sets at a time."""
    ray: tuple[str, ...] | None = None
    """Run on Ray: alone, it is started on this machine; with an address (auto, 10.0.0.1:6379), that cluster is used."""
    answers: Path | None = None
    """answers.json of another folder; its sets are not analysed again, but for those that failed."""


def run(options: BlindTestOptions) -> int:
    """Test the gap workflow on data sets with hidden truths; print and write its score."""
    say = Console(soft_wrap=True, markup=False, highlight=False).print
    plan = Plan(options.out, options.sets, options.processes)
    report = run_blind_test(plan, say=say, answers=options.answers, ray=ray_address(options.ray))
    text = markdown(report)
    write_text(options.out / "score.md", text)
    say(text)
    if options.json:
        print_json(report)
    say(f"written: {', '.join(str(options.out / name) for name in ('score.json', 'score.md', 'answers.json'))}")
    return OK


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
    say: Callable[[str], None] = print,
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
    earlier = {} if answers is None else _answers_to(plan, cases, answers)
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
    for name, answer in answers.items():
        _check_answer(f"{path}: {name}", answer)
    return answers


def _check_answer(place: str, answer: Any) -> None:
    if not isinstance(answer, dict) or not isinstance(answer.get("verdict"), str):
        raise InputError(f"{place}: expected a mapping with a verdict")
    effects = answer.get("effects", [])
    if not isinstance(effects, list) or not all(isinstance(e, dict) and {"name", "parameters"} <= e.keys() for e in effects):
        raise InputError(f"{place}: effects: expected a list of mappings with name and parameters")
    made = answer.get("blind_test")
    if not isinstance(made, dict) or not {"truth_sha256", "runs"} <= made.keys():
        raise InputError(f"{place}: blind_test: expected a mapping with truth_sha256 and runs")


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


def _answers_to(plan: Plan, cases: Sequence[BlindCase], path: Path) -> dict[str, dict[str, Any]]:
    """Read the answers to sets of a plan; those that failed are to be analysed again.

    Raises:
        InputError: no answers, or one is about another truth or other runs than the set of its name now.
    """
    answers = read_answers(path)
    asked = [one for one in cases if one.name in answers]
    for one in asked:
        _check_origin(plan, one, answers[one.name], path, "leave out --answers")
    return {one.name: answers[one.name] for one in asked if answers[one.name]["verdict"] != FAILED}


def seal(plan: Plan, cases: Sequence[BlindCase]) -> str:
    """Write the truths to a file of their own, away from the data, and return its SHA-256.

    Raises:
        InputError: a seal that is there already, of a shorter or longer test, holds other truths of the same sets.
    """
    truths, folder = {one.name: _plain(one.as_dict()) for one in cases}, plan.out / "sealed"
    for file in sorted(folder.glob("truths_*.yaml")):
        _check_seal(file, truths)
    text = yaml.safe_dump(truths, sort_keys=True)
    file = folder / f"truths_{plan.first_seed}_{plan.sets}.yaml"
    write_text(file, text)
    return hashlib.sha256(text.encode()).hexdigest()


def _check_seal(file: Path, truths: Mapping[str, Any]) -> None:
    try:
        sealed = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError):
        sealed = None
    if not isinstance(sealed, dict):
        raise InputError(f"{file}: holds no truths; use another --out")
    other = sorted(name for name in sealed.keys() & truths.keys() if sealed[name] != truths[name])
    if other:
        raise InputError(
            f"{file}: holds other truths than these seeds give now ({len(other)} sets, first {other[0]}); use another --out"
        )


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
        if plan.result_file(one).is_file():
            found[one.name] = read_result(plan.result_file(one))
            advice = "use another --out, or delete the file to analyse the set again"
            _check_origin(plan, one, found[one.name], plan.result_file(one), advice)
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


def _run(plan: Plan, cases: Sequence[BlindCase], analyser: str, say: Callable[[str], None], ray: str | None) -> None:
    """Work through the sets, in processes of their own, and say after each how long the rest will take."""
    begin, named = time.monotonic(), {one.name: one for one in cases}
    jobs = [_job(plan, one, analyser) for one in cases]
    with _spreading(plan, ray) as spread_out:
        for done, ended in enumerate(spread_out(jobs), 1):
            passed = time.monotonic() - begin
            rest = passed / done * (len(cases) - done)
            line = _outcome(plan, named[ended.name], ended.error)
            write_answers(plan.out)
            say(f"{done}/{len(cases)}  {line}  {duration(passed)} passed, about {duration(rest)} to go")


@contextmanager
def _spreading(plan: Plan, ray: str | None) -> Iterator[Callable[[Sequence[Job]], Iterator[Ended]]]:
    """Yield what runs jobs: processes of this machine, or a Ray cluster."""
    if ray is None:
        yield lambda jobs: spread(jobs, plan.processes)
        return
    from wlr_gym.learning.sweep.ray import LOCAL, connected, spread_on_ray

    with connected(ray, plan.processes if ray == LOCAL else None):
        yield lambda jobs: spread_on_ray(jobs, plan.processes)


def _job(plan: Plan, one: BlindCase, analyser: str) -> Job:
    """Return the job of one set: what it breaks or leaks is gone with its process, and it can be stopped."""
    task = {**vars(plan), "out": str(plan.out.resolve()), "index": one.seed - plan.first_seed, "analyser": analyser}
    _log_file(plan, one).unlink(missing_ok=True)
    return Job(one.name, _MODULE, task, str(_log_file(plan, one).resolve()))


def _log_file(plan: Plan, one: BlindCase) -> Path:
    return plan.out / "work" / f"{one.name}.log"


def _outcome(plan: Plan, one: BlindCase, error: str) -> str:
    """Say how a set went; a process that died without a result has failed."""
    file, log = plan.result_file(one), _log_file(plan, one)
    if not file.is_file():
        write_json(file, {"verdict": "failed", "message": _without(plan.out, error), "blind_test": _origin(plan, one)})
    result = read_result(file)
    if result["verdict"] != "failed":
        log.unlink(missing_ok=True)
    return f"{one.name}: {result['verdict']}, {result.get('wall_seconds', 0):.0f} s"


def _work(task: Mapping[str, Any], send: Send) -> None:
    """Do one set, in a process of its own."""
    module, _, function = task["analyser"].partition(":")
    fields = {name: value for name, value in task.items() if name not in ("index", "analyser")}
    plan = Plan(**{**fields, "out": Path(task["out"]), "runs": tuple(task["runs"])})
    run_case(plan, case(task["index"], plan.first_seed), getattr(importlib.import_module(module), function))


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
        result = {"verdict": "failed", "message": message, "traceback": traceback.format_exc()}
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
    from studies.bench.blind.dataset import SPOIL, fingerprint, simulate_runs, write

    robot = read_robot(data_directory("configs") / "robot" / "nominal.yaml")
    tables, meta, _ = simulate_runs(robot, one.effects, one.seed, runs or one.runs, one.kind == "none", True, one.camera)
    if one.spoilt:
        tables = SPOIL[one.spoilt](tables, np.random.default_rng([one.seed, 5]))
    shutil.rmtree(folder, ignore_errors=True)
    write(folder, tables, meta)
    return fingerprint(tables)


# ---- the score as a table --------------------------------------------------------------------------------------------


#: Whether a target is reached: ``not shown`` is a value that reaches it with a 95 % bound that does not; empty: no target.
Met = Literal["yes", "no", "not shown", ""]


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
    return [
        _at_most("false alarms, nominal robot", alarms["none"]),
        _at_most("false alarms, parameters only", alarms["parameters"]),
        _at_most("false alarms, all", alarms["all"], 0.02),
        _at_least("right name first, severity >= 2", single["top1"], 0.95),
        _at_least("right name first, severity 1", single["top1_at_one"], 0.80),
        _at_least("truth in the equivalence set", single["in_set"], 0.95),
        _set_size(single["mean_set_size"]),
        _at_most("a further name beside the right one", single["extra_name"]),
        _confidence(single["confidence"]),
        _at_least("right place, where named", single["place"], 0.98),
        _at_least("both of a pair named", pairs["both"], 0.85),
        _at_least("both of a pair and nothing else", pairs["exact"]),
        _median("median error of size", single["size_error"], most=0.03),
        _median("median error of place or form", single["shape_error"]),
        _at_least("order of a ripple", single["order"]),
        _coverage(single["interval_coverage"]),
        _median("median gap reduction, where found", single["gap_reduction"], least=0.9),
        _median("median gap reduction, misses as 0", single["gap_reduction_of_all"], least=0.9),
        _median("median error left, noise floors: named rightly, severity >= 2", report["left"]["named"]),
        _median("median error left, noise floors: nothing hidden", report["left"]["nothing hidden"]),
        _none("gap grew, interval below 0", single["gap_grew_surely"]),
        _none("gap grew by more than 2 %", single["gap_grew"]),
        _at_least("outside the library: formula or unknown, no name", outside["unknown"], 0.95),
        _at_least("outside the library: not misnamed", outside["not_misnamed"]),
        _at_least("bad data caught", report["bad_data"], 1.0),
        _none("good data refused", alarms["refused_good_data"]),
        _none("analyses that crashed", report["crashed"]),
    ]


def _met(reached: bool, shown: bool) -> Met:
    return ("yes" if shown else "not shown") if reached else "no"


def _share(share: Mapping[str, Any], bound: str) -> str:
    if not share["count"]:
        return "-"
    return f"{share['hits']}/{share['count']} = {share['share']:.0%} ({bound} {share['bound95']:.0%})"


def _at_least(what: str, share: Mapping[str, Any], target: float | None = None) -> ScoreLine:
    value = _share(share, "at least")
    if target is None:
        return ScoreLine(what, value)
    met = _met(share["share"] >= target, share["bound95"] >= target) if share["count"] else ""
    return ScoreLine(what, value, f">= {target:.0%}", met)


def _at_most(what: str, share: Mapping[str, Any], target: float | None = None) -> ScoreLine:
    value = _share(share, "at most")
    if target is None:
        return ScoreLine(what, value)
    met = _met(share["share"] <= target, share["bound95"] <= target) if share["count"] else ""
    return ScoreLine(what, value, f"<= {target:.0%}", met)


def _none(what: str, share: Mapping[str, Any]) -> ScoreLine:
    """Something that must not happen in any of these sets: no bound could show that it never does."""
    return ScoreLine(what, _share(share, "at most"), "0", _met(not share["hits"], True) if share["count"] else "")


def _coverage(coverage: Mapping[str, Any]) -> ScoreLine:
    """Intervals may be too narrow or too wide."""
    line = _at_least("95 % intervals that hold", coverage)
    if not coverage["count"]:
        return ScoreLine(line.what, line.value, "92-98 %")
    shown = coverage["bound95"] >= 0.92 and coverage["bound95_above"] <= 0.98
    return ScoreLine(line.what, line.value, "92-98 %", _met(0.92 <= coverage["share"] <= 0.98, shown))


def _median(what: str, numbers: Mapping[str, Any], most: float | None = None, least: float | None = None) -> ScoreLine:
    target = f"<= {most:g}" if most is not None else f">= {least:g}" if least is not None else ""
    if not numbers["count"]:
        return ScoreLine(what, "-", target)
    word, bound = ("at least", numbers["at_least95"]) if least is not None else ("at most", numbers["at_most95"])
    value = f"{numbers['median']:.3g} of {numbers['count']} ({'no bound' if bound is None else f'{word} {bound:.3g}'})"
    if most is not None:
        return ScoreLine(what, value, target, _met(numbers["median"] <= most, bound is not None and bound <= most))
    if least is not None:
        return ScoreLine(what, value, target, _met(numbers["median"] >= least, bound is not None and bound >= least))
    return ScoreLine(what, value)


def _set_size(size: float | None) -> ScoreLine:
    what, target = "mean size of that set, where found", "<= 1.5"
    return ScoreLine(what, "-", target) if size is None else ScoreLine(what, f"{size:.3g}", target, _met(size <= 1.5, True))


def _confidence(numbers: Mapping[str, Any]) -> ScoreLine:
    value = f"{numbers['mean_confidence']:.2f}, right {numbers['right']:.2f} of {numbers['count']}" if numbers["count"] else "-"
    return ScoreLine("mean confidence of the first name", value)


def markdown(report: Mapping[str, Any]) -> str:
    """Return the report as Markdown tables: numbers beside targets, severities, confusion matrix."""
    rows = [f"Sets analysed by commit: {tally(report['commits'])}.", ""]
    rows += ["| | measured (95 % bound) | target | met |", "|---|---|---|---|"]
    rows += [f"| {line.what} | {line.value} | {line.target} | {line.met} |" for line in lines(report)]
    rows += ["", "| severity | sets | found | right name first | in the set |", "|---|---|---|---|---|"]
    for severity, shares in report["single"]["by_severity"].items():
        cells = [f"{shares[key]['share']:.0%}" for key in ("found", "top1", "in_set")]
        rows.append(f"| {severity} | {shares['found']['count']} | {' | '.join(cells)} |")
    rows += ["", "| recorded | false alarms | right name first, severity >= 2 |", "|---|---|---|"]
    for recorded, shares in report["by_recording"].items():
        rows.append(f"| {recorded} | {_share(shares['alarms'], 'at most')} | {_share(shares['top1'], 'at least')} |")
    rows += ["", "Single effects from severity 1 on; in brackets laws outside the library:", ""]
    rows += ["| hidden | what the results say |", "|---|---|"]
    for hidden, said in sorted(report["confusion"].items()):
        ordered = sorted(said.items(), key=lambda item: (item[0] != hidden, -item[1], item[0]))
        rows.append(f"| {hidden} | {tally(dict(ordered))} |")
    return "\n".join(rows) + "\n"


if __name__ == "__main__":
    serve(_work)
