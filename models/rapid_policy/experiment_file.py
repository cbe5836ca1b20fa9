"""Reads an experiment from a TOML file: of a policy, or of a classifier. Every mistake is one line: file, key, cause and fix."""

from __future__ import annotations

import difflib
import json
import tomllib
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from .classification import Classification
from .experiment import Experiment

Location = tuple[int | str, ...]
Kind = TypeVar("Kind", Experiment, Classification)


class ExperimentError(Exception):
    """The mistakes of a file, one per line."""


def read_experiment(path: Path) -> Experiment:
    """The experiment in the file. Its folders and its file of weights are made absolute."""
    return _read(path, Experiment)


def read_classification(path: Path) -> Classification:
    """The same for a classifier."""
    return _read(path, Classification)


def _read(path: Path, kind: type[Kind]) -> Kind:
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ExperimentError(f"{path}: cannot be read: {error.strerror}: name an experiment (*.toml)") from error
    except UnicodeDecodeError as error:
        raise ExperimentError(f"{path}: not text: {error}: name an experiment (*.toml)") from error
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ExperimentError(f"{path}: not TOML: {error}: correct that line") from error
    try:
        experiment = kind.model_validate_json(json.dumps(table, default=str))
    except ValidationError as error:
        raise ExperimentError("\n".join(_line(kind, path, table, found) for found in _causes(error))) from error
    return _resolve(path, experiment)


def _resolve(path: Path, experiment: Kind) -> Kind:
    folder = path.resolve().parent
    folders = tuple(str((folder / name).resolve()) for name in experiment.data.folders)
    data = experiment.data.model_copy(update={"folders": folders})
    if experiment.encoder.weights is None:
        return experiment.model_copy(update={"data": data})
    weights = (folder / experiment.encoder.weights).resolve()
    if not weights.is_file():
        fix = "save torchvision's state_dict of a resnet18 there, or remove the key"
        raise ExperimentError(f"{path}: encoder.weights: no file {weights}: {fix}")
    encoder = experiment.encoder.model_copy(update={"weights": str(weights)})
    return experiment.model_copy(update={"data": data, "encoder": encoder})


def _causes(error: ValidationError) -> list[ErrorDetails]:
    """Without those that only follow from a mistake further in: a list is not too short because an element is wrong."""
    found = error.errors()
    places = [one["loc"] for one in found]
    inside = [any(len(p) > len(one["loc"]) and p[: len(one["loc"])] == one["loc"] for p in places) for one in found]
    return [one for one, follows in zip(found, inside, strict=True) if not (follows and one["type"] == "too_short")]


def _line(kind: type[BaseModel], path: Path, table: dict[str, Any], found: ErrorDetails) -> str:
    where, context = found["loc"], found.get("ctx", {})
    if found["type"] == "mistake":
        where += tuple(int(word) if word.isdigit() else word for word in context["key"].split(".") if word)
        return f"{path}: {_key(table, where)}: {context['cause']}: {context['fix']}"
    model, name = _owner(kind, where)
    if found["type"] == "extra_forbidden":
        return f"{path}: {_key(table, where)}: unknown: {_instead(model, name)}"
    cause = "missing" if found["type"] == "missing" else f"{_shown(found['input'])}: {_lower(found['msg'])}"
    return f"{path}: {_key(table, where)}: {cause}: {_example(model, name)}"


def _key(table: Any, where: Location) -> str:
    """The key as people write it: an observation is named by its key."""
    words: list[str] = []
    for step in where:
        if isinstance(step, int):
            inner = table[step] if isinstance(table, list) and step < len(table) else None
            named = inner.get("key") if isinstance(inner, dict) else None
            words.append(str(named) if named else str(step))
        else:
            inner = table.get(step) if isinstance(table, dict) else None
            # A step that is not a key of the file is one of the variants that a value may have.
            if inner is None and table is not None and not isinstance(table, dict):
                continue
            words.append(step)
        table = inner
    return ".".join(words)


def _owner(model: type[BaseModel], where: Location) -> tuple[type[BaseModel], str]:
    """The table in which a key stands, and the key."""
    names = [step for step in where if isinstance(step, str)]
    for at, name in enumerate(names):
        inner = _section(_field(model, name))
        if inner is None or at == len(names) - 1:
            return model, name
        model = inner
    return model, ""


def _field(model: type[BaseModel], name: str) -> Any:
    return next((f for key, f in model.model_fields.items() if name in (key, f.alias)), None)


def _section(field: Any) -> type[BaseModel] | None:
    """The table that the value of a field is, or is a list of."""
    if field is None:
        return None
    for kind in (field.annotation, *get_args(field.annotation)):
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            return kind
    return None


def _instead(model: type[BaseModel], name: str) -> str:
    keys = [field.alias or key for key, field in model.model_fields.items()]
    close = difflib.get_close_matches(name, keys, 1)
    return f"write {close[0]}, or remove it" if close else f"remove it; there are {', '.join(keys)}"


def _example(model: type[BaseModel], name: str) -> str:
    field = _field(model, name)
    if field is None:
        return "correct it"
    value = json.dumps((field.examples or [None])[0])
    return f"write for example {name} = {value} ({field.description})"


def _shown(value: Any) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def _lower(text: str) -> str:
    return text[:1].lower() + text[1:]
