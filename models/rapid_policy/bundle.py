"""Writes the other files of a bundle beside its graphs: `policy.json` and the model card."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from .cache import sha256
from .diffusion import TRAIN_TIMESTEPS
from .normalize import EXECUTED, MinMax
from .experiment import Experiment, Observation

FORMAT = "rapid-policy/1"
ENCODER, DENOISER, POLICY = "encoder.onnx", "denoiser.onnx", "policy.json"
MASK = "mask"
# An action may exceed the range of the demonstrated ones by this share of it.
LIMIT_MARGIN = 0.05


def encoder_inputs(spec: Experiment) -> list[str]:
    """Names of the encoder's inputs, in order."""
    names = [*(o.key for o in spec.observation), *(o.valid for o in spec.histories)]
    return [*names, *([MASK] if spec.policy.mask_aware else [])]


def write_policy(spec: Experiment, facts: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Writes `policy.json` beside the graphs, which exist already. `facts` is the provenance of the weights."""
    policy = policy_json(spec, facts, {name: sha256(folder / name) for name in (ENCODER, DENOISER)})
    # Last and at once: a bundle that has it is complete.
    partial = folder / f"{POLICY}.partial"
    partial.write_text(json.dumps(policy, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    partial.replace(folder / POLICY)
    return policy


def policy_json(spec: Experiment, facts: dict[str, Any], hashes: dict[str, str]) -> dict[str, Any]:
    """The content of `policy.json`; models/README.md describes each key."""
    ranges = {key: MinMax.from_dict(value) for key, value in facts["normalization"].items()}
    policy, order = spec.policy, [o.modality for o in spec.images]
    return {
        "format": FORMAT,
        "name": spec.name,
        "mask_aware": policy.mask_aware,
        "n_obs_steps": policy.n_obs_steps,
        "horizon": policy.horizon,
        "n_action_steps": policy.n_action_steps,
        "action_start": spec.action_start,
        "control_hz": policy.control_hz,
        "max_observation_age_ms": policy.max_observation_age_ms,
        "observations": [_observation(o, ranges) for o in spec.observation],
        "mask": {"input": MASK, "order": order, "absent": "zero_embedding"} if policy.mask_aware else None,
        "action": _action(spec, ranges),
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
            "num_inference_steps": policy.inference_steps,
        },
        "graphs": {
            "encoder": {"file": ENCODER, "sha256": hashes[ENCODER]},
            "denoiser": {"file": DENOISER, "sha256": hashes[DENOISER]},
        },
        "training": {key: value for key, value in facts.items() if key != "normalization"},
    }


def _action(spec: Experiment, ranges: dict[str, MinMax]) -> dict[str, Any]:
    action = spec.action
    limits = ranges[EXECUTED if action.composed else "action"].widened(LIMIT_MARGIN)
    rotation = {} if action.rotation == "none" else {"rotation": action.rotation}
    base = {} if action.base is None else {"base": action.base.model_dump(mode="json", exclude_none=True)}
    return {
        "actuator": action.actuator,
        "shape": [spec.action_length],
        "names": list(action.names),
        "units": list(action.units),
        "representation": action.representation,
        **rotation,
        **base,
        "limits": {"min": limits.low.round(4).tolist(), "max": limits.high.round(4).tolist()},
        "normalization": [{"slice": [0, spec.action_length], **ranges["action"].to_dict()}],
    }


def _observation(o: Observation, ranges: dict[str, MinMax]) -> dict[str, Any]:
    common = {"key": o.key, "kind": o.kind, "modality": o.modality, "required": o.required, "shape": list(o.shape)}
    common |= {} if o.down_sample_steps == 1 else {"down_sample_steps": o.down_sample_steps}
    if o.kind == "vector":
        turned = {"rotation": "rotation_6d"} if o.turned else {}
        return {**common, "slice": list(o.run_slice), **turned, "normalization": ranges[o.key].to_dict()}
    held = {"when_absent": o.when_absent.model_dump()} if o.when_absent else {}
    history = {"history": {"steps": o.history.steps, "valid": o.valid}} if o.history else {}
    return {
        **common,
        **held,
        **history,
        "color": o.color,
        "resize": list(o.resize) if o.resize else None,
        "crop": list(o.crop) if o.crop else None,
        "operation": o.operation,
        "normalization": {"mode": "min_max", "min": [0.0] * 3, "max": [1.0] * 3},
    }


CARD = """\
# {name}

{kind} diffusion policy for `rapid`{does}

| | |
|---|---|
| Observes | {observes} |
| Absent pictures | {absent} |
| Does | {actions} of `{actuator}`, {representation}, {n_action_steps} of {horizon} predicted at {control_hz:g} Hz |
| Actions in the data | {source} |
| Parameters | {parameters:,}, float32 |
| Data | {episodes} episodes{tagged}, {frames} ticks, recorded by {recorded_by}; seeds of the episodes {seeds} |
| Data, SHA-256 | `{episodes_sha256}` |
| Training | {iterations} iterations of {windows} windows x {draws} noises, {minutes:.1f} min on {hardware}; seed {seed} |{began}
| Final loss | {final_loss:.4f} (mean squared error of the noise{outcomes}, mean of the last hundred iterations) |
| Exported graphs against PyTorch | largest difference {difference:.1e} over all masks |
{note}
![The loss over the iterations](loss.png)

## Made with
{recorded}
    {command}
    python -m rapid_policy.export RUN/checkpoint.pt --out {name}

in `models/`. The seed fixes the first weights, the order of the windows and the noise. Sums on another processor, or with
another number of threads, round differently, so that another machine gets weights that differ in detail.{earlier}
"""
EARLIER = """ The
earlier commands ran with the experiment file and the recordings of that time, which may differ from the present ones."""
# The policies that `make train` makes.
MADE = ("tactile-id", "tactile-id-memory")
SIMULATED = """
    make train POLICY={name}

which does, one after the other:
"""
RECORDED = """
    rapid --sim task --handheld --expert --record --episodes {episodes} --out EPISODES --seed {first}"""
# What made the first weights.
BEFORE = """
    {command}
    python -m rapid_policy.export RUN/checkpoint.pt --out BUNDLE"""


def write_card(spec: Experiment, facts: dict[str, Any], folder: Path) -> None:
    """Writes the model card, `README.md` of the bundle; every figure in it comes from `facts`."""
    seeds, action = facts["episode_seeds"], spec.action
    before, made = facts.get("started_from"), ""
    if spec.name in MADE and seeds:
        made = "" if before else SIMULATED.format(name=spec.name)
        made += RECORDED.format(episodes=facts["episodes"], first=seeds[0])
    made += "".join(BEFORE.format(command=one["command"]) for one in _first_ones(before) if one.get("command"))
    card = CARD.format(
        **{
            **facts,
            "name": spec.name,
            "kind": "A mask-aware" if spec.policy.mask_aware else "A",
            "does": f": {' '.join(spec.description.split())}" if spec.description else ".",
            "observes": ", ".join(_seen(o) for o in spec.observation) + f", {spec.policy.n_obs_steps} steps",
            "absent": _absent(spec),
            "actions": ", ".join(action.names),
            "actuator": action.actuator,
            "representation": f"{action.representation} targets",
            "source": "`/action`" if action.source == "action" else f"the next pose of `{action.pose}`",
            "n_action_steps": spec.policy.n_action_steps,
            "horizon": spec.policy.horizon,
            "control_hz": spec.policy.control_hz,
            "windows": facts["batch_windows"],
            "tagged": _tagged(facts.get("tags", {})),
            "recorded_by": ", ".join(facts["recorded_by"]),
            "seeds": f"{seeds[0]} to {seeds[1]}" if seeds else "unknown",
            "began": _began(before),
            "outcomes": _outcomes(spec),
            "earlier": EARLIER if before else "",
            "note": f"\n{spec.note}\n" if spec.note else "",
            "recorded": made,
        }
    )
    (folder / "README.md").write_text(card, encoding="utf-8")


def _first_ones(bundle: dict[str, Any] | None) -> list[dict[str, Any]]:
    """The bundles whose weights it began with, the earliest first."""
    return [*_first_ones(bundle.get("started_from")), bundle] if bundle else []


def _began(bundle: dict[str, Any] | None) -> str:
    """The row about the bundle that gave the first weights."""
    if not bundle:
        return ""
    whole = f"`{bundle['name']}` of {bundle['iterations']} iterations, seed {bundle['seed']}"
    return f"\n| First weights | those of {whole}, SHA-256 of its `policy.json` `{bundle['policy_sha256']}` |"


def _outcomes(spec: Experiment) -> str:
    """What the loss contains besides the noise."""
    return "".join(f" and, times {o.outcome:g}, of the outcome as `{o.key}` predicts it" for o in spec.images if o.outcome)


def _seen(o: Observation) -> str:
    sizes = [f"{what} to {size[1]}x{size[0]}" for what, size in (("resized", o.resize), ("cropped", o.crop)) if size]
    what = [o.modality, *sizes, *(["difference to the first picture"] if o.operation else [])]
    what += [f"{o.history.steps} steps over {o.span} ticks, those that there were"] if o.history else []
    return f"`{o.key}` ({', '.join(what)})"


def _absent(spec: Experiment) -> str:
    if not spec.policy.mask_aware:
        return "not provided for"
    dropped = []
    for o in spec.images:
        ways = o.dropout.model_dump()
        given = ", ".join(f"{'' if way == 'window' else way + ' '}{share:g}" for way, share in ways.items() if share)
        dropped += [f"`{o.key}` {given}"] if given else []
    held = [f"the last of `{o.key}` for {o.when_absent.hold_last_ms / 1000:g} s" for o in spec.images if o.when_absent]
    held += [f"what `{o.key}` remembers of `{spec.images[spec.column(o)].key}`" for o in spec.histories]
    stands = f"{', '.join(held)}; then, and all others, zeroed" if held else "zeroed"
    taken = [(o, now) for o in spec.histories if (now := spec.images[spec.column(o)]).dropout.window]
    dropped += [f"from `{o.key}` with `{now.key}` all that is newer than a moment, or all" for o, now in taken]
    return f"{stands} after their encoders, by the mask; taken away in training: " + (", ".join(dropped) or "none")


def _tagged(tags: dict[str, dict[str, int]]) -> str:
    counts = [", ".join(f"{n} {value}" for value, n in values.items()) for values in tags.values() if len(values) > 1]
    return f" ({'; '.join(counts)})" if counts else ""
