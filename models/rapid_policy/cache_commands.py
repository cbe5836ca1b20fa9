"""The commands of `python -m rapid_policy.cache`: build, verify, bench."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from .cache import Cache, Mapped
from .corpus import load
from .episodes import Episode, EpisodeError, episode_files, read_episode, sources
from .experiment import Experiment
from .experiment_file import ExperimentError, read_experiment
from .lerobot_source import files, is_dataset, split

MB = 1e6


def main() -> None:
    parser = argparse.ArgumentParser(prog="rapid_policy.cache", description="Builds, verifies or measures the decoded episodes on disk.")
    parser.add_argument("part", choices=("build", "verify", "bench"))
    parser.add_argument("experiment", type=Path, help="says what is read from an episode (*.toml)")
    parser.add_argument("--cache", type=Path, required=True, metavar="DIR", help="folder of decoded episodes")
    parser.add_argument("--data", type=Path, nargs="+", metavar="FOLDER", help="in place of the experiment's folders")
    parser.add_argument("--workers", type=int, default=2, help="processes that decode")
    parser.add_argument("--json", action="store_true", help="bench: print the figures as a JSON object")
    args = parser.parse_args()
    try:
        spec = read_experiment(args.experiment)
        folders = args.data or [Path(folder) for folder in spec.data.folders]
        if args.part == "verify":
            sys.exit(verify(spec, folders, args.cache))
        corpus = load(spec, folders, args.cache, args.workers)
        print(corpus.report(), file=sys.stderr)
        if args.part == "bench":
            report = bench(spec, [*corpus.training, *corpus.held_out])
            print(json.dumps(report) if args.json else table(report))
    except (OSError, EpisodeError, ExperimentError, ValueError) as error:
        sys.exit(f"cache: {error}")


def verify(spec: Experiment, folders: list[Path], folder: Path) -> int:
    """Hashes everything; the exit status."""
    cache = Cache(folder, sources(spec))
    files = [file.absolute() for place in folders for file in episode_files(place)]
    wrong = cache.verify(map(cache.entry, files))
    print("\n".join([*wrong, f"{len(files)} episodes, {len(wrong)} wrong"]))
    return 1 if wrong else 0


def bench(spec: Experiment, episodes: list[Episode], seconds: float = 4.0) -> dict[str, float]:
    """MB per second of one core: files decoded as without a cache, the cache in sequence, and windows at random.

    Each in bytes of the recorded files, so that they can be compared; the cache also in bytes of pixels.
    """
    from .dataset import Dataset

    wanted, sizes = sources(spec), [_recorded(e) for e in episodes]
    decoded = _rate(lambda i: read_episode(episodes[i].path, wanted), sizes, seconds)
    pixels = [sum(array.nbytes for array in e.arrays.values()) for e in episodes]
    read = _rate(lambda i: _copy(episodes[i]), sizes, seconds)
    folder = episodes[0].arrays.file.parent
    dataset, random = Dataset(spec, episodes, folder=folder), np.random.default_rng(0)
    rows, steps, size = sum(len(e) for e in episodes), spec.policy.n_obs_steps, spec.training.windows
    # A window's share of the files is its ticks' share of all ticks.
    share = sum(sizes) / rows * steps * size
    drawn = _rate(lambda _: dataset.gather(dataset.plan(random, size)), [share], seconds)
    return {
        "episodes": len(episodes),
        "decode_mb_s": decoded,
        "cache_mb_s": read,
        "cache_pixels_mb_s": read * sum(pixels) / sum(sizes),
        "windows_mb_s": drawn,
        "cache_times": read / decoded,
        "windows_times": drawn / decoded,
    }


def _rate(read, sizes: list[float], seconds: float) -> float:
    """MB per second of processor time."""
    read(0)
    done, at, began = 0.0, 0, time.process_time()
    while (used := time.process_time() - began) < seconds:
        read(at % len(sizes))
        done += sizes[at % len(sizes)]
        at += 1
    return done / MB / used


def _recorded(episode: Episode) -> float:
    """Bytes of its file; for an episode of a LeRobot dataset, its share of each of its files."""
    file, index = split(episode.path)
    if index is None:
        return file.stat().st_size
    every = [files(name) for name in episode_files(_dataset(file))]
    return sum(mine.stat().st_size / sum(mine in of for of in every) for mine in files(episode.path))


def _dataset(file: Path) -> Path:
    return next(folder for folder in file.parents if is_dataset(folder))


def _copy(episode: Episode) -> None:
    for array in Mapped(episode.arrays.file).values():
        np.array(array)


def table(report: dict[str, float]) -> str:
    """For people."""
    rows = [
        ("decoded from the files", report["decode_mb_s"], 1.0),
        ("cache, in sequence", report["cache_mb_s"], report["cache_times"]),
        ("cache, windows at random", report["windows_mb_s"], report["windows_times"]),
    ]
    lines = [f"{report['episodes']} episodes; MB of recorded files a second and core, and how many times the first"]
    lines += [f"  {name:<26} {rate:10.1f} {times:8.1f}" for name, rate, times in rows]
    return "\n".join([*lines, f"  pixels in sequence         {report['cache_pixels_mb_s']:10.1f}"])
