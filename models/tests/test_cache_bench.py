"""The bench of the cache, which reads windows as training does."""

import unittest
from unittest import mock

from test_corpus import SPEC, Case

from rapid_policy.cache_commands import bench
from rapid_policy.dataset import Dataset


class Bench(Case):
    def test_the_bench_measures(self):
        self.write("a")
        with mock.patch.object(Dataset, "gather", autospec=True, side_effect=Dataset.gather) as gather:
            report = bench(SPEC, self.load().training, seconds=0.05)
        self.assertGreater(report["cache_times"], 1)
        self.assertTrue(gather.called)


if __name__ == "__main__":
    unittest.main()
