"""MuJoCo: the MJCF of a robot, and a plant of robots stepped by it, independent of the Gibbs-Appell engine's dynamics.

``mujoco`` is imported from here where pictures are drawn: at its import it loads the OpenGL that ``MUJOCO_GL`` names, and fails
where that is not there. Here it is imported all the same, and who draws is told.
"""

import os

try:
    import mujoco
except ModuleNotFoundError:
    raise
except Exception:  # PyOpenGL fails in every way there is
    asked = os.environ.get("MUJOCO_GL", "")
    os.environ["MUJOCO_GL"] = "off"
    try:
        import mujoco
    finally:
        os.environ["MUJOCO_GL"] = asked

__all__ = ["mujoco"]
