"""Runs a bundle from its files alone, with numpy and onnxruntime: stands in for the program, to check a bundle."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime

from rapid_policy import poses


class Bundle:
    """A bundle that can be run."""

    def __init__(self, folder: Path):
        self.spec = json.loads((folder / "policy.json").read_text(encoding="utf-8"))
        graphs = self.spec["graphs"]
        options = onnxruntime.SessionOptions()
        # More threads would busy-wait, and slow down PyTorch's.
        options.intra_op_num_threads = 1

        def session(name: str) -> onnxruntime.InferenceSession:
            file = str(folder / graphs[name]["file"])
            return onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])

        self.encoder, self.denoiser = session("encoder"), session("denoiser")

    def condition(self, inputs: dict[str, np.ndarray], mask: np.ndarray | None) -> np.ndarray:
        """The condition for normalised observations by key; those that are absent by the mask are zeros."""
        spec = self.spec["mask"]
        inputs = dict(inputs)
        if spec is not None:
            inputs[spec["input"]] = mask
        return self.encoder.run(None, inputs)[0]

    def predict(self, sample: np.ndarray, timestep: np.ndarray, condition: np.ndarray) -> np.ndarray:
        """One run of the denoiser."""
        return self.denoiser.run(None, {"sample": sample, "timestep": timestep, "global_cond": condition})[0]

    def act(
        self,
        observations: dict[str, np.ndarray],
        mask: np.ndarray | None,
        noise: np.ndarray,
        fresh_noise: Callable[[], np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray]:
        """The actions for samples by key: pictures of bytes [B, To, 3, H, W] and vectors [B, To, D].

        Returns them as the denoiser left them and in their units; see `compose` for what is executed. `fresh_noise` is
        drawn from by DDPM alone.
        """
        inputs = {}
        for spec in self.spec["observations"]:
            value = observations[spec["key"]].astype(np.float32)
            if spec["kind"] == "image":
                value = normalize(value / np.float32(255), spec["normalization"], (-1, 1, 1))
            else:
                value = normalize(vector(spec, value), spec["normalization"], (-1,))
            if mask is not None and spec["modality"] in self.spec["mask"]["order"]:
                present = mask[:, self.spec["mask"]["order"].index(spec["modality"])] > 0.5
                value = np.where(present.reshape(-1, *[1] * (value.ndim - 1)), value, np.float32(0))
            inputs[spec["key"]] = value
        condition = self.condition(inputs, mask)
        x = sample(self.spec["scheduler"], lambda x, t: self.predict(x, t, condition), noise, fresh_noise)
        begin = self.spec["action_start"]
        x = x[:, begin : begin + self.spec["n_action_steps"]]
        return x, denormalize(x, self.spec["action"]["normalization"])

    def compose(self, actions: np.ndarray, newest: np.ndarray) -> np.ndarray:
        """What is executed for actions [n, Da] in their units: poses with `rotation_6d` that are absolute, or relative
        to the pose in `newest`, a sample of the base's modality."""
        spec = self.spec["action"]
        assert spec["rotation"] == "rotation_6d" and spec["representation"] in ("absolute", "relative")
        targets = np.tile(np.eye(4), (len(actions), 1, 1))
        x = actions[:, 3:6] / np.linalg.norm(actions[:, 3:6], axis=1, keepdims=True)
        y = actions[:, 6:9] - (x * actions[:, 6:9]).sum(1, keepdims=True) * x
        y /= np.linalg.norm(y, axis=1, keepdims=True)
        targets[:, :3, :3], targets[:, :3, 3] = np.stack([x, y, np.cross(x, y)], 1), actions[:, :3]
        if spec["representation"] == "relative":
            pose = np.concatenate([newest[slice(*spec["base"][part])] for part in ("position", "rotation")])
            targets = poses.matrices(pose[None], "quaternion")[0] @ targets
        return np.concatenate([poses.numbers(targets, "quaternion"), actions[:, 9:]], 1)


def vector(spec: dict, value: np.ndarray) -> np.ndarray:
    """The numbers of a sample that are observed."""
    begin, end = spec.get("slice") or (0, value.shape[-1])
    value = value[..., begin:end]
    if spec.get("rotation") is None:
        return value
    places = np.zeros((value.size // 4, 3))
    found = poses.matrices(np.concatenate([places, value.reshape(-1, 4)], 1), "quaternion")[0]
    return poses.rotation_6d(found[:, :3, :3]).reshape(*value.shape[:-1], 6).astype(np.float32)


def sample(spec: dict, predict: Callable, noise: np.ndarray, fresh_noise: Callable[[], np.ndarray]) -> np.ndarray:
    """All steps of the scheduler, from `noise` on."""
    x = noise
    for t, at, at_previous in steps(spec):
        output = predict(x, np.full(len(x), t, np.int64))
        x = step(spec, output, x, at, at_previous, fresh_noise if t > 0 else None)
    return x


def normalize(value: np.ndarray, spec: dict, shape: tuple) -> np.ndarray:
    numbers = {name: np.array(spec[name], np.float32).reshape(shape) for name in spec.keys() - {"mode", "eps"}}
    if spec["mode"] == "min_max":
        return (value - numbers["min"]) / (numbers["max"] - numbers["min"]) * 2 - 1
    if spec["mode"] == "mean_std":
        return (value - numbers["mean"]) / (numbers["std"] + np.float32(spec.get("eps", 0)))
    return value


def denormalize(value: np.ndarray, slices: list[dict]) -> np.ndarray:
    out = np.empty_like(value)
    for spec in slices:
        part = slice(*spec["slice"])
        numbers = {name: np.array(spec[name], np.float32) for name in spec.keys() - {"mode", "eps", "slice"}}
        x = value[..., part]
        if spec["mode"] == "min_max":
            x = (x + 1) / 2 * (numbers["max"] - numbers["min"]) + numbers["min"]
        elif spec["mode"] == "mean_std":
            x = x * (numbers["std"] + np.float32(spec.get("eps", 0))) + numbers["mean"]
        out[..., part] = x
    return out


def steps(spec: dict):
    """The timesteps from the last, each with its alpha and that of the one visited next; only for spacing "leading"."""
    assert spec["timestep_spacing"] == "leading", spec["timestep_spacing"]
    stride = spec["num_train_timesteps"] // spec["num_inference_steps"]
    alphas = np.cumprod(1 - betas(spec), dtype=np.float32)
    last = np.float32(1) if spec["type"] == "DDPM" or spec["set_alpha_to_one"] else alphas[0]
    for i in reversed(range(spec["num_inference_steps"])):
        t = i * stride + spec["steps_offset"]
        previous = t - stride
        yield t, alphas[t], alphas[previous] if previous >= 0 else last


def betas(spec: dict) -> np.ndarray:
    total, first, last = spec["num_train_timesteps"], spec["beta_start"], spec["beta_end"]
    if spec["beta_schedule"] == "squaredcos_cap_v2":

        def bar(t: float) -> float:
            return np.cos((t + 0.008) / 1.008 * np.pi / 2) ** 2

        return np.array([min(1 - bar((i + 1) / total) / bar(i / total), 0.999) for i in range(total)], np.float32)
    if spec["beta_schedule"] == "scaled_linear":
        return np.linspace(first**0.5, last**0.5, total, dtype=np.float32) ** 2
    return np.linspace(first, last, total, dtype=np.float32)


def step(spec: dict, output, x, alpha, alpha_previous, fresh_noise) -> np.ndarray:
    """One step back, as `diffusers` takes it: DDIM with eta 0, DDPM with variance fixed_small."""
    if spec["prediction_type"] == "epsilon":
        clean, epsilon = (x - np.sqrt(1 - alpha) * output) / np.sqrt(alpha), output
    else:
        clean, epsilon = output, (x - np.sqrt(alpha) * output) / np.sqrt(1 - alpha)
    if spec["clip_sample"]:
        clean = np.clip(clean, -np.float32(spec["clip_sample_range"]), np.float32(spec["clip_sample_range"]))
    if spec["type"] == "DDIM":
        # diffusers does not recompute epsilon from the clipped sample.
        return (np.sqrt(alpha_previous) * clean + np.sqrt(1 - alpha_previous) * epsilon).astype(np.float32)
    ratio = alpha / alpha_previous
    mean = np.sqrt(alpha_previous) * (1 - ratio) / (1 - alpha) * clean
    mean = mean + np.sqrt(ratio) * (1 - alpha_previous) / (1 - alpha) * x
    if fresh_noise is not None:
        variance = np.maximum((1 - alpha_previous) / (1 - alpha) * (1 - ratio), np.float32(1e-20))
        mean = mean + np.sqrt(variance) * fresh_noise()
    return mean.astype(np.float32)
