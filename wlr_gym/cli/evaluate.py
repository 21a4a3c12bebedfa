"""Score a policy or agent over many episodes, against baselines on the same seeds: a card with confidence intervals."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from wlr_gym.base.errors import InputError, Interval, check_name
from wlr_gym.base.files import refuse_existing
from wlr_gym.base.progress import progress, tracked
from wlr_gym.base.provenance import record_provenance
from wlr_gym.cli import FAILED, OK
from wlr_gym.cli.options import (
    Count,
    FloorOption,
    ForceOption,
    JsonOption,
    PatchOption,
    ProgressOption,
    Seconds,
    Seed,
    SensorsOption,
    environment_of,
    handed,
    note_untrained,
    refuse_given,
    settings_of,
)
from wlr_gym.cli.terminal import print_json, print_table
from wlr_gym.envs.registry import task_name_of
from wlr_gym.envs.tasks.task import having
from wlr_gym.learning.evaluation import card as cards
from wlr_gym.learning.evaluation import scoring
from wlr_gym.learning.evaluation.card import MAIN, Card
from wlr_gym.learning.evaluation.conditions import FIRST_SEED, Condition, sweeps_for
from wlr_gym.learning.evaluation.episode_recorder import record_episodes, write_samples
from wlr_gym.learning.evaluation.rollout import Rollout
from wlr_gym.learning.evaluation.scoring import BACKENDS, BASELINES, accept, evaluate
from wlr_gym.learning.evaluation.subjects import Subject, common_robot, make_player, read_subjects
from wlr_gym.policy import shipped_names, trained_environment
from wlr_gym.render.video import check_video
from wlr_gym.robot import robot_content

#: With --full.
FULL_BASELINES = ("do_nothing", "constant_command", "pid", "slip_compensating_no_camera", "slip_compensating")
EPISODES = 64
FULL_EPISODES = 256
BLOCKS = 1
FULL_BLOCKS = 5


@dataclass(frozen=True)
class EvaluateOptions(ProgressOption, JsonOption, ForceOption, PatchOption, FloorOption, SensorsOption):
    policy: tyro.conf.Positional[tuple[str, ...]] = ()
    """Agent, policy file (.onnx), policy or run folder, or shipped policy; NAME=POLICY names it. Several, NAME=POLICY,POLICY, a
    pattern ('out/five/trials/*') or a folder of run folders: trainings of one recipe with different seeds, as one column."""
    env: str | None = None
    """Environment id (see: wlr envs); default: the one the policy was trained in, else WLR-Velocity-v0."""
    baselines: tuple[str, ...] | None = None
    """What to compare with, on the same episodes; as the policy. Default: do_nothing, pid, slip_compensating if trained;
    with --full every agent without learning and the environment's shipped policies."""
    full: bool = False
    """The whole card: 5 blocks of 256 episodes, every sweep, both simulators. Minutes per policy; options below still count."""
    episodes: Count | None = None
    """Number of episodes per block; default: 64, with --full 256."""
    blocks: Count | None = None
    """Number of blocks of --episodes, each with its own seeds; default: 1, with --full 5."""
    seed: Seed = FIRST_SEED
    """Seed of the first episode; the others count up from it, each further one of --blocks from 10000 above the last one."""
    backend: str | None = None
    """Simulator: gibbs_appell, mujoco, or both (the second for the main table only); default: the first, with --full both."""
    other_episodes: Count = scoring.OTHER_EPISODES
    """Episodes in the second simulator."""
    sweep: tuple[str, ...] | None = None
    """Sweeps: friction, split, floors, slope, grip, shapes, paper, latency, payload; default: none, with --full all that suit
    the task."""
    sweep_episodes: Count = scoring.SWEEP_EPISODES
    """Episodes per point of a sweep."""
    randomization: str | None = None
    """Name in configs/randomization/, path, or a gap result (.json); default: the task's."""
    robot: str | None = None
    """Robot file, or name in configs/robot/; default: the robot that the policy was trained with, else the task's."""
    threads: Count = 1
    """Threads of the simulator; results do not depend on it."""
    accept: bool = False
    """Acceptance test instead of the card: on every family of floors of the task the policy must not lose more than 5 % of
    tracking error (upper 95 % bound) against the baselines (default: its controller and the blind policy); 5 blocks of 512
    episodes. Exit code 1 where it does."""
    out: Path | None = None
    """Folder for card.md, card.json, pictures, episodes.parquet (every episode's scores) and samples.csv (what randomization
    drew); default: only print."""
    record: Annotated[int, Interval(least=0)] = 0
    """Write so many of the policy's episodes as runs into the folder OUT/runs."""
    video: Path | None = None
    """Film (.webp, .gif, .png, .mp4) of the first episode: the policy, beside the first baseline where there is one."""
    video_seconds: Seconds = 10.0
    """Length of the film."""


def run(options: EvaluateOptions) -> int:
    """Play, print the card, write it."""
    if not options.policy:
        raise InputError("no policy given; see: wlr evaluate --help")
    options.present()  # what cannot be is refused before anything is written
    if options.accept:
        return _accept(options)
    options = _complete(options)
    _check(options)
    subjects = _subjects(options)
    patch = options.patch()
    if options.out is not None:
        options.refuse_results(options.out, "card.json")
    first: list[Rollout] = []  # the first block of the first subject

    def watch(condition: Condition, subject: Subject, block: int, rollout: Rollout) -> None:
        if not first:
            first.append(rollout)

    with _progress(options.progress) as tell:
        own = {"env_id": options.env, "sweeps": options.sweep, "sensors": options.present(), "effects": patch}
        card = evaluate(**handed(options, evaluate, **own, tell=tell, watch=watch))
    if options.json:
        print_json(cards.content(card))
    else:
        print_card(card)
    robot = options.robot or common_robot(subjects)
    keywords = {
        "randomization": options.randomization, "robot": robot, "effects": patch, "floor": options.floor,
        "threads": options.threads,
        "backend": BACKENDS[0] if options.backend == "both" else options.backend, **having(options.present()),
    }  # fmt: skip
    if options.out is not None:
        driven: dict[str, Any] = {} if robot is None else {"robot": robot_content(robot)}
        _write(options.out, card, first[0], options.seed)
        driven |= {"effects": patch.content()["effects"]} | options.floor_content()
        record_provenance(options.out, settings_of(options) | driven, options.seed)
        if options.record:
            source, folder = _shown(card, subjects[0]).sources[0], options.out / "runs"
            core, policy = make_player(str(options.env), source, options.record, keywords)
            with closing(core):
                written = record_episodes(core, policy, folder, options.seed)
            print(f"written: {len(written)} runs in {folder}")
    if options.video is not None:
        from wlr_gym.learning.evaluation.film import film_beside

        shown = [_shown(card, subject) for subject in subjects[:2]]
        drawn = partial(tracked, text="drawing", console=Console(), shown=options.progress)
        film_beside(options.video, str(options.env), shown, options.seed, options.video_seconds, keywords, watch=drawn)
        print(f"written: {options.video}")
    return OK


def _accept(options: EvaluateOptions) -> int:
    """Run the acceptance test, print its table, write it."""
    if len(options.policy) != 1:
        raise InputError(f"--accept: expected one policy, got {len(options.policy)}")
    refuse_given(
        options, ("full", "sweep", "backend", "record", "video", "seed"), "it is of the card: leave it out with --accept"
    )
    _subjects(options)
    if options.out is not None:
        refuse_existing(options.out / scoring.ACCEPTANCE_FILE, options.force)
    with _progress(options.progress) as tell:
        own = {
            "policy": options.policy[0], "env_id": options.env, "references": options.baselines,
            "floors": None if options.randomization is None else (options.randomization,),
            "episodes": scoring.ACCEPTANCE_EPISODES if options.episodes is None else options.episodes,
            "blocks": scoring.ACCEPTANCE_BLOCKS if options.blocks is None else options.blocks,
            "sensors": options.present(), "effects": options.patch(), "floor": options.floor,
            "threads": options.threads, "tell": tell,
        }  # fmt: skip
        result = accept(**handed(options, accept, **own))
    if options.json:
        print_json(result)
    title = f"acceptance of {result.policy}: {result.blocks} x {result.episodes} episodes a family"
    _print(title, scoring.acceptance_rows(result))
    if options.out is not None:
        scoring.write_acceptance(options.out / scoring.ACCEPTANCE_FILE, result)
        print(f"written: {options.out / scoring.ACCEPTANCE_FILE}")
    print("accepted" if result.accepted else f"refused: {len(result.refused)} losses may be above {result.largest_loss:g} %")
    return OK if result.accepted else FAILED


def _subjects(options: EvaluateOptions) -> tuple[Subject, ...]:
    """Return who plays; of one before any training that is said."""
    subjects = read_subjects([options.policy, *(options.baselines or ())])
    note_untrained(source for subject in subjects for source in subject.sources)
    return subjects


def _shown(card: Card, subject: Subject) -> Subject:
    """Return whom to watch: of several training seeds the median one."""
    if not subject.seeds:
        return subject
    return replace(subject, sources=(subject.sources[subject.seeds.index(card.seed_scores[subject.name].median_seed)],))


def _complete(options: EvaluateOptions) -> EvaluateOptions:
    """Return the options with nothing left open that --full and the policy decide."""
    full = options.full
    environment = environment_of(options.env, read_subjects([options.policy])[0].sources[0])
    chosen = {
        "env": environment,
        "episodes": FULL_EPISODES if full else EPISODES,
        "blocks": FULL_BLOCKS if full else BLOCKS,
        "backend": "both" if full else BACKENDS[0],
        "sweep": sweeps_for(task_name_of(environment)) if full else (),
    }
    if options.baselines is None:
        names = FULL_BASELINES if full else BASELINES
        fitting = scoring.default_baselines(read_subjects([options.policy])[0].sources[0], environment, names)
        if not set(names) <= set(fitting):
            print(f"no baseline here, made for other tasks: {', '.join(name for name in names if name not in fitting)}")
        shipped = shipped_names() if full else ()  # reading them needs onnxruntime
        chosen["baselines"] = (*fitting, *(name for name in shipped if trained_environment(name) == environment))
    elif (subject := read_subjects([options.policy])[0]) in read_subjects(options.baselines):
        print(f"no baseline, the policy itself: {subject.name}")
    return replace(options, **{name: value for name, value in chosen.items() if getattr(options, name) is None})


def _check(options: EvaluateOptions) -> None:
    check_name("backend", options.backend, (*BACKENDS, "both"), "--backend")
    if options.record and (options.out is None or not 0 < options.record <= (options.episodes or 0)):
        raise InputError(f"--record {options.record}: expected 0 to {options.episodes} (--episodes), and --out for the runs")
    if options.video is not None:
        check_video(options.video)
        refuse_existing(options.video, options.force, "--video")


@contextmanager
def _progress(shown: bool) -> Iterator[Callable[[str, float], None]]:
    """Show a bar with the time left; yields a function that is told what is going on and the share that was done since."""
    done = 0.0
    with progress(Console(), shown=shown) as tell:

        def told(text: str, share: float) -> None:
            nonlocal done
            done += share
            tell("", f"evaluating: {text}", done)

        yield told


def _write(folder: Path, card: Card, samples: Rollout, seed: int) -> None:
    from wlr_gym.learning.evaluation.plots import draw_card

    pictures = draw_card(folder, card)
    cards.write_card(folder, card, pictures)
    cards.write_episodes(folder / "episodes.parquet", card, seed)
    write_samples(folder / "samples.csv", samples)
    names = ("card.md", "card.json", "episodes.parquet", "samples.csv", *pictures.values())
    print(f"written to {folder}: {', '.join(names)}")


def print_card(card: Card) -> None:
    """Print the tables of a card, intervals as ± half of their width."""
    for name, seeds in card.seed_scores.items():
        _print(f"training seeds of {name}, median seed {seeds.median_seed}", cards.seed_rows(card, name, short=True))
    _print("mean over episodes ± half of the 95 % confidence interval", cards.rows(card.scores[MAIN], card.metrics, short=True))
    if len(card.names) > 1:
        _print(f"{card.names[0]} is better by, paired episode by episode", cards.comparison_rows(card, short=True))
    for index, sweep in enumerate(card.sweeps):
        _print(f"sweep {sweep.name}: tracking error", cards.sweep_rows(card, index))
    if cards.OTHER_PLANT in card.results:
        _print("on both simulators, same episodes", cards.transfer_rows(card, short=True))


def _print(title: str, table: Sequence[Sequence[str]]) -> None:
    header, *body = table
    print_table(Console(), header, body, title)
