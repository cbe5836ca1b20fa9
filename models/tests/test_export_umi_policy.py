"""export_umi_policy.py on checkpoints of UMI's layout, against what UMI's own code computed (see umi_checkpoints)."""

from __future__ import annotations

import gzip
import json
import os
import subprocess
import unittest
from typing import Any

import numpy as np
import onnx
import torch
from umi_checkpoints import (
    FOLDER,
    RIG,
    Temporary,
    features,
    golden,
    noise,
    pictures,
    run,
    value,
    weights,
)

from policy_export import runtime
from policy_export.runtime import Bundle, vector
from policy_export.umi import backbones, checkpoint, networks, verify
from policy_export.umi import config as checkpoint_config
from policy_export.verify import Mismatch
from rapid_policy import poses

TOLERANCE = 1e-4
BEGIN = "--start-rotation={},{},{},{}"


class Equals(Temporary):
    """What UMI computes, the bundle computes: condition, actions, executed poses."""

    def check(self, name: str, *arguments: str) -> dict[str, Any]:
        case = golden(name)
        self.write(case)
        done = run(self.file, self.bundle, *RIG, *(arguments or (BEGIN.format(*case["start"]),)))
        self.assertEqual(done.status, 0, done.complaint)
        self.assertEqual(done.out.count("largest difference from UMI's networks"), 4)
        self.assertEqual(sorted(os.listdir(self.folder)), ["bundle", "latest.ckpt"], "nothing else is left behind")
        bundle = Bundle(self.bundle)
        raw = self.samples(case, bundle)
        given = {}
        for spec in bundle.spec["observations"]:
            found = np.float32(raw[spec["key"]])
            given[spec["key"]] = found / np.float32(255) if spec["kind"] == "image" else vector(spec, found)
        self.close(bundle.condition(given, None)[0], case["condition"])
        count = bundle.spec["n_action_steps"]
        _, actions = bundle.act(raw, None, noise(), lambda: self.fail("DDIM draws no noise"))
        self.close(actions[0], case["actions"][:count])
        self.close(turned(bundle.compose(actions[0], np.array(case["arm"][-1]))), turned_back(case["executed"][:count]))
        self.shown(bundle.spec)
        return bundle.spec

    def samples(self, case: dict[str, Any], bundle: Bundle) -> dict[str, np.ndarray]:
        """Samples of all steps, [1, To, ...] by key."""
        steps, arm, seen = bundle.spec["n_obs_steps"], np.array(case["arm"]), pictures(case)
        # Two or more numbers that are none of it, and the rotation, wherever its columns are.
        first = next((spec["slice"][0] for spec in bundle.spec["observations"] if spec["key"] == "start_rotation"), 2)
        begun = np.tile([*[9.0] * first, *case["start"]], (steps, 1))
        found = {spec["key"]: arm for spec in bundle.spec["observations"]} | {"start_rotation": begun} | seen
        # At the steps at which a camera is not seen there is something else.
        return {key: np.concatenate([v[:1] // 2] * (steps - len(v)) + [v])[None] for key, v in found.items()}

    def close(self, found: np.ndarray, expected: Any) -> None:
        self.assertLessEqual(np.abs(found - np.array(expected)).max(), TOLERANCE)

    def shown(self, spec: dict[str, Any]) -> None:
        """The program takes it."""
        if not (rapid := os.environ.get("RAPID_BIN")):
            return
        done = subprocess.run([rapid, "policy", "show", self.bundle], capture_output=True, text=True, check=False)
        self.assertEqual(done.returncode, 0, done.stderr)
        for observation in spec["observations"]:
            self.assertIn(observation["key"], done.stdout)

    def test_resnet_relative(self) -> None:
        spec = self.check("resnet")
        vectors = [observation for observation in spec["observations"] if observation["kind"] == "vector"]
        self.assertEqual([o["slice"] for o in vectors], [[0, 3], [3, 7], [7, 8]])
        self.assertEqual([o.get("rotation") for o in vectors], [None, "rotation_6d", None])
        self.assertEqual({o["modality"] for o in vectors}, {"arm"})
        action = spec["action"]
        self.assertEqual((action["representation"], action["rotation"]), ("relative", "rotation_6d"))
        self.assertEqual(action["base"], {"modality": "arm", "position": [0, 3], "rotation": [3, 7]})
        self.assertEqual(action["limits"]["max"][:7], [2.0] * 3 + [1.0] * 4)
        stats = golden("resnet")["normalizer"]["normalizer.params_dict.action.input_stats.max"]
        self.assertAlmostEqual(action["limits"]["max"][7], stats[9], places=6)
        self.assertEqual((spec["action_start"], spec["n_action_steps"], spec["horizon"]), (0, 8, 16))
        self.assertEqual(
            spec["scheduler"],
            {
                "type": "DDIM",
                "num_train_timesteps": 50,
                "beta_schedule": "squaredcos_cap_v2",
                "beta_start": 0.0001,
                "beta_end": 0.02,
                "prediction_type": "epsilon",
                "clip_sample": True,
                "clip_sample_range": 1.0,
                "set_alpha_to_one": True,
                "steps_offset": 0,
                "timestep_spacing": "leading",
                "num_inference_steps": 16,
            },
        )

    def test_batch_norm_two_cameras_absolute(self) -> None:
        spec = self.check("shared")
        self.assertEqual(spec["action"]["representation"], "absolute")
        self.assertNotIn("base", spec["action"])
        self.assertEqual([o["key"] for o in spec["observations"]][:2], ["camera0_rgb", "camera1_rgb"])

    def test_vit_with_the_start_from_a_sensor(self) -> None:
        spec = self.check(
            "vit", "--start-columns", "home.2-5", "--picture", "320x256", "--modality", "camera0_rgb=wrist"
        )
        self.assertEqual(spec["observations"][-1]["modality"], "home")
        self.assertEqual(spec["observations"][-1]["slice"], [2, 6])
        self.assertNotIn("operation", spec["observations"][-1])
        camera = spec["observations"][0]
        self.assertEqual((camera["modality"], camera["resize"], camera["crop"]), ("wrist", [224, 280], [224, 224]))

    def test_the_start_is_the_first_pose_of_the_run(self) -> None:
        start = self.check("resnet", "--name", "cup")["observations"][-1]
        self.assertEqual((start["modality"], start["slice"], start["operation"]), ("arm", [3, 7], "first_of_run"))


def turned(executed: np.ndarray) -> np.ndarray:
    """Executed actions, with matrices in place of quaternions: of those two are the same rotation."""
    found = poses.matrices(np.float64(executed[:, :7]), "quaternion")[0]
    return np.concatenate([found[:, :3].reshape(-1, 12), executed[:, 7:]], 1)


def turned_back(executed: list[list[float]]) -> np.ndarray:
    """The same of rotation vectors, as UMI has them."""
    found = np.array(executed)
    angle = np.linalg.norm(found[:, 3:6], axis=1, keepdims=True)
    four = np.concatenate([found[:, 3:6] / angle * np.sin(angle / 2), np.cos(angle / 2)], 1)
    return turned(np.concatenate([found[:, :3], four, found[:, 6:]], 1))


class Parts(unittest.TestCase):
    """Networks that are too large for a test in whole, at a small size."""

    def check(self, name: str, module: torch.nn.Module, compute: Any) -> None:
        expected = golden("parts")[name]
        self.assertEqual({k: list(v.shape) for k, v in module.state_dict().items()}, expected["layout"])
        module.load_state_dict({k: value(k, shape) for k, shape in expected["layout"].items()})
        with torch.no_grad():
            found = compute(module.eval()).numpy().ravel()
        self.assertLessEqual(np.abs(found - np.array(expected["features"])).max(), TOLERANCE)

    def test_backbones(self) -> None:
        picture = features(3, 2, 3, 32, 32)
        for clip in (True, False):
            self.check("clip" if clip else "vit", backbones.ViT(32, 8, 64, 2, 4, clip), lambda net: net(picture))
        self.check("convnext", backbones.convnext((8, 16, 24, 32), (1, 1, 2, 1)), lambda net: net(picture))

    def test_aggregations(self) -> None:
        for kind in checkpoint_config.AGGREGATIONS:
            with self.subTest(kind):
                part = networks.Aggregation(kind, 2, 512)
                self.check(kind, part, lambda part: part.aggregate(features(4, 2, 512, 2, 2))[:, :64])

    def test_sizes(self) -> None:
        for name, side, ratio, width in (
            ("resnet34.a1_in1k", 64, 16, 256),
            ("vit_base_patch16_clip_224.openai", 224, 32, 768),
            ("vit_small_patch16_224", 224, 32, 384),
            ("convnext_base.clip_laion2b_augreg_ft_in12k", 224, 32, 1024),
        ):
            self.assertEqual(backbones.make(name, side, ratio, True)[1], width)


class File(Temporary):
    """The file as UMI writes it is read, and no other."""

    def test_original(self) -> None:
        self.file.write_bytes(gzip.decompress((FOLDER / "original.ckpt.gz").read_bytes()))
        cfg, found = checkpoint.read(self.file)
        self.assertEqual({name: list(state) for name, state in found.items()}, dict.fromkeys(found, ["weight", "bias"]))
        self.assertEqual(list(found), ["model", "ema_model"])
        config = checkpoint_config.read(self.file, cfg)
        self.assertEqual((config.side, config.weights, config.vision.crop), (224, "ema_model", 212))
        self.assertEqual(cfg["task"]["shape_meta"]["obs"]["camera0_rgb"]["shape"], [3, 224, 224])
        json.dumps(cfg, allow_nan=False)

    def test_code_is_not_run(self) -> None:
        mark = self.folder / "mark"

        class Evil:
            def __reduce__(self) -> Any:
                return os.mkdir, (str(mark),)

        torch.save({"cfg": Evil(), "state_dicts": {}}, self.file)
        self.refused("posix.mkdir", "not safe")
        self.assertFalse(mark.exists())

    def test_what_is_no_checkpoint(self) -> None:
        self.file.write_bytes(b"text")
        self.refused("not a file of torch.save")
        torch.save({"weight": torch.zeros(1)}, self.file)
        self.refused("no cfg and state_dicts")
        torch.save({"cfg": [1], "state_dicts": {}}, self.file)
        self.refused("cfg: not a table of keys")
        loop: list[Any] = []
        loop.append(loop)
        torch.save({"cfg": {"a": loop}, "state_dicts": {}}, self.file)
        self.refused("cfg: not a configuration of OmegaConf")
        self.file.unlink()
        self.refused("neither a file *.ckpt nor a folder")

    def test_folder_of_a_training(self) -> None:
        file = self.folder / "checkpoints" / "latest.ckpt"
        file.parent.mkdir()
        file.touch()
        self.assertEqual(checkpoint.find(self.folder), file)

    def refused(self, *words: str) -> None:
        done = run(self.file, self.bundle, *RIG)
        self.assertEqual(done.status, 1)
        for word in words:
            self.assertIn(word, done.complaint)
        self.assertFalse(self.bundle.exists())


class Verification(Temporary):
    """A bundle that does something else than its networks is found out."""

    def test_every_kind_of_mistake(self) -> None:
        case = golden("resnet")
        self.write(case)
        begin = np.array(case["start"])
        done = run(self.file, self.bundle, *RIG, BEGIN.format(*case["start"]))
        self.assertEqual(done.status, 0, done.complaint)
        config = checkpoint_config.read(self.file, case["cfg"])
        policy = networks.Policy(config, weights(case["layout"], case["normalizer"]))
        start = poses.matrices(np.array([[0.0, 0.0, 0.0, *begin]]), "quaternion")[0][0, :3, :3]
        verify.verify(policy, start, self.bundle)
        mistakes = {
            "action's statistics": lambda spec: spec["action"]["normalization"][0]["mean"].__setitem__(1, 5.0),
            "state's statistics": lambda spec: spec["observations"][3].update(
                normalization={"mode": "min_max", "min": [0.0], "max": [0.5]}
            ),
            "start": lambda spec: spec.update(action_start=1),
            "schedule": lambda spec: spec["scheduler"].update(beta_schedule="linear"),
            "steps": lambda spec: spec["scheduler"].update(num_inference_steps=10),
        }
        whole = (self.bundle / "policy.json").read_text()
        for what, mistake in mistakes.items():
            with self.subTest(what):
                spec = json.loads(whole)
                mistake(spec)
                (self.bundle / "policy.json").write_text(json.dumps(spec))
                with self.assertRaises(Mismatch):
                    verify.verify(policy, start, self.bundle)
        (self.bundle / "policy.json").write_text(whole)
        with self.subTest("another start"), self.assertRaisesRegex(Mismatch, "in encoder"):
            verify.verify(policy, np.eye(3), self.bundle)
        with self.subTest("a weight of the graph"):
            model = onnx.load(self.bundle / "denoiser.onnx")
            weight = next(w for w in model.graph.initializer if w.name.endswith("out.1.bias"))
            weight.CopyFrom(onnx.numpy_helper.from_array(np.ones(10, np.float32), weight.name))
            onnx.save(model, self.bundle / "denoiser.onnx")
            with self.assertRaisesRegex(Mismatch, "in denoiser"):
                verify.verify(policy, start, self.bundle)

    def test_nothing_is_left_of_a_bundle_that_differs(self) -> None:
        case, right = golden("resnet"), runtime.denormalize
        self.write(case)
        self.addCleanup(setattr, runtime, "denormalize", right)
        runtime.denormalize = lambda value, slices: right(value, slices) + np.float32(0.01)
        done = run(self.file, self.bundle, *RIG, BEGIN.format(*case["start"]))
        self.assertEqual(done.status, 1)
        self.assertIn("the bundle differs from UMI's networks in actions in units", done.complaint)
        self.assertEqual(os.listdir(self.folder), ["latest.ckpt"])


if __name__ == "__main__":
    unittest.main()
