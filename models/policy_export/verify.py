"""Judges how much a written bundle differs from the networks it was made from."""

import numpy as np

from . import Unsupported

# For numbers around 1: normalised observations, features, normalised actions.
TOLERANCE = 1e-4
SEED = 20


class Mismatch(Unsupported):
    """The bundle computes something other than its source."""


def judge(found: dict[str, float], source: str) -> dict[str, float]:
    """`found`, the largest difference of each part from `source`.

    # Errors
    `Mismatch`, with all figures, if one is above `TOLERANCE`.
    """
    # A NaN difference compares as false with everything.
    if wrong := [name for name, difference in found.items() if not difference <= TOLERANCE]:
        figures = ", ".join(f"{name} {difference:.2e}" for name, difference in found.items())
        raise Mismatch(
            f"the bundle differs from {source} in {', '.join(wrong)}: {figures}; at most {TOLERANCE} is allowed"
        )
    return found


def normal(random: np.random.Generator, *shape: int) -> np.ndarray:
    return random.standard_normal(shape, dtype=np.float32)


def largest(worst: float, difference: np.ndarray) -> float:
    """The larger value; NaN if either is NaN."""
    return float(np.maximum(worst, np.abs(difference).max()))
