"""Files of experiments: those of the repository, and each mistake of one with its message.

The first lines of a file in `experiments/` are the messages about it, without the name of the file.
"""

import json
import tempfile
import unittest
from pathlib import Path

from made_up import EXPERIMENTS, POLICIES, experiment, small

from rapid_policy.experiment import Denoiser, Experiment
from rapid_policy.experiment_file import ExperimentError, read_experiment

MISTAKES = Path(__file__).parent / "experiments"


class Mistakes(unittest.TestCase):
    def test_every_mistake_has_file_key_cause_and_fix(self):
        files = sorted(MISTAKES.glob("*.toml"))
        self.assertGreater(len(files), 40)
        for file in files:
            lines = file.read_text(encoding="utf-8").splitlines()
            head = lines[: [line.startswith("# ") for line in lines].index(False)]
            expected = [f"{file}: {line.removeprefix('# ').replace('FOLDER', str(MISTAKES))}" for line in head]
            with self.subTest(file.stem):
                with self.assertRaises(ExperimentError) as raised:
                    read_experiment(file)
                self.assertEqual(str(raised.exception).splitlines(), expected)

    def test_what_is_no_file_is_named(self):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "none.toml"
            with self.assertRaisesRegex(ExperimentError, "none.toml: cannot be read: No such file"):
                read_experiment(path)
            path.write_bytes(b"\xff\xfe\x00")
            with self.assertRaisesRegex(ExperimentError, "none.toml: not text"):
                read_experiment(path)


class Ours(unittest.TestCase):
    def test_every_experiment_of_the_repository_is_right(self):
        names = {path.stem: read_experiment(path).name for path in POLICIES}
        self.assertTrue({"tactile-id-arm", "tactile-id", "vision", "vision-mask"} <= set(names))
        for file, name in names.items():
            self.assertEqual(file, name)

    def test_folders_are_relative_to_the_file(self):
        (folder,) = experiment().data.folders
        self.assertEqual(folder, str(EXPERIMENTS.parent / "runs" / "arm-480-1000"))

    def test_a_transformer_takes_any_horizon_and_has_defaults(self):
        described = json.loads(experiment("transformer", policy={"horizon": 15}).to_text())
        described["denoiser"] = {"type": "transformer"}
        denoiser = Experiment.from_text(json.dumps(described)).denoiser
        sizes = {"type": "transformer", "layers": 4, "heads": 4, "width": 128, "dropout": 0.1}
        self.assertEqual(denoiser.sizes(), sizes)

    def test_what_is_written_of_a_denoiser_is_read_again(self):
        for sizes in ({}, {"widths": [8, 16]}, {"type": "transformer"}, {"type": "transformer", "width": 64}):
            denoiser = Denoiser.model_validate_json(json.dumps(sizes))
            self.assertEqual(Denoiser.model_validate_json(json.dumps(denoiser.sizes())), denoiser)

    def test_a_checkpoint_brings_its_description_back(self):
        for path in POLICIES:
            spec = read_experiment(path)
            again = Experiment.from_text(spec.to_text())
            self.assertEqual(again, spec)
            self.assertIsNone(spec.learns_the_same(again))
        self.assertEqual(experiment().learns_the_same(small()), "encoder")
        self.assertEqual(experiment(data={"absences": ["unplug"]}).learns_the_same(experiment()), "data.absences")


if __name__ == "__main__":
    unittest.main()
