"""UMI's policy as PyTorch computes it: the encoder of observations, the denoiser, and the numbers of its normaliser.

Followed are diffusion_policy/policy/diffusion_unet_timm_policy.py and model/vision/timm_obs_encoder.py: every picture's
features in the order of the keys, all steps of one key side by side, then the numbers in the same way.
"""

import re
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from rapid_policy.model import UNetDenoiser

from .. import Unsupported
from ..bundle import fits
from . import backbones
from .config import ACTION_LEN, LENGTHS, Config

# Of the U-Net's names, from those of rapid_policy to those of model/diffusion/conditional_unet1d.py.
RENAMED = [
    (r"^step\.0\.", "diffusion_step_encoder.1."),
    (r"^step\.2\.", "diffusion_step_encoder.3."),
    (r"^(down|up)\.(\d+)\.2\.", r"\1_modules.\2.2.conv."),
    (r"^(down|up)\.", r"\1_modules."),
    (r"^middle\.", "mid_modules."),
    (r"^out\.", "final_conv."),
    (r"\.first\.", ".blocks.0."),
    (r"\.second\.", ".blocks.1."),
    (r"\.film\.", ".cond_encoder."),
    (r"\.skip\.", ".residual_conv."),
]
# What has no effect on what is computed: counters of batch statistics, and what holds UMI's device.
WITHOUT_EFFECT = re.compile(r"num_batches_tracked$|_dummy_variable$")
NORMALIZER = "normalizer.params_dict."


class AttentionPool(nn.Module):
    """[B, C, side, side] -> [B, C]: the mean of all places attends to them."""

    def __init__(self, side: int, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.positional_embedding = nn.Parameter(torch.zeros(side**2 + 1, width))
        self.q_proj, self.k_proj, self.v_proj, self.c_proj = (nn.Linear(width, width) for _ in range(4))

    def forward(self, x: Tensor) -> Tensor:
        x = x.flatten(2).transpose(1, 2)
        x = torch.cat([x.mean(1, keepdim=True), x], 1) + self.positional_embedding
        tokens, width = x.shape[1:]

        def heads(projected: Tensor, count: int) -> Tensor:
            return projected.reshape(-1, count, self.heads, width // self.heads).transpose(1, 2)

        q, k, v = heads(self.q_proj(x[:, :1]), 1), heads(self.k_proj(x), tokens), heads(self.v_proj(x), tokens)
        weights = (q * (width // self.heads) ** -0.5 @ k.transpose(-2, -1)).softmax(-1)
        return self.c_proj((weights @ v).transpose(1, 2).reshape(-1, width))


class Aggregation(nn.Module):
    """Features of a picture [B, C, side, side] -> [B, C]. Without a `kind` that is done already, as by a ViT."""

    def __init__(self, kind: str | None, side: int, width: int) -> None:
        super().__init__()
        self.kind = kind
        if kind == "soft_attention":
            self.attention = nn.Sequential(nn.Linear(width, 1, bias=False), nn.Softmax(dim=1))
        elif kind == "spatial_embedding":
            self.spatial_embedding = nn.Parameter(torch.zeros(side**2, width))
        elif kind == "attention_pool_2d":
            self.attention_pool_2d = AttentionPool(side, width, width // 64)

    def aggregate(self, x: Tensor) -> Tensor:
        if self.kind is None:
            return x
        if self.kind == "attention_pool_2d":
            return self.attention_pool_2d(x)
        x = x.flatten(2).transpose(1, 2)
        if self.kind == "avg":
            return x.mean(1)
        if self.kind == "max":
            return x.amax(1)
        if self.kind == "soft_attention":
            return (x * self.attention(x)).sum(1)
        return (x * self.spatial_embedding).mean(1)


class ObservationEncoder(Aggregation):
    """Normalised pictures [B, T, 3, H, W], cropped, and numbers [B, T, D], by key -> [B, Dc]."""

    def __init__(self, config: Config) -> None:
        vision = config.vision

        def made() -> tuple[nn.Module, int]:
            try:
                return backbones.make(vision.model, config.side, vision.downsample, vision.group_norm)
            except ValueError as error:
                key = "cfg.policy.obs_encoder.model_name"
                raise Unsupported(f"{config.file}: {key}: {vision.model!r} {error}") from error

        first, width = made()
        super().__init__(vision.aggregation, config.side // vision.downsample, width)
        self.key_model_map = nn.ModuleDict(
            {key: first if vision.shared or not i else made()[0] for i, key in enumerate(config.cameras)}
        )
        self.steps, self.numbers = {key: seen.steps for key, seen in config.cameras.items()}, list(config.numbers)
        self.width = width

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        features = []
        for key, network in self.key_model_map.items():
            found = self.aggregate(network(observations[key].flatten(0, 1)))
            features.append(found.reshape(-1, self.steps[key] * self.width))
        return torch.cat(features + [observations[key].flatten(1) for key in self.numbers], -1)


@dataclass(frozen=True)
class Linear:
    """A normalisation: x * scale + offset. A number per dimension."""

    scale: Tensor
    offset: Tensor
    low: Tensor
    high: Tensor


class Policy(nn.Module):
    """The networks with the weights of a checkpoint; `normalizer` by key of an observation, and of `action`."""

    def __init__(self, config: Config, state: dict[str, Tensor]) -> None:
        super().__init__()
        self.config = config
        # Without memory first: the sizes are those that the configuration states, whatever the file has.
        with torch.device("meta"):
            self._make()
        for name, module in (("obs_encoder.model_name", self.obs_encoder), ("down_dims", self.model)):
            fits(f"{config.file}: cfg.policy.{name}", 4 * sum(p.numel() for p in module.parameters()))
        found = self._placed(state)
        self._make()
        self.load_state_dict(found)
        lengths = {key: 3 for key in config.cameras} | {key: LENGTHS[key] for key in config.numbers}
        lengths["action"] = ACTION_LEN
        self.normalizer = {key: linear(config, state, key, length) for key, length in lengths.items()}

    def _make(self) -> None:
        config = self.config
        self.obs_encoder = ObservationEncoder(config)
        condition = sum(seen.steps for seen in config.cameras.values()) * self.obs_encoder.width
        condition += sum(seen.steps * LENGTHS[key] for key, seen in config.numbers.items())
        self.model = UNetDenoiser(ACTION_LEN, condition, config.widths, config.kernel, config.step_features)

    def _placed(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """The weights by their names here: every weight of the checkpoint has its place, and every place its weight."""
        names = {original(name): name for name in self.state_dict()}
        found = {k: v for k, v in state.items() if not k.startswith(NORMALIZER) and not WITHOUT_EFFECT.search(k)}
        entry = f"{self.config.file}: state_dicts.{self.config.weights}"
        for what, wrong in (("missing", set(names) - set(found)), ("surplus", set(found) - set(names))):
            if wrong:
                raise Unsupported(
                    f"{entry}.{min(wrong)}: {what} ({len(wrong)} of that kind): the weights do not fit cfg.policy"
                )
        own = self.state_dict()
        for name, value in found.items():
            wanted = own[names[name]]
            if value.shape != wanted.shape:
                raise Unsupported(f"{entry}.{name}: {list(value.shape)}, by cfg.policy it is {list(wanted.shape)}")
        return {names[name]: value.float() for name, value in found.items()}


def original(name: str) -> str:
    """UMI's name of a weight."""
    if not name.startswith("model."):
        return name
    name = name.removeprefix("model.")
    for pattern, replacement in RENAMED:
        name = re.sub(pattern, replacement, name)
    return f"model.{name}"


def linear(config: Config, state: dict[str, Tensor], key: str, length: int) -> Linear:
    """The normalisation of `key`, which is one for all its `length` dimensions or one for each."""
    entry = f"{config.file}: state_dicts.{config.weights}.{NORMALIZER}{key}"
    found = []
    for name in ("scale", "offset", "input_stats.min", "input_stats.max"):
        if (value := state.get(f"{NORMALIZER}{key}.{name}")) is None:
            raise Unsupported(f"{entry}.{name}: missing: nothing states how {key} is normalised")
        if value.shape not in ((length,), (1,)):
            raise Unsupported(
                f"{entry}.{name}: {list(value.shape)}, but {key} has {length} numbers; one normalisation for each step "
                "(temporally_independent_normalization) is not supported"
            )
        if not torch.isfinite(value).all():
            raise Unsupported(f"{entry}.{name}: not finite")
        found.append(value.float().expand(length).clone())
    if not (found[0] > 0).all():
        raise Unsupported(f"{entry}.scale: not above 0")
    return Linear(*found)
