"""Datasets that LeRobot writes itself are learned from (`make lerobot-test`): what is read of them is what LeRobot's own
reader gives, a training runs to its end, and what is damaged is left out.
"""

import shutil
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
from lerobot.datasets.lerobot_dataset import LeRobotDataset

sys.path.insert(0, str(Path(__file__).parents[1]))
from made_up import MODELS

from rapid_policy.corpus import load
from rapid_policy.episodes import EpisodeError, episode_files, read_episode, sources
from rapid_policy.experiment_file import read_experiment

FPS, LENGTHS = 10, (21, 26)
NAMES = ["shoulder_pan.pos", "shoulder_lift.pos", "gripper.pos"]
FORMS = ("image", "libsvtav1", "h264", "hevc")
VIDEO = "videos/observation.images.top/chunk-000/file-000.mp4"
ROWS = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
EXPERIMENT = """
format = "rapid-experiment/1"
name = "theirs"

[policy]
horizon = 8
n_action_steps = 4
control_hz = 10

[[observation]]
key = "top"
kind = "image"
modality = "top"
size = [64, 96]

[[observation]]
key = "pan"
kind = "vector"
modality = "shoulder_pan"
columns = [0]

[[observation]]
key = "all"
kind = "vector"
modality = "state"
columns = [0, 1, 2]

[action]
from = "action"
actuator = "arm"
names = ["pan", "lift", "grip"]
units = ["deg", "deg", "1"]

[encoder]
width = 8
features = 8
keypoints = 4

[denoiser]
widths = [8, 16]

[training]
iterations = 4
windows = 4
warmup = 1
"""


def write_set(folder: Path, form: str, names: list | dict | None) -> None:
    """Episodes whose pictures each show where they belong, by LeRobot's writer."""
    numbers = {"dtype": "float32", "shape": (len(NAMES),), "names": names}
    pictures = {"dtype": "image" if form == "image" else "video", "shape": (64, 96, 3)}
    features = {"observation.state": numbers, "action": numbers}
    features["observation.images.top"] = {**pictures, "names": ["height", "width", "channels"]}
    codec = {} if form == "image" else {"vcodec": form}
    data = LeRobotDataset.create("test/set", FPS, features, root=folder, use_videos=form != "image", **codec)
    random = np.random.default_rng(0)
    for episode, length in enumerate(LENGTHS):
        for at in range(length):
            picture = np.repeat(random.integers(0, 40, (64, 96, 1), np.uint8), 3, 2)
            picture[:, 3 * at : 3 * at + 12] = 220 - 60 * episode
            values = [random.normal(size=len(NAMES)).astype(np.float32) for _ in range(2)]
            frame = {"observation.state": values[0], "action": values[1], "observation.images.top": picture}
            data.add_frame({**frame, "task": "push"})
        data.save_episode()
    data.finalize()


class Written(unittest.TestCase):
    @classmethod
    def setUpClass(cls) -> None:
        temporary = tempfile.TemporaryDirectory()
        cls.addClassCleanup(temporary.cleanup)
        cls.folder = Path(temporary.name)
        for form, names in zip(FORMS, (NAMES, {"motors": NAMES}, NAMES, NAMES), strict=True):
            write_set(cls.folder / form, form, names)
        cls.experiment = cls.folder / "theirs.toml"
        cls.experiment.write_text(EXPERIMENT)
        cls.spec = read_experiment(cls.experiment)

    def test_what_is_read_is_what_lerobots_reader_gives(self) -> None:
        # Not HEVC, which it does not read whole.
        for form in FORMS[:3]:
            data = LeRobotDataset("test/set", root=self.folder / form)
            names, begin = episode_files(self.folder / form), 0
            for name, length in zip(names, LENGTHS, strict=True):
                found = read_episode(name, sources(self.spec))
                self.assertEqual((len(found), found.acted.all()), (length, True))
                for at in range(length):
                    item = data[begin + at]
                    picture = (item["observation.images.top"].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
                    np.testing.assert_array_equal(found.value("top")[at], picture, f"{form}, frame {begin + at}")
                    np.testing.assert_array_equal(found.value("state")[at], item["observation.state"])
                    np.testing.assert_array_equal(found.value("shoulder_pan")[at], item["observation.state"][:1])
                    np.testing.assert_array_equal(found.actions[at], item["action"])
                begin += length

    def test_a_frame_of_a_video_is_that_of_its_row(self) -> None:
        for form in FORMS[1:]:
            names = (episode_files(self.folder / which) for which in (form, "image"))
            for video, files in zip(*names, strict=True):
                found, expected = (read_episode(n, sources(self.spec)).value("top").astype(float) for n in (video, files))
                # Of noise a codec keeps little.
                self.assertLess(((found - expected) ** 2).mean((1, 2, 3)).max(), 400, form)
                self.assertGreater(((found[1:] - expected[:-1]) ** 2).mean((1, 2, 3)).min(), 800, form)

    def train(self, form: str, *words: str) -> subprocess.CompletedProcess:
        """A training by the command line."""
        out = self.folder / "runs" / form
        command = [sys.executable, "-m", "rapid_policy.train", self.experiment, "--out", out, "--device", "cpu"]
        command += ["--data", self.folder / form, *words]
        return subprocess.run(command, cwd=MODELS, capture_output=True, text=True, check=False)

    def test_a_training_runs_to_its_end(self) -> None:
        for form in FORMS:
            done = self.train(form, "--workers", "2")
            self.assertEqual(done.returncode, 0, done.stderr)
            self.assertIn("2 episodes to learn from, 0 held out, 0 left out", done.stderr)
            self.assertRegex(done.stdout, r"theirs: 2 episodes, 47 windows, [^\n]+\nfinal loss \d")
            self.assertTrue((self.folder / "runs" / form / "checkpoint.pt").is_file(), form)

    def copy(self, form: str) -> Path:
        """A dataset to damage."""
        return Path(shutil.copytree(self.folder / form, self.folder / f"{self.id()}-{len(list(self.folder.iterdir()))}"))

    def left_out(self, folder: Path, episodes: int = 1) -> list[str]:
        """The reasons; so many episodes remain."""
        found = load(self.spec, [folder], self.folder / "cache")
        self.assertEqual(len(found.training), episodes, found.report())
        return found.left_out

    def change(self, file: Path, column: str, index: int, value: float) -> None:
        """Changes the description of an episode."""
        table = pq.read_table(file)
        values = table.column(column).to_pylist()
        values[index] = value
        at = table.column_names.index(column)
        pq.write_table(table.set_column(at, column, [values]), file)

    def test_a_video_that_has_not_all_of_an_episode(self) -> None:
        for form in FORMS[1:]:
            folder = self.copy(form)
            data = (folder / VIDEO).read_bytes()
            # The description of its frames is at the beginning: the first episode is whole.
            (folder / VIDEO).write_bytes(data[: len(data) * 7 // 10])
            (reason,) = self.left_out(folder)
            self.assertRegex(reason, rf"file-000.parquet#1: left out, [^\n]+ {folder / VIDEO}: [^\n]+$")

    def test_no_video_leaves_no_episode(self) -> None:
        folder = self.copy("h264")
        (folder / VIDEO).unlink()
        reason = rf"2 left out, 0 not asked for; the first: [^\n]+ {folder / VIDEO}: No such file or directory$"
        with self.assertRaisesRegex(EpisodeError, rf"no episode that is fit to learn from: {reason}"):
            load(self.spec, [folder], self.folder / "cache")

    def test_times_beyond_the_video(self) -> None:
        folder = self.copy("libsvtav1")
        columns = [f"videos/observation.images.top/{end}_timestamp" for end in ("from", "to")]
        for column, seconds in zip(columns, (50.0, 52.6), strict=True):
            self.change(folder / EPISODES, column, 1, seconds)
        (reason,) = self.left_out(folder)
        self.assertIn(f"{folder / VIDEO}: no frame at 50.0000 s, the nearest is at 4.6000 s", reason)
        self.change(folder / EPISODES, columns[0], 1, 2.1)
        (reason,) = self.left_out(folder)
        part = "505 frames from 2.1000 to 52.6000 s by meta/episodes, where the episode has 26 rows"
        self.assertIn(f"{folder / VIDEO}: {part}", reason)
        # Put right, it serves again.
        self.change(folder / EPISODES, columns[1], 1, 4.7)
        self.assertEqual(self.left_out(folder, 2), [])

    def test_other_rows_than_the_data_set_describes(self) -> None:
        folder = self.copy("h264")
        table = pq.read_table(folder / ROWS)
        is_last = pc.equal(table["index"], len(table) - 1)
        pq.write_table(table.filter(pc.invert(is_last)), folder / ROWS)
        (reason,) = self.left_out(folder)
        self.assertIn(f"{folder / ROWS}: 25 rows, where meta/episodes has 26", reason)
        self.change(folder / EPISODES, "length", 1, 25)
        (reason,) = self.left_out(folder)
        self.assertIn(f"{folder / VIDEO}: 26 frames from 2.1000 to 4.7000 s", reason)

    def test_a_training_continues_without_what_is_damaged(self) -> None:
        folder = self.copy("libsvtav1")
        self.change(folder / EPISODES, "length", 0, 20)
        done = self.train(folder.name)
        self.assertEqual(done.returncode, 0, done.stderr)
        self.assertRegex(done.stderr, r"#0: left out, [^\n]+\n1 episodes to learn from, 0 held out, 1 left out")


if __name__ == "__main__":
    unittest.main()
