"""What a program of `rapid` needs in Python: the header of a sample, and ways to publish and to receive.

Needs the package `iceoryx2` of the version that `rapid` has, 0.10. Copy this file beside your program.
"""

import ctypes
import os
import struct
import time

import iceoryx2 as iox2

# What a payload holds.
BYTES, MJPEG, YUYV, GREY, F64 = range(5)
# Actions: little-endian 64-bit floats, one per axis.
ACTIONS = "/action"
# As many axes as an action may have.
MOST_AXES = 64


class SampleHeader(ctypes.Structure):
    """The header of every sample."""

    _fields_ = [
        ("seq", ctypes.c_uint64),
        ("lost", ctypes.c_uint64),
        ("capture_ns", ctypes.c_uint64),
        ("recv_ns", ctypes.c_uint64),
        ("id", ctypes.c_uint32),
        ("epoch", ctypes.c_uint32),
        ("encoding", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("width", ctypes.c_uint32),
        ("height", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name():
        """The name under which `rapid` knows it."""
        return "RapidSampleHeader"


class Bus:
    """The bus of the `rapid` that started this program, or of the one whose --instance is RAPID_INSTANCE."""

    def __init__(self):
        iox2.set_log_level(iox2.LogLevel.Error)
        config = iox2.config.default()
        instance = os.environ.get("RAPID_INSTANCE")
        prefix = os.environ.get("RAPID_BUS_PREFIX") or (f"iox2_{instance}_" if instance else None)
        if prefix:
            config.global_cfg.prefix = iox2.FileName.new(prefix)
        if root := os.environ.get("RAPID_BUS_ROOT"):
            config.global_cfg.root_path = iox2.Path.new(root)
        # SIGTERM ends this program as it ends any other.
        builder = iox2.NodeBuilder.new().config(config).signal_handling_mode(iox2.SignalHandlingMode.Disabled)
        self._node = builder.create(iox2.ServiceType.Ipc)

    def _topic(self, topic):
        builder = self._node.service_builder(iox2.ServiceName.new(topic))
        return builder.publish_subscribe(iox2.Slice[ctypes.c_uint8]).user_header(SampleHeader).open()

    def publisher(self, topic, max_bytes):
        """Publishes payloads of at most this many bytes, on the topic of a device of this program or of actions."""
        port = self._topic(topic).publisher_builder().initial_max_slice_len(max_bytes).create()
        wake = self._node.service_builder(iox2.ServiceName.new(topic)).event().open()
        return Publisher(port, wake.notifier_builder().create())

    def node(self, max_bytes):
        """Publishes the samples of the device this program was started for."""
        topic = os.environ["RAPID_TOPIC"]
        publisher = self.publisher(topic, max_bytes)
        publisher._header = {"id": int(os.environ["RAPID_BIT"]), "epoch": int(os.environ["RAPID_EPOCH"])}
        return publisher

    def subscriber(self, topic):
        """Yields the header and the payload of every sample of a topic as it arrives; never ends."""
        inbox = self.inbox(topic)
        while True:
            yield from inbox.take()
            self.wait()

    def inbox(self, topic):
        """The samples of a topic from now on."""
        return Inbox(self._topic(topic).subscriber_builder().create())

    def wait(self, milliseconds=2):
        """Sleeps between two looks."""
        self._node.wait(iox2.Duration.from_millis(milliseconds))

    def actions(self):
        """Receives actions."""
        return Actions(self._topic(ACTIONS).subscriber_builder().create())


class Inbox:
    """The samples of one topic."""

    def __init__(self, port):
        self._port = port

    def take(self):
        """Yields the header and the payload of every sample that has arrived."""
        while (sample := self._port.receive()) is not None:
            # Copies: the sample's memory is returned to the publisher when it is dropped.
            header = SampleHeader.from_buffer_copy(sample.user_header().contents)
            yield header, bytes(sample.payload().as_memory_view())


class Publisher:
    """Publishes on one topic."""

    def __init__(self, port, wake):
        self._port = port
        self._wake = wake
        self._header = {}
        self._seq = 0

    def send(self, payload, encoding, capture_ns=None, **header):
        """Publishes a payload, captured at a moment of `time.monotonic_ns()`, by default now."""
        sample = self._port.loan_slice_uninit(len(payload))
        fields = {"capture_ns": capture_ns or time.monotonic_ns(), "encoding": encoding, **self._header, **header}
        sample.user_header()[0] = SampleHeader(seq=self._seq, **fields)
        ctypes.memmove(sample.payload().as_ptr(), payload, len(payload))
        sample.assume_init().send()
        self._seq += 1
        # Without a notification a sample is found a little later.
        self._wake.notify()

    def send_numbers(self, numbers, **header):
        """Publishes numbers, which is what `kind = "scalars"` means."""
        self.send(struct.pack(f"<{len(numbers)}d", *numbers), F64, **header)


class Actions:
    """The actions of the run."""

    def __init__(self, port):
        self._port = port

    def newest(self):
        """The newest action that came since the last call, a list of numbers; None if none did."""
        newest = None
        while (sample := self._port.receive()) is not None:
            payload = bytes(sample.payload().as_memory_view())
            if sample.user_header().contents.encoding == F64 and 0 < len(payload) <= 8 * MOST_AXES and len(payload) % 8 == 0:
                newest = [number for (number,) in struct.iter_unpack("<d", payload)]
        return newest
