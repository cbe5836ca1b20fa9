"""What is learned of a path of poses, and what the program must execute of it: `tests/golden/poses.json`, on which the
program's own tests run (`src/policy/compose/tests.rs`).

python tests/test_composed.py --write    # writes it again, after a change of the convention
"""

import json
import sys
import unittest
from pathlib import Path
from typing import Any

import numpy as np
from made_up import by_hand, experiment, path, turn

from rapid_policy import poses
from rapid_policy.dataset import Dataset

GOLDEN = Path(__file__).parents[2] / "tests" / "golden" / "poses.json"
LENGTH = 40
EXECUTED = {"none": 4, "rotation_6d": 8, "quaternion": 8}


def recorded() -> np.ndarray:
    """[T, 4, 4] poses turned so far that the last number of their quaternions changes its sign on the way."""
    out = path(LENGTH)
    out[:, :3, :3] = turn(np.array([-0.292, 3.02, -0.195])) @ out[:, :3, :3]
    return out


def continuous(quaternions: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Of each quaternion and its negative the one nearer to the one before."""
    out = quaternions.copy()
    for i, q in enumerate(out):
        before = out[i] = -q if q @ before < 0 else q
    return out


def case(representation: str, rotation: str, tick: int) -> dict[str, Any]:
    """A window at `tick`: what is learned of it, and what is executed: the poses of the next ticks."""
    given, names = recorded(), [f"n{i}" for i in range(EXECUTED[rotation])]
    action: dict[str, Any] = {"representation": representation, "rotation": rotation, "gripper_squeeze": 0.0}
    action |= {"names": names, "units": ["1"] * len(names)}
    if representation != "absolute":
        turned = {} if rotation == "none" else {"rotation": [3, 7]}
        action["base"] = {"modality": "arm", "position": [0, 3], **turned}
    spec, episode = experiment("tactile-id", action=action), by_hand(LENGTH)
    episode.value("phone")[:] = given.transpose(0, 2, 1).reshape(LENGTH, 16)
    dataset = Dataset(spec, [episode])
    dataset.windows = dataset.windows[dataset.windows[:, 0] == tick]
    batch = dataset.gather(dataset.plan(np.random.default_rng(0), 1))
    output = dataset.ranges["action"].invert(batch.actions.numpy())[0]
    done = np.maximum(tick - spec.action_start + np.arange(spec.policy.horizon), 0) + 1
    quaternions = poses.quaternions(given[:, :3, :3])
    first = np.array([0.0, 0, 0, 1]) if representation == "absolute" else quaternions[tick]
    turned = [continuous(quaternions[done], first)] if rotation != "none" else []
    opening = (done[:, None] % 7) / 7
    return {
        "representation": representation,
        "rotation": None if rotation == "none" else rotation,
        "base": [*given[tick, :3, 3], *quaternions[tick]],
        "output": output.round(8).tolist(),
        "executed": np.concatenate([given[done, :3, 3], *turned, opening], 1).round(12).tolist(),
    }


def golden() -> dict[str, Any]:
    cases = [
        case(representation, rotation, tick)
        for representation in ("absolute", "relative", "delta")
        for rotation in EXECUTED
        for tick in (0, 12)
    ]
    rotations = recorded()[::5, :3, :3]
    six, four = poses.rotation_6d(rotations), poses.quaternions(rotations)
    return {"actions": cases, "observations": [[q.tolist(), s.tolist()] for q, s in zip(four, six, strict=True)]}


class Golden(unittest.TestCase):
    def test_the_file_is_what_training_computes(self):
        found, file = golden(), json.loads(GOLDEN.read_text(encoding="utf-8"))
        self.assertEqual(len(found["actions"]), len(file["actions"]))
        for one, other in zip(found["actions"], file["actions"], strict=True):
            self.assertEqual([one[key] for key in ("representation", "rotation")],
                             [other[key] for key in ("representation", "rotation")])  # fmt: skip
            for key in ("base", "output", "executed"):
                np.testing.assert_allclose(one[key], other[key], atol=1e-6)
        for one, other in zip(found["observations"], file["observations"], strict=True):
            for numbers, wanted in zip(one, other, strict=True):
                np.testing.assert_allclose(numbers, wanted, atol=1e-9)

    def test_a_quaternion_changes_its_sign_in_it(self):
        # Otherwise nothing in the file would show that the nearer one is taken.
        case = next(c for c in golden()["actions"] if c["representation"] == "absolute" and c["rotation"])
        last = np.array(case["executed"])[:, 6]
        self.assertTrue((last < 0).any() and (last > 0).any(), last)


if __name__ == "__main__":
    if "--write" in sys.argv:
        GOLDEN.write_text(json.dumps(golden()) + "\n", encoding="utf-8")
    else:
        unittest.main()
