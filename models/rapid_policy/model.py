"""The two networks: a mask-aware encoder of observations, and the denoiser of action sequences.

The denoiser is one of Diffusion Policy's (Chi et al., 2023), the one-dimensional U-Net or the transformer, at a size that
one processor core runs ten times in a control period. Both have the same inputs and output.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .experiment import SMALL_POOL, Encoder, Experiment
from .resnet import CHANNELS, STRIDE, ResNet18

SHARED = "shared"


class SpatialSoftmax(nn.Module):
    """Where in the picture each of `keypoints` features lies: [B, C, h, w] -> [B, 2 * keypoints], in -1..1."""

    def __init__(self, channels: int, keypoints: int, height: int, width: int) -> None:
        super().__init__()
        self.features = nn.Conv2d(channels, keypoints, 1)
        self.sharpness = nn.Parameter(torch.tensor(4.0))
        y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
        # Not a weight, because it is not learned: neither a checkpoint nor the reader of a graph needs it.
        self.register_buffer("grid", torch.stack([x.reshape(-1), y.reshape(-1)], 1), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        attention = F.softmax(self.features(x).flatten(2) * self.sharpness, -1)
        return (attention @ self.grid).flatten(1)


class SmallEncoder(nn.Module):
    """One picture [B, 3, H, W] in -1..1 -> [B, features].

    Half its size is enough to see a lattice: the picture is averaged to that first.
    """

    def __init__(self, height: int, width: int, sizes: Encoder) -> None:
        super().__init__()

        def block(inputs: int, outputs: int, kernel: int, stride: int) -> nn.Sequential:
            convolution = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
            return nn.Sequential(convolution, nn.GroupNorm(max(1, outputs // 8), outputs), nn.ReLU())

        c = sizes.width
        self.net = nn.Sequential(block(3, c, 5, 2), block(c, 2 * c, 3, 2), block(2 * c, 4 * c, 3, 1))
        # The mean shows what is present, the keypoints where it is.
        self.where = SpatialSoftmax(4 * c, sizes.keypoints, height // SMALL_POOL // 4, width // SMALL_POOL // 4)
        self.out = nn.Linear(4 * c + 2 * sizes.keypoints, sizes.features)

    def forward(self, x: Tensor) -> Tensor:
        return self.pooled(F.avg_pool2d(x, SMALL_POOL))

    def pooled(self, x: Tensor) -> Tensor:
        """The same for a picture that is already pooled: [B, 3, H / 2, W / 2]."""
        features = self.net(x)
        return self.out(torch.cat([features.mean((2, 3)), self.where(features)], 1))


class ResNetEncoder(nn.Module):
    """One picture [B, 3, H, W] in -1..1 -> [B, features]: mean and keypoints of what ResNet-18 finds."""

    # Of the pictures that torchvision's weights were trained on, for values in 0..1.
    MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)

    def __init__(self, height: int, width: int, sizes: Encoder) -> None:
        super().__init__()
        self.trunk = ResNet18(frozen=sizes.weights is not None)
        self.where = SpatialSoftmax(CHANNELS[-1], sizes.keypoints, -(-height // STRIDE), -(-width // STRIDE))
        self.out = nn.Linear(CHANNELS[-1] + 2 * sizes.keypoints, sizes.features)
        mean, std = (torch.tensor(v).view(3, 1, 1) for v in (self.MEAN, self.STD))
        plain = sizes.weights is None
        self.register_buffer("scale", torch.ones(3, 1, 1) if plain else 0.5 / std, persistent=False)
        self.register_buffer("offset", torch.zeros(3, 1, 1) if plain else (0.5 - mean) / std, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        features = self.trunk(x * self.scale + self.offset)
        return self.out(torch.cat([features.mean((2, 3)), self.where(features)], 1))

    pooled = forward


ENCODERS = {"small": SmallEncoder, "resnet18": ResNetEncoder}


class HistoryPooling(nn.Module):
    """Embeddings [B, S, F] of the steps of a history, bool [B, S] which of them are valid -> [B, F]: the mean of those,
    weighted by a learned score of each; zeros if there are none.

    At first the score is the age alone, and the newest valid step has nearly all the weight: before it has learned which
    steps to remember, it remembers the last one.
    """

    # Difference between the initial scores of the two steps that are nearest to each other: with less, the last is not most of
    # what is remembered; with much more, the others have no gradient.
    APART = 3.0
    # The score of a step that is not valid, beside which any other one has all the weight.
    LEAST = -1e9

    def __init__(self, features: int, ages: Sequence[int]) -> None:
        """`ages`: for each step, how many ticks before the newest observation it is."""
        super().__init__()
        self.score = nn.Linear(features, 1, bias=False)
        nn.init.zeros_(self.score.weight)
        times = sorted(set(ages))
        nearest = min((b - a for a, b in zip(times, times[1:], strict=False)), default=1)
        self.places = nn.Parameter(-torch.tensor(ages, dtype=torch.float32) * (self.APART / nearest))

    def forward(self, embeddings: Tensor, valid: Tensor) -> Tensor:
        # Selected, not multiplied: a step that is not valid may contain anything.
        embeddings = torch.where(valid.unsqueeze(-1), embeddings.float(), 0.0)
        scores = self.score(embeddings).squeeze(-1).float() + self.places
        weights = F.softmax(torch.where(valid, scores, self.LEAST), -1)
        # Without any valid step the softmax has given all of them the same weight.
        return (torch.where(valid, weights, 0.0).unsqueeze(-1) * embeddings).sum(1)


class ObservationEncoder(nn.Module):
    """All observations -> `global_cond` [B, Dc]: at each step the vectors and an embedding of each picture.

    The embedding of an absent picture is replaced by what its histories remember of it, or by zeros if it has none.
    """

    def __init__(self, spec: Experiment) -> None:
        super().__init__()
        self.keys = [*(o.key for o in spec.observation), *(o.valid for o in spec.histories)]
        self.image_keys = [o.key for o in spec.images]
        self.vector_keys = [o.key for o in spec.vectors]
        self.mask_aware, self.shared = spec.policy.mask_aware, spec.encoder.shared
        kind = ENCODERS[spec.encoder.type]
        one_each = {SHARED: spec.images[0]} if self.shared and spec.images else {o.key: o for o in spec.images}
        self.images = nn.ModuleDict({key: kind(*o.shape[1:], spec.encoder) for key, o in one_each.items()})
        # By the key of the current picture, whose encoder sees them too.
        of_each = {o.key: [h for h in spec.histories if h.modality == o.modality] for o in spec.images}
        self.history_keys = {key: [(h.key, h.valid) for h in found] for key, found in of_each.items()}
        ages = {key: [age for h in found for age in h.ages] for key, found in of_each.items() if found}
        self.histories = nn.ModuleDict({key: HistoryPooling(spec.encoder.features, of) for key, of in ages.items()})

    def forward(self, *inputs: Tensor) -> Tensor:
        """Inputs in the order of the observations: pictures [B, To, 3, H, W], with a history [B, S, 3, H, W], vectors
        [B, To, D]; then the validity [B, S] of each history; then the mask."""
        observations = dict(zip(self.keys, inputs, strict=False))
        return self.encode(observations, inputs[-1] if self.mask_aware else None, pooled=False)

    def encode(self, observations: dict[str, Tensor], mask: Tensor | None, *, pooled: bool) -> Tensor:
        """`mask` [B, M], 1 for present pictures. `pooled`: the pictures are already pooled."""
        vectors = [observations[key] for key in self.vector_keys]
        embeddings = []
        for i, key in enumerate(self.image_keys):
            embedding = self._embed(key, observations[key], pooled=pooled)
            if mask is not None:
                # Selected, not multiplied: NaN times zero is still NaN, and an absent picture may contain anything.
                present = mask[:, None, i : i + 1] > 0.5
                embedding = torch.where(present, embedding, self._remembered(key, observations, embedding, pooled=pooled))
            embeddings.append(embedding)
        return torch.cat([x.float() for x in vectors + embeddings], -1).flatten(1)

    def _remembered(self, key: str, observations: dict[str, Tensor], now: Tensor, *, pooled: bool) -> Tensor:
        """What replaces the embedding `now` of an absent picture, the same at every step: [B, 1, F] or a zero."""
        if not self.history_keys[key]:
            return torch.zeros((), dtype=now.dtype, device=now.device)
        seen, there = [], []
        for history, valid in self.history_keys[key]:
            there.append(observations[valid] > 0.5)
            # A graph, in onnxruntime or on a GPU, computes all steps, valid or not; training on a CPU only the valid ones.
            fewer = pooled and now.device.type == "cpu"
            seen.append(self._embed(key, observations[history], pooled=pooled, there=there[-1] if fewer else None))
        return self.histories[key](torch.cat(seen, 1), torch.cat(there, 1)).unsqueeze(1).to(now.dtype)

    def _embed(self, key: str, pictures: Tensor, *, pooled: bool, there: Tensor | None = None) -> Tensor:
        """[B, To, 3, H, W] -> [B, To, F], by the encoder of the picture `key`; with `there` [B, To], zeros where it is false."""
        encoder = self.images[SHARED if self.shared else key]
        see = encoder.pooled if pooled else encoder
        if there is None:
            return see(pictures.flatten(0, 1)).unflatten(0, pictures.shape[:2])
        places = there.flatten().nonzero().squeeze(1)
        seen = see(pictures.flatten(0, 1)[places])
        return seen.new_zeros(there.numel(), seen.shape[1]).index_copy(0, places, seen).unflatten(0, there.shape)


class Outcomes(nn.Module):
    """`global_cond` [B, Dc] -> the last action of the episode, as some pictures predict it, each by itself.

    By itself, because a vector shows it too as soon as the trajectories to different endings diverge, and a picture would then
    have nothing more to learn. Each embedding is that of the newest step, or what is remembered of it; for zeros the
    prediction is the layer's bias.
    """

    def __init__(self, spec: Experiment) -> None:
        super().__init__()
        self._steps, self._features = spec.policy.n_obs_steps, spec.encoder.features
        # Where the pictures begin in a step of the condition.
        self._first = sum(o.shape[0] for o in spec.vectors)
        self.weights = {str(i): o.outcome for i, o in enumerate(spec.images) if o.outcome}
        self.heads = nn.ModuleDict({i: nn.Linear(self._features, spec.action_length) for i in self.weights})

    def forward(self, condition: Tensor) -> dict[str, Tensor]:
        """[B, Da] from each, by its place among the pictures."""
        newest = condition.unflatten(1, (self._steps, -1))[:, -1]
        pictures = newest[:, self._first :].unflatten(1, (-1, self._features))
        return {i: head(pictures[:, int(i)]) for i, head in self.heads.items()}

    def loss(self, condition: Tensor, outcome: Tensor) -> Tensor:
        """Mean squared errors to `outcome` [B, Da], each times its weight."""
        return torch.stack([self.weights[i] * F.mse_loss(found, outcome) for i, found in self(condition).items()]).sum()


class ConvBlock(nn.Module):
    """[B, C, T] -> [B, outputs, T]"""

    def __init__(self, inputs: int, outputs: int, kernel: int) -> None:
        super().__init__()
        convolution = nn.Conv1d(inputs, outputs, kernel, padding=kernel // 2)
        self.block = nn.Sequential(convolution, nn.GroupNorm(8, outputs), nn.Mish())

    def forward(self, x: Tensor) -> Tensor:
        return self.block(x)


class ResidualBlock(nn.Module):
    """Two convolutions, scaled and shifted by the condition (FiLM): [B, inputs, T], [B, D] -> [B, outputs, T]."""

    def __init__(self, inputs: int, outputs: int, condition: int, kernel: int) -> None:
        super().__init__()
        self.first, self.second = ConvBlock(inputs, outputs, kernel), ConvBlock(outputs, outputs, kernel)
        self.film = nn.Sequential(nn.Mish(), nn.Linear(condition, 2 * outputs))
        self.skip = nn.Conv1d(inputs, outputs, 1) if inputs != outputs else nn.Identity()

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        scale, shift = self.film(condition).unsqueeze(-1).chunk(2, 1)
        return self.second(scale * self.first(x) + shift) + self.skip(x)


STEP_FEATURES = 64


class StepEmbedding(nn.Sequential):
    """Diffusion step i64 [B] -> [B, outputs], by way of `d` frequencies"""

    def __init__(self, outputs: int, d: int = STEP_FEATURES) -> None:
        super().__init__(nn.Linear(d, 4 * d), nn.Mish(), nn.Linear(4 * d, outputs))
        frequencies = torch.exp(torch.arange(d // 2) * -(math.log(10_000) / (d // 2 - 1)))
        self.register_buffer("frequencies", frequencies, persistent=False)

    def forward(self, timestep: Tensor) -> Tensor:
        phase = timestep[:, None].float() * self.frequencies[None]
        return super().forward(torch.cat([phase.sin(), phase.cos()], -1))


class UNetDenoiser(nn.Module):
    """Sample [B, Tp, Da], timestep i64 [B], global_cond [B, Dc] -> the noise predicted in the sample [B, Tp, Da]."""

    def __init__(
        self, actions: int, condition: int, widths: tuple[int, ...], kernel: int, step_features: int = STEP_FEATURES
    ) -> None:
        super().__init__()
        self.step = StepEmbedding(step_features, step_features)
        c = condition + step_features
        levels = list(zip((actions, *widths[:-1]), widths, strict=True))
        self.down = nn.ModuleList(
            nn.ModuleList([ResidualBlock(i, o, c, kernel), ResidualBlock(o, o, c, kernel), shrink])
            for (i, o), shrink in zip(
                levels, [*(nn.Conv1d(o, o, 3, 2, 1) for _, o in levels[:-1]), nn.Identity()], strict=True
            )
        )
        self.middle = nn.ModuleList(ResidualBlock(widths[-1], widths[-1], c, kernel) for _ in range(2))
        self.up = nn.ModuleList(
            nn.ModuleList(
                [ResidualBlock(2 * o, i, c, kernel), ResidualBlock(i, i, c, kernel), nn.ConvTranspose1d(i, i, 4, 2, 1)]
            )
            for i, o in reversed(levels[1:])
        )
        self.out = nn.Sequential(ConvBlock(widths[0], widths[0], kernel), nn.Conv1d(widths[0], actions, 1))

    @classmethod
    def of(cls, spec: Experiment) -> UNetDenoiser:
        """The denoiser of an experiment."""
        return cls(spec.action_length, spec.condition, spec.denoiser.widths, spec.denoiser.kernel)

    def forward(self, sample: Tensor, timestep: Tensor, global_cond: Tensor) -> Tensor:
        c = torch.cat([self.step(timestep), global_cond], -1)
        x, kept = sample.transpose(1, 2), []
        for first, second, shrink in self.down:
            x = second(first(x, c), c)
            kept.append(x)
            x = shrink(x)
        for block in self.middle:
            x = block(x, c)
        for first, second, grow in self.up:
            x = grow(second(first(torch.cat([x, kept.pop()], 1), c), c))
        return self.out(x).transpose(1, 2)


class TransformerDenoiser(nn.Module):
    """The same by attention: a token for each action, which sees all others, the diffusion step and each observation step.

    What a bundle calls `global_cond` is the observation steps, one after the other.
    """

    def __init__(self, spec: Experiment) -> None:
        super().__init__()
        sizes, self.steps = spec.denoiser, spec.policy.n_obs_steps
        width = sizes.width
        self.actions = nn.Linear(spec.action_length, width)
        self.observation = nn.Linear(spec.condition // self.steps, width)
        self.step = StepEmbedding(width)
        self.action_places = nn.Parameter(0.02 * torch.randn(spec.policy.horizon, width))
        self.seen_places = nn.Parameter(0.02 * torch.randn(1 + self.steps, width))
        # Not nn.TransformerDecoder: its layers would begin with equal weights.
        self.layers = nn.ModuleList(
            nn.TransformerDecoderLayer(
                width, sizes.heads, 4 * width, sizes.dropout, "gelu", batch_first=True, norm_first=True
            )
            for _ in range(sizes.layers)
        )
        self.out = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, spec.action_length))

    def forward(self, sample: Tensor, timestep: Tensor, global_cond: Tensor) -> Tensor:
        observations = self.observation(global_cond.unflatten(1, (self.steps, -1)))
        seen = torch.cat([self.step(timestep)[:, None], observations], 1) + self.seen_places
        x = self.actions(sample) + self.action_places
        for layer in self.layers:
            x = layer(x, seen)
        return self.out(x)


DENOISERS = {"unet": UNetDenoiser.of, "transformer": TransformerDenoiser}


class Policy(nn.Module):
    """Both networks, for training."""

    def __init__(self, spec: Experiment) -> None:
        super().__init__()
        self.spec = spec
        self.encoder = ObservationEncoder(spec)
        self.denoiser = DENOISERS[spec.denoiser.type](spec)
        # For training only: no bundle has it.
        self.outcomes = Outcomes(spec) if spec.predicts_outcomes else None

    def start_from(self, weights: Path) -> None:
        """Gives the image encoders torchvision's weights to begin with."""
        for encoder in self.encoder.images.values():
            encoder.trunk.load_file(weights)


def parameters(modules: Iterable[nn.Module]) -> int:
    """Number of trainable parameters."""
    return sum(p.numel() for module in modules for p in module.parameters())
