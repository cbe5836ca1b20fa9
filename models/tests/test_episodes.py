"""The reader, on an episode that the program itself records: RAPID_BIN names it."""

import os
import shutil
import subprocess
import sys
import tempfile
import unittest
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from rapid_policy.episodes import EpisodeError, episode_files, read_episode, read_episodes
from rapid_policy.spec import tactile_id

RAPID = os.environ.get("RAPID_BIN", "")


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
                    read_episode(path, tactile_id().observations, 4)


@unittest.skipUnless(RAPID, "RAPID_BIN names no program: NOTHING OF THE READER IS TESTED ON A REAL EPISODE")
class Recorded(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = Path(tempfile.mkdtemp())
        cls.addClassCleanup(shutil.rmtree, cls.folder)
        task = [RAPID, "--sim", "task", "--expert", "--record", "--episodes", "1", "--seed", "1000"]
        subprocess.run([*task, "--out", str(cls.folder)], check=True, capture_output=True, timeout=120)
        cls.spec = tactile_id()
        (cls.path,) = episode_files(cls.folder)
        cls.episode = read_episode(cls.path, cls.spec.observations, 4)

    def test_every_tick_has_its_samples_and_action(self):
        episode = self.episode
        self.assertGreater(len(episode), 60)
        self.assertEqual(sorted(episode.present), ["arm", "cam_wrist", "tactile_tip"])
        self.assertEqual(len(set(np.diff(episode.ticks))), 1)
        for name, present in episode.present.items():
            self.assertGreater(present.mean(), 0.95, name)
        self.assertGreater(episode.acted.mean(), 0.95)

    def test_the_arm_follows_its_actions(self):
        episode = self.episode
        rows = np.flatnonzero(episode.acted[:-1] & episode.present["arm"][:-1] & episode.present["arm"][1:])
        ahead = episode.actions[rows, :2] - episode.values["arm"][rows, :2]
        moved = episode.values["arm"][rows + 1, :2] - episode.values["arm"][rows, :2]
        fast = np.linalg.norm(ahead, axis=1) > 0.02
        self.assertGreater(fast.sum(), 10)
        agreement = (ahead[fast] * moved[fast]).sum(1) / np.linalg.norm(ahead[fast], axis=1) ** 2
        self.assertGreater(np.median(agreement), 0.5)

    def test_the_gel_is_pressed_in_the_middle_of_the_episode(self):
        tactile, reference = self.episode.values["tactile_tip"], self.episode.references["tactile_tip"]
        change = np.abs(tactile.astype(int) - reference).mean((1, 2, 3))
        self.assertGreater(change.max(), 2 * change[:5].max())

    def test_a_file_cut_short_and_a_wrong_description_are_named(self):
        cut = self.folder / "cut.mcap"
        cut.write_bytes(self.path.read_bytes()[:-1000])
        self.addCleanup(cut.unlink)
        with self.assertRaisesRegex(EpisodeError, "cut.mcap"):
            read_episodes([cut], self.spec.observations, 4)
        # Its own record still states GOOD or SUSPECT; its content is BAD.
        content = bytearray(self.path.read_bytes())
        content[11] ^= 1
        changed = self.folder / "changed.mcap"
        changed.write_bytes(content)
        self.addCleanup(changed.unlink)
        foreign = self.folder / "foreign.mcap"
        foreign.write_bytes(b"no episode")
        self.addCleanup(foreign.unlink)
        episodes, left_out = read_episodes([self.path, changed, foreign], self.spec.observations, 4)
        self.assertEqual([e.path for e in episodes], [self.path])
        self.assertRegex(left_out[0], "changed.mcap: left out, BAD: ")
        self.assertRegex(left_out[1], "foreign.mcap: left out, no verdict: not an MCAP file")
        wrist, tactile, arm = self.spec.observations
        for wrong, message in (
            (replace(wrist, modality="cam_head"), "cam_head"),
            (replace(wrist, shape=(3, 48, 48)), "cam_wrist: a picture of 96x96"),
            (replace(arm, shape=(7,)), "arm: 4 numbers, expected 7"),
            (replace(tactile, kind="vector", shape=(2,)), "tactile_tip: messages of foxglove.CompressedImage"),
        ):
            with self.assertRaisesRegex(EpisodeError, message):
                read_episode(self.path, (wrong,), 4)


if __name__ == "__main__":
    unittest.main()
