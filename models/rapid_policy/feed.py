"""Batches of a training: planned in order by one generator, gathered from the episodes ahead of time by threads."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from .dataset import Batch, Dataset, Plan

AHEAD = 2


class Feed:
    """Endless batches. Threads copy out of memory maps, which waits for the disk and not for Python."""

    def __init__(self, dataset: Dataset, random: np.random.Generator, size: int, rows: slice, workers: int) -> None:
        self._dataset, self._random, self._size, self._rows = dataset, random, size, rows
        self._pool = ThreadPoolExecutor(workers, "feed") if workers else None
        self._ahead = AHEAD * workers
        self._waiting: deque[tuple[Future[Batch], dict[str, Any]]] = deque()

    def next(self) -> tuple[Batch, dict[str, Any]]:
        """A batch, and the state of the generator after it, from which a resumed training continues."""
        if self._pool is None:
            plan, state = self._plan()
            return self._dataset.gather(plan), state
        while len(self._waiting) < self._ahead:
            plan, state = self._plan()
            self._waiting.append((self._pool.submit(self._dataset.gather, plan), state))
        batch, state = self._waiting.popleft()
        return batch.result(), state

    def _plan(self) -> tuple[Plan, dict[str, Any]]:
        whole = self._dataset.plan(self._random, self._size)
        return {name: rows[self._rows] for name, rows in whole.items()}, self._random.bit_generator.state

    def close(self) -> None:
        """Ends the threads."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
