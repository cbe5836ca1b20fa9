"""The episodes of an experiment: found, judged, filtered, decoded, and divided into those learned from and those held out.

An episode that is damaged or of no use is left out with its reason, and does not end a run unless none remains.
"""

from __future__ import annotations

import hashlib
import itertools
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from .cache import Cache, Entry
from .classification import Classification
from .episodes import ABSENCES, Episode, EpisodeError, Facts, episode_files, picture_source, sources
from .experiment import Data, Experiment
from .judgement import AT_ONCE, JudgementError, judge, program
from .lerobot_source import MissingPackage, split
from .rows import unfit

SHOWN = 20


@dataclass
class Corpus:
    """The episodes of an experiment."""

    training: Sequence[Episode]
    held_out: Sequence[Episode]
    left_out: list[str]
    """A line for each file that is of no use, with the reason."""
    unwanted: int
    """How many files the filters of the experiment leave out."""
    folder: Path
    """Where in the cache these are decoded."""

    absences: dict[str, int] = field(default_factory=dict)
    """How many rows lack a picture that is not required, by reason."""

    def report(self) -> str:
        """For people."""
        lines = [*self.left_out[:SHOWN]]
        if len(self.left_out) > SHOWN:
            lines.append(f"and {len(self.left_out) - SHOWN} more")
        first = itertools.islice(itertools.chain(self.training, self.held_out), SHOWN)
        lines += [f"{e.path}: note: {note}" for e in first for note in e.facts.notes]
        if any(self.absences.values()):
            found = ", ".join(f"{count} by {reason}" for reason, count in self.absences.items() if count)
            lines.append(f"rows without a picture: {found}")
        counts = f"{len(self.training)} episodes to learn from, {len(self.held_out)} held out"
        return "\n".join([*lines, f"{counts}, {len(self.left_out)} left out, {self.unwanted} not asked for"])


def load(spec: Experiment | Classification, folders: Sequence[Path], cache_folder: Path, workers: int = 1) -> Corpus:
    """The episodes in `folders`, decoded into the cache by `workers` processes."""
    files = [str(file.absolute()) for folder in folders for file in episode_files(folder)]
    cache = Cache(cache_folder, sources(spec))
    _judge(cache, files)
    left_out, wanted, unwanted = [], [], 0
    for file in files:
        entry = cache.entry(Path(file))
        if entry.verdict not in spec.data.verdict:
            left_out.append(f"{entry.path}: left out, {entry.verdict or 'no verdict'}: {'; '.join(entry.reasons)}")
        elif entry.error is None and not matches(spec.data, Facts(**entry.facts)):
            unwanted += 1
        else:
            wanted.append(file)
    try:
        cache.build(_entries(cache, wanted), workers)
    except MissingPackage as error:
        raise EpisodeError(folders[0], str(error)) from error
    fit = []
    for file in wanted:
        entry = cache.entry(Path(file))
        reason = _unfit(spec, cache.episode(entry)) if entry.error is None else entry.error
        if entry.error is not None or reason:
            left_out.append(f"{entry.path}: left out, {reason}")
        else:
            fit.append(file)
    if not fit:
        found = f"{len(left_out)} left out, {unwanted} not asked for"
        first = f"; the first: {left_out[0]}" if left_out else ": check the filters in [data]"
        raise EpisodeError(folders[0], f"no episode that is fit to learn from: {found}{first}")
    episodes = cache.episodes(fit)
    training, held_out = (episodes.part(rows) for rows in divide(spec.data, episodes))
    return Corpus(training, held_out, left_out, unwanted, cache.folder, _absences(spec, episodes))


def _entries(cache: Cache, files: Iterable[str]) -> Iterator[Entry]:
    """One after the other: what is known of all of them is not kept in memory."""
    return (cache.entry(Path(file)) for file in files)


def _absences(spec: Experiment | Classification, episodes: Sequence[Episode]) -> dict[str, int]:
    names = [picture_source(o).name for o in spec.images if not o.required]
    counts = dict.fromkeys(ABSENCES, 0)
    for episode in episodes:
        for name, reason in itertools.product(names, ABSENCES):
            counts[reason] += int(episode.absent(name, reason).sum())
    return counts


def _unfit(spec: Experiment | Classification, episode: Episode) -> str | None:
    if isinstance(spec, Classification):
        return spec.unfit(episode.facts.tags)
    return unfit(spec, episode)


def _judge(cache: Cache, files: list[str]) -> None:
    """Asks for the verdict of `rapid inspect`, once for each content and version of the program. A LeRobot dataset has
    none: all of its episodes are taken."""
    recorded = []
    for file in files:
        if split(Path(file))[1] is None:
            recorded.append(file)
        elif (entry := cache.entry(Path(file))).verdict is None:
            cache.record(replace(entry, verdict="GOOD"))
    if not recorded:
        return
    try:
        asked = _version(program())
        unknown = [entry.path for entry in _entries(cache, recorded) if entry.judged_by != asked]
        for first in range(0, len(unknown), AT_ONCE):
            entries = list(_entries(cache, unknown[first : first + AT_ONCE]))
            judged = judge([Path(entry.path) for entry in entries])
            for entry in entries:
                found = judged[Path(entry.path)]
                cache.record(replace(entry, verdict=found.verdict, reasons=found.reasons, judged_by=asked))
    except JudgementError as error:
        raise EpisodeError(Path(recorded[0]).parent, str(error)) from error


def _version(rapid: str) -> str:
    """The program as a file: another build may judge differently."""
    stat = os.stat(rapid)
    return f"{rapid} {stat.st_size} {stat.st_mtime_ns}"


def matches(data: Data, facts: Facts) -> bool:
    """Whether the filters of the experiment accept an episode."""
    for tag, values in data.tags.items():
        if facts.tags.get(tag) not in ((values,) if isinstance(values, str) else values):
            return False
    if not set(data.modules) <= set(facts.modules) or (data.tasks and facts.task not in data.tasks):
        return False
    if data.seeds is None:
        return True
    seed = facts.tags.get("seed", "")
    return seed.isdigit() and data.seeds[0] <= int(seed) <= data.seeds[1]


def divide(data: Data, episodes: Sequence[Episode]) -> tuple[list[int], list[int]]:
    """Which are learned from and which are held out: by a hash, so that more episodes change nothing for the others."""
    if not data.validation:
        return list(range(len(episodes))), []
    places = [_place(data, episode) for episode in episodes]
    border = max(data.validation, min(places))
    training = [row for row, place in enumerate(places) if place > border]
    if not training:
        raise EpisodeError(episodes[0].path.parent, "all episodes are held out: record more, or write validation = 0")
    return training, [row for row, place in enumerate(places) if place <= border]


def _place(data: Data, episode: Episode) -> float:
    """A number from 0 to 1 that only the episode, or its seed, determines."""
    seed = episode.facts.tags.get("seed")
    what = f"seed {seed}" if data.validation_by == "seed" and seed else episode.sha256
    return int(hashlib.sha256(what.encode()).hexdigest()[:13], 16) / 16**13
