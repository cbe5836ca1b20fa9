"""The classifier of textures: its experiment, each mistake of one, and what it does with pictures that differ."""

import argparse
import json
import tempfile
import tomllib
import unittest
from pathlib import Path

import numpy as np
import torch
from made_up import CLASSIFIERS, MODELS, made_up

from rapid_policy.classification import Classification
from rapid_policy.episodes import Episode, Facts, sources
from rapid_policy.experiment_file import ExperimentError, read_classification, read_experiment
from texture import Training, asked, cross_validate, gather, in_contact, inputs, markdown

(FILE,) = CLASSIFIERS
TOUCHED = 20


def touching(seed: int, texture: str) -> Episode:
    """Forty pictures, of a touch from the twentieth on, that are brighter at the left or at the top."""
    episode, random = made_up(40, seed), np.random.default_rng(seed)
    pictures = random.integers(100, 104, (40, 96, 96, 3))
    half = np.zeros((96, 96, 1), int)
    half[(slice(None), slice(48)) if texture == "triangular" else slice(48)] = 60
    pictures[TOUCHED:] += half
    arrays = {**episode.arrays, "value tactile_tip": pictures.astype(np.uint8)}
    return Episode(episode.path, Facts(tags={"texture": texture}), arrays, episode.sha256)


def options(**given) -> argparse.Namespace:
    return argparse.Namespace(**{"encoder": None, "folds": None, "iterations": None, "seed": None, **given})


class Experiments(unittest.TestCase):
    def test_that_of_the_repository_is_right(self):
        spec = read_classification(FILE)
        self.assertEqual(spec.name, FILE.stem)
        self.assertEqual([o.modality for o in spec.input], ["tactile_tip", "tactile_tip", "cam_wrist"])
        self.assertEqual({source.name for source in sources(spec)}, {"tactile_tip", "cam_wrist"})
        self.assertTrue(spec.data.folders[0].endswith("models/runs/arm-480-1000"))

    def test_it_learns_from_what_the_policy_with_an_arm_learns_from(self):
        policy = read_experiment(FILE.with_name("tactile-id-arm.toml"))
        spec = read_classification(FILE)
        self.assertEqual((spec.data, spec.encoder), (policy.data, policy.encoder))

    def test_every_mistake_has_file_key_cause_and_fix(self):
        text = FILE.read_text(encoding="utf-8")
        for given, instead, expected in (
            ('input = "difference"', 'input = "tactile"', "contact.input: 'tactile' is not an input that is a difference: write one of them: difference"),
            ("folds = 10", "folds = 1", "test.folds: 1: input should be greater than or equal to 2: write for example folds = 10 "
             "(parts of the episodes, each tested by a classifier trained on the others)"),
            ("pictures = 64", "windows = 64", "training.windows: unknown: remove it; there are iterations, pictures, learning_rate, seed"),
            ('key = "wrist"', 'key = "tactile"', "input.tactile.key: 'tactile' is taken: give each input a name of its own"),
            ('title = "wrist camera"', 'title = "w"\ndropout = { window = 0.3 }\nrequired = false',
             "input.wrist.dropout: of no use to a classifier of single pictures: remove it"),
            ("augmentation = { shift = 4 }", "augmentation = { shift = 3 }",
             "input.difference.augmentation.shift: 3: the encoder sees the picture at a half: write a multiple of 2"),
        ):  # fmt: skip
            with self.subTest(instead), tempfile.TemporaryDirectory() as folder:
                self.assertIn(given, text)
                file = Path(folder) / "texture.toml"
                file.write_text(text.replace(given, instead, 1), encoding="utf-8")
                with self.assertRaises(ExperimentError) as raised:
                    read_classification(file)
                self.assertEqual(str(raised.exception), f"{file}: {expected}")

    def test_an_experiment_of_a_policy_is_none_of_a_classifier(self):
        for read, file in ((read_classification, FILE.with_name("vision.toml")), (read_experiment, FILE)):
            with self.assertRaisesRegex(ExperimentError, "format: .* write for example format = \"rapid-"):
                read(file)

    def test_options_are_in_place_of_what_it_says(self):
        spec = read_classification(FILE)
        self.assertEqual(asked(spec, options()), spec)
        changed = asked(spec, options(encoder="resnet18", folds=3, iterations=7, seed=5))
        self.assertEqual((changed.encoder.type, changed.test.folds), ("resnet18", 3))
        self.assertEqual((changed.training.iterations, changed.training.seed), (7, 5))
        self.assertEqual(changed.training.pictures, spec.training.pictures)

    def test_inputs_are_chosen_by_key_in_the_order_of_the_experiment(self):
        spec = read_classification(FILE)
        self.assertEqual(inputs(spec, None), list(spec.input))
        self.assertEqual([o.key for o in inputs(spec, ["wrist", "tactile", "wrist"])], ["tactile", "wrist"])
        with self.assertRaises(ExperimentError) as raised:
            inputs(spec, ["tactile", "finger"])
        self.assertEqual(
            str(raised.exception),
            "--input finger: the experiment has no such input: write one of them: difference, tactile, wrist",
        )

    def test_an_episode_without_the_label_is_unfit(self):
        spec = read_classification(FILE)
        self.assertIsNone(spec.unfit({"texture": "hexagonal"}))
        for tags in ({}, {"texture": "smooth"}):
            self.assertEqual(spec.unfit(tags), "no tag `texture` of triangular or hexagonal")


class Trained(unittest.TestCase):
    def setUp(self):
        table = tomllib.loads(FILE.read_text(encoding="utf-8"))
        table["training"] |= {"iterations": 60, "pictures": 32}
        table["test"] |= {"folds": 2, "noises": [0.0, 0.02], "pressures": 2}
        self.spec = Classification.model_validate_json(json.dumps(table))
        textures = self.spec.label.values * 3
        self.episodes = [touching(seed, texture) for seed, texture in enumerate(textures)]
        self.labels = [self.spec.label_of(e.facts.tags) for e in self.episodes]
        self.contact = [in_contact(self.spec, e) for e in self.episodes]

    def gathered(self, o):
        return gather(self.spec, o, self.episodes, self.labels, self.contact)

    def test_pictures_of_a_touch_are_those_that_changed(self):
        for contact in self.contact:
            self.assertEqual(np.flatnonzero(contact).tolist(), [*range(TOUCHED, 40)])
        pictures = self.gathered(self.spec.touched)
        # Half of 96 pixels, and a margin for shifts of 4 of them on each side.
        self.assertEqual(pictures.pixels.shape, (6 * 20, 3, 52, 52))

    def test_the_experiment_decides_how_it_is_trained_and_tested(self):
        torch.set_num_threads(1)
        row = cross_validate(self.gathered(self.spec.touched), Training(self.spec, self.spec.touched, torch.device("cpu")))
        self.assertGreater(row["accuracy"], 0.9)
        self.assertEqual(list(row["accuracy_by_noise"]), ["0.0", "0.02"])
        self.assertEqual((row["pictures"], row["episodes"], len(row["accuracy_by_pressure"])), (120, 6, 2))


class Pages(unittest.TestCase):
    def test_those_in_the_repository_are_of_their_figures(self):
        pages = [file.with_suffix("") for file in (MODELS / "results").glob("texture*.md")]
        self.assertIn(MODELS / "results" / "texture", pages)
        for page in pages:
            report = json.loads(page.with_suffix(".json").read_text(encoding="utf-8"))
            self.assertEqual(page.with_suffix(".md").read_text(encoding="utf-8"), markdown(report, f"{page.name}.png"))


if __name__ == "__main__":
    unittest.main()
