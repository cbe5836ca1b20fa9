"""Trains a policy as an experiment describes it.

    python -m rapid_policy.train EXPERIMENT.toml [--data FOLDER...] --out RUN [--resume]
    python -m rapid_policy.train EXPERIMENT.toml --out RUN --rapid PROGRAM --evaluate-every 500 --evaluate-trials 20
    torchrun --nproc-per-node 2 -m rapid_policy.train EXPERIMENT.toml --out RUN

Writes RUN/checkpoint.pt (from which `rapid_policy.export` makes a bundle and `--resume` continues), RUN/best.pt (with the
lowest loss on held-out episodes, if there are any), RUN/best-success.pt (with the most trials that succeeded, with
--evaluate-every), curves for TensorBoard and RUN/loss.png. SIGTERM, SIGINT and SIGHUP end it after the current iteration,
with a checkpoint.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
import platform
import shutil
import signal
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from .checkpoint import BEST, BEST_SUCCESS, CHECKPOINT, Run, begin, read_checkpoint
from .corpus import Corpus, load
from .dataset import Batch, Dataset, inputs
from .diffusion import TRAIN_TIMESTEPS
from .episodes import Episode, EpisodeError
from .experiment import Experiment
from .experiment_file import ExperimentError, read_experiment
from .feed import Feed
from .judgement import JudgementError, program
from .losses import Losses, Replayed
from .model import parameters
from .progress import BOARD_EVERY, Board, Progress, plot, recent
from .ranks import Ranks, join
from .trials import CONDITION, FIRST_SEED, MOST, Trials, check_count, check_seeds
from .weights import First

# Most batches in a measurement on held-out episodes.
VALIDATION_BATCHES = 16
# The model card counts the values of a tag that has no more of them.
COUNTED = 8


class Stopped(Exception):
    """A signal ended the training; its checkpoint is written."""


class Trainer:
    """A run, what it learns from, and where it writes."""

    def __init__(self, run: Run, dataset: Dataset, out: Path, *, held_out: Dataset | None = None,
                 ranks: Ranks | None = None, workers: int = 0, minutes: float = math.inf,
                 trials: Trials | None = None) -> None:  # fmt: skip
        self.run, self.dataset, self.out, self.held_out, self.trials = run, dataset, out, held_out, trials
        self.ranks = ranks or Ranks(device=next(run.policy.parameters()).device)
        self.workers = workers
        self.minutes = min(minutes, run.schedule.minutes or math.inf)
        self.losses = self.ranks.together(Losses(run.policy, self.ranks.device))
        self.rows = self.ranks.rows(run.schedule.windows)
        self.stopping = False

    def train(self) -> float:
        """Trains to the end of the schedule. Returns the final loss: the mean of the last hundred iterations.

        Whatever ends it earlier, the checkpoint in `out` is the one to continue from.
        """
        run, first = self.run, self.ranks.first
        progress = Progress(run.spec.name, run.iterations, run.iteration, first)
        board = Board(self.out / "tensorboard", run.iteration) if first else None
        feed = Feed(self.dataset, run.random, run.schedule.windows, self.rows, self.workers)
        before = {number: signal.signal(number, self._stop) for number in _signals()}
        try:
            self._iterate(feed, progress, board)
            run.provenance["final_loss"] = recent(run.losses)
            if self.trials:
                self._evaluate_last(board)
        finally:
            if self.trials:
                self.trials.end()
            for number, handler in before.items():
                signal.signal(number, handler)
            feed.close()
            progress.close()
            if first:
                board.close()
                run.save(self.out / CHECKPOINT)
        if first:
            plot(run.losses, run.spec.name, self.out / "loss.png", run.validation)
        return run.provenance["final_loss"]

    def _evaluate_last(self, board: Board) -> None:
        # It takes a while, during which nothing of the training can be lost any more.
        self.run.save(self.out / CHECKPOINT)
        self.trials.finish(board, lambda: self.stopping)
        if self.stopping:
            raise Stopped

    def _stop(self, *_: Any) -> None:
        self.stopping = True

    def _iterate(self, feed: Feed, progress: Progress, board: Board | None) -> None:
        run, schedule = self.run, self.run.schedule
        started = saved = time.monotonic()
        before = run.seconds
        while run.iteration < run.iterations:
            run.seconds = before + time.monotonic() - started
            done = max(run.iteration / run.iterations, run.seconds / (60 * self.minutes))
            done, stopping = self.ranks.agree(done, self.stopping)
            if stopping:
                raise Stopped
            if done >= 1:
                break
            rate = _set_rate(run, done)
            batch, state = feed.next()
            loss = self._step(batch)
            run.random_state = state
            run.iteration += 1
            run.losses.append(loss)
            if not self.ranks.first:
                continue
            progress.step(run.losses, done, run.seconds)
            if run.iteration % BOARD_EVERY == 0:
                board.add(run.iteration, loss=loss, learning_rate=rate)
            if self.held_out and (run.iteration % schedule.validate_every == 0 or run.iteration == run.iterations):
                self._validate(board)
            if self.trials:
                self.trials.step(board)
            if time.monotonic() - saved >= 60 * schedule.checkpoint_minutes:
                run.save(self.out / CHECKPOINT)
                saved = time.monotonic()

    def _step(self, batch: Batch) -> float:
        run, device = self.run, self.ranks.device
        arguments = self._arguments(run.spec, batch, run.schedule.windows, self.rows, device)
        if device.type == "cuda" and self.ranks.world == 1 and not isinstance(self.losses, Replayed):
            self.losses = Replayed(self.losses, arguments)
        loss = self.losses(*arguments)
        mean = self.ranks.mean(loss)
        if not math.isfinite(mean):
            raise ValueError(f"the loss is not finite in iteration {run.iteration}")
        run.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(run.policy.parameters(), run.schedule.clip)
        run.optimizer.step()
        _follow(run)
        return mean

    @staticmethod
    def _arguments(spec: Experiment, batch: Batch, size: int, rows: slice, device: torch.device,
                   random: torch.Generator | None = None) -> tuple[Any, ...]:  # fmt: skip
        """The arguments of `Losses`. The noise is drawn for the whole batch of `size` windows, whatever part `rows` is of it."""
        draws = spec.training.draws
        shape = (draws * size, spec.policy.horizon, spec.action_length)
        timestep = torch.randint(0, TRAIN_TIMESTEPS, (draws * size,), generator=random)
        noise = torch.randn(shape, generator=random)
        timestep, noise = (x.unflatten(0, (draws, size))[:, rows].flatten(0, 1).to(device) for x in (timestep, noise))
        mask = batch.mask.to(device) if spec.policy.mask_aware else None
        clean = batch.actions.to(device).repeat(draws, 1, 1)
        return inputs(spec, batch, device), mask, clean, timestep, noise, batch.outcomes.to(device)

    def _validate(self, board: Board) -> None:
        """The loss of the averaged weights on held-out episodes: the same windows and noise each time, nothing varied.

        It is that of the noise alone: it chooses the best weights, and what predicts outcomes is in no bundle."""
        run, held_out = self.run, self.held_out
        measure = Losses(run.average, self.ranks.device, outcomes=False)
        random, noise = np.random.default_rng(0), torch.Generator().manual_seed(0)
        size, found = run.schedule.windows, []
        with torch.no_grad():
            for _ in range(min(VALIDATION_BATCHES, math.ceil(len(held_out.windows) / size))):
                batch = held_out.gather(held_out.plan(random, size, vary=False))
                found.append(
                    measure(*self._arguments(run.spec, batch, size, slice(None), self.ranks.device, noise)).item()
                )
        loss = float(np.mean(found))
        best = loss < run.best
        run.validation.append((run.iteration, loss))
        board.add(run.iteration, validation=loss)
        print(
            f"{run.spec.name}: {run.iteration}/{run.iterations} held out {loss:.4f}{', the best' if best else ''}",
            flush=True,
        )
        if best:
            run.save(self.out / BEST, final_loss=recent(run.losses), validation_loss=loss)


def _signals() -> list[signal.Signals]:
    import threading

    main = threading.current_thread() is threading.main_thread()
    return [signal.SIGTERM, signal.SIGINT, signal.SIGHUP] if main else []


def _set_rate(run: Run, done: float) -> float:
    """Sets the learning rate: a warm-up, then a fall as the schedule states. Returns it."""
    schedule = run.schedule
    fallen = {"cosine": 0.5 * (1 + math.cos(math.pi * done)), "linear": 1 - done, "constant": 1.0}[schedule.scheduler]
    share = fallen + (schedule.final_rate if schedule.scheduler != "constant" else 0.0)
    rate = schedule.learning_rate * min(1.0, run.iteration / max(1, schedule.warmup)) * share
    if not schedule.warmup:
        rate = schedule.learning_rate * share
    for group in run.optimizer.param_groups:
        group["lr"] = rate
    return rate


@torch.no_grad()
def _follow(run: Run) -> None:
    """Moves the average towards the weights; faster in the beginning, when the early weights are of no use."""
    decay = min(run.schedule.decay, (1 + run.iteration) / (10 + run.iteration))
    averages, weights = list(run.average.parameters()), list(run.policy.parameters())
    torch._foreach_lerp_(averages, weights, 1 - decay)


def provenance(episodes: Sequence[Episode], command: str) -> dict[str, Any]:
    """The origin of the weights: training data and software."""
    digest, frames, recorded_by = hashlib.sha256(), 0, set()
    seeds: list[int] = []
    tags: dict[str, Counter[str]] = defaultdict(Counter)
    for episode in episodes:
        digest.update(bytes.fromhex(episode.sha256))
        frames += len(episode)
        recorded_by.add(episode.facts.software)
        for key, value in episode.facts.tags.items():
            if key != "seed":
                tags[key][value] += 1
            elif value.isdigit():
                seeds = [min([*seeds, int(value)]), max([*seeds, int(value)])]
    return {
        "episodes": len(episodes),
        "frames": frames,
        "tags": {key: dict(sorted(of.items())) for key, of in sorted(tags.items()) if len(of) <= COUNTED},
        "episode_seeds": seeds or None,
        "episodes_sha256": digest.hexdigest(),
        "recorded_by": sorted(recorded_by),
        "command": command,
        "torch": str(torch.__version__),
        "python": platform.python_version(),
    }


def hardware(device: torch.device, world: int = 1) -> str:
    """The device of the training, in words."""
    if device.type == "cuda":
        name = torch.cuda.get_device_name(device)
    else:
        threads = torch.get_num_threads()
        name = f"{threads} CPU thread{'s' if threads > 1 else ''}"
    return name if world == 1 else f"{world} processes, each {name}"


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="rapid_policy.train", description="Trains a policy from recorded episodes.")
    add = parser.add_argument
    add("experiment", type=Path, help="the experiment (*.toml)")
    add("--data", type=Path, nargs="+", metavar="FOLDER", help="episodes, in place of the experiment's folders")
    add(
        "--out", type=Path, required=True, metavar="RUN", help="folder for checkpoints, curves and the plot of the loss"
    )
    add("--cache", type=Path, help="folder of decoded episodes (default: cache, beside RUN)")
    add("--iterations", type=int, help="in place of the experiment's")
    add("--minutes", type=float, default=math.inf, help="end after this long at the latest")
    add("--seed", type=int, help="in place of the experiment's")
    add("--threads", type=int, default=2, help="threads of the CPU (default: 2)")
    add("--workers", type=int, default=1, help="threads that read ahead, and processes that decode (default: 1)")
    add("--device", default="auto", help="auto, cpu, cuda")
    add("--resume", action="store_true", help="continue from the checkpoint in --out")
    add("--start-from", type=Path, metavar="BUNDLE", help="begin with the weights of an exported policy")
    add("--rapid", metavar="PROGRAM", help="gives the verdicts and evaluates (default: RAPID_BIN, or rapid in the PATH)")
    add(
        "--evaluate-every",
        type=whole(10**9),
        metavar="N",
        help="run the averaged weights in `rapid eval` every N iterations and at the end, beside the training; the best"
        f" are in RUN/{BEST_SUCCESS} (default: never)",
    )
    add(
        "--evaluate-trials",
        type=whole(MOST),
        default=20,
        metavar="N",
        help=f"trials of the simulated task: condition {CONDITION}, seeds from {FIRST_SEED} on, which no result uses (20)",
    )
    return parser.parse_args()


def whole(most: int) -> Callable[[str], int]:
    """Reads a number from 1 to `most`."""

    def read(text: str) -> int:
        if not (text.isascii() and text.isdigit() and 1 <= int(text) <= most):
            raise argparse.ArgumentTypeError(f"{text}: write a number from 1 to {most}")
        return int(text)

    return read


def with_options(spec: Experiment, args: argparse.Namespace) -> Experiment:
    """The experiment, with the command line's options in place of its own."""
    changes: dict[str, Any] = {} if args.iterations is None else {"iterations": args.iterations, "epochs": None}
    changes |= {} if args.seed is None else {"seed": args.seed}
    return spec.model_copy(update={"training": spec.training.model_copy(update=changes)})


def open_corpus(spec: Experiment, args: argparse.Namespace, ranks: Ranks) -> Corpus:
    """The episodes; the first process decodes, the others use what it made."""
    folders = args.data or [Path(folder) for folder in spec.data.folders]
    if not folders:
        raise ExperimentError(f"{args.experiment}: data.folders: missing: add it, or give --data FOLDER")
    cache = args.cache or args.out.parent / "cache"
    if not ranks.first:
        ranks.wait()
        return load(spec, folders, cache)
    try:
        corpus = load(spec, folders, cache, max(1, args.workers))
        print(corpus.report(), file=sys.stderr)
        return corpus
    finally:
        ranks.wait()


def prepare(args: argparse.Namespace, ranks: Ranks) -> Trainer:
    """All that a training needs, from the command line."""
    spec = with_options(read_experiment(args.experiment), args)
    if args.rapid:
        os.environ["RAPID_BIN"] = args.rapid
    rapid = program() if args.evaluate_every else None
    args.out.mkdir(parents=True, exist_ok=True)
    checkpoint = args.out / CHECKPOINT
    if args.resume and args.start_from:
        raise ValueError("--start-from: a training that is resumed has begun: leave it out, or leave --resume out")
    first = First.read(args.start_from) if args.start_from else None
    state = read_checkpoint(checkpoint) if args.resume else None
    if state and (changed := spec.learns_the_same(Experiment.from_text(state["experiment"]))):
        raise ValueError(
            f"{args.experiment}: {changed}: not as in {checkpoint}: use another --out, or leave it as it was"
        )
    corpus = open_corpus(spec, args, ranks)
    dataset, held_out = Dataset(spec, corpus.training, folder=corpus.folder), None
    if corpus.held_out and ranks.first:
        held_out = Dataset(spec, corpus.held_out, dataset.ranges, corpus.folder)
    facts = provenance(corpus.training, command(args, spec))
    facts |= {"hardware": hardware(ranks.device, ranks.world), "held_out": len(corpus.held_out)}
    facts |= _begun(first, state)
    if state and state["provenance"]["episodes_sha256"] != facts["episodes_sha256"]:
        raise ValueError(f"{checkpoint} was trained on other episodes than these")
    if rapid:
        check_seeds(facts["episode_seeds"], args.evaluate_trials)
    run = begin(spec, len(dataset.windows), dataset.ranges, facts, ranks.device, first)
    if state:
        run.load(state)
        if rapid:
            check_count(checkpoint, run.evaluations, args.evaluate_trials)
        if args.iterations is not None and args.iterations != run.iterations:
            raise ValueError(f"{checkpoint} is of a training of {run.iterations} iterations: leave --iterations out")
    if ranks.first:
        shutil.copyfile(args.experiment, args.out / "experiment.toml")
        counts = (
            f"{len(corpus.training)} episodes, {len(dataset.windows)} windows, {parameters([run.policy]):,} parameters"
        )
        print(f"{spec.name}: {counts}", flush=True)
    trials = Trials(run, args.out, rapid, args.evaluate_every, args.evaluate_trials) if rapid and ranks.first else None
    options = {"workers": args.workers, "minutes": args.minutes, "trials": trials}
    return Trainer(run, dataset, args.out, held_out=held_out, ranks=ranks, **options)


def _begun(first: First | None, state: dict[str, Any] | None) -> dict[str, Any]:
    """How the training began; if it is resumed, as its checkpoint has it."""
    if state:
        return {key: state["provenance"][key] for key in ("command", "started_from") if key in state["provenance"]}
    return {"started_from": first.origin()} if first else {}


def command(args: argparse.Namespace, spec: Experiment) -> str:
    """The command that repeats the training."""
    words = ["python -m rapid_policy.train", f"experiments/{args.experiment.name}", "--data EPISODES --out RUN"]
    words += [f"--iterations {args.iterations}"] if args.iterations is not None else []
    words += [f"--minutes {args.minutes:g}"] if math.isfinite(args.minutes) else []
    words += ["--start-from BUNDLE"] if args.start_from else []
    return " ".join([*words, f"--seed {spec.training.seed}"])


def main() -> None:
    args = parse()
    torch.set_num_threads(args.threads)
    ranks = join(args.device)
    try:
        trainer = prepare(args, ranks)
        run = trainer.run
        try:
            final = trainer.train()
        except Stopped:
            where = args.out / CHECKPOINT
            sys.exit(f"train: stopped after {run.iteration} iterations; --resume continues from {where}")
        if ranks.first:
            print(
                f"final loss {final:.4f} after {run.iteration} iterations, {run.seconds / 60:.1f} min: {args.out / CHECKPOINT}"
            )
    except (OSError, EpisodeError, ExperimentError, JudgementError, ValueError) as error:
        lines = str(error).splitlines()
        sys.exit("\n".join(f"train: {line}" for line in lines))
    finally:
        ranks.end()


if __name__ == "__main__":
    main()
