"""The parts of a checkpoint's config.json that a bundle needs; settings that a bundle cannot express are refused here.

The keys are those of `lerobot.policies.diffusion.configuration_diffusion.DiffusionConfig`.
"""

import json
from dataclasses import dataclass
from pathlib import Path

from .. import Unsupported

STATE_KEY = "observation.state"
ACTION_KEY = "action"
MAX_CAMERAS = 2
BETA_SCHEDULES = ("squaredcos_cap_v2", "linear", "scaled_linear")

UMI = "a checkpoint of UMI or diffusion_policy: export_umi_policy.py exports it, from its file *.ckpt"


@dataclass(frozen=True)
class Config:
    """A config.json that can be exported."""

    folder: Path
    raw: dict
    # Keys of the pictures in the order in which LeRobot stacks them; [3, height, width] of each.
    cameras: dict[str, list[int]]
    state_len: int
    action_len: int
    n_obs_steps: int
    horizon: int
    n_action_steps: int

    @property
    def keys(self) -> list[str]:
        """The observations, cameras first."""
        return [*self.cameras, STATE_KEY]


def read(path: Path) -> Config:
    """Reads and checks the checkpoint in folder `path` (or in its `pretrained_model`, where training leaves it)."""
    folder = checkpoint_folder(path)
    file = folder / "config.json"
    try:
        raw = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise Unsupported(f"{file}: {error}") from error
    if not isinstance(raw, dict):
        raise Unsupported(f"{file}: not a JSON object")
    if "shape_meta" in raw or "diffusion_policy." in str(raw.get("_target_", "")):
        raise Unsupported(f"{file}: {UMI}")

    def refuse(key: str, why: str) -> Unsupported:
        return Unsupported(f"{file}: {key}: {why}")

    if raw.get("type") != "diffusion":
        raise refuse("type", f'{json.dumps(raw.get("type"))} is not supported: only "diffusion" (DiffusionPolicy) is')
    if raw.get("use_peft"):
        raise refuse("use_peft", "adapters are not supported: merge them into the policy's weights and save it again")
    cameras, state_len = inputs(raw, refuse)
    action = features(raw, "output_features", refuse).get(ACTION_KEY)
    if action is None or len(action["shape"]) != 1:
        raise refuse("output_features.action", "missing, or not a vector")

    numbers = {}
    for key, default in (("n_obs_steps", 2), ("horizon", 16), ("n_action_steps", 8)):
        numbers[key] = raw.get(key, default)
        if type(numbers[key]) is not int or numbers[key] < 1:
            raise refuse(key, f"{numbers[key]!r} is not a whole number above 0")
    most = numbers["horizon"] - numbers["n_obs_steps"] + 1
    if numbers["n_action_steps"] > most:
        raise refuse("n_action_steps", f"{numbers['n_action_steps']} is more than horizon - n_obs_steps + 1 = {most}")
    if (schedule := raw.get("beta_schedule", BETA_SCHEDULES[0])) not in BETA_SCHEDULES:
        raise refuse("beta_schedule", f'"{schedule}" is not supported: {", ".join(BETA_SCHEDULES)} are')
    return Config(folder, raw, cameras, state_len, action["shape"][0], **numbers)


def checkpoint_folder(path: Path) -> Path:
    if path.suffix in (".ckpt", ".pt", ".pth") and not path.is_dir():
        raise Unsupported(f"{path}: a single file, as UMI and the original diffusion_policy write: {UMI}")
    if not path.is_dir():
        raise Unsupported(f"{path}: no such folder")
    for folder in (path, path / "pretrained_model"):
        if (folder / "config.json").is_file():
            return folder
    if (path / ".hydra").is_dir() or list(path.glob("*.ckpt")) or (path / "checkpoints" / "latest.ckpt").exists():
        raise Unsupported(f"{path}: {UMI}")
    raise Unsupported(f"{path}: no config.json: name the folder that LeRobot's training calls pretrained_model")


def features(raw: dict, key: str, refuse) -> dict:
    found = raw.get(key)
    if not isinstance(found, dict) or not found:
        raise refuse(key, "missing or empty")
    for name, feature in found.items():
        shape = feature.get("shape") if isinstance(feature, dict) else None
        if not isinstance(shape, list) or not all(type(n) is int and n > 0 for n in shape):
            raise refuse(f"{key}.{name}", "no shape of positive whole numbers")
    return found


def inputs(raw: dict, refuse) -> tuple[dict[str, list[int]], int]:
    found = features(raw, "input_features", refuse)
    cameras = {}
    for key, feature in found.items():
        kind = feature.get("type")
        if kind == "ENV":
            raise refuse(f"input_features.{key}", "the state of a simulated environment is not a sensor: not supported")
        if kind == "VISUAL":
            if len(feature["shape"]) != 3 or feature["shape"][0] != 3:
                raise refuse(f"input_features.{key}.shape", f"{feature['shape']} is not [3, height, width]")
            cameras[key] = feature["shape"]
        elif key != STATE_KEY:
            raise refuse(f"input_features.{key}", f"type {kind}: only pictures (VISUAL) and {STATE_KEY} are supported")
    if not 1 <= len(cameras) <= MAX_CAMERAS:
        raise refuse(
            "input_features", f"{len(cameras)} cameras ({', '.join(cameras)}): 1 to {MAX_CAMERAS} are supported"
        )
    if len({tuple(shape) for shape in cameras.values()}) > 1:
        raise refuse("input_features", f"cameras of different shapes, which DiffusionPolicy does not take: {cameras}")
    state = found.get(STATE_KEY)
    if state is None or len(state["shape"]) != 1:
        raise refuse(f"input_features.{STATE_KEY}", "missing, or not a vector")
    return cameras, state["shape"][0]
