"""LeRobot datasets as a source: what `rapid export` made of episodes is learned from as the episodes are."""

import io
import json
import shutil
import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

import numpy as np
import pyarrow as pa
from made_up import experiment
from PIL import Image
from recorded import Folder, rapid

import rapid_policy
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
        theirs["videos"] = {"observation.images.film": None}
        theirs["observation.images.cam"] = [b""] * 4
        for modality, there in (("arm", True), ("cam", True), ("film", True), ("tactile", False)):
            found = lerobot_source.presence(theirs, modality, 4)
            # What is not in the dataset is unplugged, which is not a stall.
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

    def test_names_as_lerobot_writes_them(self):
        pan, grip = "shoulder_pan.pos", "gripper"
        for names in ([pan, grip], {"motors": [pan, grip]}, {grip: 1, pan: 0}, {"arm": [pan], "hand": [grip]}):
            found = lerobot_source._names({"shape": [2]}, names)
            self.assertEqual(found, [pan, grip], names)
            self.assertEqual(self.numbers(found, "shoulder_pan"), [0])
            self.assertEqual(self.numbers(found, "gripper"), [1])
        # None, and those of something else than each number.
        for names in (None, [], ["pose"], {"axes": None}):
            self.assertEqual(lerobot_source._names({"shape": [2]}, names), [], names)

    def test_a_number_that_was_left_out_is_named(self):
        with self.assertRaisesRegex(lerobot_source.DatasetError, "arm.2 without arm.1: export with --state arm"):
            self.numbers(["arm.0", "arm.2"], "arm")


class Pictures(unittest.TestCase):
    def test_a_camera_is_found_by_either_name_as_bytes_or_as_a_file(self):
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            buffer = io.BytesIO()
            Image.new("RGB", (8, 8), (9, 0, 0)).save(buffer, "PNG")
            (folder / "frame.png").write_bytes(buffer.getvalue())
            kept = [{"bytes": buffer.getvalue(), "path": "frame.png"}, {"bytes": None, "path": "frame.png"}]
            kept += [{"bytes": b"damaged", "path": None}, {"bytes": None, "path": "missing.png"}]
            column = lerobot_source._column(folder, pa.table({"top": kept}), "top", {"dtype": "image"})
            for feature in ("observation.images.top", "observation.top"):
                rows = {feature: column, "videos": {}, "names": {}, "frame_index": np.arange(4)}
                found = list(lerobot_source.pictures(rows, "top"))
                self.assertEqual([None if p is None else int(p[0, 0, 0]) for p in found], [9, 9, None, None])


class Exported(Folder):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        # A dataset has no tags: the experiment's seeds would choose none of its episodes.
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

    def test_an_action_that_is_not_finite_is_none(self):
        name = episode_files(self.rows)[0]
        rows = lerobot_source.tables(name)
        rows["action"][3, 0] = np.nan
        with mock.patch.object(lerobot_source, "tables", return_value=rows):
            found = read_episode(name, sources(self.spec))
        self.assertEqual(np.flatnonzero(~found.acted).tolist(), [3])
        self.assertTrue(np.isfinite(found.actions).all())

    def test_what_it_lacks_is_named(self):
        head = self.spec.to_text().replace('"modality":"arm"', '"modality":"leg"')
        with self.assertRaisesRegex(EpisodeError, "no columns 'leg.0' ... of observation.state"):
            read_episode(episode_files(self.rows)[0], sources(type(self.spec).from_text(head)))

    def test_an_old_version_is_refused_with_the_fix(self):
        path = self.rows / "meta" / "info.json"
        before = path.read_text()
        self.addCleanup(path.write_text, before)
        path.write_text(json.dumps({**json.loads(before), "codebase_version": "v2.1"}))
        with self.assertRaisesRegex(EpisodeError, "version 'v2.1': convert it to v3.0"):
            episode_files(self.rows)

    def test_other_words_about_an_episode_are_read_anew(self):
        path, cache = self.rows / "meta" / "info.json", self.folder / "anew"
        before = path.read_text()
        self.addCleanup(path.write_text, before)
        described = json.loads(before)
        described["features"]["observation.state"] |= {"names": None, "columns": None}
        path.write_text(json.dumps(described))
        with self.assertRaisesRegex(EpisodeError, "no columns 'arm.0' ... of observation.state"):
            load(self.spec, [self.rows], cache)
        path.write_text(before)
        self.assertEqual(len(load(self.spec, [self.rows], cache).training), 2)


@unittest.skipUnless(shutil.which("ffmpeg"), "skipped: no ffmpeg, which encodes the videos")
class ExportedVideos(Folder):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.spec = experiment(data={"seeds": None})
        record = ("--sim", "task", "--expert", "--record", "--episodes", "2", "--seed", "1000", "--out", "episodes")
        rapid(*record, cwd=cls.folder)
        for form in ("jpeg", "av1", "h264"):
            rapid("export", "episodes", "--to", "lerobot", "--out", form, "--pictures", form, cwd=cls.folder)

    def test_a_video_is_near_the_pictures(self):
        wanted = sources(self.spec)
        for form in ("av1", "h264"):
            names = (episode_files(self.folder / which) for which in (form, "jpeg"))
            for video, files in zip(*names, strict=True):
                found, expected = read_episode(video, wanted), read_episode(files, wanted)
                for camera in ("cam_wrist", "tactile_tip"):
                    np.testing.assert_array_equal(found.present(camera), expected.present(camera), camera)
                    off = self.off(found.value(camera), expected.value(camera))
                    self.assertLess(off.max(), 3e-3, f"{form} {camera}")
                # Of its own row: what the arm sees changes.
                frames, pictures = found.value("cam_wrist"), expected.value("cam_wrist")
                for before, after in ((frames[1:], pictures[:-1]), (frames[:-1], pictures[1:])):
                    self.assertLess(self.off(frames, pictures).mean(), self.off(before, after).mean(), form)

    def off(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """The mean squared difference of each pair, of pixels from 0 to 1."""
        return ((one / 255 - other / 255) ** 2).mean((1, 2, 3))

    def test_a_video_that_changes_is_read_anew(self):
        cache, folder = self.folder / "cache", self.folder / "h264"
        before = load(self.spec, [folder], cache)
        self.assertEqual((len(before.training), before.left_out), (2, []))
        video = min(folder.rglob("*.mp4"))
        whole = video.read_bytes()
        self.addCleanup(video.write_bytes, whole)
        video.write_bytes(whole[: len(whole) // 2])
        found = load(self.spec, [folder], cache)
        self.assertEqual(len(found.training), 1)
        self.assertRegex(found.left_out[0], rf"left out, not an episode that is read: {video}: [^\n]+$")
        video.write_bytes(whole)
        found = load(self.spec, [folder], cache)
        self.assertEqual([e.sha256 for e in found.training], [e.sha256 for e in before.training])

    def test_without_pyav_the_fix_is_named_and_no_episode_is_left_out(self):
        cache, folder = self.folder / "without", self.folder / "h264"
        with mock.patch.dict(sys.modules, {"av": None}):
            sys.modules.pop("rapid_policy.video", None)
            vars(rapid_policy).pop("video", None)
            with self.assertRaisesRegex(EpisodeError, "with videos need PyAV .*: pip install av$"):
                load(self.spec, [folder], cache)
        self.assertEqual(len(load(self.spec, [folder], cache).training), 2)


if __name__ == "__main__":
    unittest.main()
