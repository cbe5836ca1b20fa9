#!/usr/bin/env python3
"""Prints the headers of the next samples of one topic of a running `rapid`, one JSON object a line.

    subscribe.py TOPIC [COUNT] [SECONDS]

Waits at most SECONDS (default 10) for the topic and for every next sample; exit code 3 if none came,
1 if the topic is of other types than this program expects. RAPID_INSTANCE is what that `rapid` was given as --instance.
"""

import ctypes
import json
import os
import sys
import time

import iceoryx2 as iox2

NOTHING = 3


class SampleHeader(ctypes.Structure):
    """`rapid::sample::SampleHeader`: 56 bytes beside every payload."""

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
    def type_name() -> str:
        """The name under which the service knows the header: both sides must use the same."""
        return "RapidSampleHeader"


assert ctypes.sizeof(SampleHeader) == 56


def open_service(node, topic, deadline):
    """Opens the topic, which exists from the moment `rapid` has started."""
    name = iox2.ServiceName.new(topic)
    while True:
        builder = node.service_builder(name).publish_subscribe(iox2.Slice[ctypes.c_uint8])
        try:
            return builder.user_header(SampleHeader).open()
        except iox2.PublishSubscribeOpenError as error:
            if "DoesNotExist" not in str(error):
                sys.exit(f"{topic}: {error}")
            if time.monotonic() > deadline:
                print(f"{topic}: no such topic; is rapid running?", file=sys.stderr)
                sys.exit(NOTHING)
        node.wait(iox2.Duration.from_millis(20))


def main(topic, count=10, patience=10.0):
    iox2.set_log_level(iox2.LogLevel.Error)
    config = iox2.config.default()
    instance = os.environ.get("RAPID_INSTANCE")
    if instance:
        config.global_cfg.prefix = iox2.FileName.new(f"iox2_{instance}_")
    node = iox2.NodeBuilder.new().config(config).create(iox2.ServiceType.Ipc)
    subscriber = open_service(node, topic, time.monotonic() + patience).subscriber_builder().create()
    deadline = time.monotonic() + patience
    while count > 0:
        sample = subscriber.receive()
        if sample is None:
            if time.monotonic() > deadline:
                print(f"no sample on {topic} for {patience} s", file=sys.stderr)
                return NOTHING
            node.wait(iox2.Duration.from_millis(1))
            continue
        header = sample.user_header().contents
        line = {field: getattr(header, field) for field, _ in SampleHeader._fields_}
        line["bytes"] = sample.payload().len()
        line["begins"] = bytes(sample.payload().as_memory_view()[:8]).hex()
        print(json.dumps(line), flush=True)
        count -= 1
        deadline = time.monotonic() + patience
    return 0


if __name__ == "__main__":
    if not 2 <= len(sys.argv) <= 4:
        sys.exit(__doc__)
    sys.exit(main(sys.argv[1], *map(int, sys.argv[2:3]), *map(float, sys.argv[3:4])))
