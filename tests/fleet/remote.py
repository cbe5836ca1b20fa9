#!/usr/bin/env python3
"""Sensors of one computer on another: two network namespaces, in each the real program and rapid-remote.

    remote.py RAPID RAPID_REMOTE [ZENOHD]

The clock of the second computer is 1000 s ahead (a time namespace). Shown are, from what the first one records: an unplug
there, kills of either program there and a break of the network, on a good link and on one with delay and loss, each clear
the bits within a second, and everything comes back; capture times on a link with delay, loss and little room; the verdict.
Through a router an unplug, a kill, both breaks, and the router's own death and return. Needs root, Python 3.10 and the
package mcap.
"""

import json
import os
import signal
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "python"))
from link import Link  # noqa: E402
from mcap.reader import make_reader  # noqa: E402
from read_episode import fields  # noqa: E402

AHEAD = 1000
LATEST = 1.0  # seconds until a bit falls
CAMERA, STATE = "/rapid/lan/cam_far", "/rapid/lan/state_far"

THERE = """
[rig]
name = "there"
cooldown = "100ms"
[device.cam]
vid = "046d"
pid = "0825"
serial = "B1"
node = "camera"
bit = 0
[device.cam.camera]
width = 160
height = 120
fps = 30
[device.state]
vid = "1209"
pid = "0001"
node = "serial"
bit = 1
tty = { channels = 3 }
"""

HERE = """
[rig]
name = "here"
cooldown = "100ms"
[device.cam_far]
node = "lan"
bit = 4
[device.cam_far.lan]
protocol = "remote"
host = "robot-b"
device = "cam"
width = 160
height = 120
[device.state_far]
node = "lan"
bit = 5
[device.state_far.lan]
protocol = "remote"
host = "robot-b"
device = "state"
kind = "scalars"
channels = 3
"""

UNPLUGS = """
[[device]]
name = "cam"
bytes = "8kB"
[[device]]
name = "state"
[[event]]
at = "8s"
unplug = "cam"
[[event]]
at = "11s"
plug = "cam"
"""
STAYS = UNPLUGS.split("[[event]]", maxsplit=1)[0]
# A router that starts beside everything else takes its time.
UNPLUGS_LATER = UNPLUGS.replace('"8s"', '"15s"').replace('"11s"', '"18s"')
# Of the links that are not good.
POOR = {"delay": (0.05, 0.05), "loss": 0.05}


def until(what, holds, limit=60):
    end = time.monotonic() + limit
    while not (found := holds()):
        assert time.monotonic() < end, f"{what}: not met in {limit} s"
        time.sleep(0.01)
    return found


class Program:
    """A program in a namespace, whose output is kept."""

    def __init__(self, place, name, command, namespace, ahead=False):
        self.name, self.log = name, place / f"{name}.log"
        clock = ["unshare", "-T", "--monotonic", str(AHEAD)] if ahead else []
        environment = os.environ | {"XDG_STATE_HOME": str(place / f"state-{name}"), "HOME": str(place)}
        # Each program is the process itself, so that a kill is one.
        command = ["ip", "netns", "exec", namespace, *clock, *map(str, command)]
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log, env=environment, cwd=place)

    def events(self):
        lines = self.log.read_text(encoding="utf-8", errors="replace").splitlines()
        return [json.loads(line) for line in lines if line.startswith("{") and line.endswith("}")]

    def reported(self, name):
        return [event for event in self.events() if event.get("event") == name]

    def states(self, device):
        return [event["state"] for event in self.reported("state") if event["device"] == device]

    def kill(self):
        self.process.kill()
        at = time.time()
        self.process.wait()
        return at

    def stop(self):
        self.process.send_signal(signal.SIGINT)
        self.process.wait(60)


class Rig:
    """Both computers."""

    def __init__(self, place, link, rapid, remote, scenario, router=None):
        self.place, self.link, self.rapid, self.remote = place, link, rapid, remote
        self.router = router
        place.mkdir()
        for name, text in (("here.toml", HERE), ("there.toml", THERE), ("scenario.toml", scenario)):
            (place / name).write_text(text, encoding="utf-8")
        self.run_there()
        self.serve()
        self.run_join()
        self.here = self.run_here("here")
        self.both()

    def run_there(self):
        options = ["--sim", "scenario.toml", "--headless", "--json", "--record", "--instance", "fleet-there"]
        command = [self.rapid, *options, "--config", "there.toml", "--out", "there"]
        self.there = Program(self.place, "there", command, self.link.names[1], ahead=True)

    def serve(self):
        to = ["--router", f"tcp/{self.link.ADDRESSES[0]}:7447"] if self.router else []
        command = [self.remote, "serve", "--config", "there.toml", "--name", "robot-b", "--instance", "fleet-there", *to]
        self.served = Program(self.place, "serve", command, self.link.names[1], ahead=True)

    def run_join(self):
        at = self.link.ADDRESSES
        to = ["--router", f"tcp/{at[0]}:7447"] if self.router else ["--connect", f"tcp/{at[1]}:7447"]
        self.join = Program(self.place, "join", [self.remote, "join", *to], self.link.names[0])

    def run_here(self, out):
        options = ["--headless", "--json", "--record", "--instance", "fleet-here"]
        command = [self.rapid, *options, "--config", "here.toml", "--out", out]
        return Program(self.place, out, command, self.link.names[0])

    def both(self, beyond=(0, 0)):
        """Both sensors stream, more often than before."""
        for device, count in zip(("cam_far", "state_far"), beyond):
            until(f"{device} streams", lambda: self.here.states(device).count("streaming") > count)

    def count(self):
        return tuple(self.here.states(device).count("streaming") for device in ("cam_far", "state_far"))

    def end(self):
        for program in (self.here, self.join, self.served, self.there):
            program.stop()


class Episode:
    """What is in the file of a folder."""

    def __init__(self, folder):
        (path,) = sorted(folder.glob("*.mcap"))
        self.samples, self.masks, self.clocks, self.numbers, self.late = {}, [], [], {}, {}
        with path.open("rb") as file:
            reader = make_reader(file)
            for schema, channel, message in reader.iter_messages():
                if schema.name == "rapid.Mask":
                    mask = dict(fields(message.data)).get(2, 0)
                    if not self.masks or self.masks[-1][1] != mask:
                        self.masks.append((message.log_time / 1e9, mask))
                elif schema.name == "rapid.Event":
                    event = json.loads(dict(fields(message.data))[5])
                    if event["event"] == "clock":
                        self.clocks.append(event)
                elif schema.name in ("foxglove.CompressedImage", "rapid.Scalars"):
                    own = dict(fields(message.data))
                    payload = own[2]
                    self.samples.setdefault(channel.topic, []).append((message.log_time, payload))
                    self.numbers.setdefault(channel.topic, []).append(message.sequence)
                    self.late.setdefault(channel.topic, []).append(message.publish_time - message.log_time)
            summary = {record.name: record.metadata for record in reader.iter_metadata()}["rapid/summary"]
        self.verdict, self.reasons = summary["verdict"], json.loads(summary["reasons"])
        self.summary = summary

    def falls(self, at, bits):
        """Seconds from `at` until all these bits are clear; 0 if a poor link had cleared them just before."""
        before = [mask for when, mask in self.masks if when < at]
        if before and not before[-1] & bits:
            return 0.0
        return next(when - at for when, mask in self.masks if when >= at and not mask & bits)


class Ends:
    """What ends while both sensors stream. Each time their bits must fall in time, and they must come back."""

    CAM, BOTH = 1 << 4, 3 << 4

    def __init__(self, rig, where):
        self.rig, self.where, self.found = rig, where, []

    def unplugged(self):
        """The camera is unplugged there, by the scenario, and plugged in again."""
        rig, before = self.rig, self.rig.count()
        detach = until("the unplug there", lambda: rig.there.reported("detach"))[0]
        until("cam_far is absent", lambda: rig.here.states("cam_far")[-1] == "absent")
        assert rig.here.states("state_far")[-1] == "streaming"
        # The clock there is 1000 s ahead, and the wall clock is the same.
        self.found.append(("unplugged there", detach["stamp"] / 1e9 - AHEAD + time.time() - time.monotonic(), self.CAM))
        rig.both((before[0], 0))

    def end(self, what, at, again):
        """`at` ends it and returns when; `again` undoes that."""
        rig, before = self.rig, self.rig.count()

        def bits():
            return int(rig.here.reported("state")[-1]["mask"], 16) & self.BOTH

        # By the bits: a sensor is stalled for a while before it is taken for absent.
        until(f"both stream before {what}", lambda: bits() == self.BOTH)
        self.found.append((what, at(), self.BOTH))
        until(f"both are gone after {what}", lambda: bits() == 0)
        again()
        rig.both(before)

    def partition(self, what, **fault):
        """No packet passes, on a link that has this fault before and afterwards."""
        link, here = self.rig.link, self.rig.here

        def part():
            link.set(up=False)
            return time.time()

        clocks = len(here.reported("clock"))
        link.set(**fault)
        # The fault is on both ways of an exchange.
        until("two reports of the clocks", lambda: len(here.reported("clock")) >= clocks + 2)
        self.end(what, part, lambda: link.set(**fault))
        link.set()

    def judge(self, episode):
        for what, at, bits in self.found:
            after = episode.falls(at, bits)
            print(f"remote: {self.where}: {what}: the bit fell after {after * 1e3:.0f} ms")
            assert after < LATEST, (self.where, what, after)


class Router:
    """A router on the first computer: zenohd, or without it a session of zenoh in the same mode."""

    PORT = 7447

    def __init__(self, place, link, remote, zenohd):
        self.place, self.namespace = place, link.names[0]
        configuration = place / "router.json5"
        endpoints = [f"tcp/{link.ADDRESSES[0]}:{self.PORT}"]
        configuration.write_text(json.dumps({"mode": "router", "listen": {"endpoints": endpoints}}), encoding="utf-8")
        own = [zenohd, "--config"] if zenohd else [remote, "join", "--port", "7460", "--zenoh"]
        self.command = [*own, configuration]
        self.start()

    def start(self):
        self.program = Program(self.place, "router", self.command, self.namespace)
        until("the router listens", self.listens)

    def listens(self):
        # What a killed one left of its connections may hold the port for a moment.
        if self.program.process.poll() is not None:
            self.program = Program(self.place, "router", self.command, self.namespace)
        listed = ["ip", "netns", "exec", self.namespace, "ss", "-Hltn", f"sport = :{self.PORT}"]
        return subprocess.run(listed, capture_output=True, text=True, check=True).stdout.strip()

    def kill(self):
        return self.program.kill()


def breaks(place, link, rapid, remote):
    """Everything that can end: on a link without faults, then the network on a poor one."""
    rig = Rig(place, link, rapid, remote, UNPLUGS)
    ends = Ends(rig, "directly")
    ends.unplugged()
    ends.end("kill -9 of serve", lambda: rig.served.kill(), rig.serve)
    ends.end("kill -9 of rapid there", lambda: rig.there.kill(), rig.run_there)
    ends.partition("the network is gone")
    ends.end("kill -9 of join", lambda: rig.join.kill(), rig.run_join)
    rig.here.stop()
    episode = Episode(place / "here")
    ends.judge(episode)
    # Within the interval of the mask and the clocks' reading.
    worst = max(clock["uncertainty_ns"] for clock in episode.clocks)
    print(f"remote: the clock was known to {worst / 1e6:.2f} ms")
    assert not [reason for reason in episode.reasons if "capture times uncertain" in reason], episode.reasons

    rig.here = rig.run_here("poor")
    rig.both()
    ends = Ends(rig, "directly, on a link with delay and loss")
    ends.partition("the network is gone", **POOR)
    rig.end()
    ends.judge(Episode(place / "poor"))


def check_clocks(episode):
    """The offset is right within what is reported with it."""
    assert episode.clocks
    for clock in episode.clocks:
        wrong = abs(clock["offset_ns"] - AHEAD * 10**9)
        # The kernel sets both clocks from one, which does not drift.
        assert wrong <= clock["uncertainty_ns"], clock
    return max(abs(clock["offset_ns"] - AHEAD * 10**9) for clock in episode.clocks)


def compare(here, there):
    """The pictures are those that were recorded there, at their time, and each that is missing is counted."""
    recorded = {payload: (number, at) for number, (at, payload) in enumerate(there.samples["/rapid/camera/cam"])}
    mine = [payload for _, payload in here.samples[CAMERA]]
    assert mine and all(payload in recorded for payload in mine), "a picture that was not sent"
    first, last = recorded[mine[0]][0], recorded[mine[-1]][0]
    sent, numbers = last - first + 1, here.numbers[CAMERA]
    counted = numbers[-1] - numbers[0] + 1 - len(numbers)
    assert sent - len(mine) == counted, (sent, len(mine), counted)
    # Both wall clocks are one.
    wrong = max(abs(at - recorded[payload][1]) for at, payload in here.samples[CAMERA])
    return len(mine), counted, wrong


def recorded(rig, out, seconds):
    """An episode of this length, of a rig that streams."""
    rig.here.stop()
    rig.here = rig.run_here(out)
    rig.both()
    time.sleep(seconds)
    rig.here.stop()
    return Episode(rig.place / out)


def impaired(place, link, rapid, remote):
    """Delay, loss, little room, an uneven delay."""
    rig = Rig(place, link, rapid, remote, STAYS)
    found = {}
    for name, fault in {
        "good": {},
        "delayed": POOR,
        "uneven": {"delay": (0.0, 0.08), "jitter": 0.01},
        "narrow": {"rate": 120_000},
    }.items():
        link.set(**fault)
        # The estimate of the link before is used up.
        time.sleep(0 if name == "good" else 20)
        found[name] = recorded(rig, name, 8)
        link.set()
    rig.end()
    there = Episode(place / "there")
    for name, episode in found.items():
        wrong, worst = check_clocks(episode), max(clock["uncertainty_ns"] for clock in episode.clocks)
        pictures, lost, shifted = compare(episode, there)
        judged = [reason for reason in episode.reasons if "capture times uncertain" in reason]
        print(
            f"remote: {name}: {pictures} pictures, {lost} lost and counted, the clock wrong by {wrong / 1e6:.2f} ms and "
            f"known to {worst / 1e6:.2f} ms, times shifted by up to {shifted / 1e6:.2f} ms, half of the pictures here "
            f"{sorted(episode.late[CAMERA])[pictures // 2] / 1e6:.0f} ms after their capture: {episode.verdict} {judged}"
        )
        assert shifted <= worst + 5e6, "capture times are further off than reported"
        assert bool(judged) == (worst > 12.5e6), (episode.reasons, worst)
    assert not [reason for reason in found["good"].reasons if "capture times uncertain" in reason]
    for name in ("delayed", "uneven"):
        assert any("capture times uncertain" in reason for reason in found[name].reasons), found[name].reasons
        assert found[name].verdict != "GOOD"
    assert compare(found["narrow"], there)[1] > 0, "everything passed through the narrow link"


def routed(place, link, rapid, remote, zenohd):
    """Everything that can end through a router, and the router itself."""
    router = Router(place.parent, link, remote, zenohd)
    rig = Rig(place, link, rapid, remote, UNPLUGS_LATER, router=True)
    ends = Ends(rig, "through a router")
    ends.unplugged()
    ends.end("kill -9 of serve", lambda: rig.served.kill(), rig.serve)
    ends.partition("the network is gone")
    ends.partition("the network is gone, on a link with delay and loss", **POOR)
    ends.end("kill -9 of the router", router.kill, router.start)
    rig.end()
    episode = Episode(place / "here")
    ends.judge(episode)
    check_clocks(episode)
    sent = {payload for _, payload in Episode(place / "there").samples["/rapid/camera/cam"]}
    assert all(payload in sent for _, payload in episode.samples[CAMERA]), "a picture that was not sent"
    # How it ends by itself is its own matter: zenohd has taken more than a minute.
    router.kill()


def main(rapid, remote, zenohd=None):
    rapid, remote = Path(rapid).resolve(), Path(remote).resolve()
    with tempfile.TemporaryDirectory() as folder:
        link = Link("rapid-fleet")
        try:
            place = Path(folder)
            for name, test in (("breaks", breaks), ("impaired", impaired)):
                link.set()
                test(place / name, link, rapid, remote)
            link.set()
            routed(place / "routed", link, rapid, remote, zenohd and Path(zenohd).resolve())
        except BaseException:
            for log in sorted(Path(folder).rglob("*.log")):
                tail = log.read_text(encoding="utf-8", errors="replace").splitlines()[-12:]
                print(f"--- {log.name}", *(line[:300] for line in tail), sep="\n", file=sys.stderr)
            raise
        finally:
            for namespace in link.names:
                left = subprocess.run(["ip", "netns", "pids", namespace], capture_output=True, text=True, check=False)
                for process in left.stdout.split():
                    os.kill(int(process), signal.SIGKILL)
            link.close()


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    main(*sys.argv[1:])
