"""Go on until it is decided: analyse, choose the next run, have it driven, and analyse again; see docs/gap.md."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import alone_in, check_same_request, resumes, write_json
from wlr_gym.base.settings import SettingsModel, parse_config, read_yaml
from wlr_gym.data.excitations import Motion
from wlr_gym.data.format import META_FILE
from wlr_gym.data.replay import robot_of
from wlr_gym.data.runs import read_meta, read_run, run_files
from wlr_gym.gap.analysis import BAD_DATA, FAILS_CROSS_VALIDATION, NOT_EXCITED
from wlr_gym.gap.report.result import DECIDED, NOTHING, RESULT_FILE, Explanation, Result, explanations, read_result
from wlr_gym.gap.robot.next_run import TELLS, driven_already, most_shown, motions_to_drive, promises
from wlr_gym.gap.robot.problem import LEAST_RUNS, MISFIT
from wlr_gym.gap.validation.held_out import most_left
from wlr_gym.gap.workflow import Tell, analyse
from wlr_gym.physics.effects import Patch, Source, load_patch

HISTORY_FILE = "history.json"
#: "Nothing is missing" is decided from so many runs on: fewer may not show what is.
RUNS_FOR_NOTHING = 6
#: Expected difference of minus two log evidence that takes 95 % for one name to 95 % for another.
TELLS_OTHERWISE = 2.0 * TELLS
#: Instead of a verdict: no analysis yet.
TOO_FEW_RUNS = "too_few_runs"

#: Why it ended. ``decided``: one name has 95 %, none is equivalent to it, or none that any motion promises to tell from it, and
#: what it leaves is no more than simulators leave; ``nothing would tell``: no motion promises to distinguish what is left, none
#: of which has 95 %; ``budget``: runs or seconds are used up;
#: ``stopped``: a drive recorded nothing. Empty: it goes on.
Ending = Literal["", "decided", "nothing would tell", "budget", "stopped"]


@dataclass(frozen=True)
class Budget:
    """What may be driven beside the runs that are there.

    Attributes:
        runs: further runs. seconds: of driving.
    """

    runs: int = 5
    seconds: float = math.inf

    def __post_init__(self) -> None:
        if self.runs < 0 or not self.seconds >= 0.0:
            raise InputError(f"budget of {self.runs} runs, {self.seconds:g} s: expected 0 or more of both")


@dataclass(frozen=True)
class Recorded:
    """What a drive left.

    Attributes:
        run: path of the run; None = nothing was recorded.
        reason: why it ended early; empty = it did not.
    """

    run: Path | None
    reason: str = ""


#: Has a motion driven, and a run of it left in a folder.
Recorder = Callable[[Motion, Path], Recorded]


class DecisionRound(SettingsModel):
    """One round: an analysis, and the run that was driven after it.

    Attributes:
        number: from 1 on; its report is in ``round_01``, ...
        runs: that were there.
        verdict: of the analysis; ``too_few_runs``: there was none, for want of runs.
        names: left, with their probabilities, which say nothing of what simulators cannot reproduce.
        excitation: driven next; "" = none. why: it was chosen.
        run: that it left; "" = none yet. seconds: of driving. stopped: why the drive ended early.
    """

    number: int
    runs: tuple[str, ...]
    verdict: str
    names: dict[str, float] = Field(default_factory=dict)
    excitation: str = ""
    why: str = ""
    run: str = ""
    seconds: float = 0.0
    stopped: str = ""


class History(SettingsModel):
    """``history.json``: what was asked, all rounds, and how it ended."""

    data: str
    robot: str | None
    backend: str
    known: list[dict[str, Any]]
    rounds: tuple[DecisionRound, ...] = ()
    ended: Ending = ""

    @property
    def seconds(self) -> float:
        """Seconds of driving, those of runs that were there before left out."""
        return sum(one.seconds for one in self.rounds)

    @property
    def driven(self) -> list[str]:
        """Names of the excitations that were driven."""
        return [one.excitation for one in self.rounds if one.run or one.stopped]


@dataclass(frozen=True)
class Decided:
    """How it ended.

    Attributes:
        history: all rounds.
        result: of the last analysis; None = there were too few runs for one.
        folder: of its report, result and patch.
    """

    history: History
    result: Result | None
    folder: Path


def decide(
    data: str | Path,
    out: str | Path,
    record: Recorder,
    budget: Budget | None = None,
    *,
    known: Source = None,
    robot: str | Path | None = None,
    backend: str = "gibbs_appell",
    threads: int = 1,
    tell: Tell = lambda stage, share: None,
) -> Decided:
    """Analyse measured runs, have the runs driven that distinguish best what may be missing, until it is decided.

    Called again with the same folders it goes on where it was interrupted, or with a larger budget where that was used up. A
    run that somebody added to ``data`` meanwhile is analysed with the others.

    Args:
        data: folder of runs, two or more; further runs go there.
        out: ``history.json``, and the report of each round in ``round_01``, ``round_02``, ...
        record: has one motion driven.
        budget: of further runs and seconds of driving; None = five runs.
        known, robot, backend, threads, tell: see :func:`wlr_gym.gap.workflow.analyse`.

    Raises:
        InputError: see :func:`wlr_gym.gap.workflow.analyse`; or ``out`` has a history of other data, robot or simulator, or
            another process works in it.
    """
    known = load_patch(known)
    asked = _Asked(Path(data), Path(out), budget or Budget(), known, robot, backend, threads, tell)
    history, last = _resumed(asked)
    with alone_in(asked.out):
        return _go_on(asked, record, history, last)


def _go_on(asked: _Asked, record: Recorder, history: History, last: DecisionRound | None) -> Decided:
    """Work through the rounds that are left; ``last``: see :func:`_resumed`."""
    while True:
        now, result, left = _analysed(asked, history, last)
        ended, promise = _choice(asked, history, now, result, left)
        now = now.model_copy(update={"excitation": promise.name, "why": promise.why}) if promise else now
        folder, last = asked.folder(now), None
        if promise is None:
            return Decided(_saved(asked, history, now, ended), result, folder)
        _saved(asked, history, now)
        recorded = record(promise.motion, asked.data)
        now = _with_run(now, recorded)
        if recorded.run is None:
            return Decided(_saved(asked, history, now, "stopped"), result, folder)
        history = _saved(asked, history, now)


@dataclass(frozen=True)
class _Asked:
    """What :func:`decide` was asked."""

    data: Path
    out: Path
    budget: Budget
    known: Patch
    robot: str | Path | None
    backend: str
    threads: int
    tell: Tell

    def history(self) -> History:
        """An empty history."""
        robot = None if self.robot is None else str(self.robot)
        known = [dict(effect.content()) for effect in self.known.effects]
        return History(data=str(self.data.resolve()), robot=robot, backend=self.backend, known=known)

    def folder(self, now: DecisionRound) -> Path:
        """Where the report of a round goes."""
        return self.out / f"round_{now.number:02d}"


# ---- one round -------------------------------------------------------------------------------------------------------


def _analysed(
    asked: _Asked, history: History, last: DecisionRound | None
) -> tuple[DecisionRound, Result | None, tuple[Explanation, ...]]:
    """Analyse the runs that are there, unless the round that was interrupted has done so."""
    runs = tuple(path.stem for path in run_files(asked.data))
    now = DecisionRound(number=len(history.rounds) + 1, runs=runs, verdict=TOO_FEW_RUNS)
    if len(runs) < LEAST_RUNS:
        return now, None, ()
    folder = asked.folder(now)
    if last is None or last.runs != runs or not _is_current(folder / RESULT_FILE, asked.data):
        analyse(
            asked.data,
            folder,
            known=asked.known,
            robot=asked.robot,
            backend=asked.backend,
            threads=asked.threads,
            tell=asked.tell,
        )
    result = read_result(folder / RESULT_FILE)
    left = explanations(result)
    now = now.model_copy(update={"verdict": result.verdict, "names": {one.name: one.probability for one in left}})
    _saved(asked, history, now)
    return now, result, left


def _is_current(result: Path, data: Path) -> bool:
    """Whether a result is there, and newer than runs and meta data: those may have been mended since."""
    read = [path for path in (*run_files(data), data / META_FILE) if path.exists()]
    return result.is_file() and result.stat().st_mtime_ns >= max(path.stat().st_mtime_ns for path in read)


@dataclass(frozen=True)
class _Next:
    """The motion that is driven next, and why."""

    motion: Motion
    why: str

    @property
    def name(self) -> str:
        return self.motion.name


def _choice(
    asked: _Asked, history: History, now: DecisionRound, result: Result | None, left: Sequence[Explanation]
) -> tuple[Ending, _Next | None]:
    """Return what to drive next; or None and why it ends."""
    doubt = _doubt(now, result, left)
    answered = now.verdict not in (NOT_EXCITED, BAD_DATA) and not doubt and not _some_runs_alone_show_one(result)
    if len(left) == 1 and answered:
        return "decided", None
    if len(history.driven) >= asked.budget.runs:
        return "budget", None
    runs = {path.stem: read_run(path) for path in run_files(asked.data)}
    before = [run for name, run in runs.items() if name not in {one.run for one in history.rounds}]
    own = robot_of(next(iter(runs.values())), asked.robot)
    driven = [*driven_already(before, own), *history.driven]
    seconds = asked.budget.seconds - history.seconds
    motions = motions_to_drive(own, read_meta(asked.data).profile, driven)
    motions = [motion for motion in motions if motion.duration <= seconds]
    if not motions:
        return "budget", None
    shows_most = _shows_most(result, motions, driven)
    shows_most = replace(shows_most, why=doubt + shows_most.why)
    if result is None or len(left) < 2:
        return "", shows_most
    asked.tell("choosing the next run", 1.0)
    there = [runs[name] for name in now.runs]
    found = promises(result, left, motions, own, there, known=asked.known, backend=asked.backend, threads=asked.threads)
    sure = left[0].probability >= DECIDED and left[0].name in {NOTHING, *(effect.name for effect in result.effects)}
    if max(one.most for one in found) >= (TELLS_OTHERWISE if sure else TELLS):
        best = found[0]
        between = f"{best.most:.0f} between {' and '.join(best.pair)}"
        return "", _Next(best.motion, f"promises {best.telling / best.motion.duration:.2g} per s, {between}")
    if doubt:
        return "", shows_most
    return "decided" if sure and answered else "nothing would tell", None


def _some_runs_alone_show_one(result: Result | None) -> bool:
    """Whether nothing was selected, and some runs show an effect that runs left out of the fit do not."""
    if result is None or result.effects:
        return False
    return any(one.outcome == FAILS_CROSS_VALIDATION for one in result.evidence)


def _doubt(now: DecisionRound, result: Result | None, left: Sequence[Explanation]) -> str:
    """Why the runs do not carry an answer yet, whatever it is; empty: they do."""
    if result is None:
        return ""
    unnamed = any(one.name == NOTHING for one in left[:1])
    if unnamed and not result.effects and len(now.runs) < RUNS_FOR_NOTHING:
        return f"{RUNS_FOR_NOTHING} runs or more tell that nothing is missing; "
    if result.gap is None:
        return ""
    # where the error is large, a name may be the best of wrong ones
    misfit = most_left(result.gap.fit_after, result.run_gaps if unnamed else [])[0] / (result.gap.noise_floor or math.inf)
    return f"an error of {misfit:.1f} noise floors is left, more than {MISFIT:g}; " if misfit > MISFIT else ""


def _shows_most(result: Result | None, motions: Sequence[Motion], driven: Sequence[str]) -> _Next:
    """Where there are no explanations to distinguish: what the report recommends, else what shows most effects best."""
    advised = [one.excitation for one in result.recommendations] if result is not None else []
    new = [motion for name in advised for motion in motions if motion.name == name and name not in driven]
    return _Next(new[0], "the report recommends it") if new else _Next(most_shown(motions, driven), "shows most effects best")


def _with_run(now: DecisionRound, recorded: Recorded) -> DecisionRound:
    """The round with the run that was driven after it."""
    if recorded.run is None:
        return now.model_copy(update={"stopped": recorded.reason or "nothing was recorded"})
    t = read_run(recorded.run)["t"]
    return now.model_copy(
        update={"run": recorded.run.stem, "seconds": round(float(t[-1] - t[0]), 3), "stopped": recorded.reason}
    )


# ---- the history -----------------------------------------------------------------------------------------------------


def _resumed(asked: _Asked) -> tuple[History, DecisionRound | None]:
    """Return the history of complete rounds, and the last one where it was interrupted or nothing was driven after it."""
    if not run_files(asked.data):
        raise InputError(
            f"{asked.data}: no run_*.csv or run_*.parquet: record two first: wlr record --excitation straight random"
        )
    fresh, path = asked.history(), asked.out / HISTORY_FILE
    if not resumes(asked.out, HISTORY_FILE):
        return fresh, None
    history = parse_config(History, read_yaml(path), str(path))
    requested = {name: getattr(fresh, name) for name in ("data", "robot", "backend", "known")}
    check_same_request(path, dict(history), requested)
    if not history.rounds or history.rounds[-1].run:
        return history, None
    *before, last = history.rounds
    new = [path for path in run_files(asked.data) if path.stem not in last.runs]
    if last.excitation and new:  # it was driven, but nobody was there to note it
        return history.model_copy(update={"rounds": (*before, _with_run(last, Recorded(new[0])))}), None
    return history.model_copy(update={"rounds": tuple(before)}), last


def _saved(asked: _Asked, history: History, now: DecisionRound, ended: Ending = "") -> History:
    """Return the history with a further round, and write it."""
    longer = history.model_copy(update={"rounds": (*history.rounds, now), "ended": ended})
    write_json(asked.out / HISTORY_FILE, longer.model_dump(mode="json"))
    return longer
