#!/usr/bin/env python3
"""Measures what many episodes cost a training: memory and rate, on made-up ones that lie decoded in a cache.

    measure_many.py FOLDER [--episodes 10000] [--ticks 120] [--side 24] [--iterations 20]

FOLDER is filled and left; each episode takes ticks x side x side x 6 bytes. Pictures are small so that a disk holds
many episodes: what a training keeps in memory does not depend on their size.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path
from unittest import mock

import numpy as np
import torch
from made_up import experiment, observed, presence

from rapid_policy import corpus
from rapid_policy.cache import Cache, write
from rapid_policy.checkpoint import begin
from rapid_policy.dataset import Dataset
from rapid_policy.episodes import Episode, Facts, sources
from rapid_policy.experiment import Experiment
from rapid_policy.feed import Feed
from rapid_policy.judgement import Judgement


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    for name, value in (("episodes", 10_000), ("ticks", 120), ("side", 24), ("iterations", 20)):
        parser.add_argument(f"--{name}", type=int, default=value)
    args = parser.parse_args()
    torch.set_num_threads(1)
    spec, data, folder = pictures_of(args.side), args.folder / "data", args.folder / "cache"
    data.mkdir(parents=True, exist_ok=True)
    report = {"episodes": args.episodes, "ticks": args.episodes * args.ticks, "MB_before": anonymous()}
    report["fill_s"] = timed(lambda: fill(spec, data, folder, args.episodes, args.ticks, args.side))
    with mock.patch.object(corpus, "judge", judge), mock.patch.object(corpus, "program", lambda: "/bin/true"):
        began = time.monotonic()
        found = corpus.load(spec, [data], folder)
        report["load_s"], report["MB_loaded"] = time.monotonic() - began, anonymous()
    began = time.monotonic()
    dataset = Dataset(spec, found.training, folder=found.folder)
    report["windows_s"], report["MB_dataset"] = time.monotonic() - began, anonymous()
    begin(spec, len(dataset.windows), dataset.ranges, {}, torch.device("cpu"))
    feed = Feed(dataset, np.random.default_rng(0), 64, slice(None), 1)
    began, most = time.monotonic(), 0.0
    for _ in range(args.iterations):
        feed.next()
        most = max(most, anonymous())
    report["batches_s"] = args.iterations / (time.monotonic() - began)
    feed.close()
    report["MB_most"] = most
    report["MB_of_pixels"] = args.episodes * args.ticks * args.side**2 * 6 / 1e6
    print(json.dumps({key: round(value, 1) for key, value in report.items()}))


def pictures_of(side: int) -> Experiment:
    """An experiment that learns from all episodes: the seeds of the one in the repository are of recorded ones."""
    spec = experiment(data={"seeds": None})
    for key in ("wrist", "tactile"):
        spec = observed(spec, key, size=[side, side])
    return spec


def fill(spec: Experiment, data: Path, folder: Path, episodes: int, ticks: int, side: int) -> None:
    """Episodes that are whole in the cache, each of a file that is its number."""
    cache, random = Cache(folder, sources(spec)), np.random.default_rng(0)
    pictures = random.integers(0, 256, (ticks, side, side, 3)).astype(np.uint8)
    for i in range(episodes):
        file = data / f"{i:05}.mcap"
        if file.exists():
            continue
        file.write_text(str(i))
        entry = cache.entry(file)
        arrays = {
            "ticks": np.arange(ticks),
            "times": np.arange(ticks) * 100_000_000,
            "actions": random.uniform(0, 1, (ticks, 4)),
            "acted": np.ones(ticks, bool),
            "value arm": random.uniform(0, 1, (ticks, 4)),
        }
        arrays |= presence(ticks, "arm", "cam_wrist", "tactile_tip")
        for name in ("cam_wrist", "tactile_tip"):
            arrays |= {f"value {name}": pictures, f"first {name}": np.zeros(1, np.int64)}
        content = write(cache.file(entry.sha256), Episode(file, Facts(), arrays, entry.sha256))
        facts = dataclasses.asdict(Facts(observation_hz=10.0, tags={"seed": str(i)}))
        cache.record(dataclasses.replace(entry, error=None, content=content, facts=facts))


def judge(files):
    return {file: Judgement("GOOD", ()) for file in files}


def timed(work) -> float:
    began = time.monotonic()
    work()
    return time.monotonic() - began


def anonymous() -> float:
    """MB of this process that are not pages of files."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    (line,) = (line for line in status.splitlines() if line.startswith("RssAnon"))
    return int(line.split()[1]) / 1e3


if __name__ == "__main__":
    main()
