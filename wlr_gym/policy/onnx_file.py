"""A policy as one file: ONNX, its contract and its fingerprint in the metadata. Reading it needs onnxruntime, no torch.

The graph maps ``observation`` (N, D) float32, scaled as the contract says, to ``action`` (N, 8) float32 in [-1, 1].
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.policy.file import check_content

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

SUFFIX = ".onnx"
OBSERVATION = "observation"
ACTION = "action"
#: Keys of the metadata. The fingerprint is the SHA-256 of the whole file with the fingerprint's own digits set to zero.
CONTRACT_KEY = "wlr_gym.contract"
FINGERPRINT_KEY = "wlr_gym.sha256"
BLANK = b"0" * 64
#: As protobuf writes a metadata entry: the key, then field 2, 64 bytes long.
FINGERPRINT = re.compile(re.escape(FINGERPRINT_KEY.encode()) + rb"\x12\x40([0-9a-f]{64})")


class OnnxPolicy:
    """The graph of a policy file, computed by onnxruntime on one thread: the same input gives the same bits."""

    def __init__(self, session: InferenceSession) -> None:
        self._session = session

    def act(self, observations: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return actions (N, 8) for observations (N, D)."""
        (actions,) = self._session.run([ACTION], {OBSERVATION: np.ascontiguousarray(observations, np.float32)})
        return np.asarray(actions, np.float32)

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Nothing to forget: the graph has no memory."""


def open_policy(path: str | Path) -> tuple[OnnxPolicy, dict[str, Any]]:
    """Return the policy of a file and its contract.

    Raises:
        InputError: absent, cut short, no policy of wlr_gym, changed since it was written, or a graph that does not fit its own
            contract.
        MissingPackageError: onnxruntime is not installed.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    check_fingerprint(data, str(path))
    session = open_graph(data, str(path))
    content = json.loads(session.get_modelmeta().custom_metadata_map.get(CONTRACT_KEY, "null"))
    check_content(content, str(path))
    check_graph(session, content["environment"], str(path))
    return OnnxPolicy(session), content


def open_graph(data: bytes, where: str) -> InferenceSession:
    """Return a session of onnxruntime on one thread of the CPU.

    Raises:
        InputError: it is not ONNX, or too new for the onnxruntime that is installed.
    """
    require_package("onnxruntime", "export")
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 4  # what goes wrong is raised
    try:
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its classes are private to the extension module
        raise InputError(f"{where}: this onnxruntime ({onnxruntime.__version__}) cannot compute it: {error}") from None


def check_graph(session: InferenceSession, environment: Mapping[str, Any], where: str) -> None:
    """Refuse a graph that does not map the contract's observations to its actions.

    Raises:
        InputError: naming the first difference.
    """
    pairs = (
        (OBSERVATION, session.get_inputs(), len(environment.get("observation", ()))),
        (ACTION, session.get_outputs(), len(environment.get("action", ()))),
    )
    for name, places, width in pairs:
        found = [(place.name, place.type, *place.shape[1:]) for place in places]
        if found != [(name, "tensor(float)", width)]:
            raise InputError(f"{where}: its graph has {found}, its contract needs {name}: N rows of {width} float numbers")


def check_fingerprint(data: bytes, where: str) -> None:
    """Refuse a file that is not, byte for byte, what :func:`seal` made. What it holds is not looked at before.

    Raises:
        InputError: it has no fingerprint, or another than its bytes.
    """
    found = FINGERPRINT.search(data)
    if found is None:
        raise InputError(f"{where}: not a policy file of wlr_gym, or cut short: there is no '{FINGERPRINT_KEY}' in it")
    start, end = found.span(1)
    if hashlib.sha256(data[:start] + BLANK + data[end:]).hexdigest().encode() != found[1]:
        raise InputError(f"{where}: damaged or changed since it was written: its SHA-256 is not the one it names")


def seal(graph: bytes, content: Mapping[str, Any]) -> bytes:
    """Return the bytes of a policy file.

    Args:
        graph: serialised ONNX model with input ``observation`` and output ``action``.
        content: what its contract says; see :func:`wlr_gym.policy.file.write_contract`.
    """
    import onnx

    model = onnx.load_from_string(graph)
    onnx.helper.set_model_props(model, {CONTRACT_KEY: json.dumps(content), FINGERPRINT_KEY: BLANK.decode()})
    blank = model.SerializeToString(deterministic=True)
    found = FINGERPRINT.search(blank)
    assert found is not None
    return blank[: found.start(1)] + hashlib.sha256(blank).hexdigest().encode() + blank[found.end(1) :]
