"""One kernel of the engine for robots with any effect, so that tests compile a few kernels and not dozens."""

from wlr_gym.physics.plants import drive, ground
from wlr_gym.physics.plants.gibbs_appell.plant import GibbsAppellPlant

#: The product's own choice.
OWN = GibbsAppellPlant._choose_kernel


def choose_shared(self: GibbsAppellPlant) -> None:
    """Choose the kernel for all effects where the robot has any."""
    if drive.families(self.parameters) | ground.families(self.parameters):
        self.expect_all_effects()
    OWN(self)
