#!/usr/bin/env python3
"""Makes a replay buffer for UMI and diffusion_policy from a dataset that `rapid export --to lerobot` wrote.

    rapid export episodes --to lerobot --out blocks
    export_umi.py blocks blocks.zarr.zip --camera cam_wrist --size 224x224 --pose phone_pose --gripper motor_state.0

COLUMNS are numbers of observation.state or action: `arm` (all of that sensor), `arm.3`, `arm.0-5`, `arm.hip.position` (a name
in the dataset), `action.0-3`, joined by commas. A pose is 6 of them (x y z in metres and a rotation vector), 7 (x y z and a
quaternion x y z w), or 16 (a 4x4 matrix, column by column, as phones send it). Each --camera, and each pair of --pose and
--gripper, takes the next number in UMI's names: camera0_rgb, robot0_eef_pos ...

No pose is made up: an episode of the buffer is a run of rows in which all poses, all grippers and what --require names
are valid. The picture of an absent camera is black, and rapid_mask shows that it is absent. Needs the packages of
models/requirements-fleet.txt.
"""

# This file owns the format of the buffer: zarr 2 in a zip, `data/*` by row and `meta/episode_ends`
# (<https://github.com/real-stanford/universal_manipulation_interface>, diffusion_policy/common/replay_buffer.py), with a
# compressor that zarr knows without registration.
# Invariant: the file gets its name when it is complete. Memory holds the numbers of all rows and a batch of pictures.

from __future__ import annotations

import argparse
import io
import json
import re
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import commandline

try:
    import numpy
    import pyarrow.parquet as pq
    import zarr
    from numcodecs import Blosc
    from PIL import Image, ImageOps
    from scipy.spatial.transform import Rotation
except ModuleNotFoundError as error:  # --help needs none of them
    missing = error.name
else:
    missing = None

MASK, PLUGGED, VALID, AGE, TIME = "rapid.mask", "rapid.plugged", "rapid.valid", "rapid.age", "rapid.time_ns"
STATE, ACTION, IMAGES = "observation.state", "action", "observation.images."
# Pictures that are decoded and packed in parallel.
BATCH = 64


class Unfit(Exception):
    """What cannot be exported, with its place and what to do about it."""


@dataclass(frozen=True)
class Columns:
    """Numbers of the dataset: the feature of each and its place there, and the sensors that they belong to."""

    text: str
    places: list[tuple[str, int]]
    sensors: list[str]
    factor: float = 1.0


@dataclass
class Buffer:
    """What is to be written."""

    arrays: dict[str, numpy.ndarray] = field(default_factory=dict)
    """By name, a row for each of the T rows."""
    pictures: dict[str, str] = field(default_factory=dict)
    """The feature of the dataset by the name of the array."""
    ends: list[int] = field(default_factory=list)
    """Row after the last one, by episode of the buffer."""
    sources: list[int] = field(default_factory=list)
    """Episode of the dataset, by episode of the buffer."""
    chosen: numpy.ndarray | None = None
    """[N] row of the buffer by row of the dataset; -1 for those left out."""


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit status: 0, or 1 with one line that names what is wrong."""
    options = parser().parse_args(arguments)
    try:
        export(options)
    except (Unfit, OSError) as error:
        return commandline.failed("export_umi", error)
    return 0


def parser() -> argparse.ArgumentParser:
    out = commandline.parser(__doc__)
    add = out.add_argument
    add("set", metavar="SET", type=Path, help="folder of the dataset: LeRobot v3.0 without videos")
    add("out", metavar="OUT", type=Path, help="the buffer, NAME.zarr.zip; must not exist")
    more = {"action": "append", "default": []}
    add("--camera", metavar="SENSOR", **more, help="the next camera; may be repeated")
    add("--size", metavar="WxH", type=size, help="crop pictures around their centre to this shape and scale them to this size")
    add("--pose", metavar="COLUMNS", **more, help="pose of the next gripper; may be repeated")
    add("--gripper", metavar="COLUMN[*FACTOR]", **more, help="its opening; FACTOR converts it to metres")
    add("--array", metavar="NAME=COLUMNS", **more, help="a further array (f32), such as state=arm or action=action")
    add("--require", metavar="SENSOR", **more, help="leave out rows in which this one is not valid; may be repeated")
    add("--min-rows", metavar="N", type=int, default=24, help="leave out shorter runs of rows (default: 24)")
    add("--verify", action="store_true", help="read OUT back and compare every picture and number with SET")
    return out


def export(options: argparse.Namespace) -> None:
    if missing:
        needed = "use a Python environment with what is in models/requirements-fleet.txt"
        raise Unfit(f"{sys.executable} has no {missing}: {needed}")
    if not hasattr(zarr, "ZipStore"):
        raise Unfit(f"zarr {zarr.__version__} writes another format: use zarr 2, as in models/requirements-fleet.txt")
    if options.out.exists():
        raise Unfit(f"{options.out}: exists already: name another file, or remove it")
    features = read_info(options.set)
    files = sorted((options.set / "data").glob("chunk-*/file-*.parquet"))
    buffer = plan(options, features, read_numbers(files, features))

    partial = options.out.with_name(f".{options.out.name}.partial")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    try:
        with zarr.ZipStore(partial, mode="w") as store:
            write(store, buffer, features, files, options.size)
        if options.verify:
            with zarr.ZipStore(partial, mode="r") as store:
                verify(store, buffer, files, options.size)
        partial.rename(options.out)
    finally:
        partial.unlink(missing_ok=True)
    rows, all_rows = buffer.ends[-1], len(buffer.chosen)
    verified = ", read back without a difference" if options.verify else ""
    print(f"{options.out}: {len(buffer.ends)} episodes, {rows} rows, {all_rows - rows} left out{verified}")


def read_info(folder: Path) -> dict:
    """The features of the dataset."""
    path = folder / "meta/info.json"
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
        version, features = info["codebase_version"], info["features"]
        for key in (MASK, VALID, AGE, TIME):
            features[key]
        earlier = PLUGGED not in features
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise Unfit(f"{path}: not a dataset that `rapid export --to lerobot` wrote: {error!r}") from error
    if earlier:
        raise Unfit(f"{path}: no {PLUGGED}: exported by an earlier version: export again")
    if version != "v3.0" or info.get("video_path"):
        raise Unfit(f"{path}: version {version}, video_path {info.get('video_path')}: only v3.0 without videos is read")
    return features


def read_numbers(files: list[Path], features: dict) -> dict:
    """All columns but the pictures, [N, ...] each."""
    wanted = [key for key, feature in features.items() if feature["dtype"] not in ("image", "video")]
    parts: dict[str, list] = {key: [] for key in wanted}
    for path in files:
        table = pq.read_table(path, columns=wanted)
        for key in wanted:
            column = table[key].combine_chunks()
            values = column.flatten() if hasattr(column, "flatten") and column.type.num_fields else column
            parts[key].append(values.to_numpy(zero_copy_only=False).reshape(len(table), -1))
    if not files:
        raise Unfit("no data/chunk-*/file-*.parquet in the dataset")
    return {key: numpy.concatenate(part) for key, part in parts.items()}


def plan(options: argparse.Namespace, features: dict, numbers: dict) -> Buffer:
    """Checks what is asked for against the dataset, and chooses the rows."""
    if len(options.pose) != len(options.gripper):
        raise Unfit(f"{len(options.pose)} --pose and {len(options.gripper)} --gripper: UMI needs one of each per gripper")
    if not (options.camera or options.pose or options.array):
        raise Unfit("nothing to export: give --camera, --pose with --gripper, or --array")
    buffer = Buffer()
    for number, sensor in enumerate(options.camera):
        key = f"{IMAGES}{sensor}"
        if key not in features:
            have = [k.removeprefix(IMAGES) for k in features if k.startswith(IMAGES)]
            raise Unfit(f"--camera {sensor}: the cameras of the dataset are {', '.join(have) or 'none'}")
        buffer.pictures[f"camera{number}_rgb"] = key
    poses = [columns("--pose", text, features) for text in options.pose]
    for pose in poses:
        if len(pose.places) not in (6, 7, 16):
            raise Unfit(f"--pose {pose.text}: {len(pose.places)} numbers, a pose is 6, 7 or 16 (see --help)")
    grippers = [gripper(text, features) for text in options.gripper]
    required = {sensor for part in (*poses, *grippers) for sensor in part.sensors}
    sensors = features[MASK]["names"]
    for sensor in options.require:
        if sensor not in sensors:
            raise Unfit(f"--require {sensor}: the sensors of the dataset are {', '.join(sensors)}")
    choose(buffer, numbers, sorted(required | {*options.require}, key=sensors.index), sensors, options.min_rows)

    rows = buffer.chosen >= 0
    for number, (pose, width) in enumerate(zip(poses, grippers, strict=True)):
        buffer.arrays |= robot(f"robot{number}", pose, width, numbers, buffer)
    for text in options.array:
        name, equals, of = text.partition("=")
        if not (equals and re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name)) or name in (*buffer.arrays, *buffer.pictures):
            raise Unfit(f"--array {text}: not NAME=COLUMNS with a new name of letters, digits and _")
        buffer.arrays[name] = take(columns("--array", of, features), numbers)[rows].astype("f4")
    for key in (MASK, PLUGGED, VALID, AGE):
        buffer.arrays[key.replace(".", "_")] = numbers[key][rows]
    buffer.arrays[TIME.replace(".", "_")] = numbers[TIME][rows, 0]
    return buffer


def columns(option: str, text: str, features: dict) -> Columns:
    """COLUMNS of the command line."""
    # By the number in the sample of a sensor, and by their names for people.
    known: dict[str, tuple[str, int]] = {}
    named: dict[str, str] = {}
    owners: dict[tuple[str, int], str] = {}
    for key in (STATE, ACTION):
        feature = features.get(key, {"columns": [], "names": []})
        for at, (column, name) in enumerate(zip(feature["columns"], feature["names"], strict=True)):
            if not column.startswith("/"):  # of a topic, which is not a sensor
                known.setdefault(column, (key, at))
                named.setdefault(name, column)
                owners[key, at] = column.rpartition(".")[0]
            if key == ACTION:
                known.setdefault(f"{ACTION}.{at}", (key, at))
    found: list[str] = []
    for part in text.split(","):
        name, _, which = part.rpartition(".")
        first, _, last = which.partition("-")
        if part in named and part not in known:
            names = [named[part]]
        elif name and first.isdecimal() and (last or first).isdecimal():
            names = [f"{name}.{at}" for at in range(int(first), int(last or first) + 1)]
        else:
            names = [column for column in known if column.rpartition(".")[0] == part]
            names.sort(key=lambda column: int(column.rpartition(".")[2]))
        unknown = [column for column in names if column not in known] or ([] if names else [part])
        if unknown:
            raise Unfit(f"{option} {text}: no {unknown[0]}; the dataset has {', '.join(known) or 'no numbers'}")
        found += names
    places = [known[name] for name in found]
    return Columns(text, places, sorted({owners[place] for place in places if place in owners}))


def gripper(text: str, features: dict) -> Columns:
    """COLUMN[*FACTOR] of the command line."""
    name, star, factor = text.partition("*")
    found = columns("--gripper", name, features)
    try:
        scale = float(factor) if star else 1.0
    except ValueError:
        scale = 0.0
    if len(found.places) != 1 or not 0 < abs(scale) < float("inf"):
        raise Unfit(f"--gripper {text}: one column is needed, with a FACTOR that is a number other than 0")
    return Columns(text, found.places, found.sensors, scale)


def choose(buffer: Buffer, numbers: dict, required: list[str], sensors: list[str], shortest: int) -> None:
    """Runs of rows of one episode in which all of `required` are valid, each an episode of the buffer."""
    valid = numbers[VALID][:, [sensors.index(sensor) for sensor in required]] == 1
    usable, episode = valid.all(1), numbers["episode_index"][:, 0]
    cuts = numpy.flatnonzero((numpy.diff(episode) != 0) | (numpy.diff(usable) != 0)) + 1
    buffer.chosen = numpy.full(len(usable), -1)
    total = 0
    for run in numpy.split(numpy.arange(len(usable)), cuts):
        number, where = episode[run[0]], f"rows {run[0]}..{run[-1]} of {len(usable)}"
        if not usable[run[0]]:
            absent = [sensor for at, sensor in enumerate(required) if not valid[run, at].all()]
            print(f"episode {number}: {where} left out: {', '.join(absent)} not valid")
        elif len(run) < shortest:
            print(f"episode {number}: {where} left out: fewer than --min-rows {shortest}")
        else:
            buffer.chosen[run] = numpy.arange(total, total + len(run))
            total += len(run)
            buffer.ends.append(total)
            buffer.sources.append(int(number))
    if not total:
        raise Unfit("no row is left: see the lines above")


def take(of: Columns, numbers: dict) -> numpy.ndarray:
    """[N, D] f64"""
    return numpy.stack([numbers[key][:, at] for key, at in of.places], 1).astype("f8") * of.factor


def robot(name: str, pose: Columns, width: Columns, numbers: dict, buffer: Buffer) -> dict:
    """UMI's arrays for a gripper."""
    rows = numpy.flatnonzero(buffer.chosen >= 0)
    found = six(take(pose, numbers)[rows])
    wrong = numpy.flatnonzero(~numpy.isfinite(found).all(1))
    if len(wrong):
        at = rows[wrong[0]]
        episode, frame = (numbers[key][at, 0] for key in ("episode_index", "frame_index"))
        raise Unfit(f"--pose {pose.text}: episode {episode}, frame {frame}: its numbers are not a rotation")
    begins = [0, *buffer.ends[:-1]]
    lengths = numpy.diff([0, *buffer.ends])
    return {
        f"{name}_eef_pos": found[:, :3].astype("f4"),
        f"{name}_eef_rot_axis_angle": found[:, 3:].astype("f4"),
        f"{name}_gripper_width": take(width, numbers)[rows].astype("f4"),
        f"{name}_demo_start_pose": numpy.repeat(found[begins], lengths, 0),
        f"{name}_demo_end_pose": numpy.repeat(found[numpy.array(buffer.ends) - 1], lengths, 0),
    }


def six(values: numpy.ndarray) -> numpy.ndarray:
    """Poses [T, 6, 7 or 16] as positions and rotation vectors [T, 6]; NaN where there is no rotation."""
    out = numpy.full((len(values), 6), numpy.nan)
    if values.shape[1] == 6:
        return values
    if values.shape[1] == 7:
        out[:, :3], quaternion = values[:, :3], values[:, 3:]
        fit = abs(numpy.linalg.norm(quaternion, axis=1) - 1) < 0.01
        out[fit, 3:] = Rotation.from_quat(quaternion[fit]).as_rotvec()
        return out
    matrix = values.reshape(-1, 4, 4).transpose(0, 2, 1)
    out[:, :3], turn = matrix[:, :3, 3], matrix[:, :3, :3]
    square = turn @ turn.transpose(0, 2, 1)
    fit = (abs(square - numpy.eye(3)) < 0.01).all((1, 2)) & (numpy.linalg.det(turn) > 0)
    out[fit, 3:] = Rotation.from_matrix(turn[fit]).as_rotvec()
    return out


def pictures(buffer: Buffer, files: list[Path], shape: tuple[int, int] | None) -> Iterator[list[tuple]]:
    """Batches of (array, row, picture u8 [H, W, 3])."""
    keys, first = {key: name for name, key in buffer.pictures.items()}, 0

    def decode(task: tuple) -> tuple:
        name, row, content = task
        try:
            picture = Image.open(io.BytesIO(content)).convert("RGB")
        except OSError as error:
            raise Unfit(f"{name}, row {row}: {error}: `rapid export --verify` compares the dataset") from error
        if shape:
            picture = ImageOps.fit(picture, shape, Image.Resampling.BILINEAR)
        return name, row, numpy.asarray(picture)

    with ThreadPoolExecutor() as pool:
        for path in files if keys else []:
            for batch in pq.ParquetFile(path).iter_batches(BATCH, columns=list(keys)):
                rows = buffer.chosen[first : first + len(batch)]
                first += len(batch)
                tasks = []
                for key, name in keys.items():
                    contents = batch.column(key).field("bytes")
                    tasks += [(name, row, contents[at].as_py()) for at, row in enumerate(rows) if row >= 0]
                yield list(pool.map(decode, tasks))


def write(store, buffer: Buffer, features: dict, files: list[Path], shape: tuple[int, int] | None) -> None:
    root = zarr.group(store)
    data, meta = root.create_group("data"), root.create_group("meta")
    packed = Blosc(cname="zstd", clevel=5, shuffle=Blosc.SHUFFLE)
    for name, value in {"episode_ends": buffer.ends, "rapid_episode": buffer.sources}.items():
        meta.array(name, numpy.array(value, "i8"), chunks=(len(value),), compressor=None)
    for name, values in buffer.arrays.items():
        array = data.array(name, values, chunks=values.shape, compressor=packed)
        if name in ("rapid_mask", "rapid_plugged", "rapid_valid", "rapid_age"):
            array.attrs["names"] = features[MASK]["names"]
    images = {}
    for name, key in buffer.pictures.items():
        height, width = shape[::-1] if shape else features[key]["shape"][:2]
        images[name] = data.create_dataset(
            name, shape=(buffer.ends[-1], height, width, 3), chunks=(1, height, width, 3), dtype="u1",
            compressor=packed, write_empty_chunks=True,
        )  # fmt: skip

    def put(task: tuple) -> None:
        name, row, picture = task
        if picture.shape != images[name].shape[1:]:
            raise Unfit(f"{name}, row {row}: a picture of {picture.shape[1]}x{picture.shape[0]}: give --size")
        images[name][row] = picture

    with ThreadPoolExecutor() as pool:
        for batch in pictures(buffer, files, shape):
            list(pool.map(put, batch))


def verify(store, buffer: Buffer, files: list[Path], shape: tuple[int, int] | None) -> None:
    """Compares what was written with the dataset; raises at the first difference."""
    root = zarr.group(store)
    data = root["data"]
    for name, values in buffer.arrays.items():
        if data[name].dtype != values.dtype or not numpy.array_equal(data[name][:], values):
            raise Unfit(f"data/{name} differs from the dataset")
    if root["meta/episode_ends"][:].tolist() != buffer.ends:
        raise Unfit("meta/episode_ends differs from what was written")
    for batch in pictures(buffer, files, shape):
        for name, row, picture in batch:
            if not numpy.array_equal(data[name][row], picture):
                raise Unfit(f"data/{name}, row {row} differs from the dataset")


def size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", text)
    if not found:
        raise argparse.ArgumentTypeError(f"'{text}' is not WxH")
    return int(found[1]), int(found[2])


if __name__ == "__main__":
    sys.exit(main())
