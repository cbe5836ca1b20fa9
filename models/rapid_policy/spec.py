"""Observations, actions and networks of a policy: the only description, used by loader, model and exporter."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class Observation:
    """One input of the policy."""

    key: str
    """Name of the input of the graph."""
    kind: str
    """`image` or `vector`."""
    modality: str
    """Name of the device in the registry."""
    shape: tuple[int, ...]
    """(3, H, W) of a picture, (D,) of a vector."""
    required: bool = True
    """The policy requires it: ticks without it are not used for training."""
    operation: str | None = None
    """`diff_to_reference`: the difference to the first picture of the episode."""
    dropout: float = 0.0
    """How often it is masked in training."""


@dataclass(frozen=True)
class Network:
    """Sizes of the two graphs."""

    image_width: int = 16
    """Channels of the first convolution of an image encoder."""
    image_features: int = 64
    """Length of the embedding of one picture."""
    keypoints: int = 16
    """Points of the spatial softmax."""
    denoiser: tuple[int, ...] = (32, 64, 128)
    """Channels of each level of the U-Net."""


@dataclass(frozen=True)
class Spec:
    """A policy."""

    name: str
    observations: tuple[Observation, ...]
    action_names: tuple[str, ...] = ("x", "y", "z", "grip")
    action_units: tuple[str, ...] = ("m", "m", "m", "1")
    actuator: str = "arm"
    n_obs_steps: int = 2
    horizon: int = 16
    n_action_steps: int = 8
    control_hz: float = 10.0
    max_observation_age_ms: int = 300
    mask_aware: bool = True
    """The encoder takes a mask and zeroes what is absent."""
    inference_steps: int = 10
    network: Network = field(default_factory=Network)

    @property
    def images(self) -> tuple[Observation, ...]:
        """The pictures, in the order of the mask."""
        return tuple(o for o in self.observations if o.kind == "image")

    @property
    def vectors(self) -> tuple[Observation, ...]:
        """The vectors, in the order of the condition."""
        return tuple(o for o in self.observations if o.kind == "vector")

    @property
    def action_start(self) -> int:
        """Index of the prediction that is the action of the newest observation."""
        return self.n_obs_steps - 1

    @property
    def condition(self) -> int:
        """Length of the condition: the vectors and embeddings of all observation steps."""
        step = sum(o.shape[0] for o in self.vectors) + len(self.images) * self.network.image_features
        return self.n_obs_steps * step

    def to_dict(self) -> dict[str, Any]:
        """As plain data, for a checkpoint."""
        return asdict(self)

    @staticmethod
    def from_dict(data: dict[str, Any]) -> Spec:
        """The inverse of `to_dict`."""
        plain = dict(data)
        observations = (Observation(**{**o, "shape": tuple(o["shape"])}) for o in plain.pop("observations"))
        network = plain.pop("network")
        for name in ("action_names", "action_units"):
            plain[name] = tuple(plain[name])
        return Spec(
            observations=tuple(observations),
            network=Network(**{**network, "denoiser": tuple(network["denoiser"])}),
            **plain,
        )


PICTURE = (3, 96, 96)


def wrist(dropout: float = 0.0, required: bool = False) -> Observation:
    """The camera at the wrist, which cannot see a texture."""
    return Observation("wrist", "image", "cam_wrist", PICTURE, required, dropout=dropout)


def tactile(dropout: float = 0.0, required: bool = False) -> Observation:
    """The camera behind the gel of the fingertip, as difference to the untouched gel."""
    return Observation("tactile", "image", "tactile_tip", PICTURE, required, "diff_to_reference", dropout)


def arm() -> Observation:
    """Position and opening of the gripper."""
    return Observation("state", "vector", "arm", (4,))


def tactile_id() -> Spec:
    """Grasp, identify the texture by touch, place: the shipped policy."""
    return Spec("tactile-id", (wrist(dropout=0.3), tactile(dropout=0.3), arm()))


SPECS = {"tactile-id": tactile_id}
