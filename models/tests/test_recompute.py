"""What `rapid policy observe` writes is enough to compute a chunk again, without the program."""

from __future__ import annotations

import sys
import unittest
from pathlib import Path

import numpy as np
from recorded import Folder, rapid

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "examples"))


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
            self.assertLess(apart, 1e-3)
            # The check can fail: with another noise it is another chunk.
            arrays["noise"] = -arrays["noise"]
            self.assertGreater(np.abs(recompute(policy, arrays) - arrays["recorded"]).max(), 1e-3)


if __name__ == "__main__":
    unittest.main()
