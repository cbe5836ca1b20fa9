"""Poses of recordings: from the numbers of a sample to position and rotation, and what one pose is relative to another.

The conventions are those of UMI: a relative pose is inverse(base) @ pose; in a delta the position is the difference along
the axes of the frame in which poses are given, and the rotation is rotation @ inverse(rotation before). The six numbers
of a rotation are the first two rows of its matrix; a quaternion is x y z w with w not negative.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LENGTHS = {"columns": 16, "rows": 16, "quaternion": 7}
# How far numbers may be off and still be a rotation: trackers give 32-bit numbers.
SLACK = 0.05


def layout_of(numbers: int, named: str | None) -> str | None:
    """How the numbers of a pose are laid out: as the registry has it, otherwise a matrix column by column."""
    layout = named or ("columns" if numbers == LENGTHS["columns"] else None)
    return layout if layout is not None and LENGTHS.get(layout) == numbers else None


def matrices(values: Floats, layout: str) -> tuple[Floats, NDArray[np.bool_]]:
    """Poses [T, 16 or 7] as homogeneous matrices [T, 4, 4], and [T] which of them are poses; the others are identity."""
    out = np.tile(np.eye(4), (len(values), 1, 1))
    if layout == "quaternion":
        rotations, right = _of_quaternions(values[:, 3:7])
        positions = values[:, :3]
    else:
        given = values.reshape(-1, 4, 4)
        given = given.transpose(0, 2, 1) if layout == "columns" else given
        rotations, right = _nearest(given[:, :3, :3])
        positions = given[:, :3, 3]
    right = right & np.isfinite(positions).all(1)
    out[right, :3, :3], out[right, :3, 3] = rotations[right], positions[right]
    return out, right


def _nearest(given: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """The nearest rotations, and which of the matrices are rotations, apart from rounding."""
    finite = np.isfinite(given).all((1, 2))
    u, sizes, v = np.linalg.svd(np.where(finite[:, None, None], given, np.eye(3)))
    rotations = u @ v
    return rotations, finite & (np.abs(sizes - 1) < SLACK).all(1) & (np.linalg.det(rotations) > 0)


def _of_quaternions(q: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    norm = np.linalg.norm(q, axis=1)
    right = np.isfinite(norm) & (np.abs(norm - 1) < SLACK)
    x, y, z, w = (np.where(right[:, None], q, (0.0, 0.0, 0.0, 1.0)) / np.where(right, norm, 1.0)[:, None]).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1), right


def rotation_6d(rotations: Floats) -> Floats:
    """[..., 3, 3] -> [..., 6]"""
    return rotations[..., :2, :].reshape(*rotations.shape[:-2], 6)


def quaternions(rotations: Floats) -> Floats:
    """[..., 3, 3] -> [..., 4], x y z w, w not negative."""
    m = rotations.reshape(-1, 3, 3)
    # The symmetric matrix whose eigenvector of the largest eigenvalue is the quaternion (Bar-Itzhack, 2000).
    k = np.empty((len(m), 4, 4))
    for i in range(3):
        for j in range(3):
            k[:, i, j] = m[:, i, j] + m[:, j, i]
        k[:, i, i] -= m.trace(axis1=1, axis2=2)
    k[:, 3, 3] = m.trace(axis1=1, axis2=2)
    for i, (a, b) in enumerate(((2, 1), (0, 2), (1, 0))):
        k[:, 3, i] = k[:, i, 3] = m[:, a, b] - m[:, b, a]
    q = np.linalg.eigh(k)[1][:, :, -1]
    q = np.where(q[:, 3:] < 0, -q, q)
    return q.reshape(*rotations.shape[:-2], 4)


def relative(poses: Floats, base: Floats, rotation: bool) -> Floats:
    """Poses [..., 4, 4] as seen from `base`; without `rotation` only the difference of the positions counts."""
    if rotation:
        return inverse(base) @ poses
    out = poses.copy()
    out[..., :3, 3] -= base[..., :3, 3]
    return out


def delta(poses: Floats, before: Floats) -> Floats:
    """Poses [..., 4, 4] as steps from those `before`."""
    out = poses.copy()
    out[..., :3, 3] -= before[..., :3, 3]
    out[..., :3, :3] = poses[..., :3, :3] @ before[..., :3, :3].swapaxes(-1, -2)
    return out


def inverse(poses: Floats) -> Floats:
    """[..., 4, 4] -> [..., 4, 4]"""
    out = np.zeros_like(poses)
    turned = poses[..., :3, :3].swapaxes(-1, -2)
    out[..., :3, :3], out[..., 3, 3] = turned, 1.0
    out[..., :3, 3] = -(turned @ poses[..., :3, 3:])[..., 0]
    return out


def numbers(poses: Floats, rotation: str) -> Floats:
    """Poses [..., 4, 4] as position and rotation: [..., 3], [..., 9] or [..., 7]."""
    position = poses[..., :3, 3]
    if rotation == "none":
        return position
    turned = rotation_6d if rotation == "rotation_6d" else quaternions
    return np.concatenate([position, turned(poses[..., :3, :3])], -1)
