#!/usr/bin/env python3
"""Runs LeRobot's own record loop with a camera that fails, and writes what it does beside the other results.

    lerobot_loop.py --rapid ../target/release/rapid [--out results]

An episode of the simulated task with the arm is recorded and exported by the program; its pictures are what LeRobot's cameras
read. Each condition runs in a process of its own, `lerobot_rig.py`, and its line is what that process recorded. The results are
`lerobot-loop.jsonl` and `lerobot-loop.md`. Needs the packages of requirements-lerobot.txt: `make lerobot-loop` has them.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import commandline

MODELS = Path(__file__).parent
SEED = 50_000
TITLES = {
    "full": "every camera is there",
    "unplug": "reads fail from then on",
    "replug": "the same, and 1 s later the camera is back",
    "silent": "open, but nothing comes from then on",
    "short-silence": "nothing comes until two old pictures were given",
}


class LoopError(Exception):
    """A process ended without a result."""


def main(arguments: list[str] | None = None) -> int:
    parser = commandline.parser(__doc__)
    parser.add_argument("--rapid", metavar="PROGRAM", type=Path, required=True, help="the program")
    parser.add_argument("--out", metavar="FOLDER", type=Path, default=MODELS / "results", help="default: results")
    options = parser.parse_args(arguments)
    try:
        with tempfile.TemporaryDirectory() as folder:
            data = record(options.rapid.absolute(), Path(folder))
            lines = [run(data, name, Path(folder)) for name in TITLES]
        options.out.mkdir(parents=True, exist_ok=True)
        text = "".join(json.dumps(line, sort_keys=True) + "\n" for line in lines)
        (options.out / "lerobot-loop.jsonl").write_text(text, encoding="utf-8")
        (options.out / "lerobot-loop.md").write_text(markdown(lines), encoding="utf-8")
    except (OSError, ValueError, LoopError, subprocess.CalledProcessError) as error:
        return commandline.failed("lerobot_loop", error)
    print("\n".join(table(lines)))
    return 0


def record(rapid: Path, folder: Path) -> Path:
    """An episode as a LeRobot dataset."""
    quiet = {"check": True, "stdout": subprocess.DEVNULL, "cwd": folder}
    words = ["--sim", "task", "--expert", "--record", "--episodes", "1", "--seed", str(SEED), "--out", "episodes"]
    subprocess.run([rapid, *words], **quiet)
    subprocess.run([rapid, "export", "episodes", "--to", "lerobot", "--out", "set"], **quiet)
    return folder / "set"


def run(data: Path, condition: str, folder: Path) -> dict[str, Any]:
    """The line of a condition; `exit` is the exit code of its process, or, negative, the signal that ended it."""
    place = folder / condition
    place.mkdir()
    environment = os.environ | {"OMP_WAIT_POLICY": "PASSIVE"}
    command = [sys.executable, MODELS / "lerobot_rig.py", data, condition, "line.json"]
    done = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, check=False)
    file = place / "line.json"
    if not file.exists():
        last = (done.stderr.strip().splitlines() or ["nothing printed"])[-1]
        needs = "it needs the packages of models/requirements-lerobot.txt"
        raise LoopError(f"lerobot_rig.py {condition} ended with {done.returncode} and no result: {last} ({needs})")
    return json.loads(file.read_text(encoding="utf-8")) | {"exit": done.returncode}


def crashes(name: str) -> str:
    """How many trials of `rapid eval` crashed when the camera was unplugged, in one of its runs."""
    lines = map(json.loads, (MODELS / "results/eval.jsonl").read_text(encoding="utf-8").splitlines())
    line = next(line for line in lines if line["run"] == name and line["condition"] == "hot-unplug")
    return f"{line['crash']} of {line['trials']} trials crashed ({line['status']})"


def table(lines: list[dict[str, Any]]) -> list[str]:
    """For people."""
    out = [
        "| condition | the camera | actions before | actions after | old pictures before | old pictures after | status | raised |"
        " raised after | frames kept |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for line in lines:
        error = line["raised"]
        cells = [line["condition"], TITLES[line["condition"]], line["actions_before"], line["actions_after"]]
        cells += [line["repeated_before"], line["repeated_after"], line["status"].capitalize()]
        cells += [f"`{error['type']}`" if error else "-", seconds(line["raised_after_s"])]
        out.append(f"| {' | '.join(map(str, [*cells, line['frames_kept']]))} |")
    return out


def markdown(lines: list[dict[str, Any]]) -> str:
    """The page."""
    of = lines[0]
    text = [
        "# LeRobot's own loop with a camera that fails",
        "",
        f"`record_loop` of LeRobot {of['lerobot']}, the loop of `lerobot-record`, with its DiffusionPolicy, at {of['fps']} Hz. The",
        f"pictures are those of an episode of the simulated task, {of['camera_hz']} a second, again and again. The camera that fails is",
        f"`{of['camera']}`, after {of['event_at']} actions.",
        "",
        *table(lines),
        "",
        "Everything is read from the run. An old picture: the loop was given the bytes that it was given the time before. Status:",
        "crash if the loop raised, stale if it ended on an old picture, else normal. Frames kept: those of the episode that the",
        f"dataset has in the end. A loop that does not raise ends after {of['actions']} actions.",
        "",
        "## What was raised",
        "",
    ]
    for line in lines:
        if error := line["raised"]:
            text += [f"`{line['condition']}`: `{error['type']}: {error['message']}`", ""]
            text += [*(f"    {step}" for step in error["through"]), ""]
        if "again" in line:
            text += [f"The camera sent pictures again after {seconds(line['away_s'])}; one more `get_observation` then:", ""]
            text += [answer(line["again"]), ""]
    text += [
        "## The longest time between two actions",
        "",
        "| condition | before | after |",
        "|---|---|---|",
        *(
            f"| {line['condition']} | {seconds(line['longest_interval_before_s'])} | {seconds(line['longest_interval_after_s'])} |"
            for line in lines
        ),
        "",
        "The policy computes 8 actions at a time; how long that takes depends on the machine.",
        "",
        "## Beside it",
        "",
        f"`rapid eval models/tactile-id --condition hot-unplug`: {crashes('plain')}. With `--static-config`,",
        f"a loop of ours with the same weights: {crashes('static')}. That one waits 200 ms for a sample, as",
        f"`async_read` of LeRobot's cameras does; the followers of LeRobot {of['lerobot']} take the last picture unless it is older than",
        f"{of['max_age_ms']} ms (`read_latest`). [All conditions](eval.md).",
        "",
        SOURCES,
    ]
    return "\n".join(text)


SOURCES = f"""## What is LeRobot's and what is not

LeRobot's: the loop, `predict_action`, the policy and its processors, the dataset that is written, `get_observation` and
`send_action` of `SOFollower`, and `OpenCVCamera` with its thread and its errors. Nothing of it is patched.

Ours:

- the motors: each is at its goal at once;
- what OpenCV opens: a named pipe with the JPEGs of the episode in place of a device. To unplug closes it: OpenCV's reads
  fail, as they do, by its source, when V4L2 answers ENODEV. No real camera was pulled out;
- the camera's rate and size, which are not set: OpenCV sets those of devices only;
- `probesize` and `threads` of FFmpeg, so that no pictures are held back;
- the policy: random weights (seed 0), normalised by the statistics of the episode. The question is whether the loop acts, not
  how well. The episode is that of an arm: a handheld one has no actions.

Made with `make lerobot-loop`, which runs this, `lerobot_rig.py` in a process for each condition, and keeps its lines in
`lerobot-loop.jsonl`:

    rapid --sim task --expert --record --episodes 1 --seed {SEED} --out episodes
    rapid export episodes --to lerobot --out set
    lerobot_rig.py set CONDITION line.json
"""


def answer(error: dict[str, Any] | None) -> str:
    return f"`{error['type']}: {error['message']}`" if error else "an observation."


def seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} s"


if __name__ == "__main__":
    sys.exit(main())
