"""Policy files: made from trained policies, which must answer alike, and their model cards."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.base.files import replace_file, write_text
from wlr_gym.base.provenance import versions
from wlr_gym.base.text import tally
from wlr_gym.policy.agents import Contract, Policy, agent_function, find_policy
from wlr_gym.policy.file import needs_camera, read_contract
from wlr_gym.policy.onnx_file import SUFFIX, open_policy, seal

#: Random observations that are compared.
RANDOM = 1000
#: Largest difference of an action. Sums of a hundred float32 numbers round to about 1e-6; another graph is off by far more.
TOLERANCE = 1e-5


@dataclass(frozen=True)
class Parity:
    """How alike the trained policy and its file are.

    Attributes:
        random, real: largest difference of an action over random and over real observations.
        observations: how many of both were compared.
    """

    random: float
    real: float
    observations: int


def export_policy(
    source: str | Path, path: Path, observations: NDArray[np.float32], training: Mapping[str, Any] | None = None
) -> Parity:
    """Write a trained policy as one file; a file that is there already is replaced in one step, or not at all.

    Args:
        source: policy folder, or run folder with a ``policy`` in it.
        path: of the file, ending in ``.onnx``.
        observations: (M, D) real ones, to compare with.
        training: further facts of its training, for the contract's ``training``.

    Raises:
        InputError: no policy folder, an agent whose policies cannot be exported, a file that cannot be written, or one that
            answers differently from the policy.
        MissingPackageError: a package is not installed.
    """
    folder = exportable(source)
    content = read_contract(folder)
    graph = agent_function(content["agent"], "export_network")(folder, content)
    policy = agent_function(content["agent"], "load_policy")(folder, content)
    content["training"] = {**content.get("training", {}), **(training or {})}
    return write_policy_file(path, graph, content, policy, observations)


def exportable(source: str | Path) -> Path:
    """Return the folder of a trained policy.

    Raises:
        InputError: there is none, or it is a policy file.
    """
    folder = find_policy(source)
    if folder.is_file():
        raise InputError(f"{folder}: is a policy file already: copy it; what can be exported is a policy or run folder")
    return folder


def write_policy_file(
    path: Path, graph: bytes, content: dict[str, Any], policy: Policy, observations: NDArray[np.float32]
) -> Parity:
    """Write a graph with its contract as a policy file, if it answers as the policy does that it was made from.

    Args:
        path: of the file, ending in ``.onnx``; one that is there already is replaced in one step, or not at all.
        graph: ONNX model: ``observation`` (N, D) to ``action`` (N, 8).
        content: contract, as ``policy_content`` returns; ``exported`` is added.
        policy: what the graph was made from.
        observations: (M, D) real ones, to compare with.

    Raises:
        InputError: a file that cannot be written, or a graph that answers differently.
        MissingPackageError: a package is not installed.
    """
    if path.suffix != SUFFIX:
        raise InputError(f"{path}: expected a file that ends in {SUFFIX}")
    require_package("onnx", "export")
    require_package("onnxruntime", "export")

    def write(temporary: Path) -> None:
        temporary.write_bytes(seal(graph, content))
        parity = compare(policy, open_policy(temporary)[0], content["environment"], observations)
        content["exported"] = {"parity": asdict(parity), "versions": versions()}
        temporary.write_bytes(seal(graph, content))
        open_policy(temporary)

    replace_file(path, write)
    return Parity(**content["exported"]["parity"])


def compare(policy: Policy, exported: Policy, environment: Contract, observations: NDArray[np.float32]) -> Parity:
    """Return the largest differences between the actions of two policies.

    Raises:
        InputError: they differ by more than :data:`TOLERANCE`.
    """
    columns = environment["observation"]
    bounds = np.array([column["scale"] * column["limit"] for column in columns])
    drawn = np.random.default_rng(0).normal(size=(RANDOM, len(columns)))
    differences = [
        float(np.abs(policy.act(some) - exported.act(some)).max(initial=0.0))
        for some in (np.clip(drawn, -bounds, bounds).astype(np.float32), observations)
    ]
    largest = np.max(differences)  # unlike Python's, not deaf to NaN
    if not largest <= TOLERANCE:
        raise InputError(f"the exported graph answers differently: by up to {largest:.2g}, allowed are {TOLERANCE:g}")
    return Parity(*differences, observations=RANDOM + len(observations))


# ---- model cards: what a file is, how it came about and how well it drives, as Markdown beside it --------------------

CARD_SUFFIX = ".md"
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
    card = policy.with_suffix(CARD_SUFFIX)
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
    said = [content["agent"]]
    if "steps" in training:
        said.append(f"{training['steps']:,} environment steps")
    if "seconds" in training:
        said.append(f"{training['seconds'] / 60.0:.1f} min with {config.get('torch_threads', 1)} thread(s)")
    if "seed" in training:
        said.append(f"seed {training['seed']}")
    if training.get("git_commit"):
        name, _, state = training["git_commit"].partition("-")
        said.append(f"commit {name[:7]}{state and '-'}{state}")  # ``-dirty`` stays
    facts["training"] = ", ".join(said)
    facts["versions"] = tally(content.get("versions", {}))
    if "exported" in content:
        parity = content["exported"]["parity"]
        largest = max(parity["random"], parity["real"])
        facts["same as the trained network"] = f"within {largest:.1e} on {parity['observations']} observations"
    return facts


def _term_counts(columns: list[Mapping[str, Any]]) -> Counter[str]:
    return Counter(column["name"].partition("[")[0] for column in columns)


def _below(evaluation: str) -> str:
    """Return a score card as part of another document: headings a level deeper, without pictures, which stay where they are."""
    words = re.sub(r"^#.*\n+(?:!\[.*\n*)+(?=#|\Z)", "", evaluation, flags=re.MULTILINE)  # sections that only show one
    lines = [line for line in words.strip().splitlines() if not line.startswith("![")]
    return re.sub(r"\n{3,}", "\n\n", "\n".join(f"#{line}" if line.startswith("#") else line for line in lines))
