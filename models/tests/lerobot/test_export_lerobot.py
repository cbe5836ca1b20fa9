"""export_lerobot.py on small random checkpoints that LeRobot itself writes (`make lerobot-test`)."""

import json
import os
import unittest
from hashlib import sha256

import numpy as np
import onnx
from lerobot_checkpoints import ACTION, ACTION_LEN, STATE, STATE_LEN, TOP, WRIST, Case, Temporary, run, write

from policy_export import runtime
from policy_export.lerobot import checkpoint as loading
from policy_export.lerobot import config as checkpoint_config
from policy_export.lerobot import verify
from policy_export.verify import Mismatch

CASES = {
    "one camera, LeRobot's defaults": Case(),
    "one camera, mask-aware, odd crop": Case(
        height=75,
        width=98,
        # 75 - 64 and 98 - 69 are odd, and torchvision rounds one of their halves up and the other down.
        settings={"crop_shape": (64, 69), "noise_scheduler_type": "DDIM", "num_inference_steps": 10},
        arguments=["--mask-aware"],
    ),
    "two cameras, mean and deviation throughout": Case(
        cameras=[TOP, WRIST],
        modes={"VISUAL": "MEAN_STD", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"},
        settings={"noise_scheduler_type": "DDIM", "num_inference_steps": 7, "beta_schedule": "linear"},
    ),
    "two cameras, mask-aware, own encoders, crop": Case(
        cameras=[WRIST, TOP],
        modes={"VISUAL": "MIN_MAX"},
        settings={
            "use_separate_rgb_encoder_per_camera": True,
            "crop_shape": (48, 60),
            "noise_scheduler_type": "DDIM",
            "num_inference_steps": 10,
        },
        arguments=["--mask-aware", "--required", TOP],
    ),
    "resize both ways, then crop; DDPM run as DDIM": Case(
        height=50,
        width=120,
        settings={"resize_shape": (70, 72), "crop_ratio": 0.9, "prediction_type": "sample"},
        arguments=["--scheduler", "DDIM", "--steps", "8"],
    ),
    "quantiles, batch norm, one observation, no clipping, an action that never moved": Case(
        modes={"VISUAL": "IDENTITY", "STATE": "QUANTILES", "ACTION": "MIN_MAX"},
        settings={
            "n_obs_steps": 1,
            "use_group_norm": False,
            "clip_sample": False,
            "beta_schedule": "scaled_linear",
            "noise_scheduler_type": "DDIM",
            "num_inference_steps": 10,
        },
        stats={ACTION: {"min": [-2.0, 0.25, 1.0], "max": [2.0, 0.25, 9.0]}},
    ),
}


class Exports(Temporary):
    """What can be exported is, equals LeRobot, and has the format of a bundle."""

    def check(self, case: Case) -> dict:
        write(case, self.source)
        names = ["--modality", f"{TOP}=cam_top", "--modality", f"{STATE}=arm"]
        done = run(self.source, self.bundle, "--hz", 10, *names, *case.arguments)
        self.assertEqual(done.status, 0, done.complaint)
        self.assertEqual(done.out.count("largest difference from LeRobot"), 4)
        policy = json.loads((self.bundle / "policy.json").read_text())
        self.check_graphs(case, policy)
        self.check_policy(case, policy)
        self.assertEqual(sorted(os.listdir(self.folder)), ["bundle", "checkpoint"], "nothing else is left behind")
        card = (self.bundle / "README.md").read_text()
        self.assertIn("Not mask-aware" if policy["mask"] is None else "Mask-aware by request", card)
        return policy

    def check_graphs(self, case: Case, policy: dict) -> None:
        to, horizon = policy["n_obs_steps"], policy["horizon"]
        shapes = {}
        for name, graph in policy["graphs"].items():
            bytes = (self.bundle / graph["file"]).read_bytes()
            self.assertEqual(sha256(bytes).hexdigest(), graph["sha256"])
            model = onnx.load_from_string(bytes)
            onnx.checker.check_model(model)
            for value in (*model.graph.input, *model.graph.output):
                dims = [dim.dim_param or dim.dim_value for dim in value.type.tensor_type.shape.dim]
                shapes[name, value.name] = (value.type.tensor_type.elem_type, dims)
        real, whole = onnx.TensorProto.FLOAT, onnx.TensorProto.INT64
        width = to * (STATE_LEN + 64 * len(case.cameras))
        expected = {
            ("encoder", key.rsplit(".")[-1]): (real, ["B", to, 3, case.height, case.width]) for key in case.cameras
        }
        expected["encoder", "state"] = (real, ["B", to, STATE_LEN])
        if policy["mask"] is not None:
            expected["encoder", "mask"] = (real, ["B", len(case.cameras)])
        expected["encoder", "global_cond"] = (real, ["B", width])
        expected["denoiser", "sample"] = (real, ["B", horizon, ACTION_LEN])
        expected["denoiser", "timestep"] = (whole, ["B"])
        expected["denoiser", "global_cond"] = (real, ["B", width])
        expected["denoiser", "prediction"] = (real, ["B", horizon, ACTION_LEN])
        self.assertEqual(shapes, expected)

    def check_policy(self, case: Case, policy: dict) -> None:
        aware = "--mask-aware" in case.arguments
        modalities = {TOP: "cam_top", WRIST: "wrist", STATE: "arm"}
        keys = [*case.cameras, STATE]
        self.assertEqual(policy["format"], "rapid-policy/1")
        self.assertEqual(policy["name"], "bundle")
        self.assertEqual(policy["mask_aware"], aware)
        self.assertEqual(policy["action_start"], policy["n_obs_steps"] - 1)
        self.assertEqual([spec["modality"] for spec in policy["observations"]], [modalities[key] for key in keys])
        required = [not aware or key == STATE or key in case.arguments for key in keys]
        self.assertEqual([spec["required"] for spec in policy["observations"]], required)
        mask = {"input": "mask", "order": [modalities[key] for key in case.cameras], "absent": "zero_embedding"}
        self.assertEqual(policy["mask"], mask if aware else None)
        self.assertEqual(policy["action"]["actuator"], "arm")
        self.assertEqual(policy["training"]["config"]["type"], "diffusion")
        self.assertLessEqual(max(policy["training"]["verification"].values()), 1e-4)

    def test_defaults(self):
        policy = self.check(CASES["one camera, LeRobot's defaults"])
        self.assertEqual(
            policy["scheduler"],
            {
                "type": "DDPM",
                "num_train_timesteps": 100,
                "beta_schedule": "squaredcos_cap_v2",
                "beta_start": 0.0001,
                "beta_end": 0.02,
                "prediction_type": "epsilon",
                "clip_sample": True,
                "clip_sample_range": 1.0,
                "set_alpha_to_one": True,
                "steps_offset": 0,
                "timestep_spacing": "leading",
                "num_inference_steps": 100,
            },
        )
        modes = [spec["normalization"]["mode"] for spec in policy["observations"]]
        self.assertEqual(modes, ["mean_std", "min_max"])
        self.assertEqual(policy["observations"][0]["normalization"]["eps"], 1e-8)
        self.assertEqual([spec["slice"] for spec in policy["action"]["normalization"]], [[0, ACTION_LEN]])
        low, high = (np.float32(policy["action"]["limits"][name]) for name in ("min", "max"))
        normalization = policy["action"]["normalization"][0]
        self.assertTrue((low == np.float32(normalization["min"])).all() and (high > low).all())

    def test_mask_aware_odd_crop(self):
        policy = self.check(CASES["one camera, mask-aware, odd crop"])
        self.assertEqual((policy["scheduler"]["type"], policy["scheduler"]["num_inference_steps"]), ("DDIM", 10))

    def test_two_cameras_mean_std(self):
        policy = self.check(CASES["two cameras, mean and deviation throughout"])
        self.assertEqual(policy["action"]["normalization"][0]["mode"], "mean_std")
        self.assertEqual(policy["action"]["normalization"][0]["eps"], 0, "LeRobot has no eps on the way out")

    def test_two_cameras_mask_aware_crop(self):
        self.check(CASES["two cameras, mask-aware, own encoders, crop"])

    def test_resize_and_other_scheduler(self):
        policy = self.check(CASES["resize both ways, then crop; DDPM run as DDIM"])
        self.assertEqual((policy["scheduler"]["type"], policy["scheduler"]["num_inference_steps"]), ("DDIM", 8))
        self.assertEqual(policy["training"]["config"]["noise_scheduler_type"], "DDPM")

    def test_quantiles_and_constant_action(self):
        policy = self.check(CASES["quantiles, batch norm, one observation, no clipping, an action that never moved"])
        self.assertEqual([spec["normalization"]["mode"] for spec in policy["observations"]], ["identity", "min_max"])
        slices = [(spec["slice"], spec["mode"]) for spec in policy["action"]["normalization"]]
        self.assertEqual(slices, [([0, 1], "min_max"), ([1, 2], "mean_std"), ([2, 3], "min_max")])
        self.assertEqual(policy["action"]["limits"], {"min": [-2.0, 0.25, 1.0], "max": [2.0, 0.25, 9.0]})

    def test_dataset_gives_rate_names_and_limits(self):
        write(CASES["one camera, mask-aware, odd crop"], self.source)
        meta = self.folder / "data" / "meta"
        meta.mkdir(parents=True)
        info = {"fps": 15, "features": {ACTION: {"names": {"motors": ["x", "y", "grip"]}}}}
        (meta / "info.json").write_text(json.dumps(info))
        limits = {"min": [-1.0, -2.0, 0.0], "max": [1.0, 2.0, 0.5]}
        (meta / "stats.json").write_text(json.dumps({ACTION: limits}))
        # As training leaves it: the folder around pretrained_model is named.
        self.source.rename(self.folder / "pretrained_model")
        self.source.mkdir()
        (self.folder / "pretrained_model").rename(self.source / "pretrained_model")
        done = run(self.source, self.bundle, "--dataset", meta.parent, "--action-units", "m,m,1", "--actuator", "arm")
        self.assertEqual(done.status, 0, done.complaint)
        policy = json.loads((self.bundle / "policy.json").read_text())
        self.assertEqual(policy["control_hz"], 15)
        self.assertEqual(policy["action"]["names"], ["x", "y", "grip"])
        self.assertEqual(policy["action"]["units"], ["m", "m", "1"])
        self.assertEqual(policy["action"]["limits"], limits)
        self.assertEqual(policy["action"]["actuator"], "arm")


class Verification(Temporary):
    """A bundle that does something else than LeRobot is found out."""

    def test_every_kind_of_mistake(self):
        write(CASES["two cameras, mask-aware, own encoders, crop"], self.source)
        done = run(self.source, self.bundle, "--hz", 10, "--mask-aware")
        self.assertEqual(done.status, 0, done.complaint)
        checkpoint = loading.load(checkpoint_config.read(self.source), None, None)
        verify.verify(checkpoint, self.bundle)

        def swap(graphs):
            first, second = (graphs.graph.input[i].name for i in (0, 1))
            for node in graphs.graph.node:
                names = [{first: second, second: first}.get(name, name) for name in node.input]
                del node.input[:]
                node.input.extend(names)

        mistakes = {
            "state's statistics": lambda policy: policy["observations"][2]["normalization"]["min"].__setitem__(0, -9.0),
            "picture's statistics": lambda policy: policy["observations"][1]["normalization"]["max"].__setitem__(
                2, 3.0
            ),
            "action's statistics": lambda policy: policy["action"]["normalization"][0]["max"].__setitem__(1, 5.0),
            "start": lambda policy: policy.update(action_start=0),
            "schedule": lambda policy: policy["scheduler"].update(beta_schedule="linear"),
            "steps": lambda policy: policy["scheduler"].update(num_inference_steps=11),
            "order of the mask": lambda policy: policy["mask"]["order"].reverse(),
        }
        whole = (self.bundle / "policy.json").read_text()
        for what, mistake in mistakes.items():
            with self.subTest(what):
                (self.bundle / "policy.json").write_text(whole)
                self.edit(self.bundle / "policy.json", mistake)
                with self.assertRaises(Mismatch):
                    verify.verify(checkpoint, self.bundle)
        (self.bundle / "policy.json").write_text(whole)
        with self.subTest("cameras swapped in the graph"):
            model = onnx.load(self.bundle / "encoder.onnx")
            swap(model)
            onnx.save(model, self.bundle / "encoder.onnx")
            with self.assertRaisesRegex(Mismatch, "differs from LeRobot in encoder"):
                verify.verify(checkpoint, self.bundle)

    def test_nothing_is_left_of_a_bundle_that_differs(self):
        write(Case(settings={"noise_scheduler_type": "DDIM", "num_inference_steps": 5}), self.source)
        right = runtime.betas
        self.addCleanup(setattr, runtime, "betas", right)
        runtime.betas = lambda spec: right(spec) * np.float32(0.9)
        done = run(self.source, self.bundle, "--hz", 10)
        self.assertEqual(done.status, 1)
        self.assertIn("the bundle differs from LeRobot in actions, actions in units", done.complaint)
        self.assertEqual(os.listdir(self.folder), ["checkpoint"])


if __name__ == "__main__":
    unittest.main()
