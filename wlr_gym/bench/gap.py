"""Blind test of the gap workflow: data sets with sealed truths, analysed one by one, scored at the end.

The sets come from :mod:`wlr_gym.bench.blind`, which shares no code with the workflow. Results of finished sets stay in the
output folder, so an interrupted test goes on where it stopped, and a longer one adds to a shorter one.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import shutil
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from wlr_gym.bench.blind.cases import FIRST_SCORED_SEED, Case, case
from wlr_gym.bench.blind.score import score
from wlr_gym.errors import InputError
from wlr_gym.files import make_output_folder, replace_file, write_json
from wlr_gym.paths import data_directory

#: Folder of a data set, folder for the analysis' files -> contents of result.json.
Analyser = Callable[[Path, Path], Mapping[str, Any]]
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class Plan:
    """A blind test.

    Attributes:
        out: folder for data, results, truths and the score.
        sets: how many data sets.
        processes: how many of them at a time.
        first_seed: of the first set; the others follow.
        keep_data: leave the data sets there (3 MB each); they can be made again from their seeds.
        runs: which of the eight kinds of runs a set has.
    """

    out: Path
    sets: int
    processes: int = 2
    first_seed: int = FIRST_SCORED_SEED
    keep_data: bool = False
    runs: tuple[int, ...] = tuple(range(8))

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        if self.sets < 1:
            raise InputError(f"--sets {self.sets}: expected 1 or more")
        if self.processes < 1:
            raise InputError(f"--processes {self.processes}: expected 1 or more")

    def cases(self) -> list[Case]:
        """Return the data sets."""
        return [case(index, self.first_seed) for index in range(self.sets)]

    def result_file(self, one: Case) -> Path:
        """Return where the result of a set is kept."""
        return self.out / "results" / f"{one.name}.json"


def analyse_folder(folder: Path, out: Path) -> Mapping[str, Any]:
    """Run the gap workflow on a folder; return its result file. The report with its pictures is not drawn."""
    from wlr_gym.gap.result import write_result
    from wlr_gym.gap.workflow import analyse

    make_output_folder(out)
    return read_result(write_result(analyse(folder, threads=1), out))


def run_blind_test(
    plan: Plan, analyser: str = "wlr_gym.bench.gap:analyse_folder", say: Callable[[str], None] = print
) -> dict[str, Any]:
    """Make the data sets, analyse them, score them.

    Args:
        plan: what to do.
        analyser: what is tested, as ``module:function`` that other processes can import.
        say: shown progress.

    Returns:
        The score, as in ``score.json``.

    Raises:
        InputError: the output folder cannot be written to, or holds another test.
    """
    for name in ("", "results", "data", "sealed", "work"):
        make_output_folder(plan.out / name)
    cases = plan.cases()
    say(f"truths sealed in {plan.out / 'sealed'}: sha256 {seal(plan, cases)}")
    left = [one for one in cases if not plan.result_file(one).is_file()]
    if len(left) < len(cases):
        say(f"{len(cases) - len(left)} of {len(cases)} results are there already")
    _run(plan, left, analyser, say)
    found = {one.name: read_result(plan.result_file(one)) for one in cases if plan.result_file(one).is_file()}
    report = score(found, {one.name: one.as_dict() for one in cases})
    write_json(plan.out / "score.json", report)
    return report


def seal(plan: Plan, cases: Sequence[Case]) -> str:
    """Write the truths to a file of their own, away from the data, and return its SHA-256."""
    text = yaml.safe_dump({one.name: _plain(one.as_dict()) for one in cases}, sort_keys=True)
    file = plan.out / "sealed" / f"truths_{plan.first_seed}_{plan.sets}.yaml"
    if file.is_file() and file.read_text(encoding="utf-8") != text:
        raise InputError(f"{file}: holds other truths than these seeds give now; use another --out")
    replace_file(file, lambda temporary: temporary.write_text(text, encoding="utf-8"))
    return hashlib.sha256(text.encode()).hexdigest()


def _plain(value: Any) -> Any:
    return json.loads(json.dumps(value))


def read_result(path: Path) -> dict[str, Any]:
    """Read the result of one set."""
    return json.loads(path.read_text(encoding="utf-8"))


def _run(plan: Plan, cases: Sequence[Case], analyser: str, say: Callable[[str], None]) -> None:
    """Work through the sets, ``processes`` at a time, and say after each how long the rest will take."""
    begin, done, left, working = time.monotonic(), 0, list(cases), {}
    try:
        while left or working:
            while left and len(working) < plan.processes:
                one = left.pop(0)
                working[one.name] = one, _start(plan, one, analyser)
            time.sleep(0.1)
            for one, process in [pair for pair in working.values() if pair[1].poll() is not None]:
                del working[one.name]
                done += 1
                passed = time.monotonic() - begin
                rest = passed / done * (len(cases) - done)
                line = _outcome(plan, one, process.returncode)
                say(f"{done}/{len(cases)}  {line}  {_clock(passed)} passed, about {_clock(rest)} to go")
    finally:
        for _, process in working.values():
            process.terminate()


def _start(plan: Plan, one: Case, analyser: str) -> subprocess.Popen[bytes]:
    """Start a process for one set: what it breaks or leaks is gone with it, and it can be stopped."""
    task = {**vars(plan), "out": str(plan.out), "index": one.seed - plan.first_seed, "analyser": analyser}
    with open(_log_file(plan, one), "wb") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "wlr_gym.bench.gap", json.dumps(task)],
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, **dict.fromkeys(_THREADS, "1")},
        )


def _log_file(plan: Plan, one: Case) -> Path:
    return plan.out / "work" / f"{one.name}.log"


def _outcome(plan: Plan, one: Case, code: int) -> str:
    """Say how a set went; a process that died without a result has failed."""
    file, log = plan.result_file(one), _log_file(plan, one)
    if not file.is_file():
        last = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:]
        write_json(file, {"verdict": "failed", "message": f"the process ended with {code}: {' '.join(last)}"})
    result = read_result(file)
    if result["verdict"] != "failed":
        log.unlink()
    return f"{one.name}: {result['verdict']}, {result.get('wall_seconds', 0):.0f} s"


def _main(task: dict[str, Any]) -> None:
    """Do one set, in a process of its own."""
    index, module, _, function = task.pop("index"), *task.pop("analyser").partition(":")
    plan = Plan(**{**task, "out": Path(task["out"]), "runs": tuple(task["runs"])})
    run_case(plan, case(index, plan.first_seed), getattr(importlib.import_module(module), function))


def _clock(seconds: float) -> str:
    minutes = int(seconds / 60)
    return f"{minutes // 60}:{minutes % 60:02d} h" if minutes >= 60 else f"{minutes} min {int(seconds) % 60} s"


def run_case(plan: Plan, one: Case, analyser: Analyser) -> None:
    """Make one set, analyse it, keep the result.

    Whatever the analysis raises is its answer: an :class:`InputError` refuses the data, anything else is a failure.
    """
    folder, out = plan.out / "data" / one.name, plan.out / "work" / one.name
    make_data(folder, one, plan.runs)
    begin = time.monotonic()
    try:
        result: dict[str, Any] = dict(analyser(folder, out))
    except InputError as error:
        result = {"verdict": "refused", "message": str(error), "traceback": traceback.format_exc()}
    except Exception as error:
        result = {"verdict": "failed", "message": f"{type(error).__name__}: {error}", "traceback": traceback.format_exc()}
    result["wall_seconds"] = time.monotonic() - begin
    write_json(plan.result_file(one), _plain(result))
    if not plan.keep_data:
        shutil.rmtree(folder)
    shutil.rmtree(out, ignore_errors=True)


def make_data(folder: Path, one: Case, runs: Sequence[int] = range(8)) -> None:
    """Simulate one data set and write it."""
    import numpy as np

    from wlr_gym.bench.blind.copies import read_robot
    from wlr_gym.bench.blind.dataset import simulate_runs, write
    from wlr_gym.bench.blind.spoil import SPOIL

    robot = read_robot(data_directory("configs") / "robot" / "nominal.yaml")
    tables, meta, _ = simulate_runs(robot, one.effects, one.seed, runs, exact=one.kind == "none")
    if one.spoilt:
        tables = SPOIL[one.spoilt](tables, np.random.default_rng([one.seed, 5]))
    shutil.rmtree(folder, ignore_errors=True)
    write(folder, tables, meta)


# --- report -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Line:
    """One line of the report: a number beside its target."""

    what: str
    value: str
    target: str
    met: bool | None


def lines(report: Mapping[str, Any]) -> list[Line]:
    """Return the numbers that the workflow is judged by, in the order of the targets."""
    alarms, single, pairs, outside = report["false_alarms"], report["single"], report["pairs"], report["outside"]
    error, coverage, reduction = single["parameter_error"], single["interval_coverage"], single["gap_reduction"]
    size = single["mean_set_size"]
    return [
        _share_line("false alarms, nominal robot", alarms["none"], 0.05, most=True),
        _share_line("false alarms, parameters only", alarms["parameters"], 0.05, most=True),
        _share_line("right name first, severity >= 2", single["top1"], 0.85),
        _share_line("truth in the equivalence set", single["in_set"], 0.95),
        _number_line("mean size of that set", size, "<= 1.5", size is not None and size <= 1.5),
        _share_line("right place, where named", single["place"], 0.95),
        _share_line("both of a pair named", pairs["both"], 0.60),
        _number_line("median parameter error", error["median"], "<= 10 %", (error["median"] or 0) <= 0.10, error["count"]),
        _interval_line(coverage),
        _number_line(
            "median gap reduction", reduction["median"], ">= 0.8", (reduction["median"] or 0) >= 0.8, reduction["count"]
        ),
        _share_line("gap grew", single["gap_grew"], 0.0, most=True),
        _share_line("outside the library: not misnamed", outside["not_misnamed"], 0.90),
        _share_line("outside the library: formula or unknown", outside["unknown"], None),
        _share_line("bad data caught", report["bad_data"], None),
        _share_line("good data refused", alarms["refused_good_data"], None, most=True),
    ]


def _share_line(what: str, share: Mapping[str, Any], target: float | None, most: bool = False) -> Line:
    if not share["count"]:
        return Line(what, "-", "" if target is None else f"{'<=' if most else '>='} {target:.0%}", None)
    bound = f"{'at most' if most else 'at least'} {share['bound95']:.0%}"
    value = f"{share['hits']}/{share['count']} = {share['share']:.0%} ({bound})"
    if target is None:
        return Line(what, value, "", None)
    met = share["share"] <= target if most else share["share"] >= target
    return Line(what, value, f"{'<=' if most else '>='} {target:.0%}", met)


def _interval_line(coverage: Mapping[str, Any]) -> Line:
    """Intervals may be too narrow or too wide."""
    line = _share_line("95 % intervals that hold", coverage, 0.88)
    met = None if coverage["share"] is None else 0.88 <= coverage["share"] <= 0.98
    return Line(line.what, line.value, "88-98 %", met)


def _number_line(what: str, value: float | None, target: str, met: bool, count: int | None = None) -> Line:
    if value is None:
        return Line(what, "-", target, None)
    return Line(what, f"{value:.3g}" + (f" of {count}" if count is not None else ""), target, met)


def markdown(report: Mapping[str, Any]) -> str:
    """Return the report as Markdown tables: numbers beside targets, severities, confusion matrix."""
    rows = ["| | measured (95 % bound) | target | met |", "|---|---|---|---|"]
    met = {True: "yes", False: "no", None: ""}
    rows += [f"| {line.what} | {line.value} | {line.target} | {met[line.met]} |" for line in lines(report)]
    rows += ["", "| severity | sets | found | right name first | in the set |", "|---|---|---|---|---|"]
    for severity, shares in report["single"]["by_severity"].items():
        cells = [f"{shares[key]['share']:.0%}" for key in ("found", "top1", "in_set")]
        rows.append(f"| {severity} | {shares['found']['count']} | {' | '.join(cells)} |")
    rows += ["", "| hidden | what the results say |", "|---|---|"]
    for hidden, said in sorted(report["confusion"].items()):
        ordered = sorted(said.items(), key=lambda item: (item[0] != hidden, -item[1], item[0]))
        rows.append(f"| {hidden} | {', '.join(f'{name} {count}' for name, count in ordered)} |")
    return "\n".join(rows) + "\n"


if __name__ == "__main__":
    _main(json.loads(sys.argv[1]))
