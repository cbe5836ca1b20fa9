"""Small random checkpoints, written by LeRobot itself as its training writes them, and the exporter's command."""

import contextlib
import io
import json
import os
import shutil
import sys
import tempfile
import unittest
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

os.environ["HF_HUB_OFFLINE"] = "1"
# Threads that wait busily for one another make this many times slower on a machine that has other work.
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.policies.diffusion.processor_diffusion import make_diffusion_pre_post_processors

import export_lerobot

TOP, WRIST, STATE, ACTION = "observation.images.top", "observation.images.wrist", "observation.state", "action"
STATE_LEN, ACTION_LEN = 5, 3


@dataclass
class Case:
    """A checkpoint, and how it is exported."""

    cameras: list[str] = field(default_factory=lambda: [TOP])
    height: int = 64
    width: int = 64
    modes: dict[str, str] = field(default_factory=dict)
    # More of DiffusionConfig.
    settings: dict = field(default_factory=dict)
    # Statistics by key and name, over the random ones.
    stats: dict[str, dict] = field(default_factory=dict)
    arguments: list[str] = field(default_factory=list)


def write(case: Case, folder: Path) -> None:
    """Makes the checkpoint as LeRobot's training saves one."""
    torch.manual_seed(0)
    image = PolicyFeature(FeatureType.VISUAL, (3, case.height, case.width))
    config = DiffusionConfig(
        device="cpu",
        input_features={key: image for key in case.cameras} | {STATE: PolicyFeature(FeatureType.STATE, (STATE_LEN,))},
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (ACTION_LEN,))},
        down_dims=(32, 64),
        **case.settings,
    )
    config.normalization_mapping |= {kind: NormalizationMode(mode) for kind, mode in case.modes.items()}
    stats = {key: statistics(3, 1, 1) for key in case.cameras}
    stats |= {STATE: statistics(STATE_LEN), ACTION: statistics(ACTION_LEN)}
    for key, given in case.stats.items():
        stats[key] |= {name: torch.tensor(values) for name, values in given.items()}
    policy = DiffusionPolicy(config)
    for module in policy.modules():
        # Fresh running statistics are 0 and 1, with which batch normalisation would show nothing.
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.uniform_(-0.1, 0.1)
            module.running_var.uniform_(0.5, 1.5)
    for part in (policy, *make_diffusion_pre_post_processors(config, stats)):
        part.save_pretrained(folder)


def statistics(*shape: int) -> dict[str, torch.Tensor]:
    low = torch.rand(shape) - 0.6
    names = {"min": 0.0, "q01": 0.1, "q10": 0.2, "mean": 0.5, "q90": 0.8, "q99": 0.9, "max": 1.0}
    width = 0.5 + torch.rand(shape)
    return {name: low + part * width for name, part in names.items()} | {"std": 0.2 + torch.rand(shape)}


def run(*arguments) -> SimpleNamespace:
    """The command as a user gives it: status, what it printed, its errors."""
    out, complaint = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(complaint):
        status = export_lerobot.main([str(argument) for argument in arguments])
    return SimpleNamespace(status=status, out=out.getvalue(), complaint=complaint.getvalue())


class Temporary(unittest.TestCase):
    def setUp(self):
        self.folder = Path(tempfile.mkdtemp())
        self.addCleanup(shutil.rmtree, self.folder)
        self.source, self.bundle = self.folder / "checkpoint", self.folder / "bundle"

    def edit(self, file: Path, change) -> None:
        content = json.loads(file.read_text())
        change(content)
        file.write_text(json.dumps(content))
