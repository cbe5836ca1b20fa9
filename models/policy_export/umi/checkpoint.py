"""Reads the file of a checkpoint: a pickle of `cfg` and `state_dicts`, as diffusion_policy/workspace/base_workspace.py
writes it with dill.

Invariant: the pickle may hold tensors, plain data and containers of OmegaConf. The latter are not made: a record takes
their place. Any other class or function is refused by name, before anything of it is called.
"""

import itertools
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .. import Unsupported


# Of a configuration. UMI's have about a thousand.
MOST_VALUES = 100_000


class TooLarge(Exception):
    """A configuration of more than `MOST_VALUES`."""


class Record:
    """Takes the place of an object of OmegaConf, and keeps what it was pickled with."""

    def __setstate__(self, state: Any) -> None:
        self.state = state


def empty(*_: Any) -> dict:
    """Takes the place of types and caches, which are in the metadata of OmegaConf alone."""
    return {}


CLASSES = ("dictconfig.DictConfig", "listconfig.ListConfig", "base.ContainerMetadata", "base.Metadata") + tuple(
    f"nodes.{kind}Node" for kind in ("Any", "String", "Integer", "Float", "Boolean")
)
ALLOWED = [
    *((Record, f"omegaconf.{name}") for name in CLASSES),
    *((empty, name) for name in ("typing.Any", "dill._dill._load_type", "collections.defaultdict")),
]


def find(path: Path) -> Path:
    """The file of the checkpoint, which `path` is or, as the folder of a training, has."""
    file = path if path.is_file() else path / "checkpoints" / "latest.ckpt"
    if not file.is_file():
        raise Unsupported(f"{path}: neither a file *.ckpt nor a folder with checkpoints/latest.ckpt")
    return file


def read(file: Path) -> tuple[dict, dict[str, dict[str, Tensor]]]:
    """`cfg` as plain data, and the weights of `model` and `ema_model` by name."""
    try:
        with torch.serialization.safe_globals(ALLOWED):
            # Mapped: what is not used, such as the optimizer's state, is not read.
            payload = torch.load(file, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:  # the container, the unpickler and its stack each have their own
        raise Unsupported(f"{file}: {reason(error)}") from error
    if not isinstance(payload, dict) or not {"cfg", "state_dicts"} <= set(payload):
        raise Unsupported(f"{file}: no cfg and state_dicts in it: not a checkpoint of UMI's training")
    try:
        cfg = plain(payload["cfg"], itertools.count(1))
    except TooLarge as error:
        raise Unsupported(f"{file}: cfg: more than {MOST_VALUES} values, counted where each is used") from error
    except (AttributeError, KeyError, TypeError, RecursionError) as error:
        raise Unsupported(f"{file}: cfg: not a configuration of OmegaConf: {error!r}") from error
    if not isinstance(cfg, dict):
        raise Unsupported(f"{file}: cfg: not a table of keys")
    return cfg, weights(file, payload["state_dicts"])


def reason(error: Exception) -> str:
    """The error of torch.load in one line."""
    text = str(error)
    if found := re.search(r"GLOBAL (\S+)", text):
        return (
            f"its pickle uses {found[1].rstrip('.')}, which is not plain data, and running a checkpoint's code "
            "is not safe: save it again with cfg and state_dicts alone"
        )
    lines = text.rpartition("WeightsUnpickler error:")[2].split("\n")
    return f"not a file of torch.save: {next((line.strip() for line in lines if line.strip()), repr(error))}"


def plain(value: Any, used: Iterator[int]) -> Any:
    """Configurations as dicts and lists. `used` counts their values: a pickle of a few bytes may name one value many times."""
    if next(used) > MOST_VALUES:
        raise TooLarge
    if isinstance(value, Record):
        state = value.state
        return plain(state["_content"] if "_content" in state else state["_val"], used)
    if isinstance(value, dict):
        return {str(plain(key, used)): plain(item, used) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item, used) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)  # JSON has no such numbers
    if not isinstance(value, (str, int, float, type(None))):
        raise TypeError(f"a value of {type(value).__name__}")
    return value


def weights(file: Path, state_dicts: Any) -> dict[str, dict[str, Tensor]]:
    found = {}
    for name in ("model", "ema_model"):
        if (state := state_dicts.get(name) if isinstance(state_dicts, dict) else None) is None:
            continue
        if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
            raise Unsupported(f"{file}: state_dicts.{name}: not a table of tensors")
        found[name] = state
    return found
