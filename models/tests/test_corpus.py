"""The episodes of an experiment: what is left out and why, which are held out, and the cache of decoded ones."""

import functools
import os
import tempfile
import unittest
from pathlib import Path
from unittest import mock

import numpy as np
import written
from made_up import Experiment, experiment, path

from rapid_policy import cache as module
from rapid_policy import corpus
from rapid_policy.cache_commands import verify
from rapid_policy.corpus import Corpus, divide, load
from rapid_policy.episodes import ABSENCES, EpisodeError, read_episode, sources
from rapid_policy.judgement import Judgement

SPEC = experiment("tactile-id")


class Case(unittest.TestCase):
    """Files that a test wrote, with verdicts of the test."""

    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        # Maps of one folder are not those of another of the same name.
        self.addCleanup(module._mapped.cache_clear)
        self.folder = Path(folder.name)
        self.data, self.cache = self.folder / "data", self.folder / "cache"
        self.data.mkdir()
        self.verdicts: dict[str, tuple[str | None, str]] = {}
        self.asked: list[str] = []
        for name, stand_in in (("judge", self.judge), ("program", lambda: "/bin/true")):
            patch = mock.patch.object(corpus, name, stand_in)
            patch.start()
            self.addCleanup(patch.stop)

    def judge(self, files):
        self.asked += [file.name for file in files]
        given = {file: self.verdicts.get(file.name, ("GOOD", "")) for file in files}
        return {file: Judgement(verdict, (reason,)) for file, (verdict, reason) in given.items()}

    def write(self, name: str, length: int = 20, seed: int = 0, **about) -> Path:
        return written.by_hand(self.data / f"{name}.mcap", path(length, seed), np.linspace(0, 1, length), **about)

    def load(self, spec: Experiment = SPEC, workers: int = 1) -> Corpus:
        return load(spec, [self.data], self.cache, workers)


def names(episodes) -> list[str]:
    return [episode.path.stem for episode in episodes]


def with_data(**data) -> Experiment:
    return experiment("tactile-id", data=data)


class LeftOut(Case):
    def test_each_reason_is_listed_and_the_others_are_learned_from(self):
        self.write("good")
        self.write("suspect", seed=1)
        self.write("bad", seed=2)
        self.verdicts = {"suspect.mcap": ("SUSPECT", "late"), "bad.mcap": ("BAD", "too short")}
        self.verdicts["foreign.mcap"] = (None, "not an MCAP file")
        (self.data / "foreign.mcap").write_bytes(b"no episode")
        (self.data / "cut.mcap").write_bytes((self.data / "good.mcap").read_bytes()[:-400])
        self.write("fast", hz=30)
        self.write("matrix", poses={"phone": "quaternion"})
        small = {"foxglove.CompressedImage": [written.jpeg(np.zeros((48, 64, 3), np.uint8))] * 5}
        written.write(self.data / "size.mcap", {"cam_wrist": next(iter(small.items())), **self.rest(5)})
        grey = [{"width": 96, "height": 96, "encoding": "bayer", "step": 96, "data": b"\0" * 96 * 96}] * 5
        written.write(self.data / "format.mcap", {"cam_wrist": ("foxglove.RawImage", grey), **self.rest(5)})
        found = self.load()
        self.assertEqual(names(found.training), ["good", "suspect"])
        expected = {
            "bad": "BAD: too short",
            "foreign": "no verdict: not an MCAP file",
            "cut": "not a whole episode: ",
            "fast": "recorded at 30 Hz, the policy acts at 10: write control_hz = 30",
            "matrix": "phone: 16 numbers and layout 'quaternion': not a pose",
            "size": "cam_wrist: a picture of 64x48, the policy takes 96x96: add resize to the observation",
            "format": "cam_wrist: raw pictures of encoding 'bayer' are not read",
        }
        self.assertEqual(len(found.left_out), len(expected))
        for name, reason in expected.items():
            (line,) = [line for line in found.left_out if f"/{name}.mcap" in line]
            self.assertTrue(line.startswith(f"{self.data}/{name}.mcap: left out, {reason}"), line)
        # The same from the cache, without reading them again.
        with mock.patch.object(module, "read_episode", side_effect=AssertionError):
            self.assertEqual(self.load().left_out, found.left_out)

    def rest(self, length: int) -> dict:
        """The other modalities of a handheld demonstration."""
        return {
            "phone": ("rapid.Scalars", [{"values": np.eye(4).ravel()}] * length),
            "gripper": ("rapid.Scalars", [{"values": [0.5]}] * length),
        }

    def test_a_rig_without_a_modality_that_may_be_absent_is_learned_from(self):
        written.write(
            self.data / "blind.mcap",
            {
                "tactile_tip": ("foxglove.CompressedImage", [written.jpeg(np.zeros((96, 96, 3), np.uint8))] * 20),
                "phone": ("rapid.Scalars", [{"values": p.T.ravel()} for p in path(20)]),
                "gripper": ("rapid.Scalars", [{"values": [t / 20]} for t in range(20)]),
            },
        )
        (episode,) = self.load().training
        self.assertFalse(episode.present("cam_wrist").any())

    def test_damaged_samples_are_absent_and_noted(self):
        file = self.write("good")
        pictures = [written.jpeg(np.zeros((96, 96, 3), np.uint8))] * 20
        pictures[3] = {"data": pictures[0]["data"][:200], "format": "jpeg"}
        openings = [{"values": [t / 20]} for t in range(20)]
        openings[5] = {"values": [float("nan")]}
        samples = {"cam_wrist": ("foxglove.CompressedImage", pictures), **self.rest(20)}
        samples["gripper"] = ("rapid.Scalars", openings)
        samples["phone"] = ("rapid.Scalars", [{"values": p.T.ravel()} for p in path(20)])
        written.write(file, samples)
        found = self.load()
        (episode,) = found.training
        self.assertEqual(np.flatnonzero(~episode.present("cam_wrist")).tolist(), [3])
        self.assertEqual(np.flatnonzero(~episode.present("gripper")).tolist(), [5])
        self.assertIn("cam_wrist: 1 damaged pictures, taken as absent", found.report())
        self.assertIn("gripper: 1 samples with a number that is not finite", found.report())

    def test_a_crash_a_stall_and_an_unplug_are_three_things_also_after_the_cache(self):
        touches = [written.jpeg(np.zeros((96, 96, 3), np.uint8))] * 20
        touches[3:6], touches[8:10], touches[15] = [None] * 3, ["crash"] * 2, "stall"
        samples = {"tactile_tip": ("foxglove.CompressedImage", touches), **self.rest(20)}
        samples["cam_wrist"] = ("foxglove.CompressedImage", [written.jpeg(np.zeros((96, 96, 3), np.uint8))] * 20)
        samples["phone"] = ("rapid.Scalars", [{"values": p.T.ravel()} for p in path(20)])
        file = written.write(self.data / "faulty.mcap", samples)
        found = self.load()
        self.assertIn("rows without a picture: 3 by unplug, 2 by crash, 1 by stall", found.report())
        for episode in (found.training[0], read_episode(file, sources(SPEC))):
            rows = {reason: np.flatnonzero(episode.absent("tactile_tip", reason)).tolist() for reason in ABSENCES}
            self.assertEqual(rows, {"unplug": [3, 4, 5], "crash": [8, 9], "stall": [15]})
        # A file of a version that did not record what is plugged in.
        with mock.patch.dict(written.SLOT):
            del written.SLOT[7]
            touches[8:10] = [None] * 2
            touches[15] = None
            old = read_episode(written.write(self.folder / "old.mcap", samples), sources(SPEC))
        self.assertEqual(np.flatnonzero(old.absent("tactile_tip", "unplug")).tolist(), [3, 4, 5, 8, 9, 15])

    def test_if_none_remains_it_is_said(self):
        self.write("bad")
        self.verdicts = {"bad.mcap": ("BAD", "too short")}
        with self.assertRaisesRegex(EpisodeError, "1 left out, 0 not asked for; the first: .*bad.mcap: left out, BAD"):
            self.load()
        self.verdicts.clear()
        # Another content is judged again.
        self.write("bad", seed=5)
        with self.assertRaisesRegex(EpisodeError, "0 left out, 1 not asked for: check the filters"):
            self.load(with_data(tags={"finger": "hard"}))


class Filters(Case):
    def test_each_filter(self):
        self.write("a", tags={"finger": "soft", "seed": "10"}, modules=("handheld", "soft_tip"))
        self.write("b", seed=1, tags={"finger": "hard", "seed": "11"}, modules=("handheld",))
        self.write("c", seed=2, tags={"seed": "x"}, modules=())
        self.verdicts = {"b.mcap": ("SUSPECT", "late")}
        for data, expected in (
            ({}, "abc"),
            ({"tags": {"finger": "soft"}}, "a"),
            ({"tags": {"finger": ["soft", "hard"]}}, "ab"),
            ({"modules": ["handheld"]}, "ab"),
            ({"modules": ["handheld", "soft_tip"]}, "a"),
            ({"seeds": [11, 20]}, "b"),
            ({"seeds": [0, 20]}, "ab"),
            ({"tasks": [""]}, "abc"),
            ({"verdict": ["GOOD"]}, "ac"),
        ):
            with self.subTest(**data):
                self.assertEqual("".join(names(self.load(with_data(**data)).training)), expected)

    def test_held_out_episodes_stay_held_out(self):
        for i in range(30):
            self.write(f"{i:02}", length=4, seed=i, tags={"seed": str(i // 2)})
        divided = {by: self.load(with_data(validation=0.3, validation_by=by)) for by in ("file", "seed")}
        for by, found in divided.items():
            self.assertTrue(4 <= len(found.held_out) <= 15, (by, len(found.held_out)))
            self.assertEqual(len(found.training) + len(found.held_out), 30)
        # Both of a seed are on one side.
        pairs = {e.facts.tags["seed"] for e in divided["seed"].held_out}
        self.assertFalse(pairs & {e.facts.tags["seed"] for e in divided["seed"].training})
        # With fewer episodes the others are where they were.
        spec, every = with_data(validation=0.3), [*divided["file"].training, *divided["file"].held_out]
        some = sorted(every, key=lambda e: e.path)[:20]
        training, held_out = ([some[row] for row in rows] for rows in divide(spec.data, some))
        self.assertLessEqual(set(names(held_out)), set(names(divided["file"].held_out)))
        self.assertLessEqual(set(names(training)), set(names(divided["file"].training)))

    def test_one_is_held_out_if_any_is_asked_for(self):
        for i in range(3):
            self.write(str(i), length=4, seed=i)
        found = self.load(with_data(validation=1e-9))
        self.assertEqual((len(found.training), len(found.held_out)), (2, 1))


class Decoded(Case):
    def files(self) -> list[Path]:
        return sorted(self.cache.glob("*/*.episode"))

    def test_the_cache_is_what_the_files_are(self):
        for i in range(3):
            self.write(str(i), seed=i)
        wanted = sources(SPEC)
        for workers in (1, 2):
            found = load(SPEC, [self.data], self.folder / f"cache-{workers}", workers)
            for episode in found.training:
                direct = read_episode(episode.path, wanted)
                self.assertEqual(set(direct.arrays), set(episode.arrays))
                for name, array in direct.arrays.items():
                    np.testing.assert_array_equal(episode.arrays[name], array, name)
                self.assertEqual(episode.facts, direct.facts)

    def test_only_what_is_new_is_decoded_and_judged(self):
        self.write("a")
        self.load()
        self.write("b", seed=1)
        real, decoded = module.read_episode, []
        with mock.patch.object(module, "read_episode", lambda p, w: decoded.append(p.name) or real(p, w)):
            self.load()
            self.assertEqual((decoded, self.asked), (["b.mcap"], ["a.mcap", "b.mcap"]))
            # Another time of change and the same content: nothing to do. Another content: everything.
            os.utime(self.data / "a.mcap")
            self.load()
            self.assertEqual(decoded, ["b.mcap"])
            self.write("a", seed=9)
            self.load()
            self.assertEqual(decoded, ["b.mcap", "a.mcap"])
            self.assertEqual(self.asked[2:], ["a.mcap"])

    def test_what_is_cut_short_is_decoded_again(self):
        self.write("a")
        (episode,) = self.load().training
        expected = np.array(episode.value("cam_wrist"))
        (file,) = self.files()
        for damage in (lambda: file.unlink(), lambda: os.truncate(file, 1000), lambda: file.write_bytes(b"")):
            damage()
            module._mapped.cache_clear()
            (again,) = self.load().training
            np.testing.assert_array_equal(again.value("cam_wrist"), expected)

    def test_verify_finds_a_changed_byte(self):
        self.write("a")
        self.load()
        (file,) = self.files()
        self.assertEqual(self.verify(), 0)
        content = bytearray(file.read_bytes())
        content[-5000] ^= 1
        file.write_bytes(content)
        self.assertEqual(self.verify(), 1)
        self.assertEqual(self.files(), [])
        self.load()
        self.assertEqual(self.verify(), 0)
        # The source is changed and its time set back.
        source = self.data / "a.mcap"
        stat, content = source.stat(), bytearray(source.read_bytes())
        content[-300] ^= 1
        source.write_bytes(content)
        os.utime(source, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        self.assertEqual(self.verify(), 1)

    def verify(self) -> int:
        with mock.patch("builtins.print"):
            return verify(SPEC, [self.data], self.cache)

    def test_an_index_that_lost_its_end_is_read(self):
        self.write("a")
        self.write("b", seed=1)
        self.load()
        (index,) = self.cache.glob("*/index.jsonl")
        index.write_bytes(index.read_bytes()[:-30])
        self.assertEqual(names(self.load().training), ["a", "b"])

    def test_other_sizes_have_a_cache_of_their_own(self):
        self.write("a")
        self.load()
        described = SPEC.to_text().replace('"size":[96,96]', '"resize":[48,48]')
        (episode,) = self.load(Experiment.from_text(described)).training
        self.assertEqual(episode.value("cam_wrist resize 48x48").shape, (20, 48, 48, 3))
        self.assertEqual(len(self.files()), 2)


class Maps(Case):
    def test_few_maps_are_open(self):
        for i in range(6):
            self.write(str(i), length=4, seed=i)
        few = functools.lru_cache(maxsize=2)(module._mapped.__wrapped__)
        with mock.patch.object(module, "_mapped", few):
            for episode in self.load().training:
                self.assertEqual(len(episode), 4)
            self.assertEqual(few.cache_info().currsize, 2)


if __name__ == "__main__":
    unittest.main()
