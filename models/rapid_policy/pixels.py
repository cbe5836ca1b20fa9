"""Pictures of recordings: from a message to pixels, and to the size that a policy takes, as the program does it."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Pixels = NDArray[np.uint8]

COMPRESSED, RAW = "foxglove.CompressedImage", "foxglove.RawImage"
# Bytes per pixel of each encoding of a raw picture.
ENCODINGS = {
    "rgb8": 3,
    "bgr8": 3,
    "rgba8": 4,
    "bgra8": 4,
    "mono8": 1,
    "8UC1": 1,
    "8UC3": 3,
    "yuv422_yuy2": 2,
    "yuyv": 2,
    "yuv422": 2,
    "uyvy": 2,
    "16UC1": 2,
    "mono16": 2,
}


class PixelError(Exception):
    """A picture that is damaged."""


class FormatError(Exception):
    """Messages that are not pictures that can be read."""


def decode(schema: str, message: Any) -> Pixels:
    """u8 [H, W, 3], red first."""
    if schema == COMPRESSED:
        try:
            return np.array(Image.open(io.BytesIO(message.data)).convert("RGB"))
        # Pillow has errors of its own for each format and each kind of damage.
        except Exception as error:
            raise PixelError(str(error)) from error
    if schema == RAW:
        return _raw(message)
    raise FormatError(f"messages of {schema} are not pictures that are read: expected {COMPRESSED} or {RAW}")


def _raw(message: Any) -> Pixels:
    encoding, width, height = message.encoding, message.width, message.height
    if encoding not in ENCODINGS:
        raise FormatError(f"raw pictures of encoding {encoding!r} are not read, only {', '.join(ENCODINGS)}")
    used = width * ENCODINGS[encoding]
    step = message.step or used
    data = np.frombuffer(message.data, np.uint8)
    if step < used or len(data) != step * height or not width or not height:
        raise PixelError(f"{len(data)} bytes, where {width}x{height} in rows of {step} has {step * height}")
    rows = data.reshape(height, step)[:, :used]
    if encoding in ("yuv422_yuy2", "yuyv", "yuv422", "uyvy"):
        return _yuv(rows, y=0 if encoding in ("yuv422_yuy2", "yuyv") else 1)
    if encoding in ("16UC1", "mono16"):
        return _shades(rows.reshape(height, width, 2))
    pixels = rows.reshape(height, width, -1)
    if pixels.shape[2] == 1:
        return np.repeat(pixels, 3, 2)
    return np.ascontiguousarray(pixels[:, :, 2::-1] if encoding in ("bgr8", "bgra8", "8UC3") else pixels[:, :, :3])


def _yuv(rows: Pixels, y: int) -> Pixels:
    """Two pixels in four bytes: BT.601 with limited range, in units of 1/65536; `y` is the place of the first brightness."""
    if rows.shape[1] % 4:
        raise PixelError("an odd number of pixels in YUYV")
    pairs = rows.reshape(len(rows), -1, 4).astype(np.int32)
    u, v = pairs[:, :, 1 - y, None] - 128, pairs[:, :, 3 - y, None] - 128
    bright = 76_309 * (pairs[:, :, y::2] - 16)
    colors = [bright + 104_597 * v, bright - 25_675 * u - 53_279 * v, bright + 132_201 * u]
    mixed = np.stack([np.clip((c + 32_768) >> 16, 0, 255) for c in colors], -1)
    return mixed.reshape(len(rows), -1, 3).astype(np.uint8)


def _shades(pairs: Pixels) -> Pixels:
    """Depth: from white at 0 to black at 16 x 255 counts, and black where there is none."""
    counts = pairs.astype(np.int32) @ np.array([1, 256], np.int32)
    shade = np.where(counts == 0, 0, 255 - np.minimum(counts // 16, 255)).astype(np.uint8)
    return np.repeat(shade[:, :, None], 3, 2)


def fit(pixels: Pixels, resize: tuple[int, int] | None, crop: tuple[int, int] | None) -> Pixels | None:
    """Resized (bilinear, half-pixel centres, no antialiasing), then the middle; none if it is too small for that."""
    resized = resize or pixels.shape[:2]
    wanted = crop or resized
    if resized[0] < wanted[0] or resized[1] < wanted[1]:
        return None
    if resized == pixels.shape[:2]:
        top, left = (_crop_start(r, w) for r, w in zip(resized, wanted, strict=True))
        return pixels[top : top + wanted[0], left : left + wanted[1]]
    return np.rint(scaled(pixels, resized, wanted)).astype(np.uint8)


def scaled(pixels: Pixels, resized: tuple[int, int], wanted: tuple[int, int]) -> NDArray[np.float32]:
    """f32 [h, w, 3] in 0..255: the middle of the resized picture, not rounded."""
    (top, bottom, down), (left, right, along) = (
        _taps(*sides) for sides in zip(pixels.shape[:2], resized, wanted, strict=True)
    )
    along = along[None, :, None]
    rows = [pixels[at].astype(np.float32) for at in (top, bottom)]
    high, low = (row[:, left] * (1 - along) + row[:, right] * along for row in rows)
    return high * (1 - down[:, None, None]) + low * down[:, None, None]


def _taps(size: int, resized: int, wanted: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """For each value along an axis: its two sources, and the share of the second."""
    at = np.arange(wanted) + _crop_start(resized, wanted)
    place = np.maximum((at + 0.5) * (size / resized) - 0.5, 0.0)
    low = np.minimum(place.astype(np.int64), size - 1)
    return low, np.minimum(low + 1, size - 1), np.minimum(place - low, 1.0).astype(np.float32)


def _crop_start(size: int, wanted: int) -> int:
    """An odd remainder is halved to the even number, as torchvision's CenterCrop does."""
    rest = size - wanted
    return rest // 2 + (rest % 4 == 3)
