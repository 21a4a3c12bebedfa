"""Chromium, without a window, clicks through a page."""

import threading

import numpy as np
import pytest
from browser import Browser, chromium
from PIL import Image
from test_pages import Line

from wlr_gym.render.web.page import UPDATES
from wlr_gym.render.web.player import Player

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(chromium() is None, reason="no Chromium here"),
]
PORT = 18480


def test_a_run_is_watched_paused_and_sought_in_the_browser(tmp_path):
    recordings = [Line(60.0), Line(4.0)]
    player = Player(["first", "second"], lambda k: recordings[k], ("x", "length"), port=PORT)
    over = threading.Event()
    thread = threading.Thread(target=player.run, args=(over.is_set,))
    thread.start()
    try:
        with Browser(f"http://localhost:{player.server.get_port()}") as browser:
            browser.wait("a straight line")
            browser.wait("x (m)")  # a plot
            picture = tmp_path / "page.png"
            browser.picture(picture)
            assert len(np.unique(np.asarray(Image.open(picture).convert("RGB")).reshape(-1, 3), axis=0)) > 200
            browser.click("pause")
            browser.wait("play  [space]".replace("  ", " "))
            held = player.time
            assert held > 0.0
            browser.press(" ", "Space", 32)
            browser.wait("pause")
            browser.press("l", "KeyL", 76)
            assert "http" not in browser.run(
                "performance.getEntriesByType('resource').map(r => r.name).filter(n => !n.includes('localhost')"
                " && n.startsWith('http')).join()"
            )
        assert player.time > held
        assert UPDATES == 30.0
    finally:
        over.set()
        thread.join()
