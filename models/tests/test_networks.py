"""The networks: what the mask hides, and that a bundle's graphs hold the whole policy."""

import json
import os
import subprocess
import tempfile
import unittest
from pathlib import Path
from typing import Any

import torch
from made_up import Experiment, experiment, observed, small, twelve_steps, with_history

from rapid_policy.bundle import DENOISER, ENCODER, POLICY, encoder_inputs, policy_json, write_card, write_policy
from rapid_policy.export import _network, denoiser_example, encoder_example, largest_difference, write_graph
from rapid_policy.model import HistoryPooling, Policy
from rapid_policy.resnet import ResNet18
from rapid_policy.weights import First, load_policy

RAPID = os.environ.get("RAPID_BIN")
RANGES = {
    "state": {"mode": "min_max", "min": [0, 0, 0, 0], "max": [1, 1, 1, 1]},
    "action": {"mode": "min_max", "min": [-1, -1, 0, 0], "max": [1, 1, 1, 2]},
}


def random_policy(spec: Experiment) -> Policy:
    """With weights that are all different: those of a new network are ones and zeros in places."""
    torch.manual_seed(0)
    policy = Policy(spec).eval()
    with torch.no_grad():
        for weight in policy.parameters():
            weight.add_(torch.randn_like(weight) * 0.05)
    return policy


def write(policy: Policy, folder: Path) -> dict[str, Any]:
    """A bundle without its card; the content of its `policy.json`."""
    spec, inputs = policy.spec, ["sample", "timestep", "global_cond"]
    write_graph(policy.encoder, encoder_example(spec), encoder_inputs(spec), "global_cond", folder / ENCODER)
    write_graph(policy.denoiser, denoiser_example(spec), inputs, "epsilon", folder / DENOISER)
    return write_policy(spec, {"normalization": RANGES, "network": _network(spec)}, folder)


class Mask(unittest.TestCase):
    def test_an_absent_picture_changes_nothing_even_if_it_is_not_a_number(self):
        for encoder in ({}, {"shared": True}):
            spec = experiment(encoder=encoder)
            policy = random_policy(spec)
            wrist, tactile, state, _ = encoder_example(spec)
            absent = torch.tensor([[1.0, 0.0]]).repeat(2, 1)
            with torch.no_grad():
                plain = policy.encoder(wrist, tactile, state, absent)
                spoilt = policy.encoder(wrist, tactile * torch.nan, state, absent)
                present = policy.encoder(wrist, tactile, state, torch.ones(2, 2))
            self.assertTrue(torch.equal(plain, spoilt))
            self.assertFalse(torch.equal(plain, present))


class History(unittest.TestCase):
    """Of `tactile-id-memory`: wrist, tactile, touched with a history, state; which steps there are; the mask."""

    def setUp(self):
        self.policy = random_policy(twelve_steps(encoder={"width": 8}))
        self.inputs = dict(zip(encoder_inputs(self.policy.spec), encoder_example(self.policy.spec), strict=True))

    ABSENT = torch.tensor([[1.0, 0.0]] * 2)

    def condition(self, **changed: torch.Tensor) -> torch.Tensor:
        """[B, To, D] without the tactile picture of now; the last 64 are what stands for it."""
        with torch.no_grad():
            given = self.inputs | {"mask": self.ABSENT} | changed
            return self.policy.encoder(*given.values()).unflatten(1, (2, -1))

    def test_what_goes_in(self):
        self.assertEqual(list(self.inputs), ["wrist", "tactile", "touched", "state", "touched_valid", "mask"])
        self.assertEqual(tuple(self.inputs["touched"].shape), (2, 12, 3, 96, 96))
        self.assertEqual(tuple(self.inputs["mask"].shape), (2, 2))
        self.assertEqual(list(self.policy.encoder.images), ["wrist", "tactile"])
        self.assertEqual(self.condition().flatten(1).shape[1], self.policy.spec.condition)

    def test_a_step_that_is_not_there_changes_nothing_even_if_it_is_not_a_number(self):
        there = self.inputs["touched_valid"][..., None, None, None] > 0.5
        spoilt = self.condition(touched=torch.where(there, self.inputs["touched"], torch.nan))
        self.assertTrue(torch.equal(spoilt, self.condition()))
        self.assertFalse(torch.equal(self.condition(touched=-self.inputs["touched"]), self.condition()))

    def test_without_any_step_it_is_zeros(self):
        none = self.condition(touched_valid=torch.zeros(2, 12), touched=torch.full((2, 12, 3, 96, 96), torch.nan))
        self.assertEqual(float(none[..., -64:].abs().max()), 0)
        self.assertTrue(none.isfinite().all())

    def test_it_stands_for_the_absent_picture_at_every_step_as_its_encoder_sees_it(self):
        only = torch.zeros(2, 12)
        only[:, 3] = 1
        touched = self.inputs["touched"].clone()
        touched[:, 3] = self.inputs["tactile"][:, 1]
        remembered = self.condition(touched=touched, touched_valid=only)
        there = self.condition(mask=torch.ones(2, 2))
        torch.testing.assert_close(remembered[:, 1], there[:, 1])
        self.assertTrue(torch.equal(remembered[:, 0, -64:], remembered[:, 1, -64:]))
        # Beside the picture of now it is nothing, and nothing stands for a picture without a history.
        self.assertTrue(torch.equal(self.condition(mask=torch.ones(2, 2), touched=-touched), there))
        without = self.condition(mask=torch.zeros(2, 2))
        self.assertEqual(float(without[..., -128:-64].abs().max()), 0)

    def test_before_it_is_trained_it_remembers_the_last(self):
        torch.manual_seed(0)
        pooling, embeddings = HistoryPooling(8, range(0, 15, 3)[::-1]), torch.randn(4, 5, 8)
        valid = torch.tensor([[1, 1, 1, 1, 1], [1, 1, 1, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 0, 0]]) > 0
        last = torch.stack([embeddings[0, 4], embeddings[1, 2], embeddings[2, 2], torch.zeros(8)])
        with torch.no_grad():
            torch.testing.assert_close(pooling(embeddings, valid), last, atol=0.2, rtol=0)
        # However far apart they are, the last one is most of it, and the others can be learned.
        for apart in (1, 3, 30, 64):
            pooling = HistoryPooling(8, range(0, 5 * apart, apart)[::-1])
            with torch.no_grad():
                torch.testing.assert_close(pooling(embeddings, valid), last, atol=0.2, rtol=0)
            pooling(embeddings[:1], valid[:1]).square().sum().backward()
            self.assertGreater(float(pooling.places.grad[3].abs()), 1e-3, apart)

    def test_the_order_of_its_steps_is_known_by_their_places_alone(self):
        torch.manual_seed(0)
        pooling, embeddings, order = HistoryPooling(8, range(5)[::-1]), torch.randn(3, 5, 8), torch.randperm(5)
        valid = torch.tensor([[1, 1, 0, 1, 1], [0, 0, 0, 0, 1], [0, 0, 0, 0, 0]]) > 0
        with torch.no_grad():
            self.assertFalse(torch.allclose(pooling(embeddings[:, order], valid[:, order]), pooling(embeddings, valid)))
            pooling.places.zero_()
            pooling.score.weight.normal_()
            plain = pooling(embeddings, valid)
            torch.testing.assert_close(pooling(embeddings[:, order], valid[:, order]), plain)
            torch.testing.assert_close(plain[1], embeddings[1, 4])

    def test_two_histories_of_a_picture_are_remembered_as_one(self):
        described = json.loads(twelve_steps().to_text())
        touched = next(o for o in described["observation"] if o["key"] == "touched")
        described["observation"].append({**touched, "key": "lately", "down_sample_steps": 1, "history": {"steps": 3}})
        policy = random_policy(Experiment.from_text(json.dumps(described)))
        self.assertEqual(policy.encoder.histories["tactile"].places.shape, (15,))
        inputs = dict(zip(encoder_inputs(policy.spec), encoder_example(policy.spec, mask=(1, 0)), strict=True))
        with torch.no_grad():
            found = policy.encoder(*inputs.values())
            for key in ("touched", "lately"):
                self.assertFalse(torch.equal(policy.encoder(*(inputs | {key: -inputs[key]}).values()), found), key)

    def test_training_computes_the_same_of_the_steps_that_there_are(self):
        pooled = dict(self.inputs)
        for key in ("wrist", "tactile", "touched"):
            pooled[key] = torch.nn.functional.avg_pool2d(pooled[key].flatten(0, 1), 2).unflatten(0, pooled[key].shape[:2])
        for valid in (self.inputs["touched_valid"], torch.zeros(2, 12)):
            pooled["touched_valid"] = valid
            encoded = self.policy.encoder.encode(pooled, self.ABSENT, pooled=True)
            expected = self.condition(touched_valid=valid).flatten(1)
            torch.testing.assert_close(encoded, expected, rtol=1e-4, atol=1e-5)
            with torch.autocast("cpu", torch.bfloat16):
                half = self.policy.encoder.encode(pooled, self.ABSENT, pooled=True)
            self.assertEqual(half.dtype, torch.float32)
            torch.testing.assert_close(half, expected, rtol=0.1, atol=0.1)
            half.sum().backward()
            self.assertTrue(all(w.grad.isfinite().all() for w in self.policy.encoder.parameters()))


class Encoders(unittest.TestCase):
    def test_a_shared_encoder_is_one(self):
        policy = random_policy(experiment(encoder={"shared": True}))
        self.assertEqual(list(policy.encoder.images), ["shared"])
        wrist, _, state, mask = encoder_example(policy.spec)
        with torch.no_grad():
            condition = policy.encoder(wrist, wrist, state, mask).unflatten(1, (2, -1))
        self.assertTrue(torch.equal(condition[:, :, 4:68], condition[:, :, 68:]))

    def test_resnet18_has_the_names_and_sizes_of_torchvision(self):
        state = ResNet18(frozen=True).state_dict()
        # All of torchvision's resnet18 but its classifier (fc) and its counters of batches.
        self.assertEqual(len(state), 100)
        self.assertEqual(sum(v.numel() for k, v in state.items() if "running" not in k), 11_689_512 - 513_000)
        for name, shape in (
            ("conv1.weight", (64, 3, 7, 7)),
            ("bn1.running_mean", (64,)),
            ("layer1.1.conv2.weight", (64, 64, 3, 3)),
            ("layer2.0.downsample.0.weight", (128, 64, 1, 1)),
            ("layer2.0.downsample.1.running_var", (128,)),
            ("layer4.1.bn2.bias", (512,)),
        ):
            self.assertEqual(tuple(state[name].shape), shape)

    def test_weights_come_from_a_file(self):
        with tempfile.TemporaryDirectory() as name:
            file = Path(name) / "resnet18.pth"
            state = {k: torch.randn_like(v).abs() for k, v in ResNet18(frozen=True).state_dict().items()}
            torch.save({**state, "fc.weight": torch.zeros(1000, 512)}, file)
            spec = experiment(encoder={"type": "resnet18", "weights": str(file)})
            policy = Policy(spec)
            policy.start_from(file)
            for encoder in policy.encoder.images.values():
                for key, value in encoder.trunk.state_dict().items():
                    self.assertTrue(torch.equal(value, state[key]), key)
            torch.save({k: v for k, v in state.items() if k != "layer3.0.bn1.bias"}, file)
            with self.assertRaisesRegex(
                ValueError, "resnet18.pth: not the state_dict .* no weight 'layer3.0.bn1.bias'"
            ):
                policy.start_from(file)
            file.write_bytes(b"no weights")
            with self.assertRaisesRegex(ValueError, "not the state_dict"):
                policy.start_from(file)

    def test_frozen_statistics_are_those_of_batch_normalisation(self):
        torch.manual_seed(0)
        trunk, norm = ResNet18(frozen=True), torch.nn.BatchNorm2d(64).eval()
        for name, value in norm.state_dict().items():
            if value.dim():
                value.copy_(torch.rand_like(value) + 0.5)
                trunk.bn1.get_buffer(name).copy_(value)
        x = torch.randn(2, 64, 5, 5)
        torch.testing.assert_close(trunk.bn1(x), norm(x))


class Transformer(unittest.TestCase):
    def test_every_action_sees_the_others_the_step_and_each_observation(self):
        spec = small("transformer")
        denoiser = random_policy(spec).denoiser
        inputs = denoiser_example(spec, 1)
        with torch.no_grad():
            plain = denoiser(*inputs)
            for name, at in (("another action", (0, 0, 3)), ("the step", (1, 0)), ("an observation", (2, 0, -1))):
                changed = [x.clone() for x in inputs]
                changed[at[0]][at[1:]] += 1
                moved = (denoiser(*changed) - plain).abs().amax(-1)
                self.assertGreater(float(moved.min()), 1e-5, name)

    def test_its_layers_begin_with_other_weights(self):
        one, other = Policy(small("transformer")).denoiser.layers
        self.assertFalse(torch.equal(one.linear1.weight, other.linear1.weight))


class Bundle(unittest.TestCase):
    def test_graphs_equal_pytorch_and_hold_its_weights(self):
        sizes = {
            "encoder": {"type": "resnet18", "features": 16, "keypoints": 4},
            "denoiser": {"widths": [8, 16], "kernel": 3},
        }
        for name, spec in (
            ("tactile-id-arm", experiment()),
            ("without mask", experiment("vision-diff")),
            ("shared", experiment(encoder={"shared": True})),
            ("resnet18", experiment(**sizes)),
            ("by hand", experiment("tactile-id")),
            ("transformer", experiment("transformer", policy={"horizon": 14, "n_obs_steps": 3})),
            ("history", small("tactile-id-memory")),
            ("history, shared", experiment("tactile-id-memory", encoder={"shared": True, "width": 8}, policy={"n_obs_steps": 3})),
            ("history, transformer", with_history(small("transformer"))),
        ):
            with self.subTest(name), tempfile.TemporaryDirectory() as folder_name:
                folder = Path(folder_name)
                policy = random_policy(spec)
                described = write(policy, folder)
                self.assertLess(largest_difference(spec, policy, folder), 1e-4 if name == "transformer" else 2e-4)
                self.assertEqual(described["mask"] is None, not spec.policy.mask_aware)
                again = load_policy(folder)
                for key, weight in policy.state_dict().items():
                    self.assertTrue(torch.equal(weight, again.state_dict()[key]), key)

    def start(self, spec, folder):
        """A policy of this experiment that begins with the weights of the bundle."""
        policy = Policy(spec).eval()
        ours = policy_json(spec, {"normalization": RANGES}, {ENCODER: "", DENOISER: ""})
        First.read(folder).give(policy, ours)
        return policy

    def test_a_policy_starts_with_the_weights_of_a_bundle(self):
        with tempfile.TemporaryDirectory() as name:
            folder, before = Path(name), random_policy(experiment())
            write(before, folder)
            same = self.start(experiment(), folder)
            for key, weight in before.state_dict().items():
                self.assertTrue(torch.equal(weight, same.state_dict()[key]), key)
            one = {"type": "small", "width": 8, "features": 64, "keypoints": 16}
            for changed, reason in (
                (experiment(encoder=one), "does not fit"),
                (experiment("transformer"), "does not fit"),
                (experiment(policy={"n_obs_steps": 1}), "does not fit"),
                (observed(experiment(), "tactile", operation=None), "operation of observation `tactile` is 'diff_to_reference' there"),
                (observed(experiment(), "tactile", color="bgr"), "color of observation `tactile` is 'rgb' there and 'bgr' here"),
                (observed(experiment(), "wrist", modality="other"), "modality of observation `wrist` is"),
                (observed(experiment(), "wrist", down_sample_steps=3), "down_sample_steps of observation `wrist` is"),
                (experiment(action={"names": ["z", "y", "x", "grip"]}), "names of action is"),
            ):
                with self.subTest(reason), self.assertRaisesRegex(ValueError, f"{folder}: .*{reason}.*: start from a policy with"):
                    self.start(changed, folder)

    def test_what_predicts_outcomes_is_in_no_bundle_and_begins_anew(self):
        with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as two:
            plain, spec = random_policy(experiment()), observed(experiment(), "tactile", outcome=0.5)
            guided = Policy(spec)
            self.assertIsNone(plain.outcomes)
            guided.load_state_dict(plain.state_dict() | {f"outcomes.{k}": v for k, v in guided.outcomes.state_dict().items()})
            write(plain, Path(one))
            write(guided.eval(), Path(two))
            for name in (ENCODER, DENOISER):
                self.assertEqual((Path(one) / name).read_bytes(), (Path(two) / name).read_bytes())
            begun = self.start(spec, Path(one))
            for key, weight in plain.state_dict().items():
                self.assertTrue(torch.equal(weight, begun.state_dict()[key]), key)

    def test_what_it_sees_keeps_its_weights_in_any_order(self):
        for kind in ("tactile-id-arm", "transformer"):
            with self.subTest(kind), tempfile.TemporaryDirectory() as name:
                folder, before = Path(name), random_policy(experiment(kind))
                write(before, folder)
                described = json.loads(experiment(kind).to_text())
                described["observation"].reverse()
                turned = self.start(Experiment.from_text(json.dumps(described)), folder)
                seen, at = {o.key: torch.randn(2, 2, *o.shape) for o in before.spec.observation}, (torch.randn(2, 16, 4), torch.full((2,), 50))
                found = [p.denoiser(*at, p.encoder.encode(seen, mask, pooled=False)) for p, mask in (
                    (before, torch.tensor([[1.0, 0.0]] * 2)), (turned, torch.tensor([[0.0, 1.0]] * 2)))]  # fmt: skip
                torch.testing.assert_close(*found)

    def test_a_history_keeps_its_scores_in_any_order_and_another_has_its_own(self):
        def remembering(*keys: str) -> Experiment:
            described = json.loads(with_history(experiment()).to_text())
            touched = described["observation"].pop()
            of = {"touched": {}, "lately": {"history": {"steps": 3}}, "felt": {"down_sample_steps": 5}}
            described["observation"] += [{**touched, "key": key, **of[key]} for key in keys]
            return Experiment.from_text(json.dumps(described))

        def places(policy: Policy) -> list[torch.Tensor]:
            return policy.encoder.histories["tactile"].places.detach()

        with tempfile.TemporaryDirectory() as name:
            folder, before = Path(name), random_policy(remembering("touched", "lately"))
            write(before, folder)
            first, second = places(before).split([4, 3])
            self.assertTrue(torch.equal(places(self.start(remembering("lately", "touched"), folder)), torch.cat([second, first])))
            self.assertTrue(torch.equal(places(self.start(remembering("lately"), folder)), second))
            for keys in (("felt",), ("touched", "felt"), ("felt", "lately", "touched")):
                spec = remembering(*keys)
                parts = {"touched": first, "lately": second, "felt": places(Policy(spec))[slice(4) if keys[0] == "felt" else slice(4, 8)]}
                self.assertTrue(torch.equal(places(self.start(spec, folder)), torch.cat([parts[key] for key in keys])), keys)

    def test_what_is_no_bundle_is_refused_with_its_folder(self):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            with self.assertRaisesRegex(ValueError, f"{folder}/policy.json: No such file or directory: name the folder of a bundle"):
                First.read(folder)
            written = write(random_policy(small()), folder)
            First.read(folder)
            for text in (
                "", "[]", "{", "null", '"text"',
                *(json.dumps({key: value for key, value in written.items() if key != gone}) for gone in ("action", "observations", "training")),
                *(json.dumps({**written, key: value}) for key in ("observations", "action", "training", "name") for value in (None, "Some Text", [1])),
            ):  # fmt: skip
                (folder / POLICY).write_text(text, encoding="utf-8")
                with self.subTest(text[:40]), self.assertRaisesRegex(ValueError, f"{folder}: not a bundle of rapid_policy.export: "):
                    First.read(folder)
            (folder / POLICY).write_text(json.dumps(written), encoding="utf-8")
            (folder / ENCODER).write_bytes(b"no graph")
            with self.assertRaisesRegex(ValueError, f"{folder}: not a bundle of rapid_policy.export: "):
                First.read(folder)

    def test_a_policy_that_is_to_remember_starts_as_one_that_holds_the_last(self):
        for kind in ("tactile-id-arm", "transformer"):
            with self.subTest(kind), tempfile.TemporaryDirectory() as name:
                folder, plain = Path(name), random_policy(experiment(kind))
                write(plain, folder)
                remembering = self.start(with_history(experiment(kind)), folder)
                (history,) = remembering.spec.histories
                size, sample, step = history.history.steps, torch.randn(2, 16, 4), torch.full((2,), 50)
                seen = {o.key: torch.randn(2, 2, *o.shape) for o in plain.spec.observation}
                still = seen["tactile"][:, :1]
                never = {history.key: torch.randn(2, size, *history.shape), history.valid: torch.zeros(2, size)}
                once = {history.key: still.expand(-1, size, -1, -1, -1), history.valid: torch.ones(2, size)}

                def denoised(policy, observations, mask, at=(sample, step)):
                    condition = policy.encoder.encode(observations, torch.tensor([mask] * 2), pooled=False)
                    return policy.denoiser(*at, condition)

                for remembered, stands in ((never, [1.0, 0.0]), (once, [1.0, 1.0])):
                    torch.testing.assert_close(
                        denoised(remembering, seen | remembered, [1.0, 1.0]), denoised(plain, seen, [1.0, 1.0])
                    )
                    held = seen | {"tactile": still.expand(-1, 2, -1, -1, -1)}
                    torch.testing.assert_close(
                        denoised(remembering, seen | remembered, [1.0, 0.0]), denoised(plain, held, stands), atol=2e-5, rtol=1e-4
                    )

    def test_the_bundle_of_the_repository_is_loaded(self):
        policy = load_policy(Path(__file__).parents[1] / "tactile-id")
        self.assertEqual(sum(p.numel() for p in policy.parameters()), 1_645_286)

    def test_limits_are_the_range_and_a_margin(self):
        described = policy_json(experiment(), {"normalization": RANGES}, {ENCODER: "", DENOISER: ""})
        limits = described["action"]["limits"]
        self.assertEqual(limits, {"min": [-1.1, -1.1, -0.05, -0.1], "max": [1.1, 1.1, 1.05, 2.1]})

    def test_what_the_program_does_with_pictures_and_actions_is_written(self):
        pictures = {"size": None, "resize": [120, 160], "crop": [96, 96], "color": "bgr", "down_sample_steps": 3}
        spec = observed(experiment(), "wrist", **pictures)
        described = policy_json(spec, {"normalization": RANGES}, {ENCODER: "", DENOISER: ""})
        wrist = described["observations"][0]
        self.assertEqual([o.get("down_sample_steps") for o in described["observations"]], [3, None, None])
        self.assertEqual(
            [wrist[key] for key in ("shape", "color", "resize", "crop")], [[3, 96, 96], "bgr", [120, 160], [96, 96]]
        )
        spec = observed(experiment(), "state", columns=[2, 3])
        two = {**RANGES, "state": {"mode": "min_max", "min": [0, 0], "max": [1, 1]}}
        described = policy_json(spec, {"normalization": two}, {ENCODER: "", DENOISER: ""})
        self.assertEqual([described["observations"][2][key] for key in ("shape", "slice")], [[2], [2, 4]])
        names = [f"n{i}" for i in range(8)]
        action = {"representation": "relative", "rotation": "rotation_6d", "names": names, "units": ["1"] * 8}
        action["base"] = {"modality": "arm", "position": [0, 3], "rotation": [4, 8]}
        ten, eight = ({"mode": "min_max", "min": [-1] * n, "max": [1] * n} for n in (10, 8))
        spec = experiment("tactile-id", action=action)
        ranges = {**RANGES, "action": ten, "executed": eight}
        described = policy_json(spec, {"normalization": ranges}, {ENCODER: "", DENOISER: ""})
        self.assertEqual(
            [described["action"][key] for key in ("representation", "rotation", "shape")],
            ["relative", "rotation_6d", [10]],
        )
        self.assertEqual([len(described["action"]["limits"]["min"]), described["action"]["base"]], [8, action["base"]])

    def test_a_history_is_written_and_has_no_column_of_the_mask(self):
        described = policy_json(experiment("tactile-id-memory"), {"normalization": RANGES}, {ENCODER: "", DENOISER: ""})
        found = {o["key"]: o.get("history") for o in described["observations"]}
        history = {"steps": 20, "valid": "touched_valid"}
        self.assertEqual(found, {"wrist": None, "tactile": None, "touched": history, "state": None})
        touched = described["observations"][2]
        self.assertEqual((touched["down_sample_steps"], touched["required"], "when_absent" in touched), (3, False, False))
        self.assertEqual(described["mask"]["order"], ["cam_wrist", "tactile_tip"])

    def test_the_program_makes_six_numbers_of_a_quaternion(self):
        parts = [{"modality": "phone", "take": "rotation_6d"}]
        six = {"mode": "min_max", "min": [-1] * 6, "max": [1] * 6}
        for slice_, rotation in (([4, 8], {"rotation": "rotation_6d"}), ([4, 10], {})):
            spec = observed(experiment("tactile-id"), "state", parts=parts, slice=slice_)
            described = policy_json(spec, {"normalization": {**RANGES, "state": six}}, {ENCODER: "", DENOISER: ""})
            state = described["observations"][2]
            self.assertEqual((state["shape"], state["slice"]), ([6], slice_))
            self.assertEqual({key: state[key] for key in state if key == "rotation"}, rotation)

    def test_a_card_is_written_of_every_experiment(self):
        facts = {
            "parameters": 10, "episodes": 2, "frames": 20, "recorded_by": ["rapid"], "episode_seeds": None,
            "episodes_sha256": "00", "iterations": 3, "batch_windows": 4, "draws": 2, "minutes": 1.0, "hardware": "a CPU",
            "seed": 0, "final_loss": 0.5, "difference": 1e-6, "command": "python", "tags": {"texture": {"a": 1, "b": 1}},
        }  # fmt: skip
        with tempfile.TemporaryDirectory() as name:
            for experiment_name in ("tactile-id-arm", "tactile-id", "tactile-id-memory", "vision"):
                write_card(experiment(experiment_name), facts, Path(name))
                card = (Path(name) / "README.md").read_text(encoding="utf-8")
                self.assertIn("2 episodes (1 a, 1 b), 20 ticks", card)
                self.assertEqual("the next pose of `phone`" in card, experiment_name in ("tactile-id", "tactile-id-memory"))
                self.assertEqual("20 steps over 57 ticks" in card, experiment_name == "tactile-id-memory")
                self.assertIn("error of the noise, mean of", card)
            write_card(observed(experiment(), "tactile", outcome=0.5), facts, Path(name))
            card = (Path(name) / "README.md").read_text(encoding="utf-8")
            self.assertIn("error of the noise and, times 0.5, of the outcome as `tactile` predicts it, mean of", card)


@unittest.skipUnless(RAPID, "skipped: no program in $RAPID_BIN")
class Program(unittest.TestCase):
    def rapid(self, *words: str) -> list[dict[str, Any]]:
        """The lines that the program prints."""
        done = subprocess.run([RAPID, *words, "--json"], capture_output=True, text=True, check=False)
        self.assertEqual(done.returncode, 0, done.stderr)
        return [json.loads(line) for line in done.stdout.splitlines()]

    def test_a_transformer_runs_in_the_program(self):
        with tempfile.TemporaryDirectory() as folder:
            write(random_policy(experiment("transformer")), Path(folder))
            shown = self.rapid("policy", "show", folder, "--sim", "task")[0]
            trial, condition = self.rapid("eval", folder, "--trials", "1", "--condition", "full")
        self.assertEqual((shown["policy"], shown["hash"]), ("transformer", condition["policy_hash"]))
        self.assertEqual(trial["status"], "normal")


if __name__ == "__main__":
    unittest.main()
