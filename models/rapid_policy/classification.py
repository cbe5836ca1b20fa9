"""An experiment that trains a classifier of single pictures: what it distinguishes, by which pictures, and how it is tested."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import model_validator

from .experiment import Data, Encoder, Name, Observation, Section, check_picture, known, mistake

# The keys of an observation that a classifier of single pictures uses.
_USED = {"key", "title", "kind", "modality", "required", "size", "resize", "crop", "operation", "augmentation"}


class Input(Observation):
    """A picture that is classified."""

    title: str = known("its row in the results", "tactile, as it is", min_length=1)

    @model_validator(mode="after")
    def _check_use(self) -> Input:
        if self.kind != "image":
            raise mistake("kind", f"{self.kind!r} is not a picture", 'write kind = "image"')
        for key in sorted(self.model_fields_set - _USED):
            raise mistake(key, "of no use to a classifier of single pictures", "remove it")
        if self.augmentation.brightness:
            raise mistake("augmentation.brightness", "of no use to a classifier of single pictures", "remove it")
        return self


class Label(Section):
    """What is distinguished."""

    tag: str = known("tag of an episode", "texture", min_length=1)
    values: tuple[str, ...] = known("its values that are distinguished", ["triangular", "hexagonal"], min_length=2, max_length=2)


class Contact(Section):
    """Which pictures are of a touch; others are not classified."""

    input: Name = known("key of the input that shows it, a difference", "difference")
    noises: float = known("a touch changes it by more than this many times its noise", 1.5, 1.5, gt=0)
    untouched: int = known("pictures at the beginning of an episode, from which the noise is measured", 10, 10, ge=3)


class Fitting(Section):
    """How each classifier is trained: AdamW, with a learning rate that rises and falls once."""

    iterations: int = known("batches", 400, ge=1)
    pictures: int = known("in a batch", 64, 64, ge=1)
    learning_rate: float = known("at its highest", 1e-3, 1e-3, gt=0)
    seed: int = known("of weights, batches and folds", 0, 0, ge=0)


class Testing(Section):
    """How they are tested."""

    folds: int = known("parts of the episodes, each tested by a classifier trained on the others", 10, 10, ge=2)
    noises: tuple[float, ...] = known(
        "standard deviations of noise added to the tested pictures, of a full scale of 1; the first gives the result",
        [0.0, 0.02, 0.05],
        (0.0,),
        min_length=1,
    )
    pressures: int = known("parts of the pictures, by how much the one of [contact] has changed", 5, 5, ge=1)


class Classification(Section):
    """The whole experiment."""

    format: Literal["rapid-classification/1"] = known("of this file", "rapid-classification/1")
    name: Name = known("of the experiment", "texture")
    data: Data = known("which episodes are learned from and tested", {}, Data())
    label: Label = known("what is distinguished", {"tag": "texture"})
    contact: Contact = known("which pictures are of a touch", {"input": "difference"})
    input: tuple[Input, ...] = known("a picture that is classified", {}, min_length=1)
    encoder: Encoder = known("the network that sees", {}, Encoder())
    training: Fitting = known("the schedule", {"iterations": 400})
    test: Testing = known("how they are tested", {}, Testing())

    @model_validator(mode="after")
    def _check(self) -> Classification:
        keys = [o.key for o in self.input]
        for i, o in enumerate(self.input):
            if o.key in keys[:i]:
                raise mistake(f"input.{i}.key", f"{o.key!r} is taken", "give each input a name of its own")
            check_picture(self.encoder, o, f"input.{i}")
        differences = [o.key for o in self.input if o.operation == "diff_to_reference"]
        if self.contact.input not in differences:
            cause = f"{self.contact.input!r} is not an input that is a difference"
            fix = f"write one of them: {', '.join(differences) or 'none yet'}"
            raise mistake("contact.input", cause, fix)
        return self

    @property
    def images(self) -> tuple[Input, ...]:
        """The pictures that are read from an episode."""
        return self.input

    @property
    def numbers(self) -> tuple[str, ...]:
        """Modalities whose numbers are read from an episode."""
        return ()

    @property
    def touched(self) -> Input:
        """The input that shows a touch."""
        return next(o for o in self.input if o.key == self.contact.input)

    def label_of(self, tags: Mapping[str, str]) -> int | None:
        """The index of the value that an episode has; none if it has none of them."""
        value = tags.get(self.label.tag)
        return self.label.values.index(value) if value in self.label.values else None

    def unfit(self, tags: Mapping[str, str]) -> str | None:
        """Why it cannot learn from an episode; none if it can."""
        if self.label_of(tags) is None:
            return f"no tag `{self.label.tag}` of {' or '.join(self.label.values)}"
        return None
