"""Pictures of a video at given times. Each is the frame that LeRobot 0.4.4 takes with PyAV: the one nearest to the time, if
it is less than `TOLERANCE` from it. `lerobot_source` knows which part of which video belongs to an episode.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

# Seconds.
TOLERANCE = 1e-4
# A key frame is found by the time at which it is decoded, which is before that at which it is shown: without a margin the
# first frames of a segment of HEVC are missed, as they are by LeRobot.
MARGIN = 1.0


class VideoError(Exception):
    """A video that lacks a picture; names the file and the reason."""


def frames(file: Path, times: NDArray[np.float64]) -> Iterator[NDArray[np.uint8]]:
    """The picture [H, W, 3], red first, at each of the ascending times. Decodes only the part that has them, once."""
    try:
        with av.open(str(file)) as container:
            if not container.streams.video:
                raise VideoError(f"{file}: no video in it")
            for frame in _nearest(file, _shown(container, times[0]), times):
                yield frame.to_ndarray(format="rgb24")
    except av.FFmpegError as error:
        raise VideoError(f"{file}: {error.strerror}") from error


def _shown(container: av.container.InputContainer, begin: float) -> Iterator[av.VideoFrame]:
    """The frames from a key frame before `begin` on."""
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    container.seek(int(max(0.0, begin - MARGIN) / stream.time_base), stream=stream)
    return (frame for frame in container.decode(stream) if frame.time is not None)


def _nearest(file: Path, shown: Iterator[av.VideoFrame], times: NDArray[np.float64]) -> Iterator[av.VideoFrame]:
    # Datasets keep times within an episode in 32 bits, which for late ones are coarser than the tolerance.
    tolerance = TOLERANCE + float(np.spacing(np.float32(times[-1])))
    before = after = next(shown, None)
    for time in times:
        while after is not None and after.time < time:
            before, after = after, next(shown, None)
        frame = min((f for f in (before, after) if f), key=lambda f: abs(f.time - time), default=None)
        if frame is None or abs(frame.time - time) >= tolerance:
            nearest = f", the nearest is at {frame.time:.4f} s" if frame else ""
            raise VideoError(f"{file}: no frame at {time:.4f} s{nearest}")
        if frame.is_corrupt:
            raise VideoError(f"{file}: the frame at {time:.4f} s is damaged")
        yield frame
