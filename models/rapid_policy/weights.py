"""The networks of a bundle, back in PyTorch: the weights are taken from the graphs, so that the bundle is enough; and how
a training begins with them.

Invariant: a weight is given only to an input or action of the same meaning, whatever its place.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import nn

from .bundle import DENOISER, ENCODER, POLICY
from .model import Policy
from .experiment import Experiment


def load_policy(folder: Path) -> Policy:
    """The policy of a bundle that `rapid_policy.export` made; other bundles have other weight names."""
    described = json.loads((folder / POLICY).read_text(encoding="utf-8"))
    encoder, denoiser = _initializers(folder / ENCODER), _initializers(folder / DENOISER)
    policy = Policy(_spec(described, encoder, denoiser))
    _load(policy.encoder, encoder, folder / ENCODER)
    _load(policy.denoiser, denoiser, folder / DENOISER)
    return policy.eval()


@dataclass(frozen=True)
class First:
    """The bundle whose weights a training begins with."""

    folder: Path
    described: dict[str, Any]
    """Its `policy.json`."""
    policy: Policy

    @classmethod
    def read(cls, folder: Path) -> First:
        """Raises `ValueError` for what is not a bundle that `rapid_policy.export` made."""
        try:
            described = json.loads((folder / POLICY).read_text(encoding="utf-8"))
            return cls(folder, described, load_policy(folder))
        except OSError as error:
            raise ValueError(f"{error.filename or folder}: {error.strerror or error}: name the folder of a bundle") from error
        # What is not a bundle fails in the reader of JSON, of the description or of a graph.
        except Exception as error:
            reason = " ".join(str(error).split())[:120] or type(error).__name__
            raise ValueError(f"{folder}: not a bundle of rapid_policy.export: {type(error).__name__}: {reason}") from error

    def origin(self) -> dict[str, Any]:
        """What is recorded of it in the training that it begins."""
        digest = hashlib.sha256((self.folder / POLICY).read_bytes()).hexdigest()
        trained = self.described.get("training") or {}
        known = {key: trained.get(key) for key in ("command", "iterations", "seed", "started_from")}
        return {"name": self.described["name"], "policy_sha256": digest, **known}

    def give(self, policy: Policy, described: dict[str, Any]) -> None:
        """Gives the weights to `policy`, whose `policy.json` is to be `described`.

        Only histories, which at first remember the last picture, and what predicts outcomes may be missing. Raises `ValueError`
        where inputs, actions or networks differ otherwise.
        """
        self._check_meaning(described)
        known, weights = self.policy.state_dict(), dict(policy.state_dict())
        known |= _scores(policy, _places(self.policy))
        for name, weight in weights.items():
            found = known.get(name)
            if found is None and name.startswith(("encoder.histories.", "outcomes.")):
                continue
            if found is not None and _sees_condition(name):
                found = _rearranged(found, weight, self.policy.spec, policy.spec)
            if found is None or found.shape != weight.shape:
                fix = "start from a policy with the same networks and observations"
                raise ValueError(f"{self.folder}: {name} does not fit {policy.spec.name}: {fix}")
            weights[name] = found
        policy.load_state_dict(weights)

    def _check_meaning(self, described: dict[str, Any]) -> None:
        """Raises `ValueError` unless the same key stands for the same input, and the actions are the same."""
        ours, theirs = ({o["key"]: o for o in of["observations"]} for of in (described, self.described))
        pairs = [(f"observation `{key}`", o, theirs[key]) for key, o in ours.items() if key in theirs]
        for what, ours, theirs in (*pairs, ("action", described["action"], self.described["action"])):
            for key in sorted((ours.keys() | theirs.keys()) - _OTHERWISE):
                if ours.get(key) != theirs.get(key):
                    cause = f"{key} of {what} is {theirs.get(key)!r} there and {ours.get(key)!r} here"
                    raise ValueError(f"{self.folder}: {cause}: start from a policy with the same inputs and actions")
            if ours["normalization"] != theirs["normalization"]:
                print(f"train: {what} has another range in these episodes than in {self.folder}: its numbers are scaled anew")


def _places(policy: Policy) -> dict[str, torch.Tensor]:
    """By the key of each history: the biases of its steps' scores."""
    found, steps = {}, {o.key: o.history.steps for o in policy.spec.histories if o.history}
    for picture, pooling in policy.encoder.histories.items():
        keys = [key for key, _ in policy.encoder.history_keys[picture]]
        parts = pooling.places.detach().split([steps[key] for key in keys])
        found |= dict(zip(keys, parts, strict=True))
    return found


def _scores(policy: Policy, known: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """These biases as weights of `policy`: the `known` ones, and its own for other histories."""
    own = _places(policy)
    keys = {picture: [key for key, _ in policy.encoder.history_keys[picture]] for picture in policy.encoder.histories}
    parts = {picture: [known.get(key, own[key]) for key in of] for picture, of in keys.items()}
    return {f"encoder.histories.{picture}.places": torch.cat(of) for picture, of in parts.items()}


# What may differ between two policies of the same meaning.
_OTHERWISE = {"normalization", "required", "when_absent", "limits", "actuator"}


def _sees_condition(name: str) -> bool:
    """Whether it is a layer of a denoiser whose last inputs are the condition, or a step of it."""
    return name.endswith(".film.1.weight") or name == "denoiser.observation.weight"


def _rearranged(found: torch.Tensor, weight: torch.Tensor, old: Experiment, new: Experiment) -> torch.Tensor | None:
    """The weights [outputs, inputs] of a layer whose last inputs are the condition, of all steps or of one, for that of `new`."""
    if found.dim() != 2 or len(found) != len(weight):
        return None
    columns, steps = _columns(old, new), new.policy.n_obs_steps
    if columns is None or old.policy.n_obs_steps != steps:
        return None
    before = old.condition // steps
    for repeated in (steps, 1):
        first = found.shape[1] - repeated * before
        if first >= 0 and weight.shape[1] == first + repeated * len(columns):
            seen = torch.arange(repeated)[:, None] * before + torch.tensor(columns)
            return torch.cat([found[:, :first], found[:, first + seen.flatten()]], 1)
    return None


def _columns(old: Experiment, new: Experiment) -> list[int] | None:
    """For each number in a step of the new condition, its place in a step of the old one; none if it lacks one."""
    known, at = {}, 0
    for key, length in _condition(old):
        known[key] = range(at, at + length)
        at += length
    columns = []
    for key, length in _condition(new):
        if len(known.get(key, ())) != length:
            return None
        columns += known[key]
    return columns


def _condition(spec: Experiment) -> list[tuple[str, int]]:
    """What a step of the condition consists of, in order, and how many numbers each part has."""
    pictures = [(o.key, spec.encoder.features) for o in spec.images]
    return [*((o.key, o.shape[0]) for o in spec.vectors), *pictures]


def _initializers(path: Path) -> dict[str, torch.Tensor]:
    graph = onnx.load(str(path)).graph
    return {i.name: torch.from_numpy(np.array(numpy_helper.to_array(i))) for i in graph.initializer}


def _load(module: nn.Module, found: dict[str, torch.Tensor], path: Path) -> None:
    missing = sorted(set(module.state_dict()) - set(found))
    if missing:
        raise ValueError(f"{path}: no weight {missing[0]!r}: not a graph of rapid_policy.export")
    module.load_state_dict({name: found[name] for name in module.state_dict()})


def _spec(described: dict[str, Any], encoder: dict[str, torch.Tensor], denoiser: dict[str, torch.Tensor]) -> Experiment:
    """The experiment that `policy.json` describes, with the networks as it has them, otherwise as the weights show them."""
    action = described["action"]
    network = described["training"].get("network") or _network(described, encoder, denoiser)
    horizon = ("n_obs_steps", "horizon", "n_action_steps", "control_hz", "mask_aware", "max_observation_age_ms")
    return Experiment.from_text(
        json.dumps(
            {
                "format": "rapid-experiment/1",
                "name": described["name"],
                "policy": {key: described[key] for key in horizon}
                | {"inference_steps": described["scheduler"]["num_inference_steps"]},
                "observation": [_observation(o) for o in described["observations"]],
                # Where the actions came from is not part of a bundle; what they are is in `policy.json`.
                "action": {"actuator": action["actuator"], "names": action["names"], "units": action["units"]},
                **network,
                "training": {"iterations": 1},
            }
        )
    )


def _observation(o: dict[str, Any]) -> dict[str, Any]:
    named = {key: o[key] for key in ("key", "kind", "modality", "required")}
    if o["kind"] == "vector":
        begin, end = o.get("slice") or (0, o["shape"][0])
        return {**named, "columns": list(range(begin, end))}
    size = {key: o[key] for key in ("resize", "crop", "operation") if o.get(key)}
    history = {"history": {"steps": o["history"]["steps"]}} if o.get("history") else {}
    return {**named, **({"size": o["shape"][1:]} if not {"resize", "crop"} & set(size) else {}), **size, **history}


def _network(
    described: dict[str, Any], encoder: dict[str, torch.Tensor], denoiser: dict[str, torch.Tensor]
) -> dict[str, Any]:
    image = next(o["key"] for o in described["observations"] if o["kind"] == "image")
    widths = []
    while (weight := denoiser.get(f"down.{len(widths)}.0.first.block.0.weight")) is not None:
        widths.append(weight.shape[0])
    sizes = {
        "width": encoder[f"images.{image}.net.0.0.weight"].shape[0],
        "features": encoder[f"images.{image}.out.weight"].shape[0],
        "keypoints": encoder[f"images.{image}.where.features.weight"].shape[0],
    }
    return {"encoder": sizes, "denoiser": {"widths": widths}}
