"""The networks: what the mask hides, what dropout takes away, and that a bundle's graphs hold the whole policy."""

import sys
import tempfile
import unittest
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from rapid_policy.bundle import DENOISER, ENCODER, encoder_inputs, policy_json
from rapid_policy.export import denoiser_example, encoder_example, largest_difference, write_graph
from rapid_policy.model import Policy
from rapid_policy.spec import Spec, tactile_id
from rapid_policy.train import drop
from rapid_policy.weights import load_policy

RANGES = {
    "state": {"mode": "min_max", "min": [0, 0, 0, 0], "max": [1, 1, 1, 1]},
    "action": {"mode": "min_max", "min": [-1, -1, 0, 0], "max": [1, 1, 1, 2]},
}


def random_policy(spec: Spec) -> Policy:
    """With weights that are all different: those of a new network are ones and zeros in places."""
    torch.manual_seed(0)
    policy = Policy(spec).eval()
    with torch.no_grad():
        for weight in policy.parameters():
            weight.add_(torch.randn_like(weight) * 0.05)
    return policy


class Mask(unittest.TestCase):
    def test_an_absent_picture_changes_nothing_even_if_it_is_not_a_number(self):
        spec = tactile_id()
        policy = random_policy(spec)
        wrist, tactile, state, _ = encoder_example(spec)
        absent = torch.tensor([[1.0, 0.0]]).repeat(2, 1)
        with torch.no_grad():
            plain = policy.encoder(wrist, tactile, state, absent)
            spoilt = policy.encoder(wrist, tactile * torch.nan, state, absent)
            present = policy.encoder(wrist, tactile, state, torch.ones(2, 2))
        self.assertTrue(torch.equal(plain, spoilt))
        self.assertFalse(torch.equal(plain, present))

    def test_dropout_leaves_one_picture_and_brings_none_back(self):
        spec = tactile_id()
        random = np.random.default_rng(0)
        present = torch.ones(20_000, 2, dtype=torch.bool)
        kept = drop(spec, present, random)
        self.assertEqual(float(kept.amax(1).min()), 1)
        # Each is taken with 0.3; both with 0.09, and then one of them comes back by lot.
        for share in (1 - kept.mean(0)).tolist():
            self.assertAlmostEqual(share, 0.3 - 0.09 / 2, delta=0.015)
        present[:, 0] = False
        kept = drop(spec, present, random)
        self.assertEqual((float(kept[:, 0].max()), float(kept[:, 1].min())), (0, 1))


class Bundle(unittest.TestCase):
    def test_graphs_equal_pytorch_and_hold_its_weights(self):
        import json

        for spec in (tactile_id(), replace(tactile_id(), name="without-mask", mask_aware=False)):
            with self.subTest(spec.name), tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                policy = random_policy(spec)
                write_graph(policy.encoder, encoder_example(spec), encoder_inputs(spec), "c", folder / ENCODER)
                inputs = ["sample", "timestep", "global_cond"]
                write_graph(policy.denoiser, denoiser_example(spec), inputs, "e", folder / DENOISER)
                self.assertLess(largest_difference(spec, policy, folder), 1e-4)
                hashes = {ENCODER: "", DENOISER: ""}
                described = policy_json(spec, {"normalization": RANGES}, hashes)
                self.assertEqual(described["mask"] is None, not spec.mask_aware)
                (folder / "policy.json").write_text(json.dumps(described))
                again = load_policy(folder)
                for key, weight in policy.state_dict().items():
                    self.assertTrue(torch.equal(weight, again.state_dict()[key]), key)

    def test_limits_are_the_range_and_a_margin(self):
        described = policy_json(tactile_id(), {"normalization": RANGES}, {ENCODER: "", DENOISER: ""})
        limits = described["action"]["limits"]
        self.assertEqual(limits, {"min": [-1.1, -1.1, -0.05, -0.1], "max": [1.1, 1.1, 1.05, 2.1]})

    def test_a_checkpoint_brings_its_description_back(self):
        spec = tactile_id()
        self.assertEqual(Spec.from_dict(spec.to_dict()), spec)


if __name__ == "__main__":
    unittest.main()
