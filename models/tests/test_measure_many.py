"""The measurement of many episodes measures: what it reads is what it has made up."""

import io
import json
import sys
import tempfile
import unittest
from contextlib import redirect_stdout
from unittest import mock

import measure_many
import torch


class Measured(unittest.TestCase):
    def test_all_of_the_episodes_are_read(self):
        self.addCleanup(torch.set_num_threads, torch.get_num_threads())
        with tempfile.TemporaryDirectory() as folder, redirect_stdout(io.StringIO()) as printed:
            command = ["measure_many.py", folder, "--episodes", "3", "--ticks", "20", "--side", "8", "--iterations", "1"]
            with mock.patch.object(sys, "argv", command):
                measure_many.main()
        report = json.loads(printed.getvalue())
        self.assertEqual((report["episodes"], report["ticks"]), (3, 60))
        self.assertGreaterEqual(report["MB_dataset"], 1)
        self.assertGreater(report["batches_s"], 0)


if __name__ == "__main__":
    unittest.main()
