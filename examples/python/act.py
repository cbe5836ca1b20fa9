#!/usr/bin/env python3
"""Tells the actuator of a running `rapid` where to go, from outside: `act.py SECONDS NUMBER...`, a number an axis.

It says the same 50 times a second, as an actuator stops that is not told anything. RAPID_INSTANCE is what that
`rapid` was given as --instance. `rapid` records what it says; there is room for one such program beside the policy.
"""

import os
import sys
import time

from rapid_node import ACTIONS, MOST_AXES, Bus

PERIOD = 0.02


def main(seconds, *axes):
    instance = os.environ.get("RAPID_INSTANCE")
    publisher = Bus(f"iox2_{instance}_" if instance else None).publisher(ACTIONS, 8 * MOST_AXES)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        publisher.send_numbers(axes, recv_ns=time.monotonic_ns())
        time.sleep(PERIOD)


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    main(*map(float, sys.argv[1:]))
