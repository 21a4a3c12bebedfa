"""Rewrite the contract of a policy where the code writes contracts in a newer form. What the policy computes stays."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.base.files import replace_file, write_json, write_text
from wlr_gym.base.settings import overlay, read_layers
from wlr_gym.policy.file import CONTRACT_FILE, differences, with_defaults
from wlr_gym.policy.model_card import SUFFIX as CARD_SUFFIX
from wlr_gym.policy.model_card import file_hash
from wlr_gym.policy.onnx_file import open_policy, seal
from wlr_gym.policy.sources import contract_of, robot_of_contract
from wlr_gym.robot import Robot, load_robot, robot_hash, servo_hash


def reseal(path: Path, robot: str | None = None) -> list[str]:
    """Rewrite the contract of a policy; of a policy file also its fingerprint, and its SHA-256 in the model cards beside it.

    The graph stays byte for byte.

    Args:
        path: of the policy file or folder.
        robot: name or path of the robot that it was trained with; default: what its contract says.

    Returns:
        What changed: ``key: before -> now``.

    Raises:
        InputError: a broken policy, or a robot whose numbers are not those of the training.
        MissingPackageError: a policy file, and onnx is not installed.
    """
    content = contract_of(path)
    before, resealed = content["environment"], copy.deepcopy(content)
    source = robot or robot_of_contract(content) or "nominal"
    trained = load_robot(source)
    stated, fingerprint = (before.get("robot") or {}).get("hash"), robot_hash(trained)
    if stated != fingerprint and (isinstance(source, Mapping) or stated != _first_form(source, trained)):
        raise InputError(
            f"{path}: robot.hash is {stated!r}, that of robot '{robot or trained.name}' is {fingerprint!r}: not the robot of "
            "its training"
        )
    now = with_defaults(resealed["environment"])
    now["robot"] |= {"hash": fingerprint, "servo": servo_hash(trained)}
    resealed["environment"] = now
    changes = [f"environment.{name}: {_text(old)} -> {_text(new)}" for name, old, new in differences("", before, now)]
    if path.is_dir():
        write_json(path / CONTRACT_FILE, resealed)
        return changes
    require_package("onnx", "export")
    sha = file_hash(path)
    replace_file(path, lambda temporary: temporary.write_bytes(seal(path.read_bytes(), resealed)))
    open_policy(path)
    return [*changes, *_cards(path, sha)]


#: Keys of ``servo`` that robot files got after the first form.
LATER: Any = {
    "integral_cycle": True,
    "leg": {"stall_current", "no_load_current", "current_count", "load_count"},
    "wheel": {"stall_current", "no_load_current", "current_count", "load_count"},
}


def _first_form(source: str, robot: Robot) -> str:
    """Return the hash of a robot as contracts had it at first: of everything in its file, tolerances as they are written."""
    tolerances: Any = {}
    for data, _ in read_layers("robot", source):
        tolerances = overlay(tolerances, data.get("tolerances") or {})
    adapter = TypeAdapter(dict[str, float | str])
    numbers = robot.model_dump_json(exclude={"tolerances": True, "individual": True, "servo": LATER, "sensors": {"volt_count"}})
    text = f'{numbers[:-1]},"tolerances":{adapter.dump_json(adapter.validate_python(tolerances)).decode()}}}'
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _cards(path: Path, before: str) -> list[str]:
    """Write a policy file's new SHA-256 into the cards beside it that name the old one: its own, and those of comparisons."""
    now = file_hash(path)
    named = [card for card in sorted(path.parent.glob(f"*{CARD_SUFFIX}")) if before in card.read_text(encoding="utf-8")]
    for card in named if now != before else ():
        write_text(card, card.read_text(encoding="utf-8").replace(before, now))
    return [f"{card.name}: SHA-256 {before} -> {now}" for card in named if now != before]


def _text(value: Any) -> str:
    return json.dumps(value) if isinstance(value, Mapping | list) else repr(value)
