"""Decoded episodes on disk, so that training reads pixels and decodes nothing.

    python -m rapid_policy.cache build  EXPERIMENT.toml --cache DIR [--data FOLDER...]
    python -m rapid_policy.cache verify EXPERIMENT.toml --cache DIR [--data FOLDER...]
    python -m rapid_policy.cache bench  EXPERIMENT.toml --cache DIR [--data FOLDER...]

Below DIR is a folder for each set of modalities and sizes that an experiment reads. In it is a file for each episode,
named by the SHA-256 of its source, with the arrays of `Episode` one after the other; and `index.jsonl`, where the last
line about a source counts. A file gets its name when it is complete, and lines are appended whole: an interrupted
run leaves what it finished. A source whose size or modification time differs is hashed again.

What is known of an episode is read from the index when it is needed; memory holds only where its line begins.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from .episodes import Episode, EpisodeError, Facts, Source, read_episode, read_facts
from .lerobot_source import description, files, split

MAGIC = b"RAPIDCACHE2\n"
ALIGN = 64
INDEX = "index.jsonl"
# Maps that are open at a time; each costs address space, a file descriptor (of 1024 by default) but no memory.
OPEN = 512
# Sources that are queued for each process that decodes.
QUEUED = 4


@dataclass
class Entry:
    """What is known of a source."""

    path: str
    size: int
    changed_ns: int
    sha256: str
    error: str | None = None
    """Why it cannot be read, if it cannot."""
    facts: dict[str, Any] = field(default_factory=dict)
    content: str | None = None
    """SHA-256 of its decoded file; none before it is decoded."""
    verdict: str | None = None
    reasons: tuple[str, ...] = ()
    judged_by: str | None = None
    """The program that gave the verdict; none before it is judged."""
    described: str = ""
    """The hash of its description in a LeRobot dataset; empty for a file of its own."""


class Cache:
    """The cache of one set of sources."""

    def __init__(self, folder: Path, wanted: tuple[Source, ...]) -> None:
        described = [asdict(source) for source in sorted(wanted, key=lambda s: s.name)]
        recipe = hashlib.sha256(json.dumps([MAGIC.decode(), described]).encode()).hexdigest()
        self.folder, self.wanted = folder / recipe[:16], wanted
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "sources.json").write_text(json.dumps(described, indent=2) + "\n", encoding="utf-8")
        self._index = self.folder / INDEX
        # Where the last line about each source begins.
        self._lines = dict(_read_index(self._index))

    def entry(self, path: Path) -> Entry:
        """What is known of a file as it is now; read from the disk if it has changed."""
        state = _state(path)
        known = self._known(str(path))
        if known and state.items() <= asdict(known).items():
            return known
        digest = sha256(path)
        entry = Entry(str(path), sha256=digest, **state)
        if known and known.sha256 == digest:
            entry = replace(known, **state)
        else:
            try:
                entry.facts = asdict(read_facts(path))
            except EpisodeError as error:
                entry.error = error.what
        self.record(entry)
        return entry

    def record(self, entry: Entry) -> None:
        """Writes a line about a source."""
        line = (json.dumps(asdict(entry)) + "\n").encode()
        with self._index.open("ab", buffering=0) as file:
            file.write(line)
            # Another process may have written before it.
            self._lines[entry.path] = file.tell() - len(line)

    def _known(self, path: str) -> Entry | None:
        at = self._lines.get(path)
        return None if at is None else _read_line(self._index, at)

    def build(self, entries: Iterable[Entry], workers: int) -> None:
        """Decodes those that are not decoded yet; one that cannot be decoded gets its reason."""
        missing = [e.path for e in entries if e.error is None and not self._whole(e)]
        if not missing:
            return
        progress = tqdm(total=len(missing), desc="decoding", unit="episode", disable=not sys.stderr.isatty())
        with progress:
            for entry, made in self._make(missing, workers):
                changed = {"error": made.get("error"), "content": made.get("content")}
                self.record(Entry(**{**asdict(entry), **changed, "facts": made.get("facts", entry.facts)}))
                progress.update()

    def _make(self, missing: list[str], workers: int) -> Iterator[tuple[Entry, dict[str, Any]]]:
        jobs = ((entry, self.file(entry.sha256)) for entry in map(self._known, missing))
        if workers <= 1 or len(missing) == 1:
            yield from ((entry, _decode(entry.path, entry.sha256, self.wanted, file)) for entry, file in jobs)
            return
        running: dict[Future[dict[str, Any]], Entry] = {}
        # Not forked: a fork of a process with threads may hang.
        with ProcessPoolExecutor(min(workers, len(missing)), mp_context=get_context("spawn")) as pool:
            try:
                for entry, file in jobs:
                    running[pool.submit(_decode, entry.path, entry.sha256, self.wanted, file)] = entry
                    if len(running) == QUEUED * workers:
                        yield from _finished(running)
                while running:
                    yield from _finished(running)
            finally:
                pool.shutdown(wait=True, cancel_futures=True)

    def _whole(self, entry: Entry) -> bool:
        """Whether its file is there, with the right source and length. Only `verify` reads the contents."""
        file = self.file(entry.sha256)
        if entry.content is None or not file.exists():
            return False
        try:
            header, begin = _header(file)
            return header["sha256"] == entry.sha256 and file.stat().st_size == begin + header["length"]
        except (OSError, ValueError, KeyError):
            return False

    def file(self, digest: str) -> Path:
        """The decoded file of an episode."""
        return _file(self.folder, digest)

    def episode(self, entry: Entry) -> Episode:
        """A decoded episode; its arrays are mapped when they are read."""
        return _episode(self.folder, entry)

    def episodes(self, paths: Iterable[str]) -> Decoded:
        """Decoded episodes as they are now."""
        return Decoded(self.folder, np.fromiter((self._lines[path] for path in paths), np.int64))

    def verify(self, entries: Iterable[Entry]) -> list[str]:
        """Hashes every source and every decoded file. Returns a line for each that differs from the index.

        A decoded file that is damaged is removed, so that the next run makes it again.
        """
        wrong = []
        _hashed.cache_clear()
        for entry in entries:
            file = self.file(entry.sha256)
            if sha256(Path(entry.path)) != entry.sha256:
                wrong.append(f"{entry.path}: changed without a new time of change")
                self.record(replace(entry, changed_ns=0))
            elif entry.content is not None and (not file.exists() or sha256(file) != entry.content):
                wrong.append(f"{file}: damaged; removed")
                file.unlink(missing_ok=True)
        return wrong


class Decoded(Sequence[Episode]):
    """Episodes of a cache, each read from its line of the index when it is asked for."""

    def __init__(self, folder: Path, lines: NDArray[np.int64]) -> None:
        self._folder, self._lines = folder, lines
        self._episode = functools.lru_cache(maxsize=OPEN)(lambda at: _episode(folder, _read_line(folder / INDEX, at)))

    def __getitem__(self, row: int) -> Episode:
        return self._episode(int(self._lines[row]))

    def __len__(self) -> int:
        return len(self._lines)

    def part(self, rows: Sequence[int]) -> Decoded:
        """Some of them."""
        return Decoded(self._folder, self._lines[rows])


class Mapped(Mapping[str, NDArray[Any]]):
    """The arrays of a file, mapped into memory; few maps are open at a time."""

    __slots__ = ("file",)

    def __init__(self, file: Path) -> None:
        self.file = file

    def __getitem__(self, name: str) -> NDArray[Any]:
        return _mapped(self.file)[name]

    def __iter__(self) -> Iterator[str]:
        return iter(_mapped(self.file))

    def __len__(self) -> int:
        return len(_mapped(self.file))


@functools.lru_cache(maxsize=OPEN)
def _mapped(file: Path) -> dict[str, NDArray[Any]]:
    header, begin = _header(file)
    # As a plain array: each slice of a memmap costs as much again. It keeps the map alive.
    whole = np.memmap(file, np.uint8, "r", begin, header["length"]).view(np.ndarray)
    arrays = {}
    for name, (kind, shape, at) in header["arrays"].items():
        length = int(np.prod(shape)) * np.dtype(kind).itemsize
        arrays[name] = whole[at : at + length].view(kind).reshape(shape)
    return arrays


def _header(file: Path) -> tuple[dict[str, Any], int]:
    """Its description, and where the arrays begin."""
    with file.open("rb") as opened:
        start = opened.read(len(MAGIC) + 8)
        if start[: len(MAGIC)] != MAGIC:
            raise ValueError(f"{file}: not a file of this cache")
        length = int.from_bytes(start[len(MAGIC) :], "little")
        return json.loads(opened.read(length)), _padded(len(start) + length)


def _padded(length: int) -> int:
    return -(-length // ALIGN) * ALIGN


def write(file: Path, episode: Episode) -> str:
    """Writes an episode; the file gets its name when it is complete. Returns the SHA-256 of the file."""
    described, at = {}, 0
    arrays = {name: np.ascontiguousarray(array) for name, array in episode.arrays.items()}
    for name, array in arrays.items():
        described[name] = (array.dtype.str, array.shape, at)
        at = _padded(at + array.nbytes)
    header = json.dumps({"sha256": episode.sha256, "length": at, "arrays": described}).encode()
    partial = file.with_suffix(f".partial-{os.getpid()}")
    digest = hashlib.sha256()
    try:
        with partial.open("wb") as opened:
            for part in (MAGIC, len(header).to_bytes(8, "little"), header, *arrays.values()):
                # Before each array, and after the last one, zeros up to the next multiple.
                pad = b"\0" * (_padded(opened.tell()) - opened.tell()) if isinstance(part, np.ndarray) else b""
                for data in (pad, part.data.cast("B") if isinstance(part, np.ndarray) and part.size else bytes(part)):
                    opened.write(data)
                    digest.update(data)
            pad = b"\0" * (_padded(opened.tell()) - opened.tell())
            opened.write(pad)
            digest.update(pad)
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)
    return digest.hexdigest()


def _decode(path: str, digest: str, wanted: tuple[Source, ...], file: Path) -> dict[str, Any]:
    """Decodes one source, in a process of its own: its facts and the hash of its file, or the reason why it cannot be decoded."""
    try:
        episode = read_episode(Path(path), wanted)
        episode.sha256 = digest
        return {"content": write(file, episode), "facts": asdict(episode.facts)}
    except EpisodeError as error:
        return {"error": error.what}


def _file(folder: Path, digest: str) -> Path:
    return folder / f"{digest}.episode"


def _episode(folder: Path, entry: Entry) -> Episode:
    return Episode(Path(entry.path), Facts(**entry.facts), Mapped(_file(folder, entry.sha256)), entry.sha256)


def _finished(running: dict[Future[dict[str, Any]], Entry]) -> list[tuple[Entry, dict[str, Any]]]:
    """Removes those that are done, at least one, and returns them."""
    return [(running.pop(done), done.result()) for done in wait(running, return_when=FIRST_COMPLETED).done]


def _read_index(file: Path) -> Iterator[tuple[str, int]]:
    """The source that each whole line is about, and where the line begins."""
    if not file.exists():
        return
    at = 0
    with file.open("rb") as opened:
        for line in opened:
            try:
                yield _entry(line).path, at
            except (ValueError, TypeError, KeyError):
                # A line that a full disk or a power cut shortened; its source is read again.
                pass
            at += len(line)


def _read_line(file: Path, at: int) -> Entry:
    with file.open("rb") as opened:
        opened.seek(at)
        return _entry(opened.readline())


def _entry(line: bytes) -> Entry:
    known = json.loads(line)
    return Entry(**{**known, "reasons": tuple(known["reasons"])})


def sha256(path: Path) -> str:
    """The hash of a file, in hexadecimal; for an episode of a LeRobot dataset, that of its files and of which part of
    them it is."""
    if split(path)[1] is None:
        return _hashed(path, *_stat(path))
    digests = [_hashed(file, *_stat(file)) for file in files(path)]
    return hashlib.sha256(json.dumps([digests, str(split(path)[1]), description(path)]).encode()).hexdigest()


@functools.lru_cache(maxsize=64)
def _hashed(file: Path, _size: int, _changed_ns: int) -> str:
    """The hash of one file, as it is now; kept, because each file of a dataset has many episodes."""
    if not file.exists():
        return ""
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _state(path: Path) -> dict[str, Any]:
    """What shows an entry that its source has changed."""
    if split(path)[1] is None:
        size, changed_ns = _stat(path)
        return {"size": size, "changed_ns": changed_ns}
    stats = [_stat(file) for file in files(path)]
    size, changed_ns = sum(size for size, _ in stats), max(changed_ns for _, changed_ns in stats)
    return {"size": size, "changed_ns": changed_ns, "described": description(path)}


def _stat(file: Path) -> tuple[int, int]:
    """Its size and modification time. A missing file is treated as an empty one: the episode's reason names it."""
    try:
        stat = file.stat()
    except FileNotFoundError:
        return 0, 0
    return stat.st_size, stat.st_mtime_ns


if __name__ == "__main__":
    from .cache_commands import main

    main()
