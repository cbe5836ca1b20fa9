"""`export_shards.py` on a cluster of two machines, of which one is killed in the middle of a task."""

import contextlib
import io
import json
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import unittest
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]
import export_shards
from recorded import PROGRAM, Folder, rapid, read_episode

SCRIPT = Path(export_shards.__file__)
LEROBOT = os.environ.get("LEROBOT_PYTHON")
# A cluster of this test alone: Ray lets in who has its token.
TOKEN = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
QUIET = {**os.environ, **TOKEN, "RAY_USAGE_STATS_ENABLED": "0"}
# As long as a loaded machine may need; it is waited for a state, not for a time.
PATIENCE = 120


class Machine:
    """A node of Ray: a process and those that it started."""

    def __init__(self, *words: str) -> None:
        ray = Path(sys.executable).with_name("ray")
        command = [ray, "start", *words, "--block", "--num-cpus=1", "--object-store-memory=100000000"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.process = subprocess.Popen(command, env=QUIET, **quiet)

    def kill(self) -> None:
        """All its processes at once, as when the power goes."""
        listed = subprocess.run(["ps", "-eo", "pid=,ppid="], capture_output=True, text=True, check=True).stdout
        parents = [tuple(map(int, line.split())) for line in listed.splitlines()]
        found = [self.process.pid] if self.process.poll() is None else []
        for above in found:
            found += [process for process, parent in parents if parent == above]
        for process in found:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        self.process.wait()


def until(what: str, holds) -> None:
    end = time.monotonic() + PATIENCE
    while not holds():
        if time.monotonic() > end:
            raise AssertionError(f"{what}: not met in {PATIENCE} s")
        time.sleep(0.05)


def listens(port: int) -> bool:
    with socket.socket() as found:
        return found.connect_ex(("127.0.0.1", port)) == 0


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def tables(shard: Path, what: str) -> pa.Table:
    return pa.concat_tables(pq.read_table(path) for path in sorted((shard / what).glob("*/*.parquet")))


class Cluster(Folder):
    @classmethod
    def setUpClass(cls) -> None:
        super().setUpClass()
        folder = cls.folder
        task = ("--sim", "task", "--headless", "--expert", "--record", "--episodes", "6", "--out", "episodes")
        rapid(*task, cwd=folder)
        cls.episodes = sorted((folder / "episodes").glob("*.mcap"))
        port = free_port()
        # Sockets of Ray lie below it, and a path of a socket is short.
        ray = tempfile.mkdtemp(prefix="ray-", dir="/tmp")
        cls.addClassCleanup(shutil.rmtree, ray, ignore_errors=True)
        head = Machine("--head", f"--port={port}", f"--temp-dir={ray}", "--include-dashboard=false")
        cls.addClassCleanup(head.kill)
        until("the head listens", lambda: listens(port))
        cls.address = f"127.0.0.1:{port}"
        cls.second = Machine(f"--address={cls.address}")
        cls.addClassCleanup(cls.second.kill)

    def start(self, *words: str, rapid: str | Path = PROGRAM) -> subprocess.Popen:
        command = [sys.executable, SCRIPT, "export", self.folder / "episodes", "--out", self.folder / "shards"]
        command += ["--episodes-per-shard", "2", "--rapid", rapid, "--address", self.address, *words]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        running = subprocess.Popen(command, env=QUIET, text=True, **pipes)
        self.addCleanup(lambda: (running.kill(), running.communicate()))
        return running

    def test_a_machine_dies_and_every_episode_is_there_once(self) -> None:
        shards, gate = self.folder / "shards", self.folder / "gate"
        # Stands before the program: both machines are within a task when one of them dies.
        slow = self.folder / "rapid"
        slow.write_text(f'#!/bin/sh\necho run >>"{gate}.$PPID"\nuntil test -e "{gate}"; do sleep 0.05; done\nexec "{PROGRAM}" "$@"\n')
        slow.chmod(0o755)
        running = self.start("--", "--include-bad", "--verify", rapid=slow)
        until("both machines work", lambda: len(list(self.folder.glob("gate.*"))) == 2)
        self.second.kill()
        gate.touch()
        printed, errors = running.communicate(timeout=PATIENCE)
        self.assertEqual(running.returncode, 0, printed + errors)
        self.assertIn("3 shards, 3 to make", printed)
        # The task that died has been begun once more.
        self.assertEqual(sum(len(path.read_text().splitlines()) for path in self.folder.glob("gate.*")), 4, printed)
        self.complete(shards, 3)

        again = self.start()
        self.assertEqual(again.communicate(timeout=PATIENCE)[0], "3 shards, 0 to make\n")
        with self.subTest("merged by LeRobot"):
            if not LEROBOT:
                self.skipTest("there is no environment of LeRobot: make lerobot-test makes it")
            self.merged(shards)

    def complete(self, shards: Path, number: int) -> None:
        names = sorted(path.name for path in shards.iterdir() if path.name != ".lock")
        self.assertEqual(names, [*(f"shard-{at:05}" for at in range(number)), "shards.jsonl"])
        sources, rows, times = [], 0, []
        for name in names[:-1]:
            facts, data = tables(shards / name, "meta/episodes"), tables(shards / name, "data")
            sources += facts["rapid/source"].to_pylist()
            for fact in facts.to_pylist():
                self.assertEqual((fact["data/file_index"], fact["meta/episodes/file_index"]), (0, 0))
                own = data.slice(fact["dataset_from_index"], fact["length"])
                self.assertEqual(set(own["episode_index"].to_pylist()), {fact["episode_index"]})
                times += own["rapid.time_ns"].to_pylist()
            rows += len(data)
            self.assertEqual(json.loads((shards / name / "meta/info.json").read_text())["total_frames"], len(data))
        self.assertEqual([Path(source).name for source in sources], [path.name for path in self.episodes])
        self.assertEqual(times, [row["time_ns"] for path in self.episodes for row in read_episode(path)])
        self.assertEqual(len(times), rows)

    def merged(self, shards: Path) -> None:
        out = self.folder / "merged"
        done = subprocess.run(
            [LEROBOT, SCRIPT, "merge", shards, "--out", out], capture_output=True, text=True, timeout=PATIENCE, check=False
        )
        self.assertEqual(done.returncode, 0, done.stderr)
        self.assertIn("6 episodes of 3 shards", done.stdout)
        facts, data = tables(out, "meta/episodes"), tables(out, "data")
        self.assertEqual(facts["episode_index"].to_pylist(), list(range(6)))
        self.assertEqual([Path(name).name for name in facts["rapid/source"].to_pylist()], [p.name for p in self.episodes])
        own = pa.concat_tables(tables(path, "data") for path in sorted(shards.glob("shard-*")))
        for name in own.column_names:
            if name not in ("index", "episode_index", "task_index"):
                self.assertEqual(data[name].to_pylist(), own[name].to_pylist(), name)
        self.assertEqual(data["index"].to_pylist(), list(range(len(own))))


class Refusals(unittest.TestCase):
    """What needs no cluster."""

    def setUp(self) -> None:
        temporary = tempfile.TemporaryDirectory()
        self.addCleanup(temporary.cleanup)
        self.folder = Path(temporary.name)

    def test_the_list_never_changes_what_is_in_a_shard(self) -> None:
        episodes, shards = self.folder / "episodes", self.folder / "shards"
        episodes.mkdir()
        shards.mkdir()
        (episodes / "b.mcap").touch()
        first = export_shards.plan(shards, [episodes], 2)
        for name in ("a", "c", "d"):
            (episodes / f"{name}.mcap").touch()
        second = export_shards.plan(shards, [episodes, episodes / "b.mcap"], 2)
        named = {name: [Path(file).stem for file in files] for name, files in second.items()}
        self.assertEqual(named, {"shard-00000": ["b"], "shard-00001": ["a", "c"], "shard-00002": ["d"]})
        self.assertEqual(first["shard-00000"], second["shard-00000"])

    def test_each_is_named(self) -> None:
        with self.assertRaisesRegex(export_shards.Failed, "no episode"):
            export_shards.plan(self.folder, [self.folder], 2)
        with self.assertRaisesRegex(export_shards.Failed, "shards.jsonl: not a list"):
            export_shards.merge(self.folder, self.folder / "out")
        (self.folder / "shards.jsonl").write_text('{"shard": "shard-00000", "files": []}\n')
        with self.assertRaisesRegex(export_shards.Failed, "1 of 1 shards are not made, shard-00000 first"):
            export_shards.merge(self.folder, self.folder / "out")
        for name, fps in (("shard-00000", 30), ("shard-00001", 60)):
            (self.folder / name / "meta").mkdir(parents=True)
            (self.folder / name / "meta/info.json").write_text(json.dumps({"fps": fps, "features": {}}))
        lines = [json.dumps({"shard": f"shard-0000{at}", "files": []}) + "\n" for at in range(2)]
        (self.folder / "shards.jsonl").write_text("".join(lines))
        with self.assertRaisesRegex(export_shards.Failed, "shard-00001: other fps than"):
            export_shards.merge(self.folder, self.folder / "out")
        with contextlib.redirect_stderr(io.StringIO()) as printed:
            status = export_shards.main(["merge", str(self.folder), "--out", str(self.folder)])
        self.assertEqual((status, "exists already" in printed.getvalue()), (1, True))


if __name__ == "__main__":
    unittest.main()
