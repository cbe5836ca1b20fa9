"""Training: that it learns at all, and that a run which was stopped continues as if it had not been."""

import sys
import tempfile
import unittest
from dataclasses import replace
from pathlib import Path
from unittest import mock

import torch
from test_dataset import made_up

sys.path.insert(0, str(Path(__file__).parents[1]))

from rapid_policy import train as module
from rapid_policy.dataset import Dataset
from rapid_policy.spec import Network, Spec, tactile_id
from rapid_policy.train import CHECKPOINT, Run, Schedule, begin, train


def small() -> Spec:
    """The policy that is shipped, in small."""
    return replace(tactile_id(), network=Network(image_width=8, image_features=8, keypoints=4, denoiser=(8, 16)))


def start(dataset: Dataset, iterations: int) -> Run:
    schedule = Schedule(iterations=iterations, windows=4, warmup=2)
    return begin(dataset.spec, schedule, dataset, {}, torch.device("cpu"))


class Training(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        torch.set_num_threads(1)
        cls.dataset = Dataset(small(), [made_up(40)])

    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        output = mock.patch("builtins.print")
        output.start()
        self.addCleanup(output.stop)

    def test_the_loss_falls(self):
        run = start(self.dataset, 250)
        final = train(run, self.dataset, self.folder)
        self.assertLess(final, 0.8 * sum(run.losses[:20]) / 20)
        self.assertTrue((self.folder / "loss.png").stat().st_size > 0)

    def test_a_stopped_run_goes_on_as_if_it_had_not_been(self):
        through = start(self.dataset, 8)
        train(through, self.dataset, self.folder)

        stopped = start(self.dataset, 8)
        with (
            mock.patch.object(module.Progress, "step", side_effect=[None, None, KeyboardInterrupt]),
            self.assertRaises(KeyboardInterrupt),
        ):
            train(stopped, self.dataset, self.folder)
        state = torch.load(self.folder / CHECKPOINT, weights_only=False)
        self.assertEqual(state["iteration"], 3)
        self.assertNotIn("final_loss", state["provenance"])

        resumed = start(self.dataset, 8)
        resumed.load(state)
        train(resumed, self.dataset, self.folder)
        self.assertEqual(resumed.losses, through.losses)
        for name, weight in through.average.state_dict().items():
            self.assertTrue(torch.equal(weight, resumed.average.state_dict()[name]), name)

    def test_minutes_end_it(self):
        run = start(self.dataset, 10_000)
        run.schedule = replace(run.schedule, minutes=0.02)
        train(run, self.dataset, self.folder)
        self.assertLess(run.iteration, 10_000)


if __name__ == "__main__":
    unittest.main()
