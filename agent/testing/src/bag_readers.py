"""Reads bags with the PyPI readers `mcap` and `rosbags`, and prints what they found as JSON.

usage: bag_readers.py BAG_DIRECTORY...
"""

import hashlib
import json
import sys
from pathlib import Path

from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import Reader


def digest(data):
    return hashlib.sha256(data).hexdigest()


def mcap_file(path):
    """Every record with its checksum, and every message through the index."""
    with path.open("rb") as file:
        records = [type(record).__name__ for record in StreamReader(file, validate_crcs=True).records]
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages = [
            {
                "topic": channel.topic,
                "type": schema.name,
                "sequence": message.sequence,
                "log_time": message.log_time,
                "publish_time": message.publish_time,
                "digest": digest(message.data),
            }
            for schema, channel, message in reader.iter_messages()
        ]
        summary = reader.get_summary()
        profile = reader.get_header().profile
    return {
        "profile": profile,
        "records": len(records),
        "messages": messages,
        "counts": {
            summary.channels[channel].topic: count
            for channel, count in summary.statistics.channel_message_counts.items()
        },
        "schemas": {schema.name: [schema.encoding, len(schema.data)] for schema in summary.schemas.values()},
    }


def rosbags_bag(directory):
    with Reader(directory) as reader:
        connections = [
            {
                "topic": connection.topic,
                "type": connection.msgtype,
                "count": connection.msgcount,
                "hash": connection.digest,
                "definition": connection.msgdef.format.name,
                "qos": [
                    {
                        "history": qos.history.name,
                        "depth": qos.depth,
                        "reliability": qos.reliability.name,
                        "durability": qos.durability.name,
                        "deadline": [qos.deadline.sec, qos.deadline.nsec],
                    }
                    for qos in connection.ext.offered_qos_profiles
                ],
            }
            for connection in reader.connections
        ]
        messages = [
            {"topic": connection.topic, "log_time": time, "digest": digest(data)}
            for connection, time, data in reader.messages()
        ]
        return {
            "connections": connections,
            "messages": messages,
            "start": reader.start_time,
            "end": reader.end_time,
            "count": reader.message_count,
            "distro": reader.ros_distro,
        }


def main():
    found = []
    for directory in map(Path, sys.argv[1:]):
        files = sorted(directory.glob("*.mcap"))
        found.append(
            {
                "mcap": [mcap_file(path) for path in files],
                "rosbags": rosbags_bag(directory),
            }
        )
    json.dump(found, sys.stdout)


main()
