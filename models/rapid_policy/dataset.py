"""Windows of episodes as inputs of the networks: normalised, pooled, shifted at random."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from .episodes import Episode
from .model import POOL
from .normalize import MinMax
from .spec import Observation, Spec

# Random shift of a picture in pooled pixels, each way: the gel may sit anywhere in its holder, the wrist camera is
# what the arm is guided by and may not.
SHIFT = {None: 1, "diff_to_reference": 2}
PAD = max(SHIFT.values())
BRIGHTNESS = 0.1
STATE_NOISE = 0.01


@dataclass
class Batch:
    """B windows."""

    observations: dict[str, Tensor]
    """Pictures f32 [B, To, 3, H / POOL, W / POOL] and vectors f32 [B, To, D], in -1..1, by key."""
    present: Tensor
    """bool [B, M]"""
    actions: Tensor
    """f32 [B, Tp, Da] in -1..1"""


class Dataset:
    """All ticks of all episodes in sequence, and the windows among them.

    A window belongs to a tick. It does not reach over a tick that lacks a required modality or an action, nor over a
    gap in the frame index: at such a place one segment ends and another begins, and steps beyond either end repeat it.
    """

    def __init__(self, spec: Spec, episodes: list[Episode]) -> None:
        self.spec = spec
        self.windows = np.concatenate(list(_windows(spec, episodes)))
        if not len(self.windows):
            raise ValueError("no window to learn from: every tick lacks an action or a required modality")
        used = self.windows[:, 0]
        self.present = np.stack([np.concatenate([e.present[o.modality] for e in episodes]) for o in spec.images], 1)
        self.ranges: dict[str, MinMax] = {}
        self.vectors: dict[str, NDArray[np.float32]] = {}
        for o in spec.vectors:
            values = np.concatenate([e.values[o.modality] for e in episodes])
            self.ranges[o.key] = MinMax.of(o.key, values[used])
            self.vectors[o.key] = self.ranges[o.key].apply(values)
        actions = np.concatenate([e.actions for e in episodes])
        self.ranges["action"] = MinMax.of("action", actions[used])
        self.actions = self.ranges["action"].apply(actions)
        self.pictures = {o.key: np.concatenate([pool(o, e) for e in episodes]) for o in spec.images}

    def draw(self, random: np.random.Generator, size: int) -> Batch:
        """`size` windows at random, each with its own shift, brightness and noise."""
        tick, begin, end = self.windows[random.integers(len(self.windows), size=size)].T
        seen = tick[:, None] + np.arange(1 - self.spec.n_obs_steps, 1)
        seen = np.maximum(seen, begin[:, None])
        done = tick[:, None] - self.spec.action_start + np.arange(self.spec.horizon)
        done = np.clip(done, begin[:, None], end[:, None] - 1)
        observations = {}
        for i, o in enumerate(self.spec.images):
            # Just plugged in again: the earlier steps show the first new picture, as at the start.
            steps = np.where(self.present[seen, i], seen, tick[:, None])
            observations[o.key] = torch.from_numpy(self._pictures(o, steps, random))
        for o in self.spec.vectors:
            values = self.vectors[o.key][seen]
            noise = random.standard_normal(values.shape, np.float32) * STATE_NOISE
            observations[o.key] = torch.from_numpy(values + noise)
        return Batch(observations, torch.from_numpy(self.present[tick]), torch.from_numpy(self.actions[done]))

    def _pictures(self, o: Observation, steps: NDArray[np.int64], random: np.random.Generator) -> NDArray[np.float32]:
        """[B, To, 3, h, w] of the rows `steps` [B, To]; all steps of a window have the same shift."""
        source = self.pictures[o.key]
        height, width = (side // POOL for side in o.shape[1:])
        shift = SHIFT[o.operation]
        corners = random.integers(PAD - shift, PAD + shift + 1, (len(steps), 2))
        pictures = np.empty((*steps.shape, 3, height, width), np.float32)
        for i, (top, left) in enumerate(corners):
            pictures[i] = source[steps[i], :, top : top + height, left : left + width]
        if o.operation is None:
            gain = random.uniform(1 - BRIGHTNESS, 1 + BRIGHTNESS, (len(steps), 1, 1, 1, 1)).astype(np.float32)
            pictures = (pictures + 1) * gain - 1
        return pictures


def pool(o: Observation, episode: Episode) -> NDArray[np.float32]:
    """[T, 3, H / POOL + 2 PAD, W / POOL + 2 PAD]: pictures in -1..1, averaged, with their edges repeated outwards.

    With min 0 and max 1, normalising is v * 2 - 1; of (v - reference) / 2 + 0.5 that is v - reference.
    """
    pictures = _unit(episode.values[o.modality])
    if o.operation == "diff_to_reference":
        pictures = pictures - _unit(episode.references[o.modality][None])
    else:
        pictures = pictures * 2 - 1
    padded = F.pad(F.avg_pool2d(pictures, POOL), (PAD, PAD, PAD, PAD), mode="replicate")
    return padded.numpy() * episode.present[o.modality][:, None, None, None]


def _unit(pictures: NDArray[np.uint8]) -> Tensor:
    """u8 [T, H, W, 3] -> f32 [T, 3, H, W] in 0..1"""
    return torch.from_numpy(pictures).permute(0, 3, 1, 2).float() / 255


def _windows(spec: Spec, episodes: list[Episode]) -> list[NDArray[np.int64]]:
    """For each episode [W, 3]: a tick, and the start and end of its segment, as rows of all episodes."""
    windows, start = [], 0
    for episode in episodes:
        usable = episode.acted.copy()
        for o in spec.observations:
            if o.required:
                usable &= episode.present[o.modality]
        # Pictures that are not required: at least one of them must be present.
        if spec.images:
            usable &= np.logical_or.reduce([episode.present[o.modality] for o in spec.images])
        breaks = np.flatnonzero(~(usable[1:] & usable[:-1] & (np.diff(episode.ticks) == 1))) + 1
        for segment in np.split(np.arange(len(episode)), breaks):
            if usable[segment[0]]:
                ends = np.broadcast_to([segment[0], segment[-1] + 1], (len(segment), 2))
                windows.append(np.column_stack([segment, ends]) + start)
        start += len(episode)
    return windows or [np.empty((0, 3), np.int64)]
