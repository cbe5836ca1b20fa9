"""Trains a policy from recorded episodes.

    python -m rapid_policy.train EPISODES --out RUN [--resume]

Writes RUN/checkpoint.pt (from which `rapid_policy.export` makes a bundle and `--resume` continues) and RUN/loss.png.
"""

from __future__ import annotations

import argparse
import copy
import hashlib
import math
import platform
import sys
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .dataset import Batch, Dataset
from .diffusion import TRAIN_TIMESTEPS, add_noise, alphas_cumprod
from .episodes import Episode, EpisodeError, episode_files, read_episodes
from .model import Policy, parameters
from .progress import Progress, plot, recent
from .spec import SPECS, Spec

CHECKPOINT = "checkpoint.pt"
SAVE_EVERY = 500


@dataclass(frozen=True)
class Schedule:
    """Training schedule."""

    iterations: int = 3900
    minutes: float = math.inf
    """The learning rate falls with whichever limit is reached first; training ends there."""
    seed: int = 0
    windows: int = 64
    """Batch size."""
    draws: int = 2
    """Noises drawn for each window: the encoder is the more expensive half, and runs once for all of them."""
    learning_rate: float = 1e-3
    final_rate: float = 0.005
    """Share of the learning rate that is left at the end."""
    warmup: int = 100
    """Iterations."""
    decay: float = 0.995
    """Decay of the moving average of the weights, which is exported."""


@dataclass
class Run:
    """The contents of a checkpoint."""

    spec: Spec
    schedule: Schedule
    policy: Policy
    average: Policy
    optimizer: torch.optim.Optimizer
    random: np.random.Generator
    provenance: dict[str, Any]
    iteration: int = 0
    seconds: float = 0.0
    losses: list[float] = field(default_factory=list)

    def save(self, path: Path) -> None:
        """Writes the checkpoint; a run that is stopped meanwhile leaves the previous one."""
        state = {
            "spec": self.spec.to_dict(),
            "schedule": vars(self.schedule),
            "policy": self.policy.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "random": self.random.bit_generator.state,
            "torch_random": torch.get_rng_state(),
            "provenance": self.provenance,
            "iteration": self.iteration,
            "seconds": self.seconds,
            "losses": self.losses,
        }
        partial = path.with_suffix(".partial")
        torch.save(state, partial)
        partial.replace(path)

    def load(self, state: dict[str, Any]) -> None:
        """Continues from the checkpoint `state`."""
        self.policy.load_state_dict(state["policy"])
        self.average.load_state_dict(state["average"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.random.bit_generator.state = state["random"]
        torch.set_rng_state(state["torch_random"])
        self.iteration, self.seconds, self.losses = state["iteration"], state["seconds"], state["losses"]


def begin(spec: Spec, schedule: Schedule, dataset: Dataset, provenance: dict[str, Any], device: torch.device) -> Run:
    """Networks with random weights, determined by the seed."""
    torch.manual_seed(schedule.seed)
    policy = Policy(spec).to(device)
    optimizer = torch.optim.AdamW(
        policy.parameters(), schedule.learning_rate, betas=(0.95, 0.999), weight_decay=1e-6, fused=True
    )
    ranges = {key: value.to_dict() for key, value in dataset.ranges.items()}
    facts = {**provenance, "windows": len(dataset.windows), "normalization": ranges}
    random = np.random.default_rng(schedule.seed)
    return Run(spec, schedule, policy, copy.deepcopy(policy).requires_grad_(False), optimizer, random, facts)


def train(run: Run, dataset: Dataset, out: Path) -> float:
    """Trains to the end of the schedule. Returns the final loss: the mean of the last hundred iterations.

    Whatever ends it before, the checkpoint in `out` is the one to continue from.
    """
    progress = Progress(run.spec.name, run.schedule.iterations, run.iteration)
    try:
        _iterate(run, dataset, out, progress)
        run.provenance["final_loss"] = recent(run.losses)
    finally:
        progress.close()
        run.save(out / CHECKPOINT)
    plot(run.losses, run.spec.name, out / "loss.png")
    return run.provenance["final_loss"]


def _iterate(run: Run, dataset: Dataset, out: Path, progress: Progress) -> None:
    schedule, device = run.schedule, next(run.policy.parameters()).device
    table = alphas_cumprod().to(device)
    started, before = time.monotonic(), run.seconds
    while run.iteration < schedule.iterations:
        run.seconds = before + time.monotonic() - started
        done = max(run.iteration / schedule.iterations, run.seconds / (60 * schedule.minutes))
        if done >= 1:
            break
        _set_rate(run, done)
        loss = _loss(run, dataset.draw(run.random, schedule.windows), table, device)
        if not torch.isfinite(loss):
            raise ValueError(f"the loss is not finite in iteration {run.iteration}")
        run.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(run.policy.parameters(), 1.0)
        run.optimizer.step()
        _follow(run)
        run.iteration += 1
        run.losses.append(loss.item())
        progress.step(run.losses, done, run.seconds)
        if run.iteration % SAVE_EVERY == 0:
            run.save(out / CHECKPOINT)


def _set_rate(run: Run, done: float) -> None:
    """Warm-up, then half a cosine down."""
    schedule = run.schedule
    share = 0.5 * (1 + math.cos(math.pi * done)) + schedule.final_rate
    for group in run.optimizer.param_groups:
        group["lr"] = schedule.learning_rate * min(1.0, run.iteration / schedule.warmup) * share


def _loss(run: Run, batch: Batch, table: Tensor, device: torch.device) -> Tensor:
    """Mean squared error of the predicted noise."""
    observations = {key: value.to(device) for key, value in batch.observations.items()}
    mask = drop(run.spec, batch.present, run.random).to(device) if run.spec.mask_aware else None
    # Only the encoder: its convolutions gain most from half precision, the denoiser's small ones nothing.
    with torch.autocast(device.type, torch.bfloat16, enabled=half_width(device)):
        condition = run.policy.encoder.encode(observations, mask, pooled=True)
    condition = condition.float().repeat(run.schedule.draws, 1)
    clean = batch.actions.to(device).repeat(run.schedule.draws, 1, 1)
    timestep = torch.randint(0, TRAIN_TIMESTEPS, (len(clean),)).to(device)
    noise = torch.randn(clean.shape).to(device)
    predicted = run.policy.denoiser(add_noise(clean, noise, timestep, table), timestep, condition)
    return F.mse_loss(predicted, noise)


def drop(spec: Spec, present: Tensor, random: np.random.Generator) -> Tensor:
    """Masks pictures at random, f32 [B, M]: of several `present` ones, bool [B, M], at least one always remains.

    A policy with one picture has its vectors left.
    """
    rates = np.array([o.dropout for o in spec.images])
    there = present.numpy()
    kept = there & (random.random(there.shape) >= rates)
    if len(rates) > 1:
        # The one that remains in a window that lost all: any present one, with equal probability.
        lot = np.where(there, random.random(there.shape), -1.0)
        lost = ~kept.any(1) & there.any(1)
        kept[lost, lot[lost].argmax(1)] = True
    return torch.from_numpy(kept.astype(np.float32))


@torch.no_grad()
def _follow(run: Run) -> None:
    """Moves the average towards the weights; faster in the beginning, when the early weights are of no use."""
    decay = min(run.schedule.decay, (1 + run.iteration) / (10 + run.iteration))
    averages, weights = list(run.average.parameters()), list(run.policy.parameters())
    torch._foreach_lerp_(averages, weights, 1 - decay)


def half_width(device: torch.device) -> bool:
    """Whether the device computes natively in bfloat16; emulation would cost time."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    return bool(torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported())


def provenance(episodes: list[Episode], command: str) -> dict[str, Any]:
    """The origin of the weights: training data and software."""
    digest = hashlib.sha256()
    for episode in episodes:
        digest.update(hashlib.sha256(episode.path.read_bytes()).digest())
    seeds = sorted(int(e.tags["seed"]) for e in episodes if e.tags.get("seed", "").isdigit())
    return {
        "episodes": len(episodes),
        "frames": sum(len(e) for e in episodes),
        "textures": dict(sorted(Counter(e.tags.get("texture", "unknown") for e in episodes).items())),
        "episode_seeds": [seeds[0], seeds[-1]] if seeds else None,
        "episodes_sha256": digest.hexdigest(),
        "recorded_by": sorted({e.facts.get("software", "") for e in episodes}),
        "command": command,
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def load_episodes(spec: Spec, folder: Path) -> list[Episode]:
    """The episodes of a folder; prints those left out."""
    episodes, left_out = read_episodes(episode_files(folder), spec.observations, len(spec.action_names))
    for line in left_out:
        print(line, file=sys.stderr)
    if not episodes:
        raise EpisodeError(folder, "no episode that is fit to learn from")
    return episodes


def pick_device(name: str) -> torch.device:
    """`auto`: the GPU if there is one."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)


def hardware(device: torch.device) -> str:
    """The device of the training, in words."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    threads = torch.get_num_threads()
    return f"{threads} CPU thread{'s' if threads > 1 else ''}"


def main() -> None:
    defaults = Schedule()
    parser = argparse.ArgumentParser(prog="rapid_policy.train", description="Trains a policy from recorded episodes.")
    parser.add_argument("episodes", type=Path, help="folder of episodes (*.mcap)")
    parser.add_argument("--out", type=Path, required=True, help="folder for the checkpoint and the plot of the loss")
    parser.add_argument("--policy", choices=sorted(SPECS), default="tactile-id")
    parser.add_argument("--iterations", type=int, default=defaults.iterations)
    parser.add_argument("--minutes", type=float, default=math.inf, help="end after so long at the latest")
    parser.add_argument("--seed", type=int, default=defaults.seed)
    parser.add_argument("--threads", type=int, default=2, help="of the CPU")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda")
    parser.add_argument("--resume", action="store_true", help="continue from the checkpoint in --out")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    args.out.mkdir(parents=True, exist_ok=True)
    checkpoint = args.out / CHECKPOINT
    try:
        state = torch.load(checkpoint, weights_only=False) if args.resume else None
        spec = Spec.from_dict(state["spec"]) if state else SPECS[args.policy]()
        episodes = load_episodes(spec, args.episodes)
        dataset = Dataset(spec, episodes)
    except (OSError, EpisodeError, ValueError) as error:
        sys.exit(f"train: {error}")
    command_line = f"python -m rapid_policy.train EPISODES --out RUN --iterations {args.iterations} --seed {args.seed}"
    schedule = replace(defaults, iterations=args.iterations, minutes=args.minutes, seed=args.seed)
    if state:
        schedule = replace(Schedule(**state["schedule"]), minutes=args.minutes)
    device = pick_device(args.device)
    facts = provenance(episodes, command_line)
    facts["hardware"] = hardware(device)
    if state and state["provenance"]["episodes_sha256"] != facts["episodes_sha256"]:
        sys.exit(f"train: {checkpoint} was trained on other episodes than those in {args.episodes}")
    run = begin(spec, schedule, dataset, facts, device)
    if state:
        run.load(state)
    counts = f"{len(episodes)} episodes, {len(dataset.windows)} windows, {parameters([run.policy]):,} parameters"
    print(f"{spec.name}: {counts}", flush=True)
    try:
        final = train(run, dataset, args.out)
    except ValueError as error:
        sys.exit(f"train: {error}")
    except KeyboardInterrupt:
        sys.exit(f"train: stopped after {run.iteration} iterations; --resume continues from {checkpoint}")
    print(f"final loss {final:.4f} after {run.iteration} iterations, {run.seconds / 60:.1f} min: {checkpoint}")


if __name__ == "__main__":
    main()
