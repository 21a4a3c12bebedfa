"""Make a policy file from a trained policy, and prove that both answer alike before it is there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.base.files import replace_file
from wlr_gym.base.provenance import versions
from wlr_gym.policy.agents import Contract, Policy, agent_function
from wlr_gym.policy.file import read_contract
from wlr_gym.policy.onnx_file import SUFFIX, open_policy, seal
from wlr_gym.policy.sources import find_policy

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
