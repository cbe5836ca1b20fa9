#!/usr/bin/env python3
"""Classifies the texture of a block from single pictures: how well the tactile camera shows it, raw and as difference
to the untouched gel, and whether the wrist camera shows it too; and how that depends on noise and pressure.

    texture.py EPISODES [--encoder resnet18] [--cache runs/cache] [--out results] [--folds 10] [--iterations 400] [--seed 0]

The classifier is an image encoder of the policy with one additional layer: the small one, or ResNet-18 from scratch (the
paper's was trained on other pictures first). Every episode with pictures of a touch is tested by a classifier that was not
trained on it: the episodes are divided into folds, and each fold is tested by one trained on the others.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from rapid_policy.corpus import load
from rapid_policy.episodes import Episode, EpisodeError
from rapid_policy.experiment import Encoder
from rapid_policy.experiment_file import ExperimentError, read_experiment
from rapid_policy.model import ENCODERS, parameters
from rapid_policy.ranks import join
from rapid_policy.results import wilson, write
from rapid_policy.train import hardware
from torch import nn

matplotlib.use("Agg")
TEXTURES = ("triangular", "hexagonal")
# Modality of the pictures, and whether they are the difference to the first one.
INPUTS = {
    "tactile, difference to the first picture": ("tactile_tip", True),
    "tactile, as it is": ("tactile_tip", False),
    "wrist camera": ("cam_wrist", False),
}
SIDE = 96
# Random shift of a picture, each way, in pixels.
PAD = 4
# In contact: the gel has changed by this multiple of its noise before the touch.
CONTACT = 1.5
UNTOUCHED = 10
BATCH = 64
LEARNING_RATE = 1e-3
# Standard deviations of noise that is added to the pictures of the first input, of a full scale of 1.
NOISES = (0.0, 0.02, 0.05, 0.1, 0.2)
# Parts of the pictures, by how strongly the gel has changed: the first are those of the weakest pressure.
PRESSURES = 5


@dataclass
class Pictures:
    """N pictures of one input."""

    pixels: NDArray[np.float32]
    """[N, 3, h, w] averaged as the encoder does, in -1..1, with a margin for shifts"""
    labels: NDArray[np.int64]
    """[N] index in TEXTURES"""
    episodes: NDArray[np.int64]
    """[N] index of the episode"""
    change: NDArray[np.float32]
    """[N] mean change of the gel, of a full scale of 2: what the pressure does"""


def main() -> None:
    parser = argparse.ArgumentParser(description="Tells the texture of a block from single pictures.")
    parser.add_argument("episodes", type=Path)
    parser.add_argument("--cache", type=Path, default=Path(__file__).parent / "runs" / "cache", help="decoded episodes")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--encoder", choices=sorted(ENCODERS), default="small")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda")
    parser.add_argument("--folds", type=int, default=10)
    parser.add_argument("--iterations", type=int, default=400, help="of each training")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    device, encoder = join(args.device).device, Encoder(type=args.encoder)
    try:
        experiment = read_experiment(Path(__file__).parent / "experiments" / "tactile-id-arm.toml")
        corpus = load(experiment, [args.episodes], args.cache, args.threads)
        print(corpus.report(), file=sys.stderr)
        episodes = corpus.training
        labels = [label(e) for e in episodes]
    except (EpisodeError, ExperimentError) as error:
        sys.exit(f"texture: {error}")
    contact = [in_contact(e) for e in episodes]
    begin, rows = time.monotonic(), {}
    for name, (modality, differs) in INPUTS.items():
        pictures = gather(episodes, labels, contact, modality, differs, encoder.pool)
        training = Training(encoder, args.iterations, args.seed, device)
        rows[name] = cross_validate(pictures, args.folds, training)
        print(f"{name}: accuracy {rows[name]['accuracy']:.4f} of {rows[name]['pictures']} pictures", flush=True)
    given = "" if args.encoder == "small" else f" --encoder {args.encoder}"
    report = {
        "command": f"texture.py EPISODES{given} --folds {args.folds} --iterations {args.iterations} --seed {args.seed}",
        "encoder": args.encoder,
        "parameters": parameters([Classifier(encoder)]),
        "hardware": hardware(device),
        "episodes": len(episodes),
        "textures": {name: labels.count(i) for i, name in enumerate(TEXTURES)},
        "folds": args.folds,
        "iterations": args.iterations,
        "seed": args.seed,
        "minutes": round((time.monotonic() - begin) / 60, 1),
        "inputs": rows,
    }
    name = "texture" if args.encoder == "small" else f"texture-{args.encoder}"
    write(args.out, name, report, markdown(report, f"{name}.png"))
    plot(rows, args.out / f"{name}.png")


def label(episode: Episode) -> int:
    """The texture, from the tags that the simulation writes into an episode."""
    try:
        return TEXTURES.index(episode.facts.tags["texture"])
    except (KeyError, ValueError) as error:
        raise EpisodeError(episode.path, f"no tag `texture` of {' or '.join(TEXTURES)}") from error


def in_contact(episode: Episode) -> NDArray[np.bool_]:
    """[T] whether the fingertip is pressed on the block."""
    changed = change(episode)
    return episode.present("tactile_tip") & (changed > CONTACT * np.median(changed[1:UNTOUCHED]))


def change(episode: Episode) -> NDArray[np.float32]:
    """[T] mean change of the gel since the first picture."""
    return np.abs(pool(episode, "tactile_tip", differs=True, size=Encoder().pool)).mean((1, 2, 3))


def pool(episode: Episode, modality: str, differs: bool, size: int) -> NDArray[np.float32]:
    """[T, 3, h, w]: pictures in -1..1, averaged over `size` pixels each way, with their edges repeated outwards."""
    pictures = _unit(episode.value(modality))
    if differs:
        pictures = pictures - _unit(episode.value(modality)[episode.first(modality)][None])
    else:
        pictures = pictures * 2 - 1
    padded = F.pad(F.avg_pool2d(pictures, size), (PAD // size,) * 4, mode="replicate")
    return padded.numpy() * episode.present(modality)[:, None, None, None]


def _unit(pictures: NDArray[np.uint8]) -> torch.Tensor:
    """u8 [T, H, W, 3] -> f32 [T, 3, H, W] in 0..1"""
    return torch.from_numpy(np.array(pictures)).permute(0, 3, 1, 2).float() / 255


def gather(
    episodes: list[Episode], labels: list[int], contact: list[NDArray[np.bool_]], modality: str, differs: bool, size: int
) -> Pictures:
    """The pictures of one input at all ticks in contact."""
    chosen = [c & e.present(modality) for c, e in zip(contact, episodes, strict=True)]
    return Pictures(
        pixels=np.concatenate([pool(e, modality, differs, size)[c] for e, c in zip(episodes, chosen, strict=True)]),
        labels=np.concatenate([np.full(c.sum(), k) for c, k in zip(chosen, labels, strict=True)]),
        episodes=np.concatenate([np.full(c.sum(), i) for i, c in enumerate(chosen)]),
        change=np.concatenate([change(e)[c] for e, c in zip(episodes, chosen, strict=True)]),
    )


@dataclass(frozen=True)
class Training:
    """How a classifier is trained."""

    encoder: Encoder
    iterations: int
    seed: int
    device: torch.device

    @property
    def margin(self) -> int:
        """Of the pictures as the encoder gets them."""
        return PAD // self.encoder.pool


def cross_validate(pictures: Pictures, folds: int, training: Training) -> dict[str, Any]:
    """Counts the results of classifiers on pictures of episodes that they were not trained on."""
    random = np.random.default_rng(training.seed)
    answers = np.full((len(NOISES), len(pictures.labels)), -1)
    for fold in deal(pictures, folds, random):
        tested = np.isin(pictures.episodes, fold)
        torch.manual_seed(training.seed)
        classifier = fit(pictures, np.flatnonzero(~tested), training, random)
        for level, deviation in enumerate(NOISES):
            # A picture is in -1..1 here, so that a full scale is 2; averaged pixels have less noise.
            noise = 2 * deviation / training.encoder.pool
            answers[level, tested] = classify(classifier, pictures.pixels[tested], noise, training, random)
    right = answers == pictures.labels
    edges = np.quantile(pictures.change, np.linspace(0, 1, PRESSURES + 1)[1:-1])
    parts = np.digitize(pictures.change, edges)
    return {
        **score(pictures, answers[0]),
        "accuracy_by_noise": dict(zip(map(str, NOISES), right.mean(1).tolist(), strict=True)),
        "accuracy_by_pressure": [
            {"change": float(pictures.change[parts == part].mean()), "accuracy": float(right[0, parts == part].mean())}
            for part in range(PRESSURES)
        ],
    }


def deal(pictures: Pictures, folds: int, random: np.random.Generator) -> list[NDArray[np.int64]]:
    """Divides the episodes into `folds` folds, with both textures spread evenly."""
    shuffled = []
    for texture in range(len(TEXTURES)):
        shuffled.extend(random.permutation(np.unique(pictures.episodes[pictures.labels == texture])))
    return [np.array(shuffled[i::folds]) for i in range(folds)]


class Classifier(nn.Module):
    """Pictures [B, 3, h, w], averaged as the encoder does -> [B, 2]"""

    def __init__(self, encoder: Encoder) -> None:
        super().__init__()
        self.encoder = ENCODERS[encoder.type](SIDE, SIDE, encoder)
        self.head = nn.Linear(encoder.features, len(TEXTURES))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.head(self.encoder.pooled(x))


def fit(pictures: Pictures, chosen: NDArray[np.int64], training: Training, random: np.random.Generator) -> Classifier:
    """Trains on pictures randomly shifted. They are not turned: with the lights where they are, half a turn makes bumps holes."""
    classifier = Classifier(training.encoder).to(training.device)
    optimizer = torch.optim.AdamW(classifier.parameters(), LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=training.iterations)
    height, width = (side - 2 * training.margin for side in pictures.pixels.shape[2:])
    for _ in range(training.iterations):
        rows = chosen[random.integers(len(chosen), size=BATCH)]
        top, left = random.integers(2 * training.margin + 1, size=2)
        batch = torch.from_numpy(pictures.pixels[rows, :, top : top + height, left : left + width]).to(training.device)
        loss = F.cross_entropy(classifier(batch), torch.from_numpy(pictures.labels[rows]).to(training.device))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        schedule.step()
    return classifier


@torch.no_grad()
def classify(classifier: Classifier, pixels: NDArray[np.float32], noise: float, training: Training,
             random: np.random.Generator) -> NDArray[np.int64]:  # fmt: skip
    """[N] the predicted class of pictures with this deviation of noise on them."""
    margin, found = training.margin, []
    for first in range(0, len(pixels), 256):
        part = pixels[first : first + 256, :, margin:-margin, margin:-margin]
        noisy = torch.from_numpy(part + noise * random.standard_normal(part.shape, np.float32))
        found.append(classifier(noisy.to(training.device)).argmax(1).cpu())
    return torch.cat(found).numpy()


def score(pictures: Pictures, answers: NDArray[np.int64]) -> dict[str, Any]:
    """Accuracy over pictures and over episodes (by majority of their pictures), precision, recall, counts."""
    labels = pictures.labels
    confusion = np.array([[np.sum((labels == t) & (answers == s)) for s in (0, 1)] for t in (0, 1)])
    by_episode = [
        np.mean(answers[pictures.episodes == e] == labels[pictures.episodes == e]) > 0.5
        for e in np.unique(pictures.episodes)
    ]
    diagonal = confusion.diagonal()
    return {
        "pictures": int(len(labels)),
        "episodes": len(by_episode),
        "accuracy": float(np.mean(answers == labels)),
        "episode_accuracy": float(np.mean(by_episode)),
        "episode_interval": wilson(int(np.sum(by_episode)), len(by_episode)),
        "precision": dict(zip(TEXTURES, (diagonal / np.maximum(confusion.sum(0), 1)).tolist(), strict=True)),
        "recall": dict(zip(TEXTURES, (diagonal / np.maximum(confusion.sum(1), 1)).tolist(), strict=True)),
        "confusion": confusion.tolist(),
    }


def plot(rows: dict[str, Any], to: Path) -> None:
    """Accuracy over the noise that is added, and over the change of the gel."""
    figure, (noise, pressure) = plt.subplots(1, 2, figsize=(9, 3.2), sharey=True)
    for name, row in rows.items():
        if not name.startswith("tactile"):
            continue
        noise.plot([float(d) for d in row["accuracy_by_noise"]], list(row["accuracy_by_noise"].values()), "o-", label=name)
        parts = row["accuracy_by_pressure"]
        pressure.plot([part["change"] for part in parts], [part["accuracy"] for part in parts], "o-", label=name)
    noise.set(xlabel="noise added, of full scale", ylabel="accuracy", ylim=(0.4, 1.02))
    pressure.set(xlabel="mean change of the gel, of full scale 2")
    noise.legend(fontsize=7)
    for axes in (noise, pressure):
        axes.axhline(0.5, color="grey", linewidth=0.8)
        axes.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(to, dpi=110)


NETWORKS = {"small": "the image encoder of the policy", "resnet18": "ResNet-18, from scratch"}


def markdown(report: dict[str, Any], picture: str) -> str:
    """The same for people."""
    given = "" if report["encoder"] == "small" else f" ENCODER={report['encoder']}"
    touched = max(row["episodes"] for row in report["inputs"].values())
    lines = [
        "# What a picture shows of the texture",
        "",
        f"A classifier of single pictures ({NETWORKS[report['encoder']]}; {report['parameters']:,} parameters), taken while the",
        f"fingertip is pressed on the block in {report['episodes']} simulated episodes",
        f"({', '.join(f'{n} {name}' for name, n in report['textures'].items())}). A picture is of a touch if the gel has changed by more",
        f"than {CONTACT} times its noise; {touched} of the episodes have such pictures, and the others, whose touch is the weakest, are",
        f"not part of it. Every episode is tested by a classifier that saw no picture of it: {report['folds']} folds, each classifier",
        f"trained for {report['iterations']} iterations, seed {report['seed']}.",
        "",
        "| input | pictures | accuracy | precision tri / hex | recall tri / hex | episodes by majority | 95 % |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, row in report["inputs"].items():
        precision, recall = (" / ".join(f"{row[k][t]:.3f}" for t in TEXTURES) for k in ("precision", "recall"))
        low, high = row["episode_interval"]
        lines.append(
            f"| {name} | {row['pictures']} | {row['accuracy']:.2%} | {precision} | {recall} |"
            f" {row['episode_accuracy']:.2%} | {low:.0%}-{high:.0%} |"
        )
    lines += [
        "",
        "Chance is 50 %. The pictures of an episode resemble each other: the interval (Wilson) is of the episodes, each by",
        "the majority of its pictures. Period, rotation, wear, dirt, the place and the pressure of the contact differ from",
        "episode to episode; the textures have the same heights and slopes, so that no statistic of single pixels",
        "separates them. A real gel has more that is not simulated.",
        "",
        f"![Accuracy over noise and pressure]({picture})",
        "",
        "The RAPID paper has 99.73 % for a ResNet-18 trained on ImageNet first, on pictures of a real gel (one split of the",
        "episodes in 80/10/10, precision 1.000 / 0.994, recall 0.995 / 1.000).",
        "",
        f"Made with `make texture{given}`, which runs",
        "",
        f"    python {report['command']}",
        "",
        f"on demonstrations with the arm; {report['minutes']} minutes on {report['hardware']}.",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
