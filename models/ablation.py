#!/usr/bin/env python3
"""Measures the contribution of each input of the policy: trains five configurations and evaluates each.

    ablation.py EPISODES --rapid target/release/rapid [--only NAME]... [--trials 100] [--iterations 3900]

The configurations are those of the RAPID paper's appendix, each an experiment of `experiments/`. Each is trained,
exported and evaluated by `rapid eval`, the program that runs policies, with everything plugged in. Configurations already trained under --runs are not trained
again; the results are rewritten after every configuration, with all that are available.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from rapid_policy import results
from rapid_policy.checkpoint import CHECKPOINT, begin, read_checkpoint
from rapid_policy.corpus import load
from rapid_policy.dataset import Dataset
from rapid_policy.episodes import EpisodeError
from rapid_policy.experiment import Experiment
from rapid_policy.experiment_file import ExperimentError, read_experiment
from rapid_policy.export import export
from rapid_policy.ranks import join
from rapid_policy.train import Trainer, hardware, provenance, with_options

MODELS = Path(__file__).parent
FIRST_SEED = 50_000


@dataclass(frozen=True)
class Configuration:
    """One row of the table."""

    name: str
    """Of its experiment, its policy and its folder."""
    title: str
    """Its name in the paper."""
    paper: float
    """Its success rate in the paper."""

    def bundle(self, runs: Path) -> Path:
        """The folder of its bundle, existing or not."""
        return runs / self.name / "bundle"

    def experiment(self) -> Experiment:
        """What is trained."""
        return read_experiment(MODELS / "experiments" / f"{self.name}.toml")


CONFIGURATIONS = (
    Configuration("vision", "vision only", 0.5),
    # Without its single picture, only the arm's own state remains.
    Configuration("vision-mask", "vision + mask", 0.5),
    Configuration("tactile-id-arm", "vision + mask + diff", 1.0),
    Configuration("vision-diff-one", "vision + diff", 0.5),
    Configuration("vision-diff", "vision + diff", 1.0),
)


def main() -> None:
    names = [c.name for c in CONFIGURATIONS]
    parser = argparse.ArgumentParser(description="Trains five configurations of the policy and runs each.")
    parser.add_argument("episodes", type=Path)
    parser.add_argument("--rapid", type=Path, required=True, help="the program")
    parser.add_argument("--runs", type=Path, default=Path("runs/ablation"), help="checkpoints and bundles")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--only", action="append", choices=names, help="this configuration; may be repeated")
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--iterations", type=int, default=3900)
    parser.add_argument("--minutes", type=float, default=math.inf, help="end each training after so long at the latest")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    for configuration in CONFIGURATIONS:
        if not args.only or configuration.name in args.only:
            try:
                learn(configuration, args)
                judge(configuration, args)
            except (OSError, EpisodeError, ExperimentError, ValueError, subprocess.CalledProcessError) as error:
                sys.exit(f"ablation: {configuration.name}: {error}")
            summarize(args)


def learn(configuration: Configuration, args: argparse.Namespace) -> None:
    """Trains the configuration and exports its bundle."""
    run_folder, bundle = args.runs / configuration.name, configuration.bundle(args.runs)
    if (bundle / "policy.json").exists():
        return
    run_folder.mkdir(parents=True, exist_ok=True)
    spec, ranks = with_options(configuration.experiment(), args), join("auto")
    corpus = load(spec, [args.episodes], args.runs / "cache", args.threads)
    print(corpus.report(), file=sys.stderr)
    dataset = Dataset(spec, corpus.training)
    facts = provenance(corpus.training, f"ablation.py EPISODES --only {spec.name}")
    run = begin(spec, len(dataset.windows), dataset.ranges, {**facts, "hardware": hardware(ranks.device)}, ranks.device)
    final = Trainer(run, dataset, run_folder, minutes=args.minutes).train()
    print(f"{spec.name}: final loss {final:.4f}, {run.seconds / 60:.1f} min", flush=True)
    export(read_checkpoint(run_folder / CHECKPOINT), bundle)


def judge(configuration: Configuration, args: argparse.Namespace) -> None:
    """Runs the bundle in the program, with everything plugged in: RUNS/NAME/eval.json."""
    run_folder = args.runs / configuration.name
    command = [str(args.rapid), "eval", str(configuration.bundle(args.runs)), "--json", "--trials", str(args.trials)]
    command += ["--condition", "full", "--seed", str(FIRST_SEED)]
    run_folder.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    command_line = f"rapid eval BUNDLE --condition full --trials {args.trials} --seed {FIRST_SEED} --json"
    lines = [json.loads(line) for line in printed.splitlines()]
    record = {"command": command_line, "seconds": round(time.monotonic() - started, 1), "lines": lines}
    (run_folder / "eval.json").write_text(json.dumps(record, indent=2), encoding="utf-8")


def summarize(args: argparse.Namespace) -> None:
    """Writes the table of the configurations evaluated so far."""
    rows = [row for c in CONFIGURATIONS if (row := summary(c, args.runs)) is not None]
    if not rows:
        return
    command_line = f"ablation.py EPISODES --rapid RAPID --trials {args.trials} --iterations {args.iterations}"
    command_line += f" --seed {args.seed}"
    if math.isfinite(args.minutes):
        command_line += f" --minutes {args.minutes:g}"
    report = {"command": command_line, "trials": rows[0]["trials"], "first_seed": FIRST_SEED, "configurations": rows}
    results.write(args.out, "ablation", report, markdown(report))


def summary(configuration: Configuration, runs: Path) -> dict[str, Any] | None:
    """One row; none if the configuration has not been evaluated yet."""
    record = runs / configuration.name / "eval.json"
    if not record.exists():
        return None
    judged = json.loads(record.read_text(encoding="utf-8"))
    trained = json.loads((configuration.bundle(runs) / "policy.json").read_text(encoding="utf-8"))["training"]
    spec = configuration.experiment()
    trials = [line for line in judged["lines"] if line["event"] == "trial"]
    outcomes = Counter("crash" if t["status"] == "crash" else t["outcome"] for t in trials)
    # Left is the bin of a triangular block, and wrong for a hexagonal one.
    left = [t for t in trials if t["outcome"] == ("success" if t["triangular"] else "wrong_bin")]
    return {
        "name": configuration.name,
        "title": configuration.title,
        "data": ", ".join(str(value) for value in spec.data.tags.values()) or "both textures",
        "episodes": trained["episodes"],
        "dropout": {o.key: o.dropout.window for o in spec.images},
        "mask_aware": spec.policy.mask_aware,
        "iterations": trained["iterations"],
        "minutes": trained["minutes"],
        "final_loss": trained["final_loss"],
        "seed": trained["seed"],
        "command": judged["command"],
        "trials": len(trials),
        "triangular": sum(t["triangular"] for t in trials) / len(trials),
        "success": outcomes["success"] / len(trials),
        "crash": outcomes["crash"] / len(trials),
        "wrong_bin": outcomes["wrong_bin"] / len(trials),
        "incomplete": outcomes["incomplete"] / len(trials),
        "put_left": len(left) / len(trials),
        "interval": results.wilson(outcomes["success"], len(trials)),
        "paper": configuration.paper,
    }


def markdown(report: dict[str, Any]) -> str:
    """The table for people."""
    lines = [
        "# What each input is worth",
        "",
        "Five configurations of the policy, each trained on the demonstrations of `make train` and then run by the program",
        f"(`rapid eval`) for {report['trials']} trials with everything plugged in, with seeds that no demonstration has:",
        f"{report['first_seed']} and on, {report['configurations'][0]['triangular']:.0%} of the blocks triangular. Success:",
        "the block ends in the bin of its texture, with Wilson's interval; incomplete: it ends in no bin. Of those in a bin:",
        "the share in the right one, which is what the policy knows of the texture. Left: the block ends in the bin of the",
        "triangular ones, whichever it is.",
        "",
        "| configuration | episodes | dropout | iterations | success | 95 % | wrong bin | incomplete | of those in a bin | left"
        " | paper |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in report["configurations"]:
        dropout = max(row["dropout"].values()) or "-"
        low, high = row["interval"]
        binned = row["success"] + row["wrong_bin"]
        right = f"{row['success'] / binned:.2f}" if binned else "-"
        lines.append(
            f"| {row['title']} (`{row['name']}`) | {row['episodes']}, {row['data']} | {dropout} | {row['iterations']} |"
            f" {row['success']:.2f} | {low:.2f}-{high:.2f} | {row['wrong_bin']:.2f} | {row['incomplete']:.2f} | {right} |"
            f" {row['put_left']:.2f} | {row['paper']:.2f} |"
        )
    missing = [c.name for c in CONFIGURATIONS if c.name not in {row["name"] for row in report["configurations"]}]
    if missing:
        lines += ["", f"Not run: {', '.join(missing)}."]
    lines += ["", "Training of each:", ""]
    lines += [
        f"- {row['name']}: {row['iterations']} iterations, seed {row['seed']}, {row['minutes']} min, final loss"
        f" {row['final_loss']:.4f}"
        for row in report["configurations"]
    ]
    lines += [
        "",
        "`tactile-id` is the bundle of the repository. `vision-mask` has one picture to take away, and then only the arm's",
        "state is left. `vision-diff-one` is the paper's row on the data of a single configuration: there the blocks of one",
        "size, here the demonstrations of one texture. Diff: the tactile picture, as difference to the first one. The fewer",
        "the iterations, the more trials end incomplete, with the block missed or dropped on the way.",
        "",
        "Made with `make ablation`, which runs",
        "",
        f"    python {report['command']}",
        "",
        "where `--minutes` ends a training that has not come to its last iteration, with the learning rate fallen by then;",
        "and that, for the trials of each,",
        "",
        f"    {report['configurations'][0]['command']}",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
