"""Checkpoints as UMI writes them, without its code: the files in `umi/` have what its code computed of them.

The layout is that of diffusion_policy/workspace/base_workspace.py (the file), policy/diffusion_unet_timm_policy.py and
model/vision/timm_obs_encoder.py (the weights). `umi/NAME.json`: `cfg`, the names and shapes of the weights, the numbers
of the normaliser, samples of an arm; and of these what UMI computed: the condition, the actions, and the poses it
executes (x y z, rotation vector, width), in a run without chance: the middle of the random crop, no change of colours,
the noise of `noise()`. `umi/parts.json`: networks of timm
0.9.7 and the aggregations of TimmObsEncoder, for the features in `features()`. `umi/original.ckpt.gz`: a file that
BaseWorkspace.save_checkpoint wrote, with the configuration of the U-Net and a model of two numbers.
"""

from __future__ import annotations

import contextlib
import copy
import io
import json
import shutil
import sys
import tempfile
import types
import unittest
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

import export_umi_policy

FOLDER = Path(__file__).parent / "umi"
# What the golden cases are exported with, besides the rotation at the start.
RIG = ("--hz", "20", "--pose", "arm.0-6", "--gripper", "arm.7", "--low=-2,-2,-2", "--high=2,2,2")


def golden(name: str) -> dict[str, Any]:
    return json.loads((FOLDER / f"{name}.json").read_text())


def value(name: str, shape: list[int]) -> torch.Tensor:
    """The weight of that name: random, but always the same."""
    found = np.random.RandomState(zlib.crc32(name.encode())).standard_normal(shape).astype(np.float32)
    if name.endswith("num_batches_tracked"):
        return torch.zeros(shape, dtype=torch.int64)
    if name.endswith("running_var"):
        return torch.from_numpy(np.abs(found) + np.float32(0.5))
    if len(shape) > 1:
        return torch.from_numpy(found / np.float32(np.sqrt(np.prod(shape[1:]))))
    return torch.from_numpy(np.asarray(float(name.endswith("weight")) + np.float32(0.1) * found, np.float32))


def weights(layout: dict[str, list[int]], normalizer: dict[str, list[float]]) -> dict[str, torch.Tensor]:
    found = {name: value(name, shape) for name, shape in layout.items()}
    return found | {name: torch.tensor(numbers) for name, numbers in normalizer.items()}


def pictures(case: dict[str, Any]) -> dict[str, np.ndarray]:
    """[T, 3, H, W] of each camera."""
    random, seen = np.random.RandomState(5), case["cfg"]["task"]["shape_meta"]["obs"]
    rgb = {key: spec for key, spec in seen.items() if spec["type"] == "rgb"}
    return {
        key: random.randint(0, 256, (spec["horizon"], *spec["shape"])).astype(np.uint8) for key, spec in rgb.items()
    }


def noise(horizon: int = 16) -> np.ndarray:
    return np.random.RandomState(9).standard_normal((1, horizon, 10)).astype(np.float32)


def features(seed: int, *shape: int) -> torch.Tensor:
    return torch.from_numpy(np.random.RandomState(seed).standard_normal(shape).astype(np.float32))


def container(plain: Any, made: dict[str, type]) -> Any:
    """Plain data as OmegaConf holds it."""
    out = object.__new__(made[{dict: "DictConfig", list: "ListConfig"}.get(type(plain), "AnyNode")])
    vars(out)["_metadata"] = object.__new__(made["ContainerMetadata"])
    if isinstance(plain, dict):
        vars(out)["_content"] = {key: container(item, made) for key, item in plain.items()}
    elif isinstance(plain, list):
        vars(out)["_content"] = [container(item, made) for item in plain]
    else:
        vars(out)["_val"] = plain
    return out


@contextlib.contextmanager
def omegaconf():
    """Classes with the names of OmegaConf's, for as long as something is pickled."""
    places = {
        "dictconfig": ["DictConfig"],
        "listconfig": ["ListConfig"],
        "nodes": ["AnyNode"],
        "base": ["ContainerMetadata"],
    }
    modules, made = {"omegaconf": types.ModuleType("omegaconf")}, {}
    for place, names in places.items():
        module = modules[f"omegaconf.{place}"] = types.ModuleType(f"omegaconf.{place}")
        for name in names:
            made[name] = type(name, (), {"__module__": module.__name__})
            setattr(module, name, made[name])
    before = {name: sys.modules.get(name) for name in modules}
    sys.modules.update(modules)
    try:
        yield made
    finally:
        for name, module in before.items():
            sys.modules.pop(name) if module is None else sys.modules.update({name: module})


def write(file: Path, cfg: dict[str, Any], **state_dicts: dict[str, torch.Tensor]) -> None:
    with omegaconf() as made:
        payload = {"cfg": container(cfg, made), "state_dicts": state_dicts, "pickles": {"epoch": b"not a pickle"}}
        torch.save(payload, file)


def run(*arguments: Any) -> SimpleNamespace:
    """The command as a user gives it: status, what it printed, its errors."""
    out, complaint = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(complaint):
        status = export_umi_policy.main([str(argument) for argument in arguments])
    return SimpleNamespace(status=status, out=out.getvalue(), complaint=complaint.getvalue())


class Temporary(unittest.TestCase):
    def setUp(self) -> None:
        self.folder = Path(tempfile.mkdtemp())
        self.addCleanup(shutil.rmtree, self.folder)
        self.file, self.bundle = self.folder / "latest.ckpt", self.folder / "bundle"
        torch.set_num_threads(1)

    def write(self, case: dict[str, Any]) -> None:
        """The checkpoint of a golden case. The averaged weights are the golden ones."""
        averaged = weights(case["layout"], case["normalizer"])
        write(self.file, case["cfg"], model={name: found * 2 for name, found in averaged.items()}, ema_model=averaged)

    def changed(self, change: Any, name: str = "resnet") -> dict[str, Any]:
        """The configuration of a golden case, changed. UMI's has its shapes in several places."""
        cfg = copy.deepcopy(golden(name)["cfg"])
        shapes = cfg["policy"]["shape_meta"]
        cfg["policy"]["obs_encoder"]["shape_meta"] = cfg["task"]["shape_meta"] = cfg["shape_meta"] = shapes
        change(cfg)
        return cfg
