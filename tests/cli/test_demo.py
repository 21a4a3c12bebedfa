"""``wlr demo`` end to end, as short as can be, and what it does when things are missing or somebody stops it."""

import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from wlr_gym.base.files import write_json
from wlr_gym.base.provenance import record_provenance
from wlr_gym.cli import INTERRUPTED, main
from wlr_gym.data import read_dataset
from wlr_gym.demo import diagnosis, policies, retraining, workers
from wlr_gym.demo.page import NOT_SHOWN, SHOWN, SKIPPED, TERMS, Demo, Section
from wlr_gym.demo.page import page as page_of
from wlr_gym.gap.report.result import PATCH_FILE, RESULT_FILE
from wlr_gym.learning.evaluation.metrics import Estimate, Metric
from wlr_gym.physics.effects import load_patch, save_patch

COMMAND = [sys.executable, "-c", "import sys; from wlr_gym.cli import main; sys.exit(main())", "demo", "--quick"]
NO_NUMBERS = {
    "verdict": "not_excited", "effects": [], "equivalent": [], "calibration": {}, "localisation": {}, "gap": None,
    "runs": {"fit": [], "heldout": []}, "patch": "patch.yaml",
}  # fmt: skip
ROOT = Path(__file__).parents[2]
TITLES = [stage.title for stages in workers.WORKERS.values() for stage in stages]


def check_links(page, folder):
    """Every link leads to a section of the page, or to a file or folder beside it."""
    targets = re.findall(r'href="([^"]+)"', page)
    named = re.findall(r'id="([^"]+)"', page)
    assert len(named) == len(set(named))
    for target in targets:
        assert target[1:] in named if target.startswith("#") else (folder / target).exists(), target
    assert {target[1:] for target in targets if target.startswith("#")} == set(named)


@pytest.mark.slow
def test_the_whole_loop_ends_in_one_page(tmp_path, capsys):
    for package in ("torch", "stable_baselines3", "onnxruntime", "dynamixel_sdk", "serial"):
        pytest.importorskip(package)
    out = tmp_path / "demo"
    assert main(["demo", "--quick", "--out", str(out), "--seed", "0", "--no-progress"]) == 0
    assert capsys.readouterr().out.strip().splitlines()[-1] == str(out / "demo.html")
    page = (out / "demo.html").read_text()
    assert all(f"<h2>{title}</h2>" in page.replace("&#x27;", "'") for title in TITLES)
    assert not re.search(r'src="(?!data:)', page)  # all of it is inside, but for the files that it names
    check_links(page, out)
    assert 'href="gap/report.html"' in page
    assert 'href="measured_runs/"' in page
    assert "http" not in re.sub(r'"data:[^"]*"', "", page)
    assert page.count("data:image/png") >= 4
    hidden = load_patch(out / "hidden.yaml").effects[0]
    assert hidden.name.replace("_", " ") in page
    assert len(read_dataset(out / "measured_runs").runs) == 3
    assert (out / "gap" / "patch.yaml").is_file()
    for table in re.findall(r"<table>.*?</table>", page, re.DOTALL):
        assert "nan" not in table
    assert "Left out" in page or (out / "trained_on.webp").is_file()


def test_links_lead_to_what_is_there(tmp_path):
    demo = Demo(tmp_path)
    sections = [Section(title, "said", "<p>text</p>") for title in TITLES]
    assert "Files:" not in page_of(demo, sections)
    demo.measured.mkdir()
    demo.hidden.touch()
    text = page_of(demo, sections)
    check_links(text, tmp_path)
    assert 'Files: <a href="measured_runs/">measured runs</a>, <a href="hidden.yaml">hidden fault</a>.' in text
    named = re.findall(r"docs/\w+\.md", text)
    assert "docs/gap.md" in named
    assert all((ROOT / name).is_file() for name in named)


def test_caveats_are_said_where_there_is_any():
    good = Section("1. Good", "said", "<p>text</p>")
    bad = Section("2. Bad", "said", "<p>text</p>", caveats=("this < that", "nor is this"))
    assert "Caveats" not in page_of(Demo(Path()), [good])
    text = page_of(Demo(Path()), [good, bad])
    assert text.count("<b>Caveats:</b> this &lt; that; nor is this.") == 2  # at the top, and in the section
    assert text.index("Caveats") > text.index("2. Bad")


def test_what_is_not_installed_is_left_out_and_said(tmp_path, monkeypatch):
    def missing(package, extra):
        raise workers.MissingPackageError(f"this needs the package '{package}': pip install 'wlr-gym[{extra}]'")

    monkeypatch.setattr(workers, "require_package", missing)
    sent = []
    for worker in workers.WORKERS:
        workers.work(worker, Demo(tmp_path), sent.append)
    sections = [message["section"] for message in sent if "section" in message]
    assert [one["title"] for one in sections] == TITLES
    assert [one["verdict"] for one in sections[:3]] == [SKIPPED] * 3
    assert "pip install &#x27;wlr-gym[train]&#x27;" in sections[0]["html"]
    assert "the robot was not driven" in sections[3]["html"]
    assert "no result of the gap workflow" in sections[4]["html"]
    assert sections[5]["verdict"] == SKIPPED


def numbers(old, new, better, low, high):
    return {"old": old, "new": new, "better_percent": better, "better_ci95": [low, high]}


@pytest.mark.parametrize(
    ("new", "better", "verdict", "said"),
    [
        (
            [0.3, 0.5],
            (20.0, 12.0, 31.0),
            SHOWN,
            ["0.500 before and 0.400 after", ": -20 % (95 % interval -31 to -12 %, 2 pairs"],
        ),
        # of the error: minus is better
        ([0.4, 0.58], (2.0, -3.0, 5.0), NOT_SHOWN, [": -2 % (95 % interval -5 to +3 %", "No difference beyond the interval"]),
        ([0.5, 0.7], (-20.0, -31.0, -12.0), NOT_SHOWN, [": +20 % (95 % interval +12 to +31 %", "made it worse"]),
    ],
)
def test_training_on_is_ticked_only_where_the_interval_says_so(new, better, verdict, said):
    sentence, found = retraining.outcome(numbers([0.4, 0.6], new, *better))
    assert found == verdict
    assert all(text in sentence for text in said)


def test_what_is_won_back_of_the_fault_is_said():
    driven = numbers([0.4, 0.6], [0.3, 0.4], 30.0, 12.0, 40.0)
    said, caveats = retraining.won_back(driven | {"healthy": [0.2, 0.2]})
    assert "tracking error is 0.200 in these episodes: training on wins back 50 % (95 % interval 50 to 50)" in said
    assert caveats == [
        "training on wins back 50 % (95 % interval 50 to 50) of what the fault costs, the rest is left (0.500 to 0.350, "
        "0.200 without the fault)"
    ]
    assert retraining.won_back(driven | {"healthy": [0.3, 0.4]})[1] == []
    assert "costs it nothing" in retraining.won_back(driven | {"healthy": [0.5, 0.5]})[0]
    unsure = numbers([0.4, 0.6], [0.45, 0.4], 15.0, -3.0, 40.0) | {"healthy": [0.3, 0.3]}
    assert retraining.won_back(unsure)[1][:2] == [
        "the interval of the change contains 0",
        "in 1 of 2 episodes the policy that was trained on is worse",
    ]


def test_references_that_earn_more_are_named():
    assert policies.behind(1.8, {"do_nothing": 0.4, "pid": 1.7}) == []
    (said,) = policies.behind(1.8, {"do_nothing": 0.4, "pid": 1.85})
    assert said == "in whole episodes, pid (1.85) gets more reward per second than the new policy (1.80)"


def test_terms_are_those_of_the_glossary():
    glossary = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
    for term, meaning in TERMS.items():
        assert f"| {term} | {meaning} |" in glossary
    assert "Tracking error: rms of the episode&#x27;s measures" in page_of(Demo(Path()), [])


def card(**better):
    """A card whose policies score alike; ``better``: intervals by which the slip-aware one beats the blind one."""
    metrics = [
        Metric(key, "%", 0, False, "") if key == "success" else Metric(key, "m/s", 4, True, "")
        for key in policies.SHOWN_METRICS
    ]
    even = {metric.key: Estimate(90.0, 80.0, 99.0) for metric in metrics}
    won = {metric.key: Estimate(9.0, 5.0, 12.0) for metric in metrics}
    scores = {policies.OURS: even | {"excess_slip": Estimate(0.0043, 0.004, 0.005)}, policies.BLIND: even}
    labels = list(policies.FLOORS)
    compared = {key: {policies.BLIND: won} for key in labels}
    compared[labels[0]] = {policies.BLIND: won | better}
    return SimpleNamespace(metrics=metrics, scores=dict.fromkeys(labels, scores), comparison=compared)


def test_where_the_slip_aware_policy_is_no_better_is_said():
    def short(**better) -> list[str]:
        return policies.falls_short(cast(Any, card(**better)))

    assert short() == []
    assert short(excess_slip=Estimate(-8.0, -12.0, -5.0)) == [
        "on ice, velocity_blind has the better excess slip (90.0000 against 0.0043 m/s)"
    ]
    assert short(excess_slip=Estimate(-3.0, -8.0, 2.0)) == [
        "on ice, velocity_slip_aware is not measurably better than velocity_blind in excess slip (0.0043 against 90.0000 m/s)"
    ]
    assert short(success=Estimate(1.0, -2.0, 5.0)) == [
        "on ice, velocity_slip_aware is not measurably better than velocity_blind in success (90 against 90 %)"
    ]


def test_without_numbers_of_the_gap_workflow_nothing_is_trained(tmp_path):
    demo = Demo(tmp_path)
    save_patch(load_patch([diagnosis.hide(0)]), demo.hidden)
    demo.gap.mkdir()
    write_json(demo.gap / RESULT_FILE, NO_NUMBERS)
    save_patch(load_patch(None), demo.gap / PATCH_FILE)
    section = retraining.retrain(demo, lambda text, share: None)
    assert section.verdict == SKIPPED
    assert "no numbers to train on with" in section.headline
    assert "The verdict is 'not_excited'" in section.html.replace("&#x27;", "'")


def test_a_stage_that_fails_does_not_take_the_others_with_it(tmp_path, monkeypatch, capsys):
    def broken(demo, tell):
        raise RuntimeError("boom")

    monkeypatch.setattr(
        workers, "WORKERS", {"one": (workers.DemoStage("bad", broken, 0.5), workers.DemoStage("good", _good, 0.5))}
    )
    sent = []
    workers.work("one", Demo(tmp_path), sent.append)
    bad, good = (message["section"] for message in sent if "section" in message)
    assert (bad["verdict"], good["verdict"]) == (workers.FAILED, "shown")
    assert "RuntimeError: boom" in bad["html"]
    assert "RuntimeError: boom" in capsys.readouterr().err


def _good(demo, tell):
    tell("working", 0.5)
    return workers.Section("good", "it works", "<p>fine</p>")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_ctrl_c_leaves_what_was_made(tmp_path):
    pytest.importorskip("torch")
    out = tmp_path / "demo"
    process = subprocess.Popen(
        [*COMMAND, "--steps", "50_000_000", "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # a background shell has switched it off
    )
    curve = out / "run" / "learning_curve.csv"
    deadline = time.monotonic() + 120.0
    while not curve.is_file() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    said, trouble = process.communicate(timeout=150)
    assert process.returncode == INTERRUPTED, trouble
    assert said.strip().splitlines()[-1] == str(out / "demo.html")
    page = (out / "demo.html").read_text()
    assert "Stopped before it was over" in page
    assert "Not reached: the demo was stopped." in page
    assert list((out / "run" / "checkpoints").glob("step_*"))  # the policy so far


def test_bad_options(tmp_path, capsys):
    assert main(["demo", "--seed", "-1", "--out", str(tmp_path / "a")]) == 2
    assert main(["demo", "--steps", "0", "--out", str(tmp_path / "a")]) == 2
    assert not (tmp_path / "a").exists()
    assert "--seed -1: expected a number from 0 to 4294967295" in capsys.readouterr().err


def test_demo_does_not_remove_what_is_not_its_own(tmp_path, capsys):
    mine = tmp_path / "demo" / "thesis.txt"
    mine.parent.mkdir()
    mine.write_text("years of work")
    assert main(["demo", "--out", str(tmp_path / "demo")]) == 2
    assert "'thesis.txt' is in the way" in capsys.readouterr().err
    assert mine.read_text() == "years of work"


def test_demo_does_not_remove_a_training(tmp_path, capsys):
    run = tmp_path / "run"
    record_provenance(run, {"environment": "WLR-Velocity-v0", "agent": "ppo", "settings": {}}, 0)
    assert main(["demo", "--force", "--out", str(run)]) == 2
    assert "is in the way" in capsys.readouterr().err
    assert (run / "config.yaml").is_file()
