"""Writes the other files of a bundle beside its graphs: `policy.json` and the model card."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from .diffusion import TRAIN_TIMESTEPS
from .normalize import MinMax
from .spec import Observation, Spec

FORMAT = "rapid-policy/1"
ENCODER, DENOISER, POLICY = "encoder.onnx", "denoiser.onnx", "policy.json"
MASK = "mask"
# An action may go this share of the range of the demonstrated ones beyond it.
LIMIT_MARGIN = 0.05


def encoder_inputs(spec: Spec) -> list[str]:
    """Names of the encoder's inputs, in order."""
    return [*(o.key for o in spec.observations), *([MASK] if spec.mask_aware else [])]


def write_policy(spec: Spec, facts: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Writes `policy.json` beside the graphs, which exist already. `facts` is the provenance of the weights."""
    policy = policy_json(spec, facts, {name: sha256(folder / name) for name in (ENCODER, DENOISER)})
    (folder / POLICY).write_text(json.dumps(policy, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    return policy


def policy_json(spec: Spec, facts: dict[str, Any], hashes: dict[str, str]) -> dict[str, Any]:
    """The content of `policy.json`; models/README.md describes each key."""
    ranges = {key: MinMax.from_dict(value) for key, value in facts["normalization"].items()}
    limits = ranges["action"].widened(LIMIT_MARGIN)
    actions = len(spec.action_names)
    order = [o.modality for o in spec.images]
    return {
        "format": FORMAT,
        "name": spec.name,
        "mask_aware": spec.mask_aware,
        "n_obs_steps": spec.n_obs_steps,
        "horizon": spec.horizon,
        "n_action_steps": spec.n_action_steps,
        "action_start": spec.action_start,
        "control_hz": spec.control_hz,
        "max_observation_age_ms": spec.max_observation_age_ms,
        "observations": [_observation(o, ranges) for o in spec.observations],
        "mask": {"input": MASK, "order": order, "absent": "zero_embedding"} if spec.mask_aware else None,
        "action": {
            "actuator": spec.actuator,
            "shape": [actions],
            "names": list(spec.action_names),
            "units": list(spec.action_units),
            "representation": "absolute",
            "limits": {"min": limits.low.round(4).tolist(), "max": limits.high.round(4).tolist()},
            "normalization": [{"slice": [0, actions], **ranges["action"].to_dict()}],
        },
        "scheduler": {
            "type": "DDIM",
            "num_train_timesteps": TRAIN_TIMESTEPS,
            "beta_schedule": "squaredcos_cap_v2",
            "beta_start": 0.0001,
            "beta_end": 0.02,
            "prediction_type": "epsilon",
            "clip_sample": True,
            "clip_sample_range": 1.0,
            "set_alpha_to_one": True,
            "steps_offset": 0,
            "timestep_spacing": "leading",
            "num_inference_steps": spec.inference_steps,
        },
        "graphs": {
            "encoder": {"file": ENCODER, "sha256": hashes[ENCODER]},
            "denoiser": {"file": DENOISER, "sha256": hashes[DENOISER]},
        },
        "training": {key: value for key, value in facts.items() if key != "normalization"},
    }


def _observation(o: Observation, ranges: dict[str, MinMax]) -> dict[str, Any]:
    common = {"key": o.key, "kind": o.kind, "modality": o.modality, "required": o.required, "shape": list(o.shape)}
    if o.kind == "vector":
        return {**common, "slice": [0, o.shape[0]], "normalization": ranges[o.key].to_dict()}
    return {
        **common,
        "color": "rgb",
        "resize": None,
        "crop": None,
        "operation": o.operation,
        "normalization": {"mode": "min_max", "min": [0.0] * 3, "max": [1.0] * 3},
    }


def sha256(path: Path) -> str:
    """The hash of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


CARD = """\
# {name}

A mask-aware diffusion policy for `rapid`: {does}

| | |
|---|---|
| Observes | {observes} |
| Absent pictures | {absent} |
| Does | {actions} of `{actuator}`, absolute targets, {n_action_steps} of {horizon} predicted at {control_hz:g} Hz |
| Parameters | {parameters:,}, float32 |
| Data | {episodes} simulated demonstrations ({textures}), {frames} ticks, recorded by {recorded_by}; seeds of the episodes {episode_seeds} |
| Data, SHA-256 | `{episodes_sha256}` |
| Training | {iterations} iterations of {windows} windows x {draws} noises, {minutes:.1f} min on {hardware}; seed {seed} |
| Final loss | {final_loss:.4f} (mean squared error of the noise, mean of the last hundred iterations) |
| Exported graphs against PyTorch | largest difference {difference:.1e} over all masks |

Trained in simulation only: it knows the two lattices of `rapid --sim task` and no real gel.

![The loss over the iterations](loss.png)

## Made with

    make train

which does, one after the other:

    rapid --sim task --expert --record --episodes {episodes} --out EPISODES --seed {first_seed}
    {command}
    python -m rapid_policy.export RUN/checkpoint.pt --out models/{name}

The seed fixes the first weights, the order of the windows and the noise. Sums on another processor, or with another
number of threads, round differently, so that another machine gets weights that differ in detail.
"""
DOES = {
    "tactile-id": "it grasps a block, tells by touch whether its surface is a triangular or a hexagonal lattice, and "
    "puts it to the left or to the front. Without the tactile sensor it continues and has to guess; without the wrist "
    "camera it continues and rarely finds the block; without both it holds.",
}


def write_card(spec: Spec, facts: dict[str, Any], folder: Path) -> None:
    """Writes the model card, `README.md` of the bundle; every figure in it comes from `facts`."""
    seeds = facts["episode_seeds"]
    dropped = [f"`{o.key}` {o.dropout:g}" for o in spec.images if o.dropout > 0]
    absent = "zeroed after their encoders, by the mask; taken away in training: " + ", ".join(dropped)
    card = CARD.format(
        **{
            **facts,
            "name": spec.name,
            "does": DOES.get(spec.name, "a configuration of an experiment."),
            "observes": ", ".join(
                f"`{o.key}` ({o.modality}{', difference to the first picture' if o.operation else ''})"
                for o in spec.observations
            )
            + f", {spec.n_obs_steps} steps",
            "absent": absent if spec.mask_aware else "not provided for",
            "actions": ", ".join(spec.action_names),
            "actuator": spec.actuator,
            "n_action_steps": spec.n_action_steps,
            "horizon": spec.horizon,
            "control_hz": spec.control_hz,
            "windows": facts["batch_windows"],
            "textures": ", ".join(f"{n} {texture}" for texture, n in facts["textures"].items()),
            "recorded_by": ", ".join(facts["recorded_by"]),
            "episode_seeds": f"{seeds[0]} to {seeds[1]}" if seeds else "unknown",
            "first_seed": seeds[0] if seeds else "SEED",
        }
    )
    (folder / "README.md").write_text(card, encoding="utf-8")
