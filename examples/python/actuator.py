#!/usr/bin/env python3
"""A program that moves a device for `rapid`: it goes where `/action` tells it and publishes where it is.

    [device.slide]
    vid = "0x2e8a"
    pid = "0x000b"
    node = "process"
    on_attach = ["actuator.py"]
    [device.slide.process]
    kind = "scalars"
    channels = 1
    [device.slide.action]
    names = ["position"]
    units = ["m"]
    min = [0.0]
    max = [0.4]

`rapid` stands between no program and its device: limits, a time-out, whether it is armed, and a stop when it ends are
the program's own.
"""

import time

from rapid_node import Bus

LOWEST, HIGHEST = 0.0, 0.4
# Meters a step of 10 ms.
FASTEST = 0.005
# Without an action for so long it stays where it is, seconds.
PATIENCE = 0.2


def main():
    bus = Bus()
    publisher, actions = bus.node(max_bytes=8), bus.actions()
    position = target = LOWEST
    told = time.monotonic()
    while True:
        action = actions.newest()
        if action is not None and len(action) == 1 and LOWEST <= action[0] <= HIGHEST:
            target, told = action[0], time.monotonic()
        elif time.monotonic() - told > PATIENCE:
            target = position
        position += min(FASTEST, max(-FASTEST, target - position))
        publisher.send_numbers([position])
        time.sleep(0.01)


if __name__ == "__main__":
    main()
