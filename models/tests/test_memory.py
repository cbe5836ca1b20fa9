"""What more episodes cost a training: memory of its own and descriptors. The episodes are made up."""

import functools
import os
import resource
import tempfile
import tracemalloc
import unittest
from pathlib import Path
from unittest import mock

import numpy as np
from measure_many import fill, judge, pictures_of

from rapid_policy import cache, corpus
from rapid_policy.dataset import Dataset

SIDE, TICKS, OPEN = 8, 200, 8
# Bytes for each episode more: its path, while episodes are looked up. The numbers of its ticks are ten times as much.
MOST = 1500


class Many(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.data, self.cache = Path(folder.name) / "data", Path(folder.name) / "cache"
        self.data.mkdir()
        self.spec = pictures_of(SIDE)
        few = functools.lru_cache(maxsize=OPEN)(cache._mapped.__wrapped__)
        for owner, name, stand_in in (
            (cache, "_mapped", few),
            (cache, "OPEN", OPEN),
            (corpus, "judge", judge),
            (corpus, "program", lambda: "/bin/true"),
        ):
            patch = mock.patch.object(owner, name, stand_in)
            patch.start()
            self.addCleanup(patch.stop)

    def fill(self, episodes: int) -> None:
        fill(self.spec, self.data, self.cache, episodes, TICKS, SIDE)

    def read(self) -> int:
        """Some windows of all that there are; how many there are."""
        found, random = corpus.load(self.spec, [self.data], self.cache), np.random.default_rng(0)
        dataset = Dataset(self.spec, found.training)
        for _ in range(4):
            dataset.gather(dataset.plan(random, 64))
        return len(dataset.windows)

    def peak(self, windows: int) -> int:
        """Bytes that reading these takes at most."""
        tracemalloc.start()
        self.addCleanup(tracemalloc.stop)
        self.assertEqual(self.read(), windows)
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return found

    def test_memory_does_not_grow_with_ticks(self):
        # More windows than are looked at together. What is imported when it is used is so before.
        few, many = 40, 160
        self.fill(few)
        self.read()
        peaks = []
        for episodes in (few, many):
            self.fill(episodes)
            # Python's own tables, such as that of its names, grow at any moment, by megabytes and once.
            peaks.append(min(self.peak(episodes * TICKS) for _ in range(3)))
        self.assertLess((peaks[1] - peaks[0]) / (many - few), MOST, peaks)

    def test_descriptors_do_not_grow_with_episodes(self):
        self.fill(64)
        # What is imported when it is used is so before.
        self.read()
        cache._mapped.cache_clear()
        before = resource.getrlimit(resource.RLIMIT_NOFILE)
        self.addCleanup(resource.setrlimit, resource.RLIMIT_NOFILE, before)
        # A new one gets the lowest number that is free, which must be below the limit.
        used = len(os.listdir("/proc/self/fd"))
        resource.setrlimit(resource.RLIMIT_NOFILE, (used + 4 * OPEN, before[1]))
        self.assertEqual(self.read(), 64 * TICKS)


if __name__ == "__main__":
    unittest.main()
