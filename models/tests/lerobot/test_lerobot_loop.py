"""LeRobot's own loop with a camera that fails: what `lerobot_loop.py` reports of it (`make lerobot-test`)."""

import contextlib
import io
import json
import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from recorded import PROGRAM, Folder

import lerobot_loop
from lerobot_rig import ACTIONS, CAMERA, CONDITIONS, EVENT_AT, Event, Log, Source, observed


class Figures(unittest.TestCase):
    """The figures of a run, from what happened when."""

    def log(self, pictures: str, failed_at: float | None) -> Log:
        """A picture and an action each second; the camera fails at some time."""
        times = [float(second) for second in range(1, len(pictures) + 1)]
        return Log(actions=times, observations=list(zip(times, pictures, strict=True)), read=times[-1], failed_at=failed_at)

    def figures(self, line: dict) -> tuple:
        return line["status"], *(line[f"{what}_{when}"] for what in ("actions", "repeated") for when in ("before", "after"))

    def test_status_is_that_of_the_end(self) -> None:
        self.assertEqual(self.figures(observed(self.log("abcd", None), None)), ("normal", 4, 0, 0, 0))
        self.assertEqual(self.figures(observed(self.log("aabcc", 3.5), None)), ("stale", 3, 2, 1, 1))
        self.assertEqual(self.figures(observed(self.log("abbbc", 2.5), None)), ("normal", 2, 3, 0, 2))
        line = observed(self.log("abbb", 2.5), TimeoutError("too old"))
        self.assertEqual(self.figures(line), ("crash", 2, 2, 0, 2))
        self.assertEqual((line["raised"]["type"], line["raised_after_s"]), ("TimeoutError", 1.5))
        self.assertIsNone(observed(self.log("ab", None), TimeoutError())["raised_after_s"])

    def test_a_camera_is_back_once_it_has_sent_a_picture(self) -> None:
        log, found = Log(failed_at=1.0), []

        class Pipe:
            def write(self, _: bytes) -> None:
                found.append((log.back_at is not None, log.returned.is_set()))
                if len(found) == 2:
                    raise BrokenPipeError

        with tempfile.TemporaryDirectory() as folder:
            source = Source(Path(folder) / "x.mjpeg", [b"x"], Event(closes=True, away_s=0.0), log)
            source.wait()
            with self.assertRaises(BrokenPipeError):
                source.send(Pipe())
            self.assertEqual(found, [(False, False), (True, True)])
            # Nothing waits for a camera that is closed before that.
            log.back_at = None
            log.returned.clear()
            with mock.patch.object(source, "play", side_effect=BrokenPipeError):
                source.run()
            self.assertEqual((log.back_at, log.returned.is_set()), (None, True))

    def test_the_time_without_an_action_counts_from_the_failure(self) -> None:
        line = observed(self.log("abcd", 1.5), None)
        self.assertEqual((line["longest_interval_before_s"], line["longest_interval_after_s"]), (None, 1.0))


class Loop(Folder):
    @classmethod
    def setUpClass(cls) -> None:
        super().setUpClass()
        cls.printed = io.StringIO()
        with contextlib.redirect_stdout(cls.printed):
            cls.status = lerobot_loop.main(["--rapid", PROGRAM, "--out", str(cls.folder / "results")])
        text = (cls.folder / "results/lerobot-loop.jsonl").read_text()
        cls.lines = {line["condition"]: line for line in map(json.loads, text.splitlines())}

    def test_every_condition_has_a_line_and_acted_before_the_event(self) -> None:
        self.assertEqual((self.status, list(self.lines)), (0, list(CONDITIONS)))
        self.assertEqual(set(lerobot_loop.TITLES), set(CONDITIONS))
        for name, line in self.lines.items():
            self.assertEqual((line["event"], line["camera"], line["lerobot"]), ("condition", CAMERA, "0.4.4"))
            self.assertGreaterEqual(line["actions_before"], EVENT_AT, name)

    def test_with_every_camera_it_acts_to_the_end_and_keeps_the_episode(self) -> None:
        line = self.lines["full"]
        self.assertIsNone(line["raised"])
        self.assertEqual((line["status"], line["exit"]), ("normal", 0))
        self.assertEqual((line["actions_before"], line["actions_after"], line["frames_kept"]), (ACTIONS, 0, ACTIONS))

    def test_a_camera_whose_reads_fail_ends_it_whether_or_not_it_comes_back(self) -> None:
        for name in ("unplug", "replug"):
            line = self.lines[name]
            self.crashed(line, "RuntimeError", "read thread is not running")
            self.assertLess(line["actions_before"] + line["actions_after"], ACTIONS, name)
        self.assertGreaterEqual(self.lines["replug"]["away_s"], CONDITIONS["replug"].away_s)
        self.assertEqual(self.lines["replug"]["again"]["type"], "RuntimeError")

    def test_a_silent_camera_has_its_old_picture_until_that_is_too_old(self) -> None:
        line = self.lines["silent"]
        self.crashed(line, "TimeoutError", "latest frame is too old")
        self.assertGreater(line["repeated_after"], 0)
        self.assertGreater(line["actions_after"], 0)

    def test_a_short_silence_is_not_noticed(self) -> None:
        line = self.lines["short-silence"]
        self.assertGreater(line["repeated_after"], 0)
        # On a machine that is busy for long enough the picture gets too old here as well.
        if line["away_s"] is None or line["raised"]:
            self.crashed(line, "TimeoutError", "latest frame is too old")
            self.assertGreater(line["raised_after_s"], 0.4)
        else:
            self.assertEqual((line["status"], line["frames_kept"]), ("normal", ACTIONS))
            self.assertEqual(line["actions_before"] + line["actions_after"], ACTIONS)

    def test_the_page_and_the_table_have_every_condition(self) -> None:
        page = (self.folder / "results/lerobot-loop.md").read_text()
        for name, line in self.lines.items():
            self.assertIn(f"| {name} |", page)
            self.assertIn(f"| {name} |", self.printed.getvalue())
            if line["raised"]:
                self.assertIn(line["raised"]["message"], page)
        self.assertNotIn(str(self.folder), page)

    def crashed(self, line: dict, error: str, message: str) -> None:
        """The loop raised this, in LeRobot's camera, called by LeRobot's loop, and the episode is lost."""
        self.assertEqual((line["status"], line["raised"]["type"], line["frames_kept"]), ("crash", error, 0))
        self.assertIn(message, line["raised"]["message"])
        self.assertIn("record_loop", " ".join(line["raised"]["through"]))
        self.assertRegex(line["raised"]["through"][-1], r"^cameras/opencv/camera_opencv\.py:\d+ read_latest$")


if __name__ == "__main__":
    unittest.main()
