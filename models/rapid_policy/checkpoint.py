"""The state of a training, and its file: plain data and tensors, so that reading one runs no code of it."""

from __future__ import annotations

import copy
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .bundle import DENOISER, ENCODER, policy_json
from .experiment import Experiment, Training
from .model import Policy
from .weights import First

CHECKPOINT, BEST, BEST_SUCCESS = "checkpoint.pt", "best.pt", "best-success.pt"


@dataclass
class Run:
    """A training."""

    spec: Experiment
    policy: Policy
    average: Policy
    optimizer: torch.optim.Optimizer
    random: np.random.Generator
    provenance: dict[str, Any]
    iterations: int
    """How many the whole schedule has."""
    iteration: int = 0
    seconds: float = 0.0
    losses: list[float] = field(default_factory=list)
    validation: list[tuple[int, float]] = field(default_factory=list)
    """Iteration and loss on held-out episodes."""
    evaluations: list[dict[str, Any]] = field(default_factory=list)
    """What `trials` has found: iteration, trials, success, score and interval."""
    random_state: dict[str, Any] | None = None
    """The state of `random` after the last batch that was learned from: the feed is ahead of it."""

    @property
    def schedule(self) -> Training:
        """How it is trained."""
        return self.spec.training

    def save(self, path: Path, **facts: Any) -> None:
        """Writes the checkpoint; a run that is stopped meanwhile leaves the previous one. `facts` are added to the
        provenance."""
        state = {
            "experiment": self.spec.to_text(),
            "policy": self.policy.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "random": json.dumps(self.random_state or self.random.bit_generator.state),
            "torch_random": torch.get_rng_state(),
            # For dropout on a GPU.
            "cuda_random": torch.cuda.get_rng_state() if torch.cuda.is_initialized() else None,
            "provenance": {**self.provenance, **facts},
            "iterations": self.iterations,
            "iteration": self.iteration,
            "seconds": self.seconds,
            "losses": self.losses,
            "validation": self.validation,
            "evaluations": self.evaluations,
        }
        partial = path.with_suffix(".partial")
        torch.save(state, partial)
        partial.replace(path)

    def load(self, state: dict[str, Any]) -> None:
        """Continues from the checkpoint `state`."""
        load_weights(self.policy, state["policy"])
        load_weights(self.average, state["average"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.random.bit_generator.state = self.random_state = json.loads(state["random"])
        torch.set_rng_state(state["torch_random"])
        if state.get("cuda_random") is not None and torch.cuda.is_initialized():
            torch.cuda.set_rng_state(state["cuda_random"])
        self.iterations, self.iteration, self.seconds = state["iterations"], state["iteration"], state["seconds"]
        self.losses, self.validation = state["losses"], state["validation"]
        # Older checkpoints have none.
        self.evaluations = state.get("evaluations", [])

    @property
    def best(self) -> float:
        """The lowest loss on held-out episodes."""
        return min((loss for _, loss in self.validation), default=float("inf"))

    @property
    def best_success(self) -> float:
        """The highest share of trials that succeeded."""
        return max((found["score"] for found in self.evaluations), default=0.0)


def begin(spec: Experiment, windows: int, ranges: dict[str, Any], provenance: dict[str, Any], device: Any,
          first: First | None = None) -> Run:  # fmt: skip
    """Networks with random weights, determined by the seed, or those of a bundle, for `windows` windows whose vectors have
    these ranges."""
    schedule = spec.training
    torch.manual_seed(schedule.seed)
    policy = Policy(spec)
    if spec.encoder.weights:
        policy.start_from(Path(spec.encoder.weights))
    facts = {**provenance, "windows": windows, "normalization": {key: value.to_dict() for key, value in ranges.items()}}
    if first:
        first.give(policy, policy_json(spec, facts, {ENCODER: "", DENOISER: ""}))
    policy = policy.to(device)
    iterations = schedule.iterations or max(1, round((schedule.epochs or 1) * windows / schedule.windows))
    # For measuring: dropout would change its losses, and the random numbers after them, each time.
    average, random = copy.deepcopy(policy).requires_grad_(False).eval(), np.random.default_rng(schedule.seed)
    return Run(spec, policy, average, optimizer(schedule, policy), random, facts, iterations)


def optimizer(schedule: Training, policy: Policy) -> torch.optim.Optimizer:
    """The one that the schedule names."""
    weights, rate, decay = policy.parameters(), schedule.learning_rate, schedule.weight_decay
    if schedule.optimizer == "sgd":
        return torch.optim.SGD(weights, rate, momentum=schedule.betas[0], weight_decay=decay)
    kind = torch.optim.AdamW if schedule.optimizer == "adamw" else torch.optim.Adam
    return kind(weights, rate, betas=schedule.betas, weight_decay=decay, fused=True)


def load_weights(policy: Policy, weights: dict[str, torch.Tensor]) -> None:
    """Loads those of a checkpoint. Raises `ValueError` if they are of other networks than its experiment describes now."""
    different = sorted(policy.state_dict().keys() ^ weights.keys())
    if different:
        cause = f"of another version of rapid_policy, whose networks were others ({different[0]})"
        raise ValueError(f"the checkpoint is {cause}: train again, or use that version")
    policy.load_state_dict(weights)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The state in a checkpoint. Its pickle may hold only tensors and plain data: anything else is refused, not run."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        Experiment.from_text(state["experiment"])
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}") from error
    # What is not a checkpoint fails in the container, the unpickler or the description.
    except Exception as error:
        reason = str(error).strip().splitlines()[0]
        raise ValueError(f"{path}: not a checkpoint of rapid_policy.train: {reason}") from error
    return state
