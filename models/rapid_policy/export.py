"""Exports a checkpoint to a bundle: both graphs as ONNX, checked against PyTorch, `policy.json` and a model card.

python -m rapid_policy.export RUN/checkpoint.pt --out models/NAME
"""

from __future__ import annotations

import argparse
import itertools
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from torch import Tensor, nn

from . import bundle
from .bundle import DENOISER, ENCODER, encoder_inputs
from .checkpoint import load_weights, read_checkpoint
from .model import Policy, parameters
from .progress import plot
from .experiment import Experiment

OPSET = 17
# Both compute in float32, but in a different order.
TOLERANCE = 1e-4


def export(state: dict[str, Any], out: Path) -> float:
    """Writes the bundle of the checkpoint `state` into `out`. Returns the largest difference from PyTorch."""
    spec = Experiment.from_text(state["experiment"])
    policy = Policy(spec)
    load_weights(policy, state["average"])
    policy.eval()
    out.mkdir(parents=True, exist_ok=True)
    write_graph(policy.encoder, encoder_example(spec), encoder_inputs(spec), "global_cond", out / ENCODER)
    names = ["sample", "timestep", "global_cond"]
    write_graph(policy.denoiser, denoiser_example(spec), names, "epsilon", out / DENOISER)
    difference = largest_difference(spec, policy, out)
    if not difference <= TOLERANCE:
        raise ValueError(f"{out}: the graphs differ from PyTorch by {difference:.1e}, more than {TOLERANCE}")
    schedule = spec.training
    facts = {
        **state["provenance"],
        "seed": schedule.seed,
        "iterations": state["iteration"],
        "batch_windows": schedule.windows,
        "draws": schedule.draws,
        "minutes": round(state["seconds"] / 60, 1),
        "parameters": parameters([policy.encoder, policy.denoiser]),
        "difference": difference,
        "network": _network(spec),
    }
    bundle.write_policy(spec, facts, out)
    bundle.write_card(spec, facts, out)
    plot(state["losses"], spec.name, out / "loss.png", state["validation"])
    return difference


def _network(spec: Experiment) -> dict[str, Any]:
    """The sizes of the graphs, from which `weights` makes the networks again."""
    encoder = spec.encoder.model_dump(mode="json")
    if spec.encoder.weights:
        encoder["weights"] = Path(spec.encoder.weights).name
    return {"encoder": encoder, "denoiser": spec.denoiser.sizes()}


def encoder_example(spec: Experiment, batch: int = 2, mask: tuple[int, ...] | None = None) -> tuple[Tensor, ...]:
    """Random inputs of the encoder."""
    steps = [o.history.steps if o.history else spec.policy.n_obs_steps for o in spec.observation]
    inputs = [torch.rand(batch, n, *o.shape) * 2 - 1 for n, o in zip(steps, spec.observation, strict=True)]
    inputs += [_valid_example(batch, o.history.steps) for o in spec.histories]
    if spec.policy.mask_aware:
        row = torch.tensor(mask or (1,) * len(spec.images), dtype=torch.float32)
        inputs.append(row.repeat(batch, 1))
    return tuple(inputs)


def _valid_example(batch: int, steps: int) -> Tensor:
    """Which steps of a history have a picture: of every three rows some in the first, all in the second, none in the third."""
    valid = torch.randint(0, 2, (batch, steps)).float()
    valid[1::3], valid[2::3] = 1, 0
    return valid


def denoiser_example(spec: Experiment, batch: int = 2, timestep: int = 90) -> tuple[Tensor, ...]:
    """Random inputs of the denoiser."""
    sample = torch.randn(batch, spec.policy.horizon, spec.action_length)
    return sample, torch.full((batch,), timestep, dtype=torch.int64), torch.randn(batch, spec.condition)


def write_graph(module: nn.Module, example: tuple[Tensor, ...], inputs: list[str], output: str, path: Path) -> None:
    """Traces the module. Constants are not folded: every weight keeps its name and shape, onnxruntime folds them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            example,
            str(path),
            input_names=inputs,
            output_names=[output],
            dynamic_axes={name: {0: "B"} for name in [*inputs, output]},
            opset_version=OPSET,
            do_constant_folding=False,
            dynamo=False,
        )
    onnx.checker.check_model(str(path), full_check=True)


def largest_difference(spec: Experiment, policy: Policy, folder: Path) -> float:
    """Difference between graphs and PyTorch, over random inputs: every mask, histories with some steps, all and none,
    batches of 1 and 3, all timesteps used."""
    encoder, denoiser = (session(folder / name) for name in (ENCODER, DENOISER))
    masks = itertools.product((0, 1), repeat=len(spec.images)) if spec.policy.mask_aware else [None]
    differences = []
    with torch.no_grad():
        for mask, batch in itertools.product(masks, (1, 3)):
            inputs = encoder_example(spec, batch, mask)
            expected = policy.encoder(*inputs)
            differences.append(_difference(expected, encoder, encoder_inputs(spec), inputs))
            if mask is not None:
                # The contents of an absent picture must have no effect, nor those of a step that is not there.
                spoilt = _spoil_absent(spec, inputs, mask)
                differences.append(_difference(expected, encoder, encoder_inputs(spec), spoilt))
        for timestep, batch in itertools.product(range(0, 100, 10), (1, 3)):
            inputs = denoiser_example(spec, batch, timestep)
            names = ["sample", "timestep", "global_cond"]
            differences.append(_difference(policy.denoiser(*inputs), denoiser, names, inputs))
    # `max` would ignore a NaN.
    return float(np.max(differences))


def _spoil_absent(spec: Experiment, inputs: tuple[Tensor, ...], mask: tuple[int, ...]) -> tuple[Tensor, ...]:
    """The same inputs, with NaN where the mask has no picture, and where a history has none."""
    named = dict(zip(encoder_inputs(spec), inputs, strict=True))
    for o, there in zip(spec.images, mask, strict=True):
        if not there:
            named[o.key] = torch.full_like(named[o.key], torch.nan)
    for o in spec.histories:
        named[o.key] = torch.where(named[o.valid][..., None, None, None] > 0.5, named[o.key], torch.nan)
    return tuple(named.values())


def session(path: Path, threads: int = 1) -> onnxruntime.InferenceSession:
    """A graph, run on this many threads."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def _difference(
    expected: Tensor, graph: onnxruntime.InferenceSession, names: list[str], inputs: tuple[Tensor, ...]
) -> float:
    feed = {name: value.numpy() for name, value in zip(names, inputs, strict=True)}
    (got,) = graph.run(None, feed)
    return float(np.abs(got - expected.numpy()).max())


def main() -> None:
    parser = argparse.ArgumentParser(prog="rapid_policy.export", description="Makes a bundle from a checkpoint.")
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="folder of the bundle")
    args = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    try:
        state = read_checkpoint(args.checkpoint)
    except ValueError as error:
        sys.exit(f"export: {error}")
    if "final_loss" not in state["provenance"]:
        sys.exit(f"export: {args.checkpoint} belongs to a training that has not ended; continue it with --resume")
    try:
        difference = export(state, args.out)
    except ValueError as error:
        sys.exit(f"export: {error}")
    size = sum(path.stat().st_size for path in args.out.glob("*.onnx")) / 1e6
    print(f"{args.out}: {size:.1f} MB, largest difference to PyTorch {difference:.2e}")


if __name__ == "__main__":
    main()
