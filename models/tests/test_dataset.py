"""Windows: which ticks are learned from, and what a policy would have been given at each."""

import sys
import unittest
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from rapid_policy import dataset as module
from rapid_policy.dataset import Dataset
from rapid_policy.episodes import Episode
from rapid_policy.spec import PICTURE, tactile_id

SIDE = PICTURE[1]


def made_up(length: int, seed: int = 0) -> Episode:
    """An episode in which everything is there; the number of the tick is in every picture and vector."""
    random = np.random.default_rng(seed)
    count = np.arange(length)
    pictures = np.broadcast_to(count[:, None, None, None], (length, SIDE, SIDE, 3)).astype(np.uint8)
    names = ("cam_wrist", "tactile_tip", "arm")
    return Episode(
        path=Path("made-up"),
        ticks=count.astype(np.int64),
        times=count * 100_000_000,
        values={
            "cam_wrist": pictures,
            "tactile_tip": pictures + 100,
            "arm": count[:, None] + random.uniform(0, 1, (length, 4)),
        },
        present={name: np.ones(length, bool) for name in names},
        references={"cam_wrist": pictures[0], "tactile_tip": pictures[0] + 100},
        actions=np.repeat(count[:, None] * 1.0, 4, 1),
        acted=np.ones(length, bool),
        facts={},
        summary={},
    )


def segments(dataset: Dataset) -> list[tuple[int, int]]:
    """Begin and end of each."""
    return sorted({(int(begin), int(end)) for _, begin, end in dataset.windows})


class Windows(unittest.TestCase):
    def setUp(self):
        # Without chance: no noise on vectors, no gain, no shift.
        self.plain = {"STATE_NOISE": 0.0, "BRIGHTNESS": 0.0, "SHIFT": dict.fromkeys(module.SHIFT, 0)}
        self.before = {name: getattr(module, name) for name in self.plain}
        for name, value in self.plain.items():
            setattr(module, name, value)

    def tearDown(self):
        for name, value in self.before.items():
            setattr(module, name, value)

    def test_episodes_do_not_run_into_each_other(self):
        dataset = Dataset(tactile_id(), [made_up(30), made_up(20)])
        self.assertEqual(segments(dataset), [(0, 30), (30, 50)])
        self.assertEqual(len(dataset.windows), 50)

    def test_what_is_missing_breaks_a_segment(self):
        episode = made_up(30)
        episode.present["arm"][10] = False
        episode.acted[20] = False
        self.assertEqual(segments(Dataset(tactile_id(), [episode])), [(0, 10), (11, 20), (21, 30)])

    def test_a_gap_in_the_frame_index_breaks_a_segment(self):
        episode = made_up(30)
        episode.ticks[12:] += 1
        self.assertEqual(segments(Dataset(tactile_id(), [episode])), [(0, 12), (12, 30)])

    def test_what_is_not_required_may_be_absent(self):
        episode = made_up(30)
        episode.present["tactile_tip"][10:20] = False
        dataset = Dataset(tactile_id(), [episode])
        self.assertEqual(segments(dataset), [(0, 30)])
        dataset.windows = dataset.windows[10:21]
        batch = dataset.draw(np.random.default_rng(0), 200)
        tactile = batch.observations["tactile"]
        absent = ~batch.present[:, 1]
        self.assertTrue(absent.any() and not absent.all())
        self.assertEqual(float(tactile[absent][:, 1].abs().max()), 0)
        # Plugged in again at 20: the step before shows what tick 20 shows, the difference of 20 grey levels.
        self.assertAlmostEqual(float(tactile[~absent][:, 0].min()), 20 / 255, places=5)

    def test_a_window_is_of_its_tick(self):
        dataset = Dataset(tactile_id(), [made_up(40)])
        dataset.windows = dataset.windows[[0, 12, 39]]
        batch = dataset.draw(np.random.default_rng(0), 100)
        actions = dataset.ranges["action"].invert(batch.actions.numpy())[:, :, 0].round().astype(int)
        seen = {tuple(row) for row in actions}
        # The action of the tick has index 1; beyond an end the last one is repeated.
        expected = {(0, *range(15)), tuple(range(11, 27)), (38, *[39] * 15)}
        self.assertEqual(seen, expected)
        wrist = ((batch.observations["wrist"][:, :, 0, 0, 0] + 1) * 127.5).round().int()
        self.assertEqual({tuple(row) for row in wrist.tolist()}, {(0, 0), (11, 12), (38, 39)})

    def test_nothing_to_learn_from_is_said(self):
        episode = made_up(10)
        episode.acted[:] = False
        with self.assertRaisesRegex(ValueError, "no window"):
            Dataset(tactile_id(), [episode])

    def test_a_policy_without_pictures_that_may_be_absent(self):
        spec = tactile_id()
        spec = replace(spec, observations=tuple(replace(o, required=True) for o in spec.observations))
        episode = made_up(30)
        episode.present["tactile_tip"][:15] = False
        self.assertEqual(segments(Dataset(spec, [episode])), [(15, 30)])


if __name__ == "__main__":
    unittest.main()
