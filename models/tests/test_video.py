"""Pictures of videos: by their times, from any place of a file, and a reason where there is none."""

import tempfile
import unittest
from pathlib import Path

import av
import made_up  # noqa: F401  (the path of the package)
import numpy as np

from rapid_policy.video import VideoError, frames

FPS, COUNT = 10, 40
CODECS = ("libx264", "libx265", "libsvtav1")


def write_video(path: Path, codec: str = "libx264", count: int = COUNT, **options: str) -> Path:
    """Frame N is grey 6 N. Key frames are few, and frames are in another order than they are shown in."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, FPS, options={"g": "8", "crf": "10", **options})
        stream.pix_fmt, stream.width, stream.height = "yuv420p", 96, 64
        for at in range(count):
            picture = av.VideoFrame.from_ndarray(np.full((64, 96, 3), 6 * at, np.uint8), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    return path


class Frames(unittest.TestCase):
    def setUp(self):
        temporary = tempfile.TemporaryDirectory()
        self.addCleanup(temporary.cleanup)
        self.folder = Path(temporary.name)

    def shown(self, path: Path, times: list[float]) -> list[int]:
        """The numbers of the frames."""
        return [round(float(picture.mean()) / 6) for picture in frames(path, np.array(times))]

    def test_each_is_that_of_its_time_wherever_a_segment_begins(self):
        for codec in CODECS:
            path = write_video(self.folder / f"{codec}.mp4", codec)
            for begin in range(COUNT):
                wanted = list(range(begin, min(begin + 5, COUNT)))
                self.assertEqual(self.shown(path, [at / FPS for at in wanted]), wanted, f"{codec} from {begin}")
            with self.assertRaisesRegex(VideoError, rf"{codec}.mp4: no frame at 4.0000 s, the nearest is at 3.9000 s$"):
                self.shown(path, [3.9, 4.0])

    def test_a_time_between_frames_has_none(self):
        path = write_video(self.folder / "video.mp4")
        self.assertEqual(self.shown(path, [0.29992, 0.40008]), [3, 4])
        with self.assertRaisesRegex(VideoError, "no frame at 0.4002 s, the nearest is at 0.4000 s"):
            self.shown(path, [0.4002])
        with self.assertRaisesRegex(VideoError, "no frame at -0.1000 s, the nearest is at 0.0000 s"):
            self.shown(path, [-0.1])

    def test_times_of_32_bits_late_in_a_video(self):
        # At 5,000 s such a number has steps of 0.49 ms: this one is 0.2 ms off.
        path = self.folder / "late.mp4"
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", FPS)
            stream.pix_fmt, stream.width, stream.height = "yuv420p", 96, 64
            for at in range(3):
                picture = av.VideoFrame.from_ndarray(np.full((64, 96, 3), 60 * at, np.uint8), format="rgb24")
                picture.pts = 50_002 * (at > 0) + at
                container.mux(stream.encode(picture))
            container.mux(stream.encode())
        self.assertEqual(self.shown(path, [float(np.float32(5000.3)), float(np.float32(5000.4))]), [10, 20])

    def test_what_is_damaged_is_one_line_with_the_file(self):
        whole = write_video(self.folder / "whole.mp4", movflags="faststart").read_bytes()
        damages = {"cut.mp4": whole[: len(whole) // 2], "empty.mp4": b"", "other.mp4": b"no video" * 99}
        for name, data in damages.items():
            (self.folder / name).write_bytes(data)
        for name in (*damages, "missing.mp4"):
            with self.assertRaises(VideoError) as raised:
                self.shown(self.folder / name, [at / FPS for at in range(COUNT)])
            self.assertRegex(str(raised.exception), rf"^{self.folder / name}: [^\n]+$")


if __name__ == "__main__":
    unittest.main()
