"""The diffusion process: how noise is added in training, and the DDIM sampler that removes it.

The tables are float32 and the formulas those of the diffusers library, which the program's own scheduler follows too.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from .experiment import TRAIN_TIMESTEPS

MAX_BETA = 0.999


def betas(timesteps: int = TRAIN_TIMESTEPS) -> Tensor:
    """[timesteps] `squaredcos_cap_v2`: variance of the noise that each step adds."""

    def kept(t: float) -> float:
        return math.cos((t + 0.008) / 1.008 * math.pi / 2) ** 2

    return torch.tensor(
        [min(1 - kept((i + 1) / timesteps) / kept(i / timesteps), MAX_BETA) for i in range(timesteps)],
        dtype=torch.float32,
    )


def alphas_cumprod(timesteps: int = TRAIN_TIMESTEPS) -> Tensor:
    """[timesteps] how much of the signal's variance is left after each step."""
    return torch.cumprod(1 - betas(timesteps), 0)


def add_noise(clean: Tensor, noise: Tensor, timestep: Tensor, table: Tensor) -> Tensor:
    """`clean`, `noise` [B, Tp, Da], `timestep` i64 [B], `table` of `alphas_cumprod` -> [B, Tp, Da]."""
    alpha = table[timestep][:, None, None]
    return alpha.sqrt() * clean + (1 - alpha).sqrt() * noise


def ddim_timesteps(steps: int, timesteps: int = TRAIN_TIMESTEPS) -> list[int]:
    """The steps visited, descending, in `leading` spacing."""
    if not 1 <= steps <= timesteps:
        raise ValueError(f"{steps} inference steps: expected 1 to {timesteps}")
    return [i * (timesteps // steps) for i in reversed(range(steps))]


def ddim(
    denoise: Callable[[Tensor, Tensor], Tensor], noise: Tensor, steps: int, timesteps: int = TRAIN_TIMESTEPS
) -> Tensor:
    """Samples with eta 0. `denoise(sample [B, Tp, Da], timestep i64 [B])` predicts the noise; `noise` [B, Tp, Da]."""
    table, stride, sample = alphas_cumprod(timesteps), timesteps // steps, noise
    for t in ddim_timesteps(steps, timesteps):
        alpha = table[t]
        previous = table[t - stride] if t >= stride else torch.tensor(1.0)
        epsilon = denoise(sample, torch.full((len(sample),), t, dtype=torch.int64))
        # The prediction is clipped, but the noise is not recomputed from it, as in diffusers.
        clean = ((sample - (1 - alpha).sqrt() * epsilon) / alpha.sqrt()).clamp(-1, 1)
        sample = previous.sqrt() * clean + (1 - previous).sqrt() * epsilon
    return sample
