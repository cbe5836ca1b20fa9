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
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

MIB = 1 << 20
# Older than what the check leaves out because it may be on its way.
COPIED = time.time() - 2 * 86400


def command_of(unit):
    """The command of a unit, as systemd reads it: continued lines joined, `$$` is `$`."""
    text = Path(unit).read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line.removeprefix("ExecStart=") for line in text.splitlines() if line.startswith("ExecStart=")]
    assert len(lines) == 1, lines
    return shlex.split(lines[0])


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
    upload, read_back = command_of(unit), command_of(check_unit)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        store, episodes = Store(place, server), place / "episodes"
        try:
            variables = configure(place, store, episodes)
            breaks_off(upload, variables, store)
            assert run(upload, variables).stdout == ""
            expected = ["a_001.mcap", "a_002.mcap", "a_003.mcap", "session-2026.md", "session-2026.toml", "session.toml"]
            assert store.names() == expected, store.names()
            print("resumed: all that is finished is there, and nothing that is being written")

            run(read_back, variables)
            assert len(list(episodes.glob("*.mcap"))) == 3
            print("without REMOVE_AFTER nothing is removed")
            rig = store.folder / "episodes/rig-1"
            disappears(upload, read_back, variables, rig / "a_003.mcap")
            changes(upload, read_back, variables, rig)
            closes_late(upload, variables, place, rig)
            removes(upload, variables | {"REMOVE_AFTER": "0s"}, episodes, rig)
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


def breaks_off(upload, variables, store):
    """Kills the upload once something of it is in the store: no half object is seen."""
    environment = {name: value for name, value in os.environ.items() if name != "AWS_CA_BUNDLE"}
    slow = environment | variables | {"RCLONE_BWLIMIT": "6M", "RCLONE_TRANSFERS": "1"}
    process = subprocess.Popen(words(upload, variables), env=slow, stderr=subprocess.DEVNULL, start_new_session=True)
    until("an episode is in the store", lambda: any(name.endswith(".mcap") for name in store.names()))
    # As systemd does: all processes of the unit.
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    there = [name for name in store.names() if name.endswith(".mcap")]
    assert 0 < len(there) < 3, there
    for name in there:
        path = store.folder / "episodes/rig-1" / name
        assert path.read_bytes() == (Path(variables["EPISODES"]) / name).read_bytes(), f"{name} is half an object"
    print(f"killed with {len(there)} of 3 episodes in the store, whole")


def disappears(upload, read_back, variables, there):
    """A copy that is gone: the check names it, and the next start of the upload makes it again."""
    before = there.read_bytes()
    there.unlink()
    ended = run(read_back, variables, check=False)
    assert ended.returncode != 0 and there.name in ended.stderr, ended
    run(upload, variables)
    assert there.read_bytes() == before
    run(read_back, variables)
    print("a copy that disappeared is reported, and made again from the episode here")


def changes(upload, read_back, variables, rig):
    """Copies that differ: of another length for the upload, in a byte for the check; none is replaced."""
    longer = rig / "a_001.mcap"
    whole = longer.read_bytes()
    with longer.open("ab") as file:
        file.write(b"x")
    ended = run(upload, variables, check=False)
    assert ended.returncode != 0 and longer.name in ended.stderr, ended
    assert longer.read_bytes() == whole + b"x", "the upload replaced a copy"
    os.truncate(longer, len(whole))
    flipped = rig / "a_002.mcap"
    damage(flipped)
    changed = flipped.read_bytes()
    # The store keeps the checksum of what it received: the upload may not see it, and must not hide it.
    seen = run(upload, variables, check=False).returncode != 0
    assert flipped.read_bytes() == changed, "the upload replaced a copy"
    ended = run(read_back, variables, check=False)
    assert ended.returncode != 0 and ended.stdout.split() == [flipped.name], ended
    # As the head of the unit states.
    name = f"{variables['STORE']}/{flipped.name}"
    run([shutil.which("rclone"), "moveto", "--ignore-checksum", name, f"{name}.aside"], variables)
    run(upload, variables)
    run(read_back, variables)
    assert (rig / "a_002.mcap.aside").read_bytes() == changed
    damage(flipped)
    noticed = "failed as well" if seen else "did not see it"
    print(f"a changed byte fails the check that reads it back (the upload {noticed}); moved aside it is copied again")


def closes_late(upload, variables, place, rig):
    """An episode that is closed once the copy has begun is left to the next start, which is not a failure of this one."""
    late, tools = Path(variables["EPISODES"]) / "a_007.mcap", place / "tools"
    tools.mkdir()
    # In the place of rclone: the episode appears before the check begins, old as one that was repaired.
    script = f'[ "$1" != check ] || [ -e {late} ] || cp -p {late.parent}/a_003.mcap {late}\n'
    (tools / "rclone").write_text(f'#!/bin/sh\n{script}exec {shutil.which("rclone")} "$@"\n', encoding="utf-8")
    (tools / "rclone").chmod(0o755)
    # The byte that changed in the store does not fail it here: see `changes`.
    (rig / "a_002.mcap").write_bytes((late.parent / "a_002.mcap").read_bytes())
    run(upload, variables | {"PATH": f"{tools}:{os.environ['PATH']}"})
    assert late.exists() and not (rig / late.name).exists()
    run(upload, variables)
    assert (rig / late.name).exists()
    damage(rig / "a_002.mcap")
    print("an episode that is closed after the list was made is copied by the next start")


def removes(upload, variables, episodes, rig):
    """What is equal is removed, whatever fails beside it: a copy that changed, a name that is taken."""
    with (episodes / ".upload.lock").open("a", encoding="utf-8") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        before = sorted(episodes.glob("*.mcap"))
        assert "removed" not in run(upload, variables, check=False).stdout and sorted(episodes.glob("*.mcap")) == before
    print("while copies are read back nothing is removed")
    taken = rig / "a_004.mcap"
    # Of another length: the store has no checksum of what is put there behind its back.
    taken.write_bytes(os.urandom(2 * MIB))
    there = taken.read_bytes()
    for name in ("a_004.mcap", "a_006.mcap"):
        (episodes / name).write_bytes(os.urandom(MIB))
    fresh = (episodes / "a_006.mcap").read_bytes()
    ended = run(upload, variables, check=False)
    left = sorted(path.name for path in episodes.glob("*.mcap*"))
    assert left == ["a_002.mcap", "a_004.mcap", "a_005.mcap.partial"] and ended.returncode != 0, (left, ended)
    assert taken.read_bytes() == there and taken.name in ended.stderr, ended
    assert (rig / "a_006.mcap").read_bytes() == fresh
    print("an episode in the store is not replaced by another of its name")
    print("removed: what was read back and is equal; not: what changed in the store, or has a name that is taken")


def damage(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    with open(path, "r+b") as file:
        file.write(data)


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    main(*sys.argv[1:])
