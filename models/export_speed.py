#!/usr/bin/env python3
"""Measures `rapid export --to lerobot` against LeRobot's own writer, on the same episode.

    export_speed.py episodes/20261125_place-block_001.mcap --rapid target/release/rapid

For the program, everything is measured: startup, reading the episode twice, statistics, checksum, writing; its AV1 videos
too, if there is an ffmpeg. For LeRobot, only `add_frame`, `save_episode` and `finalize` are measured, on pictures that are
already decoded, with the four threads per camera of lerobot-record: pictures as PNG, and as AV1 video. Prints one JSON
object. Needs the packages of models/requirements-lerobot.txt and an idle machine.
"""

import argparse
import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import commandline

IMAGES = "observation.images."


def main() -> int:
    parser = commandline.parser(__doc__)
    parser.add_argument("episode", metavar="FILE", type=Path)
    parser.add_argument("--rapid", metavar="PROGRAM", default="rapid")
    parser.add_argument("--times", metavar="N", type=int, default=3, help="run each N times and take the fastest (default: 3)")
    options = parser.parse_args()
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        found = {"event": "export_speed"}
        for form in ("jpeg", "av1") if shutil.which("ffmpeg") else ("jpeg",):
            found[f"rapid_{form}_s"] = ours(options, folder, form)
        features, rows = load(folder / "jpeg-0")
        found["frames"] = len(rows)
        for kind, form in (("image", "jpeg"), ("video", "av1")):
            seconds = found[f"lerobot_{kind}_s"] = theirs(options, folder, features, rows, kind)
            if own := found.get(f"rapid_{form}_s"):
                found[f"{kind}_ratio"] = round(seconds / own, 1)
    print(json.dumps(found))
    return 0


def ours(options: argparse.Namespace, folder: Path, form: str) -> float:
    """Seconds of the fastest run."""
    seconds = []
    for at in range(options.times):
        command = [options.rapid, "export", options.episode, "--to", "lerobot", "--out", folder / f"{form}-{at}"]
        command += ["--include-bad", "--pictures", form]
        begin = time.monotonic()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        seconds.append(time.monotonic() - begin)
    return round(min(seconds), 3)


def load(folder: Path) -> tuple[dict, list[dict]]:
    """The features that LeRobot is given, and the rows, decoded."""
    import numpy as np
    import pyarrow.parquet as pq
    from PIL import Image

    features = json.loads((folder / "meta/info.json").read_text(encoding="utf-8"))["features"]
    features = {key: of for key, of in features.items() if key.startswith(IMAGES) or of["dtype"] == "float32" and "." in key}
    (path,) = (folder / "data").glob("*/*.parquet")
    rows = []
    for row in pq.read_table(path, columns=list(features)).to_pylist():
        rows.append({})
        for key, value in row.items():
            if key.startswith(IMAGES):
                rows[-1][key] = np.array(Image.open(io.BytesIO(value["bytes"])).convert("RGB"))
            else:
                rows[-1][key] = np.array(value, np.float32)
    return features, rows


def theirs(options: argparse.Namespace, folder: Path, features: dict, rows: list[dict], kind: str) -> float:
    """Seconds of the fastest run."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    shaped = {key: {**of, "shape": tuple(of["shape"])} for key, of in features.items()}
    features = {key: {**of, "dtype": kind if key.startswith(IMAGES) else "float32"} for key, of in shaped.items()}
    threads = 4 * sum(key.startswith(IMAGES) for key in features)
    seconds = []
    for at in range(options.times):
        root = folder / f"{kind}-{at}"
        data = LeRobotDataset.create(
            "rapid/speed", 30, features, root=root, use_videos=kind == "video", image_writer_threads=threads
        )
        begin = time.monotonic()
        for row in rows:
            data.add_frame({**row, "task": "speed"})
        data.save_episode()
        data.finalize()
        seconds.append(time.monotonic() - begin)
    return round(min(seconds), 3)


if __name__ == "__main__":
    sys.exit(main())
