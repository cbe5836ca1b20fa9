"""The evaluation: whose output it takes, and what it does not run again."""

import argparse
import contextlib
import io
import json
import tempfile
import unittest
from pathlib import Path
from unittest import mock

from evaluation import FIRST_SEED, MODELS, RUNS, TITLES, EvaluationError, evaluate, main, markdown, row

HELD = next(run for run in RUNS if run.name == "held")


def condition(name, **changed):
    line = {"event": "condition", "condition": name, "score": 0.5, "interval": [0.1, 0.9], "wrong_bin": 1, "incomplete": 0}
    return line | {"crash": 0, "status": "normal", "paper_score": None, "paper_status": "-", "policy_hash": "ours"} | changed


class Output(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        self.args = argparse.Namespace(rapid=self.folder / "rapid", runs=self.folder, trials=2, seeds_from=FIRST_SEED)
        self.lines = [
            line
            for name in HELD.conditions
            for line in [*({"event": "trial", "condition": name} for _ in range(2)), condition(name)]
        ]
        self.program(self.lines)

    def program(self, lines):
        """A program that evaluates with this output, counts how often it does, and shows the policy `ours`."""
        text = "\n".join(map(json.dumps, lines))
        self.args.rapid.write_text(
            f"#!/bin/sh\nif [ $1 = policy ]; then echo '{{\"hash\": \"ours\"}}'; exit; fi\n"
            f"echo run >>{self.folder}/count\necho $* >>{self.folder}/words\ncat <<'END'\n{text}\nEND\n",
            encoding="utf-8",
        )
        self.args.rapid.chmod(0o755)

    def test_what_was_printed_is_not_run_again(self):
        self.assertEqual(evaluate(HELD, self.args), self.lines)
        self.assertEqual(evaluate(HELD, self.args), self.lines)
        self.assertEqual((self.folder / "count").read_text().split(), ["run"])

    def test_output_of_another_policy_or_of_another_run_is_refused(self):
        other = [line | {"policy_hash": "theirs"} if line["event"] == "condition" else line for line in self.lines]
        for wrong, reason in ((other, "of another policy"), (self.lines[:-1], "not all of them"), (self.lines[:1], "not all of them")):
            self.program(wrong)
            with self.assertRaisesRegex(EvaluationError, reason):
                evaluate(HELD, self.args)
            self.assertFalse((self.folder / "held.jsonl").exists())

    def test_another_program_or_another_number_of_trials_is_run_again(self):
        evaluate(HELD, self.args)
        self.program([*self.lines, {"event": "more"}])
        self.assertEqual(evaluate(HELD, self.args)[-1], {"event": "more"})
        self.args.trials = 3
        with self.assertRaisesRegex(EvaluationError, "not all of them"):
            evaluate(HELD, self.args)

    def test_trials_with_other_seeds_are_kept_beside_the_first_ones(self):
        evaluate(HELD, self.args)
        self.args.seeds_from = 90_000
        evaluate(HELD, self.args)
        evaluate(HELD, self.args)
        self.assertEqual([line.split()[5] for line in (self.folder / "words").read_text().splitlines()], ["80000", "90000"])
        for file, seed in (("held.jsonl", "80000"), ("held-90000.jsonl", "90000")):
            head = json.loads((self.folder / file).read_text(encoding="utf-8").splitlines()[0])
            self.assertEqual(head["command"][head["command"].index("--seed") + 1], seed)

    def test_every_condition_has_a_title(self):
        self.assertTrue(all(name in TITLES for run in RUNS for name in run.conditions))


class Options(unittest.TestCase):
    def test_seeds_of_demonstrations_are_refused(self):
        words = ["evaluation.py", "--rapid", "rapid", "--seeds-from", "79999"]
        with mock.patch("sys.argv", words), contextlib.redirect_stderr(io.StringIO()) as printed:
            self.assertRaises(SystemExit, main)
        self.assertIn("79999 is below 80000", printed.getvalue())


class Row(unittest.TestCase):
    def test_what_the_paper_has(self):
        ends = [
            row("x", condition("full", paper_score=0.92, paper_status="Normal")).split("|")[-2].strip(),
            row("x", condition("full", paper_status="Crash")).split("|")[-2].strip(),
            row("x", condition("full")).split("|")[-2].strip(),
        ]
        self.assertEqual(ends, ["0.92 Normal", "Crash", "-"])


class Page(unittest.TestCase):
    def test_that_in_the_repository_is_what_is_printed(self):
        results = MODELS / "results"
        lines = [json.loads(line) for line in (results / "eval.jsonl").read_text(encoding="utf-8").splitlines()]
        printed = {run.name: [line for line in lines if line["run"] == run.name] for run in RUNS}
        self.assertEqual((results / "eval.md").read_text(encoding="utf-8"), markdown(printed, 100))
        other = markdown(printed, 100, 90_000)
        self.assertIn("seeds 90000 to 90099", other)
        self.assertIn("evaluation.py --rapid PROGRAM --seeds-from 90000`", other)
        self.assertEqual((other.count("--seed 90000"), other.count("--seed 80000")), (len(RUNS), 0))


if __name__ == "__main__":
    unittest.main()
