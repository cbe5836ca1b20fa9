"""The episodes of an experiment: found, judged, filtered, decoded, and divided into those learned from and those held out.

An episode that is damaged or of no use is left out with its reason and never the end of a run, unless none remains.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from .cache import Cache, Entry
from .classification import Classification
from .episodes import ABSENCES, Episode, EpisodeError, Facts, episode_files, picture_source, sources
from .experiment import Data, Experiment
from .judgement import JudgementError, judge, program
from .lerobot_source import MissingPackage, split

SHOWN = 20


@dataclass
class Corpus:
    """The episodes of an experiment."""

    training: list[Episode]
    held_out: list[Episode]
    left_out: list[str]
    """A line for each file that is of no use, with the reason."""
    unwanted: int
    """Files that the filters of the experiment leave out."""

    absences: dict[str, int] = field(default_factory=dict)
    """Rows without a picture of those that are not required, by the reason."""

    def report(self) -> str:
        """For people."""
        lines = [*self.left_out[:SHOWN]]
        if len(self.left_out) > SHOWN:
            lines.append(f"and {len(self.left_out) - SHOWN} more")
        lines += [f"{e.path}: note: {note}" for e in [*self.training, *self.held_out][:SHOWN] for note in e.facts.notes]
        if any(self.absences.values()):
            found = ", ".join(f"{count} by {reason}" for reason, count in self.absences.items() if count)
            lines.append(f"rows without a picture: {found}")
        counts = f"{len(self.training)} episodes to learn from, {len(self.held_out)} held out"
        return "\n".join([*lines, f"{counts}, {len(self.left_out)} left out, {self.unwanted} not asked for"])


def load(spec: Experiment | Classification, folders: Sequence[Path], cache_folder: Path, workers: int = 1) -> Corpus:
    """The episodes in `folders`, decoded into the cache by so many processes."""
    files = [file.absolute() for folder in folders for file in episode_files(folder)]
    cache = Cache(cache_folder, sources(spec))
    entries = [cache.entry(file) for file in files]
    entries = _judged(cache, entries)
    left_out, wanted, unwanted = [], [], 0
    for entry in entries:
        if entry.verdict not in spec.data.verdict:
            left_out.append(f"{entry.path}: left out, {entry.verdict or 'no verdict'}: {'; '.join(entry.reasons)}")
        elif entry.error is None and not matches(spec.data, Facts(**entry.facts)):
            unwanted += 1
        else:
            wanted.append(entry)
    try:
        cache.build(wanted, workers)
    except MissingPackage as error:
        raise EpisodeError(folders[0], str(error)) from error
    episodes = []
    for entry in (cache.entry(Path(e.path)) for e in wanted):
        episode = cache.episode(entry) if entry.error is None else None
        reason = entry.error if episode is None else _unfit(spec, episode)
        if episode is None or reason:
            left_out.append(f"{entry.path}: left out, {reason}")
        else:
            episodes.append(episode)
    if not episodes:
        found = f"{len(left_out)} left out, {unwanted} not asked for"
        first = f"; the first: {left_out[0]}" if left_out else ": check the filters in [data]"
        raise EpisodeError(folders[0], f"no episode that is fit to learn from: {found}{first}")
    training, held_out = divide(spec.data, episodes)
    return Corpus(training, held_out, left_out, unwanted, _absences(spec, episodes))


def _absences(spec: Experiment | Classification, episodes: list[Episode]) -> dict[str, int]:
    names = [picture_source(o).name for o in spec.images if not o.required]
    return {
        reason: sum(int(episode.absent(name, reason).sum()) for episode in episodes for name in names)
        for reason in ABSENCES
    }


def _unfit(spec: Experiment | Classification, episode: Episode) -> str | None:
    if isinstance(spec, Classification):
        return spec.unfit(episode.facts.tags)
    # Torch is imported only where it is used: decoding needs none.
    from .dataset import unfit

    return unfit(spec, episode)


def _judged(cache: Cache, entries: list[Entry]) -> list[Entry]:
    """With the verdict of `rapid inspect`, asked once for each content and version of the program. A data set of LeRobot
    has none: all of its episodes are taken."""
    rows = [entry for entry in entries if split(Path(entry.path))[1] is not None]
    for entry in rows:
        if entry.verdict is None:
            cache.record(replace(entry, verdict="GOOD"))
    files = [entry for entry in entries if entry not in rows]
    if not files:
        return [cache.entry(Path(entry.path)) for entry in entries]
    try:
        asked = _version(program())
        unknown = [entry for entry in files if entry.judged_by != asked]
        judged = judge([Path(entry.path) for entry in unknown])
    except JudgementError as error:
        raise EpisodeError(Path(files[0].path).parent, str(error)) from error
    for entry in unknown:
        judgement = judged[Path(entry.path)]
        cache.record(replace(entry, verdict=judgement.verdict, reasons=judgement.reasons, judged_by=asked))
    return [cache.entry(Path(entry.path)) for entry in entries]


def _version(rapid: str) -> str:
    """The program as a file: another build may judge differently."""
    stat = os.stat(rapid)
    return f"{rapid} {stat.st_size} {stat.st_mtime_ns}"


def matches(data: Data, facts: Facts) -> bool:
    """Whether the filters of the experiment take an episode."""
    for tag, values in data.tags.items():
        if facts.tags.get(tag) not in ((values,) if isinstance(values, str) else values):
            return False
    if not set(data.modules) <= set(facts.modules) or (data.tasks and facts.task not in data.tasks):
        return False
    if data.seeds is None:
        return True
    seed = facts.tags.get("seed", "")
    return seed.isdigit() and data.seeds[0] <= int(seed) <= data.seeds[1]


def divide(data: Data, episodes: list[Episode]) -> tuple[list[Episode], list[Episode]]:
    """Those learned from and those held out: by a hash, so that more episodes change nothing for the others."""
    if not data.validation:
        return episodes, []
    places = [_place(data, episode) for episode in episodes]
    border = max(data.validation, min(places))
    held_out = [e for e, place in zip(episodes, places, strict=True) if place <= border]
    training = [e for e, place in zip(episodes, places, strict=True) if place > border]
    if not training:
        raise EpisodeError(episodes[0].path.parent, "all episodes are held out: record more, or write validation = 0")
    return training, held_out


def _place(data: Data, episode: Episode) -> float:
    """A number from 0 to 1 that only the episode, or its seed, determines."""
    seed = episode.facts.tags.get("seed")
    what = f"seed {seed}" if data.validation_by == "seed" and seed else episode.sha256
    return int(hashlib.sha256(what.encode()).hexdigest()[:13], 16) / 16**13
