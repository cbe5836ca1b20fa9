#!/usr/bin/env python3
"""Times a chunk of actions in PyTorch and onnxruntime, both from Python: encoder and all denoising steps, batch 1.

    torch_latency.py BUNDLE [--json] [--chunks 200] [--threads 1]

Both use the weights of the bundle's graphs. The times include neither decoding pictures nor reading devices.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from rapid_policy.bundle import DENOISER, ENCODER, encoder_inputs
from rapid_policy.diffusion import ddim
from rapid_policy.export import encoder_example, session
from rapid_policy.model import Policy
from rapid_policy.weights import load_policy
from torch import Tensor

WARM_UP = 20
# Above this the two do not compute the same, and comparing times would be meaningless. The differences of the individual
# graphs accumulate over the denoising steps.
SAME = 1e-3


def main() -> None:
    parser = argparse.ArgumentParser(description="Times a chunk of actions in PyTorch and in onnxruntime.")
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--chunks", type=int, default=200, help="chunks to measure, after a warm-up (default: 200)")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    try:
        policy = load_policy(args.bundle)
    except (OSError, KeyError, ValueError) as error:
        sys.exit(f"torch_latency: {args.bundle}: {error}")
    spec = policy.spec
    observation = encoder_example(spec, batch=1)
    noise = torch.randn(1, spec.policy.horizon, spec.action_length)
    ways = {"pytorch_eager": in_torch(policy), "onnxruntime": in_onnxruntime(policy, args.bundle, args.threads)}
    chunks = [way(observation, noise) for way in ways.values()]
    difference = float((chunks[0] - chunks[1]).abs().max())
    if difference > SAME:
        sys.exit(f"torch_latency: the two ways differ by {difference:.1e}")
    report = {
        "bundle": str(args.bundle),
        "denoising_steps": spec.policy.inference_steps,
        "chunks": args.chunks,
        "threads": args.threads,
        "torch": torch.__version__,
        "onnxruntime": onnxruntime.__version__,
        "difference": difference,
        "ms": {name: measure(way, observation, noise, args.chunks) for name, way in ways.items()},
    }
    print(json.dumps(report) if args.json else table(report))


Way = Callable[[tuple[Tensor, ...], Tensor], Tensor]


def in_torch(policy: Policy) -> Way:
    """Eager mode."""

    def chunk(observation: tuple[Tensor, ...], noise: Tensor) -> Tensor:
        with torch.inference_mode():
            condition = policy.encoder(*observation)
            return ddim(lambda x, t: policy.denoiser(x, t, condition), noise, policy.spec.policy.inference_steps)

    return chunk


def in_onnxruntime(policy: Policy, folder: Path, threads: int) -> Way:
    """Both graphs, with the same sampler around them."""
    encoder, denoiser = (session(folder / name, threads) for name in (ENCODER, DENOISER))
    names = encoder_inputs(policy.spec)

    def chunk(observation: tuple[Tensor, ...], noise: Tensor) -> Tensor:
        feed = {name: value.numpy() for name, value in zip(names, observation, strict=True)}
        (condition,) = encoder.run(None, feed)

        def denoise(sample: Tensor, timestep: Tensor) -> Tensor:
            feed = {"sample": sample.numpy(), "timestep": timestep.numpy(), "global_cond": condition}
            return torch.from_numpy(denoiser.run(None, feed)[0])

        return ddim(denoise, noise, policy.spec.policy.inference_steps)

    return chunk


def measure(way: Way, observation: tuple[Tensor, ...], noise: Tensor, chunks: int) -> dict[str, float]:
    """Milliseconds per chunk; `cpu_p50` is processor time, which other programs affect less."""
    times, worked = [], []
    for i in range(WARM_UP + chunks):
        began, began_work = time.perf_counter_ns(), time.process_time_ns()
        way(observation, noise)
        if i >= WARM_UP:
            times.append((time.perf_counter_ns() - began) / 1e6)
            worked.append((time.process_time_ns() - began_work) / 1e6)
    figures = {f"p{q}": np.percentile(times, q) for q in (50, 90)} | {"cpu_p50": np.percentile(worked, 50)}
    return {name: round(float(value), 2) for name, value in figures.items()}


def table(report: dict[str, Any]) -> str:
    """For people."""
    head = f"observation to chunk, {report['denoising_steps']} steps, batch 1, threads: {report['threads']}"
    rows = [f"  {name:<14}" + "".join(f" {value:8.2f}" for value in ms.values()) for name, ms in report["ms"].items()]
    return "\n".join([head, f"  {'ms':<14} {'p50':>8} {'p90':>8} {'cpu p50':>8}", *rows])


if __name__ == "__main__":
    main()
