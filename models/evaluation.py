#!/usr/bin/env python3
"""Runs the policies with a sensor that is pulled out, and writes the results beside the paper's table.

    evaluation.py --rapid ../target/release/rapid [--runs runs/evaluation] [--trials 100] [--seeds-from 80000]

Each run is a `rapid eval`, whose output is kept in RUNS/NAME.jsonl, below its command line and the hash of the program: a run
whose output by the same program is there already is not repeated. The results, `results/eval.jsonl` and
`results/eval.md`, are those of the policies that are in the repository now: output of others is refused. With --seeds-from,
results have the seed of the first trial in their names: `eval-90000.md`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rapid_policy.results import paragraph, wilson

MODELS = Path(__file__).parent
# Versions before these ran on trials from 50000 and from 60000 on, and the training was changed after their results were seen.
FIRST_SEED = 80_000
PLAIN, MEMORY = "tactile-id", "tactile-id-memory"
TITLES = {
    "full": "full",
    "no-tactile": "no tactile sensor",
    "hot-unplug": "hot-unplug, 3 to 14 steps after the touch",
    "hot-replug": "hot-replug, out at step 10 to 24, back 2 to 9 steps after the touch",
    "early-unplug": "unplugged at step 10 to 24, before the touch",
    "no-wrist": "no wrist camera",
}


@dataclass(frozen=True)
class Run:
    """A policy, run in one way."""

    name: str
    bundle: str
    title: str
    options: tuple[str, ...] = ()
    conditions: tuple[str, ...] = ()

    def command(self, trials: int, first: int) -> list[str]:
        """The command that prints its results, in the folder `models`; `first`: the seed of the first trial."""
        chosen = [word for condition in self.conditions for word in ("--condition", condition)]
        return ["eval", self.bundle, "--trials", str(trials), "--seed", str(first), "--json", *self.options, *chosen]


RUNS = (
    Run("plain", PLAIN, "absent pictures are zeros, the paper's rule"),
    Run("held", PLAIN, "the last sample stands in for the sensor", ("--hold-last", "20s"), ("hot-unplug", "hot-replug", "early-unplug")),
    Run("memory", MEMORY, "trained to remember"),
    Run("static", PLAIN, "a loop with a fixed list", ("--static-config",), ("full", "no-tactile", "hot-unplug", "hot-replug")),
)  # fmt: skip


class EvaluationError(Exception):
    """What was printed is not of these policies."""


def main() -> None:
    parser = argparse.ArgumentParser(description="Runs the policies with a sensor that is pulled out.")
    parser.add_argument("--rapid", type=Path, required=True, help="the program")
    parser.add_argument("--runs", type=Path, default=Path("runs/evaluation"), help="folder of what is printed")
    parser.add_argument("--out", type=Path, default=MODELS / "results")
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--seeds-from", type=seed, default=FIRST_SEED, metavar="N", help="seed of the first trial")
    args = parser.parse_args()
    args.runs.mkdir(parents=True, exist_ok=True)
    try:
        printed = {run.name: evaluate(run, args) for run in RUNS}
    except (OSError, ValueError, KeyError, EvaluationError, subprocess.CalledProcessError) as error:
        sys.exit(f"evaluation: {error}")
    lines = [{"run": name, **kept(line)} for name, part in printed.items() for line in part if line["event"] in KEPT]
    text = "".join(json.dumps(line, sort_keys=True) + "\n" for line in lines)
    name = named("eval", args.seeds_from)
    (args.out / f"{name}.jsonl").write_text(text, encoding="utf-8")
    (args.out / f"{name}.md").write_text(markdown(printed, args.trials, args.seeds_from), encoding="utf-8")
    print(f"{args.out / name}.jsonl and .md")


KEPT = ("condition", "trial")


def kept(line: dict[str, Any]) -> dict[str, Any]:
    """A line of the results: that of a trial without what its run counted."""
    return line if line["event"] == "condition" else {key: value for key, value in line.items() if key != "counts"}


def seed(text: str) -> int:
    """Reads the seed of a first trial. No demonstration and no evaluation of an earlier policy has a seed that is allowed here."""
    number = int(text)
    if number < FIRST_SEED:
        raise argparse.ArgumentTypeError(f"{number} is below {FIRST_SEED}: of demonstrations, or of evaluations of earlier policies")
    return number


def named(name: str, first: int) -> str:
    """The name of what was made with the trials from `first` on."""
    return name if first == FIRST_SEED else f"{name}-{first}"


def evaluate(run: Run, args: argparse.Namespace) -> list[dict[str, Any]]:
    """The lines of a run, or of the same one made earlier."""
    file, command = args.runs / f"{named(run.name, args.seeds_from)}.jsonl", run.command(args.trials, args.seeds_from)
    head = {"event": "run", "command": command, "program": hashlib.sha256(args.rapid.read_bytes()).hexdigest()}
    known = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    if not known or json.loads(known[0]) != head:
        words = [str(args.rapid.absolute()), *command]
        printed = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True, cwd=MODELS).stdout
        known = [json.dumps(head), *printed.splitlines()]
    lines = [json.loads(line) for line in known[1:]]
    conditions = [line["condition"] for line in lines if line["event"] == "condition"]
    trials = [line for line in lines if line["event"] == "trial"]
    # An interrupted one prints what it had.
    if conditions != list(run.conditions or TITLES) or len(trials) != args.trials * len(conditions):
        raise EvaluationError(f"{run.name}: {len(trials)} trials of {len(conditions)} conditions are not all of them")
    hashes = {line["policy_hash"] for line in lines if line["event"] == "condition"}
    if hashes != {bundle_hash(args.rapid, run.bundle)}:
        raise EvaluationError(f"{file}: of another policy than {run.bundle}: delete it")
    partial = file.with_suffix(".partial")
    partial.write_text("".join(line + "\n" for line in known), encoding="utf-8")
    partial.rename(file)
    return lines


def bundle_hash(rapid: Path, bundle: str) -> str:
    """The hash that `rapid` has for the bundle."""
    command = [str(rapid.absolute()), "policy", "show", bundle, "--sim", "task", "--json"]
    printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, cwd=MODELS).stdout
    return json.loads(printed.splitlines()[0])["hash"]


def row(title: str, line: dict[str, Any], compares: bool = True) -> str:
    """A row of a table, from what `rapid eval` printed about a condition; `compares`: beside the paper's."""
    low, high = line["interval"]
    known = [line["paper_score"], line["paper_status"]]
    paper = " ".join(str(part) for part in known if part not in (None, "-")) or "-"
    paper = paper if compares else "-"
    cells = [title, f"{line['score']:.2f}", f"{low:.2f} to {high:.2f}", line["wrong_bin"], line["incomplete"]]
    cells += [line["crash"], line["status"].capitalize(), paper]
    return f"| {' | '.join(map(str, cells))} |"


HEAD = [
    "| condition | success | 95 % | wrong bin | incomplete | crash | status | paper |",
    "|---|---|---|---|---|---|---|---|",
]


def between(values: list[int]) -> str:
    """The range of some steps, with their median."""
    ordered = sorted(values)
    return f"step {ordered[0]} to {ordered[-1]}, median {ordered[len(ordered) // 2]}"


ORIGIN = (
    f"`{PLAIN}` continues the best of three seeds (trials from 40000 on), trained further with an outcome"
    " ([figures](README.md#seeds-and-the-length-of-training)). Earlier versions, and these ones too, ran on trials from 50000 on and"
    " from 60000 on, and the training was changed after their results were seen. No policy ran on the trials below before the"
    f" weights were final. `{MEMORY}` is one training, which began with the weights of `{PLAIN}`. The tables are of these trainings,"
    " and not of what another one gives."
)


def markdown(printed: dict[str, list[dict[str, Any]]], trials: int, first: int = FIRST_SEED) -> str:
    """The tables for people."""
    conditions = {run.name: {c["condition"]: c for c in printed[run.name] if c["event"] == "condition"} for run in RUNS}
    of = {
        name: [t for t in printed["plain"] if t["event"] == "trial" and t["condition"] == name] for name in TITLES
    }

    def score(run: str) -> str:
        return f"{conditions[run]['hot-unplug']['score']:.2f}"

    full, unplugged, early = of["full"], of["hot-unplug"], of["early-unplug"]
    triangular = sum(t["triangular"] for t in full)
    small = sum(t["size"] == "small" for t in full)
    unseen = [t for t in full if t["unseen_period"]]
    sorted_unseen = sum(t["outcome"] == "success" for t in unseen)
    late = sum(t["parted_at"] is not None and t["unplugged_at"] >= t["parted_at"] for t in unplugged)
    felt = sum(t["touched_at"] is not None and t["touched_at"] < t["unplugged_at"] for t in early)
    bundles = " and ".join(
        f"`models/{b}` (bundle `{next(iter(conditions[n].values()))['policy_hash'][:12]}`)"
        for b, n in ((PLAIN, "plain"), (MEMORY, "memory"))
    )
    program = "scripts/train.sh python evaluation.py --rapid PROGRAM"
    made = "`make evaluation`" if first == FIRST_SEED else f"`{program} --seeds-from {first}`"
    lines = [
        "# The policies with a sensor that is pulled out",
        "",
        *paragraph(
            f"{bundles}, {trials} trials per condition, seeds {first} to {first + trials - 1}, which no demonstration has;"
            f" {triangular} of the blocks are triangular, {small} small. A trial counts when the block ends in the bin of its texture;"
            " the interval is Wilson's.",
        ),
        "",
        *paragraph(ORIGIN),
        "",
    ]
    for run in RUNS[:3]:
        lines += [f"## `{run.bundle}`: {run.title}", "", *HEAD]
        lines += [row(TITLES[name], line, run.name == "plain") for name, line in conditions[run.name].items()]
        lines.append("")
    low, high = wilson(sorted_unseen, max(1, len(unseen)))
    lines += [
        "The policies have seen no robot: they are trained on handheld demonstrations. Of the blocks whose lattice has the period",
        f"that no demonstration has, {PLAIN} sorts {sorted_unseen} of {len(unseen)} with everything plugged in ({low:.2f} to {high:.2f}).",
        "",
        "Where absent pictures are zeros (the paper's rule), a policy whose tactile sensor is pulled out after the touch guesses, as",
        f"one that never had it. With `--hold-last 20s` the last sample stands in for the sensor: what was felt is kept. `{MEMORY}`",
        "does without that rule: it is given the tactile pictures of the last 5.7 s too, each with whether there was one, and in its",
        "training the sensor was pulled out at some moment of them ([experiment](../experiments/tactile-id-memory.toml)). It has no",
        f"recurrent state: what is kept are samples. The rule alone, with the weights of `{PLAIN}`, which were not trained for it, gives",
        f"{score('held')} after the touch, beside {score('memory')}. From before the touch there is nothing to keep, and each of them guesses.",
        "",
        f"Each trial prints when the texture was first felt ({between([t['touched_at'] for t in full if t['touched_at'] is not None])}) and"
        " when the ways to the bins had",
        f"parted ({between([t['parted_at'] for t in full if t['parted_at'] is not None])}); unplugs are relative to the touch. In"
        f" {late} of the {len(unplugged)} trials of",
        f"hot-unplug the ways had parted by then, and in {felt} of those before the touch it had come. Each sensor captures at a moment",
        "of the period of 100 ms of its own and is seen 5 to 50 ms later, both drawn from the trial's seed.",
        "",
        "## A loop with a fixed list of sensors",
        "",
        f"The weights of `{PLAIN}`, whose mask stays that of the start, in a loop that reads every sensor that was there then and fails",
        "when a read has no sample within 200 ms, as LeRobot's cameras do (`async_read`; [its own loop](lerobot-loop.md) beside it):",
        "",
        *HEAD,
        *(row(TITLES[name], line) for name, line in conditions["static"].items()),
        "",
        f"Its error: `{next((t['failure'] for t in printed['static'] if t.get('failure')), 'none')}`. The paper's static software"
        " crashed in both as well. Status is read from the run:",
        "crash if its loop failed, degraded if a sensor was absent at the end, whatever the success. The paper's *Degraded* is a trial",
        "that ended with reduced performance.",
        "",
        f"Made with {made}, which runs, and keeps in `{named('eval', first)}.jsonl`, of the trials without their counters:",
        "",
        *(f"    rapid {' '.join(run.command(trials, first))}" for run in RUNS),
        "",
        "The same seed gives the same trial on the same machine; another processor rounds differently, and of a hundred trials a",
        "few may end otherwise.",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
