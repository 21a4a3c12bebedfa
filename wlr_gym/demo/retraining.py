"""Last stage: the policy trains on with what was found, and drives the robot with the fault in turns with the old one."""

from __future__ import annotations

from typing import Any

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.base.html import commands, table
from wlr_gym.demo.diagnosis import POLICY
from wlr_gym.demo.page import ENVIRONMENT, NOT_SHOWN, SHOWN, SKIPPED, Demo, Section, Tell, filmed, paragraph
from wlr_gym.envs.tasks.task import having
from wlr_gym.gap.report.text import listed, places, plain
from wlr_gym.learning.evaluation.subjects import Subject

TITLE = "6. What training on wins back"
OLD, NEW = "old policy", "trained on"
#: The film: drive on, turn both ways, stop.
SCHEDULE = "0:0.1,0; 1:0.1,-0.4; 3:0.1,0.4; 5:0,0"
#: Shares of the stage: training, driving with the fault and without it; the film is the rest.
_TRAINING, _DRIVING, _WITHOUT = 0.5, 0.2, 0.1


def retrain(demo: Demo, tell: Tell) -> Section:
    """Train on from the shipped policy, drive both on the robot with the fault, film them."""
    from wlr_gym.gap.decision import Decided, History
    from wlr_gym.gap.report.result import RESULT_FILE, read_result
    from wlr_gym.learning.adaptation.adapt import state_uncertainty
    from wlr_gym.learning.adaptation.driving import AFTER, EmulatedRobot, drive_after, episodes_of, errors_of, seeds_of
    from wlr_gym.learning.adaptation.retraining import TRAINING, train_in, trained_policy
    from wlr_gym.learning.adaptation.state import Asked, Progress
    from wlr_gym.physics.effects import load_patch
    from wlr_gym.robot import load_robot, robot_hash

    if not (demo.gap / RESULT_FILE).is_file():
        raise InputError("no result of the gap workflow to train on with")
    own, hidden = load_robot(), load_patch(demo.hidden)
    asked = Asked(
        policy=POLICY,
        identity="",
        environment=ENVIRONMENT,
        robot=robot_hash(own),
        driven="emulated",
        drives=demo.drives,
        drive_seconds=demo.drive_seconds,
        steps=demo.further_steps,
        seed=demo.seed,
    )
    progress = Progress(demo.adapted, asked, lambda text, share: tell(f"training on: {text}", _TRAINING * share))
    result = read_result(demo.gap / RESULT_FILE)
    history = History(data=str(demo.measured), robot=None, backend="gibbs_appell", known=[])
    model, found = state_uncertainty(progress, Decided(history, result, demo.gap), own)
    if found is None:
        return Section(TITLE, "Left out: the gap workflow states no numbers to train on with.", _said(model), SKIPPED)
    command = train_in(progress, TRAINING, found.training)
    progress.tell = lambda text, share: tell(text, _TRAINING + _DRIVING * share)
    after = drive_after(progress, EmulatedRobot(own, hidden), trained_policy(progress))
    progress.tell = lambda text, share: tell(text, _TRAINING + _DRIVING + _WITHOUT * share)
    driven = episodes_of(progress, "without_fault", {"old": POLICY}, EmulatedRobot(own), seeds_of(AFTER, asked))
    numbers = after.numbers | {"healthy": errors_of(driven["old"]).tolist()}
    headline, verdict = outcome(numbers)
    said, caveats = won_back(numbers)
    html = paragraph(
        f"The shipped policy {POLICY}, which has driven this robot, trains on for {demo.further_steps:,} environment steps on "
        "the simulator with what the gap workflow found and calibrated, each number drawn from its interval. It is not told "
        "what was hidden."
    )
    html += _said(model) + commands([command])
    html += paragraph(
        f"Then both drive the emulated robot with the hidden fault in turns: {demo.drives} episodes of "
        f"{demo.drive_seconds:g} s each, the same commands for both, none met in training; the old one also drives the robot "
        "without it."
    )
    html += _episodes(numbers) + _said(after) + paragraph(said) + _film(demo, hidden, numbers, tell)
    return Section(TITLE, headline, html, verdict, caveats)


def won_back(numbers: dict[str, Any]) -> tuple[str, list[str]]:
    """Return in words what share of the fault's cost training on wins back, and the caveats.

    Args:
        numbers: tracking errors ``old``, ``new`` and ``healthy`` (old policy, no fault) of the same episodes, ``better_ci95``.
    """
    from wlr_gym.learning.adaptation.driving import share_regained

    old, new, healthy = (np.array(numbers[name]) for name in ("old", "new", "healthy"))
    said = f"On the same robot without the fault, the old policy's tracking error is {healthy.mean():.3f} in these episodes"
    low, high = numbers["better_ci95"]
    caveats = ["the interval of the change contains 0"] if low <= 0.0 <= high else []
    if worse := int((new > old).sum()):
        caveats.append(f"in {worse} of {len(old)} episodes the policy that was trained on is worse")
    if old.mean() <= healthy.mean():
        return f"{said}: the fault costs it nothing.", [*caveats, "the fault costs the old policy nothing in these episodes"]
    share = share_regained(old, new, healthy)
    won = f"{share.mean:.0f} % (95 % interval {share.low:.0f} to {share.high:.0f}) of what the fault costs"
    if share.mean < 100.0:
        left = f"{old.mean():.3f} to {new.mean():.3f}, {healthy.mean():.3f} without the fault"
        caveats.append(f"training on wins back {won}, the rest is left ({left})")
    return f"{said}: training on wins back {won}.", caveats


def outcome(numbers: dict[str, Any]) -> tuple[str, str]:
    """Return the sentence for the top of the page, and whether training on has shown to help.

    Args:
        numbers: tracking errors ``old`` and ``new`` of the same episodes, ``better_percent`` and ``better_ci95``.
    """
    better, (low, high) = numbers["better_percent"], numbers["better_ci95"]
    before, after = (f"{np.mean(numbers[name]):.3f}" for name in ("old", "new"))
    change = f"{-better:+.0f} % (95 % interval {-high:+.0f} to {-low:+.0f} %, {len(numbers['old'])} pairs of episodes)"
    verdict, tail = (SHOWN, "") if low > 0.0 else (NOT_SHOWN, " No difference beyond the interval.")
    if high < 0.0:
        tail = " Training on made it worse."
    return f"Tracking error on the robot with the fault {before} before and {after} after training on: {change}.{tail}", verdict


def _said(step: Any) -> str:
    return "".join(paragraph(line) for line in step.said)


def _episodes(numbers: dict[str, Any]) -> str:
    rows = [
        (f"{index + 1}", f"{old:.3f}", f"{new:.3f}", f"{100.0 * (1.0 - new / old):+.0f}", f"{healthy:.3f}")
        for index, (old, new, healthy) in enumerate(zip(numbers["old"], numbers["new"], numbers["healthy"], strict=True))
    ]
    headings = ("episode", f"tracking error, {OLD}", f"tracking error, {NEW}", "better by (%)", f"{OLD}, without the fault")
    return table(headings, rows, range(1, 5))


def _film(demo: Demo, hidden: Any, numbers: dict[str, Any], tell: Tell) -> str:
    from wlr_gym.learning.adaptation.retraining import TRAINING

    sources = ((OLD, POLICY, "old"), (NEW, str(demo.adapted / TRAINING / "policy"), "new"))
    fault = listed([f"{plain(one.name)}, {places(one.where)}" for one in hidden.effects])
    tell("film: the old policy beside the new one", _TRAINING + _DRIVING + _WITHOUT)
    subjects = [Subject(f"{name}: tracking error {np.mean(numbers[key]):.3f}", (source,)) for name, source, key in sources]
    path, robot = demo.out / "trained_on.webp", {"randomization": "none", "effects": hidden, **having(())}
    options = {"schedule": SCHEDULE, "title": f"fault: {fault}"}
    return filmed(path, demo, subjects, 0.5 * demo.film_seconds, robot, _CAPTION, **options)


_CAPTION = (
    "The robot with the hidden fault, simulated, the same commands for both: drive on, turn right, turn left, stop. Above: "
    "each policy's mean tracking error over the episodes of the table. Arrows: where each wheel slips to, 0.1 m for 0.05 m/s. "
    "Pink: the path of the robot; dashed: the path that was commanded. One scene; what counts is the table."
)
