"""The networks of a bundle, back in PyTorch: the weights are taken from the graphs, so that the bundle is enough."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import nn

from .bundle import DENOISER, ENCODER, POLICY
from .model import Policy
from .spec import Network, Observation, Spec


def load_policy(folder: Path) -> Policy:
    """The policy of a bundle that `rapid_policy.export` made; other bundles have other weight names."""
    described = json.loads((folder / POLICY).read_text(encoding="utf-8"))
    encoder, denoiser = _initializers(folder / ENCODER), _initializers(folder / DENOISER)
    policy = Policy(_spec(described, encoder, denoiser))
    _load(policy.encoder, encoder, folder / ENCODER)
    _load(policy.denoiser, denoiser, folder / DENOISER)
    return policy.eval()


def _initializers(path: Path) -> dict[str, torch.Tensor]:
    graph = onnx.load(str(path)).graph
    return {i.name: torch.from_numpy(np.array(numpy_helper.to_array(i))) for i in graph.initializer}


def _load(module: nn.Module, found: dict[str, torch.Tensor], path: Path) -> None:
    missing = sorted(set(module.state_dict()) - set(found))
    if missing:
        raise ValueError(f"{path}: no weight {missing[0]!r}: not a graph of rapid_policy.export")
    module.load_state_dict({name: found[name] for name in module.state_dict()})


def _spec(described: dict[str, Any], encoder: dict[str, torch.Tensor], denoiser: dict[str, torch.Tensor]) -> Spec:
    """The contents of `policy.json`, with the sizes that only the weights show."""
    observations = tuple(
        Observation(o["key"], o["kind"], o["modality"], tuple(o["shape"]), o["required"], o.get("operation"))
        for o in described["observations"]
    )
    action = described["action"]
    image = next(o.key for o in observations if o.kind == "image")
    widths = []
    while (weight := denoiser.get(f"down.{len(widths)}.0.first.block.0.weight")) is not None:
        widths.append(weight.shape[0])
    network = Network(
        image_width=encoder[f"images.{image}.net.0.0.weight"].shape[0],
        image_features=encoder[f"images.{image}.out.weight"].shape[0],
        keypoints=encoder[f"images.{image}.where.features.weight"].shape[0],
        denoiser=tuple(widths),
    )
    return Spec(
        name=described["name"],
        observations=observations,
        action_names=tuple(action["names"]),
        action_units=tuple(action["units"]),
        actuator=action["actuator"],
        n_obs_steps=described["n_obs_steps"],
        horizon=described["horizon"],
        n_action_steps=described["n_action_steps"],
        control_hz=described["control_hz"],
        mask_aware=described["mask_aware"],
        inference_steps=described["scheduler"]["num_inference_steps"],
        network=network,
    )
