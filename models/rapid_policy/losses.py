"""The loss of a batch, and how a GPU computes it.

Invariant: a loss is a function of its arguments and the weights alone; noise and windows are drawn by the caller.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .diffusion import add_noise, alphas_cumprod
from .model import Policy


class Losses(nn.Module):
    """The loss of a batch, as one module: what several processes compute together."""

    def __init__(self, policy: Policy, device: torch.device, *, outcomes: bool = True) -> None:
        """Without `outcomes`, the loss is of the noise alone, which is what a bundle predicts."""
        super().__init__()
        self._outcomes = outcomes and policy.outcomes is not None
        self.policy = policy
        self._device, self._precision = device, policy.spec.training.precision
        self._table = alphas_cumprod().to(device)

    def forward(self, observations: dict[str, Tensor], mask: Tensor | None, clean: Tensor, timestep: Tensor,
                noise: Tensor, outcome: Tensor) -> Tensor:  # fmt: skip
        """Mean squared error of the predicted noise and, weighted, of the `outcome` [B, Da] as pictures predict it."""
        # `auto` is for the encoder only: its convolutions gain most from half precision, the denoiser's small ones nothing.
        both = self._precision == "bf16"
        half = both or (self._precision == "auto" and half_width(self._device))
        with torch.autocast(self._device.type, torch.bfloat16, enabled=half):
            condition = self.policy.encoder.encode(observations, mask, pooled=True)
        draws = len(clean) // len(condition)
        seen = condition.float()
        condition = seen.repeat(draws, 1)
        with torch.autocast(self._device.type, torch.bfloat16, enabled=both):
            predicted = self.policy.denoiser(add_noise(clean, noise, timestep, self._table), timestep, condition)
        loss = F.mse_loss(predicted.float(), noise)
        if self._outcomes:
            loss = loss + self.policy.outcomes.loss(seen, outcome)
        return loss


class Replayed(nn.Module):
    """`Losses` whose kernels a GPU gets as one graph: they are many and small, and launching each by itself keeps it waiting.
    The first batch determines the sizes."""

    def __init__(self, losses: nn.Module, arguments: tuple[Any, ...]) -> None:
        super().__init__()
        self._keys, self._has_mask = list(arguments[0]), arguments[1] is not None
        graph = _Flat(losses, self._keys, self._has_mask)
        self._graph = torch.cuda.make_graphed_callables(graph, self._flat(arguments), allow_unused_input=True)

    def _flat(self, arguments: tuple[Any, ...]) -> tuple[Tensor, ...]:
        observations, mask, *others = arguments
        return (*(observations[key] for key in self._keys), *([mask] if self._has_mask else []), *others)

    def forward(self, *arguments: Any) -> Tensor:
        return self._graph(*self._flat(arguments))


class _Flat(nn.Module):
    """`Losses` with tensors as its only arguments, as a graph needs them."""

    def __init__(self, losses: nn.Module, keys: list[str], has_mask: bool) -> None:
        super().__init__()
        self.losses, self._keys, self._has_mask = losses, keys, has_mask

    def forward(self, *tensors: Tensor) -> Tensor:
        observations = dict(zip(self._keys, tensors, strict=False))
        others = tensors[len(self._keys) :]
        return self.losses(observations, *others) if self._has_mask else self.losses(observations, None, *others)


def half_width(device: torch.device) -> bool:
    """Whether the device computes natively in bfloat16; emulation would cost time."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    return bool(torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported())
