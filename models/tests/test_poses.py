"""Poses: their conventions, and actions that are the next pose of the hand."""

import tempfile
import unittest
from pathlib import Path

import numpy as np
import written
from made_up import by_hand, experiment, path

from rapid_policy import poses
from rapid_policy.bundle import DENOISER, ENCODER, policy_json
from rapid_policy.dataset import Dataset
from rapid_policy.episodes import read_episode, sources
from rapid_policy.experiment import Experiment
from rapid_policy.rows import unfit

# Numbers of a pose that are learned, and that are executed.
LEARNED = {"none": 3, "rotation_6d": 9, "quaternion": 7}
NAMES = {"none": 3, "rotation_6d": 7, "quaternion": 7}


def posed(representation: str, rotation: str) -> Experiment:
    """The experiment of handheld demonstrations, with other actions."""
    names = [f"n{i}" for i in range(NAMES[rotation] + 1)]
    action = {"representation": representation, "rotation": rotation, "names": names, "units": ["1"] * len(names)}
    action["gripper_squeeze"] = 0.0
    if representation != "absolute":
        turned = {} if rotation == "none" else {"rotation": [4, 8]}
        action["base"] = {"modality": "arm", "position": [0, 3], **turned}
    return experiment("tactile-id", action=action)


class Conventions(unittest.TestCase):
    def test_a_quarter_turn(self):
        # About z: x becomes y. The rows of the matrix, and x y z w.
        quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
        self.assertEqual(poses.rotation_6d(quarter).tolist(), [0, -1, 0, 1, 0, 0])
        np.testing.assert_allclose(poses.quaternions(quarter), [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-12)

    def test_layouts_are_three_ways_to_write_the_same(self):
        wanted = path(50)
        quaternion = np.concatenate([wanted[:, :3, 3], poses.quaternions(wanted[:, :3, :3])], 1)
        given = {
            "columns": wanted.transpose(0, 2, 1).reshape(-1, 16),
            "rows": wanted.reshape(-1, 16),
            "quaternion": quaternion,
        }
        for layout, numbers in given.items():
            with self.subTest(layout):
                found, right = poses.matrices(numbers, layout)
                self.assertTrue(right.all())
                np.testing.assert_allclose(found, wanted, atol=1e-9)
                numbers = numbers.copy()
                numbers[3] = np.nan
                numbers[4, 3 if layout == "quaternion" else 0 :] = 0
                self.assertEqual(np.flatnonzero(~poses.matrices(numbers, layout)[1]).tolist(), [3, 4])

    def test_a_mirror_is_no_rotation(self):
        mirrored = np.eye(4)
        mirrored[0, 0] = -1
        self.assertFalse(poses.matrices(mirrored.reshape(1, 16), "rows")[1][0])

    def test_sixteen_numbers_are_columns_if_nothing_else_is_written(self):
        for numbers, named, layout in (
            (16, None, "columns"),
            (16, "rows", "rows"),
            (7, None, None),
            (16, "quaternion", None),
        ):
            self.assertEqual(poses.layout_of(numbers, named), layout)


class Actions(unittest.TestCase):
    """Each representation, executed as a program would, leads along the recorded path."""

    LENGTH = 40

    def chunk(self, spec: Experiment, tick: int) -> tuple[np.ndarray, Dataset]:
        dataset = Dataset(spec, [by_hand(self.LENGTH)])
        dataset.windows = dataset.windows[dataset.windows[:, 0] == tick]
        batch = dataset.gather(dataset.plan(np.random.default_rng(0), 1))
        return dataset.ranges["action"].invert(batch.actions.numpy())[0], dataset

    def execute(self, spec: Experiment, chunk: np.ndarray, tick: int) -> np.ndarray:
        """[Tp, 4, 4] from the pose at the tick."""
        given, turned = path(self.LENGTH), spec.action.rotation
        steps = np.tile(np.eye(4), (len(chunk), 1, 1))
        steps[:, :3, 3] = chunk[:, :3]
        if turned == "rotation_6d":
            first, second = chunk[:, 3:6], chunk[:, 6:9]
            steps[:, :3, :3] = np.stack([first, second, np.cross(first, second)], 1)
        elif turned == "quaternion":
            numbers = np.concatenate([chunk[:, :3], chunk[:, 3:7]], 1)
            steps, right = poses.matrices(numbers, "quaternion")
            self.assertTrue(right.all())
        now, out = given[tick], []
        if spec.action.representation == "absolute":
            return steps
        if spec.action.representation == "relative":
            if turned == "none":
                steps[:, :3, 3] += now[:3, 3]
                return steps
            return now @ steps
        # The first one of the prediction is of the observation before.
        now = given[tick - spec.action_start].copy()
        for step in steps:
            now = now.copy()
            now[:3, 3] += step[:3, 3]
            now[:3, :3] = step[:3, :3] @ now[:3, :3]
            out.append(now)
        return np.array(out)

    def test_the_path_of_the_hand_comes_back(self):
        wanted, tick = path(self.LENGTH), 12
        for representation in ("absolute", "relative", "delta"):
            for rotation in NAMES:
                with self.subTest(representation=representation, rotation=rotation):
                    spec = posed(representation, rotation)
                    chunk, _ = self.chunk(spec, tick)
                    # Of the ticks from 11 on the next poses.
                    executed, expected = self.execute(spec, chunk, tick), wanted[12:28]
                    np.testing.assert_allclose(executed[:, :3, 3], expected[:, :3, 3], atol=1e-5)
                    if rotation != "none":
                        np.testing.assert_allclose(executed[:, :3, :3], expected[:, :3, :3], atol=1e-5)
                    np.testing.assert_allclose(chunk[:, -1], (np.arange(12, 28) % 7) / 7, atol=1e-6)

    def test_the_first_step_of_a_segment_is_the_newest_observations(self):
        # There is no tick before it: what stands there is of no account, what comes from `action_start` on leads on.
        wanted, spec = path(self.LENGTH), posed("delta", "rotation_6d")
        chunk, _ = self.chunk(spec, 0)
        now = wanted[0, :3, 3]
        np.testing.assert_allclose(now + chunk[1:, :3].cumsum(0), wanted[1:16, :3, 3], atol=1e-5)

    def test_at_the_end_the_hand_stays(self):
        tick = self.LENGTH - 2
        spec = posed("delta", "rotation_6d")
        chunk, dataset = self.chunk(spec, tick)
        np.testing.assert_allclose(chunk[2:, :3], 0, atol=1e-6)
        np.testing.assert_allclose(chunk[2:, 3:9], np.tile([1, 0, 0, 0, 1, 0], (14, 1)), atol=1e-6)
        # The last tick has no next pose.
        self.assertEqual(Dataset(spec, [by_hand(self.LENGTH)]).windows[-1, 0], tick)

    def test_rotations_keep_their_range(self):
        for representation in ("absolute", "relative", "delta"):
            _, dataset = self.chunk(posed(representation, "rotation_6d"), 12)
            low, high = dataset.ranges["action"].low, dataset.ranges["action"].high
            self.assertEqual((low[3:9].tolist(), high[3:9].tolist()), ([-1.0] * 6, [1.0] * 6))

    def test_limits_are_of_what_is_executed(self):
        for representation in ("absolute", "relative", "delta"):
            for rotation in NAMES:
                with self.subTest(representation=representation, rotation=rotation):
                    spec = posed(representation, rotation)
                    dataset = Dataset(spec, [by_hand(self.LENGTH)])
                    ranges = {key: value.to_dict() for key, value in dataset.ranges.items()}
                    action = policy_json(spec, {"normalization": ranges}, {ENCODER: "", DENOISER: ""})["action"]
                    self.assertEqual(action["shape"], [LEARNED[rotation] + 1])
                    self.assertEqual(len(action["normalization"][0]["min"]), LEARNED[rotation] + 1)
                    reached = path(self.LENGTH)[1:, :3, 3]
                    low, high = (np.array(action["limits"][key]) for key in ("min", "max"))
                    self.assertEqual((len(low), len(high)), (NAMES[rotation] + 1, NAMES[rotation] + 1))
                    margin = 0.05 * np.ptp(reached, 0)
                    np.testing.assert_allclose(low[:3], reached.min(0) - margin, atol=1e-4)
                    np.testing.assert_allclose(high[:3], reached.max(0) + margin, atol=1e-4)
                    np.testing.assert_allclose(low[3:-1], -1.1)
                    np.testing.assert_allclose([low[-1], high[-1]], [-6 / 7 * 0.05, 6 / 7 * 1.05], atol=1e-4)
                    self.assertEqual("base" in action, representation != "absolute")
                    if representation != "absolute" and rotation != "none":
                        base = {"modality": "arm", "position": [0, 3], "rotation": [4, 8]}
                        self.assertEqual(action["base"], base)

    def test_lost_tracking_breaks_the_path(self):
        episode = by_hand(30)
        episode.value("phone")[10] = np.nan
        windows = Dataset(posed("absolute", "none"), [episode]).windows
        # At 9 the next pose is missing, at 10 the present one.
        self.assertEqual(sorted({(int(b), int(e)) for _, b, e in windows}), [(0, 9), (11, 29)])

    def test_a_gripper_squeezes_what_stopped_it(self):
        seen = (np.arange(1, 30) % 7) / 7
        for representation in ("absolute", "relative"):
            spec = posed(representation, "none")
            spec = spec.model_copy(update={"action": spec.action.model_copy(update={"gripper_squeeze": 0.2})})
            dataset = Dataset(spec, [by_hand(30)])
            wanted = dataset.targets[:29, -1]
            np.testing.assert_allclose(wanted, seen - 0.2 * (1 - seen / (6 / 7)), atol=1e-6)
            self.assertAlmostEqual(wanted.max(), 6 / 7)
            # Episodes that are held out, of which this one is never open, have the same mapping.
            other = by_hand(30)
            other.value("gripper")[:] = 0.0
            held_out = Dataset(spec, [other], dataset.ranges)
            np.testing.assert_allclose(held_out.targets[:29, -1], -0.2, atol=1e-6)

    def test_the_state_is_made_of_parts(self):
        episode = by_hand(30)
        dataset = Dataset(experiment("tactile-id"), [episode])
        state = dataset.vectors["state"]
        np.testing.assert_allclose(state[:, :3], path(30)[:, :3, 3], atol=1e-6)
        np.testing.assert_allclose(state[:, 3], (np.arange(30) % 7) / 7, atol=1e-6)


class Files(unittest.TestCase):
    """The same from files: the layout of the metadata and the latency of the phone count."""

    def test_an_episode_by_hand_is_read(self):
        wanted, opening = path(20), np.linspace(0, 1, 20)
        spec = experiment("tactile-id")
        with tempfile.TemporaryDirectory() as folder:
            for late in (0, 1):
                file = written.by_hand(Path(folder) / f"{late}.mcap", wanted, opening, late={"phone": late})
                episode = read_episode(file, sources(spec))
                self.assertIsNone(unfit(spec, episode))
                self.assertEqual(episode.facts.layouts, {"phone": "columns"})
                dataset = Dataset(spec, [episode])
                np.testing.assert_allclose(dataset.targets[:19, :3], wanted[1:, :3, 3], atol=1e-9)
                # Squeezed by nothing at its widest.
                self.assertAlmostEqual(dataset.targets[18, 3], opening[19])

    def test_rows_are_read_as_rows(self):
        wanted = path(20)
        turned = wanted.transpose(0, 2, 1)
        spec = experiment("tactile-id")
        with tempfile.TemporaryDirectory() as folder:
            file = written.by_hand(Path(folder) / "a.mcap", turned, np.linspace(0, 1, 20), poses={"phone": "rows"})
            dataset = Dataset(spec, [read_episode(file, sources(spec))])
            np.testing.assert_allclose(dataset.targets[:19, :3], wanted[1:, :3, 3], atol=1e-9)


if __name__ == "__main__":
    unittest.main()
