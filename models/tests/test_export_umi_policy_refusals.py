"""What export_umi_policy.py refuses, and in which words."""

from __future__ import annotations

import contextlib
import io
import math
import unittest
from typing import Any
from unittest import mock

import torch
from umi_checkpoints import RIG, Temporary, golden, run, weights, write

import export_umi_policy
from policy_export.umi import networks

BEGIN = "--start-rotation=0,0,0,1"
SHAPES = "cfg.policy.shape_meta"
# A mistake in the configuration, and words of the message about it: the key first.
MISTAKES: dict[str, tuple[Any, tuple[str, ...]]] = {
    "another policy": (
        lambda cfg: cfg["policy"].update(_target_="diffusion_policy.policy.diffusion_unet_image_policy.Policy"),
        ("cfg.policy._target_", "diffusion_unet_image_policy", "U-Net"),
    ),
    "another encoder": (
        lambda cfg: cfg["policy"]["obs_encoder"].update(
            _target_="diffusion_policy.model.vision.transformer_obs_encoder.TransformerObsEncoder"
        ),
        ("cfg.policy.obs_encoder._target_", "TransformerObsEncoder"),
    ),
    "another network of pictures": (
        lambda cfg: cfg["policy"]["obs_encoder"].update(model_name="efficientnet_b3"),
        ("cfg.policy.obs_encoder.model_name", "'efficientnet_b3'", "resnet18, resnet34"),
    ),
    "another ResNet": (
        lambda cfg: cfg["policy"]["obs_encoder"].update(model_name="resnet18d"),
        ("cfg.policy.obs_encoder.model_name", "'resnet18d'"),
    ),
    "a ViT for other pictures": (
        lambda cfg: cfg["policy"]["obs_encoder"].update(model_name="vit_base_patch16_224"),
        ("cfg.policy.obs_encoder.model_name", "takes pictures of 224", "have 64"),
    ),
    "a stride that there is not": (
        lambda cfg: cfg["policy"]["obs_encoder"].update(downsample_ratio=8),
        ("cfg.policy.obs_encoder.model_name", "downsample_ratio 8"),
    ),
    "a transformer of features": (
        lambda cfg: cfg["policy"]["obs_encoder"].update(feature_aggregation="transformer"),
        ("cfg.policy.obs_encoder.feature_aggregation", "'transformer'", "attention_pool_2d"),
    ),
    "all tokens of a ViT": (
        lambda cfg: cfg["policy"]["obs_encoder"].update(
            model_name="vit_base_patch16_224", feature_aggregation="all_tokens"
        ),
        ("cfg.policy.obs_encoder.feature_aggregation", "class token"),
    ),
    "a key of a later encoder": (
        lambda cfg: cfg["policy"]["obs_encoder"].update(fused_model_name="x"),
        ("cfg.policy.obs_encoder.fused_model_name", "not known"),
    ),
    "a change of pictures that is not random": (
        lambda cfg: cfg["policy"]["obs_encoder"]["transforms"].append({"_target_": "torchvision.transforms.Normalize"}),
        ("cfg.policy.obs_encoder.transforms[2]._target_", "Normalize"),
    ),
    "no crop": (
        lambda cfg: cfg["policy"]["obs_encoder"]["transforms"].pop(0),
        ("cfg.policy.obs_encoder.transforms[0].type", "RandomCrop"),
    ),
    "a crop of more than there is": (
        lambda cfg: cfg["policy"]["obs_encoder"]["transforms"][0].update(ratio=1.5),
        ("cfg.policy.obs_encoder.transforms[0].ratio", "1.5"),
    ),
    "settings of the scheduler's step": (lambda cfg: cfg["policy"].update(eta=0.5), ("cfg.policy.eta", "not known")),
    "another U-Net": (lambda cfg: cfg["policy"].update(n_groups=4), ("cfg.policy.n_groups", "only 8")),
    "a U-Net that only shifts": (
        lambda cfg: cfg["policy"].update(cond_predict_scale=False),
        ("cfg.policy.cond_predict_scale",),
    ),
    "a condition in the sample": (
        lambda cfg: cfg["policy"].update(obs_as_global_cond=False),
        ("cfg.policy.obs_as_global_cond",),
    ),
    "uneven widths": (lambda cfg: cfg["policy"].update(down_dims=[12, 32]), ("cfg.policy.down_dims", "multiples of 8")),
    "too many levels": (lambda cfg: cfg["policy"].update(down_dims=[8] * 6), ("cfg.policy.down_dims", "16 unevenly")),
    "two robots": (
        lambda cfg: cfg["policy"]["shape_meta"]["action"].update(shape=[20]),
        (f"{SHAPES}.action.shape", "[20]", "one arm"),
    ),
    "an observation of another robot": (
        lambda cfg: obs(cfg).update(robot1_eef_pos=dict(obs(cfg)["robot0_eef_pos"])),
        (f"{SHAPES}.obs.robot1_eef_pos", "one robot"),
    ),
    "a position since the start": (
        lambda cfg: obs(cfg).update(robot0_eef_pos_wrt_start=dict(obs(cfg)["robot0_eef_pos"])),
        (f"{SHAPES}.obs.robot0_eef_pos_wrt_start", "not supported"),
    ),
    "another action": (
        lambda cfg: cfg["policy"]["shape_meta"]["action"].update(rotation_rep="axis_angle"),
        (f"{SHAPES}.action.rotation_rep", "'axis_angle'"),
    ),
    "another rotation": (
        lambda cfg: obs(cfg)["robot0_eef_rot_axis_angle"].update(shape=[3]),
        (f"{SHAPES}.obs.robot0_eef_rot_axis_angle.shape", "[3]", "rows"),
    ),
    "a late action": (
        lambda cfg: cfg["policy"]["shape_meta"]["action"].update(latency_steps=1),
        (f"{SHAPES}.action.latency_steps",),
    ),
    "observations of different times": (
        lambda cfg: obs(cfg)["robot0_gripper_width"].update(latency_steps=6.3),
        (f"{SHAPES}.obs.robot0_gripper_width.latency_steps", "6.3", "different times"),
    ),
    "observations between ticks": (
        lambda cfg: obs(cfg)["camera0_rgb"].update(down_sample_steps=2),
        (f"{SHAPES}.obs.camera0_rgb.down_sample_steps", "2 rows", "0.666667 ticks"),
    ),
    "a pose in two rhythms": (
        lambda cfg: obs(cfg)["robot0_eef_pos"].update(horizon=4),
        (f"{SHAPES}.obs", "not of the same steps"),
    ),
    "no rotation": (
        lambda cfg: obs(cfg).pop("robot0_eef_rot_axis_angle"),
        (f"{SHAPES}.obs.robot0_eef_rot_axis_angle", "missing"),
    ),
    "a sound": (
        lambda cfg: obs(cfg)["camera0_rgb"].update(type="audio"),
        (f"{SHAPES}.obs.camera0_rgb.type", "'audio'"),
    ),
    "an oblong picture": (
        lambda cfg: obs(cfg)["camera0_rgb"].update(shape=[3, 64, 96]),
        (f"{SHAPES}.obs.camera0_rgb.shape", "[3, 64, 96]"),
    ),
    "no picture": (lambda cfg: obs(cfg).pop("camera0_rgb"), (f"{SHAPES}.obs", "no pictures")),
    "the old relative poses": (
        lambda cfg: cfg["task"]["pose_repr"].update(obs_pose_repr="rel"),
        ("cfg.task.pose_repr.obs_pose_repr", "'rel'"),
    ),
    "actions that were learned as others": (
        lambda cfg: cfg["task"]["pose_repr"].update(action_pose_repr="abs"),
        ("cfg.task.pose_repr.action_pose_repr", "'abs'", "'relative'"),
    ),
    "more actions than there are": (lambda cfg: cfg.update(n_action_steps=17), ("cfg.n_action_steps", "17", "16")),
    "another scheduler": (
        lambda cfg: cfg["policy"]["noise_scheduler"].update(_target_="diffusers.DPMSolverMultistepScheduler"),
        ("cfg.policy.noise_scheduler._target_", "DPMSolver"),
    ),
    "another schedule": (
        lambda cfg: cfg["policy"]["noise_scheduler"].update(beta_schedule="sigmoid"),
        ("cfg.policy.noise_scheduler.beta_schedule", "'sigmoid'"),
    ),
    "a setting that no bundle has": (
        lambda cfg: cfg["policy"]["noise_scheduler"].update(thresholding=True),
        ("cfg.policy.noise_scheduler.thresholding", "True"),
    ),
    "too many steps": (
        lambda cfg: cfg["policy"].update(num_inference_steps=51),
        ("51 inference steps", "num_train_timesteps is 50"),
    ),
    "a number in words": (
        lambda cfg: cfg["policy"]["shape_meta"]["action"].update(horizon="${task.action_horizon}"),
        (f"{SHAPES}.action.horizon", "whole number"),
    ),
    "timesteps that the training has not": (
        lambda cfg: cfg["policy"].update(num_inference_steps=5) or schedule(cfg).update(steps_offset=10),
        ("cfg.policy.noise_scheduler.steps_offset", "10 is not from 0 to 9"),
    ),
    "timesteps before the first": (
        lambda cfg: schedule(cfg).update(steps_offset=-1),
        ("cfg.policy.noise_scheduler.steps_offset", "-1 is not from 0 to 4"),
    ),
    "more timesteps than a bundle has": (
        lambda cfg: schedule(cfg).update(num_train_timesteps=10**9),
        ("cfg.policy.noise_scheduler.num_train_timesteps", "more than 10000"),
    ),
    "too few features of a timestep": (
        lambda cfg: cfg["policy"].update(diffusion_step_embed_dim=2),
        ("cfg.policy.diffusion_step_embed_dim", "2 is not an even number from 4"),
    ),
    "odd features of a timestep": (
        lambda cfg: cfg["policy"].update(diffusion_step_embed_dim=5),
        ("cfg.policy.diffusion_step_embed_dim", "5 is not an even number from 4"),
    ),
    "an even kernel": (
        lambda cfg: cfg["policy"].update(kernel_size=4),
        ("cfg.policy.kernel_size", "4 is even"),
    ),
    "a side in words": (
        lambda cfg: obs(cfg)["camera0_rgb"].update(shape=[3, "a", "a"]),
        (f"{SHAPES}.obs.camera0_rgb.shape", "[3, 'a', 'a']"),
    ),
    "pictures without an end": (
        lambda cfg: obs(cfg)["camera0_rgb"].update(shape=[3, 10**6, 10**6]),
        (f"{SHAPES}.obs.camera0_rgb.shape", "from 1 to 2048"),
    ),
    "patches of nothing": (
        lambda cfg: cfg["policy"]["obs_encoder"].update(model_name="vit_tiny_patch0_64"),
        ("cfg.policy.obs_encoder.model_name", "patches of 0"),
    ),
    "a crop of nothing": (
        lambda cfg: cfg["policy"]["obs_encoder"]["transforms"][0].update(ratio=0.001),
        ("cfg.policy.obs_encoder.transforms[0].ratio", "0.001 leaves nothing"),
    ),
    "pictures alone": (
        lambda cfg: alone(cfg),
        (f"{SHAPES}.obs", "pictures alone (ignore_by_policy)"),
    ),
    "more actions than a bundle has": (
        lambda cfg: cfg["policy"]["shape_meta"]["action"].update(horizon=10**6),
        (f"{SHAPES}.action.horizon", "1000000 is more than 1024"),
    ),
    "more steps than a bundle has": (
        lambda cfg: obs(cfg)["camera0_rgb"].update(horizon=10**6),
        (f"{SHAPES}.obs.camera0_rgb.horizon", "1000000 is more than 64"),
    ),
    "a number without an end": (
        lambda cfg: obs(cfg)["camera0_rgb"].update(down_sample_steps=10**400),
        (f"{SHAPES}.obs.camera0_rgb.down_sample_steps", "is not from"),
    ),
    "widths without an end": (
        lambda cfg: cfg["policy"].update(down_dims=[8_000_000, 8_000_000]),
        ("cfg.policy.down_dims", "at most 65536"),
    ),
    "no configuration of the task": (lambda cfg: cfg.pop("task"), ("cfg.task: missing",)),
}


def obs(cfg: dict[str, Any]) -> dict[str, Any]:
    return cfg["policy"]["shape_meta"]["obs"]


def schedule(cfg: dict[str, Any]) -> dict[str, Any]:
    return cfg["policy"]["noise_scheduler"]


def alone(cfg: dict[str, Any]) -> None:
    cfg["task"]["pose_repr"].update(obs_pose_repr="abs", action_pose_repr="abs")
    for key, one in obs(cfg).items():
        if key != "camera0_rgb":
            one.update(ignore_by_policy=True)


class Refusals(Temporary):
    """What cannot be exported is refused in words that name the key, and nothing is left."""

    def refused(self, *words: str, arguments: tuple[str, ...] = (*RIG, BEGIN)) -> None:
        done = run(self.file, self.bundle, *arguments)
        self.assertEqual(done.status, 1)
        for word in words:
            self.assertIn(word, done.complaint)
        self.assertFalse(self.bundle.exists())

    def test_configuration(self) -> None:
        for what, (mistake, words) in MISTAKES.items():
            with self.subTest(what):
                write(self.file, self.changed(mistake), ema_model={})
                self.refused(str(self.file), *words)

    def test_a_configuration_that_names_a_value_many_times(self) -> None:
        nested: Any = "x"
        for _ in range(60):
            nested = [nested, nested]
        torch.save({"cfg": {"policy": nested}, "state_dicts": {}}, self.file)
        self.refused(f"{self.file}: cfg: more than 100000 values")

    def test_networks_larger_than_the_weights(self) -> None:
        case = golden("resnet")
        state = weights(case["layout"], case["normalizer"])
        write(self.file, self.changed(lambda cfg: cfg["policy"].update(down_dims=[65536, 65536])), ema_model=state)
        self.refused("cfg.policy.down_dims", "bytes of weights do not fit one ONNX file")
        # Refused before the networks have memory.
        write(self.file, self.changed(lambda cfg: cfg["policy"].update(down_dims=[1024, 2048])), ema_model=state)
        with mock.patch.object(networks.nn.Module, "load_state_dict", side_effect=AssertionError):
            devices: list[str] = []
            made = networks.UNetDenoiser

            def noted(*arguments: Any) -> torch.nn.Module:
                network = made(*arguments)
                devices.append(next(network.parameters()).device.type)
                return network

            with mock.patch.object(networks, "UNetDenoiser", noted):
                self.refused("by cfg.policy it is")
        self.assertEqual(devices, ["meta"])

    def test_which_weights(self) -> None:
        write(self.file, golden("resnet")["cfg"], model={})
        self.refused("state_dicts.ema_model: missing", "use_ema")
        write(self.file, self.changed(lambda cfg: cfg["training"].update(use_ema=False)), ema_model={})
        self.refused("state_dicts.model: missing")
        write(self.file, golden("resnet")["cfg"], ema_model={"a": 1})
        self.refused("state_dicts.ema_model: not a table of tensors")

    def test_weights(self) -> None:
        case = golden("resnet")
        whole = weights(case["layout"], case["normalizer"])
        kernel, offset = "model.down_modules.0.0.blocks.0.block.0.weight", "normalizer.params_dict.action.offset"
        scale = "normalizer.params_dict.action.scale"
        for change, words in (
            ({kernel: None}, (f"state_dicts.ema_model.{kernel}", "missing")),
            ({"model.local_cond_encoder.0.weight": torch.zeros(1)}, ("model.local_cond_encoder.0.weight", "surplus")),
            ({kernel: torch.zeros(16, 10, 3)}, (kernel, "[16, 10, 3]", "[16, 10, 5]")),
            ({offset: None}, (offset, "missing")),
            ({offset: torch.zeros(160)}, (offset, "[160]", "temporally_independent_normalization")),
            ({offset: torch.full((10,), math.nan)}, (offset, "not finite")),
            ({scale: torch.zeros(10)}, (scale, "not above 0")),
        ):
            with self.subTest(words[0]):
                state = {name: found for name, found in (whole | change).items() if found is not None}
                write(self.file, case["cfg"], ema_model=state)
                self.refused(*words)

    def test_the_start(self) -> None:
        write(self.file, golden("resnet")["cfg"], ema_model={})
        self.refused("a quaternion x y z w has the length 1", arguments=(*RIG, "--start-rotation=0,0,0,2"))
        ignored = self.changed(
            lambda cfg: obs(cfg)["robot0_eef_rot_axis_angle_wrt_start"].update(ignore_by_policy=True)
        )
        write(self.file, ignored, ema_model={})
        self.refused("does not observe robot0_eef_rot_axis_angle_wrt_start")

    def test_arguments(self) -> None:
        write(self.file, golden("shared")["cfg"], ema_model={})
        both = ("--modality", "camera0_rgb=top", "--modality", "camera1_rgb=top")
        self.refused("two cameras cannot both be top", arguments=(*RIG, BEGIN, *both))
        self.refused(
            "camera2_rgb=top", "camera0_rgb, camera1_rgb", arguments=(*RIG, BEGIN, "--modality", "camera2_rgb=top")
        )
        self.refused("--low", "not below", arguments=(*RIG, BEGIN, "--low=0,0,3"))
        self.refused("101 inference steps", arguments=(*RIG, BEGIN, "--steps", "101"))
        self.bundle.mkdir()
        self.assertIn("exists already", run(self.file, self.bundle, *RIG).complaint)

    def test_forms_of_arguments(self) -> None:
        for argument, words in (
            ("--pose=arm", "'arm' is not 7 numbers of a sensor, such as arm.0-6"),
            ("--pose=arm.0-5", "'arm.0-5' is not 7 numbers"),
            ("--gripper=arm.7-8", "'arm.7-8' is not 1 numbers"),
            ("--low=0,0", "'0,0' is not 3 numbers"),
            ("--low=a,b,c", "'a,b,c' is not 3 numbers, joined by commas"),
            ("--high=0,0,inf", "'0,0,inf' is not 3 numbers"),
            ("--picture=640", "'640' is not WIDTHxHEIGHT"),
        ):
            complaint = io.StringIO()
            with self.subTest(argument), contextlib.redirect_stderr(complaint), self.assertRaises(SystemExit):
                export_umi_policy.main([str(self.file), str(self.bundle), *RIG, argument])
            self.assertIn(words, complaint.getvalue())


if __name__ == "__main__":
    unittest.main()
