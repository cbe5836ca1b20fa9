"""Compares a written bundle with UMI's networks in PyTorch: its graphs alone, then from raw samples to actions.

What is before the networks is computed here as UMI computes it, with matrices in numpy; the bundle's side knows the
files of the bundle alone. That the networks are UMI's is shown by `tests/test_export_umi_policy.py`.
"""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rapid_policy import poses

from ..runtime import Bundle, sample, vector
from ..verify import SEED, judge, largest, normal
from .config import POSITION, ROTATION, SINCE_START, WIDTH
from .graphs import START, Encoder
from .networks import Policy


def verify(policy: Policy, start: np.ndarray | None, folder: Path) -> dict[str, float]:
    """The largest difference of each part, judged."""
    bundle, random = Bundle(folder), np.random.default_rng(SEED)
    policy.eval()
    with torch.no_grad():
        found = {
            "encoder": max(encoder(policy, start, bundle, random, batch) for batch in (1, 3)),
            "denoiser": max(denoiser(policy, bundle, random, batch) for batch in (1, 3)),
            **end_to_end(policy, start, bundle, random),
        }
    return judge(found, "UMI's networks")


def encoder(policy: Policy, start: np.ndarray | None, bundle: Bundle, random, batch: int) -> float:
    raw = samples(policy, bundle, random, batch)
    given = {}
    for spec in bundle.spec["observations"]:
        value = np.float32(raw[spec["key"]])
        given[spec["key"]] = value / np.float32(255) if spec["kind"] == "image" else vector(spec, value)
    return largest(0.0, bundle.condition(given, None) - condition(policy, start, bundle, raw).numpy())


def denoiser(policy: Policy, bundle: Bundle, random, batch: int) -> float:
    x = normal(random, batch, policy.config.horizon, bundle.spec["action"]["shape"][0])
    known = normal(random, batch, bundle.denoiser.get_inputs()[2].shape[1])
    timestep = random.integers(0, bundle.spec["scheduler"]["num_train_timesteps"], batch)
    return largest(0.0, bundle.predict(x, timestep, known) - predicted(policy, torch.from_numpy(known))(x, timestep))


def end_to_end(policy: Policy, start: np.ndarray | None, bundle: Bundle, random) -> dict[str, float]:
    """From the same noise. Differences in units are divided by what is 1 in the network, so that metres and rotations
    are judged alike."""
    raw, batch = samples(policy, bundle, random, 2), 2
    noise = normal(random, batch, policy.config.horizon, bundle.spec["action"]["shape"][0])
    fresh = [np.random.default_rng(SEED) for _ in range(2)]
    actions, in_units = bundle.act(raw, None, noise, lambda: normal(fresh[0], *noise.shape))
    predict = predicted(policy, condition(policy, start, bundle, raw))
    expected = sample(policy.config.scheduler, predict, noise, lambda: normal(fresh[1], *noise.shape))
    expected = expected[:, : policy.config.n_action_steps]
    linear = policy.normalizer["action"]
    expected_in_units = ((torch.from_numpy(expected) - linear.offset) / linear.scale).numpy()
    # A sample that is not clipped can be large, and differences with it.
    scale = max(1.0, float(np.abs(expected).max()))
    return {
        "actions": largest(0.0, (actions - expected) / scale),
        "actions in units": largest(0.0, (in_units - expected_in_units) * linear.scale.numpy() / scale),
    }


def predicted(policy: Policy, known: Tensor):
    def predict(x: np.ndarray, timestep: np.ndarray) -> np.ndarray:
        return policy.model(torch.from_numpy(x), torch.from_numpy(timestep), known).numpy()

    return predict


def samples(policy: Policy, bundle: Bundle, random, batch: int) -> dict[str, np.ndarray]:
    """Random samples of the modalities, by key of the observation; those of the same modality are the same."""
    found, steps = {}, bundle.spec["n_obs_steps"]
    for spec in bundle.spec["observations"]:
        if spec["kind"] == "image":
            found[spec["key"]] = random.integers(0, 256, (batch, steps, *spec["shape"]), dtype=np.uint8)
    numbers = max(spec["slice"][1] for spec in bundle.spec["observations"] if spec["kind"] == "vector")
    arm = random.uniform(-0.5, 0.5, (batch, steps, numbers))
    for spec in bundle.spec["observations"]:
        if spec["kind"] == "vector":
            own = random.uniform(-0.5, 0.5, arm.shape) if spec["key"] == START else arm
            if spec.get("rotation"):
                begin, end = spec["slice"]
                own[..., begin:end] /= np.linalg.norm(own[..., begin:end], axis=-1, keepdims=True)
            found[spec["key"]] = own
    return found


def condition(policy: Policy, start: np.ndarray | None, bundle: Bundle, raw: dict[str, np.ndarray]) -> Tensor:
    """UMI's condition of raw samples."""
    config, slices = policy.config, {spec["key"]: spec.get("slice") for spec in bundle.spec["observations"]}

    def numbers(key: str, steps: int) -> np.ndarray:
        return np.float64(raw[key][:, -steps:, slice(*slices[key])])

    seen = {key: np.float32(raw[key][:, -steps.steps :]) / np.float32(255) for key, steps in config.cameras.items()}
    if ROTATION in raw:
        arm = matrices(np.concatenate([numbers(key, config.pose.steps) for key in (POSITION, ROTATION)], -1))
        if SINCE_START in config.numbers:
            begun = start if start is not None else matrices(numbers(START, 1))[..., :3, :3]
            seen[SINCE_START] = poses.rotation_6d(np.linalg.inv(begun) @ arm[..., :3, :3])
        if config.relative:
            arm = np.linalg.inv(arm[:, -1:]) @ arm
        seen |= {POSITION: arm[..., :3, 3], ROTATION: poses.rotation_6d(arm[..., :3, :3])}
    if WIDTH in config.numbers:
        seen[WIDTH] = numbers(WIDTH, config.numbers[WIDTH].steps)
    picture, inputs = Encoder(policy, start).picture, {}
    for key in (*config.cameras, *config.numbers):
        linear, value = policy.normalizer[key], torch.from_numpy(np.float32(seen[key]))
        shape = (-1, 1, 1) if key in config.cameras else (-1,)
        value = value * linear.scale.reshape(shape) + linear.offset.reshape(shape)
        inputs[key] = picture(value) if key in config.cameras else value
    return policy.obs_encoder(inputs)


def matrices(values: np.ndarray) -> np.ndarray:
    """Position, if it is there, and quaternion [B, T, 7 or 4] -> [B, T, 4, 4]"""
    whole = np.concatenate([np.zeros((*values.shape[:2], 7 - values.shape[2])), values], -1)
    return poses.matrices(whole.reshape(-1, 7), "quaternion")[0].reshape(*values.shape[:2], 4, 4)
