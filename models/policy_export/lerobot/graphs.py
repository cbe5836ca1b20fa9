"""The two graphs of a bundle, traced from a LeRobot policy."""

from pathlib import Path

import torch
from torch import Tensor, nn

from ..bundle import CONDITION, DENOISER, ENCODER, MASK
from ..graphs import Crop, Resize, trace, trace_denoiser
from .config import STATE_KEY, Config


def picture(settings, height: int, width: int) -> nn.Module:
    """Resize and centre crop of LeRobot's image encoder; they work on normalised pixels there, too."""
    steps, (rows, columns) = [], settings.resize_shape or (height, width)
    if (rows, columns) != (height, width):
        steps.append(Resize((height, width), (rows, columns)))
    return nn.Sequential(*steps, Crop((rows, columns), settings.crop_shape or (rows, columns)))


class Encoder(nn.Module):
    """Named observations, and the mask if there is one, to the condition of LeRobot's U-Net.

    LeRobot stacks its cameras into one tensor [B, To, N, 3, H, W]; here each has its own input, and what comes out has
    LeRobot's order: for every step the state, then the features of each camera.
    """

    def __init__(self, policy, config: Config, mask_aware: bool):
        super().__init__()
        model = policy.diffusion
        count = len(config.cameras)
        self.encoders = nn.ModuleList(
            model.rgb_encoder if policy.config.use_separate_rgb_encoder_per_camera else [model.rgb_encoder] * count
        )
        _, height, width = next(iter(config.cameras.values()))
        self.picture = picture(policy.config, height, width)
        self.n_obs_steps = config.n_obs_steps
        self.mask_aware = mask_aware

    def forward(self, *inputs: Tensor) -> Tensor:
        cameras, state = inputs[: len(self.encoders)], inputs[len(self.encoders)]
        features = [state]
        for index, (encoder, camera) in enumerate(zip(self.encoders, cameras, strict=True)):
            x = self.picture(camera.flatten(0, 1))
            x = torch.flatten(encoder.pool(encoder.backbone(x)), start_dim=1)
            # The batch is the one size left open: an unflatten would write that of the traced batch into the graph.
            x = encoder.relu(encoder.out(x)).reshape(-1, self.n_obs_steps, encoder.feature_dim)
            if self.mask_aware:
                # Selected rather than multiplied: the input of an absent camera, even NaN, has no effect.
                present = inputs[-1][:, index, None, None] > 0.5
                x = torch.where(present, x, torch.zeros_like(x))
            features.append(x)
        return torch.cat(features, dim=-1).flatten(start_dim=1)


class Denoiser(nn.Module):
    """One prediction of LeRobot's U-Net."""

    def __init__(self, policy):
        super().__init__()
        self.unet = policy.diffusion.unet

    def forward(self, sample: Tensor, timestep: Tensor, condition: Tensor) -> Tensor:
        return self.unet(sample, timestep, global_cond=condition)


def export(policy, config: Config, names: dict[str, str], mask_aware: bool, folder: Path) -> dict[str, str]:
    """Writes both graphs; `names` has the input of each observation. Returns the file of each graph.

    The wrappers are put into evaluation mode themselves: a fresh module starts in training mode.
    """
    n, batch = config.n_obs_steps, 2
    observations = [torch.rand(batch, n, *shape) for shape in config.cameras.values()]
    observations.append(torch.rand(batch, n, config.state_len))
    inputs = [names[key] for key in (*config.cameras, STATE_KEY)]
    if mask_aware:
        observations.append(torch.ones(batch, len(config.cameras)))
        inputs.append(MASK)
    encoder = Encoder(policy, config, mask_aware).eval()
    condition = trace(encoder, observations, inputs, CONDITION, folder / ENCODER)
    trace_denoiser(Denoiser(policy).eval(), (config.horizon, config.action_len), condition, folder / DENOISER)
    return {"encoder": ENCODER, "denoiser": DENOISER}
