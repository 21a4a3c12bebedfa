"""Controls that every page has: from where the robot is seen, and what is drawn beside it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from wlr_gym.render.view import View

if TYPE_CHECKING:
    import viser

#: What a page calls its cameras; the direction from which it is seen is the mouse's affair.
_CAMERAS = {"goes with the robot": "follow", "turns with the robot": "chase"}
#: Pixels.
_PLOTS_WIDE = 380


class ViewControls:
    """What whoever watches wants to see.

    Args:
        server: of the page.
        view: what is seen until something else is chosen.
    """

    def __init__(self, server: viser.ViserServer, view: View) -> None:
        self._first = view
        first = next((text for text, camera in _CAMERAS.items() if camera == view.camera), "goes with the robot")
        with server.gui.add_folder("View", expand_by_default=False):
            self._camera = server.gui.add_dropdown("camera", tuple(_CAMERAS), initial_value=first)
            self._friction = server.gui.add_checkbox("floor's friction", view.friction)
            self._slip = server.gui.add_checkbox("slip", view.slip)
            self._forces = server.gui.add_checkbox("contact forces", view.forces)

    @property
    def view(self) -> View:
        """What to show now."""
        return replace(
            self._first,
            camera=_CAMERAS[self._camera.value],
            friction=bool(self._friction.value),
            slip=bool(self._slip.value),
            forces=bool(self._forces.value),
        )


def plot_panel(server: viser.ViserServer) -> Any:
    """Return a panel at the left edge, the other controls at the right one: what is added within it stands there."""
    server.gui.main_panel.dock_right()
    panel = server.gui.add_panel()
    tab = panel.add_tab("Plots")
    panel.dock_left()
    panel.set_width(_PLOTS_WIDE)
    return tab
