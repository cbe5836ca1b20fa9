"""Compares a written bundle with LeRobot: its graphs alone, then everything from raw observations to actions.

LeRobot's side is LeRobot's own code throughout (processors, crop, encoders, scheduler); the bundle's side knows the
files of the bundle alone.
"""

import itertools
from pathlib import Path

import numpy as np
import torch
from lerobot.utils.constants import OBS_IMAGES

from ..runtime import Bundle
from ..verify import SEED, judge, largest, normal
from .checkpoint import Checkpoint
from .config import STATE_KEY


def verify(checkpoint: Checkpoint, folder: Path) -> dict[str, float]:
    """The largest difference of each part, judged."""
    bundle, random = Bundle(folder), np.random.default_rng(SEED)
    with torch.no_grad():
        found = {
            "encoder": max(encoder(checkpoint, bundle, random, batch) for batch in (1, 3)),
            "denoiser": max(denoiser(checkpoint, bundle, random, batch) for batch in (1, 3)),
            **end_to_end(checkpoint, bundle, random),
        }
    return judge(found, "LeRobot")


def encoder(checkpoint: Checkpoint, bundle: Bundle, random, batch: int) -> float:
    """Over every mask with at least one camera present, with NaN for absent cameras."""
    config = checkpoint.config
    inputs = {key: normal(random, batch, config.n_obs_steps, *shape) for key, shape in config.cameras.items()}
    inputs[STATE_KEY] = normal(random, batch, config.n_obs_steps, config.state_len)
    worst = 0.0
    whole = lerobot_condition(checkpoint, inputs)
    for mask in masks(checkpoint, bundle):
        expected = masked(checkpoint, whole, mask)
        given = {}
        for spec, (key, value) in zip(bundle.spec["observations"], inputs.items(), strict=True):
            absent = mask is not None and key in config.cameras and not mask[list(config.cameras).index(key)]
            given[spec["key"]] = np.full_like(value, np.nan) if absent else value
        rows = None if mask is None else np.tile(np.float32(mask), (batch, 1))
        worst = largest(worst, bundle.condition(given, rows) - expected.numpy())
    return worst


def denoiser(checkpoint: Checkpoint, bundle: Bundle, random, batch: int) -> float:
    config = checkpoint.config
    width = bundle.denoiser.get_inputs()[2].shape[1]
    sample = normal(random, batch, config.horizon, config.action_len)
    condition = normal(random, batch, width)
    timestep = random.integers(0, bundle.spec["scheduler"]["num_train_timesteps"], batch)
    unet = checkpoint.policy.diffusion.unet
    expected = unet(torch.from_numpy(sample), torch.from_numpy(timestep), global_cond=torch.from_numpy(condition))
    return largest(0.0, bundle.predict(sample, timestep, condition) - expected.numpy())


def end_to_end(checkpoint: Checkpoint, bundle: Bundle, random) -> dict[str, float]:
    """Raw observations to executed actions, from the same noise: as the denoiser returns them, and in their units.

    The latter are divided by the width of their range, so that degrees and metres are judged alike.
    """
    config, batch = checkpoint.config, 2
    pictures = {
        key: random.integers(0, 256, (batch, config.n_obs_steps, *shape), dtype=np.uint8)
        for key, shape in config.cameras.items()
    }
    state = states(checkpoint, bundle, random, (batch, config.n_obs_steps, config.state_len))
    noise = normal(random, batch, config.horizon, config.action_len)
    names = [spec["key"] for spec in bundle.spec["observations"]]
    raw = dict(zip(names, [*pictures.values(), state], strict=True))

    observation = {key: torch.from_numpy(value).float() / 255 for key, value in pictures.items()}
    observation[STATE_KEY] = torch.from_numpy(state)
    observation = checkpoint.preprocessor(observation)
    inputs = {key: observation[key].numpy() for key in config.keys}
    limits = bundle.spec["action"]["limits"]
    width = np.maximum(np.subtract(limits["max"], limits["min"]), 1e-3)

    worst = {"actions": 0.0, "actions in units": 0.0}
    for mask in masks(checkpoint, bundle):
        # DDPM draws noise at every step: both use the same seed.
        torch.manual_seed(SEED)
        expected = lerobot_actions(checkpoint, inputs, mask, noise)
        torch.manual_seed(SEED)
        rows = None if mask is None else np.tile(np.float32(mask), (batch, 1))
        actions, in_units = bundle.act(raw, rows, noise, lambda: torch.randn(noise.shape).numpy())
        # A sample that is not clipped can be large, and differences with it.
        scale = max(1.0, float(expected.abs().max()))
        expected_in_units = checkpoint.postprocessor(expected)
        worst["actions"] = largest(worst["actions"], (actions - expected.numpy()) / scale)
        difference = (in_units - expected_in_units.numpy()) / width / scale
        worst["actions in units"] = largest(worst["actions in units"], difference)
    return worst


def lerobot_actions(checkpoint: Checkpoint, inputs: dict, mask, noise: np.ndarray) -> torch.Tensor:
    """LeRobot's own generate_actions, after its own conditioning."""
    model = checkpoint.policy.diffusion
    if mask is None:
        return model.generate_actions(batch(checkpoint, inputs), noise=torch.from_numpy(noise))
    condition = masked(checkpoint, lerobot_condition(checkpoint, inputs), mask)
    sample = model.conditional_sample(len(noise), global_cond=condition, noise=torch.from_numpy(noise))
    begin = checkpoint.config.n_obs_steps - 1
    return sample[:, begin : begin + checkpoint.config.n_action_steps]


def lerobot_condition(checkpoint: Checkpoint, inputs: dict) -> torch.Tensor:
    return checkpoint.policy.diffusion._prepare_global_conditioning(batch(checkpoint, inputs))


def masked(checkpoint: Checkpoint, condition: torch.Tensor, mask) -> torch.Tensor:
    """LeRobot has no mask: the columns of the absent cameras are zeroed in its result."""
    if mask is None:
        return condition
    config = checkpoint.config
    by_step = condition.reshape(len(condition), config.n_obs_steps, -1).clone()
    size = (by_step.shape[-1] - config.state_len) // len(config.cameras)
    for index, present in enumerate(mask):
        if not present:
            begin = config.state_len + index * size
            by_step[..., begin : begin + size] = 0
    return by_step.flatten(1)


def batch(checkpoint: Checkpoint, inputs: dict) -> dict[str, torch.Tensor]:
    cameras = [torch.from_numpy(inputs[key]) for key in checkpoint.policy.config.image_features]
    return {STATE_KEY: torch.from_numpy(inputs[STATE_KEY]), OBS_IMAGES: torch.stack(cameras, dim=2)}


def masks(checkpoint: Checkpoint, bundle: Bundle) -> list:
    if bundle.spec["mask"] is None:
        return [None]
    return list(itertools.product((1, 0), repeat=len(checkpoint.config.cameras)))


def states(checkpoint: Checkpoint, bundle: Bundle, random, shape: tuple) -> np.ndarray:
    """States as in the training data."""
    spec = bundle.spec["observations"][-1]["normalization"]
    if spec["mode"] == "min_max":
        return random.uniform(spec["min"], spec["max"], shape).astype(np.float32)
    if spec["mode"] == "mean_std":
        return random.normal(spec["mean"], spec["std"], shape).astype(np.float32)
    return normal(random, *shape)
