"""The networks of timm that see UMI's pictures, with timm's names of weights: ResNet-18 and 34, ViT, ConvNeXt base.

UMI takes them apart (diffusion_policy/model/vision/timm_obs_encoder.py): of ResNet and ConvNeXt it keeps the modules up
to the features, as a list without names; of ViT it keeps all but the classifier.
"""

import re

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rapid_policy.resnet import CHANNELS, Block, norm

RESNETS = {"resnet18": (2, 2, 2, 2), "resnet34": (3, 4, 6, 3)}
# Width, depth and heads of a ViT.
VITS = {"tiny": (192, 12, 3), "small": (384, 12, 6), "base": (768, 12, 12), "large": (1024, 24, 16)}
CONVNEXTS = {"convnext_base": ((128, 256, 512, 1024), (3, 3, 27, 3))}
KNOWN = f"{', '.join(RESNETS)}, {', '.join(CONVNEXTS)}, vit_*_patch*_* ({', '.join(VITS)}; base and large also clip)"


def make(name: str, side: int, downsample: int, group_norm: bool) -> tuple[nn.Module, int]:
    """The network called `name` in timm and the channels of its features, for pictures of `side`.

    # Errors
    `ValueError`, in words that follow the name.
    """
    architecture = name.split(".")[0]
    if architecture in RESNETS and downsample in (16, 32):
        levels = 4 if downsample == 32 else 3
        return resnet(RESNETS[architecture][:levels], group_norm), CHANNELS[levels - 1]
    if architecture in CONVNEXTS and downsample == 32:
        channels, depths = CONVNEXTS[architecture]
        return convnext(channels, depths), channels[-1]
    if found := re.fullmatch(r"vit_([a-z]+)_patch(\d{1,4})(_clip)?_(\d{1,4})", architecture):
        size, patch, clip, expected = found[1], int(found[2]), bool(found[3]), int(found[4])
        if size in VITS and (not clip or size in ("base", "large")):
            if expected != side:
                raise ValueError(f"takes pictures of {expected}, but those of shape_meta have {side}")
            if not 1 <= patch <= side:
                raise ValueError(f"divides pictures of {side} in patches of {patch}")
            width, depth, heads = VITS[size]
            return ViT(side, patch, width, depth, heads, clip), width
    if architecture in (*RESNETS, *CONVNEXTS):
        raise ValueError(f"with downsample_ratio {downsample}: UMI has no such encoder")
    raise ValueError(f"is not supported: {KNOWN} are")


def resnet(depths: tuple[int, ...], group_norm: bool) -> nn.Sequential:
    """[B, 3, H, W] -> [B, C, h, w]"""
    first, layers = CHANNELS[0], []
    for inputs, outputs, depth in zip((first, *CHANNELS), CHANNELS, depths, strict=False):
        blocks = [Block(inputs, outputs, 1 if not layers else 2, not group_norm)]
        blocks += [Block(outputs, outputs, 1, not group_norm) for _ in range(depth - 1)]
        layers.append(nn.Sequential(*blocks))
    stem = nn.Conv2d(3, first, 7, 2, 3, bias=False), norm(first, not group_norm), nn.ReLU(), nn.MaxPool2d(3, 2, 1)
    return nn.Sequential(*stem, *layers)


class Mlp(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(x)))


class Attention(nn.Module):
    """Of every token to every token: [B, N, C] -> [B, N, C]"""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        tokens, width = x.shape[1:]
        q, k, v = self.qkv(x).reshape(-1, tokens, 3, self.heads, width // self.heads).permute(2, 0, 3, 1, 4).unbind(0)
        weights = (q * q.shape[-1] ** -0.5 @ k.transpose(-2, -1)).softmax(-1)
        return self.proj((weights @ v).transpose(1, 2).reshape(-1, tokens, width))


class Transformer(nn.Module):
    """One block of a ViT."""

    def __init__(self, width: int, heads: int, eps: float) -> None:
        super().__init__()
        self.norm1, self.attn = nn.LayerNorm(width, eps), Attention(width, heads)
        self.norm2, self.mlp = nn.LayerNorm(width, eps), Mlp(width)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.attn(self.norm1(x))
        return x + self.mlp(self.norm2(x))


class ViT(nn.Module):
    """[B, 3, H, W] -> [B, C], its class token. `clip`: as CLIP trained it, with a normalisation before the blocks."""

    def __init__(self, side: int, patch: int, width: int, depth: int, heads: int, clip: bool) -> None:
        super().__init__()
        eps = 1e-5 if clip else 1e-6
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, (side // patch) ** 2 + 1, width))
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, width, patch, patch, bias=not clip)})
        self.norm_pre = nn.LayerNorm(width, eps) if clip else nn.Identity()
        self.blocks = nn.Sequential(*(Transformer(width, heads, eps) for _ in range(depth)))
        self.norm = nn.LayerNorm(width, eps)

    def forward(self, x: Tensor) -> Tensor:
        x = self.patch_embed["proj"](x).flatten(2).transpose(1, 2)
        x = torch.cat([self.cls_token.expand(x.shape[0], -1, -1), x], 1) + self.pos_embed
        return self.norm(self.blocks(self.norm_pre(x)))[:, 0]


class ChannelNorm(nn.LayerNorm):
    """Over the channels of [B, C, H, W]."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class ConvNeXtBlock(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv_dw = nn.Conv2d(width, width, 7, padding=3, groups=width)
        self.norm, self.mlp = nn.LayerNorm(width, 1e-6), Mlp(width)
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        changed = self.mlp(self.norm(self.conv_dw(x).permute(0, 2, 3, 1)))
        return x + (changed * self.gamma).permute(0, 3, 1, 2)


def convnext(channels: tuple[int, ...], depths: tuple[int, ...]) -> nn.Sequential:
    """[B, 3, H, W] -> [B, C, H / 32, W / 32]"""
    stages = []
    for inputs, outputs, depth in zip((0, *channels), channels, depths, strict=False):
        stage = nn.Sequential()
        if inputs:
            stage.add_module("downsample", nn.Sequential(ChannelNorm(inputs, 1e-6), nn.Conv2d(inputs, outputs, 2, 2)))
        stage.add_module("blocks", nn.Sequential(*(ConvNeXtBlock(outputs) for _ in range(depth))))
        stages.append(stage)
    stem = nn.Sequential(nn.Conv2d(3, channels[0], 4, 4), ChannelNorm(channels[0], 1e-6))
    return nn.Sequential(stem, nn.Sequential(*stages))
