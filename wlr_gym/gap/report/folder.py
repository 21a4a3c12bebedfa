"""The folder of an analysis: report, pictures, patch and result, written once everything is made."""

from __future__ import annotations

from pathlib import Path

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import make_output_folder, replace_file, require_output_place, write_text
from wlr_gym.base.provenance import CONFIG_FILE, PROVENANCE_FILE
from wlr_gym.gap.analysis import Analysis
from wlr_gym.gap.report.page import CAPTIONS, report
from wlr_gym.gap.report.plots import draw
from wlr_gym.gap.report.result import PATCH_FILE, RESULT_FILE, read_result, result_of, write_result

REPORT_FILE = "report.html"
#: Folder of the pictures.
PLOTS = "plots"
_OWN = {RESULT_FILE, PATCH_FILE, REPORT_FILE, PLOTS, CONFIG_FILE, PROVENANCE_FILE}


def check_folder(folder: Path) -> None:
    """Refuse, before the work, a folder that the results cannot go into; nothing is made.

    Raises:
        InputError: a file, a folder without rights, or one with contents that no earlier analysis wrote.
    """
    if folder.is_dir():
        _require_own(folder)
    require_output_place(folder)


def _require_own(folder: Path) -> None:
    there = sorted(path.name for path in folder.iterdir())
    strange = [name for name in there if name not in _OWN] or ([] if _is_analysis(folder) else there)
    if strange:
        raise InputError(f"--out {folder}: '{strange[0]}' in it is not of an analysis; expected a new folder or an earlier one")


def _is_analysis(folder: Path) -> bool:
    """Whether an analysis wrote a folder: files of these names alone may be anybody's."""
    if not (folder / RESULT_FILE).exists():  # one that was interrupted, before anything but pictures was there
        return (folder / PROVENANCE_FILE).exists() or not any((folder / name).exists() for name in (PATCH_FILE, CONFIG_FILE))
    try:
        read_result(folder / RESULT_FILE)
    except InputError:
        return False
    return True


def save_analysis(analysis: Analysis, folder: Path) -> Path:
    """Write report, pictures, patch and result into ``folder``, and return the path of the result.

    Everything is made before anything is written, and ``result.json`` comes last: a folder that holds one is whole.

    Raises:
        InputError: see :func:`check_folder`, or a folder that cannot be written to.
    """
    check_folder(folder)
    result_of(analysis)
    pictures = draw(analysis)
    page = report(analysis, pictures, folder)
    make_output_folder(folder / PLOTS)
    # the provenance stays until there is a result: it tells whose the folder is
    for stale in (RESULT_FILE, PATCH_FILE, CONFIG_FILE):
        (folder / stale).unlink(missing_ok=True)
    for stale in (folder / PLOTS).glob("*.png"):
        if stale.stem.rstrip("_0123456789") in CAPTIONS:
            stale.unlink()
    for name, picture in pictures.items():
        replace_file(folder / PLOTS / f"{name}.png", lambda temporary, picture=picture: temporary.write_bytes(picture))
    write_text(folder / REPORT_FILE, page)
    return write_result(analysis, folder)
