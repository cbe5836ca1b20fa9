#!/usr/bin/env python3
"""Measures what each input of the policy is worth: trains five configurations, each with several seeds, and runs each.

    ablation.py EPISODES --rapid ../target/release/rapid [--only NAME]... [--seeds 0 1 2] [--iterations 3900] [--jobs 1]
        [--name ablation]

The configurations are those of the RAPID paper's appendix, each an experiment of `experiments/`, all trained for the same
number of iterations. Each is exported and evaluated by `rapid eval`, the program that runs policies, with everything plugged
in. What an earlier run has trained or evaluated in the same way is reused, and an interrupted training continues; what
was trained in another way is refused: --name gives such a table files and runs of its own. The results are rewritten after
every evaluation, with all those available.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import signal
import statistics
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
from rapid_policy import results
from rapid_policy.checkpoint import CHECKPOINT
from rapid_policy.experiment import Experiment
from rapid_policy.experiment_file import ExperimentError, read_experiment

matplotlib.use("Agg")
MODELS = Path(__file__).parent
FIRST_SEED = 50_000
# Seconds until a wait for a training notices a signal.
NOTICED = 0.5
# Of `make ablation`.
NAME, SEEDS, TRIALS, ITERATIONS = "ablation", [0, 1, 2], 100, 3900


@dataclass(frozen=True)
class Configuration:
    """One row of the table."""

    name: str
    """The name of its experiment, its policy and its folders."""
    title: str
    """Its name in the paper."""
    data: str
    """The demonstrations it is trained on, as the paper calls them."""
    paper: float
    """Its success rate in the paper."""

    @property
    def file(self) -> Path:
        """Its experiment."""
        return MODELS / "experiments" / f"{self.name}.toml"


CONFIGURATIONS = (
    Configuration("vision", "vision only", "mix", 0.5),
    # Dropout leaves one picture at least: its single one is never taken away.
    Configuration("vision-mask", "vision + mask", "mix", 0.5),
    Configuration("tactile-id-arm", "vision + mask + diff", "mix", 1.0),
    Configuration("vision-diff-big", "vision + diff", "big", 0.5),
    Configuration("vision-diff", "vision + diff", "mix", 1.0),
)


@dataclass(frozen=True)
class Training:
    """A configuration, trained with one seed, in a folder of its own."""

    configuration: Configuration
    seed: int
    folder: Path

    @property
    def bundle(self) -> Path:
        """Its policy; complete if it has a `policy.json`, which is written last."""
        return self.folder / "bundle"

    @property
    def trials(self) -> Path:
        """What `rapid eval` printed about it."""
        return self.folder / "eval.json"

    @property
    def policy(self) -> str:
        """SHA-256 of its policy."""
        return hashlib.sha256((self.bundle / "policy.json").read_bytes()).hexdigest()


def main() -> None:
    args = parse()
    args.runs = args.runs or Path("runs") / args.name
    chosen = [c for c in CONFIGURATIONS if not args.only or c.name in args.only]
    trainings = [Training(c, seed, args.runs / f"{c.name}-{seed}") for seed in args.seeds for c in chosen]
    failed = 0
    # Not the handler of SIGINT, which a shell has ignored by what it starts in the background.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    pool = ThreadPoolExecutor(args.jobs)
    try:
        submitted = {pool.submit(carry_out, training, args): training for training in trainings}
        for future in as_done(set(submitted)):
            training = submitted[future]
            try:
                future.result()
                summarize(args)
            except (OSError, ValueError, KeyError, ExperimentError, subprocess.CalledProcessError) as error:
                failed += 1
                name = f"{training.configuration.name}, seed {training.seed}"
                print(f"ablation: {name}: {error}; see {training.folder}/log.txt", file=sys.stderr, flush=True)
    except KeyboardInterrupt:
        sys.exit("ablation: interrupted; the same command continues")
    finally:
        CHILDREN.end()
        pool.shutdown(cancel_futures=True)
    if failed:
        sys.exit(f"ablation: {failed} of {len(trainings)} failed")


def as_done(pending: set[Future]) -> Iterator[Future]:
    """Each as it ends. A signal that arrives just before a wait is noticed only after it, so no wait is long."""
    while pending:
        done, pending = wait(pending, timeout=NOTICED, return_when=FIRST_COMPLETED)
        yield from done


class Children:
    """The running programs; none starts after `end`, which lets a training write its checkpoint."""

    def __init__(self) -> None:
        self._lock, self._running, self._ended = threading.Lock(), set(), False

    def run(self, command: list[str], **options: Any) -> str | None:
        """Runs a program to its end. Returns what it printed, if that is asked for.

        Raises `CalledProcessError` if it fails.
        """
        with self._lock:
            if self._ended:
                raise ValueError("interrupted")
            child = subprocess.Popen(command, text=True, **options)
            self._running.add(child)
        printed, _ = child.communicate()
        with self._lock:
            self._running.discard(child)
        if child.returncode:
            raise subprocess.CalledProcessError(child.returncode, command[:3])
        return printed

    def end(self) -> None:
        """Asks all of them to end."""
        with self._lock:
            self._ended = True
            for child in self._running:
                child.terminate()


CHILDREN = Children()


def parse() -> argparse.Namespace:
    """The command line."""
    names = [c.name for c in CONFIGURATIONS]
    parser = argparse.ArgumentParser(description="Trains five configurations of the policy and runs each.")
    add = parser.add_argument
    add("episodes", type=Path, help="`rapid --sim task --expert --record --episodes 480 --seed 1000`")
    add("--rapid", type=Path, required=True, help="the program")
    add("--name", default=NAME, help="of the results, and of the folder of checkpoints and bundles without --runs")
    add("--runs", type=Path, help="checkpoints and bundles (default: runs/NAME)")
    add("--cache", type=Path, default=Path("runs/cache"), help="decoded episodes")
    add("--out", type=Path, default=MODELS / "results")
    add("--only", action="append", choices=names, help="this configuration; may be repeated")
    add("--seeds", type=int, nargs="+", default=SEEDS, help="of the trainings")
    add("--trials", type=int, default=TRIALS)
    add("--iterations", type=int, default=ITERATIONS, help="of each training")
    add("--jobs", type=int, default=1, help="trainings at a time")
    add("--threads", type=int, default=2, help="of the CPU, for each")
    return parser.parse_args()


def carry_out(training: Training, args: argparse.Namespace) -> None:
    """Trains, exports and evaluates, as far as that has not been done yet."""
    training.folder.mkdir(parents=True, exist_ok=True)
    asked = {
        # Without its comments, which change nothing of what is learned.
        "experiment": json.loads(read_experiment(training.configuration.file).to_text()),
        "episodes": str(args.episodes.absolute()),
        "iterations": args.iterations,
    }
    note = training.folder / "asked.json"
    if not note.exists():
        note.write_text(json.dumps(asked, indent=2), encoding="utf-8")
    elif json.loads(note.read_text(encoding="utf-8")) != asked:
        raise ValueError(f"{training.folder}: of another experiment, other episodes or iterations: delete it")
    if not (training.bundle / "policy.json").exists():
        learn(training, args)
    if not is_judged(training, args):
        judge(training, args)


def learn(training: Training, args: argparse.Namespace) -> None:
    """Trains the configuration, or continues, and exports its bundle."""
    checkpoint = training.folder / CHECKPOINT
    command = ["-m", "rapid_policy.train", str(training.configuration.file), "--data", str(args.episodes.absolute())]
    command += ["--out", str(training.folder.absolute()), "--cache", str(args.cache.absolute())]
    command += ["--iterations", str(args.iterations), "--seed", str(training.seed), "--threads", str(args.threads)]
    command += ["--resume"] if checkpoint.exists() else []
    logged(training, command, args)
    export = ["-m", "rapid_policy.export", str(checkpoint.absolute()), "--out", str(training.bundle.absolute())]
    logged(training, export, args)


def logged(training: Training, command: list[str], args: argparse.Namespace) -> None:
    """Runs a module of this Python; its output is appended to the log of the training."""
    with (training.folder / "log.txt").open("a", encoding="utf-8") as log:
        environment = {**os.environ, "RAPID_BIN": str(args.rapid.absolute())}
        CHILDREN.run([sys.executable, *command], stdout=log, stderr=log, cwd=MODELS, env=environment)


def is_judged(training: Training, args: argparse.Namespace) -> bool:
    """Whether this very bundle has had that many trials."""
    if not training.trials.exists():
        return False
    record = json.loads(training.trials.read_text(encoding="utf-8"))
    return record["policy"] == training.policy and len(record["trials"]) == args.trials


def judge(training: Training, args: argparse.Namespace) -> None:
    """Runs the bundle in the program, with everything plugged in."""
    options = ["--condition", "full", "--trials", str(args.trials), "--seed", str(FIRST_SEED), "--json"]
    started = time.monotonic()
    command = [str(args.rapid), "eval", str(training.bundle), *options]
    printed = CHILDREN.run(command, stdout=subprocess.PIPE) or ""
    lines = [json.loads(line) for line in printed.splitlines()]
    record = {
        "command": " ".join(["rapid eval BUNDLE", *options]),
        "policy": training.policy,
        "seconds": round(time.monotonic() - started, 1),
        "trials": [line for line in lines if line["event"] == "trial"],
    }
    # An interrupted evaluation prints the trials that it had.
    if len(record["trials"]) != args.trials:
        raise ValueError(f"{training.bundle}: {len(record['trials'])} of {args.trials} trials")
    partial = training.trials.with_suffix(".partial")
    partial.write_text(json.dumps(record, indent=2), encoding="utf-8")
    partial.rename(training.trials)


def summarize(args: argparse.Namespace) -> None:
    """Writes the table of what is evaluated so far."""
    rows = [row for c in CONFIGURATIONS if (row := summary(c, args)) is not None]
    if not rows:
        return
    report = {
        "command": command(args.name, args.seeds, args.trials, args.iterations, [row["name"] for row in rows]),
        "first_seed": FIRST_SEED,
        "configurations": rows,
    }
    picture = f"{args.name}.png"
    results.write(args.out, args.name, report, markdown(report, picture))
    plot(report, args.out / picture)


def command(name: str, seeds: list[int], trials: int, iterations: int, chosen: list[str]) -> str:
    """The command that makes a table of the configurations `chosen`."""
    words = [f"ablation.py EPISODES --rapid RAPID --trials {trials} --iterations {iterations}"]
    words += [f"--seeds {' '.join(map(str, seeds))}"]
    words += [f"--only {one}" for one in chosen if len(chosen) < len(CONFIGURATIONS)]
    words += [f"--name {name}"] if name != NAME else []
    return " ".join(words)


def summary(configuration: Configuration, args: argparse.Namespace) -> dict[str, Any] | None:
    """One row, over all seeds of its training; none if nothing has been evaluated yet."""
    trainings = [Training(configuration, seed, args.runs / f"{configuration.name}-{seed}") for seed in args.seeds]
    parts = [part(training) for training in trainings if is_judged(training, args)]
    if not parts:
        return None
    spec: Experiment = read_experiment(configuration.file)
    trials = [trial for one in parts for trial in one["trials"]]
    shares = counted(trials)
    return {
        "name": configuration.name,
        "title": configuration.title,
        "data": configuration.data,
        "dropout": max(o.dropout.window for o in spec.images),
        "outcome": max(o.outcome for o in spec.images),
        "mask_aware": spec.policy.mask_aware,
        "trials": len(trials),
        **shares,
        "success_by_size": {size: of_size(trials, size) for size in ("big", "small")},
        "paper": configuration.paper,
        "command": parts[0]["command"],
        "trainings": [{key: value for key, value in one.items() if key not in ("trials", "command")} for one in parts],
    }


def of_size(trials: list[dict[str, Any]], size: str) -> float | None:
    """Share of the blocks of this size that are sorted, if there are any."""
    chosen = [trial for trial in trials if trial["size"] == size]
    return counted(chosen)["success"] if chosen else None


def part(training: Training) -> dict[str, Any]:
    """The facts of one training, with its trials."""
    record = json.loads(training.trials.read_text(encoding="utf-8"))
    facts = json.loads((training.bundle / "policy.json").read_text(encoding="utf-8"))["training"]
    kept = ("seed", "episodes", "frames", "batch_windows", "iterations", "minutes", "final_loss", "hardware", "torch")
    success = counted(record["trials"])["success"]
    return {**{key: facts[key] for key in kept}, "success": success, "trials": record["trials"], "command": record["command"]}


def counted(trials: list[dict[str, Any]]) -> dict[str, float]:
    """Shares of the trials by how they ended."""
    outcomes = Counter("crash" if t["status"] == "crash" else t["outcome"] for t in trials)
    # Left is the bin of a triangular block, and wrong for a hexagonal one.
    left = sum(t["outcome"] == ("success" if t["triangular"] else "wrong_bin") for t in trials)
    shares = {outcome: outcomes[outcome] for outcome in ("success", "wrong_bin", "incomplete", "crash")}
    shares |= {"put_left": left, "triangular": sum(t["triangular"] for t in trials)}
    return {name: count / len(trials) for name, count in shares.items()}


AIDED = (
    "In training the tactile picture, where there is one, also predicts the last action of the episode by itself"
    " ([outcome](../README.md#the-outcome-of-an-episode)); the wrist camera does not. What such a row gains, it gains by the"
    " input and this loss together. The paper has no such loss."
)
COLUMNS = ("configuration", "data", "dropout", "success", "95 %", "big", "small", "wrong bin", "incomplete", "of those in a bin",
           "left", "paper")  # fmt: skip


def markdown(report: dict[str, Any], picture: str) -> str:
    """The table for people, and a picture of it."""
    rows = report["configurations"]
    present = {row["name"] for row in rows}
    missing = [c.name for c in CONFIGURATIONS if c.name not in present]
    lines = [
        *introduction(report),
        *(f"| {' | '.join(words)} |" for words in (COLUMNS, ["---"] * len(COLUMNS), *map(cells, rows))),
        *(["", f"Not run: {', '.join(missing)}."] if missing else []),
        # What has to be known of figures that were made in another way than now; a new training has none.
        *(line for row in rows if "note" in row for line in ("", f"**`{row['name']}`**: {row['note']}")),
        "",
        f"![Success of each training]({picture})",
        *explanation(report),
    ]
    return "\n".join(lines) + "\n"


def plot(report: dict[str, Any], to: Path) -> None:
    """A point for each training, with its interval, beside the paper's."""
    rows = report["configurations"]
    figure, axes = plt.subplots(figsize=(8, 0.9 + 0.6 * len(rows)))
    for place, row in enumerate(rows):
        each = trials_of_each(row)
        for at, training in enumerate(row["trainings"]):
            share = training["success"]
            low, high = results.wilson(round(share * each), each)
            height = place - 0.2 * (at - (len(row["trainings"]) - 1) / 2)
            label = "one training, with its 95 % interval" if place == at == 0 else None
            axes.errorbar(share, height, xerr=[[share - low], [high - share]], fmt="o", color="C0", markersize=4, label=label)
        axes.plot(row["paper"], place, "D", color="C1", fillstyle="none", label="the paper" if place == 0 else None)
    axes.axvline(0.5, color="grey", linewidth=0.8, linestyle="--", label="a guess")
    names = [f"{row['title']}, {row['data']}" for row in rows]
    axes.set(yticks=range(len(rows)), yticklabels=names, ylim=(len(rows) - 0.5, -0.5), xlabel="blocks in the right bin")
    axes.grid(axis="x", alpha=0.3)
    axes.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1), ncols=3, frameon=False)
    figure.tight_layout()
    figure.savefig(to, dpi=110)
    plt.close(figure)


def introduction(report: dict[str, Any]) -> list[str]:
    """What was trained and how it was run, and what the columns mean."""
    rows, trainings = report["configurations"], all_trainings(report)
    seeds = sorted({t["seed"] for t in trainings})
    each = f"seed {seeds[0]}" if len(seeds) == 1 else f"each of the seeds {', '.join(map(str, seeds))}"
    partial = [row["name"] for row in rows if len(row["trainings"]) < len(seeds)]
    count = ("One configuration", *(f"{number} configurations" for number in ("Two", "Three", "Four", "Five")))[len(rows) - 1]
    return [
        "# What each input is worth",
        "",
        *results.paragraph(
            f"{count} of the policy, each trained for {lengths(trainings)} iterations with {each}, and run by the program"
            f" (`rapid eval`) with everything plugged in: {trials_of_each(rows[0])} trials per training, from seed"
            f" {report['first_seed']} on, which no demonstration has; {rows[0]['triangular']:.0%} of the blocks are triangular, and"
            " they are big or small."
        ),
        "",
        "- success: the block ends in the bin of its texture; share of all trials, and of those of each training in brackets",
        "- 95 %: the interval (Wilson) of the lowest and of the highest training",
        "- incomplete: the block ends in no bin",
        "- of those in a bin: the share in the right one, which is what the policy knows of the texture",
        "- left: the share in the bin of the triangular blocks, right or wrong",
        "",
        *([f"Some trainings are missing of: {', '.join(partial)}.", ""] if partial else []),
    ]


def cells(row: dict[str, Any]) -> list[str]:
    """One line of the table, in the order of `COLUMNS`."""
    shares = sorted(t["success"] for t in row["trainings"])
    each = trials_of_each(row)
    ends = [results.wilson(round(share * each), each) for share in (shares[0], shares[-1])]
    binned = row["success"] + row["wrong_bin"]
    of_each = ", ".join(f"{t['success']:.2f}" for t in row["trainings"])
    return [
        f"{row['title']} (`{row['name']}`)",
        f"{row['data']}, {row['trainings'][0]['episodes']}",
        str(row["dropout"] or "-"),
        f"{row['success']:.2f} ({of_each})",
        "; ".join(f"{low:.2f}-{high:.2f}" for low, high in ends),
        *("-" if share is None else f"{share:.2f}" for share in row["success_by_size"].values()),
        f"{row['wrong_bin']:.2f}",
        f"{row['incomplete']:.2f}",
        f"{row['success'] / binned:.2f}" if binned else "-",
        f"{row['put_left']:.2f}",
        f"{row['paper']:.2f}",
    ]


def explanation(report: dict[str, Any]) -> list[str]:
    """What the words of the table mean, and how it was made."""
    rows, trainings = report["configurations"], all_trainings(report)
    minutes = [t["minutes"] for t in trainings]
    made_by_default = command(NAME, SEEDS, TRIALS, ITERATIONS, [c.name for c in CONFIGURATIONS])
    return [
        "",
        *results.paragraph(
            "Data: the paper's mixture of sizes (`mix`), or big blocks alone (`big`), with the number of demonstrations. Dropout:"
            " how often a picture is taken away in training; one is always left, so that row 2, which has 0.3 in the paper, has"
            " none here. Diff: the tactile picture, as difference to the first one of the episode; the paper's is of its"
            " `hand_view`. The paper calls a policy *biased* that puts every block to the same side: *left* would be 0 or 1."
        ),
        "",
        *results.paragraph(
            "A training that has the tactile picture and is near 0.5 has not learned to use it: see [what its length"
            " changes](README.md#seeds-and-the-length-of-training).",
            AIDED if any(row.get("outcome") for row in rows) else "",
        ),
        "",
        *results.paragraph(
            "The paper trains for 200 epochs of 72 demonstrations of some 100 to 170 frames: 1.4 to 2.4 million windows. Here"
            f" {lengths(trainings)} iterations of {trainings[0]['batch_windows']} windows are {windows(report):.2f} million,"
            f" {epochs(report)} of these demonstrations. Trained on {', '.join(sorted({t['hardware'] for t in trainings}))},"
            f" {min(minutes):.0f} to {max(minutes):.0f} minutes each."
        ),
        "",
        "Made with `make ablation`, which runs" if report["command"] == made_by_default else "Made with",
        "",
        f"    python {report['command']}",
        "",
        "and that, for the trials of each, whose lines are not kept here,",
        "",
        f"    {rows[0]['command']}",
    ]


def all_trainings(report: dict[str, Any]) -> list[dict[str, Any]]:
    """Those of all configurations."""
    return [training for row in report["configurations"] for training in row["trainings"]]


def trials_of_each(row: dict[str, Any]) -> int:
    """Trials of one training."""
    return row["trials"] // len(row["trainings"])


def lengths(trainings: list[dict[str, Any]]) -> str:
    """Iterations of a training, in words."""
    return ", ".join(sorted({f"{t['iterations']:,}" for t in trainings}))


def windows(report: dict[str, Any]) -> float:
    """Millions of windows that a training learned from."""
    return statistics.mean(t["batch_windows"] * t["iterations"] for t in all_trainings(report)) / 1e6


def epochs(report: dict[str, Any]) -> str:
    """How often each tick is seen, in words."""
    seen = [t["batch_windows"] * t["iterations"] / t["frames"] for t in all_trainings(report)]
    return f"about {statistics.mean(seen):.0f} epochs"


if __name__ == "__main__":
    main()
