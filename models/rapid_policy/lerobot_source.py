"""Episodes of LeRobot data sets v3.0 with pictures, as `rapid export --to lerobot` makes them.

An episode is named `FILE.parquet#INDEX`: a file has several. A modality NAME is the feature `observation.images.NAME`, the
columns `NAME.0`, `NAME.1` ... of `observation.state`, or the feature `observation.NAME` (so `state` is all of it). A data
set of `rapid` lists these in `columns`, beside `names`, which are for people; of others the names count. Where the data set
has `rapid.mask` and `rapid.valid` a sample is present if both are 1; in others every sample is. `rapid.plugged` is read
where it is there.
"""

from __future__ import annotations

import io
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

if TYPE_CHECKING:
    import pyarrow as pa

DESCRIPTION = "meta/info.json"
VERSION = "v3.0"
NAMED = re.compile(r"(.+\.parquet)#(\d+)")


class DatasetError(Exception):
    """A data set, or a part of it, that is not read; the reason and the fix."""


def is_dataset(folder: Path) -> bool:
    """Whether the folder is a data set of LeRobot."""
    return (folder / DESCRIPTION).is_file()


def split(path: Path) -> tuple[Path, int | None]:
    """The file of an episode, and its index in it if it is one of several."""
    found = NAMED.fullmatch(str(path))
    return (Path(found[1]), int(found[2])) if found else (path, None)


def episode_names(folder: Path) -> list[Path]:
    """The episodes of a data set."""
    described = _described(folder)
    pq, names = _parquet(), []
    for file in sorted((folder / "meta/episodes").glob("*/*.parquet")):
        columns = ["episode_index", "data/chunk_index", "data/file_index"]
        for row in pq.read_table(file, columns=columns).to_pylist():
            place = {"chunk_index": row["data/chunk_index"], "file_index": row["data/file_index"]}
            names.append((row["episode_index"], folder / described["data_path"].format(**place)))
    return [Path(f"{file}#{index}") for index, file in sorted(names)]


def rate(path: Path) -> float:
    """Rows a second of an episode's data set."""
    return float(_described(_folder(path))["fps"])


def tables(path: Path) -> dict[str, Any]:
    """The rows of an episode by feature: arrays, and of pictures a list of bytes. Beside it `names` and `columns`, by feature."""
    file, index = split(path)
    described = _described(_folder(path))
    table = _parquet().read_table(file, filters=[("episode_index", "=", index)])
    features = described["features"]
    found = {name: _column(table, name, feature) for name, feature in features.items() if name in table.column_names}
    videos = {name for name, feature in features.items() if feature["dtype"] == "video"}
    names = {name: f.get("names") for name, f in features.items()}
    columns = {name: f.get("columns", f.get("names")) for name, f in features.items()}
    return found | {"names": names, "columns": columns, "videos": videos}


def _column(table: pa.Table, name: str, feature: dict[str, Any]) -> Any:
    column = table.column(name)
    if feature["dtype"] == "image":
        return [row["bytes"] for row in column.to_pylist()]
    values = np.array(column.to_pylist())
    return values[:, None] if values.ndim == 1 else values


def pictures(rows: dict[str, Any], modality: str) -> list[NDArray[np.uint8] | None] | None:
    """Of a camera, where it is present; none if the data set has no such camera. A damaged one is none."""
    feature = f"observation.images.{modality}"
    if feature in rows["videos"]:
        raise DatasetError(f"{feature} is a video, which is not read: export with --pictures jpeg")
    if feature not in rows:
        return None
    present = _present(rows, modality, len(rows[feature]))
    return [_picture(data) if there else None for data, there in zip(rows[feature], present, strict=True)]


def _picture(data: bytes) -> NDArray[np.uint8] | None:
    try:
        return np.array(Image.open(io.BytesIO(data)).convert("RGB"))
    # Pillow has errors of its own for each format and each kind of damage.
    except Exception:
        return None


def numbers(rows: dict[str, Any], modality: str) -> tuple[NDArray[np.float64], NDArray[np.bool_]] | None:
    """Of a sensor [T, D], and [T] where it is present; none if the data set has no such sensor."""
    columns = _columns(rows, modality)
    if columns and "observation.state" in rows:
        values = rows["observation.state"][:, columns]
    elif f"observation.{modality}" in rows:
        values = rows[f"observation.{modality}"]
    else:
        return None
    return values.astype(np.float64), _present(rows, modality, len(values))


def _columns(rows: dict[str, Any], modality: str) -> list[int]:
    """The places in observation.state of the numbers 0, 1 ... of a sensor."""
    names = rows["columns"].get("observation.state") or []
    found = [(name.rpartition("."), i) for i, name in enumerate(names) if isinstance(name, str)]
    mine = [(number, i) for (owner, _, number), i in found if owner == modality]
    if not all(number.isdecimal() for number, _ in mine):
        return [i for _, i in mine]
    mine = sorted((int(number), i) for number, i in mine)
    missing = next((at for at, (number, _) in enumerate(mine) if number != at), None)
    if missing is not None:
        fix = f"export with --state {modality}, or with its first numbers"
        raise DatasetError(f"observation.state has {modality}.{mine[-1][0]} without {modality}.{missing}: {fix}")
    return [i for _, i in mine]


def presence(rows: dict[str, Any], modality: str, count: int) -> dict[str, NDArray[np.bool_]]:
    """[T] whether the device of a sensor is plugged in, and whether its bit is set. In a data set that does not record them
    both are, of each sensor that it has."""
    running = _flags(rows, "rapid.mask", modality)
    running = np.full(count, _has(rows, modality)) if running is None else running
    plugged = _flags(rows, "rapid.plugged", modality)
    return {"plugged": running if plugged is None else plugged, "running": running}


def _has(rows: dict[str, Any], modality: str) -> bool:
    """Whether the data set has the sensor."""
    return bool({f"observation.images.{modality}", f"observation.{modality}"} & rows.keys() or _columns(rows, modality))


def _present(rows: dict[str, Any], modality: str, count: int) -> NDArray[np.bool_]:
    mask, valid = _flags(rows, "rapid.mask", modality), _flags(rows, "rapid.valid", modality)
    return np.ones(count, bool) if mask is None or valid is None else mask & valid


def _flags(rows: dict[str, Any], feature: str, modality: str) -> NDArray[np.bool_] | None:
    """Of a feature with a flag for each sensor; none if it has none for this one."""
    names = rows["names"].get(feature) or []
    return rows[feature][:, names.index(modality)] > 0.5 if modality in names else None


def _folder(path: Path) -> Path:
    """The data set of an episode."""
    file, _ = split(path)
    found = next((folder for folder in file.parents if is_dataset(folder)), None)
    if found is None:
        raise DatasetError(f"no {DESCRIPTION} above it")
    return found


def _described(folder: Path) -> dict[str, Any]:
    described = json.loads((folder / DESCRIPTION).read_text(encoding="utf-8"))
    version = described.get("codebase_version")
    if version != VERSION:
        raise DatasetError(f"{DESCRIPTION}: version {version!r}: convert it to {VERSION} with LeRobot's converter")
    return described


def _parquet() -> Any:
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise DatasetError(f"data sets of LeRobot need pyarrow ({error}): pip install pyarrow") from error
    return pyarrow.parquet
