#!/usr/bin/env python3
"""Writes a recording of today as the program wrote it before frames and masks had `plugged`.

    make.py NEW.mcap SCHEMAS OLD.mcap

SCHEMAS is a folder with rapid.Frame.bin and rapid.Mask.bin of that time. Everything else stays as it is, message by message;
the name of the computer, its kernel and its boot are replaced. Needs the packages mcap and zstandard.
"""

import json
import sys
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

# By message: the fields that are left out; in a frame they are those of each modality, its field 4.
LEFT_OUT = {"rapid.Mask": {4}, "rapid.Frame": {7}}
MODALITY = 4
NEUTRAL = {"host": "rig", "kernel": "", "boot_id": "00000000-0000-0000-0000-000000000000"}


def varint(data, at):
    value = shift = 0
    while True:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            return value, at


def encoded(value):
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def fields(data):
    """Yields (number, value of a field of bytes or None, all bytes of the field) of a protobuf message."""
    at = 0
    while at < len(data):
        begin = at
        key, at = varint(data, at)
        value = None
        if key & 7 == 0:
            _, at = varint(data, at)
        elif key & 7 == 2:
            length, at = varint(data, at)
            value = data[at : at + length]
            at += length
        else:
            at += {1: 8, 5: 4}[key & 7]
        yield key >> 3, value, data[begin:at]


def without(schema, data):
    if schema == "rapid.Frame":
        out = b""
        for number, value, whole in fields(data):
            if number == MODALITY:
                kept = b"".join(part for inner, _, part in fields(value) if inner not in LEFT_OUT[schema])
                whole = encoded(MODALITY << 3 | 2) + encoded(len(kept)) + kept
            out += whole
        return out
    return b"".join(whole for number, _, whole in fields(data) if number not in LEFT_OUT.get(schema, set()))


def metadata(record):
    values = {key: NEUTRAL.get(key, value) for key, value in record.metadata.items()}
    if record.name == "rapid/summary":
        modalities = json.loads(values["modalities"])
        for modality in modalities.values():
            # Since there are sensors of other computers.
            modality.pop("clock_uncertainty", None)
        values["modalities"] = json.dumps(modalities, separators=(",", ":"))
    return values


def main(new, schemas, old):
    with open(new, "rb") as source, open(old, "wb") as sink:
        reader = make_reader(source, validate_crcs=True)
        summary = reader.get_summary()
        writer = Writer(sink, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="", library=reader.get_header().library)
        records = {record.name: metadata(record) for record in reader.iter_metadata()}
        writer.add_metadata("rapid", records.pop("rapid"))
        for attachment in reader.iter_attachments():
            data, media = attachment.data, attachment.media_type
            writer.add_attachment(attachment.create_time, attachment.log_time, attachment.name, media, data)
        ids = {}
        for channel in sorted(summary.channels.values(), key=lambda channel: channel.id):
            schema = summary.schemas[channel.schema_id]
            path = Path(schemas) / f"{schema.name}.bin"
            data = path.read_bytes() if schema.name in LEFT_OUT else schema.data
            own = writer.register_schema(schema.name, schema.encoding, data)
            ids[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, own, channel.metadata)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            data = without(schema.name, message.data)
            writer.add_message(ids[channel.id], message.log_time, data, message.publish_time, message.sequence)
        for name, values in records.items():
            writer.add_metadata(name, values)
        writer.finish()


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    main(*sys.argv[1:])
