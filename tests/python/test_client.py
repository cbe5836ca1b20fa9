"""What examples/python/rapid_client.py makes of the samples of devices, whole and damaged."""

import io
import struct
import unittest

import numpy as np
from PIL import Image
from rapid_client import DAMAGED, array_of
from rapid_node import BYTES, F64, GREY, MJPEG, YUYV, SampleHeader


def jpeg(width, height, colour):
    file = io.BytesIO()
    Image.new("RGB", (width, height), colour).save(file, "JPEG", quality=95)
    return file.getvalue()


class Samples(unittest.TestCase):
    def test_numbers_are_float64(self):
        array = array_of(SampleHeader(encoding=F64), struct.pack("<3d", 1, -2.5, 1e300), (3,))
        np.testing.assert_array_equal(array, [1, -2.5, 1e300])

    def test_pictures_have_the_channels_that_are_asked_for(self):
        header = SampleHeader(encoding=MJPEG, width=32, height=16)
        colour = array_of(header, jpeg(32, 16, (200, 40, 90)), (16, 32, 3))
        np.testing.assert_allclose(colour.reshape(-1, 3).mean(axis=0), (200, 40, 90), atol=3)
        grey = array_of(header, jpeg(32, 16, (77, 77, 77)), (16, 32, 1))
        np.testing.assert_allclose(grey, 77, atol=1)
        header = SampleHeader(encoding=GREY, width=2, height=1)
        np.testing.assert_array_equal(array_of(header, b"\x05\xf0", (1, 2, 3)), [[[5] * 3, [240] * 3]])

    def test_yuyv_is_red_green_blue(self):
        # ITU-R BT.601: the limits of white and black, and a red, whose Y, U and V are 81, 90 and 240.
        header = SampleHeader(encoding=YUYV, width=4, height=1)
        array = array_of(header, bytes([235, 128, 16, 128, 81, 90, 81, 240]), (1, 4, 3))
        np.testing.assert_allclose(array[0], [[255] * 3, [0] * 3, [254, 0, 0], [254, 0, 0]], atol=2)

    def test_what_is_damaged_is_no_array(self):
        whole = jpeg(64, 64, (9, 99, 200))
        header = SampleHeader(encoding=MJPEG, width=64, height=64)
        for payload in [whole[: len(whole) // 2], whole[:2], b"", b"\x00" * 100]:
            self.assertIsNone(array_of(header, payload, (64, 64, 3)), payload[:8])
        self.assertIsNone(array_of(SampleHeader(encoding=MJPEG, flags=DAMAGED), whole, (64, 64, 3)))
        self.assertIsNone(array_of(SampleHeader(encoding=YUYV, width=4, height=2), b"1234567", (2, 4, 3)))
        self.assertIsNone(array_of(SampleHeader(encoding=GREY, width=4, height=2), b"1234567", (2, 4, 1)))
        self.assertIsNone(array_of(SampleHeader(encoding=F64), b"1234567", (1,)))

    def test_another_shape_is_an_error(self):
        numbers = SampleHeader(encoding=F64)
        with self.assertRaisesRegex(TypeError, r"\(2,\), and \(3,\)"):
            array_of(numbers, bytes(16), (3,))
        with self.assertRaisesRegex(TypeError, "encoding 0"):
            array_of(SampleHeader(encoding=BYTES), bytes(16), (2,))


if __name__ == "__main__":
    unittest.main()
