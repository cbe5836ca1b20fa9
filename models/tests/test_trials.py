"""Evaluations beside a training: which weights are kept, that the training does not depend on them, and how they end."""

import contextlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

import ablation
import evaluation
import torch
from made_up import MODELS, by_hand, small

from rapid_policy import trials as module
from rapid_policy.checkpoint import BEST_SUCCESS, CHECKPOINT, Run, begin, read_checkpoint
from rapid_policy.dataset import Dataset
from rapid_policy.progress import Progress
from rapid_policy.train import Stopped, Trainer, parse, prepare, provenance
from rapid_policy.trials import FIRST_SEED, MOST, Trials, check_count, check_seeds
from rapid_policy.weights import load_policy

RAPID = os.environ.get("RAPID_BIN")
# In the place of `rapid`: keeps its command lines and the bundle, and answers as the test has it.
STAND_IN = f"""#!{sys.executable}
import json, pathlib, shutil, signal, sys
here = pathlib.Path(__file__).parent
calls = here / "calls"
number = len(calls.read_text().splitlines()) if calls.exists() else 0
if pathlib.Path(sys.argv[2]).is_dir():
    shutil.copytree(sys.argv[2], here / f"bundle-{{number}}")
(here / "answering").write_text("")
with calls.open("a") as file:
    file.write(json.dumps(sys.argv[1:]) + "\\n")
answer = json.loads((here / "answers").read_text())[number]
if answer["wait"]:
    if answer["wait"] == "without end":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    (here / "waiting").touch()
    while True:
        signal.pause()
sys.stderr.write(answer["errors"])
print(answer["printed"])
sys.exit(answer["code"])
"""


def condition(success: int, trials: int = 20, **changed) -> str:
    line = {"event": "condition", "condition": "full", "success": success, "trials": trials, "score": success / trials}
    trial = {"event": "trial", "condition": "full", "outcome": "success"}
    return "\n".join(json.dumps(one) for one in (trial, line | {"interval": [0.1, 0.9]} | changed))


def answer(printed: str = "", code: int = 0, errors: str = "", wait: str = "") -> dict:
    return {"printed": printed, "code": code, "errors": errors, "wait": wait}


class Case(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        torch.set_num_threads(1)

    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder, self.out = Path(folder.name), Path(folder.name) / "run"
        self.out.mkdir()
        self.rapid = self.folder / "rapid"
        self.rapid.write_text(STAND_IN, encoding="utf-8")
        self.rapid.chmod(0o755)
        self.output, self.errors = io.StringIO(), io.StringIO()
        self.enter(contextlib.redirect_stdout(self.output), contextlib.redirect_stderr(self.errors))
        self.dataset = Dataset(small("transformer"), [by_hand(40)])

    def enter(self, *contexts):
        for context in contexts:
            self.enterContext(context)

    def answers(self, *answers: dict):
        (self.folder / "answers").write_text(json.dumps(answers))

    def calls(self) -> list[list[str]]:
        return [json.loads(line) for line in (self.folder / "calls").read_text().splitlines()]

    def start(self, **training) -> Run:
        spec = small("transformer", **training)
        facts = provenance([by_hand(40)], "train") | {"hardware": "a CPU"}
        return begin(spec, len(self.dataset.windows), self.dataset.ranges, facts, torch.device("cpu"))

    def trials(self, run: Run, every: int = 10, count: int = 20) -> Trials:
        return Trials(run, self.out, str(self.rapid), every, count)

    def without_export(self):
        """What the child does first takes seconds, and is not what most of the tests are about."""
        self.enter(mock.patch.object(Trials, "_command", Trials._evaluation))


class Kept(Case):
    def setUp(self):
        super().setUp()
        self.without_export()
        self.run_, self.board = self.start(), mock.Mock()
        self.run_.losses.append(1.0)

    def evaluate(self, trials: Trials, *iterations: int):
        for iteration in iterations:
            self.run_.iteration = iteration
            trials.step(self.board)
            if trials._child:
                trials._child.wait()
            trials.step(self.board)

    def test_the_best_is_kept_and_of_equals_the_later(self):
        self.answers(*(answer(condition(success)) for success in (5, 12, 12, 9)))
        self.evaluate(self.trials(self.run_), 10, 20, 30, 40)
        found = [(e["iteration"], e["success"], e["trials"]) for e in self.run_.evaluations]
        self.assertEqual(found, [(10, 5, 20), (20, 12, 20), (30, 12, 20), (40, 9, 20)])
        best = read_checkpoint(self.out / BEST_SUCCESS)
        self.assertEqual(best["iteration"], 30)
        facts = {"condition": "full", "trials": 20, "first_seed": FIRST_SEED}
        self.assertEqual((best["provenance"]["evaluated"], best["provenance"]["final_loss"]), (facts, 1.0))
        self.assertIn("40/8 success 0.45 (0.10 to 0.90), 9 of 20 trials\n", self.output.getvalue())
        self.assertEqual(self.output.getvalue().count("the best"), 3)
        self.board.add.assert_called_with(40, success=0.45, success_low=0.1, success_high=0.9)
        options = ["--condition", "full", "--trials", "20", "--seed", "40000", "--json"]
        self.assertEqual(self.calls(), [["eval", str(self.out / "evaluation" / "bundle"), *options]] * 4)
        self.assertFalse((self.out / "evaluation").exists())

    def test_a_resumed_training_knows_the_best(self):
        self.answers(*(answer(condition(success)) for success in (12, 9, 13)))
        self.evaluate(self.trials(self.run_), 10)
        self.run_ = self.start()
        self.run_.load(read_checkpoint(self.out / CHECKPOINT))
        trials = self.trials(self.run_)
        self.evaluate(trials, 11, 19)
        self.assertEqual(len(self.calls()), 1)
        self.evaluate(trials, 20)
        self.assertEqual(read_checkpoint(self.out / BEST_SUCCESS)["iteration"], 10)
        self.evaluate(trials, 30)
        self.assertEqual(read_checkpoint(self.out / BEST_SUCCESS)["iteration"], 30)

    def test_a_failed_one_is_reported_and_the_next_runs(self):
        wrong = (
            (answer(code=3, errors="first\nno library\n"), "exit code 3: no library"),
            (answer("no json"), "Expecting value"),
            (answer(condition(3, trials=7)), "printed no result of 20 trials"),
            (answer(condition(3, condition="no-tactile")), "printed no result of 20 trials"),
            (answer(condition(3, interval=None)), "TypeError"),
            (answer("[1]"), "AttributeError"),
        )
        self.answers(*(given for given, _ in wrong), answer(condition(20)))
        trials = self.trials(self.run_)
        for i, (_, reason) in enumerate(wrong, 1):
            self.evaluate(trials, 10 * i)
            line = self.errors.getvalue().splitlines()[-1]
            self.assertRegex(line, f"^train: evaluation after {10 * i} iterations failed: .*{reason}.*: see .*log.txt; the")
            self.assertTrue((self.out / "evaluation" / "log.txt").exists())
        self.assertEqual((self.run_.evaluations, (self.out / BEST_SUCCESS).exists()), ([], False))
        self.evaluate(trials, 69)
        self.assertEqual(len(self.calls()), len(wrong))
        self.evaluate(trials, 70)
        self.assertEqual(self.run_.evaluations[0]["iteration"], 70)

    def test_what_cannot_start_is_reported(self):
        self.rapid.unlink()
        with mock.patch.object(Run, "save", side_effect=RuntimeError("disk full")):
            self.evaluate(self.trials(self.run_), 10)
        self.evaluate(self.trials(self.run_), 10)
        first, second = self.errors.getvalue().splitlines()
        self.assertIn("after 10 iterations failed: disk full", first)
        self.assertIn("No such file", second)

    def test_what_is_due_while_one_runs_starts_when_that_ends(self):
        self.answers(answer(condition(1)), answer(condition(1)))
        trials = self.trials(self.run_)
        # It has ended when `_take` looks, and not before.
        for iteration, ended in ((10, False), (20, False), (25, False), (27, True)):
            self.run_.iteration = iteration
            if trials._child and ended:
                trials._child.wait()
            with contextlib.ExitStack() as stack:
                if trials._child and not ended:
                    stack.enter_context(mock.patch.object(trials._child, "poll", return_value=None))
                trials.step(self.board)
        trials._child.wait()
        trials.step(self.board)
        self.assertEqual([e["iteration"] for e in self.run_.evaluations], [10, 27])

    def test_the_child_ends_with_the_training(self):
        for wait in ("for the end", "without end"):
            with self.subTest(wait):
                for name in ("calls", "waiting"):
                    (self.folder / name).unlink(missing_ok=True)
                self.answers(answer(wait=wait))
                trials = self.trials(self.run_)
                self.run_.iteration = 10
                trials.step(self.board)
                child = trials._child
                self.addCleanup(child.kill)
                until(lambda: (self.folder / "waiting").exists())
                with mock.patch.object(module, "PATIENCE", 0.1 if wait == "without end" else 1000):
                    trials.end()
                self.assertEqual(child.returncode, -signal.SIGKILL if wait == "without end" else -signal.SIGTERM)
                self.assertFalse((self.out / "evaluation").exists())
                trials.end()

    def test_the_child_ends_with_a_training_that_is_killed(self):
        child = self.folder / "child"
        code = (
            "import os, sys\nfrom rapid_policy import trials\n"
            "if not os.fork():\n"
            "    trials.end_with(int(sys.argv[1]) or os.getppid())\n"
            f"    os.execv('/bin/sh', ['sh', '-c', 'echo $$ >{child}.new; mv {child}.new {child}; while :; do sleep 1; done'])\n"
            "os.wait()\n"
        )

        def start(parent: str) -> subprocess.Popen:
            words = [sys.executable, "-c", code, parent]
            started = subprocess.Popen(words, cwd=MODELS, stderr=subprocess.PIPE, text=True, start_new_session=True)
            self.addCleanup(started.stderr.close)
            self.addCleanup(started.wait)
            self.addCleanup(end, started)
            return started

        def end(started: subprocess.Popen):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(started.pid, signal.SIGKILL)

        def gone() -> bool:
            try:
                return (Path("/proc") / child.read_text().strip() / "stat").read_text().rpartition(")")[2].split()[0] in "ZX"
            except (FileNotFoundError, ProcessLookupError):
                return True

        training = start("0")
        until(child.exists)
        self.assertFalse(gone())
        training.kill()
        until(gone)
        # It ended before the child asked for that.
        late = start(str(os.getpid()))
        self.assertIn("the training has ended", late.communicate()[1])


def until(holds):
    while not holds():
        signal.sigtimedwait([], 0.02)


class Seeds(unittest.TestCase):
    def test_nothing_is_chosen_by_the_seeds_of_results(self):
        for reported in (ablation.FIRST_SEED, evaluation.FIRST_SEED):
            self.assertLessEqual(FIRST_SEED + MOST, reported)

    def test_demonstrated_seeds_are_refused(self):
        for seeds in (None, [1000, 1239], [0, FIRST_SEED - 1], [FIRST_SEED + 20, FIRST_SEED + 30]):
            check_seeds(seeds, 20)
        for seeds in ([FIRST_SEED, FIRST_SEED], [0, 10**9], [FIRST_SEED + 19, 10**9]):
            with self.assertRaisesRegex(ValueError, "^40000 to 40019: seeds of trials that were demonstrated"):
                check_seeds(seeds, 20)

    def test_scores_of_other_numbers_of_trials_are_refused(self):
        # The first is of an older version.
        evaluations = [{"iteration": 10, "score": 1.0}, {"iteration": 20, "score": 1.0, "trials": 2}]
        check_count(Path("run/checkpoint.pt"), evaluations, 2)
        fix = "write --evaluate-trials 2, or use another --out"
        with self.assertRaisesRegex(ValueError, f"^--evaluate-trials 20: .* run/checkpoint.pt are of 2 trials .*: {fix}$"):
            check_count(Path("run/checkpoint.pt"), evaluations, 20)

    def test_more_trials_than_there_are_seeds_are_refused(self):
        trials, every = "--evaluate-trials", "--evaluate-every"
        for option, value in ((trials, MOST + 1), (trials, 0), (every, -1), (every, "x")):
            words = ["train", "x.toml", "--out", "run", option, str(value)]
            with mock.patch.object(sys, "argv", words), contextlib.redirect_stderr(io.StringIO()) as errors:
                with self.assertRaises(SystemExit):
                    parse()
            self.assertIn(f"{option}: {value}: write a number from 1 to", errors.getvalue())


class Training(Case):
    def test_it_learns_the_same_and_the_final_weights_are_evaluated(self):
        alone = self.start()
        Trainer(alone, self.dataset, self.out).train()
        self.answers(answer(condition(5)), answer(condition(7)))
        run = self.start()
        trials = self.trials(run, every=5)

        def step(*_):
            if run.iteration == 6:
                until(lambda: trials._child.poll() is not None)

        with mock.patch.object(Progress, "step", side_effect=step):
            Trainer(run, self.dataset, self.out, trials=trials).train()
        self.assertEqual(run.losses, alone.losses)
        iterations = [e["iteration"] for e in run.evaluations]
        self.assertEqual((iterations, self.errors.getvalue()), ([5, 8], ""))
        best = read_checkpoint(self.out / BEST_SUCCESS)
        evaluated = load_policy(self.folder / "bundle-1").state_dict()
        for name, weight in best["average"].items():
            self.assertTrue(torch.equal(weight, evaluated[name]), name)
        described = json.loads((self.folder / "bundle-1" / "policy.json").read_text())
        self.assertEqual(described["training"]["evaluated"]["first_seed"], FIRST_SEED)
        self.assertEqual(read_checkpoint(self.out / CHECKPOINT)["evaluations"], run.evaluations)

    def test_a_signal_ends_the_child_and_what_is_resumed_evaluates_again(self):
        self.without_export()
        for moment, first in ((4, 5), (8, 8)):
            with self.subTest(moment):
                for file in (self.folder / name for name in ("calls", "waiting")):
                    file.unlink(missing_ok=True)
                shutil.rmtree(self.out)
                self.out.mkdir()
                self.answers(answer(wait="for the end"), *[answer(condition(5))] * 3)
                run = self.start()
                trials = self.trials(run, every=moment - 1)
                children = []

                def step(*_, run=run, trials=trials, moment=moment, children=children):
                    if run.iteration == moment:
                        until(lambda: (self.folder / "waiting").exists())
                        children.append(trials._child)
                        # Whatever happens, it does not outlive the test.
                        self.addCleanup(trials._child.kill)
                        os.kill(os.getpid(), signal.SIGTERM if moment == 4 else signal.SIGHUP)

                with mock.patch.object(Progress, "step", side_effect=step), self.assertRaises(Stopped):
                    Trainer(run, self.dataset, self.out, trials=trials).train()
                self.assertEqual(children[0].returncode, -signal.SIGTERM)
                resumed = self.start()
                resumed.load(read_checkpoint(self.out / CHECKPOINT))
                self.assertEqual((resumed.iteration, resumed.evaluations), (moment, []))
                Trainer(resumed, self.dataset, self.out, trials=self.trials(resumed, every=moment - 1)).train()
                self.assertEqual([resumed.evaluations[i]["iteration"] for i in (0, -1)], [first, 8])
                self.assertEqual(self.errors.getvalue(), "")

    def test_no_program_is_named_before_anything_is_read(self):
        words = [str(MODELS / "experiments" / "transformer.toml"), "--out", str(self.folder / "none")]
        argv = ["train", *words, "--rapid", "/no/program", "--evaluate-every", "5"]
        with mock.patch.object(sys, "argv", argv), mock.patch.dict(os.environ):
            with self.assertRaisesRegex(Exception, "RAPID_BIN=/no/program is not a program: build it"):
                prepare(parse(), mock.Mock())
        self.assertFalse((self.folder / "none").exists())

    @unittest.skipUnless(RAPID, "skipped: no program in $RAPID_BIN")
    def test_the_program_evaluates(self):
        run = self.start()
        Trainer(run, self.dataset, self.out, trials=Trials(run, self.out, RAPID, 8, 1)).train()
        self.assertEqual(self.errors.getvalue(), "")
        (found,) = run.evaluations
        self.assertEqual((found["iteration"], found["score"]), (8, float(found["success"])))
        self.assertTrue((self.out / BEST_SUCCESS).exists())


if __name__ == "__main__":
    unittest.main()
