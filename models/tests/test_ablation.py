"""The ablation: what of it is done again, and what its table says."""

import argparse
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

from ablation import CONFIGURATIONS, ITERATIONS, MODELS, NAME, SEEDS, TRIALS, Training
from ablation import carry_out, command, counted, markdown, summarize
from rapid_policy.experiment_file import read_experiment
from rapid_policy.results import wilson

FACTS = {"episodes": 240, "frames": 25_600, "batch_windows": 64, "iterations": 400, "minutes": 2.0, "final_loss": 0.02}
FACTS |= {"hardware": "a processor", "torch": "2"}


def trial(triangular, outcome, size="big", status="normal"):
    return {"event": "trial", "triangular": triangular, "outcome": outcome, "size": size, "status": status}


class Runs(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        self.rapid = self.folder / "rapid"
        self.args = argparse.Namespace(
            rapid=self.rapid, runs=self.folder, out=self.folder / "results", seeds=[0, 1], trials=2, iterations=400,
            episodes=self.folder / "episodes", name="ablation",
        )

    def program(self, trials):
        """A program that prints these trials and counts how often it is run."""
        lines = "\n".join(map(json.dumps, [*trials, {"event": "condition"}]))
        self.rapid.write_text(f"#!/bin/sh\necho run >>{self.folder}/count\ncat <<'END'\n{lines}\nEND\n", encoding="utf-8")
        self.rapid.chmod(0o755)

    def trained(self, name, seed):
        configuration = next(c for c in CONFIGURATIONS if c.name == name)
        training = Training(configuration, seed, self.folder / f"{name}-{seed}")
        training.bundle.mkdir(parents=True)
        facts = {"training": FACTS | {"seed": seed}}
        (training.bundle / "policy.json").write_text(json.dumps(facts), encoding="utf-8")
        return training

    def test_what_is_evaluated_is_not_evaluated_again(self):
        self.program([trial(True, "success")] * 2)
        training = self.trained("vision", 0)
        carry_out(training, self.args)
        carry_out(training, self.args)
        self.assertEqual((self.folder / "count").read_text().split(), ["run"])
        self.assertEqual(len(json.loads(training.trials.read_text())["trials"]), 2)

    def test_another_number_of_trials_or_another_policy_is_evaluated_again(self):
        self.program([trial(True, "success")] * 2)
        training = self.trained("vision", 0)
        carry_out(training, self.args)
        policy = training.bundle / "policy.json"
        policy.write_text(policy.read_text() + " ", encoding="utf-8")
        carry_out(training, self.args)
        self.args.trials = 3
        self.program([trial(True, "success")] * 3)
        carry_out(training, self.args)
        self.assertEqual((self.folder / "count").read_text().split(), ["run"] * 3)

    def test_other_iterations_or_episodes_are_refused(self):
        self.program([trial(True, "success")] * 2)
        training = self.trained("vision", 0)
        carry_out(training, self.args)
        for key, other in (("iterations", 500), ("episodes", self.folder / "others")):
            changed = argparse.Namespace(**{**vars(self.args), key: other})
            with self.assertRaisesRegex(ValueError, "other episodes or iterations: delete it"):
                carry_out(training, changed)

    def test_of_an_experiment_a_value_counts_and_a_comment_does_not(self):
        self.program([trial(True, "success")] * 2)
        shutil.copytree(MODELS / "experiments", self.folder / "experiments")
        training = self.trained("vision", 0)
        with mock.patch("ablation.MODELS", self.folder):
            carry_out(training, self.args)
            file, text = training.configuration.file, training.configuration.file.read_text(encoding="utf-8")
            file.write_text(f"# Another comment.\n{text}", encoding="utf-8")
            carry_out(training, self.args)
            file.write_text(text.replace("learning_rate = 0.001", "learning_rate = 0.002"), encoding="utf-8")
            with self.assertRaisesRegex(ValueError, "of another experiment"):
                carry_out(training, self.args)

    def test_an_interrupted_evaluation_does_not_count(self):
        self.program([trial(True, "success")])
        training = self.trained("vision", 0)
        with self.assertRaisesRegex(ValueError, "1 of 2 trials"):
            carry_out(training, self.args)
        self.assertFalse(training.trials.exists())

    def test_an_evaluation_that_fails_leaves_nothing_that_counts(self):
        self.rapid.write_text("#!/bin/sh\necho '{\"event\":'\n", encoding="utf-8")
        self.rapid.chmod(0o755)
        training = self.trained("vision", 0)
        with self.assertRaises(ValueError):
            carry_out(training, self.args)
        self.assertFalse(training.trials.exists())

    def test_sigterm_ends_it_in_the_background_too(self):
        """Where a shell starts it with `&`, SIGINT is ignored."""
        program = (
            "import sys, ablation\n"
            "def carry_out(*_):\n"
            "    print('begun', flush=True)\n"
            "    ablation.CHILDREN.run(['sleep', '600'])\n"
            "ablation.carry_out = carry_out\n"
            "ablation.main()\n"
        )
        command = [sys.executable, "-c", program, str(self.folder), "--rapid", str(self.rapid), "--runs", str(self.folder)]
        for ignored in (False, True):
            process = subprocess.Popen(
                command, cwd=MODELS, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                preexec_fn=(lambda: signal.signal(signal.SIGINT, signal.SIG_IGN)) if ignored else None,
            )  # fmt: skip
            self.addCleanup(process.kill)
            self.assertEqual(process.stdout.readline(), "begun\n")
            process.terminate()
            _, errors = process.communicate(timeout=60)
            self.assertEqual(process.returncode, 1)
            self.assertIn("ablation: interrupted; the same command continues", errors)

    def test_the_table_has_all_trials_and_each_training(self):
        self.program([trial(True, "success"), trial(False, "success", "small")])
        carry_out(self.trained("vision-diff", 0), self.args)
        self.program([trial(True, "wrong_bin"), trial(False, "incomplete", "small")])
        carry_out(self.trained("vision-diff", 1), self.args)
        summarize(self.args)
        report = json.loads((self.args.out / "ablation.json").read_text())
        (row,) = report["configurations"]
        self.assertEqual((row["trials"], row["success"], row["wrong_bin"], row["incomplete"]), (4, 0.5, 0.25, 0.25))
        self.assertEqual([t["success"] for t in row["trainings"]], [1.0, 0.0])
        self.assertEqual(row["success_by_size"], {"big": 0.5, "small": 0.5})
        text = markdown(report, "ablation.png")
        self.assertIn("0.50 (1.00, 0.00)", text)
        self.assertIn("about 1 epochs", text)
        self.assertIn("Not run: vision, vision-mask, tactile-id-arm, vision-diff-big.", text)
        self.assertIn("\nOne configuration of the policy, each trained for 400 iterations with each of the seeds 0, 1, and", text)
        words = "ablation.py EPISODES --rapid RAPID --trials 2 --iterations 400 --seeds 0 1 --only vision-diff"
        self.assertIn(f"Made with\n\n    python {words}\n", text)

    def test_what_is_noted_of_a_row_stands_below_the_table(self):
        self.program([trial(True, "success")] * 2)
        carry_out(self.trained("vision", 0), self.args)
        summarize(self.args)
        report = json.loads((self.args.out / "ablation.json").read_text())
        self.assertIn("each trained for 400 iterations with seed 0, and", markdown(report, "ablation.png"))
        report["configurations"][0]["note"] = "trained in another way."
        self.assertIn("\n\n**`vision`**: trained in another way.\n\n", markdown(report, "ablation.png"))

    def test_another_table_has_other_files(self):
        self.program([trial(True, "success")] * 2)
        carry_out(self.trained("vision", 0), self.args)
        summarize(self.args)
        first = (self.args.out / "ablation.md").read_text()
        self.assertIn("](ablation.png)", first)
        self.args.name = "ablation-400"
        summarize(self.args)
        self.assertEqual((self.args.out / "ablation.md").read_text(), first)
        report = json.loads((self.args.out / "ablation-400.json").read_text())
        self.assertIn("](ablation-400.png)", (self.args.out / "ablation-400.md").read_text())
        for picture in ("ablation.png", "ablation-400.png"):
            self.assertGreater((self.args.out / picture).stat().st_size, 1000)
        self.assertTrue(report["command"].endswith("--only vision --name ablation-400"), report["command"])


class Pages(unittest.TestCase):
    def test_those_in_the_repository_are_of_their_figures(self):
        report = json.loads((MODELS / "results" / "ablation.json").read_text(encoding="utf-8"))
        self.assertEqual((MODELS / "results" / "ablation.md").read_text(encoding="utf-8"), markdown(report, "ablation.png"))
        # By `make ablation` only a table of all that it makes.
        seeds, rows = " ".join(map(str, SEEDS)), [c.name for c in CONFIGURATIONS]
        for chosen, made in ((rows, "Made with `make ablation`, which runs\n"), (rows[1:], "Made with\n")):
            report["command"] = command(NAME, SEEDS, TRIALS, ITERATIONS, chosen)
            self.assertIn(f"--seeds {seeds}", report["command"])
            self.assertIn(made, markdown(report, "ablation.png"))


class Counting(unittest.TestCase):
    def test_no_share_is_outside_its_interval(self):
        for trials in (1, 2, 100, 300):
            for successes in (0, 1, trials - 1, trials):
                low, high = wilson(successes, trials)
                self.assertTrue(0 <= low <= successes / trials <= high <= 1, (successes, trials, low, high))

    def test_left_is_the_bin_of_the_triangular_ones(self):
        trials = [trial(True, "success"), trial(False, "wrong_bin"), trial(False, "success"), trial(True, "incomplete")]
        shares = counted(trials)
        self.assertEqual((shares["put_left"], shares["success"], shares["triangular"]), (0.5, 0.5, 0.5))

    def test_a_crash_is_no_other_outcome(self):
        shares = counted([trial(True, "incomplete", status="crash"), trial(True, "success")])
        self.assertEqual((shares["crash"], shares["incomplete"], shares["success"]), (0.5, 0.0, 0.5))

    def test_every_configuration_is_trained_equally(self):
        schedules = {read_experiment(c.file).training for c in CONFIGURATIONS}
        self.assertEqual(len(schedules), 1)


if __name__ == "__main__":
    unittest.main()
