"""policy.json and README.md of a bundle of UMI."""

from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from .. import bundle
from ..bundle import FORMAT
from .config import ACTION_LEN, POSITION, ROTATION, WIDTH, Observation
from .graphs import START, inputs
from .networks import Policy

NAMES = ["x", "y", "z", "qx", "qy", "qz", "qw", "width"]
UNITS = ["m", "m", "m", "1", "1", "1", "1", "m"]


@dataclass(frozen=True)
class Columns:
    """Numbers `begin` to `end` of a modality's samples."""

    modality: str
    begin: int
    end: int

    @property
    def slice(self) -> list[int]:
        return [self.begin, self.end]

    def part(self, begin: int, end: int) -> "Columns":
        return Columns(self.modality, self.begin + begin, self.begin + end)


@dataclass(frozen=True)
class Rig:
    """Facts about the rig that a checkpoint does not contain."""

    name: str
    hz: float
    # Modality of each camera; [height, width] of its pictures where they are resized.
    cameras: dict[str, str]
    picture: tuple[int, int] | None
    # x y z and quaternion x y z w of the tip, the opening of the gripper, what is moved.
    pose: Columns
    gripper: Columns
    actuator: str
    # The smallest and largest position that is executed.
    low: list[float]
    high: list[float]
    max_age_ms: int
    # The tip's rotation when a run begins: a matrix that holds for every run, or where its quaternion is. Without them it is
    # that of the run's first pose.
    start: np.ndarray | None = None
    start_columns: Columns | None = None


def policy(made: Policy, rig: Rig, graphs: dict[str, str], folder: Path) -> dict:
    """The contents of policy.json beside `graphs`, whose files are in `folder`."""
    config = made.config
    pose = rig.pose
    base = {"modality": pose.modality, "position": pose.part(0, 3).slice, "rotation": pose.part(3, 7).slice}
    return {
        "format": FORMAT,
        "name": rig.name,
        "mask_aware": False,
        "n_obs_steps": config.n_obs_steps,
        "horizon": config.horizon,
        "n_action_steps": config.n_action_steps,
        # The first action is of the row of the newest observation.
        "action_start": 0,
        "control_hz": rig.hz,
        "max_observation_age_ms": rig.max_age_ms,
        "observations": [observation(made, rig, name) for name in inputs(config, rig.start)],
        "mask": None,
        "action": {
            "actuator": rig.actuator,
            "shape": [ACTION_LEN],
            "names": NAMES,
            "units": UNITS,
            "representation": "relative" if config.relative else "absolute",
            "rotation": "rotation_6d",
            **({"base": base} if config.relative else {}),
            "limits": limits(made, rig),
            "normalization": normalization(made),
        },
        "scheduler": config.scheduler,
        "graphs": bundle.graphs(graphs, folder),
        "training": {
            "source": "UMI DiffusionUnetTimmPolicy checkpoint",
            "weights": config.weights,
            "weights_sha256": bundle.sha256(config.file),
            "exported_with": {name: version(name) for name in ("torch", "onnx")},
            "config": config.raw,
        },
    }


def observation(made: Policy, rig: Rig, name: str) -> dict:
    """An entry of `observations`. The normalisation is in the graph, behind what poses are relative to."""
    config = made.config
    if name in config.cameras:
        side = config.side
        resize, crop = cover(rig.picture, side) if rig.picture else (None, None)
        found = {"kind": "image", "modality": rig.cameras[name], "shape": [3, side, side], "color": "rgb"}
        found |= {"resize": resize, "crop": crop, "operation": None}
        seen = config.cameras[name]
    else:
        columns, rotation, seen = {
            POSITION: (rig.pose.part(0, 3), False, config.pose),
            ROTATION: (rig.pose.part(3, 7), True, config.pose),
            WIDTH: (rig.gripper, False, config.numbers.get(WIDTH)),
            START: (rig.start_columns or rig.pose.part(3, 7), True, Observation(1, 1)),
        }[name]
        found = {
            "kind": "vector",
            "modality": columns.modality,
            "shape": [6 if rotation else columns.end - columns.begin],
        }
        found |= {"slice": columns.slice} | ({"rotation": "rotation_6d"} if rotation else {})
    if name == START and rig.start_columns is None:
        found["operation"] = "first_of_run"
    found |= {} if seen.apart == 1 else {"down_sample_steps": seen.apart}
    return {"key": name, "required": True, **found, "normalization": {"mode": "identity"}}


def cover(size: tuple[int, int], side: int) -> tuple[list[int], list[int] | None]:
    """`resize` and `crop` of pictures of `size`: the smaller side becomes `side`, of the other the middle is kept, as
    diffusion_policy/common/cv2_util.py has it."""
    resize = [max(side, -(-side * length // min(size))) for length in size]
    return resize, None if resize == [side, side] else [side, side]


def limits(made: Policy, rig: Rig) -> dict:
    """The positions that the rig allows, any rotation, and the openings of the training data."""
    action = made.normalizer["action"]
    width = bundle.decimals([action.low[-1], action.high[-1]])
    ends = zip((rig.low, rig.high), (-1.0, 1.0), width, strict=True)
    return dict(
        zip(("min", "max"), ([*position, *[turn] * 4, opening] for position, turn, opening in ends), strict=True)
    )


def normalization(made: Policy) -> list[dict]:
    """The inverse of x * scale + offset."""
    action = made.normalizer["action"]
    scale, offset = (np.float64(part.numpy()) for part in (action.scale, action.offset))
    return [bundle.mean_std(0, np.float32(-offset / scale), np.float32(1 / scale))]


def write_card(policy: dict, folder: Path) -> None:
    low, high = (policy["action"]["limits"][name][:3] for name in ("min", "max"))
    notes = (
        f"Positions stay within {low} and {high}, openings within those of the training data. Not mask-aware: every "
        "observation is required. Of a picture the middle is seen, where UMI's program takes a random part of it."
    )
    if policy["action"]["representation"] == "relative":
        notes += " The poses that it observes and its actions are relative to the newest pose."
    bundle.write_card(policy, "UMI DiffusionUnetTimmPolicy", "export_umi_policy.py", notes, folder)
