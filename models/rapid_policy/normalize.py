"""Normalisation of vectors to -1..1 and back."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Name of the range of what is executed, where that differs from what is learned.
EXECUTED = "executed"


@dataclass(frozen=True)
class MinMax:
    """(v - min) / (max - min) * 2 - 1, each dimension by its own range."""

    low: NDArray[np.float64]
    """[D]"""
    high: NDArray[np.float64]
    """[D]"""

    @staticmethod
    def of(what: str, values: NDArray[np.float64], turns: Iterable[int] = ()) -> MinMax:
        """The range of `values` [N, D]; a dimension that never changes cannot be normalised.

        The dimensions `turns` belong to a rotation and keep their range, -1 to 1: scaled separately they would not be a rotation.
        """
        low, high = values.min(0), values.max(0)
        low[list(turns)], high[list(turns)] = -1.0, 1.0
        for dimension in np.flatnonzero(~(high > low)):
            raise ValueError(
                f"{what}: dimension {dimension} is {low[dimension]} in all data, it has no range: leave it out"
            )
        return MinMax(low, high)

    def apply(self, values: NDArray[np.float64]) -> NDArray[np.float32]:
        """[..., D] -> [..., D]"""
        return ((values - self.low) / (self.high - self.low) * 2 - 1).astype(np.float32)

    def invert(self, values: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """[..., D] -> [..., D]"""
        return (values.astype(np.float64) + 1) / 2 * (self.high - self.low) + self.low

    def widened(self, share: float) -> MinMax:
        """The range with a margin of `share` of it on both sides."""
        margin = share * (self.high - self.low)
        return MinMax(self.low - margin, self.high + margin)

    def to_dict(self) -> dict[str, Any]:
        """In the format of `policy.json`."""
        return {"mode": "min_max", "min": self.low.tolist(), "max": self.high.tolist()}

    @staticmethod
    def from_dict(data: dict[str, Any]) -> MinMax:
        """The inverse of `to_dict`."""
        return MinMax(np.array(data["min"], np.float64), np.array(data["max"], np.float64))
