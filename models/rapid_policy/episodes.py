"""Reads recorded episodes: the samples of each tick of the frame index, and the action taken at it.

The frame index of a file (`/rapid/frame`) names the sample of every modality at every tick by its sequence number, and
the mask in force. What is read here is therefore what a policy would have been given, not the nearest sample by a rule
of our own.
"""

from __future__ import annotations

import io
import json
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from numpy.typing import NDArray
from PIL import Image

from .judgement import JudgementError, judge
from .spec import Observation

FRAMES = "/rapid/frame"
ACTIONS = "/action"
# A message names its sample by the lower half of the 64-bit sequence number.
SEQUENCE_BITS = 0xFFFF_FFFF


class EpisodeError(Exception):
    """A file that cannot be used for training; names it and the reason."""

    def __init__(self, path: Path, what: str) -> None:
        super().__init__(f"{path}: {what}")


@dataclass
class Episode:
    """One episode, a row for each of its T ticks. Rows that are not `present` are zeros."""

    path: Path
    ticks: NDArray[np.int64]
    """[T] the tick's number in the frame index."""
    times: NDArray[np.int64]
    """[T] ns of the wall clock."""
    values: dict[str, NDArray[Any]]
    """By modality: pictures u8 [T, H, W, 3] (red first) or vectors f64 [T, D]."""
    present: dict[str, NDArray[np.bool_]]
    """[T] by modality: its bit is set in the mask, and the tick has a sample of it."""
    references: dict[str, NDArray[np.uint8]]
    """[H, W, 3] by modality: the first picture of the episode."""
    actions: NDArray[np.float64]
    """[T, Da]"""
    acted: NDArray[np.bool_]
    """[T] whether an action was taken at the tick."""
    facts: dict[str, str]
    """The metadata record `rapid`, written at the beginning."""
    summary: dict[str, str]
    """The metadata record `rapid/summary`, written at the end."""
    tags: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.ticks)


def episode_files(folder: Path) -> list[Path]:
    """The finished episodes of a folder, by name."""
    files = sorted(folder.glob("*.mcap"))
    if not files:
        raise EpisodeError(folder, "no episode (*.mcap) in this folder")
    return files


def read_episodes(
    files: Iterable[Path], observations: tuple[Observation, ...], actions: int
) -> tuple[list[Episode], list[str]]:
    """All files that are GOOD or SUSPECT at present, and a line for each that is not."""
    files = list(files)
    try:
        judged = judge(files)
    except JudgementError as error:
        raise EpisodeError(files[0].parent, str(error)) from error
    episodes, left_out = [], []
    for path in files:
        if judged[path].verdict in ("GOOD", "SUSPECT"):
            episodes.append(read_episode(path, observations, actions))
        else:
            left_out.append(f"{path}: left out, {judged[path]}")
    return episodes, left_out


def read_episode(path: Path, observations: tuple[Observation, ...], actions: int) -> Episode:
    """One file, read whole with its checksums. `actions` is the length of an action."""
    try:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            records = {record.name: record.metadata for record in reader.iter_metadata()}
            facts, summary = records.get("rapid", {}), records.get("rapid/summary", {})
            streams = _streams(path, facts)
            wanted = {o.modality: streams[o.modality] for o in observations if o.modality in streams}
            for o in observations:
                if o.modality not in wanted:
                    raise EpisodeError(path, f"no modality {o.modality!r}; it has {', '.join(sorted(streams))}")
            topics = [FRAMES, ACTIONS, *(s["topic"] for s in wanted.values())]
            decoder = _Decoder(path)
            messages: dict[str, list[_Message]] = defaultdict(list)
            for schema, channel, message in reader.iter_messages(topics=topics, log_time_order=False):
                decoded = decoder.decode(schema, message.data)
                messages[channel.topic].append(_Message(message.log_time, message.sequence, schema.name, decoded))
    except EpisodeError:
        raise
    # Damage is found in the container, the compression, a schema or a message: each has its own errors.
    except Exception as error:
        raise EpisodeError(path, f"not a whole episode: {error}") from error
    return _assemble(path, facts, summary, wanted, observations, actions, messages)


@dataclass(frozen=True)
class _Message:
    time: int
    sequence: int
    schema: str
    body: Any


def _streams(path: Path, facts: dict[str, str]) -> dict[str, dict[str, Any]]:
    """The registered modalities by name, as the file's own metadata lists them."""
    try:
        return {entry["name"]: entry for entry in json.loads(facts["modalities"])}
    except KeyError as error:
        raise EpisodeError(path, f"metadata record `rapid` without key {error}: not an episode of rapid") from error
    except (TypeError, ValueError) as error:
        raise EpisodeError(path, f"metadata record `rapid`, key `modalities`: {error}") from error


class _Decoder:
    """Decodes messages by the schemas in the file itself."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._classes: dict[str, Any] = {}

    def decode(self, schema: Any, data: bytes) -> Any:
        if schema is None or schema.encoding != "protobuf":
            raise EpisodeError(self._path, f"a channel is not protobuf but {schema and schema.encoding!r}")
        if schema.name not in self._classes:
            pool = descriptor_pool.DescriptorPool()
            for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                pool.Add(file)
            self._classes[schema.name] = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
        return self._classes[schema.name].FromString(data)


def _assemble(
    path: Path,
    facts: dict[str, str],
    summary: dict[str, str],
    streams: dict[str, dict[str, Any]],
    observations: tuple[Observation, ...],
    actions: int,
    messages: dict[str, list[_Message]],
) -> Episode:
    frames = messages[FRAMES]
    if not frames:
        raise EpisodeError(path, f"no frame index: nothing on {FRAMES}")
    values, present, references = {}, {}, {}
    for o in observations:
        stream = streams[o.modality]
        chosen = _chosen(stream, frames, messages[stream["topic"]])
        present[o.modality] = np.array([m is not None for m in chosen])
        read = _picture if o.kind == "image" else _vector
        rows = [None if m is None else read(path, o, m) for m in chosen]
        shape = (*o.shape[1:], o.shape[0]) if o.kind == "image" else o.shape
        blank = np.zeros(shape, np.uint8 if o.kind == "image" else np.float64)
        values[o.modality] = np.stack([blank if row is None else row for row in rows])
        if o.kind == "image":
            references[o.modality] = next((row for row in rows if row is not None), blank)
    acts, acted = _actions(path, facts, frames, messages[ACTIONS], actions)
    return Episode(
        path=path,
        ticks=np.array([m.body.index for m in frames], np.int64),
        times=np.array([m.time for m in frames], np.int64),
        values=values,
        present=present,
        references=references,
        actions=acts,
        acted=acted,
        facts=facts,
        summary=summary,
        tags=json.loads(facts.get("tags") or "{}"),
    )


def _chosen(stream: dict[str, Any], frames: list[_Message], samples: list[_Message]) -> list[_Message | None]:
    """The sample of the modality at each tick; none if its bit is clear or the tick has no usable one."""
    by_sequence: dict[int, list[_Message]] = defaultdict(list)
    for sample in samples:
        by_sequence[sample.sequence].append(sample)
    bit, latency, hold = stream["bit"], stream["latency_ns"], stream["when_stale"] == "hold"
    chosen: list[_Message | None] = []
    for frame in frames:
        slot = next((s for s in frame.body.modalities if s.bit == bit), None)
        usable = slot is not None and slot.present and slot.HasField("seq") and (slot.valid or (slot.stale and hold))
        if not usable:
            chosen.append(None)
            continue
        # After a replug a device may count from the beginning again: of several with one number the nearest is used.
        captured = frame.time - slot.age_ns + latency
        candidates = by_sequence[slot.seq & SEQUENCE_BITS]
        chosen.append(min(candidates, key=lambda m: abs(m.time - captured), default=None))
    return chosen


def _picture(path: Path, o: Observation, message: _Message) -> NDArray[np.uint8]:
    """u8 [H, W, 3], red first."""
    if message.schema != "foxglove.CompressedImage":
        raise EpisodeError(path, f"{o.modality}: pictures of {message.schema} are not read, only compressed ones")
    try:
        picture = np.array(Image.open(io.BytesIO(message.body.data)).convert("RGB"))
    except OSError as error:
        raise EpisodeError(path, f"{o.modality}: picture {message.sequence}: {error}") from error
    if picture.shape != (*o.shape[1:], 3):
        got, want = picture.shape, o.shape
        raise EpisodeError(path, f"{o.modality}: a picture of {got[1]}x{got[0]}, the policy takes {want[2]}x{want[1]}")
    return picture


def _vector(path: Path, o: Observation, message: _Message) -> NDArray[np.float64]:
    """f64 [D]"""
    return _numbers(path, o.modality, message, o.shape[0])


def _numbers(path: Path, what: str, message: _Message, length: int) -> NDArray[np.float64]:
    if message.schema != "rapid.Scalars":
        raise EpisodeError(path, f"{what}: messages of {message.schema}, expected rapid.Scalars")
    values = np.array(message.body.values, np.float64)
    if values.shape != (length,):
        raise EpisodeError(path, f"{what}: {len(values)} numbers, expected {length}")
    if not np.isfinite(values).all():
        raise EpisodeError(path, f"{what}: a number that is not finite in message {message.sequence}")
    return values


def _actions(
    path: Path, facts: dict[str, str], frames: list[_Message], messages: list[_Message], length: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """[T, Da] and [T]: an action belongs to the tick with its time."""
    if not messages:
        raise EpisodeError(path, f"no action: nothing on {ACTIONS}")
    times = np.array([m.time for m in frames])
    half_period = 0.5e9 / float(facts["observation_hz"])
    actions, acted = np.zeros((len(frames), length)), np.zeros(len(frames), bool)
    for message in messages:
        tick = int(np.abs(times - message.time).argmin())
        if abs(int(times[tick]) - message.time) < half_period:
            actions[tick], acted[tick] = _numbers(path, ACTIONS, message, length), True
    return actions, acted
