"""Two network namespaces joined by a link whose delay, loss, rate and break are set while it runs.

The kernel's netem is not in every kernel. Here each namespace has a TUN device, and packets pass through this process.
Needs root.
"""

import ctypes
import fcntl
import heapq
import os
import random
import select
import struct
import subprocess
import threading
import time

CLONE_NEWNET = 0x40000000
TUNSETIFF = 0x400454CA
IFF_TUN, IFF_NO_PI = 0x0001, 0x1000
MTU = 1500


class Link:
    """The namespaces `NAME-a` (10.77.0.1) and `NAME-b` (10.77.0.2)."""

    ADDRESSES = ("10.77.0.1", "10.77.0.2")

    def __init__(self, name):
        self.names = (f"{name}-a", f"{name}-b")
        self.ends, self.lock, self.ends_now = [], threading.Lock(), False
        self.set()
        for namespace, address in zip(self.names, self.ADDRESSES):
            subprocess.run(["ip", "netns", "del", namespace], stderr=subprocess.DEVNULL, check=False)
            subprocess.run(["ip", "netns", "add", namespace], check=True)
            self.ends.append(self._tun(namespace))
            inside = ["ip", "-n", namespace]
            subprocess.run([*inside, "link", "set", "lo", "up"], check=True)
            subprocess.run([*inside, "addr", "add", f"{address}/30", "dev", "far"], check=True)
            subprocess.run([*inside, "link", "set", "far", "mtu", str(MTU), "up"], check=True)
        self.thread = threading.Thread(target=self._carry, daemon=True)
        self.thread.start()

    def set(self, delay=(0.0, 0.0), jitter=0.0, loss=0.0, rate=None, up=True):
        """Seconds of delay from a to b and from b to a, further ones by chance, share of packets, bytes a second."""
        with self.lock:
            self.delay, self.jitter, self.loss, self.rate, self.up = delay, jitter, loss, rate, up

    def close(self):
        self.ends_now = True
        self.thread.join()
        for end in self.ends:
            os.close(end)
        for namespace in self.names:
            subprocess.run(["ip", "netns", "del", namespace], check=False)

    @staticmethod
    def _tun(namespace):
        libc, here = ctypes.CDLL(None, use_errno=True), os.open("/proc/self/ns/net", os.O_RDONLY)
        there = os.open(f"/run/netns/{namespace}", os.O_RDONLY)
        try:
            if libc.setns(there, CLONE_NEWNET):
                raise OSError(ctypes.get_errno(), "setns")
            end = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
            fcntl.ioctl(end, TUNSETIFF, struct.pack("16sH", b"far", IFF_TUN | IFF_NO_PI))
            return end
        finally:
            libc.setns(here, CLONE_NEWNET)
            os.close(here)
            os.close(there)

    def _carry(self):
        waiting, number, free, chance = [], 0, [0.0, 0.0], random.Random(1)
        while not self.ends_now:
            now = time.monotonic()
            patience = min(0.05, max(0.0, waiting[0][0] - now)) if waiting else 0.05
            readable, _, _ = select.select(self.ends, [], [], patience)
            with self.lock:
                delay, jitter, loss, rate, up = self.delay, self.jitter, self.loss, self.rate, self.up
            now = time.monotonic()
            for end in readable:
                side = self.ends.index(end)
                for _ in range(64):
                    try:
                        packet = os.read(end, 65536)
                    except BlockingIOError:
                        break
                    if not up or chance.random() < loss:
                        continue
                    due = now
                    if rate:
                        # What a router would not keep either.
                        if free[side] - now > 0.1:
                            continue
                        due = free[side] = max(now, free[side]) + len(packet) / rate
                    number += 1
                    heapq.heappush(waiting, (due + delay[side] + chance.random() * jitter, number, 1 - side, packet))
            while waiting and waiting[0][0] <= now:
                _, _, side, packet = heapq.heappop(waiting)
                try:
                    os.write(self.ends[side], packet)
                except (BlockingIOError, OSError):
                    pass
