#!/usr/bin/env python3
"""Exports a checkpoint of Universal Manipulation Interface (UMI) to a policy bundle.

    export_umi_policy.py cup.ckpt models/cup --hz 20 --modality camera0_rgb=cam_wrist --picture 1280x720 \\
        --pose arm.0-6 --gripper arm.7 --low=-0.3,-0.5,0.02 --high=0.5,0.5,0.6

A DiffusionUnetTimmPolicy of one robot, with ResNet-18 or 34, ViT or ConvNeXt base. COLUMNS are numbers of a sensor:
arm.7, arm.0-6 (both included). The pose is x y z in metres and the quaternion x y z w of the same gripper frame
as in the training data. A policy with robot0_eef_rot_axis_angle_wrt_start sees how the gripper has turned since its first pose
in the run. Give --start-rotation if every run is to count as begun with the same rotation (UMI trains with 0.05 rad of
noise there), or --start-columns if a sensor gives the rotation at the start.

What a bundle cannot express is refused, with its key. No code in the file is run. The bundle is compared with the networks
in PyTorch before it gets its name; a difference above 1e-4 is an error. Needs the packages of
models/requirements.txt. Nothing is fetched.
"""

import argparse
import dataclasses
import re
import sys
from pathlib import Path

import commandline
from policy_export import Unsupported, commands
from policy_export.commands import count, pair, positive
from policy_export.umi import config as checkpoint_config


def main(arguments: list[str] | None = None) -> int:
    return commands.run("export_umi_policy", parser(), export, arguments)


def parser() -> argparse.ArgumentParser:
    out = commandline.parser(__doc__)
    add = out.add_argument
    add(
        "path", metavar="PATH", type=Path, help="file *.ckpt, or the folder of a training (its checkpoints/latest.ckpt)"
    )
    add("out", metavar="OUT", type=Path, help="folder of the bundle; must not exist")
    add("--name", help="name of the bundle (default: that of OUT)")
    add(
        "--hz",
        type=positive,
        required=True,
        help="actions per second: the rate of the data (GoPro 59.94) divided by the action's down_sample_steps",
    )
    add(
        "--modality",
        metavar="KEY=NAME",
        action="append",
        default=[],
        type=pair,
        help="entry of devices.toml that gives the pictures KEY (default: KEY); may be repeated",
    )
    add(
        "--picture",
        metavar="WIDTHxHEIGHT",
        type=size,
        help="size of the cameras' pictures: they are resized and cropped as in UMI, but without antialiasing "
        "(default: they have the checkpoint's size)",
    )
    add("--pose", metavar="COLUMNS", required=True, type=columns(7), help="7 numbers: where the gripper is")
    add("--gripper", metavar="COLUMNS", required=True, type=columns(1), help="its opening in metres")
    add("--actuator", metavar="NAME", help="entry of devices.toml that is moved (default: that of --pose)")
    add("--low", metavar="X,Y,Z", required=True, type=numbers(3), help="no smaller position is executed")
    add("--high", metavar="X,Y,Z", required=True, type=numbers(3), help="no larger position is executed")
    start = out.add_mutually_exclusive_group()
    start.add_argument(
        "--start-rotation", metavar="X,Y,Z,W", type=numbers(4), help="the gripper's quaternion when a run begins"
    )
    start.add_argument(
        "--start-columns", metavar="COLUMNS", type=columns(4), help="4 numbers of a sensor that gives it throughout the run"
    )
    add("--scheduler", choices=["DDIM", "DDPM"], help="run with this scheduler instead of cfg.policy.noise_scheduler's")
    add("--steps", type=count, metavar="N", help="run this many steps instead of cfg.policy.num_inference_steps")
    add("--max-age-ms", type=count, default=300, metavar="MS", help="no older observation is acted on (default: 300)")
    return out


def export(options: argparse.Namespace) -> None:
    commands.is_new(options.out)
    try:
        from policy_export.umi import bundle, checkpoint, graphs, networks, verify
    except ModuleNotFoundError as error:
        raise Unsupported(
            f"{sys.executable} has no {error.name}: use a Python environment with what is in models/requirements.txt "
            "(`make train-test` makes one)"
        ) from error

    file = checkpoint.find(options.path)
    cfg, weights = checkpoint.read(file)
    config = scheduled(options, checkpoint_config.read(file, cfg))
    if config.weights not in weights:
        raise Unsupported(f"{file}: state_dicts.{config.weights}: missing: by cfg.training.use_ema it is used")
    rig = bundle.Rig(**settings(options, config, bundle.Columns))
    policy = networks.Policy(config, weights[config.weights])

    def make(folder: Path) -> dict:
        return bundle.policy(policy, rig, graphs.export(policy, rig.start, folder), folder)

    def check(folder: Path) -> dict[str, float]:
        return verify.verify(policy, rig.start, folder)

    made = commands.write(options.out, make, check, bundle.write_card)
    commands.report(options.out, made, "UMI's networks")


def scheduled(options: argparse.Namespace, config: checkpoint_config.Config) -> checkpoint_config.Config:
    """The configuration, with the scheduler and the number of steps that the command line asks for."""
    wanted = {"type": options.scheduler, "num_inference_steps": options.steps}
    scheduler = config.scheduler | {key: value for key, value in wanted.items() if value is not None}
    return dataclasses.replace(config, scheduler=checkpoint_config.visited(config.file, scheduler))


def settings(options: argparse.Namespace, config: checkpoint_config.Config, kind: type) -> dict:
    """What the command line states about the rig, checked against the checkpoint."""
    cameras = commands.modalities(list(config.cameras), options.modality, str)
    commands.apart(list(cameras.values()))
    if any(low >= high for low, high in zip(options.low, options.high, strict=True)):
        raise Unsupported(f"--low {options.low}: not below --high {options.high}")
    pose, gripper = (kind(*named) for named in (options.pose, options.gripper))
    return {
        "name": options.name or options.out.name,
        "hz": float(options.hz),
        "cameras": cameras,
        "picture": options.picture,
        "pose": pose,
        "gripper": gripper,
        "actuator": options.actuator or pose.modality,
        "low": options.low,
        "high": options.high,
        "max_age_ms": options.max_age_ms,
        **begun(options, config, kind),
    }


def begun(options: argparse.Namespace, config: checkpoint_config.Config, kind: type) -> dict:
    """How the gripper is turned when a run begins, as a matrix, or which numbers of a sensor give it, unless its first
    pose does."""
    import numpy as np

    from rapid_policy import poses

    key, rotation, named = checkpoint_config.SINCE_START, options.start_rotation, options.start_columns
    if (rotation is not None or named is not None) and key not in config.numbers:
        raise Unsupported(f"--start-rotation, --start-columns: {config.file} does not observe {key}")
    if rotation is None:
        return {"start_columns": kind(*named) if named else None}
    found, right = poses.matrices(np.array([[0.0, 0.0, 0.0, *rotation]]), "quaternion")
    if not right[0]:
        raise Unsupported(f"--start-rotation {rotation}: a quaternion x y z w has the length 1")
    return {"start": found[0, :3, :3]}


def columns(length: int):
    """The form of an option: NAME.FIRST-LAST or NAME.NUMBER, `length` numbers."""

    def read(text: str) -> tuple[str, int, int]:
        found = re.fullmatch(r"(.+)\.(\d+)(?:-(\d+))?", text)
        begin, end = (int(found[2]), int(found[3] or found[2]) + 1) if found else (0, 0)
        if end - begin != length:
            last = f"-{length - 1}" if length > 1 else ""
            raise argparse.ArgumentTypeError(f"'{text}' is not {length} numbers of a sensor, such as arm.0{last}")
        return found[1], begin, end

    return read


def numbers(length: int):
    """The form of an option: `length` finite numbers, joined by commas."""

    def read(text: str) -> list[float]:
        try:
            found = [float(word) for word in text.split(",")]
        except ValueError:
            found = []
        if len(found) != length or not all(abs(number) < float("inf") for number in found):
            raise argparse.ArgumentTypeError(f"'{text}' is not {length} numbers, joined by commas")
        return found

    return read


def size(text: str) -> tuple[int, int]:
    """[height, width] of WIDTHxHEIGHT."""
    found = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text)
    if not found:
        raise argparse.ArgumentTypeError(f"'{text}' is not WIDTHxHEIGHT")
    return int(found[2]), int(found[1])


if __name__ == "__main__":
    sys.exit(main())
