"""Pictures of any size and format: as the program sees them when a policy runs."""

import unittest
from types import SimpleNamespace

import numpy as np
import torch
import torch.nn.functional as F
import written
from made_up import SIDE

from rapid_policy import pixels
from rapid_policy.pixels import COMPRESSED, RAW, FormatError, PixelError, decode, fit, scaled

RANDOM = np.random.default_rng(0)
COLORED = RANDOM.integers(0, 256, (4, 6, 3)).astype(np.uint8)


def raw(encoding: str, data: np.ndarray, width: int = 6, height: int = 4, step: int | None = None) -> SimpleNamespace:
    step = data.nbytes // height if step is None else step
    return SimpleNamespace(encoding=encoding, width=width, height=height, step=step, data=data.tobytes())


class Formats(unittest.TestCase):
    def test_raw_pictures(self):
        grey = COLORED[:, :, 0]
        padded = np.concatenate([COLORED.reshape(4, 18), np.zeros((4, 2), np.uint8)], 1)
        alpha = np.concatenate([COLORED, np.full((4, 6, 1), 9, np.uint8)], 2)
        depth = np.array([[0, 1, 16, 4080, 65535, 160]] * 4, "<u2")
        for name, message, expected in (
            ("rgb8", raw("rgb8", COLORED), COLORED),
            ("rows with a rest", raw("rgb8", padded), COLORED),
            ("without a step", raw("rgb8", COLORED, step=0), COLORED),
            ("bgr8", raw("bgr8", COLORED[:, :, ::-1]), COLORED),
            ("rgba8", raw("rgba8", alpha), COLORED),
            ("bgra8", raw("bgra8", alpha[:, :, [2, 1, 0, 3]]), COLORED),
            ("mono8", raw("mono8", grey), np.repeat(grey[:, :, None], 3, 2)),
            ("8UC1", raw("8UC1", grey), np.repeat(grey[:, :, None], 3, 2)),
            # The shades of the program's own test.
            ("16UC1", raw("16UC1", depth), np.tile(np.array([0, 255, 254, 0, 0, 245])[None, :, None], (4, 1, 3))),
        ):
            with self.subTest(name):
                np.testing.assert_array_equal(decode(RAW, message), expected)

    def test_yuyv_is_bt_601_of_limited_range(self):
        for value in range(256):
            y, u, v = value, 255 - value, value // 2
            pair = np.tile(np.array([y, u, y, v], np.uint8), 12)
            bright, blue, red = (y - 16) * 255 / 219, u - 128, v - 128
            expected = [bright + 1.596027 * red, bright - 0.391762 * blue - 0.812968 * red, bright + 2.017232 * blue]
            for encoding, data in (("yuv422_yuy2", pair), ("uyvy", pair.reshape(-1, 2)[:, ::-1])):
                found = decode(RAW, raw(encoding, data))[2, 3]
                self.assertLess(np.abs(found - np.clip(expected, 0, 255)).max(), 0.51, f"{encoding} {value}")

    def test_compressed_pictures(self):
        smooth = np.broadcast_to(np.arange(0, 192, 2, dtype=np.uint8)[:, None, None], (SIDE, SIDE, 3))
        for kind, allowed in (("PNG", 0), ("WEBP", 8), ("JPEG", 8)):
            found = decode(COMPRESSED, SimpleNamespace(**written.jpeg(smooth, kind)))
            self.assertLessEqual(np.abs(found.astype(int) - smooth).max(), allowed, kind)

    def test_damage_and_what_is_no_picture(self):
        whole = written.jpeg(np.zeros((SIDE, SIDE, 3), np.uint8))["data"]
        for data in (b"", b"no picture", whole[: len(whole) // 2]):
            with self.assertRaises(PixelError):
                decode(COMPRESSED, SimpleNamespace(data=data))
        with self.assertRaisesRegex(PixelError, "71 bytes, where 6x4 in rows of 18 has 72"):
            decode(RAW, raw("rgb8", COLORED.ravel()[:71], step=18))
        with self.assertRaisesRegex(PixelError, "odd number"):
            decode(RAW, raw("yuyv", np.zeros(40, np.uint8), width=5))
        with self.assertRaisesRegex(FormatError, "encoding 'bayer_rggb8'"):
            decode(RAW, raw("bayer_rggb8", COLORED))
        with self.assertRaisesRegex(FormatError, "rapid.Scalars"):
            decode("rapid.Scalars", SimpleNamespace())


class Sizes(unittest.TestCase):
    def test_resized_as_pytorch_does_and_cropped_as_torchvision_does(self):
        for size, resized, wanted in (
            ((48, 64), (96, 128), (96, 96)),
            ((120, 161), (96, 128), (96, 96)),
            ((97, 101), (64, 71), (64, 64)),
            ((30, 30), (30, 30), (24, 16)),
            ((480, 640), (96, 96), (96, 96)),
        ):
            with self.subTest(size=size, resized=resized):
                picture = RANDOM.integers(0, 256, (*size, 3)).astype(np.uint8)
                given = torch.from_numpy(picture).permute(2, 0, 1)[None].float()
                expected = (
                    F.interpolate(given, resized, mode="bilinear", align_corners=False)[0].permute(1, 2, 0).numpy()
                )
                top, left = (round((r - w) / 2.0) for r, w in zip(resized, wanted, strict=True))
                expected = expected[top : top + wanted[0], left : left + wanted[1]]
                np.testing.assert_allclose(scaled(picture, resized, wanted), expected, atol=0.02)
                self.assertLessEqual(np.abs(fit(picture, resized, wanted) - expected).max(), 0.52)

    def test_taps_are_those_of_the_program(self):
        # Computed with the formulas of src/policy/picture.rs: 5 values of 7, the middle 3.
        low, high, share = pixels._taps(7, 5, 3)
        self.assertEqual((low.tolist(), high.tolist()), ([1, 3, 4], [2, 4, 5]))
        np.testing.assert_allclose(share, [0.6, 0.0, 0.4], atol=1e-6)
        self.assertEqual([pixels._crop_start(100, 100 - rest) for rest in range(8)], [0, 0, 1, 2, 2, 2, 3, 4])

    def test_a_picture_that_fits_is_unchanged(self):
        np.testing.assert_array_equal(fit(COLORED, None, None), COLORED)
        np.testing.assert_array_equal(fit(COLORED, (4, 6), (2, 4)), COLORED[1:3, 1:5])
        self.assertIsNone(fit(COLORED, None, (8, 8)))


if __name__ == "__main__":
    unittest.main()
