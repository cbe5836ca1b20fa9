"""Episodes of tests that no program recorded, and the experiments of the repository in small."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

MODELS = Path(__file__).parents[1]
sys.path.insert(0, str(MODELS))

from rapid_policy.episodes import Episode, Facts
from rapid_policy.experiment import Experiment
from rapid_policy.experiment_file import read_experiment

EXPERIMENTS = MODELS / "experiments"
CLASSIFIERS = [EXPERIMENTS / "texture.toml"]
POLICIES = sorted(set(EXPERIMENTS.glob("*.toml")) - set(CLASSIFIERS))
SIDE = 96


def experiment(name: str = "tactile-id-arm", **tables: dict[str, Any]) -> Experiment:
    """An experiment of the repository, with other values in its tables; it learns no outcomes unless they are asked for."""
    described = json.loads(read_experiment(EXPERIMENTS / f"{name}.toml").to_text())
    for o in described["observation"]:
        o.pop("outcome", None)
    for table, values in tables.items():
        described[table] = {**described.get(table, {}), **values}
    return Experiment.from_text(json.dumps(described))


def small(name: str = "tactile-id-arm", **training: Any) -> Experiment:
    """The same with small networks."""
    denoiser = {"layers": 2, "heads": 2, "width": 32} if name == "transformer" else {"widths": [8, 16]}
    sizes = {"encoder": {"width": 8, "features": 8, "keypoints": 4}, "denoiser": denoiser}
    training = {"iterations": 8, "windows": 4, "draws": 2, "warmup": 2, **training}
    if "epochs" in training:
        training["iterations"] = None
    return experiment(name, **sizes, training=training)


def observed(spec: Experiment, key: str, **values: Any) -> Experiment:
    """The experiment with another observation."""
    described = json.loads(spec.to_text())
    for o in described["observation"]:
        if o["key"] == key:
            o.update(values)
    return Experiment.from_text(json.dumps(described))


def with_history(spec: Experiment) -> Experiment:
    """The same, which remembers what it touched."""
    described = json.loads(spec.to_text())
    tactile = next(o for o in described["observation"] if o["key"] == "tactile")
    touched = {key: value for key, value in tactile.items() if key != "dropout"}
    described["observation"].append({**touched, "key": "touched", "history": {"steps": 4}})
    return Experiment.from_text(json.dumps(described))


def twelve_steps(**tables: dict[str, Any]) -> Experiment:
    """`tactile-id-memory` with a history of twelve steps, half a second apart."""
    return observed(experiment("tactile-id-memory", **tables), "touched", down_sample_steps=5, history={"steps": 12})


def presence(length: int, *names: str) -> dict[str, np.ndarray]:
    """The arrays of modalities that are there in every row."""
    return {f"{what} {name}": np.ones(length, bool) for name in names for what in ("present", "plugged", "running")}


def made_up(length: int, seed: int = 0) -> Episode:
    """An episode in which everything is there; the number of the tick is in every picture and vector."""
    random = np.random.default_rng(seed)
    count = np.arange(length)
    pictures = np.broadcast_to(count[:, None, None, None], (length, SIDE, SIDE, 3)).astype(np.uint8)
    arrays = {
        "ticks": count.astype(np.int64),
        "times": count * 100_000_000,
        "value cam_wrist": pictures,
        "value tactile_tip": pictures + 100,
        "value arm": count[:, None] + random.uniform(0, 1, (length, 4)),
        "first cam_wrist": np.zeros(1, np.int64),
        "first tactile_tip": np.zeros(1, np.int64),
        "actions": np.repeat(count[:, None] * 1.0, 4, 1),
        "acted": np.ones(length, bool),
    }
    arrays |= presence(length, "cam_wrist", "tactile_tip", "arm")
    return Episode(Path(f"made-up-{seed}"), Facts(), arrays, f"{seed:064x}")


def by_hand(length: int, seed: int = 0, layout: str = "columns") -> Episode:
    """A handheld demonstration: a pose that turns on its way, an opening, no arm and no action."""
    episode = made_up(length, seed)
    poses = path(length, seed)
    numbers = {"columns": poses.transpose(0, 2, 1), "rows": poses}[layout].reshape(length, 16)
    arrays = {name: array for name, array in episode.arrays.items() if not name.endswith(" arm")}
    arrays |= presence(length, "phone", "gripper") | {
        "value phone": numbers,
        "value gripper": (np.arange(length)[:, None] % 7) / 7.0,
        "actions": np.zeros((length, 0)),
        "acted": np.zeros(length, bool),
    }
    return Episode(episode.path, Facts(layouts={"phone": layout}), arrays, episode.sha256)


def path(length: int, seed: int = 0) -> np.ndarray:
    """[T, 4, 4] poses: each further, and turned about all axes."""
    random = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (length, 1, 1))
    steps = random.normal(0, 0.05, (length, 3))
    poses[:, :3, 3] = steps.cumsum(0)
    for t in range(1, length):
        poses[t, :3, :3] = poses[t - 1, :3, :3] @ turn(random.normal(0, 0.1, 3))
    return poses


def turn(axis: np.ndarray) -> np.ndarray:
    """The rotation about an axis by its length (Rodrigues)."""
    angle = np.linalg.norm(axis)
    x, y, z = axis / max(angle, 1e-12)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
