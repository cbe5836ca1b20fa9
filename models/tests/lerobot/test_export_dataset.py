"""`rapid export --to lerobot`, loaded by LeRobot itself (`make lerobot-test`); the episodes are recorded here.

The episodes are read once more by `recorded`, which shares nothing with the program.
"""

import json
import shutil
import sys
import tempfile
import unittest
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import torch
from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.compute_stats import get_feature_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.video_utils import get_video_duration_in_s, get_video_info
from mcap.reader import make_reader

sys.path.insert(0, str(Path(__file__).parents[1]))
from recorded import PROGRAM, Folder, decoder, rapid, read_episode

FPS = 30
CAMERAS = {"cam_wrist": (480, 640), "tactile_tip": (240, 320)}
MODALITIES = ["cam_wrist", "tactile_tip", "motor_state"]


class ExportedDataSet(Folder):
    """A dataset of two episodes, the tactile camera unplugged in the first; the second is appended."""

    @classmethod
    def setUpClass(cls) -> None:
        super().setUpClass()
        folder = cls.folder
        record = ("--sim", "--headless", "--record", "--out", "episodes")
        export = ("export", "episodes", "--to", "lerobot", "--out", "set", "--include-bad", "--json")
        # The demonstration unplugs the tactile camera after 4 s.
        rapid(*record, "--duration", "6s", "--task", "a place block", cwd=folder)
        rapid(*export, cwd=folder)
        rapid(*record, "--duration", "2s", "--task", "b push", cwd=folder)
        lines = [json.loads(line) for line in rapid(*export, "--verify", cwd=folder).splitlines()]
        cls.summary = lines[-1]
        exported = {line["episode"]: line["file"] for line in lines if line["event"] == "exported"}
        cls.episodes = [read_episode(folder / exported[number]) for number in sorted(exported)]
        cls.rows = [row for episode in cls.episodes for row in episode]
        cls.data = LeRobotDataset("rapid/set", root=folder / "set")

    def test_lerobot_loads_all_rows_and_features(self) -> None:
        data = self.data
        self.assertEqual((data.num_episodes, len(data), data.fps), (2, len(self.rows), FPS))
        self.assertEqual(sorted(data.meta.camera_keys), [f"observation.images.{name}" for name in sorted(CAMERAS)])
        self.assertEqual(data.features["rapid.mask"]["names"], MODALITIES)
        self.assertEqual((self.summary["verified"], self.summary["differences"]), (len(self.rows), 0))
        begins = [int(value) for value in data.meta.episodes["dataset_from_index"]]
        self.assertEqual(begins, [0, len(self.episodes[0])])

    def test_every_picture_is_the_cameras_own_and_every_number_its_f32(self) -> None:
        files = sorted((self.folder / "set/data").glob("*/*.parquet"))
        columns = [pq.read_table(file).to_pylist() for file in files]
        table = [row for rows in columns for row in rows]
        self.assertEqual(len(table), len(self.rows))
        absent = 0
        for found, expected in zip(table, self.rows, strict=True):
            self.assertEqual(found["rapid.mask"], expected["mask"])
            self.assertEqual(found["rapid.plugged"], expected["plugged"])
            self.assertEqual(found["rapid.valid"], expected["valid"])
            self.assertEqual(found["rapid.age"], expected["age"])
            self.assertEqual(found["rapid.time_ns"], expected["time_ns"])
            for place, name in enumerate(MODALITIES[:2]):
                picture, sample = found[f"observation.images.{name}"]["bytes"], expected["samples"][place]
                if sample is None:
                    absent += 1
                    self.assertEqual(picture[:4], b"\x89PNG")
                else:
                    self.assertEqual(picture, sample.data)
            sample = expected["samples"][2]
            values = [0.0] * 3 if sample is None else np.array(sample.values, np.float32).tolist()
            self.assertEqual(found["observation.state"], values)
        self.assertGreater(absent, 10)

    def test_random_access_and_deltas(self) -> None:
        data, generator = self.data, np.random.default_rng(0)
        for at in generator.integers(0, len(data), 40):
            item, row = data[int(at)], self.rows[at]
            self.assertEqual(item["rapid.mask"].tolist(), row["mask"])
            self.assertEqual(item["task"], "a place block" if at < len(self.episodes[0]) else "b push")
            for place, (name, (height, width)) in enumerate(CAMERAS.items()):
                picture = item[f"observation.images.{name}"]
                self.assertEqual(tuple(picture.shape), (3, height, width))
                self.assertEqual(bool(picture.any()), row["samples"][place] is not None)
        deltas = {"observation.state": [-1 / FPS, 0.0], "observation.images.cam_wrist": [-1 / FPS, 0.0]}
        paired = LeRobotDataset("rapid/set", root=self.folder / "set", delta_timestamps=deltas)
        item = paired[50]
        self.assertEqual(item["observation.state"].shape, (2, 3))
        torch.testing.assert_close(item["observation.state"][1], data[50]["observation.state"])
        torch.testing.assert_close(item["observation.images.cam_wrist"][0], data[49]["observation.images.cam_wrist"])
        # The first row of the second episode has nothing before it.
        begin = len(self.episodes[0])
        self.assertTrue(paired[begin]["observation.state_is_pad"][0])
        batch = next(iter(torch.utils.data.DataLoader(data, batch_size=8, shuffle=True)))
        self.assertEqual(batch["observation.images.cam_wrist"].shape, (8, 3, 480, 640))

    def test_statistics_are_those_of_the_valid_rows(self) -> None:
        stats = self.data.meta.stats
        rows = [row for row in self.rows if row["valid"][2]]
        values = np.array([row["samples"][2].values for row in rows], np.float32).astype(float)
        found = stats["observation.state"]
        for name in ("min", "max", "mean", "std"):
            expected = getattr(values, name)(0)
            np.testing.assert_allclose(found[name], expected, rtol=1e-9, atol=1e-12, err_msg=name)
        self.assertEqual(int(found["count"][0]), len(rows))
        # LeRobot's own of every valid picture; ours are of a part of their pixels.
        pictures = [
            self.data[at]["observation.images.tactile_tip"].numpy()
            for at, row in enumerate(self.rows)
            if row["valid"][1]
        ]
        own = get_feature_stats(np.stack(pictures), axis=(0, 2, 3), keepdims=True)
        found = stats["observation.images.tactile_tip"]
        self.assertEqual((found["mean"].shape, int(found["count"][0])), ((3, 1, 1), len(pictures)))
        for name in ("mean", "std", "q50"):
            np.testing.assert_allclose(found[name], own[name][0], atol=0.03, err_msg=name)
        self.assertEqual(sorted(set(own) - set(found)), [])

    def test_lerobot_merges_two_of_them(self) -> None:
        folder = self.folder
        names = sorted(path.name for path in (folder / "episodes").glob("*.mcap"))
        for out, name in zip(("one", "two"), names, strict=True):
            words = ("--to", "lerobot", "--out", out, "--include-bad")
            rapid("export", f"episodes/{name}", *words, cwd=folder)
        roots = [folder / "one", folder / "two"]
        aggregate_datasets(["rapid/one", "rapid/two"], "rapid/both", roots=roots, aggr_root=folder / "both")
        both = LeRobotDataset("rapid/both", root=folder / "both")
        self.assertEqual((both.num_episodes, len(both)), (2, len(self.rows)))
        self.assertEqual(both.features, self.data.features)
        for at in range(len(both)):
            merged, ours = both[at], self.data[at]
            self.assertEqual(merged.keys(), ours.keys())
            for key in ours:
                if isinstance(ours[key], torch.Tensor):
                    self.assertTrue(torch.equal(merged[key], ours[key]), f"frame {at}, {key}")
                else:
                    self.assertEqual(merged[key], ours[key], f"frame {at}, {key}")
        # LeRobot merges the statistics of the numbers that it gives anew as they were before.
        merged, ours = both.meta.stats, self.data.meta.stats
        anew = {"episode_index", "index", "task_index"}
        self.assertEqual(merged.keys(), ours.keys())
        for key in sorted(ours.keys() - anew):
            # Of ages, each sensor has its own count of rows, of which LeRobot knows the largest: it weighs by that.
            names = ("min", "max") if key == "rapid.age" else sorted(ours[key].keys() & merged[key].keys())
            self.assertLessEqual({"min", "max"}, set(names))
            for name in names:
                found, expected = merged[key][name], ours[key][name]
                np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9, err_msg=f"{key} {name}")


@unittest.skipUnless(shutil.which("ffmpeg"), "skipped: no ffmpeg, which encodes the videos")
class ExportedVideos(Folder):
    """The same episode with its pictures as files, in AV1 and in H.264."""

    FORMS = ("jpeg", "av1", "h264")

    @classmethod
    def setUpClass(cls) -> None:
        super().setUpClass()
        # The demonstration unplugs the tactile camera after 4 s.
        rapid("--sim", "--headless", "--record", "--out", "episodes", "--duration", "5s", cwd=cls.folder)
        for form in cls.FORMS:
            rapid("export", "episodes", "--to", "lerobot", "--out", form, "--include-bad", "--pictures", form, cwd=cls.folder)
        cls.sets = {form: LeRobotDataset(f"rapid/{form}", root=cls.folder / form) for form in cls.FORMS}

    def test_every_frame_is_near_its_picture_and_black_where_there_is_none(self) -> None:
        files = self.sets["jpeg"]
        for form in ("av1", "h264"):
            videos = self.sets[form]
            self.assertEqual((len(videos), sorted(videos.meta.video_keys)), (len(files), sorted(files.meta.camera_keys)))
            absent = 0
            # Backwards: each is sought on its own.
            for at in reversed(range(len(files))):
                found, expected = videos[at], files[at]
                for key in files.meta.camera_keys:
                    error = float(((found[key] - expected[key]) ** 2).mean())
                    self.assertLess(error, 1e-3, f"{form}, frame {at}, {key}")
                    absent += not expected[key].any()
                torch.testing.assert_close(found["observation.state"], expected["observation.state"])
            self.assertGreater(absent, 10)

    def test_what_lerobot_reads_of_the_file_is_what_the_facts_say(self) -> None:
        for form in ("av1", "h264"):
            meta = self.sets[form].meta
            for key in meta.video_keys:
                path = self.folder / form / meta.get_video_file_path(0, key)
                self.assertEqual(get_video_info(path), meta.info["features"][key]["info"])
                end = meta.episodes[0][f"videos/{key}/to_timestamp"]
                self.assertAlmostEqual(end, get_video_duration_in_s(path), places=3)

    def test_deltas_and_batches(self) -> None:
        deltas = {"observation.images.cam_wrist": [-1 / FPS, 0.0]}
        paired = LeRobotDataset("rapid/av1", root=self.folder / "av1", delta_timestamps=deltas)
        data = self.sets["av1"]
        torch.testing.assert_close(paired[50]["observation.images.cam_wrist"][0], data[49]["observation.images.cam_wrist"])
        batch = next(iter(torch.utils.data.DataLoader(data, batch_size=8, shuffle=True)))
        self.assertEqual(batch["observation.images.tactile_tip"].shape, (8, 3, 240, 320))

    def test_lerobot_merges_two_of_them(self) -> None:
        folder = self.folder
        rapid("export", "episodes", "--to", "lerobot", "--out", "again", "--include-bad", "--pictures", "av1", cwd=folder)
        aggregate_datasets(
            ["rapid/av1", "rapid/again"], "rapid/both", roots=[folder / "av1", folder / "again"], aggr_root=folder / "both"
        )
        both, one = LeRobotDataset("rapid/both", root=folder / "both"), self.sets["av1"]
        self.assertEqual(len(both), 2 * len(one))
        for at in range(0, len(one), 23):
            for key in one.meta.camera_keys:
                for merged in (both[at], both[len(one) + at]):
                    torch.testing.assert_close(merged[key], one[at][key], msg=f"frame {at}, {key}")


@unittest.skipUnless(PROGRAM, "skipped: no program in $RAPID_BIN")
class ExportedActions(unittest.TestCase):
    """Demonstrations of the simulated task, which have an action at each tick."""

    def test_a_row_has_the_action_of_its_tick(self) -> None:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            rapid("--sim", "task", "--headless", "--record", "--expert", "--episodes", "2", "--out", "out", cwd=folder)
            rapid("export", "out", "--to", "lerobot", "--out", "set", "--include-bad", cwd=folder)
            data = LeRobotDataset("rapid/set", root=folder / "set")
            expected = [action for path in sorted((folder / "out").glob("*.mcap")) for action in read_actions(path)]
            found = [data[at]["action"].tolist() for at in range(len(data))]
            self.assertEqual(found, np.array(expected, np.float32).tolist())
            self.assertEqual(data.features["action"]["names"], action_names(next((folder / "out").glob("*.mcap"))))
            np.testing.assert_allclose(data.meta.stats["action"]["mean"], np.mean(found, axis=0), atol=1e-6)


def action_names(path: Path) -> list[str]:
    """The axes of an action, as the channel lists them."""
    with path.open("rb") as file:
        channels = make_reader(file).get_summary().channels.values()
        return json.loads(next(channel.metadata["names"] for channel in channels if channel.topic == "/action"))


def read_actions(path: Path) -> list[list[float]]:
    """Of each tick the action nearest to it."""
    body, times, values, ticks = None, [], [], []
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            if channel.topic == "/rapid/frame":
                ticks.append(message.log_time)
            elif channel.topic == "/action":
                body = body or decoder(schema)
                times.append(message.log_time)
                values.append(list(body.FromString(message.data).values))
    return [values[int(np.abs(np.array(times) - tick).argmin())] for tick in ticks]


if __name__ == "__main__":
    unittest.main()
