"""Building blocks of tasks: small documented units that a task's YAML lists by name, with weights and parameters.

``registered`` and ``computed`` make a function such a unit, here or in a module of one's own (docs/extending.md).
"""

from wlr_gym.envs.tasks.terms.measures import MEASURES, POSITIVE, TERMINATIONS, ScalarTerm, registered
from wlr_gym.envs.tasks.terms.observations import (
    COMMANDS,
    COMPUTED,
    CONTROLLER,
    POLICY_TERMS,
    PRIVILEGED_TERMS,
    ObservationTerm,
    computed,
)
from wlr_gym.envs.tasks.terms.rewards import REWARDS

#: Group of a task's terms that are single numbers -> those there are.
SCALARS = {"rewards": REWARDS, "terminations": TERMINATIONS, "measures": MEASURES}

__all__ = [
    "COMMANDS",
    "COMPUTED",
    "CONTROLLER",
    "MEASURES",
    "POLICY_TERMS",
    "POSITIVE",
    "PRIVILEGED_TERMS",
    "REWARDS",
    "TERMINATIONS",
    "ObservationTerm",
    "ScalarTerm",
    "computed",
    "registered",
]
