"""The result file of an analysis, ``result.json``, and the patch that adds what was found to the model, ``patch.yaml``.

The models of :mod:`wlr_gym.gap.report.entries` are the format: what is written has passed them, and :func:`read_result`
checks a file against them. Keys that other versions add are kept.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from wlr_gym import __version__
from wlr_gym.base.errors import InputError
from wlr_gym.base.files import write_json
from wlr_gym.gap.analysis import Adequacy, Analysis, Calibrated, Evidence, FoundEffect, GapFigures, ParameterEstimate, Statistic
from wlr_gym.gap.report.entries import Result, finite
from wlr_gym.gap.report.text import closure, sentence, unit_of
from wlr_gym.physics.effects import Patch, PatchEffect, save_patch
from wlr_gym.physics.plants.forces import COORDINATES

RESULT_FILE = "result.json"
PATCH_FILE = "patch.yaml"
MADE_BY = "wlr gap"


# ---- writing ---------------------------------------------------------------------------------------------------------


def patch_of(analysis: Analysis) -> Patch:
    """Return the effects that were found, as a patch; an unknown effect without a formula cannot be added.

    Neither the effects that were given as known nor calibrated numbers are in it.
    """
    effects = tuple(
        PatchEffect(
            effect.name,
            tuple(effect.where),
            {name: float(found.value) for name, found in effect.parameters.items()},
            effect.formula,
            dict(effect.units),
        )
        for effect in analysis.added
    )
    origin = {"made_by": MADE_BY, "data": [analysis.data], "date": _today(), "version": __version__}
    return Patch(effects, {**origin, "verdict": analysis.verdict}, source=PATCH_FILE)


def result_of(analysis: Analysis, patch: Path | str = PATCH_FILE) -> Result:
    """Return what the result file says of an analysis.

    Args:
        analysis: what was found.
        patch: where its patch is.

    Raises:
        ValueError: a number that makes no sense, such as a share above 1.
    """
    places = sorted(analysis.localisation, key=lambda place: -place.share)
    content = {
        "verdict": analysis.verdict,
        "summary": sentence(analysis),
        "effects": [_effect(effect) for effect in analysis.effects],
        "equivalent": [list(group.names) for group in analysis.equivalent],
        "separating_runs": [group.separating_run for group in analysis.equivalent],
        "calibration": {name: _calibrated(moved) for name, moved in analysis.calibration.items()},
        "localisation": {p.name: {"share_of_gap": p.share, "state_dependence": p.dependence} for p in places},
        "relations": [dict(vars(one)) for one in analysis.relations],
        "gap": None if analysis.gap is None else _gap(analysis.gap),
        "runs": {"fit": list(analysis.fit_runs), "heldout": list(analysis.heldout_runs)},
        "patch": str(patch),
        "detectable": {name: dict(vars(one)) for name, one in analysis.detectable.items()},
        "closure": closure(analysis),
        "turning": None if analysis.turning is None else dict(vars(analysis.turning)),
        "evidence": [_evidence(one) for one in analysis.evidence],
        "thresholds": [dict(vars(one)) for one in analysis.thresholds],
        "run_gaps": [dict(vars(one)) for one in analysis.run_gaps],
        "channel_gaps": [dict(vars(one)) for one in analysis.channel_gaps],
        "intake": [dict(vars(one)) for one in analysis.intake],
        "recommendations": [dict(vars(one)) for one in analysis.recommendations],
        "adequacy": None if analysis.adequacy is None else _adequacy(analysis.adequacy),
        "known_effects": [dict(known) for known in analysis.known_effects],
        "seconds": dict(analysis.seconds),
        "provenance": {
            "made_by": MADE_BY, "data": analysis.data, "date": _today(), "version": __version__, **analysis.provenance
        },
    }  # fmt: skip
    return Result.model_validate(_plain(content))


def write_result(analysis: Analysis, folder: Path) -> Path:
    """Write ``patch.yaml`` and then ``result.json`` into a folder that is there, each in one step; return the latter's path.

    The result names the patch by its absolute path.
    """
    patch = folder.resolve() / PATCH_FILE
    result = result_of(analysis, patch)
    save_patch(patch_of(analysis), patch)
    path = folder / RESULT_FILE
    write_json(path, result.model_dump(mode="json", exclude_none=False))
    return path


def _effect(effect: FoundEffect) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "name": effect.name,
        "where": list(effect.where),
        "parameters": {name: _parameter(found) for name, found in effect.parameters.items()},
        "confidence": effect.confidence,
        "gain": effect.gain,
        "formula": _formula(effect) if effect.formula else None,
        "validity": {name: {"range": [one.low, one.high], "unit": one.unit} for name, one in effect.validity.items()},
    }
    return entry


def _parameter(found: ParameterEstimate) -> dict[str, Any]:
    known = math.isfinite(found.low) and math.isfinite(found.high)
    interval = [min(found.low, found.value), max(found.high, found.value)] if known else None
    return {"value": found.value, "ci95": interval, "unit": found.unit}


def _formula(effect: FoundEffect) -> str:
    """Return the formula with the units of its force and its constants: ``-k * leg_angle N m; k in N m/rad``."""
    force = unit_of(COORDINATES.get(effect.where[0], "")) if effect.where else ""
    constants = [f"{name} in {'1' if unit == '-' else unit}" for name, unit in effect.units.items()]
    return "; ".join([effect.formula + force, *constants])


def _calibrated(moved: Calibrated) -> dict[str, Any]:
    half = moved.uncertainty
    interval = [moved.fitted - half, moved.fitted + half] if math.isfinite(half) else None
    return {
        "nominal": moved.nominal, "fitted": moved.fitted, "unit": moved.unit, "sigma": moved.sigma, "ci95": interval
    }  # fmt: skip


def _gap(gap: GapFigures) -> dict[str, Any]:
    known = all(map(math.isfinite, gap.reduction_ci95))
    share = min(max(gap.reduction, 0.0), 1.0) if math.isfinite(gap.reduction) else 0.0
    interval = list(gap.reduction_ci95) if known else None
    return {**vars(gap), "reduction": share, "reduction_signed": gap.reduction, "reduction_ci95": interval}


def _adequacy(found: Adequacy) -> dict[str, Any]:
    pulled = {"number": found.pulled.number, "run": found.pulled.run, **_statistic(found.pulled.errors)}
    by_channel = [{name: _statistic(both[k]) for name, both in found.channels.items()} for k in (0, 1)]
    return {
        "replicates": found.replicates,
        "level": {**_statistic(found.level), "channels": by_channel[0]},
        "whiteness": {**_statistic(found.whiteness), "channels": by_channel[1]},
        "constancy": {**_statistic(found.constancy), "pulled_most": pulled},
    }


def _statistic(found: Statistic) -> dict[str, float]:
    return {**vars(found), "ratio": found.ratio}


def _evidence(one: Evidence) -> dict[str, Any]:
    return {
        **vars(one),
        "where": list(one.where),
        "values": dict(one.values),
        "by_run": dict(one.by_run),
        "units": dict(one.units),
    }


def _plain(value: Any) -> Any:
    """Return nested mappings and sequences of plain JSON types; what is not finite becomes null outside required numbers."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return finite(float(value))  # NumPy's are floats, too
    if isinstance(value, np.generic):
        return _plain(value.item())
    return value if isinstance(value, str | bool | int | type(None)) else str(value)


def _today() -> str:
    return datetime.now(UTC).date().isoformat()


# ---- reading ---------------------------------------------------------------------------------------------------------


def read_result(path: str | Path) -> Result:
    """Read and check a result file.

    Raises:
        InputError: no such file, broken JSON, or contents that are not those of a result; the message names the place.
    """
    try:
        return Result.model_validate(json.loads(Path(path).read_text(encoding="utf-8")))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    except json.JSONDecodeError as error:
        raise InputError(f"{path}, line {error.lineno}, column {error.colno}: broken JSON: {error.msg}") from None
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "content"
        raise InputError(f"{path}: {place}: {first['msg']}") from None
