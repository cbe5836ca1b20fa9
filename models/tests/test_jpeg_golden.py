"""Pictures as training decodes them, with Pillow: `tests/golden/jpeg`, against which the program's own decoder is tested
(`src/pixels/tests.rs`). Each picture is `NAME.jpg` with its pixels in `NAME.ppm`.

python tests/test_jpeg_golden.py --write             # draws the pictures of cameras, and decodes all of them
python tests/test_jpeg_golden.py --write EPISODE     # takes those of the simulated task from an episode too
"""

import io
import sys
import unittest
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))

from rapid_policy.pixels import COMPRESSED, decode

GOLDEN = Path(__file__).parents[2] / "tests" / "golden" / "jpeg"
# Names with width, height and sampling of the colours. Motion JPEG of cameras is 4:2:2 or 4:2:0, and its sides are mostly
# whole blocks; where they are not, decoders differ more at the right and lower edge.
CAMERAS = {
    "camera_422": (64, 48, "4:2:2"),
    "camera_420": (64, 48, "4:2:0"),
    "cut_422": (70, 50, "4:2:2"),
    "cut_420": (70, 50, "4:2:0"),
}
# By name the topic and the number of the sample in an episode: the wrist camera's first, and the gel pressed on a block.
TASK = {"task_wrist": ("/rapid/camera/wrist", 0), "task_tactile": ("/rapid/camera/tactile", -1)}


def scene(width: int, height: int, seed: int) -> np.ndarray:
    """Waves, patches with hard edges in strong colours, and noise, which no decoder reproduces by chance."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width]
    picture = np.empty((height, width, 3))
    for channel in range(3):
        across, along, phase = random.uniform(-0.6, 0.6), random.uniform(-0.6, 0.6), random.uniform(0, 2 * np.pi)
        picture[:, :, channel] = random.uniform(80, 170) + 50 * np.sin(across * u + along * v + phase)
    for _ in range(4):
        left, top = random.integers(0, width - 12), random.integers(0, height - 12)
        wide, high = random.integers(8, 24, 2)
        picture[top : top + high, left : left + wide] = random.uniform(0, 255, 3)
    return np.clip(picture + random.normal(0, 20, picture.shape), 0, 255).astype(np.uint8)


def as_of_a_camera(jpeg: bytes) -> bytes:
    """Without the Huffman tables (segments DHT), which are those of the standard: cameras leave them out."""
    kept, at = jpeg[:2], 2
    while jpeg[at + 1] != 0xDA:
        after = at + 2 + int.from_bytes(jpeg[at + 2 : at + 4], "big")
        if jpeg[at + 1] != 0xC4:
            kept += jpeg[at:after]
        at = after
    return kept + jpeg[at:]


def task(episode: Path) -> dict[str, bytes]:
    """The pictures of the simulated task, as the program encoded them."""
    from mcap.reader import make_reader
    from recorded import decoder

    sent = {topic: [] for topic, _ in TASK.values()}
    with episode.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(topics=list(sent)):
            sent[channel.topic].append(decoder(schema).FromString(message.data).data)
    return {name: sent[topic][number] for name, (topic, number) in TASK.items()}


def write(episode: Path | None) -> None:
    for seed, (name, (width, height, sampling)) in enumerate(CAMERAS.items()):
        jpeg = io.BytesIO()
        Image.fromarray(scene(width, height, seed)).save(jpeg, "JPEG", quality=80, subsampling=sampling)
        (GOLDEN / f"{name}.jpg").write_bytes(as_of_a_camera(jpeg.getvalue()))
    for name, jpeg in (task(episode) if episode else {}).items():
        (GOLDEN / f"{name}.jpg").write_bytes(jpeg)
    for jpeg in sorted(GOLDEN.glob("*.jpg")):
        Image.fromarray(decoded(jpeg)).save(jpeg.with_suffix(".ppm"))


def decoded(jpeg: Path) -> np.ndarray:
    return decode(COMPRESSED, SimpleNamespace(data=jpeg.read_bytes()))


class Golden(unittest.TestCase):
    def test_the_pixels_are_those_that_training_sees(self):
        found = sorted(GOLDEN.glob("*.jpg"))
        self.assertEqual([jpeg.stem for jpeg in found], sorted([*CAMERAS, *TASK]))
        for jpeg in found:
            with self.subTest(jpeg.stem):
                stored = np.array(Image.open(jpeg.with_suffix(".ppm")))
                # Not within a bound: libjpeg-turbo promises the same pixels on all processors, and another decoder in
                # Pillow would have another distance from the program's.
                np.testing.assert_array_equal(decoded(jpeg), stored)

    def test_the_colours_are_sampled_as_the_names_say(self):
        # ITU-T T.81 B.2.2: after the marker of the frame 2 bytes of length, 1 of precision, 4 of size, 1 of components;
        # the sampling is the second byte of the first one, that of the brightness.
        expected = {"4:4:4": 0x11, "4:2:2": 0x21, "4:2:0": 0x22}
        samplings = {name: sampling for name, (_, _, sampling) in CAMERAS.items()} | dict.fromkeys(TASK, "4:4:4")
        for name, sampling in samplings.items():
            data = (GOLDEN / f"{name}.jpg").read_bytes()
            self.assertEqual(data[data.index(b"\xff\xc0") + 11], expected[sampling], name)


if __name__ == "__main__":
    if "--write" in sys.argv:
        given = sys.argv[sys.argv.index("--write") + 1 :]
        write(Path(given[0]) if given else None)
    else:
        unittest.main()
