"""The sampler, and normalisation there and back."""

import json
import sys
import unittest
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from rapid_policy.diffusion import add_noise, alphas_cumprod, betas, ddim, ddim_timesteps
from rapid_policy.normalize import MinMax


# What the program's own scheduler is tested with, computed by the diffusers library.
GOLDEN = Path(__file__).parents[2] / "tests" / "golden" / "scheduler.json"
OURS = ("ddim_T100_n10_eps", "ddim_T100_n16_eps", "ddim_umi_T50_n16_eps")


class Sampler(unittest.TestCase):
    def test_every_step_is_that_of_diffusers(self):
        cases = json.loads(GOLDEN.read_text())["cases"]
        for name in OURS:
            case = cases[name]
            timesteps, expected = case["cfg"]["num_train_timesteps"], torch.tensor(case["x"]).reshape(-1, 1, 16, 4)
            wave = 0.3 * torch.sin(torch.arange(64.0)).reshape(1, 16, 4)
            seen = []

            def denoise(sample, timestep, wave=wave, timesteps=timesteps, seen=seen):
                seen.append(sample)
                return torch.tanh(0.7 * sample + wave - timestep[:, None, None] / timesteps)

            with self.subTest(name):
                self.assertEqual(ddim_timesteps(case["n"], timesteps), case["timesteps"])
                torch.testing.assert_close(alphas_cumprod(timesteps), torch.tensor(case["alphas_cumprod"]))
                last = ddim(denoise, expected[0], case["n"], timesteps)
                torch.testing.assert_close(torch.stack([*seen, last]), expected, atol=1e-5, rtol=0)

    def test_the_tables_fall_and_end_at_their_caps(self):
        table = alphas_cumprod()
        self.assertEqual(len(table), 100)
        self.assertTrue((table[1:] < table[:-1]).all())
        self.assertAlmostEqual(float(betas()[-1]), 0.999, places=6)
        self.assertGreater(float(table[0]), 0.999)
        self.assertLess(float(table[-1]), 1e-4)

    def test_steps_are_spaced_leading(self):
        self.assertEqual(ddim_timesteps(10), [90, 80, 70, 60, 50, 40, 30, 20, 10, 0])
        self.assertEqual(ddim_timesteps(16)[:2], [90, 84])
        self.assertEqual(ddim_timesteps(100)[-1], 0)
        for steps in (0, 101):
            with self.assertRaises(ValueError):
                ddim_timesteps(steps)

    def test_whoever_knows_the_noise_gets_the_sample_back(self):
        torch.manual_seed(0)
        clean = torch.rand(3, 16, 4) * 2 - 1
        table = alphas_cumprod()

        def knowing(sample, timestep):
            alpha = table[timestep][:, None, None]
            return (sample - alpha.sqrt() * clean) / (1 - alpha).sqrt()

        for steps in (1, 4, 10, 50):
            sampled = ddim(knowing, torch.randn(3, 16, 4), steps)
            self.assertLess(float((sampled - clean).abs().max()), 1e-3, f"{steps} steps")

    def test_noise_is_added_by_the_table(self):
        clean, noise = torch.full((2, 16, 4), 0.5), torch.full((2, 16, 4), -1.0)
        noised = add_noise(clean, noise, torch.tensor([0, 99]), alphas_cumprod())
        self.assertLess(float((noised[0] - clean[0]).abs().max()), 0.05)
        self.assertLess(float((noised[1] - noise[1]).abs().max()), 0.01)


class Normalisation(unittest.TestCase):
    def test_there_and_back(self):
        random = np.random.default_rng(0)
        values = random.normal(3, [0.1, 1, 10], (50, 3))
        scale = MinMax.of("state", values)
        unit = scale.apply(values)
        self.assertEqual((unit.min(), unit.max()), (-1, 1))
        np.testing.assert_allclose(scale.invert(unit), values, atol=1e-5)
        again = MinMax.from_dict(scale.to_dict())
        np.testing.assert_array_equal(again.low, scale.low)

    def test_a_dimension_without_range_is_refused_by_name(self):
        with self.assertRaisesRegex(ValueError, "state: dimension 1 "):
            MinMax.of("state", np.array([[0.0, 2.0], [1.0, 2.0]]))


if __name__ == "__main__":
    unittest.main()
