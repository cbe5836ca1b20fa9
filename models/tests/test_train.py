"""Training: that it learns at all, that what it learns is what it was, and that a run survives being stopped."""

import json
import os
import pickle
import re
import signal
import subprocess
import sys
import tempfile
import threading
import unittest
from pathlib import Path
from unittest import mock

import numpy as np
import torch
import written
from made_up import MODELS, Experiment, by_hand, made_up, observed, path, small, with_history

from rapid_policy import progress
from rapid_policy import train as module
from rapid_policy.checkpoint import BEST, BEST_SUCCESS, CHECKPOINT, Run, begin, read_checkpoint
from rapid_policy.dataset import Dataset
from rapid_policy.losses import Losses
from rapid_policy.model import Policy
from rapid_policy.train import Stopped, Trainer

# The first losses of the policy that is shipped, in small, on `episodes()`: computed before experiments were files.
BEFORE = (1.20768404, 1.11989737, 1.20433569, 1.16570115, 1.18714881, 1.15765762, 1.07689071, 1.15567672)


def episodes():
    """Two, of which one lacks the tactile camera for a time and a required sample once."""
    first, second = made_up(40), made_up(30, 1)
    second.present("tactile_tip")[8:15] = False
    second.present("arm")[20] = False
    return [first, second]


def start(spec: Experiment, dataset: Dataset) -> Run:
    return begin(spec, len(dataset.windows), dataset.ranges, {}, torch.device("cpu"))


class Case(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        torch.set_num_threads(1)

    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        output = mock.patch("builtins.print")
        self.printed = output.start()
        self.addCleanup(output.stop)

    def interrupt(self, trainer: Trainer) -> None:
        """Ends a training in its third iteration."""
        with (
            mock.patch.object(module.Progress, "step", side_effect=[None, None, KeyboardInterrupt]),
            self.assertRaises(KeyboardInterrupt),
        ):
            trainer.train()


class Learning(Case):
    def test_the_first_losses_are_what_they_were(self):
        for workers in (0, 2):
            spec = small(windows=16, precision="float32")
            dataset = Dataset(spec, episodes())
            run = start(spec, dataset)
            Trainer(run, dataset, self.folder, workers=workers).train()
            np.testing.assert_allclose(run.losses, BEFORE, rtol=2e-4, err_msg=f"{workers} workers")

    def test_the_loss_falls(self):
        for change in (
            {},
            {"optimizer": "adam", "scheduler": "linear"},
            {"precision": "bf16", "scheduler": "constant"},
        ):
            with self.subTest(**change):
                spec = small(iterations=250, **change)
                dataset = Dataset(spec, [made_up(40)])
                run = start(spec, dataset)
                final = Trainer(run, dataset, self.folder).train()
                self.assertLess(final, 0.8 * sum(run.losses[:20]) / 20)
                self.assertTrue((self.folder / "loss.png").stat().st_size > 0)

    def test_outcomes_are_learned_beside_the_noise(self):
        weights = {"wrist": 0.25, "tactile": 0.5}
        for plain, predict in (
            (small(iterations=60, windows=16, precision="float32"), ("wrist", "tactile")),
            (small(iterations=60, windows=16, precision="float32"), ("wrist",)),
            (small("vision-diff", iterations=60, windows=16, precision="float32"), ("tactile",)),
            (with_history(small(iterations=60, windows=16, precision="float32")), ("tactile",)),
            (small("transformer", iterations=60, windows=16, precision="float32"), ("wrist", "tactile")),
        ):
            with self.subTest(plain.name, predict=predict, histories=len(plain.histories)):
                spec = plain
                for key in predict:
                    spec = observed(spec, key, outcome=weights[key])
                self.learns_outcomes(plain, spec, {key: weights[key] for key in predict})

    def learns_outcomes(self, plain: Experiment, spec: Experiment, weights: dict[str, float]) -> None:
        dataset = Dataset(spec, [by_hand(40)] if spec.name == "transformer" else episodes())
        run = start(spec, dataset)
        # A dropout would be another one in each measurement.
        run.policy.eval()
        trainer = Trainer(run, dataset, self.folder)
        batch = dataset.gather(dataset.plan(np.random.default_rng(0), 16))
        device, random = trainer.ranks.device, torch.Generator().manual_seed(0)
        given = trainer._arguments(spec, batch, 16, slice(None), device, random)
        without = Losses(Policy(plain).eval(), device)
        measured = Losses(run.policy, device, outcomes=False)
        # Of a step of the condition, what the pictures show is last, 8 numbers of each: here of the newest step.
        places = {o.key: slice(-8 * (2 - i), -8 * (1 - i) or None) for i, o in enumerate(spec.images)}
        heads = dict(zip(weights, run.policy.outcomes.heads.values(), strict=True))

        def error(key: str) -> torch.Tensor:
            """Of the outcome as one picture predicts it, computed by the test itself."""
            seen = run.policy.encoder.encode(*given[:2], pooled=True)[:, places[key]]
            return (seen @ heads[key].weight.T + heads[key].bias - batch.outcomes).square().mean()

        def check() -> float:
            without.policy.load_state_dict(run.policy.state_dict(), strict=False)
            with torch.no_grad():
                noise, errors = without(*given).item(), {key: error(key).item() for key in weights}
                whole = noise + sum(weight * errors[key] for key, weight in weights.items())
                self.assertAlmostEqual(trainer.losses(*given).item(), whole, places=5)
                self.assertAlmostEqual(measured(*given).item(), noise, places=5)
            return sum(errors.values())

        before = check()
        for key in weights:
            run.optimizer.zero_grad()
            error(key).backward()
            # Only the picture that predicts it learns by it.
            learning = {n for n, weight in run.policy.encoder.images.named_parameters() if weight.grad is not None and weight.grad.any()}
            self.assertEqual(learning, {n for n, _ in run.policy.encoder.images.named_parameters() if n.startswith(f"{key}.")})
        run.optimizer.zero_grad()
        trainer.train()
        run.policy.eval()
        self.assertLess(check(), 0.6 * before)

    def test_the_loss_of_a_transformer_falls(self):
        spec = small("transformer", iterations=250)
        dataset = Dataset(spec, [by_hand(40)])
        run = start(spec, dataset)
        final = Trainer(run, dataset, self.folder).train()
        self.assertLess(final, 0.8 * sum(run.losses[:20]) / 20)

    def test_the_loss_of_a_policy_that_remembers_falls(self):
        spec = with_history(small(iterations=250, precision="bf16", scheduler="constant"))
        dataset = Dataset(spec, [made_up(40)])
        run = start(spec, dataset)
        final = Trainer(run, dataset, self.folder).train()
        self.assertLess(final, 0.85 * sum(run.losses[:20]) / 20)
        # Which steps serve is learned too.
        learned = run.policy.encoder.histories["tactile"]
        moved = learned.places != -torch.tensor(spec.histories[0].ages)
        # Where a history is looked at, its last step is never there.
        self.assertEqual(moved.tolist(), [True, True, True, False])
        self.assertTrue(learned.score.weight.all())

    def test_histories_are_the_same_by_threads_and_after_a_stop(self):
        spec = small("tactile-id-memory", precision="float32")
        dataset = Dataset(spec, [by_hand(40), by_hand(8, 1)])
        through = start(spec, dataset)
        Trainer(through, dataset, self.folder).train()
        stopped = start(spec, dataset)
        self.interrupt(Trainer(stopped, dataset, self.folder, workers=2))
        resumed = start(spec, dataset)
        resumed.load(read_checkpoint(self.folder / CHECKPOINT))
        Trainer(resumed, dataset, self.folder, workers=2).train()
        self.assertEqual(resumed.losses, through.losses)

    def test_dropout_is_resumed_and_measures_nothing(self):
        spec = small("transformer", iterations=6, validate_every=2)
        dataset = Dataset(spec, [by_hand(40)])
        held_out = Dataset(spec, [by_hand(30, 1)], dataset.ranges)
        through = start(spec, dataset)
        Trainer(through, dataset, self.folder).train()
        stopped = start(spec, dataset)
        self.interrupt(Trainer(stopped, dataset, self.folder, held_out=held_out))
        resumed = start(spec, dataset)
        resumed.load(read_checkpoint(self.folder / CHECKPOINT))
        trainer = Trainer(resumed, dataset, self.folder, held_out=held_out)
        trainer.train()
        self.assertEqual(resumed.losses, through.losses)
        trainer._validate(mock.Mock())
        self.assertEqual(resumed.validation[-1][1], resumed.validation[-2][1])

    def test_epochs_are_iterations(self):
        spec = small(epochs=3, windows=8)
        dataset = Dataset(spec, [made_up(40)])
        self.assertEqual(start(spec, dataset).iterations, 15)

    def test_minutes_end_it(self):
        spec = small(iterations=10_000)
        dataset = Dataset(spec, [made_up(40)])
        run = start(spec, dataset)
        Trainer(run, dataset, self.folder, minutes=0.02).train()
        self.assertLess(run.iteration, 10_000)

    def test_a_loss_that_is_no_number_ends_it(self):
        spec = small(iterations=10)
        dataset = Dataset(spec, [made_up(40)])
        dataset.targets[:] = np.nan
        with self.assertRaisesRegex(ValueError, "the loss is not finite in iteration 0"):
            Trainer(start(spec, dataset), dataset, self.folder).train()


class HeldOut(Case):
    def test_the_best_is_kept(self):
        spec = small(iterations=12, validate_every=4, windows=8)
        dataset = Dataset(spec, [made_up(40)])
        held_out = Dataset(spec, [made_up(30, 1)], dataset.ranges)
        losses = iter((0.9, 0.5, 0.7))
        run = start(spec, dataset)
        trainer = Trainer(run, dataset, self.folder, held_out=held_out)
        with mock.patch.object(module, "recent", lambda _: 0.0), mock.patch.object(np, "mean", lambda _: next(losses)):
            trainer.train()
        self.assertEqual(run.validation, [(4, 0.9), (8, 0.5), (12, 0.7)])
        best = read_checkpoint(self.folder / BEST)
        self.assertEqual((best["iteration"], best["provenance"]["validation_loss"]), (8, 0.5))
        self.assertIn("final_loss", best["provenance"])

    def test_measuring_changes_nothing_of_the_training(self):
        found = {}
        for measured in (False, True):
            spec = small(iterations=6, validate_every=2)
            dataset = Dataset(spec, [made_up(40)])
            run = start(spec, dataset)
            held_out = Dataset(spec, [made_up(30, 1)], dataset.ranges) if measured else None
            Trainer(run, dataset, self.folder, held_out=held_out).train()
            found[measured] = run.losses
            if measured:
                # The same windows and noise each time: the loss of the same weights is the same.
                trainer = Trainer(run, dataset, self.folder, held_out=held_out)
                for _ in range(2):
                    trainer._validate(mock.Mock())
                self.assertEqual(run.validation[-1][1], run.validation[-2][1])
        self.assertEqual(found[False], found[True])


class Curves(Case):
    def test_without_tensorboard_there_is_one_warning(self):
        spec = small()
        dataset = Dataset(spec, [made_up(40)])
        with mock.patch.dict(sys.modules, {"torch.utils.tensorboard": None}):
            Trainer(start(spec, dataset), dataset, self.folder).train()
        warned = [call for call in self.printed.call_args_list if "TensorBoard" in str(call)]
        self.assertEqual(len(warned), 1)
        self.assertFalse((self.folder / "tensorboard").exists())

    def test_curves_are_written(self):
        try:
            from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
        except ImportError:
            self.skipTest("tensorboard is not installed: ITS CURVES ARE NOT TESTED")
        spec = small(iterations=20, validate_every=10)
        dataset = Dataset(spec, [made_up(40)])
        held_out = Dataset(spec, [made_up(30, 1)], dataset.ranges)
        run = start(spec, dataset)
        Trainer(run, dataset, self.folder, held_out=held_out).train()
        read = EventAccumulator(str(self.folder / "tensorboard")).Reload()
        self.assertEqual({"loss", "learning_rate", "validation"}, set(read.Tags()["scalars"]))
        self.assertAlmostEqual(read.Scalars("loss")[-1].value, run.losses[-1], places=5)
        self.assertEqual([point.step for point in read.Scalars("validation")], [10, 20])

    def test_the_board_closes_without_a_writer(self):
        with mock.patch.dict(sys.modules, {"torch.utils.tensorboard": None}):
            board = progress.Board(self.folder, 0)
        board.add(1, loss=1.0)
        board.close()


class Interrupted(Case):
    def through(self, workers: int = 0, spec: Experiment | None = None):
        spec = spec or small(iterations=8)
        dataset = Dataset(spec, episodes())
        run = start(spec, dataset)
        Trainer(run, dataset, self.folder, workers=workers).train()
        return spec, dataset, run

    def test_a_stopped_run_continues_as_if_it_had_not_been(self):
        plain = small(iterations=8)
        for workers, asked in ((0, plain), (2, plain), (0, observed(plain, "tactile", outcome=0.5))):
            with self.subTest(workers=workers, outcomes=asked is not plain):
                spec, dataset, through = self.through(workers, asked)
                stopped = start(spec, dataset)
                self.interrupt(Trainer(stopped, dataset, self.folder, workers=workers))
                state = read_checkpoint(self.folder / CHECKPOINT)
                self.assertEqual(state["iteration"], 3)
                self.assertNotIn("final_loss", state["provenance"])
                resumed = start(spec, dataset)
                resumed.load(state)
                Trainer(resumed, dataset, self.folder, workers=workers).train()
                self.assertEqual(resumed.losses, through.losses)
                for whole, again in ((through.policy, resumed.policy), (through.average, resumed.average)):
                    for name, weight in whole.state_dict().items():
                        self.assertTrue(torch.equal(weight, again.state_dict()[name]), name)

    def test_a_signal_ends_it_after_the_iteration(self):
        for number in (signal.SIGTERM, signal.SIGINT):
            with self.subTest(number):
                spec, dataset, through = self.through()
                run = start(spec, dataset)
                handler = signal.getsignal(number)

                def third(*_, run=run, number=number):
                    if run.iteration == 3:
                        os.kill(os.getpid(), number)

                with mock.patch.object(module.Progress, "step", side_effect=third), self.assertRaises(Stopped):
                    Trainer(run, dataset, self.folder).train()
                self.assertEqual(signal.getsignal(number), handler)
                state = read_checkpoint(self.folder / CHECKPOINT)
                self.assertEqual((state["iteration"], state["losses"]), (3, through.losses[:3]))

    def test_checkpoints_are_written_by_the_clock(self):
        saved = []
        spec = small(iterations=4, checkpoint_minutes=1e-9)
        dataset = Dataset(spec, [made_up(40)])
        run = start(spec, dataset)
        with mock.patch.object(module.Run, "save", lambda self, path, **_: saved.append((path.name, self.iteration))):
            Trainer(run, dataset, self.folder).train()
        self.assertEqual(saved, [(CHECKPOINT, i) for i in (1, 2, 3, 4, 4)])

    def test_a_checkpoint_that_cannot_be_written_leaves_the_one_before(self):
        spec, dataset, run = self.through()
        before = (self.folder / CHECKPOINT).read_bytes()
        with mock.patch.object(torch, "save", side_effect=lambda _, file: file.write_bytes(b"half") and 1 / 0):
            with self.assertRaises(ZeroDivisionError):
                run.save(self.folder / CHECKPOINT)
        self.assertEqual((self.folder / CHECKPOINT).read_bytes(), before)


class Safety(Case):
    def test_weights_of_other_networks_are_refused(self):
        run = start(small(), Dataset(small(), episodes()))
        run.save(self.folder / CHECKPOINT)
        state = read_checkpoint(self.folder / CHECKPOINT)
        for weights in ("policy", "average"):
            name, weight = state[weights].popitem()
            with self.assertRaisesRegex(ValueError, f"the checkpoint is of another version .*{name}.*: train again, or use that version"):
                run.load(state)
            state[weights][name] = weight
        run.load(state)

    def test_a_checkpoint_runs_no_code(self):
        mark = self.folder / "ran"

        class Evil:
            def __reduce__(self):
                return (Path.touch, (mark,))

        foreign = self.folder / "foreign.pt"
        torch.save({"experiment": Evil()}, foreign)
        with self.assertRaisesRegex(ValueError, "foreign.pt: not a checkpoint of rapid_policy.train"):
            read_checkpoint(foreign)
        self.assertFalse(mark.exists())
        foreign.write_bytes(pickle.dumps(Evil()))
        with self.assertRaisesRegex(ValueError, "not a checkpoint"):
            read_checkpoint(foreign)
        self.assertFalse(mark.exists())
        with self.assertRaisesRegex(ValueError, "none.pt: "):
            read_checkpoint(self.folder / "none.pt")


@unittest.skipUnless(os.environ.get("RAPID_BIN"), "skipped: no program in $RAPID_BIN, which gives the verdicts")
class CommandLine(Case):
    """The program as people run it, on files; `rapid inspect` is replaced where the files are written by a test."""

    def run_train(self, *words: str, launch: tuple[str, ...] = (sys.executable, "-m"), **environment: str):
        command = [*launch, "rapid_policy.train", *words]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(MODELS), **environment}
        return subprocess.run(
            command, cwd=MODELS, env=environment, capture_output=True, text=True, timeout=400, check=False
        )

    def setUp(self):
        super().setUp()
        # Files of a test are not files of the program: a program that calls them GOOD stands in its place.
        self.judge = self.folder / "rapid"
        self.judge.write_text(
            f"#!{sys.executable}\nimport json, sys\n"
            "for name in sys.argv[4:]:\n    print(json.dumps({'file': name, 'verdict': 'GOOD', 'reasons': []}))\n"
        )
        self.judge.chmod(0o755)
        self.data = self.folder / "data"
        self.data.mkdir()
        for i in range(3):
            opening = np.linspace(0, 1, 25)
            written.by_hand(self.data / f"{i}.mcap", path(25, i), opening, tags={"seed": str(i)}, modules=("handheld",))
        self.experiment = self.folder / "small.toml"
        text = (MODELS / "experiments" / "tactile-id.toml").read_text(encoding="utf-8")
        for before, after in (
            ("width = 16", "width = 8"),
            ("widths = [32, 64, 128]", "widths = [8, 16]"),
            ("iterations = 12000", 'iterations = 10\nprecision = "float32"\nwarmup = 1'),
            ("windows = 64", "windows = 8"),
        ):
            self.assertIn(before, text)
            text = text.replace(before, after)
        self.experiment.write_text(text, encoding="utf-8")

    def words(self, run: str, *more: str) -> list[str]:
        words = [str(self.experiment), "--data", str(self.data), "--out", str(self.folder / run)]
        return [*words, "--threads", "1", *more]

    def test_two_processes_learn_as_one(self):
        alone = self.run_train(*self.words("one"), RAPID_BIN=str(self.judge))
        self.assertEqual(alone.returncode, 0, alone.stderr)
        launch = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m")
        both = self.run_train(*self.words("two", "--device", "cpu"), launch=launch, RAPID_BIN=str(self.judge))
        self.assertEqual(both.returncode, 0, both.stderr)
        one, two = (read_checkpoint(self.folder / name / CHECKPOINT) for name in ("one", "two"))
        self.assertEqual(len(two["losses"]), 10)
        np.testing.assert_allclose(one["losses"], two["losses"], atol=1e-3)
        weights = [torch.cat([w.flatten() for w in state["policy"].values()]) for state in (one, two)]
        self.assertLess(float((weights[0] - weights[1]).abs().mean()), 2e-5)
        self.assertEqual(two["provenance"]["hardware"], "2 processes, each 1 CPU thread")

    def test_the_first_of_two_processes_evaluates(self):
        line = {"event": "condition", "condition": "full", "success": 1, "trials": 2, "score": 0.5, "interval": [0.1, 0.9]}
        rapid, calls = self.folder / "evaluates", self.folder / "calls"
        rapid.write_text(
            f'#!/bin/sh\nif [ $1 = inspect ]; then exec {self.judge} "$@"; fi\n'
            f'echo "$@" >>{calls}\necho \'{json.dumps(line)}\'\n'
        )
        rapid.chmod(0o755)
        launch = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m")
        evaluated = ("--rapid", str(rapid), "--evaluate-every", "10", "--evaluate-trials", "2")
        done = self.run_train(*self.words("run", "--device", "cpu", *evaluated), launch=launch)
        self.assertEqual(done.returncode, 0, done.stderr)
        self.assertIn("tactile-id: 10/10 success 0.50 (0.10 to 0.90), 1 of 2 trials, the best", done.stdout)
        self.assertEqual(len(calls.read_text().splitlines()), 1)
        other = ("--rapid", str(rapid), "--evaluate-every", "10", "--evaluate-trials", "3", "--resume")
        refused = self.run_train(*self.words("run", "--device", "cpu", *other))
        self.assertRegex(refused.stderr, "(?m)^train: --evaluate-trials 3: .*: write --evaluate-trials 2, or use another --out$")
        self.assertEqual(read_checkpoint(self.folder / "run" / BEST_SUCCESS)["iteration"], 10)

    def test_a_run_is_resumed_and_exported(self):
        first = self.run_train(*self.words("run"), RAPID_BIN=str(self.judge))
        self.assertEqual(first.returncode, 0, first.stderr)
        self.assertIn("3 episodes, 72 windows", first.stdout)
        again = self.run_train(*self.words("run", "--resume"), RAPID_BIN=str(self.judge))
        self.assertEqual(again.returncode, 0, again.stderr)
        self.assertIn("after 10 iterations", again.stdout)
        self.experiment.write_text(self.experiment.read_text().replace("[8, 16]", "[8, 8]"))
        changed = self.run_train(*self.words("run", "--resume"), RAPID_BIN=str(self.judge))
        self.assertRegex(changed.stderr, "train: .*small.toml: denoiser: not as in .*checkpoint.pt: use another --out")
        text = self.experiment.read_text().replace("[8, 8]", "[8, 16]")
        self.experiment.write_text(re.sub("(?m)^outcome = .*$", "", text), encoding="utf-8")
        changed = self.run_train(*self.words("run", "--resume"), RAPID_BIN=str(self.judge))
        self.assertRegex(changed.stderr, "train: .*small.toml: observation: not as in .*checkpoint.pt: use another --out")
        self.experiment.write_text(text.replace("[data]\n", '[data]\nabsences = ["unplug"]\n'))
        changed = self.run_train(*self.words("run", "--resume"), RAPID_BIN=str(self.judge))
        self.assertRegex(changed.stderr, "train: .*small.toml: data.absences: not as in .*checkpoint.pt: use another --out")
        from rapid_policy.export import export

        export(read_checkpoint(self.folder / "run" / CHECKPOINT), self.folder / "bundle")
        described = json.loads((self.folder / "bundle" / "policy.json").read_text())
        (state,) = [o for o in described["observations"] if o["kind"] == "vector"]
        self.assertEqual((state["modality"], state["slice"], state["shape"]), ("arm", [0, 4], [4]))
        self.assertEqual(described["action"]["representation"], "absolute")
        self.assertNotIn("rotation", described["action"])

    def test_a_training_begins_with_the_weights_of_another(self):
        from rapid_policy.export import export

        judge = {"RAPID_BIN": str(self.judge)}
        self.assertEqual(self.run_train(*self.words("first"), **judge).returncode, 0)
        bundle, first = self.folder / "bundle", read_checkpoint(self.folder / "first" / CHECKPOINT)
        export(first, bundle)
        start = ("--start-from", str(bundle))
        # Before any episode is read.
        refused = self.run_train(*self.words("second", "--start-from", str(self.folder / "none")), RAPID_BIN="/bin/false")
        self.assertRegex(refused.stderr, r"^train: .*/none/policy.json: No such file or directory: name the folder of a bundle\n$")
        begun = self.run_train(*self.words("second", *start, "--iterations", "3", "--minutes", "9"), **judge)
        self.assertEqual(begun.returncode, 0, begun.stderr)
        resumed = self.run_train(*self.words("second", "--resume"), **judge)
        self.assertEqual(resumed.returncode, 0, resumed.stderr)
        both = self.run_train(*self.words("second", "--resume", *start), **judge)
        self.assertRegex(both.stderr, "^train: --start-from: a training that is resumed has begun: leave it out, or leave --resume out\n$")
        second = read_checkpoint(self.folder / "second" / CHECKPOINT)
        self.assertLess(second["losses"][0], first["losses"][0])
        command = "python -m rapid_policy.train experiments/small.toml --data EPISODES --out RUN"
        export(second, self.folder / "again")
        card = (self.folder / "again" / "README.md").read_text(encoding="utf-8")
        commands = [line.strip() for line in card.splitlines() if "rapid_policy." in line]
        exports = [f"python -m rapid_policy.export RUN/checkpoint.pt --out {name}" for name in ("BUNDLE", "tactile-id")]
        trainings = [f"{command} --seed 0", f"{command} --iterations 3 --minutes 9 --start-from BUNDLE --seed 0"]
        self.assertEqual(commands, [trainings[0], exports[0], trainings[1], exports[1]])
        self.assertIn("| First weights | those of `tactile-id` of 10 iterations, seed 0, SHA-256", card)

    def test_sigterm_leaves_a_checkpoint_to_continue_from(self):
        command = [sys.executable, "-m", "rapid_policy.train", *self.words("run", "--iterations", "100000")]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "RAPID_BIN": str(self.judge), "PYTHONUNBUFFERED": "1"}
        running = subprocess.Popen(
            command, cwd=MODELS, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        # Whatever happens, it does not outlive the test.
        guard = threading.Timer(300, running.kill)
        guard.start()
        self.addCleanup(guard.cancel)
        for line in running.stdout:
            if "100/100000" in line:
                break
        running.terminate()
        _, errors = running.communicate()
        self.assertRegex(errors, r"train: stopped after \d+ iterations; --resume continues from")
        self.assertEqual(running.returncode, 1)
        state = read_checkpoint(self.folder / "run" / CHECKPOINT)
        self.assertGreaterEqual(state["iteration"], 100)
        self.assertEqual(len(state["losses"]), state["iteration"])

    def test_damaged_and_unfit_episodes_are_left_out_with_the_reason(self):
        (self.data / "cut.mcap").write_bytes((self.data / "0.mcap").read_bytes()[:-500])
        strange = {"phone": ("rapid.Scalars", [{"values": [1.0] * 12}] * 20)}
        written.write(self.data / "other-rig.mcap", strange)
        done = self.run_train(*self.words("run"), RAPID_BIN=str(self.judge))
        self.assertEqual(done.returncode, 0, done.stderr)
        self.assertRegex(done.stderr, "cut.mcap: left out, not a whole episode")
        self.assertRegex(done.stderr, "other-rig.mcap: left out, no modality 'gripper'; it has phone")
        self.assertIn("3 episodes to learn from, 0 held out, 2 left out, 0 not asked for", done.stderr)
        for file in "012":
            (self.data / f"{file}.mcap").unlink()
        none = self.run_train(*self.words("none"), RAPID_BIN=str(self.judge))
        self.assertEqual(none.returncode, 1)
        self.assertRegex(
            none.stderr, "no episode that is fit to learn from: 2 left out, 0 not asked for; the first: .*cut.mcap"
        )

    def test_mistakes_of_the_command_line(self):
        self.experiment.write_text(self.experiment.read_text().replace("horizon = 16", "horizont = 16"))
        done = self.run_train(*self.words("run"))
        self.assertEqual((done.returncode, done.stderr.count("\n")), (1, 1))
        self.assertRegex(done.stderr, "^train: .*small.toml: policy.horizont: unknown: write horizon, or remove it")


if __name__ == "__main__":
    unittest.main()
