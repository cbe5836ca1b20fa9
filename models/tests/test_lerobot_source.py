"""Data sets of LeRobot as a source: what `rapid export` made of episodes is learned from as the episodes are."""

import json
import unittest

import numpy as np
from made_up import experiment
from recorded import Folder, rapid

from rapid_policy import lerobot_source
from rapid_policy.corpus import load
from rapid_policy.dataset import Dataset
from rapid_policy.episodes import EpisodeError, episode_files, read_episode, sources


class Present(unittest.TestCase):
    def test_with_its_bit_and_a_sample_that_can_be_used(self):
        rows = {
            "names": {key: ["cam", "arm"] for key in ("rapid.mask", "rapid.valid", "rapid.plugged")},
            "rapid.mask": np.array([[1, 1], [0, 1], [1, 1], [0, 1]]),
            "rapid.plugged": np.array([[1, 1], [0, 1], [1, 1], [1, 1]]),
            "rapid.valid": np.array([[1, 1], [1, 1], [0, 1], [0, 0]]),
        }
        self.assertEqual(lerobot_source._present(rows, "cam", 4).tolist(), [True, False, False, False])
        self.assertEqual(lerobot_source._present(rows, "arm", 4).tolist(), [True, True, True, False])
        self.assertTrue(lerobot_source._present({"names": {}}, "arm", 4).all())
        found = lerobot_source.presence(rows, "cam", 4)
        self.assertEqual(found["plugged"].tolist(), [True, False, True, True])
        self.assertEqual(found["running"].tolist(), [True, False, True, False])
        # An earlier version's, and another program's.
        del rows["names"]["rapid.plugged"]
        self.assertEqual(lerobot_source.presence(rows, "cam", 4)["plugged"].tolist(), [True, False, True, False])
        theirs = {"names": {}, "columns": {"observation.state": ["arm.0"]}, "observation.state": np.zeros((4, 1))}
        theirs["observation.images.cam"] = [b""] * 4
        for modality, there in (("arm", True), ("cam", True), ("tactile", False)):
            found = lerobot_source.presence(theirs, modality, 4)
            # What is not in the data set is unplugged, which is no stall.
            for name in ("plugged", "running"):
                self.assertEqual(found[name].tolist(), [there] * 4, (modality, name))


class Columns(unittest.TestCase):
    def numbers(self, columns: list[str], modality: str) -> list[float]:
        rows = {"names": {}, "columns": {"observation.state": columns}, "observation.state": np.arange(9.0)[None, :]}
        return lerobot_source.numbers(rows, modality)[0][0].tolist()

    def test_numbers_are_in_the_order_of_the_sensor(self):
        columns = ["arm.1", "hand.0", "arm.0", "arm.2"]
        self.assertEqual(self.numbers(columns, "arm"), [2, 0, 3])
        self.assertEqual(self.numbers(columns, "hand"), [1])
        # Those of other programs are in the order of the columns.
        self.assertEqual(self.numbers(["arm.b", "arm.a"], "arm"), [0, 1])

    def test_a_number_that_was_left_out_is_named(self):
        with self.assertRaisesRegex(lerobot_source.DatasetError, "arm.2 without arm.1: export with --state arm"):
            self.numbers(["arm.0", "arm.2"], "arm")


class Exported(Folder):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        # A data set has no tags: the experiment's seeds would choose none of its episodes.
        cls.spec = experiment(data={"seeds": None})
        cls.episodes, cls.rows = cls.folder / "episodes", cls.folder / "rows"
        for words in (
            ("--sim", "task", "--expert", "--record", "--episodes", "2", "--seed", "1000", "--out", str(cls.episodes)),
            ("export", str(cls.episodes), "--to", "lerobot", "--out", str(cls.rows)),
        ):
            rapid(*words, cwd=cls.folder)

    def test_both_are_the_same(self):
        wanted = sources(self.spec)
        names = episode_files(self.rows)
        self.assertEqual(len(names), 2)
        for file, name in zip(episode_files(self.episodes), names, strict=True):
            recorded, exported = read_episode(file, wanted), read_episode(name, wanted)
            self.assertEqual(len(recorded), len(exported))
            self.assertEqual(exported.facts.observation_hz, 10)
            for modality in ("cam_wrist", "tactile_tip", "arm"):
                np.testing.assert_array_equal(recorded.present(modality), exported.present(modality), modality)
                np.testing.assert_allclose(recorded.value(modality), exported.value(modality), rtol=1e-6, atol=1e-7)
            acted = np.asarray(recorded.acted)
            np.testing.assert_allclose(recorded.actions[acted], exported.actions[acted], rtol=1e-6, atol=1e-7)

    def test_a_training_takes_them(self):
        cache = self.folder / "cache"
        with self.assertRaisesRegex(EpisodeError, "0 left out, 2 not asked for: check the filters in .data.$"):
            load(experiment(), [self.rows], cache)
        found = load(self.spec, [self.rows], cache)
        self.assertEqual((len(found.training), found.left_out), (2, []))
        self.assertNotEqual(found.training[0].sha256, found.training[1].sha256)
        self.assertGreater(len(Dataset(self.spec, found.training).windows), 100)
        # Beside the files that they were made of.
        self.assertEqual(len(load(self.spec, [self.rows, self.episodes], cache).training), 4)

    def test_what_it_lacks_is_named(self):
        head = self.spec.to_text().replace('"modality":"arm"', '"modality":"leg"')
        with self.assertRaisesRegex(EpisodeError, "no columns 'leg.0' ... of observation.state"):
            read_episode(episode_files(self.rows)[0], sources(type(self.spec).from_text(head)))

    def test_a_video_and_an_old_version_are_refused_with_the_fix(self):
        path = self.rows / "meta" / "info.json"
        before = path.read_text()
        self.addCleanup(path.write_text, before)
        described = json.loads(before)
        described["features"]["observation.images.cam_wrist"]["dtype"] = "video"
        path.write_text(json.dumps(described))
        with self.assertRaisesRegex(
            EpisodeError, "cam_wrist is a video, which is not read: export with --pictures jpeg"
        ):
            read_episode(episode_files(self.rows)[0], sources(self.spec))
        path.write_text(json.dumps({**described, "codebase_version": "v2.1"}))
        with self.assertRaisesRegex(EpisodeError, "version 'v2.1': convert it to v3.0"):
            episode_files(self.rows)


if __name__ == "__main__":
    unittest.main()
