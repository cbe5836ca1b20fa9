#!/usr/bin/env python3
"""Runs the commands of rapid-upload.service and rapid-upload-check.service against a real S3 server on this machine.

    upload.py UNIT CHECK_UNIT VERSITYGW

The units are the files that `rapid artifacts` writes, VERSITYGW the server (https://github.com/versity/versitygw), which
keeps objects as files. A break in the middle, a copy that changes or disappears in the store, and an episode that is being
written are shown. Needs rclone and Python 3.10.
"""

import fcntl
import os
import re
import shlex
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

MIB = 1 << 20
# Older than what the check leaves out because it may be on its way.
COPIED = time.time() - 2 * 86400


def commands(unit, count):
    """The commands of a unit, as systemd reads them: continued lines joined, `$$` is `$`."""
    text = Path(unit).read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line.removeprefix("ExecStart=") for line in text.splitlines() if line.startswith("ExecStart=")]
    assert len(lines) == count, lines
    return [shlex.split(line) for line in lines]


def words(command, variables):
    """A command with its variables: `${NAME}` is one word, `$$` a `$` for the shell."""
    named = lambda word: re.sub(r"(?<!\$)\$\{(\w+)\}", lambda found: variables[found[1]], word)
    return [named(word).replace("$$", "$") for word in command]


class Store:
    """A bucket of a server of its own."""

    def __init__(self, place, server):
        self.folder = place / "store"
        (self.folder / "episodes").mkdir(parents=True)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        environment = os.environ | {"ROOT_ACCESS_KEY": "test", "ROOT_SECRET_KEY": "test-secret"}
        command = [server, "--port", f"127.0.0.1:{self.port}", "posix", str(self.folder)]
        self.process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        until("the server listens", lambda: socket.socket().connect_ex(("127.0.0.1", self.port)) == 0)

    def names(self):
        rig = self.folder / "episodes/rig-1"
        return sorted(path.name for path in rig.iterdir() if not path.name.startswith(".")) if rig.is_dir() else []


def until(what, holds):
    end = time.monotonic() + 60
    while not holds():
        assert time.monotonic() < end, f"{what}: not met in time"
        time.sleep(0.02)


def run(command, variables, check=True):
    environment = {name: value for name, value in os.environ.items() if name != "AWS_CA_BUNDLE"} | variables
    ended = subprocess.run(words(command, variables), env=environment, capture_output=True, text=True)
    assert not check or ended.returncode == 0, f"{command}: {ended.stderr}"
    return ended


def main(unit, check_unit, server):
    sessions, copy, check, remove = commands(unit, 4)
    (read_back,) = commands(check_unit, 1)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        store, episodes = Store(place, server), place / "episodes"
        try:
            variables = configure(place, store, episodes)
            breaks_off(copy, variables, store)
            run(sessions, variables)
            run(copy, variables)
            run(check, variables)
            expected = ["a_001.mcap", "a_002.mcap", "a_003.mcap", "session-2026.md", "session-2026.toml", "session.toml"]
            assert store.names() == expected, store.names()
            print("resumed: all that is finished is there, and nothing that is being written")

            run(read_back, variables)
            assert run(remove, variables).stdout == "" and len(list(episodes.glob("*.mcap"))) == 3
            print("without REMOVE_AFTER nothing is removed")
            disappears(copy, read_back, variables, store.folder / "episodes/rig-1/a_003.mcap")
            changes(copy, check, read_back, variables, store.folder / "episodes/rig-1")
            at_once = variables | {"REMOVE_AFTER": "0s"}
            with (episodes / ".upload.lock").open("a", encoding="utf-8") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                assert run(remove, at_once).stdout == "" and len(list(episodes.glob("*.mcap"))) == 3
            print("while copies are read back nothing is removed")
            (episodes / "a_004.mcap").write_bytes(os.urandom(MIB))
            ended = run(remove, at_once, check=False)
            left = sorted(path.name for path in episodes.glob("*.mcap*"))
            assert left == ["a_002.mcap", "a_004.mcap", "a_005.mcap.partial"] and ended.returncode != 0, (left, ended)
            print("removed: what was read back and is equal; not: what changed in the store, or is not there")
            names_are_taken(copy, variables, store, episodes)
        finally:
            store.process.kill()
            store.process.wait()


def configure(place, store, episodes):
    """Episodes, and where they go."""
    episodes.mkdir()
    for number in range(1, 4):
        path = episodes / f"a_{number:03}.mcap"
        path.write_bytes(os.urandom(12 * MIB))
        os.utime(path, (COPIED, COPIED))
    (episodes / "a_005.mcap.partial").write_bytes(os.urandom(MIB))
    for name in ("session.toml", "session-2026.toml", "session-2026.md"):
        (episodes / name).write_text("x", encoding="utf-8")
    config = place / "rclone.conf"
    config.write_text(
        "[lab]\ntype = s3\nprovider = Other\naccess_key_id = test\nsecret_access_key = test-secret\n"
        f"endpoint = http://127.0.0.1:{store.port}\n",
        encoding="utf-8",
    )
    return {"EPISODES": str(episodes), "STORE": "lab:episodes/rig-1", "RCLONE_CONFIG": str(config)}


def breaks_off(copy, variables, store):
    """Kills the copy once something of it is in the store: no half object is seen."""
    environment = {name: value for name, value in os.environ.items() if name != "AWS_CA_BUNDLE"}
    slow = environment | variables | {"RCLONE_BWLIMIT": "6M", "RCLONE_TRANSFERS": "1"}
    process = subprocess.Popen(words(copy, variables), env=slow, stderr=subprocess.DEVNULL)
    until("an episode is in the store", lambda: any(name.endswith(".mcap") for name in store.names()))
    process.kill()
    process.wait()
    there = [name for name in store.names() if name.endswith(".mcap")]
    assert 0 < len(there) < 3, there
    for name in there:
        path = store.folder / "episodes/rig-1" / name
        assert path.read_bytes() == (Path(variables["EPISODES"]) / name).read_bytes(), f"{name} is half an object"
    print(f"killed with {len(there)} of 3 episodes in the store, whole")


def disappears(copy, read_back, variables, there):
    """A copy that is gone: the check names it, and the next start of the upload makes it again."""
    before = there.read_bytes()
    there.unlink()
    ended = run(read_back, variables, check=False)
    assert ended.returncode != 0 and there.name in ended.stderr, ended
    run(copy, variables)
    assert there.read_bytes() == before
    run(read_back, variables)
    print("a copy that disappeared is reported, and made again from the episode here")


def changes(copy, check, read_back, variables, rig):
    """Copies that differ: of another length for the upload, in a byte for the check; none is replaced."""
    longer = rig / "a_001.mcap"
    whole = longer.read_bytes()
    with longer.open("ab") as file:
        file.write(b"x")
    for command in (copy, check):
        ended = run(command, variables, check=False)
        assert ended.returncode != 0 and longer.name in ended.stderr, ended
    assert longer.read_bytes() == whole + b"x", "the upload replaced a copy"
    os.truncate(longer, len(whole))
    flipped = rig / "a_002.mcap"
    damage(flipped)
    changed = flipped.read_bytes()
    # The store keeps the checksum of what it received: these two may not see it, and must not hide it.
    seen = [run(command, variables, check=False).returncode != 0 for command in (copy, check)]
    assert flipped.read_bytes() == changed, "the upload replaced a copy"
    ended = run(read_back, variables, check=False)
    assert ended.returncode != 0 and ended.stdout.split() == [flipped.name], ended
    noticed = "failed as well" if any(seen) else "did not see it"
    print(f"a changed byte fails the check that reads it back (the upload {noticed})")


def names_are_taken(copy, variables, store, episodes):
    """An episode of a name that the store has already: the one there stays, and the others are copied."""
    there = store.folder / "episodes/rig-1/a_001.mcap"
    before = there.read_bytes()
    for name in ("a_001.mcap", "a_006.mcap"):
        (episodes / name).write_bytes(os.urandom(MIB))
    ended = run(copy, variables, check=False)
    assert ended.returncode != 0 and there.read_bytes() == before, ended
    assert "a_006.mcap" in store.names(), store.names()
    print("an episode in the store is not replaced by another of its name")


def damage(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    with open(path, "r+b") as file:
        file.write(data)


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    main(*sys.argv[1:])
