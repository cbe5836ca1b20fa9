#!/usr/bin/env python3
"""Puts the observations of a running `rapid` together, and prints a line for each.

    observe.py COUNT TOPIC...            observe.py 5 /rapid/camera/wrist /rapid/serial/motor

An observation names the sample of each modality that belongs to a tick; the sample is on the topic of the modality.
It ends after COUNT observations. RAPID_INSTANCE is what that `rapid` was given as --instance.
"""

import struct
import sys

import iceoryx2
from rapid_node import Bus

MASK = struct.Struct("<Q")
# Bit of the modality, flags, number of the chosen sample, its age in ns.
SLOT = struct.Struct("<IIQq")
VALID, STALE, CHOSEN = 2, 4, 8
# Samples of a modality that are kept until an observation names one of them.
KEPT = 64


def main(count, topics):
    bus = Bus()

    def inbox(topic):
        try:
            return bus.inbox(topic)
        except iceoryx2.PublishSubscribeOpenError as error:
            sys.exit(f"{topic}: no such topic: does rapid run, with this device and this RAPID_INSTANCE? ({error})")

    observations, inboxes = inbox("/rapid/observation"), [inbox(topic) for topic in topics]
    samples = {}
    while count > 0:
        bus.wait()
        ticks = list(observations.take())
        # Read after the observation: the samples that it names are there.
        for inbox in inboxes:
            for header, payload in inbox.take():
                kept = samples.setdefault(header.id, {})
                kept[header.seq] = payload
                if len(kept) > KEPT:
                    del kept[next(iter(kept))]
        for header, payload in ticks[:count]:
            (mask,) = MASK.unpack_from(payload)
            line = [f"tick {header.seq} mask {mask:#04x}"]
            for bit, flags, seq, age in SLOT.iter_unpack(payload[MASK.size :]):
                sample = samples.get(bit, {}).get(seq) if flags & CHOSEN else None
                state = "valid" if flags & VALID else "stale" if flags & STALE else "absent"
                chosen = f" seq {seq} age {age / 1e6:.1f} ms" if flags & CHOSEN else ""
                held = f", {len(sample)} bytes" if sample is not None else ""
                line.append(f"{bit}: {state}{chosen}{held}")
            # Without its bytes: it came before this program subscribed.
            print("; ".join(line), flush=True)
        count -= len(ticks[:count])


if __name__ == "__main__":
    if len(sys.argv) < 3 or not sys.argv[1].isdecimal():
        sys.exit(__doc__)
    main(int(sys.argv[1]), sys.argv[2:])
