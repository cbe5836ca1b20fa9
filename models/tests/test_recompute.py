"""What `rapid policy observe` writes is enough to compute a chunk again, without the program."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
RAPID = os.environ.get("RAPID_BIN", "")
sys.path.insert(0, str(ROOT / "examples"))


@unittest.skipUnless(RAPID, "no program is built (RAPID_BIN)")
class Recompute(unittest.TestCase):
    """Chunks of a run of the simulated task."""

    def test_a_chunk_is_computed_again_by_onnxruntime_and_numpy(self) -> None:
        from recompute import recompute

        policy = ROOT / "models" / "tactile-id"
        with tempfile.TemporaryDirectory() as folder:
            run = [RAPID, "--infer", policy, "--sim", "task", "--duration", "4s", "--record", "--out", folder]
            subprocess.run(run, check=True, capture_output=True)
            episode = next(Path(folder).glob("*.mcap"))
            for number in (0, 2):
                to = Path(folder) / f"{number}.npz"
                observe = [RAPID, "policy", "observe", episode, policy, "--chunk", str(number), "--to", to]
                subprocess.run(observe, check=True, capture_output=True)
                arrays = dict(np.load(to))
                apart = np.abs(recompute(policy, arrays) - arrays["recorded"]).max()
                self.assertLess(apart, 1e-3)
                # The check can fail: with another noise it is another chunk.
                arrays["noise"] = -arrays["noise"]
                self.assertGreater(np.abs(recompute(policy, arrays) - arrays["recorded"]).max(), 1e-3)


if __name__ == "__main__":
    unittest.main()
