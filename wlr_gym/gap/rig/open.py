"""Open a folder of the rig's recordings: read, check, and make a problem of them."""

from __future__ import annotations

from pathlib import Path

from wlr_gym.effects import Patch
from wlr_gym.gap.analysis import IntakeFinding
from wlr_gym.gap.rig.intake import findings
from wlr_gym.gap.rig.problem import RigProblem
from wlr_gym.gap.rig.recording import read_recordings

#: Recordings that an analysis needs: two to fit, one for the proof.
LEAST_RUNS = 3


def open_rig(data: str | Path, known: Patch | None = None) -> tuple[RigProblem | None, list[IntakeFinding]]:
    """Return the problem, and what was noticed about the data; None where the data are too bad to go on.

    Args:
        data: folder of recordings.
        known: effects that are in the model from the start.

    Raises:
        InputError: files that are no such recordings, an effect the rig does not know.
    """
    recordings = read_recordings(data)
    found = list(findings(recordings))
    bad = {finding.run for finding in found if finding.fatal}
    good = [recording for recording in recordings if recording.name not in bad]
    if "" in bad:
        return None, found
    if len(good) < LEAST_RUNS:
        text = f"{len(good)} usable runs of {len(recordings)}: record {LEAST_RUNS} or more, two to fit and one for the proof"
        return None, [*found, IntakeFinding("", "", "few_runs", text, fatal=True)]
    return RigProblem(good, known.effects if known else ()), found
