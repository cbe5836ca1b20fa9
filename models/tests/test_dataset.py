"""Windows: which ticks are learned from, and what a policy would have been given at each."""

import json
import unittest
from unittest import mock

import numpy as np
import torch
from made_up import POLICIES, by_hand, experiment, made_up, observed, small, twelve_steps

from rapid_policy import dataset as module
from rapid_policy.dataset import Dataset, drop, inputs
from rapid_policy.experiment import Experiment
from rapid_policy.rows import unfit

CPU = torch.device("cpu")


def plain() -> Experiment:
    """The policy without chance: no noise on vectors, no gain, no shift, nothing taken away."""
    spec = experiment()
    for key in ("wrist", "tactile", "state"):
        spec = observed(spec, key, augmentation={}, **({"dropout": {}} if key != "state" else {}))
    return spec


def remembering(**dropout: float) -> Experiment:
    """A policy with a history without chance, but for how the tactile picture is taken away: 12 steps, 5 ticks apart."""
    spec = twelve_steps()
    for key in ("wrist", "tactile", "touched", "state"):
        spec = observed(spec, key, augmentation={})
    return observed(observed(spec, "wrist", dropout={}), "tactile", dropout=dropout)


def segments(dataset: Dataset) -> list[tuple[int, int]]:
    """Begin and end of each."""
    return sorted({(int(begin), int(end)) for _, begin, end in dataset.windows})


def drawn(dataset: Dataset, size: int, seed: int = 0):
    """A batch, and the inputs of the encoder."""
    batch = dataset.gather(dataset.plan(np.random.default_rng(seed), size))
    return batch, inputs(dataset.spec, batch, CPU)


class Windows(unittest.TestCase):
    def test_episodes_do_not_run_into_each_other(self):
        dataset = Dataset(plain(), [made_up(30), made_up(20)])
        self.assertEqual(segments(dataset), [(0, 30), (30, 50)])
        self.assertEqual(len(dataset.windows), 50)

    def test_what_is_missing_breaks_a_segment(self):
        episode = made_up(30)
        episode.present("arm")[10] = False
        episode.acted[20] = False
        self.assertEqual(segments(Dataset(plain(), [episode])), [(0, 10), (11, 20), (21, 30)])

    def test_a_gap_in_the_frame_index_breaks_a_segment(self):
        episode = made_up(30)
        episode.ticks[12:] += 1
        self.assertEqual(segments(Dataset(plain(), [episode])), [(0, 12), (12, 30)])

    def test_what_is_not_required_may_be_absent(self):
        episode = made_up(30)
        episode.present("tactile_tip")[10:20] = False
        dataset = Dataset(plain(), [episode])
        self.assertEqual(segments(dataset), [(0, 30)])
        dataset.windows = dataset.windows[10:21]
        batch, given = drawn(dataset, 200)
        absent = batch.mask[:, 1] == 0
        self.assertTrue(absent.any() and not absent.all())
        self.assertEqual(float(given["tactile"][absent].abs().max()), 0)
        # Plugged in again at 20: the step before shows what tick 20 shows, the difference of 20 grey levels.
        self.assertAlmostEqual(float(given["tactile"][~absent][:, 0].min()), 20 / 255, places=5)

    def test_what_an_absence_was_decides_whether_it_is_learned_from(self):
        episode = made_up(40)
        present = episode.present("tactile_tip")
        for reason, rows in (("unplug", slice(5, 10)), ("crash", slice(15, 20)), ("stall", slice(25, 30))):
            present[rows] = False
            episode.arrays["plugged tactile_tip"][rows] = reason != "unplug"
            episode.arrays["running tactile_tip"][rows] = reason == "stall"
            self.assertEqual(np.flatnonzero(episode.absent("tactile_tip", reason)).tolist(), [*range(40)[rows]])
        for absences, expected in (
            (["unplug", "crash", "stall"], [(0, 40)]),
            (["unplug"], [(0, 15), (20, 25), (30, 40)]),
            ([], [(0, 5), (10, 15), (20, 25), (30, 40)]),
        ):
            spec = json.loads(plain().to_text())
            spec["data"] = {**spec.get("data", {}), "absences": absences}
            found = segments(Dataset(Experiment.from_text(json.dumps(spec)), [episode]))
            self.assertEqual(found, expected, absences)

    def test_a_window_is_of_its_tick(self):
        dataset = Dataset(plain(), [made_up(40)])
        dataset.windows = dataset.windows[[0, 12, 39]]
        batch, given = drawn(dataset, 100)
        actions = dataset.ranges["action"].invert(batch.actions.numpy())[:, :, 0].round().astype(int)
        seen = {tuple(row) for row in actions}
        # The action of the tick has index 1; beyond an end the last one is repeated.
        expected = {(0, *range(15)), tuple(range(11, 27)), (38, *[39] * 15)}
        self.assertEqual(seen, expected)
        wrist = ((given["wrist"][:, :, 0, 0, 0] + 1) * 127.5).round().int()
        self.assertEqual({tuple(row) for row in wrist.tolist()}, {(0, 0), (11, 12), (38, 39)})

    def test_an_outcome_is_the_last_action_of_the_episode(self):
        first, second, third = made_up(30), made_up(10), made_up(20)
        # A segment ends at 11 and at 25, and the last row that has an action is 27.
        first.present("arm")[11] = first.present("arm")[25] = False
        first.present("arm")[26:] = False
        first.acted[28:] = False
        second.acted[:4] = second.acted[5:] = False
        # No window is of this one.
        silent = made_up(15)
        silent.present("arm")[:] = False
        spec = plain()
        self.assertEqual(drawn(Dataset(spec, [first]), 5)[0].outcomes.shape, (5, 0))
        dataset = Dataset(observed(spec, "tactile", outcome=0.5), [silent, second, first, silent, third, silent])
        batch, given = drawn(dataset, 500)
        outcomes = dataset.ranges["action"].invert(batch.outcomes.numpy())[:, 0].round().astype(int)
        self.assertEqual(set(outcomes.tolist()), {4, 27, 19})
        # A window of the first episode is recognised by a tick that the third has not.
        seen = ((given["wrist"][:, -1, 0, 0, 0] + 1) * 127.5).round().int().numpy()
        self.assertEqual(set(outcomes[seen >= 20].tolist()), {27})
        self.assertEqual(set(outcomes[seen == 11].tolist()), {19})

    def test_nothing_to_learn_from_is_said(self):
        episode = made_up(10)
        episode.present("arm")[:] = False
        with self.assertRaisesRegex(ValueError, "no window"):
            Dataset(plain(), [episode])

    def test_what_is_required_ends_a_segment(self):
        spec = experiment("vision-diff")
        episode = made_up(30)
        episode.present("tactile_tip")[:15] = False
        self.assertEqual(segments(Dataset(spec, [episode])), [(15, 30)])

    def test_why_an_episode_is_unfit(self):
        silent, other = made_up(10), made_up(10)
        silent.acted[:] = False
        other.facts.observation_hz = 30.0
        short = made_up(10)
        short.arrays["value arm"] = short.arrays["value arm"][:, :3]
        strange = by_hand(10)
        strange.arrays["value phone"] = strange.arrays["value phone"][:, :12]
        for spec, episode, reason in (
            (plain(), made_up(10), None),
            (plain(), silent, "no action"),
            (plain(), other, "recorded at 30 Hz, the policy acts at 10: write control_hz = 30"),
            (plain(), short, "arm: 3 numbers, but number 3"),
            (experiment("tactile-id"), by_hand(10), None),
            (experiment("tactile-id"), strange, "phone: 12 numbers and layout 'columns': not a pose"),
        ):
            with self.subTest(reason):
                found = unfit(spec, episode)
                self.assertRegex(found, reason) if reason else self.assertIsNone(found)


class Pictures(unittest.TestCase):
    def test_a_shift_repeats_the_edges(self):
        spec = observed(plain(), "tactile", augmentation={"shift": 4})
        episode = made_up(5)
        episode.arrays["value tactile_tip"] = np.tile(np.arange(96, dtype=np.uint8)[None, :, None, None], (5, 1, 96, 3))
        episode.arrays["value tactile_tip"][1:] += 50
        episode.arrays["value tactile_tip"][1:, 40] += 4
        dataset = Dataset(spec, [episode])
        dataset.windows = dataset.windows[3:4]
        _, given = drawn(dataset, 64)
        # The reference is shifted with the picture: the difference is 50 everywhere, and the brighter row moves.
        rows = (given["tactile"][:, 1, 0, :, 0] * 255).round()
        self.assertEqual(set(rows.unique().tolist()), {50.0, 52.0})
        places = {int(row.argmax()) for row in rows}
        self.assertEqual(places, {18, 19, 20, 21, 22})

    def test_colours_may_be_the_other_way_round(self):
        episode = made_up(5)
        episode.arrays["value cam_wrist"] = np.tile(np.array([255, 0, 128], np.uint8), (5, 96, 96, 1))
        for color, expected in (("rgb", [1, -1, 0]), ("bgr", [0, -1, 1])):
            _, given = drawn(Dataset(observed(plain(), "wrist", color=color), [episode]), 2)
            self.assertEqual(given["wrist"][0, 0, :, 3, 3].round().tolist(), expected)

    def test_an_encoder_of_whole_pictures_is_given_them(self):
        spec = experiment(encoder={"type": "resnet18"})
        _, given = drawn(Dataset(spec, [made_up(5)]), 2)
        self.assertEqual(tuple(given["wrist"].shape), (2, 2, 3, 96, 96))


class Apart(unittest.TestCase):
    def test_steps_are_as_many_ticks_apart_as_the_program_looks_back(self):
        spec = observed(observed(plain(), "wrist", down_sample_steps=3), "state", down_sample_steps=2)
        dataset = Dataset(spec, [made_up(30), made_up(30)])
        dataset.windows = dataset.windows[[10, 30 + 1]]
        batch, given = drawn(dataset, 200)
        tick = dataset.ranges["action"].invert(batch.actions.numpy())[:, 1, 0].round().astype(int)
        wrist = ((given["wrist"][:, :, 0, 0, 0] + 1) * 127.5).round().int()
        state = np.floor(dataset.ranges["state"].invert(given["state"].numpy())[:, :, 0]).astype(int)
        seen = {at: ({tuple(r) for r in wrist[tick == at].tolist()}, {tuple(r) for r in state[tick == at].tolist()})
                for at in set(tick.tolist())}  # fmt: skip
        # Steps before the beginning of a segment repeat its first one, as at run time.
        self.assertEqual(seen, {10: ({(7, 10)}, {(8, 10)}), 1: ({(0, 1)}, {(0, 1)})})


class Dropout(unittest.TestCase):
    def masked(self, spec: Experiment, present: np.ndarray, steps: int = 2) -> np.ndarray:
        """[B, To, M] of windows at random places of an episode of 100 ticks."""
        count = len(present)
        tick = np.random.default_rng(1).integers(steps, 100, count)
        seen = tick[:, None] + np.arange(1 - steps, 1)
        shape = (count, steps, present.shape[1])
        spans = np.tile([0, 100], (count, 1))
        seen = np.broadcast_to(seen[:, :, None], shape)
        return drop(spec, np.broadcast_to(present[:, None], shape), seen, spans, np.random.default_rng(0)).visible

    def test_dropout_leaves_one_picture_and_brings_none_back(self):
        present = np.ones((20_000, 2), bool)
        kept = self.masked(experiment(), present)[:, -1]
        self.assertTrue(kept.any(1).all())
        # Each is taken with 0.3; both with 0.09, and then one of them comes back by lot.
        for share in (1 - kept.mean(0)).tolist():
            self.assertAlmostEqual(share, 0.3 - 0.09 / 2, delta=0.015)
        present[:, 0] = False
        kept = self.masked(experiment(), present)[:, -1]
        self.assertEqual((int(kept[:, 0].max()), int(kept[:, 1].min())), (0, 1))

    def test_the_only_picture_of_a_policy_remains(self):
        spec = observed(experiment("vision-mask"), "wrist", required=False, dropout={"replug": 0.5})
        kept = self.masked(spec, np.ones((2000, 1), bool))
        self.assertTrue(kept[:, 1].all())
        self.assertAlmostEqual(float(kept[:, 0].mean()), 0.5, delta=0.05)
        gone = self.masked(spec, np.zeros((10, 1), bool))
        self.assertFalse(gone.any())

    def test_no_experiment_of_the_repository_takes_the_last_picture(self):
        for path in POLICIES:
            spec = experiment(path.stem)
            if spec.policy.mask_aware:
                kept = self.masked(spec, np.ones((2000, len(spec.images)), bool), spec.policy.n_obs_steps)
                self.assertTrue(kept[:, -1].any(1).all(), path.stem)

    def test_in_the_middle_of_a_window_the_first_new_picture_is_shown(self):
        spec = observed(plain(), "wrist", dropout={"replug": 0.5})
        dataset = Dataset(spec, [made_up(40)])
        dataset.windows = dataset.windows[20:21]
        batch, given = drawn(dataset, 2000)
        self.assertTrue((batch.mask == 1).all())
        wrist = ((given["wrist"][:, :, 0, 0, 0] + 1) * 127.5).round().int()
        pairs = {tuple(row) for row in wrist.tolist()}
        self.assertEqual(pairs, {(19, 20), (20, 20)})
        self.assertAlmostEqual(float((wrist[:, 0] == 20).float().mean()), 0.5, delta=0.05)

    def test_in_the_middle_of_an_episode_it_is_gone_more_often_towards_the_end(self):
        spec = observed(plain(), "tactile", dropout={"episode": 0.6})
        kept = self.masked(spec, np.ones((40_000, 2), bool))
        tick = np.random.default_rng(1).integers(2, 100, 40_000)
        self.assertTrue(kept[:, :, 0].all())
        gone = [1 - kept[(tick >= a) & (tick < a + 20), -1, 1].mean() for a in (0, 40, 80)]
        self.assertLess(gone[0], gone[1])
        self.assertLess(gone[1], gone[2])
        # Where it is back the step before may have been without it.
        self.assertTrue((kept[:, 1, 1] & ~kept[:, 0, 1]).any())

    def test_what_is_held_is_shown_as_it_was_since_the_episode_began(self):
        held = {"dropout": {"held": 0.5}, "when_absent": {"hold_last_ms": 1000}}
        dataset = Dataset(observed(plain(), "wrist", **held), [made_up(30), made_up(40)])
        dataset.windows = dataset.windows[[30 + 25, 30 + 4, 30]]
        batch, given = drawn(dataset, 6000)
        self.assertTrue((batch.mask == 1).all())
        wrist = ((given["wrist"][:, :, 0, 0, 0] + 1) * 127.5).round().int()
        tick = dataset.ranges["action"].invert(batch.actions.numpy())[:, 1, 0].round().astype(int)
        pairs = {at: {tuple(row) for row in wrist[torch.from_numpy(tick == at)].tolist()} for at in (25, 4, 0)}
        # A second is 10 ticks, and nothing of the episode before is shown.
        self.assertEqual(pairs[25], {(24 - since, 25 - since) for since in range(11)})
        self.assertEqual(pairs[4], {(3 - since, 4 - since) for since in range(4)})
        self.assertEqual(pairs[0], {(0, 0)})
        old = wrist[torch.from_numpy(tick == 25)][:, 1] < 25
        self.assertAlmostEqual(float(old.float().mean()), 0.5, delta=0.05)
        # What was not there then is not shown as if it had been.
        dataset = Dataset(observed(plain(), "wrist", **held), [made_up(30)])
        dataset.windows = dataset.windows[25:26]
        dataset.present[15:24, 0] = False
        _, given = drawn(dataset, 500)
        wrist = ((given["wrist"][:, :, 0, 0, 0] + 1) * 127.5).round().int()
        self.assertEqual({tuple(row) for row in wrist.tolist()}, {(24, 25)})

    def test_without_dropout_nothing_is_taken(self):
        self.assertTrue(self.masked(plain(), np.ones((100, 2), bool)).all())

    def test_a_measurement_varies_nothing(self):
        dataset = Dataset(small(), [made_up(40)])
        plan = dataset.plan(np.random.default_rng(0), 50, vary=False)
        self.assertEqual(sorted(plan), ["done", "seen", "tick", "visible"])
        self.assertTrue(plan["visible"].all())


class Histories(unittest.TestCase):
    """Tactile pictures show their row: of each window the rows that its history shows, None where there is no picture."""

    def shown(self, dataset: Dataset, size: int = 100) -> tuple[np.ndarray, np.ndarray, list[list[int | None]]]:
        """The tick in its episode and the tactile bit of each window, and its history."""
        plan = dataset.plan(np.random.default_rng(0), size)
        batch = dataset.gather(plan)
        given = inputs(dataset.spec, batch, CPU)
        there, now = plan["valid touched"], batch.mask[:, 1].numpy() == 1
        starts = dataset.starts[np.searchsorted(dataset.starts, plan["tick"], "right") - 1]
        rows = plan["seen touched"] - starts[:, None]
        # It is read where it is looked at: where there is no picture of now.
        read = there & ~now[:, None]
        np.testing.assert_array_equal(given["touched_valid"] == 1, read)
        pictures = given["touched"][:, :, 0, 0, 0].numpy() * 255
        np.testing.assert_array_equal(pictures.round(), np.where(read, rows, 0))
        history = [[r if t else None for r, t in zip(*one, strict=True)] for one in zip(rows.tolist(), there.tolist(), strict=True)]
        return plan["tick"] - starts, now, history

    def test_it_is_what_there_was_at_each_of_its_ticks(self):
        episode = by_hand(100)
        episode.present("tactile_tip")[30:50] = False
        dataset = Dataset(remembering(), [episode])
        dataset.windows = dataset.windows[[70, 44, 52]]
        tick, bit, found = self.shown(dataset)
        self.assertEqual({int(t): (bool(b), tuple(h)) for t, b, h in zip(tick, bit, found, strict=True)}, {
            70: (True, (15, 20, 25, None, None, None, None, 50, 55, 60, 65, 70)),
            # The tick itself has none; those of before are still there.
            44: (False, (*[None] * 3, 4, 9, 14, 19, 24, 29, None, None, None)),
            # Nothing stands in for a step of before the replug.
            52: (True, (None, 2, 7, 12, 17, 22, 27, None, None, None, None, 52)),
        })  # fmt: skip

    def test_before_the_beginning_there_is_nothing(self):
        broken = by_hand(100)
        broken.present("phone")[40] = False
        dataset = Dataset(remembering(), [by_hand(100), broken])
        # The last tick of an episode and the two around an invalid pose have no action.
        dataset.windows = dataset.windows[np.isin(dataset.windows[:, 0], [0, 100 + 12, 100 + 47])]
        tick, _, found = self.shown(dataset)
        expected = {0: (*[None] * 11, 0), 12: (*[None] * 9, 2, 7, 12), 47: (*[None] * 10, 42, 47)}
        self.assertEqual({int(t): tuple(h) for t, h in zip(tick, found, strict=True)}, expected)

    def test_its_last_step_is_there_if_the_picture_of_now_is(self):
        episode = by_hand(100)
        episode.present("tactile_tip")[30:50] = False
        episode.present("cam_wrist")[45:60] = False
        spec = observed(remembering(window=0.5, episode=0.4, replug=0.3), "wrist", dropout={"window": 0.5, "episode": 0.4})
        # Where both are absent no window is learned from.
        plan = Dataset(spec, [episode]).plan(np.random.default_rng(0), 4000)
        bit = plan["visible"][:, -1, 1]
        np.testing.assert_array_equal(plan["valid touched"][:, -1], bit)
        self.assertTrue(0.2 < bit.mean() < 0.8)

    def test_a_window_without_the_picture_was_unplugged_some_time_ago(self):
        dataset = Dataset(remembering(window=0.5), [by_hand(100)])
        dataset.windows = dataset.windows[dataset.windows[:, 0] >= 55]
        plan = dataset.plan(np.random.default_rng(0), 20_000)
        bit, valid = plan["visible"][:, -1, 1], plan["valid touched"]
        self.assertAlmostEqual(bit.mean(), 0.5, delta=0.02)
        self.assertTrue(valid[bit].all())
        left = valid[~bit].sum(1)
        counts = np.bincount(left, minlength=13) / len(left)
        self.assertAlmostEqual(counts[0], 1 / 3, delta=0.02)
        # 1 to 55 ticks ago: the oldest step is always there.
        np.testing.assert_allclose(counts[1:12], 2 / 3 / 11, atol=0.01)
        self.assertEqual(counts[12], 0)
        # Those that are left are the oldest.
        np.testing.assert_array_equal(valid[~bit], np.arange(12) < left[:, None])

    def test_two_histories_of_a_modality_lack_the_same(self):
        described = json.loads(remembering(window=0.5).to_text())
        touched = next(o for o in described["observation"] if o["key"] == "touched")
        described["observation"].append({**touched, "key": "lately", "down_sample_steps": 1})
        dataset = Dataset(Experiment.from_text(json.dumps(described)), [by_hand(100)])
        plan = dataset.plan(np.random.default_rng(0), 4000)
        there = {}
        for key in ("touched", "lately"):
            for b, (rows, valid) in enumerate(zip(plan[f"seen {key}"], plan[f"valid {key}"], strict=True)):
                for row, is_there in zip(rows[rows < rows[-1]].tolist(), valid[rows < rows[-1]].tolist(), strict=True):
                    self.assertEqual(there.setdefault((b, row), is_there), is_there)

    def test_what_leaves_in_the_middle_of_an_episode_is_gone_from_its_history(self):
        dataset = Dataset(remembering(episode=0.5), [by_hand(100)])
        dataset.windows = dataset.windows[[40, 70]]

        def left(_, spans, random):
            random.random(len(spans))
            return tuple(np.tile([0, row], (len(spans), 1)) for row in (30, 45))

        with mock.patch.object(module, "_absences", left):
            tick, bit, found = self.shown(dataset)
        self.assertEqual({int(t): (bool(b), tuple(h)) for t, b, h in zip(tick, bit, found, strict=True)}, {
            40: (False, (*[None] * 3, 0, 5, 10, 15, 20, 25, None, None, None)),
            70: (True, (15, 20, 25, None, None, None, 45, 50, 55, 60, 65, 70)),
        })  # fmt: skip

    def test_what_is_held_is_not_in_it(self):
        held = {"dropout": {"held": 0.5}, "when_absent": {"hold_last_ms": 3000}}
        spec = observed(remembering(), "tactile", **held)
        dataset = Dataset(spec, [by_hand(100)])
        dataset.windows = dataset.windows[70:71]
        plan = dataset.plan(np.random.default_rng(0), 200)
        batch = dataset.gather(plan)
        now = (inputs(spec, batch, CPU)["tactile"][:, -1, 0, 0, 0] * 255).round().int()
        self.assertTrue((batch.mask == 1).all())
        self.assertTrue(int(now.min()) < 45 and int(now.max()) == 70)
        for last, valid in zip(now.tolist(), plan["valid touched"].tolist(), strict=True):
            self.assertEqual(valid, [float(row <= last) for row in range(15, 71, 5)])

    def test_all_of_a_history_is_shifted_as_one_and_as_its_reference(self):
        spec = observed(remembering(), "touched", augmentation={"shift": 4})
        episode = by_hand(100)
        tactile = episode.value("tactile_tip")
        tactile[1:, 40] += 4
        episode.present("tactile_tip")[66:71] = False
        dataset, now = Dataset(spec, [episode]), Dataset(spec, [episode])
        dataset.windows, now.windows = dataset.windows[70:71], dataset.windows[65:66]
        _, given = drawn(dataset, 64)
        seen = given["touched"][:, :-1]
        places = (seen[:, :, 0, :, 0] - seen[:, :, 0, :1, 0]).argmax(2)
        self.assertTrue((places == places[:, :1]).all())
        self.assertEqual(set(places.unique().tolist()), {18, 19, 20, 21, 22})
        _, given = drawn(now, 64)
        self.assertEqual(set((given["tactile"][:, 1, 0, :, 0] * 255).round().unique().tolist()), {65.0, 67.0})

    def test_windows_are_those_of_a_policy_without(self):
        spec = observed(experiment("tactile-id"), "tactile", dropout={"window": 0.4})
        plain, with_one = (Dataset(s, [by_hand(60)]) for s in (spec, twelve_steps()))
        one, other = (d.plan(np.random.default_rng(3), 50) for d in (plain, with_one))
        self.assertEqual(sorted(set(other) - set(one)), ["corner touched", "seen touched", "valid touched"])
        # The observation is between two others.
        other["seen"] = other["seen"][..., [0, 1, 3]]
        for name, values in one.items():
            np.testing.assert_array_equal(values, other[name], name)
        batch = with_one.gather({name: rows[10:40] for name, rows in with_one.plan(np.random.default_rng(3), 50).items()})
        whole = with_one.gather(with_one.plan(np.random.default_rng(3), 50))
        self.assertTrue(batch.shown["touched"].any())
        self.assertTrue(torch.equal(batch.pictures["touched"], whole.pictures["touched"][10:40]))

    def test_a_measurement_takes_nothing_from_it(self):
        dataset = Dataset(twelve_steps(), [by_hand(100)])
        dataset.windows = dataset.windows[55:]
        plan = dataset.plan(np.random.default_rng(0), 50, vary=False)
        self.assertTrue(plan["valid touched"].all())


if __name__ == "__main__":
    unittest.main()
