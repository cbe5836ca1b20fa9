"""What `rapid policy observe` writes is enough to compute a chunk again, without the program."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

import numpy as np
import torch
from made_up import small
from recorded import Folder, rapid
from test_networks import random_policy, write

from rapid_policy.bundle import encoder_inputs
from rapid_policy.diffusion import ddim
from rapid_policy.export import encoder_example

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "examples"))


class History(unittest.TestCase):
    """A chunk of a policy that remembers, which no program computed."""

    def test_its_arrays_are_named_as_the_inputs(self) -> None:
        from recompute import recompute

        spec = small("tactile-id-memory")
        # Without the picture of now, for which the history stands.
        policy, inputs = random_policy(spec), encoder_example(spec, 1, (1, 0))
        noise = torch.randn(1, spec.policy.horizon, spec.action_length)
        with torch.no_grad():
            condition = policy.encoder(*inputs)
            wanted = ddim(lambda x, t: policy.denoiser(x, t, condition), noise, spec.policy.inference_steps)[0]
        arrays = dict(zip(encoder_inputs(spec), (value.numpy() for value in inputs), strict=True)) | {"noise": noise.numpy()}
        with tempfile.TemporaryDirectory() as folder:
            (part,) = write(policy, Path(folder))["action"]["normalization"]
            low, high = np.array(part["min"]), np.array(part["max"])
            expected = (wanted.numpy() + 1) / 2 * (high - low) + low
            self.assertLess(np.abs(recompute(Path(folder), arrays) - expected).max(), 1e-4)
            for recorded, code in ((expected, 0), (expected + 0.0002, 1), (expected * np.nan, 1)):
                chunk = Path(folder) / "chunk.npz"
                np.savez(chunk, **arrays, recorded=recorded)
                command = [sys.executable, str(ROOT / "examples" / "recompute.py"), folder, str(chunk)]
                done = subprocess.run(command, capture_output=True, text=True, check=False)
                self.assertEqual((done.returncode, done.stderr), (code, ""))
            # A step that is not there counts for nothing, and one that is for something.
            there = arrays["touched_valid"][..., None, None, None] > 0
            arrays["touched"] = np.where(there, arrays["touched"], 7).astype(np.float32)
            self.assertLess(np.abs(recompute(Path(folder), arrays) - expected).max(), 1e-4)
            arrays["touched"] = -arrays["touched"]
            self.assertGreater(np.abs(recompute(Path(folder), arrays) - expected).max(), 1e-3)


class Recompute(Folder):
    """Chunks of a run of the simulated task."""

    def test_a_chunk_is_computed_again_by_onnxruntime_and_numpy(self) -> None:
        from recompute import recompute

        policy = ROOT / "models" / "tactile-id"
        rapid("--infer", str(policy), "--sim", "task", "--duration", "4s", "--record", "--out", ".", cwd=self.folder)
        episode = next(self.folder.glob("*.mcap"))
        for number in (0, 2):
            to = self.folder / f"{number}.npz"
            rapid("policy", "observe", str(episode), str(policy), "--chunk", str(number), "--to", str(to), cwd=self.folder)
            arrays = dict(np.load(to))
            apart = np.abs(recompute(policy, arrays) - arrays["recorded"]).max()
            self.assertLess(apart, 1e-4)
            # The check can fail: with another noise it is another chunk.
            arrays["noise"] = -arrays["noise"]
            self.assertGreater(np.abs(recompute(policy, arrays) - arrays["recorded"]).max(), 1e-3)


if __name__ == "__main__":
    unittest.main()
