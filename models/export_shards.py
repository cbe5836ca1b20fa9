#!/usr/bin/env python3
"""Exports many episodes as tasks of a Ray cluster, and merges what they make into one LeRobot dataset.

    export_shards.py export /data/episodes --out /data/shards -- --state motor_state --verify
    export_shards.py merge /data/shards --out /data/blocks

What follows `--` are options of `rapid export`. All machines must see the episodes and the shards under the same paths, and
have `rapid`. A task makes a shard of some episodes, in a folder that gets its name when it is complete; if its machine
dies, another one makes it again. The same command continues after any interruption, and adds shards of new episodes.
`export` needs the packages of models/requirements-fleet.txt, `merge` those of models/requirements-lerobot.txt.
"""

# This file owns the folder of shards: `shards.jsonl`, the episodes of each shard, which never change once they are listed;
# `shard-NNNNN`, a dataset with few large files and `report.jsonl`, what `rapid export --json` printed.
# Invariant: a folder without a leading dot is complete, whoever made it, and is made once.

from __future__ import annotations

import argparse
import fcntl
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import commandline

LIST, REPORT = "shards.jsonl", "report.jsonl"
# Below the 100 MB of LeRobot's files: its merge appends small files to one another and rewrites the result each time.
FILE_BYTES = 90_000_000


class Failed(Exception):
    """What stops a command, or a shard; with its place and what to do about it."""


def main(arguments: list[str]) -> int:
    """Returns the exit status: 0, or 1 if a shard or the command failed."""
    at = arguments.index("--") if "--" in arguments else len(arguments)
    options = parser().parse_args(arguments[:at])
    try:
        if options.command == "merge":
            return merge(options.shards.resolve(), options.out.resolve())
        return export(options, arguments[at + 1 :])
    except (Failed, OSError) as error:
        return commandline.failed("export_shards", error)


def parser() -> argparse.ArgumentParser:
    out = commandline.parser(__doc__)
    commands = out.add_subparsers(dest="command", required=True, metavar="export|merge")
    plain = {"epilog": out.epilog, **commandline.PLAIN}
    of_export = commands.add_parser("export", help="make shards of episodes", **plain)
    add = of_export.add_argument
    add("episodes", metavar="FILE|DIR", nargs="+", type=Path, help="episodes, or folders of them")
    add("--out", metavar="SHARDS", type=Path, required=True, help="folder of the shards")
    add("--episodes-per-shard", metavar="N", type=int, default=100, help="episodes in a shard (default: 100)")
    add("--rapid", metavar="PROGRAM", default="rapid", help="the program on each machine (default: rapid)")
    add("--address", help="address of the cluster (default: RAY_ADDRESS, or the one on this machine; without one: this machine)")
    add("--retries", metavar="N", type=int, default=3, help="retries of a shard whose machine died (default: 3)")
    of_merge = commands.add_parser("merge", help="make one dataset of the shards, with LeRobot", **plain)
    of_merge.add_argument("shards", metavar="SHARDS", type=Path, help="folder of the shards")
    of_merge.add_argument("--out", metavar="SET", type=Path, required=True, help="the dataset; must not exist")
    return out


def export(options: argparse.Namespace, words: list[str]) -> int:
    try:
        import pyarrow  # noqa: F401  (in the tasks)
        import ray
    except ModuleNotFoundError as error:
        raise Failed(missing(error, "fleet")) from error
    shards = options.out.resolve()
    shards.mkdir(parents=True, exist_ok=True)
    with (shards / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise Failed(f"{shards}: another export_shards.py writes to it: wait for its end") from error
        listed = plan(shards, options.episodes, options.episodes_per_shard)
        wanted = {name: files for name, files in listed.items() if not (shards / name).exists()}
        print(f"{len(listed)} shards, {len(wanted)} to make", flush=True)
        if not wanted:
            return 0
        ray.init(address=options.address, log_to_driver=False, logging_level="ERROR")
        task = ray.remote(num_cpus=1, max_retries=options.retries)(shard)
        pending = {task.remote(str(shards), name, files, options.rapid, words): name for name, files in wanted.items()}
        failed = collect(ray, pending)
        # Left by machines that died.
        for left in shards.glob(".shard-*.partial"):
            shutil.rmtree(left, ignore_errors=True)
    return 1 if failed else 0


def plan(shards: Path, named: list[Path], size: int) -> dict[str, list[str]]:
    """The episodes of each shard: of those that are listed, and of further ones for episodes that are not listed yet."""
    found: list[Path] = []
    for path in named:
        files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
        if not files or not path.exists():
            raise Failed(f"{path}: no episode (*.mcap)")
        found += [file.resolve() for file in files]
    path = shards / LIST
    try:
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []
        listed = {line["shard"]: line["files"] for line in lines}
    except (ValueError, KeyError, TypeError) as error:
        raise Failed(f"{path}: not a list of export_shards.py: {error!r}") from error
    known = {file for files in listed.values() for file in files}
    new = [file for file in dict.fromkeys(map(str, found)) if file not in known]
    for first in range(0, len(new), size):
        listed[f"shard-{len(listed):05}"] = new[first : first + size]
    text = "".join(json.dumps({"shard": name, "files": files}) + "\n" for name, files in listed.items())
    (partial := shards / f".{LIST}.partial").write_text(text, encoding="utf-8")
    partial.rename(path)
    return listed


def collect(ray, pending: dict) -> int:
    """Prints what the tasks report; returns how many failed."""
    begin, total, failed, episodes, frames = time.monotonic(), len(pending), 0, 0, 0
    while pending:
        (done,), _ = ray.wait(list(pending), num_returns=1)
        name = pending.pop(done)
        try:
            report = ray.get(done)
        except Exception as error:  # of Ray, or what the task raised
            failed += 1
            cause = getattr(error, "cause", None) or error
            print(f"{name}: {str(cause).strip() or repr(cause)}", file=sys.stderr, flush=True)
            continue
        episodes, frames = episodes + report["episodes"], frames + report["frames"]
        left_out = f", {report['left_out']} left out (see {REPORT})" if report["left_out"] else ""
        made = f"{report['episodes']} episodes{left_out}, by {report['node']}"
        print(f"{name}: {made}; {total - len(pending)} of {total}", flush=True)
    seconds = max(time.monotonic() - begin, 1e-9)
    rate = f"{episodes / seconds:.1f} episodes/s, {frames / seconds:.0f} frames/s"
    print(f"{episodes} episodes, {frames} frames in {seconds:.1f} s: {rate}; {failed} shards failed")
    return failed


def shard(folder: str, name: str, files: list[str], rapid: str, words: list[str]) -> dict:
    """The task: makes one shard, wherever it runs."""
    import ray

    node = f"{socket.gethostname()}/{ray.get_runtime_context().get_node_id()[:8]}"
    for path in (os.path.join(folder, LIST), *files):
        if not os.path.exists(path):
            raise Failed(f"{node} does not see {path}: all machines need the same folders")
    partial = Path(folder) / f".{name}.{node.replace('/', '.')}.{os.getpid()}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    try:
        # A task has one processor.
        jobs = [] if any(word.split("=")[0] == "--jobs" for word in words) else ["--jobs", "1"]
        command = [rapid, "export", *files, "--to", "lerobot", "--out", str(partial), "--json", *jobs, *words]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        events = [json.loads(line) for line in ended.stdout.splitlines() if line.startswith("{")]
        summary = next((event for event in events if event["event"] == "export"), None)
        # Without any episode that fits, the code is 1, too, and the shard is empty.
        if not summary or summary["differences"] or (ended.returncode != 0 and summary["episodes"]):
            raise Failed(f"{node}: {rapid} export: {ended.returncode}: {(ended.stderr or ended.stdout).strip()[-500:]}")
        if summary["episodes"]:
            pack(partial)
        partial.mkdir(exist_ok=True)
        (partial / REPORT).write_text(ended.stdout, encoding="utf-8")
        try:
            partial.rename(Path(folder) / name)
        except OSError:
            # Another machine made it meanwhile: one that was taken for dead.
            if not (Path(folder) / name / REPORT).exists():
                raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return {"node": node, **{key: summary[key] for key in ("episodes", "frames", "left_out")}}


def pack(folder: Path) -> None:
    """Packs the files of the episodes into a few large ones. Most of their content is JPEGs, which do not become smaller."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    facts = pa.concat_tables(pq.read_table(path) for path in sorted((folder / "meta/episodes").glob("*/*.parquet")))
    packed, number, writer, places = folder / "data.packed/chunk-000", 0, None, []
    packed.mkdir(parents=True)
    for path in sorted((folder / "data").glob("*/*.parquet")):
        name = packed / f"file-{number:03}.parquet"
        if writer and name.stat().st_size + path.stat().st_size > FILE_BYTES:
            writer.close()
            writer, number = None, number + 1
            name = packed / f"file-{number:03}.parquet"
        source = pq.ParquetFile(path)
        writer = writer or pq.ParquetWriter(name, source.schema_arrow, use_dictionary=False, compression="none")
        for group in range(source.num_row_groups):
            writer.write_table(source.read_row_group(group))
        places.append(number)
    writer.close()
    shutil.rmtree(folder / "data")
    packed.parent.rename(folder / "data")

    zeros = [0] * len(places)
    for key, values in {
        "data/chunk_index": zeros,
        "data/file_index": places,
        "meta/episodes/chunk_index": zeros,
        "meta/episodes/file_index": zeros,
    }.items():
        facts = facts.set_column(facts.column_names.index(key), key, pa.array(values, pa.int64()))
    shutil.rmtree(folder / "meta/episodes")
    (folder / "meta/episodes/chunk-000").mkdir(parents=True)
    pq.write_table(facts, folder / "meta/episodes/chunk-000/file-000.parquet", use_dictionary=False)


def merge(shards: Path, out: Path) -> int:
    try:
        listed = [json.loads(line)["shard"] for line in (shards / LIST).read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise Failed(f"{shards / LIST}: not a list of export_shards.py: {error!r}") from error
    absent = [name for name in listed if not (shards / name).exists()]
    if absent:
        raise Failed(f"{shards}: {len(absent)} of {len(listed)} shards are not made, {absent[0]} first: run export again")
    if out.exists():
        raise Failed(f"{out}: exists already: name another folder, or remove it")
    roots = [shards / name for name in listed if (shards / name / "meta/info.json").exists()]
    infos = {root: json.loads((root / "meta/info.json").read_text(encoding="utf-8")) for root in roots}
    if not roots:
        raise Failed(f"{shards}: no episode in any shard")
    for root, info in infos.items():
        for key in ("fps", "features"):
            if info[key] != infos[roots[0]][key]:
                raise Failed(f"{root}: other {key} than {roots[0]}: export episodes of one kind, or name --state")

    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as temporary:
        # LeRobot reads tables through a cache that holds a copy of each.
        os.environ.update(HF_HUB_OFFLINE="1", HF_DATASETS_CACHE=f"{temporary}/cache", HF_DATASETS_DISABLE_PROGRESS_BARS="1")
        try:
            from lerobot.datasets.aggregate import aggregate_datasets
        except ModuleNotFoundError as error:
            raise Failed(missing(error, "lerobot")) from error
        begin = time.monotonic()
        names = [f"rapid/{root.name}" for root in roots]
        aggregate_datasets(names, f"rapid/{out.name}", roots=roots, aggr_root=Path(temporary) / "set")
        seconds = time.monotonic() - begin
        (Path(temporary) / "set").rename(out)
    episodes = sum(info["total_episodes"] for info in infos.values())
    print(f"{out}: {episodes} episodes of {len(roots)} shards in {seconds:.1f} s: {episodes / seconds:.1f} episodes/s")
    return 0


def missing(error: ModuleNotFoundError, which: str) -> str:
    where = f"models/requirements-{which}.txt"
    return f"{sys.executable} has no {error.name}: use a Python environment with what is in {where}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
