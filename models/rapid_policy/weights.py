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
from .experiment import Experiment


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


def _spec(described: dict[str, Any], encoder: dict[str, torch.Tensor], denoiser: dict[str, torch.Tensor]) -> Experiment:
    """The contents of `policy.json`, with the networks as it has them, otherwise as the weights show them."""
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
                # Where the actions came from is no part of a bundle; what they are is in `policy.json`.
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
    history = {"history": {"steps": o["history"]["steps"]}} if "history" in o else {}
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
