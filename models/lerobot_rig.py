#!/usr/bin/env python3
"""One condition of `lerobot_loop.py`: LeRobot's record loop, with a camera that fails; run by it in a process of its own.

    lerobot_rig.py DATASET CONDITION OUT

LeRobot's are the loop, the policy, `predict_action`, the cameras (`OpenCVCamera`: thread, timeouts, errors), the follower's
`get_observation` and `send_action`, and the dataset that is written. Ours is what LeRobot has no simulation of: the motors
(`Motors`) and what OpenCV opens (`Source`), a named pipe with the JPEGs of an episode. Nothing of LeRobot's is patched.

What is written to OUT, one JSON line, is read from the run: times of actions and of the event, the pictures that the loop was
given, the error and where it was raised.
"""

from __future__ import annotations

import hashlib
import inspect
import itertools
import json
import logging
import math
import os
import sys
import threading
import time
import traceback
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("HF_HUB_OFFLINE", "1")
# Otherwise FFmpeg reads seconds of pictures before it reports a stream as open, and holds one back for each thread.
os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] = "probesize;32|threads;1"

import lerobot
import pyarrow.parquet as pq
import torch
from lerobot.cameras.opencv import OpenCVCamera, OpenCVCameraConfig
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.pipeline_features import aggregate_pipeline_dataset_features, create_initial_features
from lerobot.datasets.utils import combine_feature_dicts
from lerobot.datasets.video_utils import VideoEncodingManager
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.processor import make_default_processors
from lerobot.robots import Robot
from lerobot.robots.so_follower import SO101FollowerConfig
from lerobot.robots.so_follower.so_follower import SOFollower
from lerobot.scripts.lerobot_record import record_loop

IMAGES = "observation.images."
# The camera that fails.
CAMERA = "tactile_tip"
# Pictures a second; the loop runs at the rate of the dataset.
CAMERA_HZ = 30
# How many actions it fails after, and how many the episode ends after.
EVENT_AT, ACTIONS = 20, 60


@dataclass(frozen=True)
class Event:
    """What the camera does: its reads fail, like those of a device that is pulled out, or it is open and sends nothing."""

    closes: bool
    # When it is back: after seconds, or once the loop was given its last picture again so often. Without either it stays away.
    away_s: float | None = None
    old: int = 0


CONDITIONS = {
    "full": None,
    "unplug": Event(closes=True),
    "replug": Event(closes=True, away_s=1.0),
    "silent": Event(closes=False),
    "short-silence": Event(closes=False, old=2),
}


@dataclass
class Log:
    """What happened when, in seconds of the same clock."""

    actions: list[float] = field(default_factory=list)
    # Time and digest of the picture of CAMERA.
    observations: list[tuple[float, str]] = field(default_factory=list)
    # The end of the last reading of the cameras, successful or not.
    read: float = 0.0
    failed_at: float | None = None
    back_at: float | None = None
    # Set when EVENT_AT actions were sent.
    due: threading.Event = field(default_factory=threading.Event)
    observed: threading.Condition = field(default_factory=threading.Condition)
    returned: threading.Event = field(default_factory=threading.Event)

    def repeats(self) -> list[float]:
        """When the loop was given the same picture as the time before."""
        pairs = zip(self.observations[1:], self.observations, strict=False)
        return [at for (at, digest), (_, last) in pairs if digest == last]

    def old(self) -> int:
        """How often that happened since the camera failed."""
        return sum(at > self.failed_at for at in self.repeats())


class Source(threading.Thread):
    """The pictures of an episode, again and again, in a named pipe, from which OpenCV reads them as from a file."""

    def __init__(self, path: Path, pictures: list[bytes], event: Event | None, log: Log):
        super().__init__(name=str(path), daemon=True)
        self.path, self.event, self.log = path, event, log
        self.pictures = itertools.cycle(pictures)
        os.mkfifo(path)

    def run(self) -> None:
        try:
            self.play()
        except BrokenPipeError:
            pass  # The loop has closed the camera.
        finally:
            # No picture will come that `again` could wait for.
            if self.event is not None:
                self.log.returned.set()

    def play(self) -> None:
        with self.path.open("wb", buffering=0) as pipe:
            self.send(pipe)
            self.log.failed_at = time.perf_counter()
            if not self.event.closes:
                self.wait()
                self.send(pipe)
        # Every writer of the pipe is closed: OpenCV's next read fails.
        self.wait()
        with self.path.open("wb", buffering=0) as pipe:
            self.send(pipe)

    def send(self, pipe: Any) -> None:
        """Sends pictures until the camera fails; endlessly if it does not, or has been away. It is back once one is sent."""
        fails = self.event is not None and self.log.failed_at is None
        while not (fails and self.log.due.is_set()):
            pipe.write(next(self.pictures))
            if self.event is not None and self.log.failed_at is not None and self.log.back_at is None:
                self.log.back_at = time.perf_counter()
                self.log.returned.set()
            time.sleep(1 / CAMERA_HZ)

    def wait(self) -> None:
        """Returns when the camera is to be back; never if it stays away."""
        if self.event.old:
            with self.log.observed:
                self.log.observed.wait_for(lambda: self.log.old() >= self.event.old)
        else:
            threading.Event().wait(self.event.away_s)


class Motors:
    """In place of a bus of servos: each is at its goal at once. Ends the episode after ACTIONS actions."""

    is_connected = False
    is_calibrated = True

    def __init__(self, positions: dict[str, float], log: Log, events: dict[str, bool]):
        self.motors, self.positions, self.log, self.events = list(positions), positions, log, events

    def connect(self) -> None:
        self.is_connected = True

    def disconnect(self, disable_torque: bool = True) -> None:
        self.is_connected = False

    def torque_disabled(self) -> nullcontext:
        return nullcontext()

    def configure_motors(self) -> None:
        pass

    def write(self, name: str, motor: str, value: int) -> None:
        pass

    def sync_read(self, name: str) -> dict[str, float]:
        return dict(self.positions)

    def sync_write(self, name: str, goals: dict[str, float]) -> None:
        self.positions.update(goals)
        self.log.actions.append(time.perf_counter())
        if len(self.log.actions) == EVENT_AT:
            self.log.due.set()
        # What the key "right" sets in LeRobot.
        self.events["exit_early"] = len(self.log.actions) == ACTIONS


class Follower(SOFollower):
    """LeRobot's follower with other motors. It records what its loop is given from CAMERA."""

    def __init__(self, config: SO101FollowerConfig, motors: Motors, log: Log):
        # Not SOFollower's own, which opens a serial port.
        Robot.__init__(self, config)
        self.config, self.bus, self.log = config, motors, log
        # Rate and size are those of the pictures: OpenCV sets them on devices only, and LeRobot raises if it cannot.
        read = {name: replace(camera, fps=None, width=None, height=None) for name, camera in config.cameras.items()}
        self.cameras = make_cameras_from_configs(read)

    def get_observation(self) -> dict[str, Any]:
        try:
            observation = super().get_observation()
        finally:
            self.log.read = time.perf_counter()
        digest = hashlib.sha256(observation[CAMERA].tobytes()).hexdigest()
        with self.log.observed:
            self.log.observations.append((self.log.read, digest))
            self.log.observed.notify()
        return observation


def main() -> None:
    data, condition, out = Path(sys.argv[1]).absolute(), sys.argv[2], Path(sys.argv[3]).absolute()
    logging.basicConfig(level=logging.WARNING)
    log, events = Log(), {"exit_early": False, "rerecord_episode": False, "stop_recording": False}
    robot = rig(data, condition, log, events)
    dataset, parts = recorder(data, robot)
    robot.connect()
    error = None
    try:
        # As LeRobot's `record` does; only an error or ACTIONS ends the episode.
        with VideoEncodingManager(dataset):
            record_loop(robot, events, dataset.fps, dataset=dataset, control_time_s=math.inf, single_task="loop", **parts)
            dataset.save_episode()
    except Exception as raised:
        error = raised
    line = {"event": "condition", "condition": condition, **facts(dataset.fps), **observed(log, error)}
    event = CONDITIONS[condition]
    if error and event and event.away_s:
        line["again"] = again(robot, log)
    line["away_s"] = round(log.back_at - log.failed_at, 3) if log.back_at else None
    line["frames_kept"] = dataset.meta.total_frames
    out.write_text(json.dumps(line) + "\n", encoding="utf-8")
    # Last: a thread of the camera may be in a read that does not end.
    dataset.finalize()
    if robot.is_connected:
        robot.disconnect()


def rig(data: Path, condition: str, log: Log, events: dict[str, bool]) -> Follower:
    """The follower with a camera for each of the dataset's; pipes and calibration are in the current folder."""
    info = json.loads((data / "meta/info.json").read_text(encoding="utf-8"))["features"]
    names = [key.removeprefix(IMAGES) for key in info if key.startswith(IMAGES)]
    (file,) = (data / "data").glob("*/*.parquet")
    rows = pq.read_table(file).to_pylist()
    cameras = {}
    for name in names:
        path = Path(f"{name}.mjpeg")
        pictures = [row[IMAGES + name]["bytes"] for row in rows]
        Source(path, pictures, CONDITIONS[condition] if name == CAMERA else None, log).start()
        height, width, _ = info[IMAGES + name]["shape"]
        cameras[name] = OpenCVCameraConfig(path, fps=CAMERA_HZ, width=width, height=height)
    motors = dict(zip(info["observation.state"]["names"], rows[0]["observation.state"], strict=True))
    config = SO101FollowerConfig(port="", id="recorded", calibration_dir=Path.cwd(), cameras=cameras)
    return Follower(config, Motors(motors, log, events), log)


def recorder(data: Path, robot: Follower) -> tuple[LeRobotDataset, dict[str, Any]]:
    """The dataset that the loop writes, and the policy with its processors, made as LeRobot's `record` makes them."""
    source = LeRobotDatasetMetadata("rapid/loop", root=data)
    teleop, action, observation = make_default_processors()
    features = combine_feature_dicts(
        aggregate_pipeline_dataset_features(teleop, create_initial_features(action=robot.action_features)),
        aggregate_pipeline_dataset_features(observation, create_initial_features(observation=robot.observation_features)),
    )
    threads = 4 * len(robot.cameras)
    dataset = LeRobotDataset.create("rapid/loop", source.fps, features, Path("recorded"), robot.name, image_writer_threads=threads)
    torch.manual_seed(0)
    torch.set_num_threads(1)
    config = DiffusionConfig(device="cpu", down_dims=(32, 64), noise_scheduler_type="DDIM", num_inference_steps=10)
    policy = make_policy(config, ds_meta=dataset.meta)
    before, after = make_pre_post_processors(config, dataset_stats=source.stats)
    processors = {"teleop_action_processor": teleop, "robot_action_processor": action, "robot_observation_processor": observation}
    return dataset, {**processors, "policy": policy, "preprocessor": before, "postprocessor": after}


def facts(fps: int) -> dict[str, Any]:
    """What the figures depend on."""
    limit = inspect.signature(OpenCVCamera.read_latest).parameters["max_age_ms"].default
    rates = {"fps": fps, "camera": CAMERA, "camera_hz": CAMERA_HZ, "event_at": EVENT_AT, "actions": ACTIONS}
    return {"lerobot": lerobot.__version__, **rates, "max_age_ms": limit}


def observed(log: Log, error: Exception | None) -> dict[str, Any]:
    """The run in figures. It is a crash if its loop raised, stale if it ended on the same picture as the time before."""
    failed = log.failed_at or math.inf
    after = [at for at in log.actions if at > failed]
    repeats = log.repeats()
    stale = repeats and repeats[-1] == log.observations[-1][0]
    return {
        "status": "crash" if error else "stale" if stale else "normal",
        "actions_before": len(log.actions) - len(after),
        "actions_after": len(after),
        "repeated_before": sum(at <= failed for at in repeats),
        "repeated_after": sum(at > failed for at in repeats),
        "longest_interval_before_s": longest([at for at in log.actions if at <= failed]),
        "longest_interval_after_s": longest([failed, *after]) if log.failed_at else None,
        "raised_after_s": round(log.read - failed, 3) if error and log.failed_at else None,
        "raised": raised(error) if error else None,
    }


def again(robot: Follower, log: Log) -> dict[str, Any] | None:
    """What a further observation raises once the camera is back."""
    log.returned.wait()
    try:
        robot.get_observation()
    except Exception as error:
        return raised(error)
    return None


def longest(times: list[float]) -> float | None:
    """The longest time between two of them."""
    return round(max(b - a for a, b in itertools.pairwise(times)), 3) if len(times) > 1 else None


def raised(error: Exception) -> dict[str, Any]:
    """The error, and the functions of LeRobot that it went through, outermost first."""
    package = Path(lerobot.__file__).parent
    frames = [f for f in traceback.extract_tb(error.__traceback__) if package in Path(f.filename).parents]
    through = [f"{Path(f.filename).relative_to(package)}:{f.lineno} {f.name}" for f in frames]
    return {"type": type(error).__name__, "message": str(error), "through": through}


if __name__ == "__main__":
    main()
