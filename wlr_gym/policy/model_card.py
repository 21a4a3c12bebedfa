"""Model cards: what a policy file is, how it came about and how well it drives, as Markdown beside it."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import write_text
from wlr_gym.base.text import tally
from wlr_gym.policy.file import needs_camera
from wlr_gym.policy.onnx_file import open_policy

SUFFIX = ".md"
#: Observations that come from the pose that the slip observer has.
_FROM_POSE = ("path_error", "course_error")


def write_model_card(policy: Path, evaluation: str) -> Path:
    """Write the model card of a policy file beside it, and return its path.

    Args:
        policy: the file.
        evaluation: score card as Markdown, as ``wlr evaluate --out`` writes it.

    Raises:
        InputError: no policy file, a broken one, or scores that do not name it and its fingerprint.
    """
    _, content = open_policy(policy)
    if policy.stem not in evaluation:
        raise InputError(f"the score card is about other policies than '{policy.stem}'")
    if file_hash(policy) not in evaluation:
        raise InputError(
            f"the score card is about another '{policy.stem}': SHA-256 {file_hash(policy)} is not in it; evaluate anew"
        )
    card = policy.with_suffix(SUFFIX)
    facts = "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in _facts(policy, content).items())])
    write_text(card, "\n\n".join([f"# {policy.stem}", _summary(content), facts, _below(evaluation)]) + "\n")
    return card


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file, as ``sha256sum`` prints it."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _summary(content: Mapping[str, Any]) -> str:
    environment, training = content["environment"], content.get("training", {})
    sources = {column["source"] for column in environment["observation"]}
    camera = "with" if needs_camera(environment) else "without"
    if 0.0 < (environment.get("sensors") or {}).get("camera", 0.0) < 1.0:
        camera = "with or without"
    if "truth" in sources:
        sees = "It sees what no robot can measure, friction for example: an upper bound, for simulators only."
    elif "estimate" in sources:
        sees = f"It sees the estimates of the slip observer, {camera} a camera."
    elif _term_counts(environment["observation"]).keys() & set(_FROM_POSE):
        sees = f"It sees no estimate of slip, but errors of its way from the slip observer's pose, {camera} a camera."
    else:
        sees = "It is blind to slip: it sees neither estimates of it nor a camera."
    return (
        f"A policy for `{training.get('environment', environment['task'])}`. {sees} Trained and evaluated in simulation; no "
        "real robot was driven. `wlr play`, `wlr evaluate` and `wlr deploy` take it by name or path."
    )


def _facts(policy: Path, content: Mapping[str, Any]) -> dict[str, str]:
    environment, training, config = content["environment"], content.get("training", {}), content["config"]
    facts = {
        "file": f"`{policy.name}`, {policy.stat().st_size / 1000:.0f} kB",
        "SHA-256": f"`{file_hash(policy)}`",
        "robot": f"{environment['robot']['name']}, at {1.0 / environment['control_period']:g} Hz",
        "observation": f"{len(environment['observation'])} numbers: {tally(_term_counts(environment['observation']))}",
        "action": f"{len(environment['action'])} setpoints of joints",
        "randomisation": environment.get("randomization", {}).get("name") or "as in the contract",
    }
    if "command" in training:
        facts["trained with"] = f"`{training['command']}`"
    facts["training"] = ", ".join(_training(content["agent"], training, config))
    facts["versions"] = tally(content.get("versions", {}))
    if "exported" in content:
        parity = content["exported"]["parity"]
        largest = max(parity["random"], parity["real"])
        facts["same as the trained network"] = f"within {largest:.1e} on {parity['observations']} observations"
    return facts


def _term_counts(columns: list[Mapping[str, Any]]) -> Counter[str]:
    return Counter(column["name"].partition("[")[0] for column in columns)


def _training(agent: str, training: Mapping[str, Any], config: Mapping[str, Any]) -> list[str]:
    found = [agent]
    if "steps" in training:
        found.append(f"{training['steps']:,} environment steps")
    if "seconds" in training:
        found.append(f"{training['seconds'] / 60.0:.1f} min with {config.get('torch_threads', 1)} thread(s)")
    if "seed" in training:
        found.append(f"seed {training['seed']}")
    if training.get("git_commit"):
        found.append(f"commit {_short(training['git_commit'])}")
    return found


def _short(commit: str) -> str:
    """Abbreviate the hash; ``-dirty`` stays."""
    name, _, state = commit.partition("-")
    return f"{name[:7]}-{state}" if state else name[:7]


def _below(evaluation: str) -> str:
    """Return a score card as part of another document: headings a level deeper, without pictures, which stay where they are."""
    words = re.sub(r"^#.*\n+(?:!\[.*\n*)+(?=#|\Z)", "", evaluation, flags=re.MULTILINE)  # sections that only show one
    lines = [line for line in words.strip().splitlines() if not line.startswith("![")]
    return re.sub(r"\n{3,}", "\n\n", "\n".join(f"#{line}" if line.startswith("#") else line for line in lines))
