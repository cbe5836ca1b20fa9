"""The two graphs of a bundle, of a policy of UMI.

The encoder's graph takes what a rig observes: pictures in 0..1, the arm's position, the first two rows of its rotation,
the gripper's width. What UMI's program does before its policy is in the graph: poses as seen from the newest one
(umi/real_world/real_inference_util.py), the middle of the pictures, the normalisation.
"""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from ..bundle import CONDITION, DENOISER, ENCODER
from ..graphs import Crop, Resize, trace, trace_denoiser
from .config import ACTION_LEN, LENGTHS, POSITION, ROTATION, SINCE_START, WIDTH, Config
from .networks import Policy

# The input with the arm's rotation when the run began, of a policy that sees its rotation since then.
START = "start_rotation"


def inputs(config: Config, start: np.ndarray | None) -> list[str]:
    """The encoder's inputs, in order; `start` is the rotation [3, 3] at the start of every run, if it is known."""
    sees_pose = {POSITION, ROTATION, SINCE_START} & set(config.numbers)
    # The modality that actions are relative to must be observed.
    names = [*config.cameras, *([POSITION] if sees_pose or config.relative else []), *([ROTATION] if sees_pose else [])]
    names += [WIDTH] if WIDTH in config.numbers else []
    return names + ([START] if SINCE_START in config.numbers and start is None else [])


class Encoder(nn.Module):
    """Observations as a rig has them, [B, n_obs_steps, ...] in the order of `inputs`, to UMI's condition."""

    def __init__(self, policy: Policy, start: np.ndarray | None):
        super().__init__()
        self.config, self.encoder = policy.config, policy.obs_encoder
        self.names = inputs(policy.config, start)
        side, kept = (policy.config.side,) * 2, policy.config.vision.crop
        self.picture = nn.Identity()
        if kept is not None and (kept, kept) != side:
            self.picture = nn.Sequential(Crop(side, (kept, kept)), Resize((kept, kept), side))
        for key, linear in policy.normalizer.items():
            shape = (-1, 1, 1) if key in policy.config.cameras else (-1,)
            self.register_buffer(f"scale_{key}", linear.scale.reshape(shape), persistent=False)
            self.register_buffer(f"offset_{key}", linear.offset.reshape(shape), persistent=False)
        fixed = None if start is None else torch.tensor(start, dtype=torch.float32)
        self.register_buffer("start", fixed, persistent=False)

    def forward(self, *given: Tensor) -> Tensor:
        raw = dict(zip(self.names, given, strict=True))
        seen = {key: raw[key][:, -steps.steps :] for key, steps in self.config.cameras.items()}
        seen |= self.pose(raw) if ROTATION in raw else {}
        if WIDTH in raw:
            seen[WIDTH] = raw[WIDTH][:, -self.config.numbers[WIDTH].steps :]
        used = (*self.config.cameras, *self.config.numbers)
        seen = {key: seen[key] * getattr(self, f"scale_{key}") + getattr(self, f"offset_{key}") for key in used}
        return self.encoder(seen | {key: self.picture(seen[key]) for key in self.config.cameras})

    def pose(self, raw: dict[str, Tensor]) -> dict[str, Tensor]:
        """The observations that are of the arm's pose."""
        steps = self.config.pose.steps
        position, rotation = raw[POSITION][:, -steps:], matrix(raw[ROTATION][:, -steps:])
        start = matrix(raw[START][:, -1:]) if START in raw else self.start
        seen = {} if start is None else {SINCE_START: rows(start.transpose(-1, -2) @ rotation)}
        if self.config.relative:
            newest = rotation[:, -1:]
            position = ((position - position[:, -1:])[..., None, :] @ newest)[..., 0, :]
            rotation = newest.transpose(-1, -2) @ rotation
        return seen | {POSITION: position, ROTATION: rows(rotation)}


def matrix(six: Tensor) -> Tensor:
    """The first two rows of rotations [..., 6] -> [..., 3, 3]"""
    x, y = six[..., :3], six[..., 3:]
    return torch.stack([x, y, torch.linalg.cross(x, y)], -2)


def rows(rotation: Tensor) -> Tensor:
    """[..., 3, 3] -> [..., 6]"""
    return rotation[..., :2, :].flatten(-2)


def export(policy: Policy, start: np.ndarray | None, folder: Path) -> dict[str, str]:
    """Writes both graphs. Returns the file of each."""
    config, batch = policy.config, 2
    sides = (3, config.side, config.side)
    shapes = (
        {key: sides for key in config.cameras} | {key: (length,) for key, length in LENGTHS.items()} | {START: (6,)}
    )
    names = inputs(config, start)
    examples = [torch.rand(batch, config.n_obs_steps, *shapes[name]) for name in names]
    condition = trace(Encoder(policy, start).eval(), examples, names, CONDITION, folder / ENCODER)
    trace_denoiser(policy.model.eval(), (config.horizon, ACTION_LEN), condition, folder / DENOISER)
    return {"encoder": ENCODER, "denoiser": DENOISER}
