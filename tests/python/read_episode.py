#!/usr/bin/env python3
"""Prints what an episode holds as one JSON object: the mask's edges and the messages of each topic.

An independent reader: it shares no code with the recorder. Needs the PyPI package `mcap` alone; the
fields of rapid.Mask and rapid.Frame are taken from the wire by hand.

    read_episode.py FILE.mcap
"""

import json
import struct
import sys

from mcap.reader import make_reader


def fields(message):
    """Yields (field number, value) of a protobuf message: int for numbers, bytes for the rest."""
    at = 0

    def varint():
        nonlocal at
        value = shift = 0
        while True:
            byte = message[at]
            at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    while at < len(message):
        key = varint()
        wire = key & 7
        if wire == 0:
            value = varint()
        elif wire == 1:
            (value,) = struct.unpack_from("<Q", message, at)
            at += 8
        elif wire == 5:
            (value,) = struct.unpack_from("<I", message, at)
            at += 4
        elif wire == 2:
            length = varint()
            value = message[at : at + length]
            if len(value) != length:
                raise ValueError("field longer than its message")
            at += length
        else:
            raise ValueError(f"wire type {wire}")
        yield key >> 3, value


def read(path):
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        topics = {
            channel.topic: {
                "schema": summary.schemas[channel.schema_id].name,
                "messages": 0,
                "metadata": channel.metadata,
            }
            for channel in summary.channels.values()
        }
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        attachments = {record.name: len(record.data) for record in reader.iter_attachments()}
        begin = int(metadata["rapid"]["begin_wall_ns"])
        edges, last, frames = [], None, {}
        for schema, channel, message in reader.iter_messages():
            topics[channel.topic]["messages"] += 1
            if schema.name == "rapid.Mask":
                mask = dict(fields(message.data)).get(2, 0)
                if mask != last:
                    edges.append({"at": (message.log_time - begin) / 1e9, "mask": mask})
                    last = mask
            elif schema.name == "rapid.Frame":
                for number, slot in fields(message.data):
                    if number == 4:
                        slot = dict(fields(slot))
                        count = frames.setdefault(slot.get(1, 0), {"valid": 0, "stale": 0, "absent": 0})
                        count["valid"] += slot.get(2, 0)
                        count["stale"] += slot.get(3, 0)
                        count["absent"] += 1 - slot.get(6, 0)
        return {
            "task": metadata["rapid"]["task"],
            "layout": json.loads(metadata["rapid"]["layout"]),
            "messages": summary.statistics.message_count,
            "topics": topics,
            "mask_edges": edges,
            "frames": frames,
            "attachments": attachments,
            "summary": metadata.get("rapid/summary"),
        }


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    json.dump(read(sys.argv[1]), sys.stdout, indent=2, sort_keys=True)
    print()
