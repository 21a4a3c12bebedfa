"""The servo test rig: the gap workflow on one servo that swings a pendulum.

Everything it needs of the rig is here: recordings (:mod:`.recording`, in the files of the BAM test bench), what is odd about
them (:mod:`.intake`), a fast simulation (:mod:`.law`, :mod:`.kernel`, :mod:`.replay`), and the rig as a
:class:`wlr_gym.gap.problem.Problem` (:mod:`.model`, :mod:`.candidates`, :mod:`.problem`).
"""

from wlr_gym.gap.rig.effects import RIG_EFFECTS
from wlr_gym.gap.rig.intake import findings
from wlr_gym.gap.rig.open import open_rig, rig_patch
from wlr_gym.gap.rig.problem import RigProblem
from wlr_gym.gap.rig.recording import Recording, read_recordings

__all__ = ["RIG_EFFECTS", "Recording", "RigProblem", "findings", "open_rig", "read_recordings", "rig_patch"]
