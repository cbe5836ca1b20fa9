"""The two graphs of a bundle, traced from a LeRobot policy."""

import warnings
from pathlib import Path

import onnx
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .config import STATE_KEY, Config

OPSET = 17
MASK = "mask"
CONDITION = "global_cond"


class Picture(nn.Module):
    """Resize and centre crop of LeRobot's image encoder, for pictures of one size, as constants.

    They stay in the graph, because a bundle's own resize has no antialiasing and LeRobot's (torchvision's) has.
    Both work on normalised pixels, as in LeRobot.
    """

    def __init__(self, settings, height: int, width: int):
        super().__init__()
        self.resizes = settings.resize_shape is not None and tuple(settings.resize_shape) != (height, width)
        if self.resizes:
            # A bilinear resize is linear in each direction: applied to the identity it shows its matrix.
            rows, columns = settings.resize_shape
            self.register_buffer("rows", interpolation(height, rows))
            self.register_buffer("columns", interpolation(width, columns).T.contiguous())
            height, width = rows, columns
        crop_height, crop_width = settings.crop_shape or (height, width)
        # torchvision rounds half to even here, as Python does. Its CenterCrop itself cannot be traced.
        self.top, self.left = round((height - crop_height) / 2), round((width - crop_width) / 2)
        self.bottom, self.right = self.top + crop_height, self.left + crop_width

    def forward(self, x: Tensor) -> Tensor:
        if self.resizes:
            x = self.rows @ (x @ self.columns)
        return x[..., self.top : self.bottom, self.left : self.right]


def interpolation(size: int, target: int) -> Tensor:
    eye = torch.eye(size)[None, None]
    return F.interpolate(eye, (target, size), mode="bilinear", align_corners=False, antialias=True)[0, 0]


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
        self.picture = Picture(policy.config, height, width)
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
    condition = trace(encoder, observations, inputs, CONDITION, folder / "encoder.onnx")

    sample = torch.randn(batch, config.horizon, config.action_len)
    timestep = torch.zeros(batch, dtype=torch.int64)
    denoiser_inputs = ["sample", "timestep", CONDITION]
    trace(
        Denoiser(policy).eval(), [sample, timestep, condition], denoiser_inputs, "prediction", folder / "denoiser.onnx"
    )
    return {"encoder": "encoder.onnx", "denoiser": "denoiser.onnx"}


def trace(module: nn.Module, args: list[Tensor], inputs: list[str], output: str, file: Path) -> Tensor:
    """Writes the graph of `module` to `file`, and returns the result of `module` for `args`."""
    with warnings.catch_warnings():
        # torch prefers its newer exporter, and warns about it for every graph.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            tuple(args),
            str(file),
            input_names=inputs,
            output_names=[output],
            dynamic_axes={name: {0: "B"} for name in [*inputs, output]},
            opset_version=OPSET,
            dynamo=False,
        )
    with torch.no_grad():
        made = module(*args)
    # The tracer leaves the output's other sizes open as well. The program checks them against policy.json.
    model = onnx.load(file)
    dims = model.graph.output[0].type.tensor_type.shape.dim
    for dim, size in zip(dims[1:], made.shape[1:], strict=True):
        dim.dim_value = size
    onnx.checker.check_model(model)
    onnx.save(model, file)
    return made
