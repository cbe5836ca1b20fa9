#!/usr/bin/env python3
"""Prints what an episode holds, as one JSON object: for each topic its schema, the messages counted by reading them all
with their checksums, the count the file's own statistics claim, and how often time ran backwards.

    episode.py FILE
"""

import json
import sys

from mcap.reader import make_reader


def main(path):
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        topics = {}
        newest = {}
        # In the order of the file, which is the order of writing.
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            topic = topics.setdefault(
                channel.topic,
                {
                    "schema": schema.name,
                    "messages": 0,
                    "counted": summary.statistics.channel_message_counts[channel.id],
                    "backwards": 0,
                },
            )
            topic["messages"] += 1
            topic["backwards"] += message.log_time < newest.get(channel.id, 0)
            newest[channel.id] = message.log_time
    print(json.dumps(topics))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])
