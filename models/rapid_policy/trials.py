"""Trials of a training's weights in the program while it continues: `rapid eval` on the simulated task.

Owns RUN/evaluation and the child process that works there, of which there is one at most: it exports a copy of the
checkpoint and then becomes the program. The training does not wait for it and draws no random number for it. It survives
the child's failure. It ends the child when it ends, after SIGHUP, SIGINT and SIGTERM too; when it is killed, the kernel
kills the child, which asks for that. Weights are chosen by these trials, so their seeds are none of those of reported
results, and only scores of equally many trials are compared.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .checkpoint import BEST_SUCCESS, CHECKPOINT, Run, read_checkpoint
from .progress import Board, recent

# Demonstrations are recorded with seeds from 1,000 on; reported results use those from 50,000 on (evaluation.py,
# ablation.py, the default of `rapid eval`).
FIRST_SEED = 40_000
MOST = 10_000
CONDITION = "full"
# Seconds that the child has to end itself.
PATIENCE = 10.0
# Seconds until a wait for the child notices a signal to the training.
NOTICE = 0.2
# Of prctl(2): the signal that a process gets when its parent ends; it survives execve.
PR_SET_PDEATHSIG = 1
MODELS = Path(__file__).parents[1]


class Trials:
    """Evaluations of the averaged weights of `run`, one every `every` iterations, of `count` trials each."""

    def __init__(self, run: Run, out: Path, rapid: str, every: int, count: int) -> None:
        self._run, self._out, self._folder = run, out.absolute(), out.absolute() / "evaluation"
        self._rapid, self._every, self._count = Path(rapid).absolute(), every, count
        self._child: subprocess.Popen[bytes] | None = None
        self._started = run.evaluations[-1]["iteration"] if run.evaluations else 0

    def step(self, board: Board) -> None:
        """After an iteration: takes the result of an evaluation that has ended, and starts the next if it is due.

        One that falls due while another runs starts when that ends, with the weights of that time.
        """
        self._take(board)
        if self._child is None and self._run.iteration // self._every > self._started // self._every:
            self._start()

    def finish(self, board: Board, stopping: Callable[[], bool]) -> None:
        """After the last iteration: waits for the running evaluation, and for one of the final weights."""
        self._wait(board, stopping)
        if self._started < self._run.iteration and not stopping():
            self._start()
            self._wait(board, stopping)

    def end(self) -> None:
        """Ends the running evaluation; its result is lost."""
        if self._child is None:
            return
        self._child.terminate()
        try:
            self._child.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        self._child = None
        shutil.rmtree(self._folder, ignore_errors=True)

    def _wait(self, board: Board, stopping: Callable[[], bool]) -> None:
        while self._child is not None and not stopping():
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._child.wait(NOTICE)
            self._take(board)

    def _start(self) -> None:
        run, self._started = self._run, self._run.iteration
        try:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder.mkdir()
            chosen = {"condition": CONDITION, "trials": self._count, "first_seed": FIRST_SEED}
            run.save(self._folder / CHECKPOINT, final_loss=recent(run.losses), evaluated=chosen)
            with (self._folder / "printed.jsonl").open("wb") as printed, (self._folder / "log.txt").open("wb") as log:
                # In a session of its own: Ctrl-C reaches the training alone, which ends it.
                self._child = subprocess.Popen(
                    self._command(),
                    cwd=MODELS,
                    stdin=subprocess.DEVNULL,
                    stdout=printed,
                    stderr=log,
                    start_new_session=True,
                )
        # A disk that is full is a RuntimeError to PyTorch.
        except (OSError, RuntimeError) as error:
            self._report(error)

    def _command(self) -> list[str]:
        exporting = [str(os.getpid()), str(self._folder / CHECKPOINT), str(self._folder / "bundle")]
        return [sys.executable, "-m", "rapid_policy.trials", *exporting, *self._evaluation()]

    def _evaluation(self) -> list[str]:
        options = ["--condition", CONDITION, "--trials", str(self._count), "--seed", str(FIRST_SEED), "--json"]
        return [str(self._rapid), "eval", str(self._folder / "bundle"), *options]

    def _take(self, board: Board) -> None:
        if self._child is None or self._child.poll() is None:
            return
        code, self._child = self._child.returncode, None
        run = self._run
        try:
            found = self._read(code)
            # The later one of equals: it has learned for longer.
            best = found["score"] >= run.best_success
            if best:
                (self._folder / CHECKPOINT).replace(self._out / BEST_SUCCESS)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            self._report(error)
            return
        run.evaluations.append({"iteration": self._started, **found})
        # So that neither a crash nor a resumed training forgets what the best one is.
        run.save(self._out / CHECKPOINT)
        shutil.rmtree(self._folder, ignore_errors=True)
        low, high = found["interval"]
        board.add(self._started, success=found["score"], success_low=low, success_high=high)
        text = f"success {found['score']:.2f} ({low:.2f} to {high:.2f}), {found['success']} of {self._count} trials"
        print(f"{run.spec.name}: {self._started}/{run.iterations} {text}{', the best' if best else ''}", flush=True)

    def _read(self, code: int) -> dict[str, Any]:
        """What the program printed about all trials, in plain numbers."""
        if code:
            last = (self._folder / "log.txt").read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:]
            raise ValueError(": ".join([f"exit code {code}", *last]))
        lines = [json.loads(line) for line in (self._folder / "printed.jsonl").read_text(encoding="utf-8").splitlines()]
        wanted = {"event": "condition", "condition": CONDITION}
        found = next((line for line in lines if wanted.items() <= line.items()), {})
        if found.get("trials") != self._count:
            raise ValueError(f"{self._rapid} eval printed no result of {self._count} trials: is it this version?")
        low, high = map(float, found["interval"])
        return {"trials": self._count, "success": int(found["success"]), "score": float(found["score"]), "interval": [low, high]}

    def _report(self, error: Exception) -> None:
        where = f"see {self._folder / 'log.txt'}; the training continues"
        cause = f"{type(error).__name__} {error}" if isinstance(error, (KeyError, TypeError, AttributeError)) else error
        print(f"train: evaluation after {self._started} iterations failed: {cause}: {where}", file=sys.stderr, flush=True)


def check_seeds(demonstrated: list[int] | None, count: int) -> None:
    """Refuses trials whose blocks were demonstrated: they show nothing about others. `demonstrated`: first and last seed."""
    if demonstrated and demonstrated[0] < FIRST_SEED + count and demonstrated[1] >= FIRST_SEED:
        cause = f"{FIRST_SEED} to {FIRST_SEED + count - 1}: seeds of trials that were demonstrated"
        fix = "leave --evaluate-every out, or data.seeds of the experiment chooses other episodes"
        raise ValueError(f"{cause} ({demonstrated[0]} to {demonstrated[1]}): {fix}")


def check_count(checkpoint: Path, evaluations: list[dict[str, Any]], count: int) -> None:
    """Refuses scores of another number of trials: those of few vary more, so that the best of them would stay the best."""
    # Older checkpoints do not state it.
    others = {found["trials"] for found in evaluations if "trials" in found} - {count}
    if others:
        cause = f"--evaluate-trials {count}: the scores in {checkpoint} are of {min(others)} trials and not comparable"
        raise ValueError(f"{cause}: write --evaluate-trials {min(others)}, or use another --out")


def end_with(parent: int) -> None:
    """Has the kernel kill this process when `parent`, which started it, ends. Ends it if that has happened already."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL):
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    if os.getppid() != parent:
        sys.exit("trials: the training has ended")


def main() -> None:
    """The child: exports the checkpoint and becomes the program."""
    parent, checkpoint, bundle, *command = sys.argv[1:]
    end_with(int(parent))
    import torch

    from .export import export

    # The training has priority.
    os.nice(10)
    torch.set_num_threads(1)
    export(read_checkpoint(Path(checkpoint)), Path(bundle))
    os.execv(command[0], command)


if __name__ == "__main__":
    main()
