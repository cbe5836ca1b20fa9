#!/usr/bin/env python3
"""Exports a LeRobot DiffusionPolicy checkpoint to a policy bundle.

    export_lerobot.py outputs/train/pick/checkpoints/last/pretrained_model models/pick --hz 30 \\
        --modality observation.images.top=cam_top --modality observation.state=arm

For policies with one or two cameras and observation.state. The bundle is compared with LeRobot on random observations
before it gets its name; a difference above 1e-4 is an error. Needs the packages of models/requirements-lerobot.txt.
Nothing is fetched.
"""

import argparse
import contextlib
import json
import os
import sys
from pathlib import Path

import commandline
from policy_export import Unsupported, commands
from policy_export.commands import count, pair, positive, words
from policy_export.lerobot import config as checkpoint_config


def main(arguments: list[str] | None = None) -> int:
    return commands.run("export_lerobot", parser(), export, arguments)


def parser() -> argparse.ArgumentParser:
    out = commandline.parser(__doc__)
    add = out.add_argument
    add(
        "path",
        metavar="PATH",
        type=Path,
        help="folder of the checkpoint: config.json, model.safetensors, policy_*.json",
    )
    add("out", metavar="OUT", type=Path, help="folder of the bundle; must not exist")
    add("--name", help="name of the bundle (default: that of OUT)")
    add("--hz", type=positive, help="control rate the policy was trained at (default: the fps of --dataset)")
    add(
        "--modality",
        metavar="KEY=NAME",
        action="append",
        default=[],
        type=pair,
        help="entry of devices.toml that gives observation KEY (default: the last part of KEY); may be repeated",
    )
    add("--actuator", metavar="NAME", help="entry of devices.toml that is moved (default: that of observation.state)")
    add(
        "--dataset",
        metavar="DIR",
        type=Path,
        help="the LeRobotDataset it was trained on: its meta/ gives rate, names of the actions and their limits",
    )
    add(
        "--action-names",
        metavar="A,B",
        type=words,
        help="names of the action's values (default: those of --dataset, or a0,a1)",
    )
    add("--action-units", metavar="A,B", type=words, help="their units (default: 1)")
    add(
        "--mask-aware",
        action="store_true",
        help="zero the embedding of a camera that is absent; only for a policy that was trained that way",
    )
    add(
        "--required",
        metavar="KEY",
        action="append",
        default=[],
        help="with --mask-aware: a camera the policy does not run without; may be repeated",
    )
    add(
        "--scheduler",
        choices=["DDIM", "DDPM"],
        help="run with this scheduler instead of config.json's noise_scheduler_type",
    )
    add("--steps", type=count, metavar="N", help="run this many steps instead of config.json's num_inference_steps")
    add("--max-age-ms", type=count, default=300, metavar="MS", help="no older observation is acted on (default: 300)")
    return out


def export(options: argparse.Namespace) -> None:
    commands.is_new(options.out)
    config = checkpoint_config.read(options.path)
    settings = rig(options, config)

    # Importing LeRobot and torch takes seconds, and a refusal needs neither.
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    try:
        from policy_export.lerobot import bundle, checkpoint, graphs, verify
    except ModuleNotFoundError as error:
        raise Unsupported(
            f"{sys.executable} has no {error.name}: use a Python environment with what is in "
            "models/requirements-lerobot.txt (its first lines explain how; `make lerobot-test` makes one)"
        ) from error

    settings = bundle.Options(**settings)
    names = bundle.input_names(config)
    with contextlib.redirect_stdout(sys.stderr):  # LeRobot prints when it loads
        loaded = checkpoint.load(config, options.scheduler, options.steps)

    def make(folder: Path) -> dict:
        files = graphs.export(loaded.policy, config, names, settings.mask_aware, folder)
        return bundle.policy(loaded, settings, files, folder)

    made = commands.write(options.out, make, lambda folder: verify.verify(loaded, folder), bundle.write_card)
    commands.report(options.out, made, "LeRobot")


def rig(options: argparse.Namespace, config: checkpoint_config.Config) -> dict:
    """What the command line and the data state about the rig, checked against the checkpoint."""
    modalities = commands.modalities(config.keys, options.modality, lambda key: key.rsplit(".", 1)[-1])
    for key in options.required:
        if key not in config.cameras or not options.mask_aware:
            raise Unsupported(
                f"--required {key}: goes with --mask-aware, and the cameras are {', '.join(config.cameras)}"
            )
    commands.apart([modalities[key] for key in config.cameras])

    data = dataset(options.dataset) if options.dataset else {}
    hz = options.hz or data.get("hz")
    if not hz:
        raise Unsupported("the checkpoint does not state at what rate it acts: give --hz, or its data with --dataset")
    found = {
        "name": options.name or options.out.name,
        "hz": float(hz),
        "modalities": modalities,
        "actuator": options.actuator or modalities[checkpoint_config.STATE_KEY],
        "mask_aware": options.mask_aware,
        "required": set(options.required),
        "max_age_ms": options.max_age_ms,
        "action_names": options.action_names or data.get("names") or [],
        "action_units": options.action_units or [],
        "dataset_stats": data.get("stats"),
    }
    for what in ("action_names", "action_units"):
        if found[what] and len(found[what]) != config.action_len:
            raise Unsupported(
                f"{len(found[what])} {what.replace('_', ' ')}, but an action has {config.action_len} values"
            )
    return found


def dataset(folder: Path) -> dict:
    """Rate, action names and statistics of a LeRobotDataset (v2 keeps no meta/stats.json: then no statistics)."""
    try:
        info = json.loads((folder / "meta" / "info.json").read_text(encoding="utf-8"))
        stats = folder / "meta" / "stats.json"
        found = {"hz": info["fps"], "stats": json.loads(stats.read_text(encoding="utf-8")) if stats.exists() else None}
        names = info["features"][checkpoint_config.ACTION_KEY].get("names")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise Unsupported(f"{folder}: not the folder of a LeRobotDataset: {error!r}") from error
    # Either a list, or lists by group: {"motors": [...]}.
    found["names"] = [name for group in names.values() for name in group] if isinstance(names, dict) else names
    return found


if __name__ == "__main__":
    sys.exit(main())
