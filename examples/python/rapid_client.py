"""Observations of a running `rapid` as numpy arrays whose shapes never change, whatever is plugged in.

    from rapid_client import Client

    client = Client({"/rapid/camera/wrist": (480, 640, 3), "/rapid/serial/motor": (6,)})
    for now in client.observations():
        act(now.arrays["/rapid/camera/wrist"], now.arrays["/rapid/serial/motor"], now.valid, now.mask)

Of a modality that is absent, or whose sample cannot be used, the array is zeros and `valid` is False; a late sample is
repeated with its age. Needs the packages `iceoryx2` 0.10 and `numpy`, and for JPEG `pillow` or a function of your own. Copy this
file and rapid_node.py beside your program; RAPID_INSTANCE is what that `rapid` was given as --instance.
"""

import io
import struct
from dataclasses import dataclass

import numpy as np
from rapid_node import F64, GREY, MJPEG, YUYV, Bus

OBSERVATIONS = "/rapid/observation"
# An observation: the mask, and of each modality its bit, flags, number of the chosen sample, its age in ns.
MASK = struct.Struct("<Q")
SLOT = struct.Struct("<IIQq")
PRESENT, VALID, STALE, CHOSEN, PLUGGED = 1, 2, 4, 8, 16
DAMAGED = 1
# Samples of a modality that are kept until an observation names one of them.
KEPT = 64


@dataclass(frozen=True)
class Observation:
    """What one tick saw. The dictionaries have every topic of the client, always."""

    seq: int
    """Number of the tick: a hole is a tick that was skipped."""
    tick_ns: int
    """Time of the tick, of `time.monotonic_ns()`."""
    mask: int
    """The Physical Mask: bit i is set while the device of bit i is attached and running."""
    arrays: dict
    """uint8 (height, width, channels) of a picture, float64 (n,) of numbers; zeros where there is no usable sample."""
    present: dict
    """The modality's bit of the mask; False before the first sample of its topic, which names its bit."""
    plugged: dict
    """Its device is plugged in, though it may not run: plugged and not present is a driver that starts or has failed."""
    valid: dict
    """A usable sample lies within the window of the tick."""
    age: dict
    """From the moment that the sample shows to the tick, s; NaN without a sample."""


def picture(payload, header, shape):
    """The pixels of a JPEG, YUYV or grey picture, as (height, width, 3), or (height, width, 1) where `shape` has one channel."""
    if header.encoding == MJPEG:
        from PIL import Image

        image = Image.open(io.BytesIO(payload)).convert("L" if shape[-1] == 1 else "RGB")
        return np.asarray(image).reshape(image.height, image.width, -1)
    if header.encoding == GREY:
        grey = np.frombuffer(payload, np.uint8).reshape(header.height, header.width, 1)
        return np.broadcast_to(grey, (header.height, header.width, shape[-1]))
    # YUYV: the luminance of each pixel, and of each second one its two colours (ITU-R BT.601, limited range).
    pairs = np.frombuffer(payload, np.uint8).reshape(header.height, header.width // 2, 4).astype(np.float32)
    luminance = (pairs[..., 0::2].reshape(header.height, header.width) - 16) * 1.164
    blue, red = (np.repeat(pairs[..., at] - 128, 2, axis=1) for at in (1, 3))
    colours = [luminance + 1.596 * red, luminance - 0.392 * blue - 0.813 * red, luminance + 2.017 * blue]
    channels = [luminance] if shape[-1] == 1 else colours
    return np.stack(channels, axis=-1).clip(0, 255).astype(np.uint8)


def array_of(header, payload, shape, decode=picture):
    """The array of a sample; None if it is damaged. A whole sample of another shape is an error of the program."""
    if header.flags & DAMAGED:
        return None
    if header.encoding not in (F64, MJPEG, YUYV, GREY):
        raise TypeError(f"encoding {header.encoding} is no array: read the topic itself, as subscribe.py does")
    try:
        array = np.frombuffer(payload, "<f8") if header.encoding == F64 else decode(payload, header, shape)
    except (OSError, ValueError):
        # A picture that is cut, or bytes that are none.
        return None
    if array.shape != shape:
        raise TypeError(f"a sample has the shape {array.shape}, and {shape} is expected")
    return array


class Client:
    """Observations of these topics. `decode(payload, header, shape)` makes the array of a picture."""

    def __init__(self, shapes, decode=picture):
        self._shapes = {topic: tuple(shape) for topic, shape in shapes.items()}
        self._decode = decode
        self._bus = Bus()
        # The observations last: fewer of them name samples from before the subscription.
        self._inboxes = {topic: self._bus.inbox(topic) for topic in self._shapes}
        self._ticks = self._bus.inbox(OBSERVATIONS)
        self._samples = {topic: {} for topic in self._shapes}
        self._bits = {}

    def observations(self):
        """Yields each observation from now on; never ends. The first ones may lack samples older than the client."""
        while True:
            ticks = list(self._ticks.take())
            # Read after the observations: the samples that they name are there.
            for topic, inbox in self._inboxes.items():
                kept = self._samples[topic]
                for header, payload in inbox.take():
                    self._bits[topic] = header.id
                    kept[header.seq] = (header, payload)
                    if len(kept) > KEPT:
                        del kept[next(iter(kept))]
            yield from (self._observation(header, payload) for header, payload in ticks)
            self._bus.wait()

    def _observation(self, header, payload):
        (mask,) = MASK.unpack_from(payload)
        slots = {bit: slot for bit, *slot in SLOT.iter_unpack(payload[MASK.size :])}
        arrays, present, plugged, valid, age = {}, {}, {}, {}, {}
        for topic, shape in self._shapes.items():
            flags, seq, age_ns = slots.get(self._bits.get(topic), (0, 0, 0))
            sample = self._samples[topic].get(seq) if flags & CHOSEN else None
            array = None if sample is None else array_of(*sample, shape, self._decode)
            present[topic] = bool(flags & PRESENT)
            plugged[topic] = bool(flags & PLUGGED)
            valid[topic] = bool(flags & VALID) and array is not None
            age[topic] = age_ns / 1e9 if array is not None else float("nan")
            kind = np.uint8 if len(shape) == 3 else np.float64
            arrays[topic] = np.zeros(shape, kind) if array is None else array
        return Observation(header.seq, header.capture_ns, mask, arrays, present, plugged, valid, age)
