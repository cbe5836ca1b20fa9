"""An experiment: the data, the policy and its training, as one description that loader, networks, training and exporter
share. `experiment_file` reads it from TOML; a checkpoint or a bundle's weights restore it.

The models check each key, and keys that depend on each other. A finding names cause and fix; `experiment_file` adds its
place in the file.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

# Pixels each way that the small encoder averages before anything else.
SMALL_POOL = 2
# The small encoder halves the pooled picture twice.
SMALL_MULTIPLE = SMALL_POOL * 4
TRAIN_TIMESTEPS = 100
POSITION = 3
ROTATIONS = {"none": 0, "rotation_6d": 6, "quaternion": 4}
QUATERNION = 4
# Ticks that a history may reach back, and that the program therefore keeps.
LONGEST_HISTORY = 600
TAKES = {"position": POSITION, "rotation_6d": 6, "quaternion": 4}


def mistake(key: str, cause: str, fix: str) -> PydanticCustomError:
    """A finding about `key`, relative to the table that is checked."""
    return PydanticCustomError("mistake", "{cause}", {"key": key, "cause": cause, "fix": fix})


def known(meaning: str, example: Any, default: Any = ..., **limits: Any) -> Any:
    """A key with its meaning and an example, both of which messages about it show."""
    return Field(default, description=meaning, examples=[example], **limits)


def _plain(name: str) -> str:
    if not name or not name.replace("_", "").replace("-", "").isalnum():
        raise mistake("", f"{name!r} is not a name", "use letters, digits, - and _")
    return name


Name = Annotated[str, AfterValidator(_plain)]
Side = Annotated[int, Field(ge=8, le=8192)]
Size = tuple[Side, Side]
Column = Annotated[int, Field(ge=0)]
Share = Annotated[float, Field(ge=0, lt=1)]


class Section(BaseModel):
    """A table of the file; an unknown key is a mistake."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, populate_by_name=True)


class Data(Section):
    """Which episodes are learned from."""

    folders: tuple[str, ...] = known("folders of episodes, relative to this file", ["../runs/episodes"], ())
    verdict: tuple[Literal["GOOD", "SUSPECT"], ...] = known(
        "verdicts that are taken", ["GOOD", "SUSPECT"], ("GOOD", "SUSPECT"), min_length=1
    )
    tags: dict[str, str | tuple[str, ...]] = known("values of a tag that are taken", {"finger": ["soft"]}, {})
    modules: tuple[str, ...] = known("modules that must be mounted", ["handheld_adapter"], ())
    tasks: tuple[str, ...] = known("tasks that are taken", ["place block"], ())
    absences: tuple[Literal["unplug", "crash", "stall"], ...] = known(
        "why a picture may be absent in what is learned from", ["unplug"], ("unplug", "crash", "stall")
    )
    seeds: tuple[int, int] | None = known("first and last value of the tag `seed`", [1000, 1071], None)
    validation: float = known("share of the episodes held out", 0.1, 0.0, ge=0, le=0.5)
    validation_by: Literal["file", "seed"] = known("what decides which are held out", "file", "file")

    @model_validator(mode="after")
    def _check(self) -> Data:
        if self.seeds and self.seeds[0] > self.seeds[1]:
            raise mistake(
                "seeds", f"{self.seeds[0]} is above {self.seeds[1]}", "write the first seed, then the last one"
            )
        return self


class Dropout(Section):
    """How often a picture is taken away in training."""

    window: Share = known("share of the windows without it", 0.3, 0.0)
    replug: Share = known("share of the windows in the middle of which it is plugged in again", 0.1, 0.0)
    episode: Share = known("share of the windows that see it leave in the middle of their episode", 0.2, 0.0)
    held: Share = known("share of the windows that see it as it was before it left, with when_absent", 0.2, 0.0)

    @property
    def any(self) -> bool:
        """Whether it is ever taken away."""
        return max(self.window, self.replug, self.episode, self.held) > 0


class HoldLast(Section):
    """What stands in for an absent picture at run time: its last ones, for a time. Without this table, nothing does."""

    hold_last_ms: int = known("for how long, ms", 20000, ge=1, le=600_000)


class History(Section):
    """More steps than the policy's and further back, in their place, each with whether there was a picture."""

    steps: int = known("how many, the newest included", 12, ge=2, le=64)


class Augmentation(Section):
    """What is varied at random in training."""

    shift: int = known("pictures: pixels each way", 4, 0, ge=0, le=256)
    brightness: float = known("pictures: share each way", 0.1, 0.0, ge=0, lt=1)
    noise: float = known("vectors: standard deviation, as a share of half the range", 0.01, 0.0, ge=0, lt=1)


class Part(Section):
    """A part of a vector, taken from one modality of the episodes."""

    modality: Name = known("modality of the episodes", "phone")
    take: Literal["columns", "position", "rotation_6d", "quaternion"] = known("what is taken from it", "position", "columns")
    columns: tuple[Column, ...] | None = known('which of its numbers, for take = "columns"', [0], None, min_length=1)

    @model_validator(mode="after")
    def _check(self) -> Part:
        if self.take == "columns" and self.columns is None:
            raise mistake("columns", "missing", 'add columns = [0], or take = "position" of a pose')
        if self.take != "columns" and self.columns is not None:
            raise mistake("columns", f"of no use with take = {self.take!r}", "remove it")
        return self

    @property
    def length(self) -> int:
        """How many numbers it gives."""
        return len(self.columns or ()) if self.take == "columns" else TAKES[self.take]


class Observation(Section):
    """One input of the policy."""

    key: Name = known("name of the encoder's input", "wrist")
    kind: Literal["image", "vector"] = known("what it is", "image")
    modality: Name = known("the device in the registry of the rig that the policy runs on", "cam_wrist")
    required: bool = known("without it the policy does not act; ticks without it are not learned from", True, True)
    down_sample_steps: int = known("ticks between two of its steps", 3, 1, ge=1, le=64)
    size: Size | None = known("pictures: [height, width] as the camera gives them", [96, 96], None)
    resize: Size | None = known("pictures: [height, width] to which they are resized", [96, 128], None)
    crop: Size | None = known("pictures: [height, width] of the centre that is kept", [96, 96], None)
    color: Literal["rgb", "bgr"] = known("pictures: order of the colours", "rgb", "rgb")
    operation: Literal["diff_to_reference"] | None = known("pictures: what is computed from them", "diff_to_reference", None)
    columns: tuple[Column, ...] | None = known(
        "vectors: which numbers of the modality", [0, 1, 2, 3], None, min_length=1
    )
    parts: tuple[Part, ...] = known(
        "vectors: what they are made of in the episodes, in place of columns",
        [{"modality": "phone", "take": "position"}],
        (),
    )
    slice: tuple[Column, Column] | None = known(
        "vectors with parts: numbers of the modality at run time; for one rotation_6d, those of the quaternion",
        [0, 4],
        None,
    )
    dropout: Dropout = known("how often it is taken away in training", {"window": 0.3}, Dropout())
    when_absent: HoldLast | None = known("what stands in for it while it is absent", {"hold_last_ms": 20000}, None)
    history: History | None = known(
        "pictures: steps of its own, including those from before it was unplugged", {"steps": 12}, None
    )
    augmentation: Augmentation = known("what is varied in training", {"shift": 4}, Augmentation())
    outcome: float = known(
        "pictures: weight of a second loss, of predicting the episode's last action from it alone", 0.5, 0.0, ge=0
    )

    @model_validator(mode="after")
    def _check(self) -> Observation:
        foreign = _VECTOR_KEYS if self.kind == "image" else _IMAGE_KEYS
        for key in sorted(foreign & self.model_fields_set):
            raise mistake(key, f"not a key of kind = {self.kind!r}", "remove it, or change kind")
        if self.kind == "image":
            self._check_picture()
        else:
            self._check_vector()
        if self.required and self.dropout.any:
            raise mistake("dropout", "what is required is never absent", "write required = false, or remove dropout")
        if self.required and self.when_absent:
            raise mistake("when_absent", "what is required is never absent", "write required = false, or remove the key")
        if self.history:
            self._check_history()
        if self.dropout.held and not self.when_absent:
            fix = "write when_absent = { hold_last_ms = 20000 }"
            raise mistake("dropout.held", "at run time nothing stands in for it", fix)
        return self

    def _check_history(self) -> None:
        if self.required:
            cause = "of what is required, but it is given whether or not there is a picture now"
            raise mistake("history", cause, "write required = false")
        if self.when_absent:
            raise mistake("when_absent", "nothing stands in for a step of a history", "remove it")
        if self.dropout.any:
            raise mistake("dropout", "that of the modality's other observation decides", "write it there alone")
        if self.outcome:
            raise mistake("outcome", "a history is looked at only where there is no picture", "write it in the other observation alone")
        if self.span > LONGEST_HISTORY:
            cause = f"from the first to the last step {self.span} ticks, more than {LONGEST_HISTORY}"
            raise mistake("history.steps", cause, "write fewer, or a smaller down_sample_steps")

    def _check_picture(self) -> None:
        if not (self.crop or self.resize or self.size):
            raise mistake(
                "size", "missing: the size of the input is unknown", "add size, resize or crop = [height, width]"
            )
        outer = self.resize or self.size
        if self.crop and outer and (self.crop[0] > outer[0] or self.crop[1] > outer[1]):
            raise mistake(
                "crop", f"{list(self.crop)} is larger than {list(outer)}", "write a smaller one, or another resize"
            )
        if self.augmentation.noise:
            raise mistake("augmentation.noise", "is for vectors", "remove it; pictures have shift and brightness")
        if self.operation and self.augmentation.brightness:
            raise mistake("augmentation.brightness", "a difference has no brightness", "remove it")

    def _check_vector(self) -> None:
        if not self.required:
            raise mistake("required", "a vector has no bit in the mask", "write required = true")
        if self.augmentation.shift or self.augmentation.brightness:
            raise mistake("augmentation", "shift and brightness are for pictures", "write noise")
        if (self.columns is None) == (not self.parts):
            cause = "missing" if self.columns is None else "given beside parts"
            raise mistake("columns", cause, "write either columns of the modality, or parts")
        if self.columns and list(self.columns) != list(range(self.columns[0], self.columns[-1] + 1)):
            fix = "name neighbours in order, or several observations"
            raise mistake("columns", f"{list(self.columns)} is not a range, which is all a bundle can take", fix)
        if self.slice and self.slice[1] - self.slice[0] != self.shape[0] and not self.turned:
            cause = f"{self.slice[1] - self.slice[0]} numbers, where the parts have {self.shape[0]}"
            raise mistake("slice", cause, f"write [{self.slice[0]}, {self.slice[0] + self.shape[0]}], or other parts")

    @property
    def shape(self) -> tuple[int, ...]:
        """(3, H, W) of a picture, (D,) of a vector."""
        if self.kind == "image":
            return (3, *(self.crop or self.resize or self.size or ()))
        return (sum(part.length for part in self.sources),)

    @property
    def valid(self) -> str:
        """Of a history: name of the encoder's input that marks the steps that have a picture."""
        return f"{self.key}_valid"

    @property
    def ages(self) -> tuple[int, ...]:
        """Of a history: how many ticks before the newest observation each step is, the oldest first."""
        steps = self.history.steps if self.history else 0
        return tuple(age * self.down_sample_steps for age in reversed(range(steps)))

    @property
    def span(self) -> int:
        """Of a history: ticks from the first step to the last."""
        return max(self.ages, default=0)

    @property
    def sources(self) -> tuple[Part, ...]:
        """Vectors: what they are made of in the episodes."""
        return self.parts or (Part(modality=self.modality, columns=self.columns),)

    @property
    def turned(self) -> bool:
        """Vectors: whether the program makes the six numbers of a rotation from the quaternion at run time."""
        one = [part.take for part in self.parts] == ["rotation_6d"]
        return one and self.slice is not None and self.slice[1] - self.slice[0] == QUATERNION

    @property
    def run_slice(self) -> tuple[int, int]:
        """Vectors: the numbers of the modality at run time."""
        if self.slice:
            return self.slice
        begin = self.columns[0] if self.columns else 0
        return begin, begin + self.shape[0]


_IMAGE_KEYS = {"size", "resize", "crop", "color", "operation", "dropout", "when_absent", "history", "outcome"}
# What an encoder sees of a picture depends on these.
_SIGHT = ("size", "resize", "crop", "color", "operation")
_VECTOR_KEYS = {"columns", "parts", "slice"}


class Base(Section):
    """Where to find, at run time, the pose that actions are relative to: the one that the episodes have as `pose`."""

    modality: Name = known("of a vector that the policy observes", "arm")
    position: tuple[Column, Column] = known("which of its numbers are x, y, z, the end not included", [0, 3])
    rotation: tuple[Column, Column] | None = known(
        "which are its quaternion x y z w, if the action has a rotation", [3, 7], None
    )

    @model_validator(mode="after")
    def _check(self) -> Base:
        for key, wanted in (("position", POSITION), ("rotation", QUATERNION)):
            if (span := getattr(self, key)) and span[1] - span[0] != wanted:
                fix = f"write [{span[0]}, {span[0] + wanted}]"
                raise mistake(key, f"{span[1] - span[0]} numbers instead of {wanted}", fix)
        return self


class Action(Section):
    """What the policy does, and where the episodes have it."""

    source: Literal["action", "pose"] = known(
        "where it is recorded: on the topic /action, or as the next pose", "pose", "action", alias="from"
    )
    actuator: Name = known("the device in the registry that is moved", "arm")
    names: tuple[Name, ...] = known("of each number that is executed", ["x", "y", "z", "grip"], min_length=1)
    units: tuple[str, ...] = known("of each number that is executed", ["m", "m", "m", "1"], min_length=1)
    columns: tuple[Column, ...] | None = known("numbers of /action that are learned", [0, 1], None, min_length=1)
    pose: Name | None = known("modality with the pose", "phone", None)
    gripper: Name | None = known("modality with the opening", "gripper", None)
    gripper_column: int = known("which of its numbers", 0, 0, ge=0)
    gripper_squeeze: float = known("how much further it closes than was recorded: what it held stopped it", 0.1, 0.0, ge=0)
    representation: Literal["absolute", "relative", "delta"] = known(
        "what a pose is relative to", "relative", "absolute"
    )
    rotation: Literal["none", "rotation_6d", "quaternion"] = known(
        "how a pose's rotation is learned; what is executed has it as a quaternion", "rotation_6d", "none"
    )
    base: Base | None = known(
        "with relative and delta: the pose at run time", {"modality": "arm", "position": [0, 3]}, None
    )

    @model_validator(mode="after")
    def _check(self) -> Action:
        if len(self.units) != len(self.names):
            cause = f"{len(self.units)} units for {len(self.names)} names"
            raise mistake("units", cause, "give a unit for each number")
        if self.source == "pose":
            self._check_pose()
        else:
            for key in sorted(_POSE_KEYS & self.model_fields_set):
                if getattr(self, key) != type(self).model_fields[key].default:
                    raise mistake(key, 'of no use with from = "action"', 'remove it, or write from = "pose"')
        if self.columns and len(self.columns) != len(self.names):
            cause = f"{len(self.columns)} numbers for {len(self.names)} names"
            raise mistake("columns", cause, "give a name for each number")
        return self

    def _check_pose(self) -> None:
        if self.pose is None:
            raise mistake("pose", "missing", 'add the modality with the pose: pose = "phone"')
        if self.gripper_squeeze and self.gripper is None:
            raise mistake(
                "gripper", "missing, though it squeezes", 'add gripper = "gripper", or remove gripper_squeeze'
            )
        if self.columns is not None:
            raise mistake("columns", 'of no use with from = "pose"', "remove it")
        self._check_base()
        turned = self.rotation != "none"
        length = POSITION + QUATERNION * turned + (self.gripper is not None)
        if len(self.names) != length:
            what = f"a position ({POSITION})" + (f", a quaternion ({QUATERNION})" if turned else "")
            what += " and an opening (1)" if self.gripper else ""
            cause = f"{len(self.names)} names for {length} numbers that are executed: {what}"
            raise mistake("names", cause, f"give {length} names")

    def _check_base(self) -> None:
        if self.representation == "absolute":
            if self.base is not None:
                raise mistake("base", "of no use with representation = 'absolute'", "remove it")
            return
        place = 'modality = "arm", position = [0, 3]' + (", rotation = [3, 7]" if self.rotation != "none" else "")
        if self.base is None:
            cause = f"missing with representation = {self.representation!r}: where the pose is at run time"
            raise mistake("base", cause, f"add base = {{ {place} }}")
        if self.base.rotation is None and self.rotation != "none":
            cause = f"missing with rotation = {self.rotation!r}"
            raise mistake("base.rotation", cause, f"write base = {{ {place} }}")
        if self.base.rotation is not None and self.rotation == "none":
            fix = 'remove it, or write rotation = "rotation_6d"'
            raise mistake("base.rotation", "of no use with rotation = 'none'", fix)

    @property
    def outputs(self) -> int:
        """How many numbers of an action are learned."""
        if self.source == "action":
            return len(self.names)
        return POSITION + ROTATIONS[self.rotation] + (self.gripper is not None)

    @property
    def composed(self) -> bool:
        """Whether what is executed differs from what is learned."""
        return self.representation != "absolute" or self.rotation != "none"


_POSE_KEYS = {"pose", "gripper", "gripper_column", "gripper_squeeze", "representation", "rotation", "base"}


class Encoder(Section):
    """The network that sees."""

    type: Literal["small", "resnet18"] = known("which", "resnet18", "small")
    shared: bool = known("one for all pictures", False, False)
    weights: str | None = known("file of torchvision's weights, relative to this file", "resnet18.pth", None)
    width: int = known("small: channels of the first convolution", 16, 16, ge=8, le=512, multiple_of=8)
    features: int = known("length of the embedding of a picture", 64, 64, ge=1, le=4096)
    keypoints: int = known("points of the spatial softmax", 16, 16, ge=1, le=512)

    @property
    def pool(self) -> int:
        """How many pixels each way are averaged before anything else."""
        return SMALL_POOL if self.type == "small" else 1

    @model_validator(mode="after")
    def _check(self) -> Encoder:
        if self.weights and self.type != "resnet18":
            raise mistake("weights", f"of no use with type = {self.type!r}", 'remove it, or write type = "resnet18"')
        return self


def check_picture(encoder: Encoder, o: Observation, key: str) -> None:
    """Raises a mistake if the encoder does not take what is observed under `key`."""
    if o.kind == "image" and encoder.type == "small" and any(side % SMALL_MULTIPLE for side in o.shape[1:]):
        cause = f"{o.shape[1]}x{o.shape[2]}: the small encoder takes multiples of {SMALL_MULTIPLE}"
        given = next(k for k in ("crop", "resize", "size") if getattr(o, k))
        raise mistake(f"{key}.{given}", cause, 'resize or crop to such a size, or type = "resnet18"')
    if o.augmentation.shift % encoder.pool:
        cause = f"{o.augmentation.shift}: the encoder sees the picture at a half"
        raise mistake(f"{key}.augmentation.shift", cause, f"write a multiple of {encoder.pool}")


class Denoiser(Section):
    """The network that predicts the noise in actions."""

    type: Literal["unet", "transformer"] = known("which", "transformer", "unet")
    widths: tuple[Annotated[int, Field(ge=8, le=4096, multiple_of=8)], ...] = known(
        "unet: channels of each level", [32, 64, 128], (32, 64, 128), min_length=1, max_length=6
    )
    kernel: int = known("unet: kernel size of its convolutions", 5, 5, ge=1, le=15)
    layers: int = known("transformer: how many", 4, 4, ge=1, le=48)
    heads: int = known("transformer: attention heads per layer", 4, 4, ge=1, le=64)
    width: int = known("transformer: length of a token", 128, 128, ge=8, le=4096)
    dropout: Share = known("transformer: share of the values that are dropped in training", 0.1, 0.1)

    @model_validator(mode="after")
    def _check(self) -> Denoiser:
        for key in sorted(self.model_fields_set):
            if not self._is_of_type(key):
                fix = f'remove it, or write type = "{_TYPE_OF_KEY[key]}"'
                raise mistake(key, f"of no use with type = {self.type!r}", fix)
        if self.kernel % 2 == 0:
            raise mistake("kernel", f"{self.kernel} is even", f"write {self.kernel + 1}")
        if self.width % self.heads:
            cause = f"{self.heads} do not divide the width {self.width}"
            raise mistake("heads", cause, "write a divisor of the width")
        return self

    @property
    def halvings(self) -> int:
        """How often the horizon is halved."""
        return len(self.widths) - 1 if self.type == "unet" else 0

    def sizes(self) -> dict[str, Any]:
        """The keys of its type, with their values."""
        return {key: value for key, value in self.model_dump(mode="json").items() if self._is_of_type(key)}

    def _is_of_type(self, key: str) -> bool:
        return _TYPE_OF_KEY.get(key, self.type) == self.type


_TYPE_OF_KEY = dict.fromkeys(("widths", "kernel"), "unet")
_TYPE_OF_KEY |= dict.fromkeys(("layers", "heads", "width", "dropout"), "transformer")


class Horizon(Section):
    """How much is seen, predicted and executed."""

    n_obs_steps: int = known("observations seen", 2, 2, ge=1, le=64)
    horizon: int = known("actions predicted", 16, 16, ge=1, le=1024)
    n_action_steps: int = known("actions executed before the next prediction", 8, 8, ge=1, le=1024)
    control_hz: float = known("ticks per second, as recorded", 10, 10.0, gt=0, le=1000)
    max_observation_age_ms: int = known("older observations are not acted upon", 300, 300, ge=1)
    mask_aware: bool = known("learns to do without a modality", True, True)
    inference_steps: int = known("steps of the sampler", 10, 10, ge=1, le=TRAIN_TIMESTEPS)

    @model_validator(mode="after")
    def _check(self) -> Horizon:
        left = self.horizon - self.n_obs_steps + 1
        if self.n_action_steps > left:
            raise mistake(
                "n_action_steps",
                f"{self.n_action_steps}, but only {left} are predicted from now on",
                "write fewer, or a longer horizon",
            )
        return self


class Training(Section):
    """The schedule."""

    iterations: int | None = known("batches; or epochs", 3900, None, ge=1)
    epochs: float | None = known("times as many windows as the data have, drawn at random", 30, None, gt=0)
    minutes: float | None = known("the training ends after them at the latest", 30, None, gt=0)
    windows: int = known("in a batch", 64, 64, ge=1)
    draws: int = known("noises for each window: the encoder, the expensive half, runs once for all", 2, 2, ge=1)
    optimizer: Literal["adamw", "adam", "sgd"] = known("which", "adamw", "adamw")
    learning_rate: float = known("at its highest", 1e-3, 1e-3, gt=0)
    betas: tuple[Share, Share] = known(
        "of adamw and adam; the first is the momentum of sgd", [0.95, 0.999], (0.95, 0.999)
    )
    weight_decay: float = known("of the optimiser", 1e-6, 1e-6, ge=0)
    scheduler: Literal["cosine", "linear", "constant"] = known("how the learning rate falls", "cosine", "cosine")
    final_rate: float = known("share of the learning rate at the end", 0.005, 0.005, ge=0, le=1)
    warmup: int = known("iterations in which the learning rate rises", 100, 100, ge=0)
    decay: float = known("of the moving average of the weights, which is exported", 0.995, 0.995, ge=0, lt=1)
    clip: float = known("largest norm of the gradients", 1.0, 1.0, gt=0)
    seed: int = known("of weights, windows and noise", 0, 0, ge=0)
    precision: Literal["auto", "bf16", "float32"] = known(
        "auto: encoders in bfloat16 where the device has it; bf16: both networks", "auto", "auto"
    )
    checkpoint_minutes: float = known("between two checkpoints", 5, 5.0, gt=0)
    validate_every: int = known("iterations between two measurements of the loss on held-out episodes", 250, 250, ge=1)

    @model_validator(mode="after")
    def _check(self) -> Training:
        if self.iterations is not None and self.epochs is not None:
            raise mistake("epochs", "given beside iterations", "write one of them")
        if self.iterations is None and self.epochs is None:
            raise mistake("iterations", "missing, and no epochs either", "add iterations = 3900, or epochs = 30")
        return self


class Experiment(Section):
    """The whole experiment."""

    format: Literal["rapid-experiment/1"] = known("of this file", "rapid-experiment/1")
    name: Name = known("of the policy", "tactile-id")
    description: str = known("what it does, for the model card", "it grasps a block", "")
    note: str = known("what it was trained on and does not know, for the model card", "Trained in simulation only.", "")
    data: Data = known("which episodes are learned from", {}, Data())
    policy: Horizon = known("how much is seen, predicted and executed", {}, Horizon())
    observation: tuple[Observation, ...] = known("an input of the policy", {}, min_length=1)
    action: Action = known("what it does", {"actuator": "arm"})
    encoder: Encoder = known("the network that sees", {}, Encoder())
    denoiser: Denoiser = known("the network that predicts the noise", {}, Denoiser())
    training: Training = known("the schedule", {"iterations": 3900})

    @model_validator(mode="after")
    def _check(self) -> Experiment:
        keys = [o.key for o in self.observation]
        taken = {"mask", "action", *(o.valid for o in self.histories)}
        for i, o in enumerate(self.observation):
            if o.key in keys[:i] or o.key in taken:
                raise mistake(f"observation.{i}.key", f"{o.key!r} is taken", "give each input a name of its own")
        self._check_histories()
        self._check_mask()
        self._check_pictures()
        self._check_outcomes()
        base = self.action.base
        if base and base.modality not in (o.modality for o in self.vectors):
            known_ones = ", ".join(sorted({o.modality for o in self.vectors})) or "none yet"
            cause = f"{base.modality!r} is the modality of no vector that is observed"
            raise mistake("action.base.modality", cause, f"write one of them ({known_ones}), or observe it")
        levels = 2**self.denoiser.halvings
        if self.policy.horizon % levels:
            cause = f"{self.policy.horizon} cannot be halved {self.denoiser.halvings} times"
            raise mistake("policy.horizon", cause, f"write a multiple of {levels}, or fewer widths of the denoiser")
        return self

    def _check_outcomes(self) -> None:
        for i, o in enumerate(self.observation):
            if o.outcome and self.action.source == "pose" and self.action.representation != "absolute":
                cause = f"where an episode ends is not known of {self.action.representation} actions"
                fix = 'write representation = "absolute" in [action], or remove it'
                raise mistake(f"observation.{i}.outcome", cause, fix)

    def _check_histories(self) -> None:
        now = {o.modality: o for o in self.images}
        for i, o in enumerate(self.observation):
            if not o.history:
                continue
            if not self.policy.mask_aware:
                fix = "write mask_aware = true in [policy], or remove it"
                raise mistake(f"observation.{i}.history", "without a mask nothing may be absent", fix)
            if o.modality not in now:
                fix = "observe it without a history too, which decides when it is taken away"
                raise mistake(f"observation.{i}.history", f"the only observation of {o.modality!r}", fix)
            self._check_sight(i, o, now[o.modality])

    def _check_sight(self, i: int, history: Observation, now: Observation) -> None:
        for key in _SIGHT:
            if getattr(history, key) != getattr(now, key):
                cause = f"not as of {now.key!r}: one encoder sees both"
                raise mistake(f"observation.{i}.{key}", cause, "write the same in both")

    def _check_mask(self) -> None:
        if self.policy.mask_aware:
            if not self.images:
                raise mistake("policy.mask_aware", "no pictures that could be absent", "write mask_aware = false")
            seen = [o.modality if o in self.images else None for o in self.observation]
            for i, modality in enumerate(seen):
                if modality and modality in seen[:i]:
                    fix = "observe it once, or write mask_aware = false"
                    raise mistake(f"observation.{i}.modality", f"{modality!r} has one element in the mask", fix)
            self._check_only_picture()
            return
        for i, o in enumerate(self.observation):
            if not o.required:
                fix = "write required = true, or mask_aware = true in [policy]"
                raise mistake(f"observation.{i}.required", "without a mask nothing may be absent", fix)

    def _check_only_picture(self) -> None:
        if len(self.images) > 1:
            return
        for i, o in enumerate(self.observation):
            for key in ("window", "episode"):
                if getattr(o.dropout, key):
                    fix = "remove it, or observe another picture"
                    raise mistake(f"observation.{i}.dropout.{key}", "the only picture is never taken away", fix)

    def _check_pictures(self) -> None:
        shapes = {o.shape for o in self.images}
        if self.encoder.shared and len(shapes) > 1:
            cause = f"pictures of {len(shapes)} sizes"
            raise mistake("encoder.shared", cause, "resize all to one size, or write shared = false")
        for i, o in enumerate(self.observation):
            check_picture(self.encoder, o, f"observation.{i}")

    @property
    def images(self) -> tuple[Observation, ...]:
        """The current pictures, in the order of the mask."""
        return tuple(o for o in self.observation if o.kind == "image" and not o.history)

    @property
    def histories(self) -> tuple[Observation, ...]:
        """The pictures with a history."""
        return tuple(o for o in self.observation if o.history)

    def column(self, history: Observation) -> int:
        """The index in `images` of the picture of the same modality."""
        return [o.modality for o in self.images].index(history.modality)

    @property
    def vectors(self) -> tuple[Observation, ...]:
        """The vectors, in the order of the condition."""
        return tuple(o for o in self.observation if o.kind == "vector")

    @property
    def numbers(self) -> tuple[str, ...]:
        """Modalities whose numbers are read from an episode."""
        observed = [part.modality for o in self.vectors for part in o.sources]
        return (*observed, *(name for name in (self.action.pose, self.action.gripper) if name))

    @property
    def predicts_outcomes(self) -> bool:
        """Whether a picture predicts the last action of the episode by itself."""
        return any(o.outcome for o in self.images)

    @property
    def action_length(self) -> int:
        """How many numbers an action has in the networks."""
        return self.action.outputs

    @property
    def action_start(self) -> int:
        """Index, in the prediction, of the action for the tick of the newest observation."""
        return self.policy.n_obs_steps - 1

    @property
    def condition(self) -> int:
        """Length of the condition: the vectors and embeddings of all observation steps."""
        step = sum(o.shape[0] for o in self.vectors) + len(self.images) * self.encoder.features
        return self.policy.n_obs_steps * step

    def to_text(self) -> str:
        """For a checkpoint."""
        return self.model_dump_json(by_alias=True, exclude_unset=True)

    @staticmethod
    def from_text(text: str) -> Experiment:
        """The inverse of `to_text`."""
        return Experiment.model_validate_json(text)

    def learns_the_same(self, other: Experiment) -> str | None:
        """Where `other` describes different weights; none if the training of one can continue the other's."""
        for table in ("policy", "observation", "action", "encoder", "denoiser"):
            if getattr(self, table) != getattr(other, table):
                return table
        # What is learned from decides the ranges that inputs are normalised by.
        return "data.absences" if set(self.data.absences) != set(other.data.absences) else None
