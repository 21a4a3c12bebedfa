"""``wlr bench decide``: how often, and after how much driving, ``wlr gap --until-decided`` decides rightly.

A robot of the blind test's simulator has one effect of severity 2, or none. It has driven two runs. Contenders differ in what
it drives next. Each contender in each case is a process of its own, whose line is kept: an interrupted study goes on.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import make_output_folder, write_json
from wlr_gym.base.jobs import Job, Send, serve, spread
from wlr_gym.base.paths import data_directory
from wlr_gym.base.provenance import git_commit
from wlr_gym.data.excitations import Motion, excite
from wlr_gym.data.read import read_meta
from wlr_gym.gap.decision import Budget, Decided, Recorded, decide
from wlr_gym.gap.robot.next_run import motions_to_drive
from wlr_gym.robot import load_robot
from wlr_gym.studies.bench.blind.cases import OF_CAMERA, named
from wlr_gym.studies.bench.blind.commands import BlindScript
from wlr_gym.studies.bench.blind.copies import read_robot
from wlr_gym.studies.bench.blind.dataset import BlindRobot, copy_of, write
from wlr_gym.studies.bench.blind.score import at_least, at_most, found_names
from wlr_gym.studies.bench.blind.simulation import BlindProfile
from wlr_gym.studies.bench.blind.truth import NAMED, hide

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
FIRST_SEED = 9100
#: After so many effects comes a robot copy without any.
NULL_EVERY = 6
CASES = len(NAMED) + len(NAMED) // NULL_EVERY
_MODULE = "wlr_gym.studies.bench.decide_study"


@dataclass(frozen=True)
class DecideCase:
    """A robot: ``effect`` is hidden in it (None: nothing), ``camera`` sees it."""

    name: str
    seed: int
    effect: Mapping[str, Any] | None
    camera: bool


def cases(count: int = CASES) -> list[DecideCase]:
    """Return so many robots: every effect once in an order drawn beforehand, every seventh robot without any; then anew.

    Raises:
        InputError: none.
    """
    if count < 1:
        raise InputError(f"--cases {count}: expected 1 or more")
    order, found, effects = np.random.default_rng(FIRST_SEED).permutation(sorted(NAMED)), [], 0
    for index in range(count):
        seed, effect = FIRST_SEED + index, None
        rng = np.random.default_rng([seed, 4])
        if index % (NULL_EVERY + 1) != NULL_EVERY:
            effect = named(str(order[effects % len(order)]), SEVERITY, rng)
            effects += 1
        camera = bool(rng.random() < 0.5) or (effect is not None and effect["name"] in OF_CAMERA)
        found.append(DecideCase(f"case_{seed}", seed, effect, camera))
    return found


# ---- one contender in one case ---------------------------------------------------------------------------------------


def decided_by(contender: str, one: DecideCase, folder: Path) -> dict[str, Any]:
    """Let a contender drive and analyse until it has decided; return its line."""
    begin, robot = time.monotonic(), _robot(one)
    noise = np.random.default_rng([one.seed, 3])
    data = folder / "runs"
    first = EIGHT if contender == "eight" else START
    write(data, [robot.drive(_script(excite(name)), noise) for name in first], robot.meta(", ".join(first)))

    def record(motion: Motion, runs: Path) -> Recorded:
        path = runs / f"run_{len(list(runs.glob('run_*.parquet'))) + 1:02d}.parquet"
        robot.drive(_script(motion), noise).to_parquet(path, index=False)
        return Recorded(path)

    if contender == "random":
        found, driven = _at_random(data, folder, record, np.random.default_rng([one.seed, 9]))
    else:
        found = decide(data, folder / "rounds", record, Budget(runs=FURTHER if contender == "chosen" else 0))
        driven = found.history.driven
    result = {"verdict": "none"} if found.result is None else found.result.model_dump(mode="json")
    names, hidden = found_names(result), [] if one.effect is None else [one.effect["name"]]
    return {
        "case": one.name,
        "contender": contender,
        "hidden": hidden,
        "camera": one.camera,
        "ended": found.history.ended,
        "verdict": result["verdict"],
        "found": names,
        "right": found.history.ended == "decided" and names == hidden,
        "runs": [*first, *driven],
        "seconds": round(sum(excite(name).duration for name in (*first, *driven)), 2),
        "wall_seconds": round(time.monotonic() - begin, 1),
        "commit": git_commit(),
    }


def _robot(one: DecideCase) -> BlindRobot:
    sheet = read_robot(data_directory("configs") / "robot" / "nominal.yaml")
    copy = copy_of(sheet, one.seed, soft=True)
    registers = excite(START[0]).profile
    profile = BlindProfile(registers.wheel_acceleration, registers.leg_velocity, registers.leg_acceleration)
    return BlindRobot(sheet, copy, hide([] if one.effect is None else [one.effect], copy), profile, one.camera)


def _script(motion: Motion) -> BlindScript:
    """A motion as what the blind test's robot is written."""
    last = len(motion.setpoints) - 1
    return BlindScript(motion.duration, lambda t: motion.setpoints[np.clip((t / motion.period).astype(int), 0, last)])


def _at_random(
    data: Path, folder: Path, record: Callable[[Motion, Path], Recorded], rng: np.random.Generator
) -> tuple[Decided, list[str]]:
    """Analyse after every run, and drive any motion next."""
    driven: list[str] = []
    while True:
        found = decide(data, folder / f"after_{len(driven)}", record, Budget(runs=0))
        if found.history.ended == "decided" or len(driven) == FURTHER:
            return found, driven
        motions = motions_to_drive(load_robot(), read_meta(data).profile, [*START, *driven])
        motion = motions[int(rng.integers(len(motions)))]
        record(motion, data)
        driven.append(motion.name)


# ---- the study -------------------------------------------------------------------------------------------------------


def run_decide_study(
    out: Path, count: int = CASES, contenders: Sequence[str] = tuple(CONTENDERS), processes: int = 2, say: Callable = print
) -> list[dict[str, Any]]:
    """Do what is left of a study, and return all lines; they are in ``out/decide.json``, too."""
    for name in ("", "lines", "work"):
        make_output_folder(out / name)
    jobs = []
    for one in cases(count):
        for contender in contenders:
            name = f"{one.name}_{contender}"
            task = {"out": str(out.resolve()), "index": one.seed - FIRST_SEED, "contender": contender}
            if not (out / "lines" / f"{name}.json").is_file():
                jobs.append(Job(name, _MODULE, task, str((out / "work" / f"{name}.log").resolve())))
    begin = time.monotonic()
    for done, ended in enumerate(spread(jobs, processes), 1):
        passed = time.monotonic() - begin
        rest = passed / done * (len(jobs) - done) / 60.0
        said = ended.error or _said(json.loads((out / "lines" / f"{ended.name}.json").read_text(encoding="utf-8")))
        say(f"{done}/{len(jobs)}  {ended.name}: {said}; about {rest:.0f} min to go")
    lines = [json.loads(path.read_text(encoding="utf-8")) for path in sorted((out / "lines").glob("case_*.json"))]
    write_json(out / "decide.json", lines)
    return lines


def _said(line: Mapping[str, Any]) -> str:
    rightly = "right" if line["right"] else "not right"
    return f"{line['ended']}, {', '.join(line['found']) or line['verdict']}: {rightly} after {line['seconds']:.0f} s of driving"


def _work(task: Mapping[str, Any], send: Send) -> None:
    out, contender = Path(task["out"]), task["contender"]
    one = cases(task["index"] + 1)[-1]
    folder = out / "work" / f"{one.name}_{contender}"
    write_json(out / "lines" / f"{folder.name}.json", decided_by(contender, one, folder))


def markdown(lines: Sequence[Mapping[str, Any]]) -> str:
    """Return the tables: how often each contender decided rightly, after how much driving, and case by case."""
    text = [
        "| drives | robots with an effect | decided rightly | wrongly | driving, median | mean | robots without | rightly |",
        "|---|---|---|---|---|---|---|---|",
    ]
    text += [_row(name, [one for one in lines if one["contender"] == name]) for name in CONTENDERS]
    text += ["", "| hidden | camera | " + " | ".join(CONTENDERS) + " |", "|---|---|" + "---|" * len(CONTENDERS)]
    for case in dict.fromkeys(one["case"] for one in lines):
        own = {one["contender"]: one for one in lines if one["case"] == case}
        first = next(iter(own.values()))
        cells = [_cell(own[name]) if name in own else "" for name in CONTENDERS]
        text.append(
            f"| {', '.join(first['hidden']) or 'nothing'} | {'yes' if first['camera'] else 'no'} | {' | '.join(cells)} |"
        )
    return "\n".join(text) + "\n"


def _row(name: str, lines: Sequence[Mapping[str, Any]]) -> str:
    hiding, nulls = [one for one in lines if one["hidden"]], [one for one in lines if not one["hidden"]]
    right = at_least(sum(one["right"] for one in hiding), len(hiding))
    wrong = at_most(sum(one["ended"] == "decided" and not one["right"] for one in hiding), len(hiding))
    seconds = [one["seconds"] for one in hiding]
    driving = (f"{np.median(seconds):.0f} s", f"{np.mean(seconds):.0f} s") if seconds else ("-", "-")
    cells = (
        CONTENDERS[name],
        str(len(hiding)),
        f"{right.hits} (at least {right.bound:.0%})" if hiding else "-",
        f"{wrong.hits} (at most {wrong.bound:.0%})" if hiding else "-",
        *driving,
        str(len(nulls)),
        str(sum(one["right"] for one in nulls)),
    )
    return f"| {' | '.join(cells)} |"


def _cell(line: Mapping[str, Any]) -> str:
    return (
        f"{'right' if line['right'] else ', '.join(line['found']) or line['verdict']}, {line['ended']}, {line['seconds']:.0f} s"
    )


if __name__ == "__main__":
    serve(_work)
