"""Episodes of tests: recorded by the program in $RAPID_BIN, and read by code that shares nothing with it.

What belongs to a row is taken from `/rapid/frame` and from nothing else.
"""

import json
import os
import subprocess
import tempfile
import unittest
from collections import defaultdict
from pathlib import Path

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader

LOWER = 0xFFFF_FFFF
PROGRAM = os.environ.get("RAPID_BIN")


def rapid(*words: str, cwd: Path) -> str:
    """Runs the program; returns what it prints."""
    environment = {**os.environ, "RAPID_INSTANCE": f"test-{os.getpid()}", "HOME": str(cwd)}
    done = subprocess.run([PROGRAM, *words], cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    # 4: an episode is BAD, as on a busy machine it may be.
    if done.returncode not in (0, 4):
        raise AssertionError(f"rapid {' '.join(words)}: {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


@unittest.skipUnless(PROGRAM, "skipped: no program in $RAPID_BIN")
class Folder(unittest.TestCase):
    """Tests on what is in one folder, which is there before the first and gone after the last."""

    @classmethod
    def setUpClass(cls) -> None:
        temporary = tempfile.TemporaryDirectory()
        cls.addClassCleanup(temporary.cleanup)
        cls.folder = Path(temporary.name)


def decoder(schema):
    """The class of a schema's messages, from the schema in the file."""
    pool = descriptor_pool.DescriptorPool()
    for proto in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(proto)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))


def read_episode(path: Path) -> list[dict]:
    """The rows of an episode: by modality the sample, or None; mask, plugged, valid, age."""
    classes, samples, frames = {}, defaultdict(dict), []
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        about = next(record.metadata for record in reader.iter_metadata() if record.name == "rapid")
        listed = sorted(json.loads(about["modalities"]), key=lambda entry: entry["bit"])
        topics = {entry["topic"]: entry["bit"] for entry in listed}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.topic != "/rapid/frame" and channel.topic not in topics:
                continue
            if schema.name not in classes:
                classes[schema.name] = decoder(schema)
            body = classes[schema.name].FromString(message.data)
            if channel.topic == "/rapid/frame":
                frames.append((message.log_time, body))
            else:
                samples[topics[channel.topic]][message.sequence] = body
    rows = []
    for time_ns, frame in frames:
        slots = {slot.bit: slot for slot in frame.modalities}
        row = {"time_ns": time_ns, "mask": [], "plugged": [], "valid": [], "age": [], "samples": []}
        for entry in listed:
            slot = slots[entry["bit"]]
            shown = slot.present and slot.HasField("seq")
            sample = samples[entry["bit"]].get(slot.seq & LOWER) if shown else None
            row["samples"].append(sample)
            row["mask"].append(float(slot.present))
            row["plugged"].append(float(slot.plugged))
            row["valid"].append(float(slot.valid and sample is not None))
            row["age"].append(slot.age_ns / 1e9 if sample is not None else 0.0)
        rows.append(row)
    return rows
