"""ResNet-18 (He et al., 2016) without its classifier. Weights have torchvision's names, so that its files load.

From scratch it has group normalisation, because a moving average of weights does not work with batch statistics
(Chi et al., 2023). With weights from a file the statistics of that file are kept as they are.
"""

from __future__ import annotations

from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

CHANNELS = (64, 128, 256, 512)
# How many pixels of the picture's side one step of the features covers.
STRIDE = 32


class FrozenNorm(nn.Module):
    """Batch normalisation with constants: the statistics and factors of the file."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        for name, value in (("weight", 1.0), ("bias", 0.0), ("running_mean", 0.0), ("running_var", 1.0)):
            self.register_buffer(name, torch.full((channels,), value))

    def forward(self, x: Tensor) -> Tensor:
        scale = self.weight * (self.running_var + 1e-5).rsqrt()
        shift = self.bias - self.running_mean * scale
        return x * scale[:, None, None].to(x.dtype) + shift[:, None, None].to(x.dtype)


def norm(channels: int, frozen: bool) -> nn.Module:
    """The normalisation of a convolution's output."""
    return FrozenNorm(channels) if frozen else nn.GroupNorm(channels // 16, channels)


class Block(nn.Module):
    """Two convolutions beside a connection that skips them."""

    def __init__(self, inputs: int, outputs: int, stride: int, frozen: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.bn1 = norm(outputs, frozen)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.bn2 = norm(outputs, frozen)
        self.downsample = None
        if stride != 1 or inputs != outputs:
            self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), norm(outputs, frozen))

    def forward(self, x: Tensor) -> Tensor:
        skipped = x if self.downsample is None else self.downsample(x)
        return F.relu(self.bn2(self.conv2(F.relu(self.bn1(self.conv1(x))))) + skipped)


class ResNet18(nn.Module):
    """[B, 3, H, W] -> [B, 512, H / 32, W / 32], rounded up."""

    def __init__(self, frozen: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, CHANNELS[0], 7, 2, 3, bias=False)
        self.bn1 = norm(CHANNELS[0], frozen)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        for i, (inputs, outputs) in enumerate(zip((CHANNELS[0], *CHANNELS), CHANNELS, strict=False), 1):
            blocks = [Block(inputs, outputs, 1 if i == 1 else 2, frozen), Block(outputs, outputs, 1, frozen)]
            self.add_module(f"layer{i}", nn.Sequential(*blocks))

    def forward(self, x: Tensor) -> Tensor:
        x = self.maxpool(F.relu(self.bn1(self.conv1(x))))
        return self.layer4(self.layer3(self.layer2(self.layer1(x))))

    def load_file(self, path: Path) -> None:
        """Loads the weights of torchvision's resnet18, without those of its classifier."""
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
            wanted = self.state_dict()
            missing = sorted(set(wanted) - set(state))
            if missing:
                raise ValueError(f"no weight {missing[0]!r}")
            self.load_state_dict({name: state[name] for name in wanted})
        # What is not a file of weights fails in the container, the unpickler or the shapes.
        except Exception as error:
            raise ValueError(f"{path}: not the state_dict of torchvision's resnet18: {error}") from error
