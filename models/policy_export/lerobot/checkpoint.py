"""LeRobot's own policy and normalisation, loaded on the CPU, and the statistics in the format of a bundle."""

import json
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten

import numpy as np
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.processor import PolicyProcessorPipeline
from lerobot.processor.converters import (
    batch_to_transition,
    policy_action_to_transition,
    transition_to_batch,
    transition_to_policy_action,
)
from safetensors import SafetensorError

from .. import Unsupported
from ..bundle import decimals, fits, mean_std
from .config import ACTION_KEY, Config

PRE, POST = "policy_preprocessor.json", "policy_postprocessor.json"
# The steps of LeRobot's own DiffusionPolicy. Any other step would silently be missing from the bundle.
STEPS = {
    PRE: ["rename_observations_processor", "to_batch_processor", "device_processor", "normalizer_processor"],
    POST: ["unnormalizer_processor", "device_processor"],
}
# The statistics that a mode maps to -1 and 1.
BOUNDS = {"MIN_MAX": ("min", "max"), "QUANTILES": ("q01", "q99"), "QUANTILE10": ("q10", "q90")}


@dataclass
class Checkpoint:
    """A checkpoint as LeRobot runs it."""

    config: Config
    policy: DiffusionPolicy
    preprocessor: PolicyProcessorPipeline
    postprocessor: PolicyProcessorPipeline

    def normalization(self, key: str) -> dict:
        """LeRobot's normalisation of observation `key`, in the format of a bundle."""
        feature = "VISUAL" if key in self.config.cameras else "STATE"
        step, file = normalizer(self.preprocessor, "normalizer_processor"), self.config.folder / PRE
        only = step.normalize_observation_keys
        mode = self._mode(step, key, feature) if only is None or key in only else "IDENTITY"
        size = 3 if feature == "VISUAL" else self.config.state_len
        if mode == "IDENTITY":
            return {"mode": "identity"}
        if mode == "MEAN_STD":
            mean, std = (statistic(step, file, key, name, size) for name in ("mean", "std"))
            return {"mode": "mean_std", "mean": decimals(mean), "std": decimals(std), "eps": step.eps}
        low, high = (statistic(step, file, key, name, size) for name in BOUNDS[mode])
        for dimension in np.flatnonzero(high <= low):
            raise Unsupported(
                f"{file}: {key}, dimension {dimension}: {BOUNDS[mode][0]} = {low[dimension]} and {BOUNDS[mode][1]} = "
                f"{high[dimension]}: it never changed in the training data, and LeRobot divides what it sees by "
                f"{step.eps}; train with normalization_mapping.{feature} MEAN_STD or without this dimension"
            )
        return {"mode": "min_max", "min": decimals(low), "max": decimals(high)}

    def action_normalization(self) -> list[dict]:
        """How LeRobot's postprocessor converts an action back to its units."""
        step, file = normalizer(self.postprocessor, "unnormalizer_processor"), self.config.folder / POST
        size = self.config.action_len
        mode = self._mode(step, ACTION_KEY, "ACTION")
        if mode == "IDENTITY":
            return [{"slice": [0, size], "mode": "identity"}]
        if mode == "MEAN_STD":
            # LeRobot adds its eps only when normalising, not in the inverse.
            mean, std = (statistic(step, file, ACTION_KEY, name, size) for name in ("mean", "std"))
            return [mean_std(0, mean, std)]
        low, high = (statistic(step, file, ACTION_KEY, name, size) for name in BOUNDS[mode])
        # A dimension that never changed in the data has zero width; LeRobot replaces it by eps. A bundle's min_max
        # does not allow it; a mean and a tiny deviation express the same.
        slices, begin, flat = [], 0, high == low
        for end in range(1, size + 1):
            if end < size and flat[end] == flat[begin]:
                continue
            part = slice(begin, end)
            if flat[begin]:
                slices.append(mean_std(begin, low[part], np.full(end - begin, step.eps / 2, np.float32)))
            else:
                bounds = {"min": decimals(low[part]), "max": decimals(high[part])}
                slices.append({"slice": [begin, end], "mode": "min_max", **bounds})
            begin = end
        return slices

    def action_limits(self, dataset_stats: dict | None) -> dict:
        """The smallest and largest action of the training data; no action beyond them is executed."""
        step, file = normalizer(self.postprocessor, "unnormalizer_processor"), self.config.folder / POST
        stats = (step.stats or {}).get(ACTION_KEY, {})
        if dataset_stats is not None:
            stats = dataset_stats.get(ACTION_KEY, {})
        if not {"min", "max"} <= set(stats):
            raise Unsupported(f"{file}: no min and max of the actions for action.limits: name the data with --dataset")
        limits = {name: np.asarray(stats[name], np.float32).reshape(-1) for name in ("min", "max")}
        if any(len(limit) != self.config.action_len or not np.isfinite(limit).all() for limit in limits.values()):
            raise Unsupported(f"min and max of the actions in the statistics are not {self.config.action_len} numbers")
        return {name: decimals(limit) for name, limit in limits.items()}

    def scheduler(self) -> dict:
        """The noise scheduler that LeRobot made, defaults included."""
        made = self.policy.diffusion.noise_scheduler.config
        return {
            "type": self.policy.config.noise_scheduler_type,
            "num_train_timesteps": made.num_train_timesteps,
            "beta_schedule": made.beta_schedule,
            "beta_start": made.beta_start,
            "beta_end": made.beta_end,
            "prediction_type": made.prediction_type,
            "clip_sample": made.clip_sample,
            "clip_sample_range": made.clip_sample_range,
            # DDPM has no such setting: its last alpha is always 1.
            "set_alpha_to_one": made.get("set_alpha_to_one", True),
            "steps_offset": made.steps_offset,
            "timestep_spacing": made.timestep_spacing,
            "num_inference_steps": self.policy.diffusion.num_inference_steps,
        }

    def _mode(self, step, key: str, feature: str) -> str:
        # LeRobot leaves values without statistics unchanged.
        return step.norm_map.get(feature, "IDENTITY").upper() if key in (step.stats or {}) else "IDENTITY"


def load(config: Config, scheduler: str | None, steps: int | None) -> Checkpoint:
    """Loads the weights and processors; `scheduler` and `steps` override those of the configuration, if given."""
    folder = config.folder
    pre = pipeline(folder / PRE, batch_to_transition, transition_to_batch)
    post = pipeline(folder / POST, policy_action_to_transition, transition_to_policy_action)
    settings = parse(config)
    settings.device = "cpu"
    # All weights come from the checkpoint: nothing is downloaded, and nothing is compiled before tracing.
    settings.pretrained_backbone_weights = None
    settings.compile_model = False
    if scheduler is not None:
        settings.noise_scheduler_type = scheduler
    if steps is not None:
        settings.num_inference_steps = steps
    total = settings.num_train_timesteps
    count = total if settings.num_inference_steps is None else settings.num_inference_steps
    if not 1 <= count <= total:
        raise Unsupported(f"{folder / 'config.json'}: {count} inference steps: num_train_timesteps is {total}")
    try:
        policy = DiffusionPolicy.from_pretrained(folder, config=settings, strict=True)
    except (OSError, RuntimeError, ValueError, SafetensorError) as error:
        raise Unsupported(f"{folder}: the weights do not fit config.json: {shorten(str(error), 400)}") from error
    for name, module in (("down_dims", policy.diffusion.unet), ("vision_backbone", policy.diffusion.rgb_encoder)):
        fits(f"{folder / 'config.json'}: {name}", 4 * sum(p.numel() for p in module.parameters()))
    return Checkpoint(config, policy.eval(), pre, post)


def parse(config: Config) -> DiffusionConfig:
    try:
        settings = PreTrainedConfig.from_pretrained(config.folder)
        settings.validate_features()
    except (Exception, SystemExit) as error:  # draccus raises whatever its parsers raise
        raise Unsupported(
            f"{config.folder / 'config.json'}: LeRobot cannot read it: {shorten(str(error), 400)}"
        ) from error
    return settings


def pipeline(file: Path, to_transition, to_output) -> PolicyProcessorPipeline:
    overrides = {"device_processor": {"device": "cpu"}} if "device_processor" in check_steps(file) else {}
    try:
        return PolicyProcessorPipeline.from_pretrained(
            file.parent, file.name, overrides=overrides, to_transition=to_transition, to_output=to_output
        )
    except Exception as error:  # what LeRobot's steps raise at what they were saved with is theirs
        raise Unsupported(f"{file}: LeRobot cannot load it: {shorten(str(error), 400)}") from error


def check_steps(file: Path) -> list[str]:
    """The names of a processor's steps, all of which a bundle can express."""
    try:
        steps = json.loads(file.read_text(encoding="utf-8"))["steps"]
        names = [step.get("registry_name") or step.get("class") for step in steps]
    except FileNotFoundError as error:
        raise Unsupported(
            f"{file}: missing: a checkpoint of an older LeRobot keeps its statistics elsewhere; convert it with "
            "python -m lerobot.processor.migrate_policy_normalization --pretrained-path FOLDER"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise Unsupported(f"{file}: no list of steps: {error!r}") from error
    for index, name in enumerate(names):
        if name not in STEPS[file.name]:
            raise Unsupported(
                f"{file}: steps[{index}].registry_name: {name} is not supported: a bundle has no such step"
            )
    if (needed := STEPS[file.name][-1 if file.name == PRE else 0]) not in names:
        raise Unsupported(f"{file}: steps: no {needed}, so nothing states how numbers are normalised")
    return names


def normalizer(pipeline: PolicyProcessorPipeline, name: str):
    return next(step for step in pipeline.steps if step._registry_name == name)


def statistic(step, file: Path, key: str, name: str, size: int) -> np.ndarray:
    """One statistic of one key as `size` finite numbers; LeRobot keeps those of pictures as [3, 1, 1]."""
    if name not in step.stats[key]:
        raise Unsupported(f"{file}: the statistics of {key} have no {name}, which its normalisation needs")
    values = np.asarray(step.stats[key][name], np.float32).reshape(-1)
    if len(values) != size:
        raise Unsupported(f"{file}: {name} of {key} has {len(values)} numbers and not {size}")
    for dimension in np.flatnonzero(~np.isfinite(values)):
        raise Unsupported(f"{file}: {name} of {key}, dimension {dimension}: {values[dimension]}")
    return values
