"""The parts of a checkpoint's `cfg` that a bundle needs; what a bundle cannot express is refused here, by its key.

The keys are those of diffusion_policy/config/train_diffusion_unet_timm_umi_workspace.yaml and config/task/umi.yaml.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .. import Unsupported

POSITION, ROTATION, WIDTH = "robot0_eef_pos", "robot0_eef_rot_axis_angle", "robot0_gripper_width"
SINCE_START = "robot0_eef_rot_axis_angle_wrt_start"
# Numbers of each observation that is not a picture.
LENGTHS = {POSITION: 3, ROTATION: 6, SINCE_START: 6, WIDTH: 1}
ACTION_LEN = 10
# Largest distance of two observation steps, in ticks, and what else a bundle may state at most.
MOST_APART = 64
MOST_STEPS, MOST_ACTIONS, MOST_TIMESTEPS = 64, 1024, 10_000
# Larger pictures, widths and kernels are of no network that is known here.
MOST_SIDE, MOST_WIDTH, MOST_KERNEL = 2048, 65_536, 63
# Whole numbers from there on are not floats.
MOST_WHOLE = 2**53
POLICY = "diffusion_policy.policy.diffusion_unet_timm_policy.DiffusionUnetTimmPolicy"
ENCODER = "diffusion_policy.model.vision.timm_obs_encoder.TimmObsEncoder"
AGGREGATIONS = ("avg", "max", "soft_attention", "spatial_embedding", "attention_pool_2d")
# Random changes of a picture, of which the middle changes nothing. UMI makes them when it acts, too.
AUGMENTATIONS = {
    f"torchvision.transforms.{name}"
    for name in ("ColorJitter", "RandomRotation", "RandomPerspective", "ElasticTransform", "RandomGrayscale")
}
# What `policy` may have besides networks and sampling: read below, or of training alone.
POLICY_KEYS = {
    "_target_", "shape_meta", "noise_scheduler", "obs_encoder", "num_inference_steps", "obs_as_global_cond",
    "diffusion_step_embed_dim", "down_dims", "kernel_size", "n_groups", "cond_predict_scale", "input_pertub",
    "inpaint_fixed_action_prefix", "train_diffusion_n_samples",
}  # fmt: skip
ENCODER_KEYS = {
    "_target_", "shape_meta", "model_name", "pretrained", "frozen", "global_pool", "transforms", "use_group_norm",
    "share_rgb_model", "imagenet_norm", "feature_aggregation", "downsample_ratio", "position_encording",
}  # fmt: skip
# The defaults of the diffusers library (0.18, which UMI pins, to 0.35), under a bundle's names.
SCHEDULER = {
    "num_train_timesteps": 1000,
    "beta_schedule": "linear",
    "beta_start": 0.0001,
    "beta_end": 0.02,
    "prediction_type": "epsilon",
    "clip_sample": True,
    "clip_sample_range": 1.0,
    "set_alpha_to_one": True,
    "steps_offset": 0,
    "timestep_spacing": "leading",
}
# Settings that a bundle does not have, at what it does.
FIXED = {
    "timestep_spacing": "leading",
    "trained_betas": None,
    "thresholding": False,
    "rescale_betas_zero_snr": False,
    "variance_type": "fixed_small",
    "dynamic_thresholding_ratio": 0.995,
    "sample_max_value": 1.0,
}
CHOICES = {
    "beta_schedule": ("squaredcos_cap_v2", "linear", "scaled_linear"),
    "prediction_type": ("epsilon", "sample"),
}


@dataclass(frozen=True)
class Observation:
    """When an observation is seen: its steps, and the ticks between two of them."""

    steps: int
    apart: int


@dataclass(frozen=True)
class Vision:
    """The encoder of pictures."""

    model: str
    aggregation: str | None
    downsample: int
    group_norm: bool
    shared: bool
    # Side of the middle that is kept, which is resized to the whole again; None keeps the picture.
    crop: int | None


@dataclass(frozen=True)
class Config:
    """A configuration that can be exported."""

    file: Path
    raw: dict
    # In the order in which the network takes them: the pictures' keys, then the others'.
    cameras: dict[str, Observation]
    numbers: dict[str, Observation]
    # Of the arm's pose, which relative actions need even where the network does not see it.
    pose: Observation
    side: int
    relative: bool
    horizon: int
    n_action_steps: int
    vision: Vision
    widths: tuple[int, ...]
    kernel: int
    step_features: int
    scheduler: dict
    weights: str

    @property
    def n_obs_steps(self) -> int:
        return max(seen.steps for seen in (*self.cameras.values(), *self.numbers.values(), self.pose))


class Keys:
    """A table of the configuration, whose errors name file and key."""

    def __init__(self, file: Path, table: Any, path: str = "cfg"):
        self.file, self.path = file, path
        if not isinstance(table, dict):
            raise Unsupported(f"{file}: {path}: missing, or not a table of keys")
        self.table = table

    def wrong(self, key: str, why: str) -> Unsupported:
        return Unsupported(f"{self.file}: {self.path}.{key}: {why}")

    def below(self, key: str) -> "Keys":
        return Keys(self.file, self.table.get(key), f"{self.path}.{key}")

    def get(self, key: str, kind: type, default: Any = None) -> Any:
        value = self.table.get(key, default)
        # True is an int to Python.
        if type(value) is not kind and not (kind is float and type(value) is int):
            words = {int: "a whole number", float: "a number", bool: "true or false", str: "text", list: "a list"}
            raise self.wrong(key, f"{value!r} is not {words[kind]}")
        if type(value) is int and abs(value) > MOST_WHOLE:
            raise self.wrong(key, f"is not from -{MOST_WHOLE} to {MOST_WHOLE}")
        return value

    def count(self, key: str, default: Any = None, most: int = MOST_WHOLE) -> int:
        if (value := self.get(key, int, default)) < 1:
            raise self.wrong(key, f"{value} is not above 0")
        if value > most:
            raise self.wrong(key, f"{value} is more than {most}")
        return value

    def must(self, key: str, expected: Any, default: Any, why: str) -> None:
        if (value := self.table.get(key, default)) != expected:
            raise self.wrong(key, f"{value!r} is not supported, only {expected!r}: {why}")

    def known(self, names: set[str]) -> None:
        for key in self.table:
            if key not in names:
                raise self.wrong(key, "is not known here, so that it could not be taken into account")


def read(file: Path, cfg: dict) -> Config:
    """Checks the configuration `cfg` of the checkpoint `file`."""
    root = Keys(file, cfg)
    policy = root.below("policy")
    policy.must("_target_", POLICY, None, "what can be exported is UMI's U-Net with an encoder of timm")
    policy.known(POLICY_KEYS)
    policy.must("obs_as_global_cond", True, True, "the denoiser of a bundle has a global condition")
    policy.must("n_groups", 8, 8, "the U-Net here has groups of 8")
    policy.must("cond_predict_scale", True, True, "the U-Net here scales and shifts by its condition")
    shapes = policy.below("shape_meta")
    action = shapes.below("action")
    action.must("shape", [ACTION_LEN], None, "position, rotation_6d and width of one robot; a bundle moves one arm")
    action.must("rotation_rep", "rotation_6d", "rotation_6d", "an action has the first two rows of the matrix")
    action.must("latency_steps", 0, 0, "the first action is of the tick of the newest observation")
    every, horizon = action.count("down_sample_steps"), action.count("horizon", most=MOST_ACTIONS)
    n_action_steps = root.count("n_action_steps", 8)
    if n_action_steps > horizon:
        raise root.wrong("n_action_steps", f"{n_action_steps} is more than the horizon of {horizon}")
    cameras, numbers, pose, side = observations(shapes.below("obs"), every)
    relative = representation(root)
    if not (numbers or relative):
        raise shapes.wrong("obs", "the policy sees pictures alone (ignore_by_policy), and actions relative to no pose")
    return Config(
        file=file,
        raw=cfg,
        cameras=cameras,
        numbers=numbers,
        pose=pose,
        side=side,
        relative=relative,
        horizon=horizon,
        n_action_steps=n_action_steps,
        vision=vision(policy.below("obs_encoder"), side),
        widths=widths(policy, horizon),
        kernel=kernel(policy),
        step_features=step_features(policy),
        scheduler=scheduler(policy),
        weights="ema_model" if root.below("training").get("use_ema", bool) else "model",
    )


def observations(found: Keys, every: int) -> tuple[dict[str, Observation], dict[str, Observation], Observation, int]:
    """The pictures, the numbers, when the pose is seen, and the side of the pictures."""
    cameras, numbers, poses, sides = {}, {}, {}, set()
    for key in sorted(found.table):
        one = found.below(key)
        kind, shape = one.get("type", str, "low_dim"), one.get("shape", list)
        if kind == "rgb":
            # True is an int to Python.
            whole = len(shape) == 3 and all(type(length) is int for length in shape)
            if not whole or shape[0] != 3 or shape[1] != shape[2] or not 1 <= shape[1] <= MOST_SIDE:
                raise one.wrong("shape", f"{shape} is not [3, side, side] with a side from 1 to {MOST_SIDE}")
            cameras[key] = seen(one, every)
            sides.add(shape[1])
            continue
        if kind != "low_dim":
            raise one.wrong("type", f"{kind!r} is not supported: rgb and low_dim are")
        if key in (POSITION, ROTATION):
            poses[key] = seen(one, every)
        if one.get("ignore_by_policy", bool, False):
            continue
        if key not in LENGTHS:
            raise found.wrong(key, f"is not supported: of one robot {', '.join(LENGTHS)} are")
        one.must("shape", [LENGTHS[key]], None, "rotations are the first two rows of the matrix")
        one.must("rotation_rep", "rotation_6d", "rotation_6d", "rotations are the first two rows of the matrix")
        numbers[key] = seen(one, every)
    if not cameras or len(sides) > 1:
        raise Unsupported(f"{found.file}: {found.path}: no pictures, or of several sizes: {sorted(sides)}")
    for key in (POSITION, ROTATION):
        if key not in poses:
            raise found.wrong(key, "missing: an arm's pose is position and rotation")
    if len({*poses.values(), *([numbers[SINCE_START]] if SINCE_START in numbers else [])}) > 1:
        raise Unsupported(
            f"{found.file}: {found.path}: {POSITION}, {ROTATION} and {SINCE_START}: not of the same steps"
        )
    return cameras, numbers, poses[POSITION], sides.pop()


def seen(one: Keys, every: int) -> Observation:
    """`every`: rows of the data between two actions, which are a tick apart."""
    if (latency := one.get("latency_steps", float, 0)) != 0:
        raise one.wrong(
            "latency_steps",
            f"{latency}: it was trained with observations of different times; those of a bundle are of the same tick",
        )
    steps, rows = one.count("horizon", most=MOST_STEPS), one.get("down_sample_steps", float)
    apart = 1 if steps == 1 else rows / every
    if apart not in range(1, MOST_APART + 1):
        raise one.wrong(
            "down_sample_steps",
            f"{rows} rows of the data, {apart:g} ticks of the actions, which are {every} rows apart: a bundle has "
            f"whole ticks from 1 to {MOST_APART} between two observations",
        )
    return Observation(steps, int(apart))


def representation(root: Keys) -> bool:
    """Whether poses are relative to the newest one; otherwise they are as they are."""
    found = root.below("task").below("pose_repr")
    names = {key: found.get(key, str) for key in ("obs_pose_repr", "action_pose_repr")}
    for key, name in names.items():
        if name not in ("relative", "abs"):
            raise found.wrong(key, f"{name!r} is not supported: relative and abs are")
    if len(set(names.values())) > 1:
        raise found.wrong(
            "action_pose_repr",
            f"{names['action_pose_repr']!r}, but obs_pose_repr is {names['obs_pose_repr']!r}: UMI's dataset gives "
            "actions the representation of the observations, so that the policy learned another than it states",
        )
    return names["action_pose_repr"] == "relative"


def vision(found: Keys, side: int) -> Vision:
    found.must("_target_", ENCODER, None, "other encoders of observations have no counterpart here")
    found.known(ENCODER_KEYS)
    found.must("global_pool", "", "", "features are aggregated behind the network")
    model, aggregation = found.get("model_name", str), found.table.get("feature_aggregation", "spatial_embedding")
    if model.startswith("vit"):
        # UMI ignores it there, but for all_tokens, which its own encoder cannot do.
        if aggregation == "all_tokens":
            raise found.wrong("feature_aggregation", "'all_tokens' is not supported: of a ViT the class token is used")
        aggregation = None
    elif aggregation not in AGGREGATIONS:
        raise found.wrong("feature_aggregation", f"{aggregation!r} is not supported: {', '.join(AGGREGATIONS)} are")
    downsample = found.count("downsample_ratio", 32)
    if aggregation in ("spatial_embedding", "attention_pool_2d") and side % downsample:
        raise found.wrong("feature_aggregation", f"{aggregation!r} needs pictures of a multiple of {downsample}")
    return Vision(
        model=model,
        aggregation=aggregation,
        downsample=downsample,
        # Weights that were trained with batch statistics keep them.
        group_norm=found.get("use_group_norm", bool, False) and not found.get("pretrained", bool),
        shared=found.get("share_rgb_model", bool, False),
        crop=crop(found, side),
    )


def crop(found: Keys, side: int) -> int | None:
    """UMI's list of random changes: what is left of them when nothing is random."""
    steps = found.table.get("transforms")
    if steps is None:
        return None
    for index, step in enumerate(found.get("transforms", list)):
        one = Keys(found.file, step, f"{found.path}.transforms[{index}]")
        if index == 0:
            one.must("type", "RandomCrop", None, "UMI's encoder expects it first")
            ratio = one.get("ratio", float)
            if not 0 < ratio <= 1:
                raise one.wrong("ratio", f"{ratio} is not above 0 and at most 1")
        elif one.get("_target_", str) not in AUGMENTATIONS:
            raise one.wrong("_target_", f"{one.table['_target_']} is not known to be without effect in the mean")
    if not steps:
        raise found.wrong("transforms", "is empty: UMI's encoder expects RandomCrop first, or null")
    if not (kept := int(side * ratio)):
        raise Unsupported(f"{found.file}: {found.path}.transforms[0].ratio: {ratio} leaves nothing of pictures of {side}")
    return kept


def widths(policy: Keys, horizon: int) -> tuple[int, ...]:
    found = policy.get("down_dims", list, [256, 512, 1024])
    if not found or not all(type(width) is int and 0 < width <= MOST_WIDTH and width % 8 == 0 for width in found):
        raise policy.wrong("down_dims", f"{found!r} are not multiples of 8, at most {MOST_WIDTH}")
    if horizon % 2 ** (len(found) - 1):
        raise policy.wrong("down_dims", f"{len(found)} levels halve a horizon of {horizon} unevenly")
    return tuple(found)


def kernel(policy: Keys) -> int:
    if (found := policy.count("kernel_size", 5, MOST_KERNEL)) % 2 == 0:
        raise policy.wrong("kernel_size", f"{found} is even: actions would not keep their number")
    return found


def step_features(policy: Keys) -> int:
    found = policy.count("diffusion_step_embed_dim", 256, MOST_WIDTH)
    if found < 4 or found % 2:
        raise policy.wrong("diffusion_step_embed_dim", f"{found} is not an even number from 4")
    return found


def scheduler(policy: Keys) -> dict:
    """As policy.json has it."""
    found = policy.below("noise_scheduler")
    kind = found.get("_target_", str).rsplit(".", 1)[-1]
    if kind not in ("DDIMScheduler", "DDPMScheduler"):
        raise found.wrong("_target_", f"{kind} is not supported: DDIMScheduler and DDPMScheduler are")
    found.known({"_target_", *SCHEDULER, *FIXED})
    for key, value in FIXED.items():
        found.must(key, value, value, "a bundle has no such setting")
    settings = {key: found.get(key, type(value), value) for key, value in SCHEDULER.items()}
    for key, names in CHOICES.items():
        if settings[key] not in names:
            raise found.wrong(key, f"{settings[key]!r} is not supported: {', '.join(names)} are")
    total = found.count("num_train_timesteps", SCHEDULER["num_train_timesteps"], MOST_TIMESTEPS)
    steps = total if policy.table.get("num_inference_steps") is None else policy.count("num_inference_steps")
    return {"type": kind.removesuffix("Scheduler"), **settings, "num_inference_steps": steps}


def visited(file: Path, scheduler: dict) -> dict:
    """`scheduler`, all of whose timesteps are among those of the training."""
    steps, total, offset = (scheduler[key] for key in ("num_inference_steps", "num_train_timesteps", "steps_offset"))
    if steps > total:
        raise Unsupported(f"{file}: {steps} inference steps: num_train_timesteps is {total}")
    largest = total - 1 - (steps - 1) * (total // steps)
    if not 0 <= offset <= largest:
        key = "cfg.policy.noise_scheduler.steps_offset"
        raise Unsupported(f"{file}: {key}: {offset} is not from 0 to {largest}, as {steps} of {total} timesteps leave")
    return scheduler
