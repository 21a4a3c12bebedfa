"""Whether a window can be opened here."""

from __future__ import annotations

import os
import platform

from wlr_gym.base.errors import InputError


def has_display() -> bool:
    """Whether this process has a display; on macOS and Windows it is taken to have one."""
    return platform.system() != "Linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def require_display() -> None:
    """Raise where no window can be opened.

    Raises:
        InputError: no display; the message says what to do instead.
    """
    if not has_display():
        raise InputError(
            "no display here (neither DISPLAY nor WAYLAND_DISPLAY is set), so no window: make a video instead "
            "(wlr play --video FILE.webp, or render_mode='rgb_array'), or log in with a display (ssh -X)"
        )
