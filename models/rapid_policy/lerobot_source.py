"""Episodes of LeRobot datasets v3.0, as LeRobot and `rapid export --to lerobot` write them.

An episode is named `FILE.parquet#INDEX`: a file has several. A modality NAME is, for pictures, the feature
`observation.images.NAME` or `observation.NAME`; for numbers, the columns of `observation.state` that are named `NAME.0`,
`NAME.1` ..., `NAME.pos` or just `NAME`, or the feature `observation.NAME` (so `state` is all of it). A dataset of `rapid`
lists the columns in `columns`, beside `names`, which are for people; in others the names count. Where the dataset has
`rapid.mask` and `rapid.valid`, a sample is present if both are 1; in others every sample is. `rapid.plugged` is read if
the dataset has it.
"""

from __future__ import annotations

import functools
import hashlib
import io
import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

if TYPE_CHECKING:
    import pyarrow as pa

DESCRIPTION = "meta/info.json"
VERSION = "v3.0"
# Prefixes of the columns of meta/episodes that state in which files an episode is.
PLACES = ("data/", "videos/")
NAMED = re.compile(r"(.+\.parquet)#(\d+)")


class DatasetError(Exception):
    """A dataset, or a part of it, that is not read; the reason and the fix."""


class MissingPackage(DatasetError):
    """A package that reads them is not installed: no fault of the episodes, which can be used once it is."""


@dataclass(frozen=True)
class Video:
    """The part of a file, in seconds, that has a camera's frames of an episode."""

    file: Path
    begin: float
    end: float


def is_dataset(folder: Path) -> bool:
    """Whether the folder is a LeRobot dataset."""
    return (folder / DESCRIPTION).is_file()


def split(path: Path) -> tuple[Path, int | None]:
    """The file of an episode, and its index in it if it is one of several."""
    found = NAMED.fullmatch(str(path))
    return (Path(found[1]), int(found[2])) if found else (path, None)


def episode_names(folder: Path) -> list[Path]:
    """The episodes of a dataset."""
    template, names = _described(folder)["data_path"], []
    for index, row in sorted(_episodes(folder).items()):
        # An episode for which meta/episodes names no video is refused here, before anything is decoded.
        _videos(folder, row)
        names.append(Path(f"{folder / _place(template, row, 'data')}#{index}"))
    return names


def rate(path: Path) -> float:
    """Rows per second of an episode's dataset."""
    return float(_described(_folder(path))["fps"])


def files(path: Path) -> list[Path]:
    """The files that an episode's samples are in."""
    videos = _videos(_folder(path), _episode(path)).values()
    return [split(path)[0], *sorted({video.file for video in videos})]


def description(path: Path) -> str:
    """The hash of an episode's description: its names and times may change without its samples."""
    described = _described(_folder(path))
    whole = [described["fps"], described["features"], _episode(path)]
    return hashlib.sha256(json.dumps(whole).encode()).hexdigest()


def tables(path: Path) -> dict[str, Any]:
    """The rows of an episode by feature: arrays, and for pictures a list. Also `names`, `columns` and `videos`, each by
    feature, and `fps`."""
    file, index = split(path)
    folder, row = _folder(path), _episode(path)
    described = _described(folder)
    table = _parquet().read_table(file, filters=[("episode_index", "=", index)])
    if len(table) != row["length"]:
        raise DatasetError(f"{file}: {len(table)} rows, where meta/episodes has {row['length']}")
    features = described["features"]
    found = {name: _column(folder, table, name, f) for name, f in features.items() if name in table.column_names}
    names = {name: _names(f, f.get("names")) for name, f in features.items()}
    columns = {name: _names(f, f.get("columns", f.get("names"))) for name, f in features.items()}
    return found | {"names": names, "columns": columns, "videos": _videos(folder, row), "fps": described["fps"]}


def _column(folder: Path, table: pa.Table, name: str, feature: dict[str, Any]) -> Any:
    column = table.column(name)
    if feature["dtype"] == "image":
        # A picture that LeRobot has not embedded yet is a file.
        return [folder / row["path"] if row["bytes"] is None else row["bytes"] for row in column.to_pylist()]
    values = np.array(column.to_pylist())
    return values.reshape(len(values), -1)


def _names(feature: dict[str, Any], names: Any) -> list[str]:
    """The name of each number of a feature; none if the names are of something else. LeRobot has them in a list, in lists
    by a key (`motors`), or as places by name."""
    if isinstance(names, dict):
        lists = [inner for inner in names.values() if isinstance(inner, list)]
        names = sum(lists, []) if lists else sorted(names, key=lambda name: names[name])
    return names if names and len(names) == math.prod(feature["shape"]) else []


def pictures(rows: dict[str, Any], modality: str) -> Iterator[NDArray[np.uint8] | None] | None:
    """The pictures of a camera where it is present; none if the dataset has no such camera. A damaged picture is absent;
    nothing of a damaged video is used: frames after the damage may be wrong and look right."""
    feature = _camera(rows, modality)
    if feature is None:
        return None
    present = _present(rows, modality, len(rows["frame_index"]))
    if feature in rows["videos"]:
        shown = zip(_frames(rows, feature), present, strict=True)
        return (picture if there else None for picture, there in shown)
    return (_picture(data) if there else None for data, there in zip(rows[feature], present, strict=True))


def _camera(rows: dict[str, Any], modality: str) -> str | None:
    """The feature with the pictures of a camera."""
    features = (f"observation.images.{modality}", f"observation.{modality}")
    return next((f for f in features if f in rows["videos"] or isinstance(rows.get(f), list)), None)


def _frames(rows: dict[str, Any], feature: str) -> Iterator[NDArray[np.uint8]]:
    """The frame of each row, by its time."""
    video, times = rows["videos"][feature], rows["timestamp"].ravel()
    count = round((video.end - video.begin) * rows["fps"])
    if count != len(times):
        part = f"{count} frames from {video.begin:.4f} to {video.end:.4f} s"
        raise DatasetError(f"{video.file}: {part} by meta/episodes, where the episode has {len(times)} rows")
    return _decoder().frames(video.file, video.begin + times)


def _picture(data: bytes | Path) -> NDArray[np.uint8] | None:
    try:
        return np.array(Image.open(data if isinstance(data, Path) else io.BytesIO(data)).convert("RGB"))
    # Pillow has errors of its own for each format and each kind of damage.
    except Exception:
        return None


def numbers(rows: dict[str, Any], modality: str) -> tuple[NDArray[np.float64], NDArray[np.bool_]] | None:
    """The numbers of a sensor [T, D], and [T] where it is present; none if the dataset has no such sensor."""
    columns = _columns(rows, modality)
    if columns and "observation.state" in rows:
        values = rows["observation.state"][:, columns]
    elif isinstance(rows.get(f"observation.{modality}"), np.ndarray):
        values = rows[f"observation.{modality}"]
    else:
        return None
    return values.astype(np.float64), _present(rows, modality, len(values))


def _columns(rows: dict[str, Any], modality: str) -> list[int]:
    """The places in observation.state of a sensor's numbers: in the order of these, or in that of the columns."""
    names = rows["columns"].get("observation.state") or []
    found = [(name, *name.rpartition("."), i) for i, name in enumerate(names) if isinstance(name, str)]
    mine = [(number, i) for name, owner, _, number, i in found if modality in (owner, name)]
    if not all(number.isdecimal() for number, _ in mine):
        return [i for _, i in mine]
    mine = sorted((int(number), i) for number, i in mine)
    missing = next((at for at, (number, _) in enumerate(mine) if number != at), None)
    if missing is not None:
        fix = f"export with --state {modality}, or with its first numbers"
        raise DatasetError(f"observation.state has {modality}.{mine[-1][0]} without {modality}.{missing}: {fix}")
    return [i for _, i in mine]


def presence(rows: dict[str, Any], modality: str, count: int) -> dict[str, NDArray[np.bool_]]:
    """[T] whether the device of a sensor is plugged in, and whether its bit is set. Where a dataset does not record
    them, both hold for each sensor that it has."""
    running = _flags(rows, "rapid.mask", modality)
    running = np.full(count, _has(rows, modality)) if running is None else running
    plugged = _flags(rows, "rapid.plugged", modality)
    return {"plugged": running if plugged is None else plugged, "running": running}


def _has(rows: dict[str, Any], modality: str) -> bool:
    """Whether the dataset has the sensor."""
    return bool(_camera(rows, modality) or f"observation.{modality}" in rows or _columns(rows, modality))


def _present(rows: dict[str, Any], modality: str, count: int) -> NDArray[np.bool_]:
    mask, valid = _flags(rows, "rapid.mask", modality), _flags(rows, "rapid.valid", modality)
    return np.ones(count, bool) if mask is None or valid is None else mask & valid


def _flags(rows: dict[str, Any], feature: str, modality: str) -> NDArray[np.bool_] | None:
    """The flags of a sensor in a feature with one for each; none if it has none for this one."""
    names = rows["names"].get(feature) or []
    return rows[feature][:, names.index(modality)] > 0.5 if modality in names else None


def _folder(path: Path) -> Path:
    """The dataset of an episode."""
    file, _ = split(path)
    found = next((folder for folder in file.parents if is_dataset(folder)), None)
    if found is None:
        raise DatasetError(f"no {DESCRIPTION} above it")
    return found


def _described(folder: Path) -> dict[str, Any]:
    described = _read_description(_now(folder / DESCRIPTION))
    version = described.get("codebase_version")
    if version != VERSION:
        raise DatasetError(f"{DESCRIPTION}: version {version!r}: convert it to {VERSION} with LeRobot's converter")
    return described


@functools.lru_cache(maxsize=4)
def _read_description(file: tuple[Path, int, int]) -> dict[str, Any]:
    return json.loads(file[0].read_text(encoding="utf-8"))


def _videos(folder: Path, row: dict[str, Any]) -> dict[str, Video]:
    """The parts of videos that belong to an episode, by feature."""
    described, found = _described(folder), {}
    for name, feature in described["features"].items():
        if feature["dtype"] == "video":
            file = _place(described["video_path"], row, f"videos/{name}", video_key=name)
            span = [row[f"videos/{name}/{end}_timestamp"] for end in ("from", "to")]
            found[name] = Video(folder / file, *span)
    return found


def _place(template: str, row: dict[str, Any], what: str, **names: str) -> str:
    """The file of an episode's rows or frames."""
    places = {name: row[f"{what}/{name}"] for name in ("chunk_index", "file_index")}
    return template.format(**places, **names)


def _episode(path: Path) -> dict[str, Any]:
    """The description of an episode in the dataset."""
    return _episodes(_folder(path))[split(path)[1]]


def _episodes(folder: Path) -> dict[int, dict[str, Any]]:
    """The description of each episode, without statistics."""
    return _read_episodes(tuple(_now(file) for file in sorted((folder / "meta/episodes").glob("*/*.parquet"))))


def _now(file: Path) -> tuple[Path, int, int]:
    """A file as it is now: what is read from it is kept until it changes, since each of many episodes asks."""
    stat = file.stat()
    return file, stat.st_size, stat.st_mtime_ns


@functools.lru_cache(maxsize=4)
def _read_episodes(files: tuple[tuple[Path, int, int], ...]) -> dict[int, dict[str, Any]]:
    pq, episodes = _parquet(), {}
    for file, *_ in files:
        columns = [c for c in pq.read_schema(file).names if c in ("episode_index", "length") or c.startswith(PLACES)]
        episodes |= {row["episode_index"]: row for row in pq.read_table(file, columns=columns).to_pylist()}
    return episodes


def _parquet() -> Any:
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise MissingPackage(f"LeRobot datasets need pyarrow ({error}): pip install pyarrow") from error
    return pyarrow.parquet


def _decoder() -> Any:
    try:
        from . import video
    except ImportError as error:
        raise MissingPackage(f"LeRobot datasets with videos need PyAV ({error}): pip install av") from error
    return video
