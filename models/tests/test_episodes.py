"""The reader, on an episode that the program itself records: RAPID_BIN names it."""

import tempfile
import unittest
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from made_up import experiment
from recorded import Folder, rapid

from rapid_policy import episodes
from rapid_policy.corpus import load
from rapid_policy.episodes import EpisodeError, Source, episode_files, read_episode, sources
from rapid_policy.judgement import judge


class Broken(unittest.TestCase):
    def test_a_folder_without_episodes_is_named(self):
        with tempfile.TemporaryDirectory() as folder, self.assertRaisesRegex(EpisodeError, folder):
            episode_files(Path(folder))

    def test_what_is_no_episode_is_named(self):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "x.mcap"
            for content in (b"", b"no episode", b"\x89MCAP0\r\n" + bytes(100)):
                path.write_bytes(content)
                with self.assertRaisesRegex(EpisodeError, "x.mcap: not a whole episode"):
                    read_episode(path, sources(experiment()))


class Chosen(unittest.TestCase):
    """The sample of a tick is the one that the frame index names."""

    def chosen(self, samples: list[tuple[int, int]], latency: int = 0, stale: bool = False, hold: bool = False, **slot):
        """Of samples, each its time and number, that of a tick at 1000 whose slot names number 7 of age 10."""
        slot = {"bit": 3, "present": True, "valid": not stale, "stale": stale, "age_ns": 10, "seq": 7, **slot}
        named = SimpleNamespace(**slot, HasField=lambda name: slot[name] is not None)
        frame = episodes._Message(1000, 0, "", SimpleNamespace(modalities=[named]))
        messages = [episodes._Message(time, number, "", None) for time, number in samples]
        stream = {"bit": 3, "latency_ns": latency, "when_stale": "hold" if hold else "zero"}
        (found,) = episodes._chosen(stream, [frame], messages)
        return found and found.time

    def test_by_its_number(self):
        samples = [(980, 6), (400, 7), (1000, 8)]
        self.assertEqual(self.chosen(samples), 400)
        self.assertIsNone(self.chosen([(990, 6)]))
        # The number in a message is the lower half.
        self.assertEqual(self.chosen(samples, seq=7 + 2**32), 400)

    def test_of_several_with_that_number_the_one_of_the_moment(self):
        # After a replug the device counts from the beginning again. What shows 990 was captured at 990 and its latency.
        samples = [(980, 7), (1200, 7)]
        self.assertEqual(self.chosen(samples), 980)
        self.assertEqual(self.chosen(samples, latency=200), 1200)

    def test_absent_and_stale(self):
        samples = [(990, 7)]
        self.assertIsNone(self.chosen(samples, present=False))
        self.assertIsNone(self.chosen(samples, seq=None))
        self.assertIsNone(self.chosen(samples, bit=2))
        self.assertIsNone(self.chosen(samples, stale=True))
        self.assertEqual(self.chosen(samples, stale=True, hold=True), 990)


class Recorded(Folder):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        rapid("--sim", "task", "--expert", "--record", "--episodes", "1", "--seed", "1000", "--out", ".", cwd=cls.folder)
        cls.spec = experiment()
        (cls.path,) = episode_files(cls.folder)
        cls.episode = read_episode(cls.path, sources(cls.spec))

    def test_every_tick_has_its_samples_and_action(self):
        episode = self.episode
        self.assertGreater(len(episode), 60)
        self.assertEqual(len(set(np.diff(episode.ticks))), 1)
        for name in ("arm", "cam_wrist", "tactile_tip"):
            self.assertGreater(episode.present(name).mean(), 0.95, name)
        self.assertGreater(episode.acted.mean(), 0.95)

    def test_the_arm_follows_its_actions(self):
        episode = self.episode
        rows = np.flatnonzero(episode.acted[:-1] & episode.present("arm")[:-1] & episode.present("arm")[1:])
        ahead = episode.actions[rows, :2] - episode.value("arm")[rows, :2]
        moved = episode.value("arm")[rows + 1, :2] - episode.value("arm")[rows, :2]
        fast = np.linalg.norm(ahead, axis=1) > 0.02
        self.assertGreater(fast.sum(), 10)
        agreement = (ahead[fast] * moved[fast]).sum(1) / np.linalg.norm(ahead[fast], axis=1) ** 2
        self.assertGreater(np.median(agreement), 0.5)

    def test_the_gel_is_pressed_in_the_middle_of_the_episode(self):
        tactile = self.episode.value("tactile_tip")
        reference = tactile[self.episode.first("tactile_tip")]
        # Averaged over squares of 8 pixels, which leaves little of the noise of single ones.
        change = (tactile.astype(float) - reference).reshape(-1, 12, 8, 12, 8, 3).mean((2, 4))
        change = np.abs(change).mean((1, 2, 3))
        self.assertGreater(change.max(), 3 * change[:5].max())

    def test_a_file_cut_short_and_a_wrong_description_are_named(self):
        content = bytearray(self.path.read_bytes())
        content[len(content) // 2] ^= 1
        for name, data in (("changed", content), ("cut", content[:-1000]), ("foreign", b"no episode")):
            file = self.folder / f"{name}.mcap"
            file.write_bytes(data)
            self.addCleanup(file.unlink)
        with tempfile.TemporaryDirectory() as cache:
            found = load(self.spec, [self.folder], Path(cache))
            self.assertEqual([e.path for e in found.training], [self.path])
        reasons = "\n".join(found.left_out)
        self.assertRegex(reasons, "changed.mcap: left out, ")
        self.assertRegex(reasons, "cut.mcap: left out, ")
        self.assertRegex(reasons, "foreign.mcap: left out, no verdict: not an MCAP file")
        self.assertEqual(
            str(judge([self.folder / "foreign.mcap"])[self.folder / "foreign.mcap"]), "no verdict: not an MCAP file"
        )
        for wrong, message in (
            (Source("cam_head", "image", size=(96, 96)), "no modality 'cam_head'; it has arm, "),
            (Source("cam_wrist", "image", size=(48, 48)), "cam_wrist: a picture of 96x96, the policy takes 48x48"),
            (Source("tactile_tip", "vector"), "tactile_tip: messages of foxglove.CompressedImage"),
            (Source("arm", "image", size=(96, 96)), "arm: messages of rapid.Scalars are not pictures"),
        ):
            with self.assertRaisesRegex(EpisodeError, message):
                read_episode(self.path, (wrong,))

    def test_a_file_with_two_names_is_judged_under_both(self):
        link = self.folder / "link"
        link.symlink_to(self.path)
        self.addCleanup(link.unlink)
        for files in ([link, self.path], [self.path], [link]):
            judged = judge(files)
            self.assertEqual(list(judged), files)
            self.assertLessEqual({judgement.verdict for judgement in judged.values()}, {"GOOD", "SUSPECT"})

    def test_pictures_are_resized_as_they_are_read(self):
        resized = read_episode(self.path, (Source("cam_wrist", "image", resize=(60, 80), crop=(48, 48)),))
        pictures = resized.value("cam_wrist resize 60x80 crop 48x48")
        self.assertEqual(pictures.shape[1:], (48, 48, 3))
        self.assertGreater(pictures.std(), 5)


if __name__ == "__main__":
    unittest.main()
