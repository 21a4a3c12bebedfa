"""What proves the product and is no part of it: benchmarks, the paper reproduced, the derivation, the observer's training.

In a clone and in the source distribution, not in the wheel: ``python -m studies.bench``, ``python -m studies.paper``.
"""
