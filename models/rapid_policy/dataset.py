"""Windows of episodes as inputs of the networks.

A batch is made in three steps. `plan` makes every random decision, in one order, so that neither workers nor several
processes change what is learned; `gather` copies what the plan names out of the episodes, which may be on disk;
`inputs` turns pixels into numbers on the device that trains.

The data of every tick are in files: pictures in those of the episodes, numbers and windows in ones that this module makes.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from . import poses
from .episodes import Episode, picture_source
from .experiment import POSITION, QUATERNION, ROTATIONS, Experiment, Observation
from .normalize import EXECUTED, MinMax
from .rows import Bools, Rows

# Name of the range of the recorded gripper opening, beside those of inputs and actions.
OPENING = "opening"

# Windows that are read at a time to find the ranges of numbers.
AT_ONCE = 4096

# Pictures that a CPU turns into inputs at a time: few enough to stay in its cache.
TOGETHER = 32

# Of the windows without a picture, the share in which there was none before either.
NEVER = 1 / 3

Plan = dict[str, NDArray]


@dataclass
class Batch:
    """B windows."""

    pictures: dict[str, Tensor]
    """u8 [B, To, H, W, 3] by key, with a history [B, S, H, W, 3]; a picture that is masked or absent may be anything."""
    references: dict[str, Tensor]
    """u8 [B, H, W, 3] by key, for differences: the picture to compare with."""
    gains: dict[str, Tensor]
    """f32 [B, 1, 1, 1, 1] by key: brightness."""
    shown: dict[str, Tensor]
    """bool [B, To] by key, with a history [B, S]: whether there is a picture."""
    vectors: dict[str, Tensor]
    """f32 [B, To, D] in -1..1 by key."""
    mask: Tensor
    """f32 [B, M], 1 for pictures that are present."""
    actions: Tensor
    """f32 [B, Tp, Da] in -1..1"""
    outcomes: Tensor
    """f32 [B, Da]: the last action of each window's episode, in -1..1 unless no window contains it; [B, 0] unless a picture
    predicts it."""


class Dropped(NamedTuple):
    """What `drop` leaves of M pictures, and how it took the others away."""

    visible: Bools
    """[B, To, M]"""
    windows: Bools
    """[B, M] present at the newest step, and taken away by `dropout.window`."""
    out: NDArray[np.int64]
    """[B, M] the row at which it leaves by `dropout.episode`."""
    back: NDArray[np.int64]
    """[B, M] the row at which it is back; the same as `out` where it does not leave."""


class Dataset:
    """All ticks of all episodes in sequence, and the windows among them.

    A window belongs to a tick. It does not reach across a tick that lacks a required modality or an action, nor across a
    gap in the frame index: there one segment ends and another begins, and steps beyond either end repeat that end.
    Pictures stay in the episodes; numbers and windows are copied to unnamed files in `folder`, which vanish with the
    dataset. If that folder is in memory, as the system's temporary one may be, each tick costs memory.
    """

    def __init__(self, spec: Experiment, episodes: Sequence[Episode], ranges: dict[str, MinMax] | None = None,
                 folder: Path | None = None) -> None:  # fmt: skip
        self.spec, self.episodes = spec, episodes
        self.names = {o.key: picture_source(o).name for o in (*spec.images, *spec.histories)}
        # The index of each picture among the observations.
        self.images = [i for i, o in enumerate(spec.observation) if o in spec.images]
        read = _on_disk(self._read(), folder)
        if not len(read.get("windows", ())):
            raise ValueError("no window to learn from: every tick lacks an action or a required modality")
        self.starts = np.cumsum([0, *read["length"]])
        self.windows = read["windows"]
        self.present, self.targets, self.now = read["present"], read["targets"], read.get("now")
        self.ends = read["last"]
        self.vectors = {o.key: read[f"vector {o.key}"] for o in spec.vectors}
        self.ranges = dict(ranges or {})
        if spec.action.gripper_squeeze:
            self._squeeze(spec.action.gripper_squeeze)
        if ranges is None:
            self.ranges |= self._ranges()

    def _read(self) -> Iterator[dict[str, NDArray]]:
        """The arrays of each episode."""
        start = 0
        for episode in self.episodes:
            rows = Rows(self.spec, episode)
            vectors = {f"vector {key}": values for key, values in rows.vectors.items()}
            now = {} if rows.now is None else {"now": rows.now}
            every = {"windows": rows.windows() + start, "length": np.array([len(episode)]), "present": rows.present}
            yield every | {"targets": rows.targets, "last": np.array([rows.last + start])} | now | vectors
            start += len(episode)

    def _squeeze(self, far: float) -> None:
        """The more closed the gripper was, the further it closes: fully open stays fully open."""
        if OPENING not in self.ranges:
            self.ranges[OPENING] = MinMax.of(OPENING, self._extremes(lambda part: self.targets[part[:, 0], -1:]))
        for first in range(0, len(self.targets), AT_ONCE):
            opening = self.targets[first : first + AT_ONCE, -1:]
            closed = (1 - self.ranges[OPENING].apply(opening).astype(np.float64)) / 2
            opening -= far * closed

    def _ranges(self) -> dict[str, MinMax]:
        ranges = {}
        for o in self.spec.vectors:
            seen = self._extremes(lambda part, key=o.key: self.vectors[key][part[:, 0]])
            ranges[o.key] = MinMax.of(o.key, seen, _turns([p.take for p in o.sources], o))
        action = self.spec.action
        absolute = action.representation == "absolute"
        # What an action is relative to depends on the window.
        seen = self._extremes(lambda part: self._actions(part[:, :1] if absolute else self._done(part), part[:, 0]))
        turns = range(POSITION, POSITION + ROTATIONS[action.rotation]) if action.source == "pose" else ()
        ranges["action"] = MinMax.of("action", seen, turns)
        if action.composed:
            turns = range(POSITION, POSITION + QUATERNION) if action.rotation != "none" else ()
            ranges[EXECUTED] = MinMax.of(EXECUTED, self._extremes(lambda part: self._executed(part[:, 0])), turns)
        return ranges

    def _extremes(self, numbers: Callable[[NDArray[np.int64]], NDArray[np.float64]]) -> NDArray[np.float64]:
        """[2, D] minimum and maximum of the numbers [..., D] of all windows."""
        found = []
        for first in range(0, len(self.windows), AT_ONCE):
            seen = numbers(self.windows[first : first + AT_ONCE])
            seen = seen.reshape(-1, seen.shape[-1])
            found.append((seen.min(0), seen.max(0)))
        low, high = zip(*found, strict=True)
        return np.stack([np.min(low, 0), np.max(high, 0)])

    def _executed(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """[T, D] absolute actions as the program executes them; zeros for a rotation, whose range is known."""
        targets, turned = self.targets[rows], self.spec.action.rotation != "none"
        if self.now is not None:
            positions, rest = targets[:, :16].reshape(-1, 4, 4)[:, :3, 3], targets[:, 16:]
        else:
            positions, rest = targets[:, :POSITION], targets[:, POSITION + ROTATIONS[self.spec.action.rotation] :]
        return np.concatenate([positions, np.zeros((len(targets), QUATERNION * turned)), rest], 1)

    def plan(self, random: np.random.Generator, size: int, *, vary: bool = True) -> Plan:
        """`size` windows at random; each has its own shift, brightness, noise and dropout unless `vary` is false."""
        spec = self.spec
        windows = self.windows[random.integers(len(self.windows), size=size)]
        tick = windows[:, 0]
        # [B, To, O], each observation with its own distance between steps.
        apart = np.outer(np.arange(1 - spec.policy.n_obs_steps, 1), [o.down_sample_steps for o in spec.observation])
        seen = np.maximum(tick[:, None, None] + apart, windows[:, 1:2, None])
        plan: Plan = {"tick": tick, "seen": seen, "done": self._done(windows)}
        for o in spec.images:
            self._vary(plan, o, random, vary=vary)
        for o in spec.vectors:
            if o.augmentation.noise and vary:
                noise = random.standard_normal((*seen.shape[:2], *o.shape), np.float32)
                plan[f"noise {o.key}"] = noise * np.float32(o.augmentation.noise)
        pictures = seen[..., self.images]
        plan["visible"] = self.present[pictures, np.arange(len(self.images))]
        dropped = None
        if spec.policy.mask_aware and vary:
            dropped = drop(spec, plan["visible"], pictures, self._episode_spans(tick), random)
            plan["visible"] = dropped.visible
        if vary:
            self._hold(plan, random)
        # Last, so that apart from their histories windows are those of a policy without any.
        for o in spec.histories:
            self._vary(plan, o, random, vary=vary)
        hidden = None if dropped is None else hide(spec, dropped, random)
        for o in spec.histories:
            self._remember(plan, o, windows[:, 1:2], dropped, hidden)
        return plan

    def _vary(self, plan: Plan, o: Observation, random: np.random.Generator, *, vary: bool) -> None:
        """The shift and the brightness of a picture."""
        varied, pool, size = o.augmentation, self.spec.encoder.pool, len(plan["tick"])
        if varied.shift and vary:
            far = varied.shift // pool
            plan[f"corner {o.key}"] = random.integers(-far, far + 1, (size, 2)) * pool
        if varied.brightness and vary:
            gain = random.uniform(1 - varied.brightness, 1 + varied.brightness, (size, 1, 1, 1, 1))
            plan[f"gain {o.key}"] = gain.astype(np.float32)

    def _remember(self, plan: Plan, o: Observation, begin: NDArray[np.int64], dropped: Dropped | None,
                  hidden: NDArray[np.int64] | None) -> None:  # fmt: skip
        """The rows [B, S] of a history and which of them have a picture, for windows whose segments begin at `begin` [B, 1]."""
        i, tick = self.spec.column(o), plan["tick"][:, None]
        ago = np.array(o.ages)
        rows = tick - ago
        valid = rows >= begin
        # A step before the beginning names an arbitrary row of the episode, which is not read.
        rows = np.where(valid, rows, tick)
        valid &= self.present[rows, i]
        if dropped is not None and hidden is not None:
            valid &= (rows < dropped.out[:, i : i + 1]) | (rows >= dropped.back[:, i : i + 1])
            valid &= ago >= hidden[:, i : i + 1]
        # The current picture decides about the newest step, even where it is the one that always remains.
        valid[:, -1] = plan["visible"][:, -1, i]
        # A held picture has been absent since then; a history holds nothing.
        valid &= ago >= plan.get(f"since {self.spec.images[i].key}", 0)
        plan[f"seen {o.key}"], plan[f"valid {o.key}"] = rows, valid

    def _hold(self, plan: Plan, random: np.random.Generator) -> None:
        """Some windows have an older picture, from up to `hold_last_ms` before: the policy sees the last one of an absent sensor."""
        starts = self._episode_spans(plan["tick"])[:, :1]
        for i, o in enumerate(self.spec.images):
            if not (o.dropout.held and o.when_absent):
                continue
            seen = plan["seen"][..., self.images[i]]
            longest = max(1, round(o.when_absent.hold_last_ms / 1e3 * self.spec.policy.control_hz))
            # Every moment since the episode began is as likely as any other.
            room = np.minimum(seen[:, :1] - starts, longest)
            since = np.where(room > 0, random.integers(0, np.maximum(room, 1)) + 1, 0)
            is_held = (random.random((len(seen), 1)) < o.dropout.held) & plan["visible"][:, :, i].all(1, keepdims=True)
            is_held &= self.present[seen - since, i].all(1, keepdims=True)
            plan[f"since {o.key}"] = np.where(is_held, since, 0)

    def gather(self, plan: Plan) -> Batch:
        """The windows of a plan, or of a part of its rows."""
        spec, visible = self.spec, plan["visible"]
        mask = torch.from_numpy(visible[:, -1].astype(np.float32))
        batch = Batch({}, {}, {}, {}, {}, mask, self._batch_actions(plan), self._outcomes(plan))
        for i, o in enumerate(spec.images):
            steps, shown = _replugged(plan["seen"][..., self.images[i]] - plan.get(f"since {o.key}", 0), visible[:, :, i])
            batch.shown[o.key] = torch.from_numpy(shown)
            self._pictures(batch, o, plan, steps, shown)
        for o in spec.histories:
            # The networks look at a history only where the current picture is absent: it is read for no other window.
            shown = plan[f"valid {o.key}"] & ~visible[:, -1:, spec.column(o)]
            batch.shown[o.key] = torch.from_numpy(shown)
            self._pictures(batch, o, plan, plan[f"seen {o.key}"], shown)
        for i, o in enumerate(spec.observation):
            if o.kind == "image":
                continue
            values = self.ranges[o.key].apply(self.vectors[o.key][plan["seen"][..., i]])
            if (noise := plan.get(f"noise {o.key}")) is not None:
                values = values + noise
            batch.vectors[o.key] = torch.from_numpy(values)
        return batch

    def _pictures(self, batch: Batch, o: Observation, plan: Plan, steps: NDArray[np.int64], shown: Bools) -> None:
        """All steps of a window have the same shift and brightness; beyond an edge the edge is repeated."""
        name, (_, height, width), pool = self.names[o.key], o.shape, self.spec.encoder.pool
        corners = plan.get(f"corner {o.key}")
        pictures = np.zeros((*steps.shape, height, width, 3), np.uint8)
        compared = np.zeros((len(steps), height, width, 3), np.uint8) if o.operation else None
        owners = self._owners(plan["tick"])
        for b in np.flatnonzero(shown.any(1)):
            episode = self.episodes[owners[b]]
            source, rows = episode.value(name), steps[b] - self.starts[owners[b]]
            corner = (0, 0) if corners is None else corners[b]
            for step in np.flatnonzero(shown[b]):
                _shift(source[rows[step]], corner, pool, pictures[b, step])
            if compared is not None:
                _shift(source[episode.first(name)], corner, pool, compared[b])
        batch.pictures[o.key] = torch.from_numpy(pictures)
        if compared is not None:
            batch.references[o.key] = torch.from_numpy(compared)
        if (gain := plan.get(f"gain {o.key}")) is not None:
            batch.gains[o.key] = torch.from_numpy(gain)

    def _done(self, windows: NDArray[np.int64]) -> NDArray[np.int64]:
        """[B, Tp] rows of the actions of windows."""
        done = windows[:, 0][:, None] - self.spec.action_start + np.arange(self.spec.policy.horizon)
        return np.clip(done, windows[:, 1:2], windows[:, 2:3] - 1)

    def _batch_actions(self, plan: Plan) -> Tensor:
        return torch.from_numpy(self.ranges["action"].apply(self._actions(plan["done"], plan["tick"])))

    def _outcomes(self, plan: Plan) -> Tensor:
        if not self.spec.predicts_outcomes:
            return torch.zeros(len(plan["tick"]), 0)
        ends = self.ends[self._owners(plan["tick"])]
        return torch.from_numpy(self.ranges["action"].apply(self._actions(ends[:, None], plan["tick"])[:, 0]))

    def _actions(self, done: NDArray[np.int64], tick: NDArray[np.int64]) -> NDArray[np.float64]:
        """[B, Tp, Da] at the rows `done` [B, Tp], where the newest observation is that of `tick` [B]."""
        action, targets = self.spec.action, self.targets[done]
        if self.now is None:
            return targets
        wanted = targets[..., :16].reshape(*done.shape, 4, 4)
        turned = action.rotation != "none"
        if action.representation == "relative":
            wanted = poses.relative(wanted, self.now[tick][:, None], turned)
        elif action.representation == "delta":
            # The program starts from the pose of the newest observation, at `action_start`; so does a window that
            # begins where its segment does, in which the actions before repeat the first one.
            start = self.spec.action_start
            wanted = poses.delta(wanted, np.concatenate([self.now[done[:, : start + 1]], wanted[:, start:-1]], 1))
        return np.concatenate([poses.numbers(wanted, action.rotation), targets[..., 16:]], -1)

    def _owners(self, tick: NDArray[np.int64]) -> NDArray[np.int64]:
        """[B] index of the episode that each window belongs to."""
        return np.searchsorted(self.starts, tick, "right") - 1

    def _episode_spans(self, tick: NDArray[np.int64]) -> NDArray[np.int64]:
        """[B, 2] first row, and row after the last, of each window's episode."""
        owners = self._owners(tick)
        return np.stack([self.starts[owners], self.starts[owners + 1]], 1)


def inputs(spec: Experiment, batch: Batch, device: torch.device) -> dict[str, Tensor]:
    """By key: pictures f32 [B, To, 3, H / pool, W / pool] and vectors f32 [B, To, D], in -1..1; for a history also
    f32 [B, S], by the name of its validity, 1 for the steps that have a picture."""
    out = {o.key: _picture_input(spec, o, batch, device) for o in (*spec.images, *spec.histories)}
    out |= {o.valid: batch.shown[o.key].to(device).float() for o in spec.histories}
    return out | {o.key: batch.vectors[o.key].to(device, non_blocking=True) for o in spec.vectors}


def _picture_input(spec: Experiment, o: Observation, batch: Batch, device: torch.device) -> Tensor:
    """f32 [B, To, 3, H / pool, W / pool]; only those that are shown are computed, the others are zeros."""
    shown, pixels, (_, height, width), pool = batch.shown[o.key], batch.pictures[o.key], o.shape, spec.encoder.pool
    found = torch.zeros(shown.numel(), 3, height // pool, width // pool, device=device)
    every = shown.flatten().nonzero().squeeze(1)
    # Another device copies a few large arrays faster than many small ones.
    for places in every.split(TOGETHER if device.type == "cpu" else max(1, len(every))):
        windows = places // shown.shape[1]
        pictures = _unit(pixels.flatten(0, 1)[places].to(device, non_blocking=True))
        if o.operation == "diff_to_reference":
            # With min 0 and max 1, normalising (v - reference) / 2 + 0.5 gives v - reference.
            pictures = pictures - _unit(batch.references[o.key][windows].to(device, non_blocking=True))
        else:
            pictures = pictures * 2 - 1
        if pool > 1:
            pictures = F.avg_pool2d(pictures, pool)
        if o.color == "bgr":
            pictures = pictures.flip(1)
        if o.key in batch.gains:
            pictures = (pictures + 1) * batch.gains[o.key][windows, 0].to(device) - 1
        found[places.to(device)] = pictures
    return found.unflatten(0, shown.shape)


def drop(spec: Experiment, present: Bools, seen: NDArray[np.int64], spans: NDArray[np.int64],
         random: np.random.Generator) -> Dropped:  # fmt: skip
    """Takes away, at random, pictures that are `present` [B, To, M] at the rows `seen` [B, To, M], in episodes with the rows
    `spans` [B, 2].

    Of those present at the newest step at least one always remains, even if there is only one: the paper's rule.
    """
    visible, there = present.copy(), present[:, -1]
    windows = there & (random.random(there.shape) < [o.dropout.window for o in spec.images])
    out = back = np.zeros(there.shape, np.int64)
    if any(o.dropout.episode for o in spec.images):
        out, back = _absences(spec, spans, random)
    away = (seen >= out[:, None]) & (seen < back[:, None])
    kept = there & ~windows & ~away[:, -1]
    # The one that remains in a window that lost all: any present one, with equal probability.
    lot = np.where(there, random.random(there.shape), -1.0)
    lost = ~kept.any(1) & there.any(1)
    kept[lost, lot[lost].argmax(1)] = True
    visible &= ~away
    visible[:, -1] = kept
    if visible.shape[1] > 1 and any(o.dropout.replug for o in spec.images):
        cut = random.random(there.shape) < [o.dropout.replug for o in spec.images]
        first = random.integers(1, visible.shape[1], there.shape)
        visible &= ~(cut[:, None] & (np.arange(visible.shape[1])[None, :, None] < first[:, None]))
    return Dropped(visible, windows & ~kept, out, back)


def hide(spec: Experiment, dropped: Dropped, random: np.random.Generator) -> NDArray[np.int64]:
    """[B, M] how many of the newest ticks a history lacks, one draw for each window and modality.

    Where `dropout.window` took the current picture away, it was never plugged in, or it was unplugged some time ago: at any
    moment of the modality's longest history, with equal probability.
    """
    hidden = np.zeros(dropped.windows.shape, np.int64)
    spans: dict[int, int] = {}
    for o in spec.histories:
        spans[spec.column(o)] = max(spans.get(spec.column(o), 0), o.span)
    for i, span in spans.items():
        never = random.random(len(hidden)) < NEVER
        ago = np.where(never, span + 1, random.integers(1, span + 1, len(hidden)))
        hidden[:, i] = np.where(dropped.windows[:, i], ago, 0)
    return hidden


def _absences(spec: Experiment, spans: NDArray[np.int64],
              random: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.int64]]:  # fmt: skip
    """[B, M] rows at which a picture leaves in the middle of the episode and at which it is back, at its end if it stays away."""
    count = (len(spans), len(spec.images))
    leaves = random.random(count) < [o.dropout.episode for o in spec.images]
    begin, end = spans[:, :1], spans[:, 1:]
    out = begin + (random.random(count) * (end - begin)).astype(np.int64)
    back = np.where(random.random(count) < 0.5, end, out + 1 + (random.random(count) * (end - out)).astype(np.int64))
    return out, np.where(leaves, back, out)


def _replugged(seen: NDArray[np.int64], visible: Bools) -> tuple[NDArray[np.int64], Bools]:
    """[B, To] rows and whether there are pictures: just after a replug, earlier steps show the first new one."""
    rows, shown = seen.copy(), np.repeat(visible[:, -1:], seen.shape[1], 1)
    for step in range(seen.shape[1] - 2, -1, -1):
        rows[:, step] = np.where(visible[:, step], seen[:, step], rows[:, step + 1])
    return rows, shown


def _shift(picture: NDArray[np.uint8], corner: Sequence[int], pool: int, out: NDArray[np.uint8]) -> None:
    """Writes the picture seen from `corner` [2]; beyond an edge its blocks of `pool` pixels are repeated."""
    (height, width), (down, right) = picture.shape[:2], corner
    top, bottom = max(0, -down), height - max(0, down)
    left, end = max(0, -right), width - max(0, right)
    out[top:bottom, left:end] = picture[top + down : bottom + down, left + right : end + right]
    for beyond, edge in ((slice(0, left), slice(left, left + pool)), (slice(end, width), slice(end - pool, end))):
        if beyond.start != beyond.stop:
            block = out[top:bottom, edge]
            out[top:bottom, beyond] = np.tile(block, (1, (beyond.stop - beyond.start) // pool, 1))
    for beyond, edge in (
        (slice(0, top), slice(top, top + pool)),
        (slice(bottom, height), slice(bottom - pool, bottom)),
    ):
        if beyond.start != beyond.stop:
            out[beyond] = np.tile(out[edge], ((beyond.stop - beyond.start) // pool, 1, 1))


def _unit(pictures: Tensor) -> Tensor:
    """u8 [N, H, W, 3] -> f32 [N, 3, H, W] in 0..1"""
    return pictures.permute(0, 3, 1, 2).float() / 255


def _on_disk(parts: Iterator[dict[str, NDArray]], folder: Path | None) -> dict[str, NDArray]:
    """The arrays of each name one after the other, mapped from a file. They are written before they are mapped: a full
    disk is then an error, not a signal."""
    files: dict[str, BinaryIO] = {}
    rows: dict[str, tuple[np.dtype, tuple[int, ...]]] = {}
    with contextlib.ExitStack() as opened:
        for part in parts:
            for name, array in part.items():
                if name not in files:
                    files[name] = opened.enter_context(tempfile.TemporaryFile(dir=folder))
                    rows[name] = array.dtype, array.shape[1:]
                if rows[name] != (array.dtype, array.shape[1:]):
                    raise ValueError(f"{name}: {array.dtype} {array.shape[1:]} after {rows[name]}")
                files[name].write(array.tobytes())
        return {name: _map(file, *rows[name]) for name, file in files.items()}


def _map(file: BinaryIO, kind: np.dtype, row: tuple[int, ...]) -> NDArray:
    """[N, ...] as many as are in the file; an empty file cannot be mapped."""
    if not file.seek(0, os.SEEK_END):
        return np.empty((0, *row), kind)
    # As a plain array: each slice of a memmap costs as much again.
    return np.memmap(file, kind, "r+").reshape(-1, *row).view(np.ndarray)


def _turns(takes: list[str], o: Observation) -> list[int]:
    """The indices of a vector's numbers that belong to a rotation."""
    found, at = [], 0
    for part, take in zip(o.sources, takes, strict=True):
        found += range(at, at + part.length) if take in ("rotation_6d", "quaternion") else ()
        at += part.length
    return found
