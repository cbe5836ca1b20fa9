#!/usr/bin/env python3
"""Classifies the texture of a block from single pictures: how well the tactile camera shows it, raw and as the difference
from the untouched gel, and whether the wrist camera shows it too; and how that depends on noise and pressure.

    texture.py EPISODES [--encoder resnet18] [--input KEY]... [--cache runs/cache] [--out results]
               [--folds N] [--iterations N] [--seed N] [--threads N]

An experiment, `experiments/texture.toml`, states what is classified, by which pictures, and how it is trained and tested; the
options replace parts of it. The classifier is an image encoder of the policy with one additional layer: the small
one, or ResNet-18 from scratch (the paper's was pretrained on other pictures). Every episode with pictures of a touch is
tested by a classifier that was not trained on it: the episodes are divided into folds, and each fold is tested by one trained
on the others.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from rapid_policy.classification import Classification, Input
from rapid_policy.corpus import load
from rapid_policy.episodes import Episode, EpisodeError, picture_source
from rapid_policy.experiment import SMALL_POOL, Encoder
from rapid_policy.experiment_file import ExperimentError, read_classification
from rapid_policy.model import ENCODERS, parameters
from rapid_policy.ranks import join
from rapid_policy.results import wilson, write
from rapid_policy.train import hardware
from torch import nn

matplotlib.use("Agg")
EXPERIMENT = Path(__file__).parent / "experiments" / "texture.toml"


@dataclass
class Pictures:
    """N pictures of one input."""

    pixels: NDArray[np.float32]
    """[N, 3, h, w] averaged as the encoder does, in -1..1, with a margin for shifts"""
    labels: NDArray[np.int64]
    """[N] index of the value of the label"""
    episodes: NDArray[np.int64]
    """[N] index of the episode"""
    change: NDArray[np.float32]
    """[N] mean change of the gel, of a full scale of 2: it grows with the pressure"""


def main() -> None:
    parser = argparse.ArgumentParser(description="Classifies the texture of a block from single pictures.")
    parser.add_argument("episodes", type=Path)
    parser.add_argument("--cache", type=Path, default=Path(__file__).parent / "runs" / "cache", help="decoded episodes")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--experiment", type=Path, default=EXPERIMENT, help="what is classified and how (*.toml)")
    parser.add_argument("--encoder", choices=sorted(ENCODERS), help="in place of the experiment's")
    parser.add_argument("--input", action="append", metavar="KEY", help="of the experiment; repeat for several (all)")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda")
    parser.add_argument("--folds", type=int, help="in place of the experiment's")
    parser.add_argument("--iterations", type=int, help="of each training, in place of the experiment's")
    parser.add_argument("--seed", type=int, help="in place of the experiment's")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    device = join(args.device).device
    try:
        written = read_classification(args.experiment)
        spec, classified = asked(written, args), inputs(written, args.input)
        corpus = load(spec, [args.episodes], args.cache, args.threads)
        print(corpus.report(), file=sys.stderr)
        episodes = corpus.training
    except (EpisodeError, ExperimentError) as error:
        sys.exit(f"texture: {error}")
    labels = [spec.label_of(e.facts.tags) for e in episodes]
    contact = [in_contact(spec, e) for e in episodes]
    begin, rows = time.monotonic(), {}
    for o in classified:
        row = cross_validate(gather(spec, o, episodes, labels, contact), Training(spec, o, device))
        rows[o.title] = row
        print(f"{o.title}: accuracy {row['accuracy']:.4f} of {row['pictures']} pictures", flush=True)
    encoder, fitting, folds = spec.encoder, spec.training, spec.test.folds
    given = "" if encoder.type == "small" else f" --encoder {encoder.type}"
    given += "".join(f" --input {key}" for key in args.input or ())
    report = {
        "command": f"texture.py EPISODES{given} --folds {folds} --iterations {fitting.iterations} --seed {fitting.seed}",
        "as_written": not args.input and (spec.test, fitting) == (written.test, written.training),
        "encoder": encoder.type,
        "parameters": parameters([Classifier(spec, spec.touched)]),
        "hardware": hardware(device),
        "episodes": len(episodes),
        "textures": {name: labels.count(i) for i, name in enumerate(spec.label.values)},
        "contact": spec.contact.noises,
        "folds": folds,
        "iterations": fitting.iterations,
        "seed": fitting.seed,
        "minutes": round((time.monotonic() - begin) / 60, 1),
        "inputs": rows,
    }
    name = spec.name if encoder.type == "small" else f"{spec.name}-{encoder.type}"
    write(args.out, name, report, markdown(report, f"{name}.png"))
    plot(rows, args.out / f"{name}.png")


def asked(spec: Classification, args: argparse.Namespace) -> Classification:
    """The experiment, with the command line's options in place of its own."""
    training = {name: getattr(args, name) for name in ("iterations", "seed") if getattr(args, name) is not None}
    changed: dict[str, Any] = {"training": spec.training.model_copy(update=training)}
    if args.folds is not None:
        changed["test"] = spec.test.model_copy(update={"folds": args.folds})
    if args.encoder is not None and args.encoder != spec.encoder.type:
        changed["encoder"] = Encoder(type=args.encoder)
    return spec.model_copy(update=changed)


def inputs(spec: Classification, keys: list[str] | None) -> list[Input]:
    """Those of the experiment with these keys, or all if there are none. The one that shows the touch may be left out: it is
    still read."""
    known = [o.key for o in spec.input]
    for key in keys or ():
        if key not in known:
            raise ExperimentError(f"--input {key}: the experiment has no such input: write one of them: {', '.join(known)}")
    return [o for o in spec.input if not keys or o.key in keys]


def in_contact(spec: Classification, episode: Episode) -> NDArray[np.bool_]:
    """[T] whether the fingertip is pressed on the block."""
    changed, before = change(spec, episode), slice(1, spec.contact.untouched)
    touches = changed > spec.contact.noises * np.median(changed[before])
    return episode.present(picture_source(spec.touched).name) & touches


def change(spec: Classification, episode: Episode) -> NDArray[np.float32]:
    """[T] mean change of the gel since the first picture."""
    return np.abs(pool(episode, spec.touched, SMALL_POOL)).mean((1, 2, 3))


def pool(episode: Episode, o: Input, size: int) -> NDArray[np.float32]:
    """[T, 3, h, w]: pictures in -1..1, averaged over `size` pixels each way, with their edges repeated outwards."""
    name = picture_source(o).name
    pictures = _unit(episode.value(name))
    if o.operation == "diff_to_reference":
        pictures = pictures - _unit(episode.value(name)[episode.first(name)][None])
    else:
        pictures = pictures * 2 - 1
    padded = F.pad(F.avg_pool2d(pictures, size), (o.augmentation.shift // size,) * 4, mode="replicate")
    return padded.numpy() * episode.present(name)[:, None, None, None]


def _unit(pictures: NDArray[np.uint8]) -> torch.Tensor:
    """u8 [T, H, W, 3] -> f32 [T, 3, H, W] in 0..1"""
    return torch.from_numpy(np.array(pictures)).permute(0, 3, 1, 2).float() / 255


def gather(
    spec: Classification, o: Input, episodes: Sequence[Episode], labels: list[int], contact: list[NDArray[np.bool_]]
) -> Pictures:
    """The pictures of one input at all ticks in contact."""
    name, size = picture_source(o).name, spec.encoder.pool
    chosen = [c & e.present(name) for c, e in zip(contact, episodes, strict=True)]
    return Pictures(
        pixels=np.concatenate([pool(e, o, size)[c] for e, c in zip(episodes, chosen, strict=True)]),
        labels=np.concatenate([np.full(c.sum(), k) for c, k in zip(chosen, labels, strict=True)]),
        episodes=np.concatenate([np.full(c.sum(), i) for i, c in enumerate(chosen)]),
        change=np.concatenate([change(spec, e)[c] for e, c in zip(episodes, chosen, strict=True)]),
    )


@dataclass(frozen=True)
class Training:
    """How a classifier is trained."""

    spec: Classification
    input: Input
    device: torch.device

    @property
    def margin(self) -> int:
        """The margin of the pictures as the encoder gets them."""
        return self.input.augmentation.shift // self.spec.encoder.pool


def cross_validate(pictures: Pictures, training: Training) -> dict[str, Any]:
    """Counts the results of classifiers on pictures of episodes that they were not trained on."""
    spec, seed = training.spec, training.spec.training.seed
    random, noises, pressures = np.random.default_rng(seed), spec.test.noises, spec.test.pressures
    answers = np.full((len(noises), len(pictures.labels)), -1)
    for number, fold in enumerate(deal(pictures, spec.test.folds, random), 1):
        begin = time.monotonic()
        tested = np.isin(pictures.episodes, fold)
        torch.manual_seed(seed)
        classifier = fit(pictures, np.flatnonzero(~tested), training, random)
        for level, deviation in enumerate(noises):
            # A picture is in -1..1 here, so that a full scale is 2; averaged pixels have less noise.
            noise = 2 * deviation / spec.encoder.pool
            answers[level, tested] = classify(classifier, pictures.pixels[tested], noise, training, random)
        accuracy = (answers[0] == pictures.labels)[tested].mean()
        done = f"fold {number} of {spec.test.folds} in {(time.monotonic() - begin) / 60:.1f} min"
        print(f"{training.input.title}: {done}: {accuracy:.4f}", file=sys.stderr, flush=True)
    right = answers == pictures.labels
    edges = np.quantile(pictures.change, np.linspace(0, 1, pressures + 1)[1:-1])
    parts = np.digitize(pictures.change, edges)
    return {
        **score(pictures, answers[0], spec.label.values),
        "accuracy_by_noise": dict(zip(map(str, noises), right.mean(1).tolist(), strict=True)),
        "accuracy_by_pressure": [
            {"change": float(pictures.change[parts == part].mean()), "accuracy": float(right[0, parts == part].mean())}
            for part in range(pressures)
        ],
    }


def deal(pictures: Pictures, folds: int, random: np.random.Generator) -> list[NDArray[np.int64]]:
    """Divides the episodes into `folds` folds, with both textures spread evenly."""
    shuffled = []
    for texture in np.unique(pictures.labels):
        shuffled.extend(random.permutation(np.unique(pictures.episodes[pictures.labels == texture])))
    return [np.array(shuffled[i::folds]) for i in range(folds)]


class Classifier(nn.Module):
    """Pictures [B, 3, h, w], averaged as the encoder does -> [B, 2]"""

    def __init__(self, spec: Classification, o: Input) -> None:
        super().__init__()
        _, height, width = o.shape
        self.encoder = ENCODERS[spec.encoder.type](height, width, spec.encoder)
        self.head = nn.Linear(spec.encoder.features, len(spec.label.values))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.head(self.encoder.pooled(x))


def fit(pictures: Pictures, chosen: NDArray[np.int64], training: Training, random: np.random.Generator) -> Classifier:
    """Trains on randomly shifted pictures. They are not rotated: under fixed lights, half a turn would make bumps look like
    holes."""
    fitting = training.spec.training
    classifier = Classifier(training.spec, training.input).to(training.device)
    optimizer = torch.optim.AdamW(classifier.parameters(), fitting.learning_rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, fitting.learning_rate, total_steps=fitting.iterations
    )
    height, width = (side - 2 * training.margin for side in pictures.pixels.shape[2:])
    for _ in range(fitting.iterations):
        rows = chosen[random.integers(len(chosen), size=fitting.pictures)]
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
    found = []
    rows, columns = (slice(training.margin, side - training.margin) for side in pixels.shape[2:])
    for first in range(0, len(pixels), 256):
        part = pixels[first : first + 256, :, rows, columns]
        noisy = torch.from_numpy(part + noise * random.standard_normal(part.shape, np.float32))
        found.append(classifier(noisy.to(training.device)).argmax(1).cpu())
    return torch.cat(found).numpy()


def score(pictures: Pictures, answers: NDArray[np.int64], values: tuple[str, ...]) -> dict[str, Any]:
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
        "precision": dict(zip(values, (diagonal / np.maximum(confusion.sum(0), 1)).tolist(), strict=True)),
        "recall": dict(zip(values, (diagonal / np.maximum(confusion.sum(1), 1)).tolist(), strict=True)),
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
        axes.locator_params(axis="x", nbins=5)
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
        f"than {report['contact']} times its noise; {touched} of the episodes have such pictures, and the others, whose touch is the weakest, are",
        f"not part of it. Every episode is tested by a classifier that saw no picture of it: {report['folds']} folds, each classifier",
        f"trained for {report['iterations']} iterations, seed {report['seed']}.",
        "",
        "| input | pictures | accuracy | precision tri / hex | recall tri / hex | episodes by majority | 95 % |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, row in report["inputs"].items():
        precision, recall = (" / ".join(f"{row[k][t]:.3f}" for t in report["textures"]) for k in ("precision", "recall"))
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
        f"Made with `make texture{given}`, which runs" if report["as_written"] else "Made with",
        "",
        f"    {'python' if report['as_written'] else 'scripts/train.sh python'} {report['command']}",
        "",
        f"on demonstrations with the arm; {report['minutes']} minutes on {report['hardware']}.",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
