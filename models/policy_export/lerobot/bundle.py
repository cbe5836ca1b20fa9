"""policy.json and README.md of a bundle."""

from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

from .. import Unsupported, bundle
from ..bundle import CONDITION, FORMAT, MASK
from .checkpoint import Checkpoint
from .config import Config


@dataclass
class Options:
    """Facts about the rig that a checkpoint does not contain."""

    name: str
    hz: float
    # Modality of each observation, and the entry of the actuator.
    modalities: dict[str, str]
    actuator: str
    mask_aware: bool = False
    # Cameras without which the policy does not run; all of them if the bundle is not mask-aware.
    required: set[str] = field(default_factory=set)
    max_age_ms: int = 300
    action_names: list[str] = field(default_factory=list)
    action_units: list[str] = field(default_factory=list)
    # The data's own meta/stats.json, instead of the checkpoint's copy, for the limits of the actions.
    dataset_stats: dict | None = None


def input_names(config: Config) -> dict[str, str]:
    """The name in the bundle of each observation: the last part of LeRobot's key, `observation.images.top` -> `top`."""
    names = {key: key.rsplit(".", 1)[-1] for key in config.keys}
    taken = {MASK: "the mask", CONDITION: "the encoder's output"}
    for key, name in names.items():
        if name in taken:
            raise Unsupported(
                f"{config.folder / 'config.json'}: input_features.{key}: {taken[name]} has the name {name}, too"
            )
        taken[name] = key
    return names


def policy(checkpoint: Checkpoint, options: Options, graphs: dict[str, str], folder: Path) -> dict:
    """The contents of policy.json beside `graphs`, whose files are in `folder`."""
    config, names = checkpoint.config, input_names(checkpoint.config)
    observations = []
    for key in config.keys:
        observation = {"key": names[key], "kind": "vector", "modality": options.modalities[key], "required": True}
        if key in config.cameras:
            observation |= {"kind": "image", "required": not options.mask_aware or key in options.required}
            # Resize and crop are in the graph.
            observation |= {
                "shape": config.cameras[key],
                "color": "rgb",
                "resize": None,
                "crop": None,
                "operation": None,
            }
        else:
            observation |= {"shape": [config.state_len]}
        observations.append(observation | {"normalization": checkpoint.normalization(key)})
    mask = None
    if options.mask_aware:
        order = [options.modalities[key] for key in config.cameras]
        mask = {"input": MASK, "order": order, "absent": "zero_embedding"}
    return {
        "format": FORMAT,
        "name": options.name,
        "mask_aware": options.mask_aware,
        "n_obs_steps": config.n_obs_steps,
        "horizon": config.horizon,
        "n_action_steps": config.n_action_steps,
        # LeRobot's first predicted action is that of the oldest observation.
        "action_start": config.n_obs_steps - 1,
        "control_hz": options.hz,
        "max_observation_age_ms": options.max_age_ms,
        "observations": observations,
        "mask": mask,
        "action": {
            "actuator": options.actuator,
            "shape": [config.action_len],
            "names": options.action_names or [f"a{i}" for i in range(config.action_len)],
            "units": options.action_units or ["1"] * config.action_len,
            "representation": "absolute",
            "limits": checkpoint.action_limits(options.dataset_stats),
            "normalization": checkpoint.action_normalization(),
        },
        "scheduler": checkpoint.scheduler(),
        "graphs": bundle.graphs(graphs, folder),
        "training": provenance(config),
    }


def provenance(config: Config) -> dict:
    weights = config.folder / "model.safetensors"
    return {
        "source": "LeRobot DiffusionPolicy checkpoint",
        "weights_sha256": bundle.sha256(weights),
        "exported_with": {name: version(name) for name in ("lerobot", "torch", "onnx")},
        "config": config.raw,
    }


def write_card(policy: dict, folder: Path) -> None:
    if policy["mask_aware"]:
        mask = (
            "Mask-aware by request: an absent camera's embedding is replaced by zeros. That serves only a policy that "
            "was trained with cameras left out in the same way; nothing in the checkpoint states whether this one was."
        )
    else:
        mask = "Not mask-aware: every observation is required."
    notes = f"Actions stay within the range of the training data. {mask}"
    bundle.write_card(policy, "LeRobot DiffusionPolicy", "export_lerobot.py", notes, folder)
