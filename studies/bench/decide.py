"""``python -m studies.bench decide``: how often, and after how much driving, ``wlr gap --until-decided`` decides rightly.

A robot of the blind test's simulator has one effect of severity 2, or none. It has driven two runs. Contenders differ in what
it drives next. Each contender in each case is a process of its own, whose line is kept: an interrupted study goes on, an
interrupted contender begins anew.
"""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from studies.bench.blind.cases import CAMERA_SHARE, NAMED, OF_CAMERA, hide, named
from studies.bench.blind.commands import BlindScript
from studies.bench.blind.copies import read_robot
from studies.bench.blind.dataset import BlindRobot, copy_of, write
from studies.bench.blind.drive import BlindProfile
from studies.bench.blind.score import FAILED, at_least, at_most, found_names
from studies.bench.gap import read_result
from studies.tables import hand_over, markdown_table, plain_console
from wlr_gym.base.errors import Interval
from wlr_gym.base.files import keep_request, make_output_folder, write_json
from wlr_gym.base.jobs import Job, Send, serve, spread
from wlr_gym.base.paths import data_directory
from wlr_gym.base.provenance import git_commit
from wlr_gym.base.text import tally
from wlr_gym.cli.options import JsonOption
from wlr_gym.data.excitations import Motion, excite
from wlr_gym.data.runs import next_run, read_meta
from wlr_gym.gap.decision import Budget, Decided, Recorded, decide, motions_to_drive
from wlr_gym.robot import load_robot

#: Contender -> what it drives.
CONTENDERS = {
    "chosen": "the run that distinguishes best, per second",
    "random": "a motion at random",
    "eight": "eight runs, fixed beforehand",
}
#: Runs that are there at first.
START = ("straight", "random")
#: What somebody drives who does not choose.
EIGHT = (*START, "turns", "s_curve", "stop_and_go", "posture", "rear_legs", "all_legs")
#: Further runs at most.
FURTHER = 5
SEVERITY = 2.0
FIRST_SEED = 9200
#: After so many effects comes a robot copy without any.
NULL_EVERY = 6
CASES = len(NAMED) + len(NAMED) // NULL_EVERY
LINES_FILE = "decide.json"

Line = Mapping[str, Any]
Say = Callable[[str], object]


@dataclass(frozen=True)
class DecideCase:
    """A robot: ``effect`` is hidden in it (None: nothing), ``camera`` sees it."""

    name: str
    seed: int
    effect: Mapping[str, Any] | None
    camera: bool

    @property
    def hidden(self) -> list[str]:
        """The names that are right."""
        return [] if self.effect is None else [str(self.effect["name"])]


def cases(count: int = CASES) -> list[DecideCase]:
    """Return so many robots: every effect once in an order drawn beforehand, every seventh robot without any; then anew."""
    order, found, effects = np.random.default_rng(FIRST_SEED).permutation(sorted(NAMED)), [], 0
    for index in range(count):
        seed, effect = FIRST_SEED + index, None
        rng = np.random.default_rng([seed, 4])
        if index % (NULL_EVERY + 1) != NULL_EVERY:
            effect = named(str(order[effects % len(order)]), SEVERITY, rng)
            effects += 1
        camera = bool(rng.random() < CAMERA_SHARE) or (effect is not None and effect["name"] in OF_CAMERA)
        found.append(DecideCase(f"case_{seed}", seed, effect, camera))
    return found


# ---- one contender in one case ---------------------------------------------------------------------------------------


def decided_by(contender: str, one: DecideCase, folder: Path) -> dict[str, Any]:
    """Let a contender drive and analyse in an empty folder until it has decided; return its line."""
    begin, robot, data = time.monotonic(), _robot(one), folder / "runs"
    noise = np.random.default_rng([one.seed, 3])
    driven = [excite(name) for name in (EIGHT if contender == "eight" else START)]
    tables = [robot.drive(_script(motion), noise) for motion in driven]
    write(data, tables, robot.meta(", ".join(motion.name for motion in driven)))

    def record(motion: Motion, runs: Path) -> Recorded:
        path = next_run(runs)
        robot.drive(_script(motion), noise).to_parquet(path, index=False)
        driven.append(motion)
        return Recorded(path)

    if contender == "random":
        found = _at_random(data, folder, record, np.random.default_rng([one.seed, 9]))
    else:
        found = decide(data, folder / "rounds", record, Budget(runs=FURTHER if contender == "chosen" else 0))
    assert found.result is not None
    names = list(dict.fromkeys(found_names(found.result.model_dump(mode="json"))))
    return _line(one, contender) | {
        "ended": found.history.ended,
        "verdict": found.result.verdict,
        "found": names,
        "right": found.history.ended == "decided" and names == one.hidden,
        "runs": [motion.name for motion in driven],
        "seconds": round(sum(motion.duration for motion in driven), 2),
        "wall_seconds": round(time.monotonic() - begin, 1),
    }


def _line(one: DecideCase, contender: str) -> dict[str, Any]:
    return {"case": one.name, "contender": contender, "hidden": one.hidden, "camera": one.camera, "commit": git_commit()}


def _robot(one: DecideCase) -> BlindRobot:
    sheet = read_robot(data_directory("configs") / "robot" / "nominal.yaml")
    copy = copy_of(sheet, one.seed, soft=True)
    registers = excite(START[0]).profile
    profile = BlindProfile(registers.wheel_acceleration, registers.leg_velocity, registers.leg_acceleration)
    return BlindRobot(sheet, copy, hide([] if one.effect is None else [one.effect]), profile, one.camera)


def _script(motion: Motion) -> BlindScript:
    """A motion as what the blind test's robot is written."""
    last = len(motion.setpoints) - 1
    return BlindScript(motion.duration, lambda t: motion.setpoints[np.clip((t / motion.period).astype(int), 0, last)])


def _at_random(data: Path, folder: Path, record: Callable[[Motion, Path], Recorded], rng: np.random.Generator) -> Decided:
    """Analyse after every run, and drive any motion next."""
    driven: list[str] = []
    while True:
        found = decide(data, folder / f"after_{len(driven)}", record, Budget(runs=0))
        if found.history.ended == "decided" or len(driven) == FURTHER:
            return found
        motions = motions_to_drive(load_robot(), read_meta(data).profile, [*START, *driven])
        motion = motions[int(rng.integers(len(motions)))]
        record(motion, data)
        driven.append(motion.name)


# ---- the study -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DecideStudyOptions(JsonOption):
    out: Path
    """Folder for results; an interrupted study resumes from it."""
    cases: Annotated[int, Interval(least=1)] = CASES
    """How many robots."""
    contenders: tuple[Literal["chosen", "random", "eight"], ...] = ("chosen", "random", "eight")
    """Who decides what is driven next."""
    processes: Annotated[int, Interval(least=1)] = 2
    """Contenders at a time."""


def run(options: DecideStudyOptions) -> int:
    """Let the gap workflow choose what robots with hidden effects drive, and others beside it; print and write the tables."""
    lines = run_decide_study(options.out, options.cases, options.contenders, options.processes, plain_console.print)
    return hand_over(options.out / "decide.md", markdown(lines), lines, options.json, options.out / LINES_FILE)


def run_decide_study(
    out: Path, count: int = CASES, contenders: Sequence[str] = tuple(CONTENDERS), processes: int = 2, say: Say = print
) -> list[dict[str, Any]]:
    """Do what is left of a study, failed contenders too, and return its lines; they are in ``decide.json``, too.

    Raises:
        InputError: the folder has a study of other robots or runs.
    """
    for folder in ("", "lines", "work"):
        make_output_folder(out / folder)
    request = {"first_seed": FIRST_SEED, "severity": SEVERITY, "further": FURTHER, "start": list(START), "eight": list(EIGHT)}
    keep_request(out / "study.json", request)
    asked = [(one, contender) for one in cases(count) for contender in dict.fromkeys(contenders)]
    left, jobs = {}, []
    for one, contender in asked:
        file = _file(out, one, contender)
        if not file.is_file() or read_result(file)["ended"] == FAILED:
            left[file.stem] = one, contender
    for name, (one, contender) in left.items():
        task = {"out": str(out.resolve()), "index": one.seed - FIRST_SEED, "contender": contender}
        jobs.append(Job(name, "studies.bench.decide", task, str((out / "work" / f"{name}.log").resolve())))
    begin = time.monotonic()
    for done, ended in enumerate(spread(jobs, processes), 1):
        file = _file(out, *left[ended.name])
        if ended.error:
            write_json(file, _line(*left[ended.name]) | {"ended": FAILED, "right": False, "found": [], "message": ended.error})
        rest = (time.monotonic() - begin) / done * (len(jobs) - done) / 60.0
        line = read_result(file)
        said = f"{FAILED}, {line['message']}" if line["ended"] == FAILED else _cell(line)
        say(f"{done}/{len(jobs)}  {ended.name}: {said}; about {rest:.0f} min to go")
    lines = [read_result(_file(out, one, contender)) for one, contender in asked]
    write_json(out / LINES_FILE, lines)
    return lines


def _file(out: Path, one: DecideCase, contender: str) -> Path:
    return out / "lines" / f"{one.name}_{contender}.json"


def _work(task: Mapping[str, Any], send: Send) -> None:
    out, contender = Path(task["out"]), task["contender"]
    one = cases(task["index"] + 1)[-1]
    folder = out / "work" / f"{one.name}_{contender}"
    shutil.rmtree(folder, ignore_errors=True)
    write_json(_file(out, one, contender), decided_by(contender, one, folder))


# ---- tables ----------------------------------------------------------------------------------------------------------


def markdown(lines: Sequence[Line]) -> str:
    """Return how often each contender decided rightly after how much driving, pairs of contenders, and every case."""
    taking_part = [name for name in CONTENDERS if any(one["contender"] == name for one in lines)]
    headings = ("drives", "decided rightly, of robots with an effect", "wrongly", "failed", "driving per right decision",
                "nothing hidden: rightly", "false alarms")  # fmt: skip
    rows = []
    for case in dict.fromkeys(one["case"] for one in lines):
        own = {one["contender"]: one for one in lines if one["case"] == case}
        first = next(iter(own.values()))
        hidden = ", ".join(first["hidden"]) or "nothing"
        rows.append((hidden, "yes" if first["camera"] else "no", *(_cell(own[name]) for name in taking_part)))
    parts = [
        [f"Robots analysed by commit: {tally(Counter(one['commit'] for one in lines))}."],
        markdown_table(headings, [_row(name, [one for one in lines if one["contender"] == name]) for name in taking_part]),
        [_pair(lines, other) for other in taking_part[1:] if taking_part[0] == "chosen"],
        markdown_table(("hidden", "camera", *taking_part), rows),
    ]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def _row(name: str, lines: Sequence[Line]) -> tuple[str, ...]:
    hiding, nulls = [one for one in lines if one["hidden"]], [one for one in lines if not one["hidden"]]
    right = at_least(sum(one["right"] for one in hiding), len(hiding))
    wrong = at_most(sum(one["ended"] == "decided" and not one["right"] for one in hiding), len(hiding))
    driving = sum(one.get("seconds", 0.0) for one in hiding)
    return (
        CONTENDERS[name],
        f"{right.hits}/{right.count} (at least {right.bound:.0%})" if hiding else "-",
        f"{wrong.hits} (at most {wrong.bound:.0%})" if hiding else "-",
        str(sum(one["ended"] == FAILED for one in lines)),
        f"{driving / right.hits:.0f} s" if right.hits else "-",
        f"{sum(one['right'] for one in nulls)}/{len(nulls)}",
        str(sum(bool(one["found"]) for one in nulls)),
    )


def _pair(lines: Sequence[Line], other: str) -> str:
    """What choosing gains over another contender in the same robots."""
    both = {
        name: {one["case"]: one for one in lines if one["contender"] == name and one["hidden"]} for name in ("chosen", other)
    }
    pairs = [(one, both[other][case]) for case, one in both["chosen"].items() if case in both[other]]
    only = [sum(one["right"] and not two["right"] for one, two in order) for order in (pairs, [p[::-1] for p in pairs])]
    saved = [two["seconds"] - one["seconds"] for one, two in pairs if one["right"] and two["right"]]
    less = f"{np.mean(saved):.0f} s less driving on average in the {len(saved)} where both are" if saved else "both in none"
    return f"- Chosen runs against '{CONTENDERS[other]}': right alone in {only[0]} robots, the other in {only[1]}; {less}."


def _cell(line: Line) -> str:
    if line["ended"] == FAILED:
        return FAILED
    answer = "right" if line["right"] else ", ".join(line["found"]) or line["verdict"]
    return f"{answer}, {line['ended']}, {line['seconds']:.0f} s"


if __name__ == "__main__":
    serve(_work)
