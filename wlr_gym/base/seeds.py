"""How large seeds may be."""

from __future__ import annotations

from wlr_gym.base.errors import InputError

#: Of commands and trainings: NumPy's older generator, which libraries seed too, takes no larger one.
LARGEST_SEED = 2**32 - 1
#: Of a simulator's noise, whose keys have 64 bits.
LARGEST_NOISE_SEED = 2**64 - 1


def require_seed(name: str, seed: int, largest: int = LARGEST_SEED) -> None:
    """Raise :class:`InputError` for a seed out of range; the message begins with ``name``."""
    if not 0 <= seed <= largest:
        raise InputError(f"{name} {seed}: expected 0 to {largest}")
