"""What every exporter writes beside the graphs: policy.json, README.md, and the numbers in them."""

import hashlib
import json
from pathlib import Path

import numpy as np

from . import Unsupported

FORMAT = "rapid-policy/1"
MASK, CONDITION = "mask", "global_cond"
ENCODER, DENOISER = "encoder.onnx", "denoiser.onnx"
# One protobuf file holds at most 2 GiB, and a graph of a bundle is one file.
MAX_GRAPH_BYTES = 2**31 - 2**20


def fits(entry: str, size: int) -> None:
    """Whether weights of `size` bytes fit one graph; `entry` names them."""
    if size > MAX_GRAPH_BYTES:
        raise Unsupported(f"{entry}: {size} bytes of weights do not fit one ONNX file")


def save(policy: dict, folder: Path) -> None:
    text = json.dumps(policy, indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "policy.json").write_text(text + "\n", encoding="utf-8")


def graphs(files: dict[str, str], folder: Path) -> dict:
    """The entry `graphs` of policy.json, for the file of each."""
    return {name: {"file": file, "sha256": sha256(folder / file)} for name, file in files.items()}


def sha256(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def mean_std(begin: int, mean: np.ndarray, std: np.ndarray) -> dict:
    """A slice of an action's normalisation."""
    values = {"mean": decimals(mean), "std": decimals(std), "eps": 0.0}
    return {"slice": [begin, begin + len(mean)], "mode": "mean_std", **values}


def decimals(values: np.ndarray) -> list[float]:
    """The shortest decimals that parse to these 32-bit floats."""
    return [float(str(np.float32(value))) for value in values]


def write_card(policy: dict, source: str, command: str, notes: str, folder: Path) -> None:
    """README.md: the model card, derived from policy.json. `source` is what models/`command` made it from."""
    action, scheduler, training = policy["action"], policy["scheduler"], policy["training"]
    rows = []
    for spec in policy["observations"]:
        what = f"{spec['kind']} {' x '.join(str(n) for n in spec['shape'])}"
        need = "required" if spec["required"] else "may be absent"
        rows.append(f"| `{spec['key']}` | `{spec['modality']}` | {what} | {spec['normalization']['mode']} | {need} |")
    executed = f"{policy['n_action_steps']} of them, from number {policy['action_start']} on"
    values = ", ".join(f"`{name}` [{unit}]" for name, unit in zip(action["names"], action["units"], strict=True))
    steps = f"{scheduler['num_inference_steps']} of {scheduler['num_train_timesteps']} steps"
    differences = ", ".join(f"{name} {value:.1e}" for name, value in training["verification"].items())
    (folder / "README.md").write_text(
        f"""# {policy["name"]}

A {source}, exported by `models/{command}`. `policy.json` has every number below.

| observation | modality | what | normalisation | presence |
|---|---|---|---|---|
{chr(10).join(rows)}

{policy["n_obs_steps"]} observations at {policy["control_hz"]:g} Hz give {policy["horizon"]} actions. {executed},
are executed by `{action["actuator"]}`, {values}.
{notes}

Scheduler: {scheduler["type"]}, {steps}, {scheduler["beta_schedule"]}, predicts {scheduler["prediction_type"]}.

Weights: SHA-256 `{training["weights_sha256"]}`. Largest difference from its networks in PyTorch at export, over random
observations: {differences}. How well the policy does its task was not measured.
""",
        encoding="utf-8",
    )
