"""What export_lerobot.py refuses, and in which words (`make lerobot-test`)."""

import shutil
import tempfile
import unittest
from pathlib import Path

from lerobot_checkpoints import STATE, TOP, Case, Temporary, run, write


class Refusals(Temporary):
    """What cannot be exported is refused in words that name the key."""

    @classmethod
    def setUpClass(cls):
        cls.whole = Path(tempfile.mkdtemp()) / "checkpoint"
        cls.addClassCleanup(shutil.rmtree, cls.whole.parent)
        write(Case(), cls.whole)

    def refused(self, words: list[str], *arguments) -> None:
        done = run(self.source, self.bundle, *(arguments or ("--hz", 10)))
        self.assertEqual(done.status, 1)
        for word in words:
            self.assertIn(word, done.complaint)
        self.assertFalse(self.bundle.exists())
        shutil.rmtree(self.source)

    def changed(self, change, *words: str, file: str = "config.json") -> None:
        """The checkpoint with its configuration changed is refused with these words."""
        with self.subTest(words[0]):
            shutil.copytree(self.whole, self.source)
            self.edit(self.source / file, change)
            self.refused([file, *words])

    def test_configuration(self):
        picture = {"type": "VISUAL", "shape": [3, 64, 64]}
        more = {"observation.images.b": picture, "observation.images.c": picture}
        env = {"observation.environment_state": {"type": "ENV", "shape": [9]}}
        self.changed(lambda c: c.update(type="act"), "type:", '"act" is not supported')
        self.changed(lambda c: c["input_features"].update(more), "input_features:", "3 cameras")
        self.changed(lambda c: c["input_features"].pop(TOP), "input_features:", "0 cameras")
        self.changed(lambda c: c["input_features"].update(env), "input_features.observation.environment_state")
        self.changed(lambda c: c["input_features"].pop(STATE), f"input_features.{STATE}: missing")
        self.changed(lambda c: c["input_features"][TOP].update(shape=[1, 64, 64]), f"input_features.{TOP}.shape")
        self.changed(
            lambda c: c["input_features"].update({"observation.state_mask": picture | {"type": "LANGUAGE"}}),
            "input_features.observation.state_mask",
            "LANGUAGE",
        )
        self.changed(
            lambda c: c["input_features"].update({"observation.images.mask": picture}),
            "input_features.observation.images.mask",
            "the mask has the name mask",
        )
        self.changed(
            lambda c: c.update(output_features={"pose": {"type": "ACTION", "shape": [3]}}), "output_features.action"
        )
        self.changed(lambda c: c.update(n_action_steps=16), "n_action_steps: 16 is more than", "15")
        self.changed(lambda c: c.update(beta_schedule="sigmoid"), 'beta_schedule: "sigmoid"')
        self.changed(lambda c: c.update(use_peft=True), "use_peft")
        self.changed(lambda c: c.update(of_a_later_version=1), "LeRobot cannot read it", "of_a_later_version")

    def test_weights_of_another_configuration(self):
        shutil.copytree(self.whole, self.source)
        self.edit(self.source / "config.json", lambda c: c.update(down_dims=[32, 96]))
        self.refused(["the weights do not fit config.json"])

    def test_files_that_are_cut_off(self):
        for file, words in (
            ("model.safetensors", ["the weights do not fit config.json"]),
            (
                "policy_preprocessor_step_3_normalizer_processor.safetensors",
                ["policy_preprocessor.json", "cannot load"],
            ),
            ("config.json", ["config.json"]),
        ):
            with self.subTest(file):
                shutil.copytree(self.whole, self.source)
                content = (self.source / file).read_bytes()
                (self.source / file).write_bytes(content[: len(content) // 2])
                self.refused(words)

    def test_processors(self):
        shutil.copytree(self.whole, self.source)
        (self.source / "policy_preprocessor.json").unlink()
        self.refused(["policy_preprocessor.json: missing", "migrate_policy_normalization"])
        shutil.copytree(self.whole, self.source)
        (self.source / "policy_postprocessor_step_0_unnormalizer_processor.safetensors").unlink()
        self.refused(["policy_postprocessor.json", "LeRobot cannot load it"])
        step = {"registry_name": "relative_actions_processor", "config": {}}
        self.changed(
            lambda c: c["steps"].insert(2, step),
            "steps[2].registry_name: relative_actions_processor",
            file="policy_preprocessor.json",
        )
        self.changed(lambda c: c["steps"].pop(0), "no unnormalizer_processor", file="policy_postprocessor.json")

    def test_statistics(self):
        write(Case(stats={STATE: {"min": [0.0, 0.0, 0.5, 0.0, 0.0], "max": [1.0, 1.0, 0.5, 1.0, 1.0]}}), self.source)
        self.refused([f"{STATE}, dimension 2", "min = 0.5 and max = 0.5"])
        write(Case(stats={STATE: {"max": [1.0, float("nan"), 1.0, 1.0, 1.0]}}), self.source)
        self.refused([f"max of {STATE}, dimension 1: nan"])

    def test_umi(self):
        for files in (
            {".hydra/config.yaml": "a: 1"},
            {"checkpoints/latest.ckpt": ""},
            {"config.json": '{"_target_": "diffusion_policy.workspace.Workspace", "shape_meta": {}}'},
        ):
            with self.subTest(str(files)):
                for name, text in files.items():
                    file = self.source / name
                    file.parent.mkdir(parents=True, exist_ok=True)
                    file.write_text(text)
                self.refused(["a checkpoint of UMI", "export_umi_policy.py"])
        done = run(self.folder / "latest.ckpt", self.bundle, "--hz", 10)
        self.assertIn("UMI", done.complaint)

    def test_arguments(self):
        for arguments, words in (
            ((), ["--hz", "--dataset"]),
            (("--hz", 10, "--modality", "observation.image.top=cam"), ["observation.image.top=cam", TOP]),
            (("--hz", 10, "--required", TOP), ["--required", "--mask-aware"]),
            (("--hz", 10, "--action-names", "x,y"), ["2 action names", "3 values"]),
            (("--hz", 10, "--steps", 101), ["101 inference steps"]),
            (("--dataset", "/nowhere"), ["/nowhere", "LeRobotDataset"]),
        ):
            with self.subTest(str(arguments)):
                shutil.copytree(self.whole, self.source)
                self.refused(words, *(arguments or ("--name", "x")))
        self.bundle.mkdir()
        self.assertIn("exists already", run(self.whole, self.bundle, "--hz", 10).complaint)


if __name__ == "__main__":
    unittest.main()
