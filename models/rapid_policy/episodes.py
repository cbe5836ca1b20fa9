"""Reads recorded episodes: the samples of each tick of the frame index, and the action taken at it.

The frame index of a file (`/rapid/frame`) names the sample of every modality at every tick by its sequence number, and
the mask in force. What is read here is therefore what a policy would have been given, not the nearest sample by a rule
of our own. `dataset` knows what the numbers mean for a policy.
"""

from __future__ import annotations

import json
import tomllib
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from numpy.typing import NDArray

from . import lerobot_source
from .classification import Classification
from .experiment import Experiment
from .lerobot_source import DatasetError, MissingPackage
from .pixels import FormatError, PixelError, decode, fit

FRAMES = "/rapid/frame"
ACTIONS = "/action"
# Why a tick has no sample of a modality: its device is unplugged, or the rig has none; its driver is not running; or it runs
# but sends nothing usable.
ABSENCES = ("unplug", "crash", "stall")
# A message names its sample by the lower half of the 64-bit sequence number.
SEQUENCE_BITS = 0xFFFF_FFFF


class EpisodeError(Exception):
    """A file that cannot be used for training; names it and the reason."""

    def __init__(self, path: Path, what: str) -> None:
        super().__init__(f"{path}: {what}")
        self.what = what


@dataclass(frozen=True)
class Source:
    """A modality as it is read: pictures of one size, or all numbers of a vector."""

    modality: str
    kind: str
    """`image` or `vector`."""
    required: bool = True
    """Whether an episode whose rig has no such modality is of no use."""
    size: tuple[int, int] | None = None
    resize: tuple[int, int] | None = None
    crop: tuple[int, int] | None = None

    @property
    def name(self) -> str:
        """The name of its arrays in an episode."""
        parts = [self.modality]
        parts += [f"resize {self.resize[0]}x{self.resize[1]}"] if self.resize else []
        parts += [f"crop {self.crop[0]}x{self.crop[1]}"] if self.crop else []
        return " ".join(parts)


def picture_source(o: Any) -> Source:
    """Where the pictures of an observation come from."""
    return Source(o.modality, "image", o.required, o.size, o.resize, o.crop)


def sources(spec: Experiment | Classification) -> tuple[Source, ...]:
    """All that an experiment reads from an episode, each source once."""
    wanted = [picture_source(o) for o in spec.images]
    wanted += [Source(name, "vector") for name in spec.numbers]
    return tuple({source.name: source for source in wanted}.values())


@dataclass
class Facts:
    """What training uses of an episode's metadata."""

    software: str = ""
    task: str = ""
    observation_hz: float | None = None
    tags: dict[str, str] = field(default_factory=dict)
    modules: list[str] = field(default_factory=list)
    layouts: dict[str, str] = field(default_factory=dict)
    """By modality: the layout of its pose, as the registry has it."""
    notes: list[str] = field(default_factory=list)
    """Faulty samples that were found and treated as absent."""


@dataclass
class Episode:
    """One episode, a row for each of its T ticks. Rows that are not present are zeros."""

    path: Path
    facts: Facts
    arrays: Mapping[str, NDArray[Any]]
    """`ticks` i64 [T], number in the frame index; `times` i64 [T], ns of the wall clock; `actions` f64 [T, Da] and `acted`
    bool [T]; for each source `value NAME`, pictures u8 [T, H, W, 3] (red first) or vectors f64 [T, D], `present NAME`
    bool [T], `plugged NAME` and `running NAME` bool [T], and for pictures `first NAME` i64 [1], the row of the first one or
    -1."""
    sha256: str = ""
    """Of the file."""

    @property
    def ticks(self) -> NDArray[np.int64]:
        """[T]"""
        return self.arrays["ticks"]

    @property
    def actions(self) -> NDArray[np.float64]:
        """[T, Da]"""
        return self.arrays["actions"]

    @property
    def acted(self) -> NDArray[np.bool_]:
        """[T] whether an action was taken at the tick."""
        return self.arrays["acted"]

    def value(self, name: str) -> NDArray[Any]:
        """[T, ...] the samples of a source."""
        return self.arrays[f"value {name}"]

    def present(self, name: str) -> NDArray[np.bool_]:
        """[T] whether the bit of a source is set in the mask, and the tick has a sample of it."""
        return self.arrays[f"present {name}"]

    def absent(self, name: str, reason: str) -> NDArray[np.bool_]:
        """[T] whether a source is not present for this one of `ABSENCES`."""
        plugged, running = self.arrays[f"plugged {name}"], self.arrays[f"running {name}"]
        reasons = {"unplug": ~plugged, "crash": plugged & ~running, "stall": plugged & running}
        return ~self.present(name) & reasons[reason]

    def first(self, name: str) -> int:
        """The row of the first picture of a source; -1 if there is none."""
        return int(self.arrays[f"first {name}"][0])

    def __len__(self) -> int:
        return len(self.ticks)


def episode_files(folder: Path) -> list[Path]:
    """The finished episodes of a folder, by name; for a LeRobot dataset, those in its files."""
    if lerobot_source.is_dataset(folder):
        try:
            files = lerobot_source.episode_names(folder)
        except (DatasetError, OSError, ValueError, KeyError) as error:
            raise EpisodeError(folder, f"not a dataset that is read: {error}") from error
    else:
        files = sorted(folder.glob("*.mcap"))
    if not files:
        raise EpisodeError(folder, "no episode (*.mcap) in this folder")
    return files


def read_facts(path: Path) -> Facts:
    """The metadata of a file, without its samples."""
    try:
        if lerobot_source.split(path)[1] is not None:
            return Facts(software="LeRobot", observation_hz=lerobot_source.rate(path))
        with path.open("rb") as file:
            records = {record.name: record.metadata for record in make_reader(file).iter_metadata()}
    except Exception as error:
        raise EpisodeError(path, f"not a whole episode: {error}") from error
    return _facts(path, records.get("rapid", {}))


def _facts(path: Path, about: dict[str, str]) -> Facts:
    try:
        devices = tomllib.loads(about.get("registry") or "").get("device", {})
        poses = {name: entry["pose"] for name, entry in devices.items() if isinstance(entry.get("pose"), dict)}
        return Facts(
            software=about.get("software", ""),
            task=about.get("task", ""),
            observation_hz=float(about["observation_hz"]) if "observation_hz" in about else None,
            tags=json.loads(about.get("tags") or "{}"),
            modules=json.loads(about.get("configuration") or "{}").get("modules", []),
            layouts={name: pose["layout"] for name, pose in poses.items() if "layout" in pose},
        )
    except (ValueError, TypeError, AttributeError, KeyError) as error:
        raise EpisodeError(path, f"metadata record `rapid`: {error}") from error


def read_episode(path: Path, wanted: tuple[Source, ...]) -> Episode:
    """Reads one file completely, and verifies its checksums."""
    if lerobot_source.split(path)[1] is not None:
        return _read_rows(path, wanted)
    try:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            records = {record.name: record.metadata for record in reader.iter_metadata()}
            facts = _facts(path, records.get("rapid", {}))
            streams = _streams(path, records.get("rapid", {}))
            for source in wanted:
                if source.required and source.modality not in streams:
                    raise EpisodeError(path, f"no modality {source.modality!r}; it has {', '.join(sorted(streams))}")
            topics = {streams[s.modality]["topic"] for s in wanted if s.modality in streams}
            decoder = _Decoder(path)
            messages: dict[str, list[_Message]] = defaultdict(list)
            for schema, channel, message in reader.iter_messages(
                topics=[FRAMES, ACTIONS, *topics], log_time_order=False
            ):
                decoded = decoder.decode(schema, message.data)
                messages[channel.topic].append(_Message(message.log_time, message.sequence, schema.name, decoded))
    except EpisodeError:
        raise
    # Damage shows in the container, the compression, a schema or a message, each with errors of its own.
    except Exception as error:
        raise EpisodeError(path, f"not a whole episode: {error}") from error
    return _assemble(path, facts, streams, wanted, messages)


def _read_rows(path: Path, wanted: tuple[Source, ...]) -> Episode:
    """An episode of a LeRobot dataset."""
    try:
        facts, rows = read_facts(path), lerobot_source.tables(path)
        count = len(rows["frame_index"])
        actions = rows.get("action", np.zeros((count, 0))).astype(np.float64)
        acted = np.isfinite(actions).all(1) & ("action" in rows)
        arrays: dict[str, NDArray[Any]] = {
            "ticks": rows["frame_index"].ravel().astype(np.int64),
            "times": (rows["timestamp"].ravel() * 1e9).astype(np.int64),
            "actions": np.where(acted[:, None], actions, 0.0),
            "acted": acted,
        }
        for source in wanted:
            found = _of_pictures(path, source, rows) if source.kind == "image" else _of_numbers(path, source, rows)
            found |= lerobot_source.presence(rows, source.modality, count)
            arrays |= {f"{what} {source.name}": array for what, array in found.items()}
    except (EpisodeError, MissingPackage):
        raise
    # A damaged file fails in the container, the compression or a column, each with errors of its own, some of several lines.
    except Exception as error:
        raise EpisodeError(path, f"not an episode that is read: {' '.join(str(error).split())}") from error
    return Episode(path, facts, arrays)


def _of_pictures(path: Path, source: Source, rows: dict[str, Any]) -> dict[str, NDArray[Any]]:
    found = lerobot_source.pictures(rows, source.modality)
    if found is None and source.required:
        raise EpisodeError(path, f"no feature 'observation.images.{source.modality}'")
    found = [None] * len(rows["frame_index"]) if found is None else found
    return _stacked(source, [None if p is None else _fitted(path, source, p) for p in found])


def _of_numbers(path: Path, source: Source, rows: dict[str, Any]) -> dict[str, NDArray[Any]]:
    found = lerobot_source.numbers(rows, source.modality)
    if found is None:
        what = f"no columns '{source.modality}.0' ... of observation.state and no 'observation.{source.modality}'"
        raise EpisodeError(path, what)
    values, present = found
    present = present & np.isfinite(values).all(1)
    return {"value": np.where(present[:, None], values, 0.0), "present": present}


@dataclass(frozen=True)
class _Message:
    time: int
    sequence: int
    schema: str
    body: Any


def _streams(path: Path, about: dict[str, str]) -> dict[str, dict[str, Any]]:
    """The registered modalities by name, as the file's own metadata lists them."""
    try:
        return {entry["name"]: entry for entry in json.loads(about["modalities"])}
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
    facts: Facts,
    streams: dict[str, dict[str, Any]],
    wanted: tuple[Source, ...],
    messages: dict[str, list[_Message]],
) -> Episode:
    frames = messages[FRAMES]
    if not frames:
        raise EpisodeError(path, f"no frame index: nothing on {FRAMES}")
    arrays: dict[str, NDArray[Any]] = {
        "ticks": np.array([m.body.index for m in frames], np.int64),
        "times": np.array([m.time for m in frames], np.int64),
    }
    for source in wanted:
        stream = streams.get(source.modality)
        chosen = _chosen(stream, frames, messages[stream["topic"]]) if stream else [None] * len(frames)
        read = _pictures if source.kind == "image" else _vectors
        found = read(path, source, chosen, facts.notes) | _presence(stream, frames)
        arrays |= {f"{what} {source.name}": array for what, array in found.items()}
    arrays["actions"], arrays["acted"] = _actions(path, facts, frames, messages[ACTIONS])
    return Episode(path, facts, arrays)


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
        # After a replug a device may count from the beginning again: of several samples with the same number the nearest is used.
        captured = frame.time - slot.age_ns + latency
        candidates = by_sequence[slot.seq & SEQUENCE_BITS]
        chosen.append(min(candidates, key=lambda m: abs(m.time - captured), default=None))
    return chosen


def _presence(stream: dict[str, Any] | None, frames: list[_Message]) -> dict[str, NDArray[np.bool_]]:
    """[T] whether the device of a modality is plugged in, and whether its bit is set."""
    slots = [next((s for s in m.body.modalities if stream and s.bit == stream["bit"]), None) for m in frames]
    running = np.array([slot is not None and slot.present for slot in slots], bool)
    # Files of earlier versions lack it: what runs is plugged in; about the rest nothing is known.
    plugged = np.array([getattr(slot, "plugged", False) for slot in slots], bool)
    return {"plugged": plugged | running, "running": running}


def _pictures(path: Path, source: Source, chosen: list[_Message | None], notes: list[str]) -> dict[str, NDArray[Any]]:
    """A damaged picture counts as absent, as it does while a policy runs; one of another size is an error."""
    rows: list[NDArray[np.uint8] | None] = []
    damaged = 0
    for message in chosen:
        try:
            rows.append(None if message is None else _picture(path, source, message))
        except PixelError:
            rows.append(None)
            damaged += 1
    if damaged:
        notes.append(f"{source.modality}: {damaged} damaged pictures, taken as absent")
    return _stacked(source, rows)


def _stacked(source: Source, rows: list[NDArray[np.uint8] | None]) -> dict[str, NDArray[Any]]:
    """The arrays of pictures, some of which may be absent."""
    present = np.array([row is not None for row in rows])
    shape = source.crop or source.resize or source.size or (0, 0)
    values = np.zeros((len(rows), *shape, 3), np.uint8)
    for row, pixels in zip(values, rows, strict=True):
        if pixels is not None:
            row[:] = pixels
    first = int(present.argmax()) if present.any() else -1
    return {"value": values, "present": present, "first": np.array([first], np.int64)}


def _picture(path: Path, source: Source, message: _Message) -> NDArray[np.uint8]:
    try:
        pixels = decode(message.schema, message.body)
    except FormatError as error:
        raise EpisodeError(path, f"{source.modality}: {error}") from error
    return _fitted(path, source, pixels)


def _fitted(path: Path, source: Source, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The picture at the size that the policy takes."""
    fitted = fit(pixels, source.resize, source.crop)
    wanted = source.crop or source.resize or source.size or pixels.shape[:2]
    if fitted is None or fitted.shape[:2] != wanted:
        got = f"{source.modality}: a picture of {pixels.shape[1]}x{pixels.shape[0]}"
        raise EpisodeError(path, f"{got}, the policy takes {wanted[1]}x{wanted[0]}: add resize to the observation")
    return fitted


def _vectors(path: Path, source: Source, chosen: list[_Message | None], notes: list[str]) -> dict[str, NDArray[Any]]:
    """A sample with a number that is not finite counts as absent."""
    rows = [None if m is None else _numbers(path, source.modality, m) for m in chosen]
    length = next((len(row) for row in rows if row is not None), 0)
    values, present = np.zeros((len(rows), length)), np.zeros(len(rows), bool)
    odd = 0
    for i, row in enumerate(rows):
        if row is None:
            continue
        if len(row) != length:
            raise EpisodeError(path, f"{source.modality}: {len(row)} numbers after samples of {length}")
        present[i] = np.isfinite(row).all()
        odd += not present[i]
        values[i] = row if present[i] else 0.0
    if odd:
        notes.append(f"{source.modality}: {odd} samples with a number that is not finite, taken as absent")
    return {"value": values, "present": present}


def _numbers(path: Path, what: str, message: _Message) -> NDArray[np.float64]:
    if message.schema != "rapid.Scalars":
        raise EpisodeError(path, f"{what}: messages of {message.schema}, expected rapid.Scalars")
    return np.array(message.body.values, np.float64)


def _actions(
    path: Path, facts: Facts, frames: list[_Message], messages: list[_Message]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """[T, Da] actions, and [T] whether there is one: each belongs to the tick at its time. Da is 0 if there are none."""
    times = np.array([m.time for m in frames])
    rows = [_numbers(path, ACTIONS, m) for m in messages]
    length = len(rows[0]) if rows else 0
    actions, acted = np.zeros((len(frames), length)), np.zeros(len(frames), bool)
    if not rows:
        return actions, acted
    if facts.observation_hz is None:
        raise EpisodeError(path, "metadata record `rapid` without key 'observation_hz': not an episode of rapid")
    half_period = 0.5e9 / facts.observation_hz
    for message, row in zip(messages, rows, strict=True):
        if len(row) != length:
            raise EpisodeError(path, f"{ACTIONS}: {len(row)} numbers after actions of {length}")
        tick = int(np.abs(times - message.time).argmin())
        if abs(int(times[tick]) - message.time) < half_period and np.isfinite(row).all():
            actions[tick], acted[tick] = row, True
    return actions, acted
