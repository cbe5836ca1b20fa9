"""What an experiment takes from the rows of an episode: numbers, and which rows can be learned from. Everything but pictures,
and without torch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from . import poses
from .episodes import ABSENCES, Episode, picture_source
from .experiment import Experiment, Observation, Part

Bools = NDArray[np.bool_]


class Unfit(ValueError):
    """An episode that an experiment cannot learn from."""


class Rows:
    """What an experiment takes from the rows of one episode: everything but pictures."""

    def __init__(self, spec: Experiment, episode: Episode) -> None:
        self.spec, self.episode = spec, episode
        hz, wanted = episode.facts.observation_hz, spec.policy.control_hz
        if hz is not None and abs(hz - wanted) > 1e-6 * wanted:
            raise Unfit(f"recorded at {hz:g} Hz, the policy acts at {wanted:g}: write control_hz = {hz:g} in [policy]")
        self.usable = np.ones(len(episode), bool)
        self.vectors = {o.key: self._vector(o) for o in spec.vectors}
        self.now: NDArray[np.float64] | None = None
        # The last row that has an action, whatever else it lacks.
        self.last = 0
        self.targets = self._recorded() if spec.action.source == "action" else self._next_poses()
        found = [np.asarray(episode.present(picture_source(o).name)) for o in spec.images]
        self.present = np.stack(found, 1) if found else np.zeros((len(episode), 0), bool)
        for o, present in zip(spec.images, found, strict=True):
            if o.required:
                self.usable &= present
            # An absence that is not to be learned as an unplugged sensor ends a segment.
            for reason in set(ABSENCES) - set(spec.data.absences):
                self.usable &= ~episode.absent(picture_source(o).name, reason)
        # Pictures that are not required: at least one of them must be present.
        if found:
            self.usable &= self.present.any(1)

    def windows(self) -> NDArray[np.int64]:
        """[W, 3] a tick, and the start and end of its segment, as rows of the episode."""
        usable, windows = self.usable, []
        breaks = np.flatnonzero(~(usable[1:] & usable[:-1] & (np.diff(self.episode.ticks) == 1))) + 1
        for segment in np.split(np.arange(len(self.episode)), breaks):
            if usable[segment[0]]:
                ends = np.broadcast_to([segment[0], segment[-1] + 1], (len(segment), 2))
                windows.append(np.column_stack([segment, ends]))
        return np.concatenate(windows) if windows else np.empty((0, 3), np.int64)

    def _vector(self, o: Observation) -> NDArray[np.float64]:
        """[T, D]"""
        return np.concatenate([self._part(part) for part in o.sources], 1)

    def _part(self, part: Part) -> NDArray[np.float64]:
        if part.take == "columns":
            return self._columns(part.modality, part.columns or ())
        matrices, there = self._poses(part.modality)
        self.usable &= there
        if part.take == "position":
            return matrices[:, :3, 3]
        turned = poses.rotation_6d if part.take == "rotation_6d" else poses.quaternions
        return turned(matrices[:, :3, :3])

    def _columns(self, modality: str, columns: tuple[int, ...]) -> NDArray[np.float64]:
        values, present = np.asarray(self.episode.value(modality)), np.asarray(self.episode.present(modality))
        self.usable &= present
        if not present.any():
            return np.zeros((len(self.episode), len(columns)))
        if max(columns) >= values.shape[1]:
            raise Unfit(f"{modality}: {values.shape[1]} numbers, but number {max(columns)} (from 0) is taken")
        return values[:, columns]

    def _poses(self, modality: str) -> tuple[NDArray[np.float64], Bools]:
        """[T, 4, 4] and [T] whether there is a pose."""
        values, present = np.asarray(self.episode.value(modality)), np.asarray(self.episode.present(modality))
        if not present.any():
            return np.tile(np.eye(4), (len(values), 1, 1)), present
        named = self.episode.facts.layouts.get(modality)
        layout = poses.layout_of(values.shape[1], named)
        if layout is None:
            what = f"layout {named!r}" if named else f"no [device.{modality}.pose] in its registry"
            raise Unfit(f"{modality}: {values.shape[1]} numbers and {what}: not a pose")
        matrices, right = poses.matrices(values, layout)
        return matrices, right & present

    def _recorded(self) -> NDArray[np.float64]:
        """[T, Da] as recorded on /action."""
        actions, spec = np.asarray(self.episode.actions), self.spec.action
        if not self.episode.acted.any():
            raise Unfit('no action: nothing on /action; a handheld demonstration trains with from = "pose"')
        if spec.columns is not None:
            if max(spec.columns) >= actions.shape[1]:
                raise Unfit(f"/action: {actions.shape[1]} numbers, but number {max(spec.columns)} (from 0) is taken")
            actions = actions[:, spec.columns]
        if actions.shape[1] != len(spec.names):
            raise Unfit(f"/action: {actions.shape[1]} numbers, expected {len(spec.names)}")
        self._act(np.asarray(self.episode.acted))
        return actions

    def _next_poses(self) -> NDArray[np.float64]:
        """[T, ...] the pose and the opening of the next tick: the pose as it is learned if it is absolute, otherwise as a
        matrix. The last of consecutive ticks has no action."""
        spec = self.spec.action
        matrices, there = self._poses(spec.pose or "")
        absolute = spec.representation == "absolute"
        parts = [poses.numbers(matrices, spec.rotation) if absolute else matrices.reshape(-1, 16)]
        if spec.gripper:
            parts.append(self._opening(spec.gripper, spec.gripper_column))
            there = there & np.asarray(self.episode.present(spec.gripper))
        self.now = None if absolute else matrices
        follows = there[:-1] & there[1:] & (np.diff(self.episode.ticks) == 1)
        self._act(np.append(follows, False))
        targets = np.concatenate(parts, 1)
        return np.concatenate([targets[1:], targets[-1:]])

    def _act(self, acted: Bools) -> None:
        self.usable &= acted
        self.last = int(np.flatnonzero(acted)[-1]) if acted.any() else 0

    def _opening(self, modality: str, column: int) -> NDArray[np.float64]:
        before = self.usable.copy()
        opening = self._columns(modality, (column,))
        # `there` decides: the opening belongs to the next tick too.
        self.usable = before
        return opening


def unfit(spec: Experiment, episode: Episode) -> str | None:
    """Why an experiment cannot learn from an episode; none if it can."""
    try:
        rows = Rows(spec, episode)
    except Unfit as error:
        return str(error)
    return None if len(rows.windows()) else "every tick lacks an action or a required modality"
