"""Writes a bag in sqlite3 storage as rosbag2 does, from lines of JSON on stdin.

Usage: bag_chains.py DIRECTORY
"""

import json
import os
import sqlite3
import sys

directory = sys.argv[1]
os.mkdir(directory)
name = os.path.basename(directory) + "_0.db3"
database = sqlite3.connect(os.path.join(directory, name))
database.executescript(
    """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY,ros_distro TEXT NOT NULL);
CREATE TABLE metadata(id INTEGER PRIMARY KEY,metadata_version INTEGER NOT NULL,metadata TEXT NOT NULL);
CREATE TABLE topics(id INTEGER PRIMARY KEY,name TEXT NOT NULL,type TEXT NOT NULL,serialization_format TEXT NOT NULL,offered_qos_profiles TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY,topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
"""
)
topics = {}
for line in sys.stdin:
    message = json.loads(line)
    topic = message["topic"]
    if topic not in topics:
        topics[topic] = len(topics) + 1
        database.execute(
            "INSERT INTO topics VALUES(?, ?, ?, 'cdr', '')",
            (topics[topic], topic, message["type"]),
        )
    database.execute(
        "INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)",
        (topics[topic], message["time"], bytes.fromhex(message["data"])),
    )
count = database.execute("SELECT COUNT(*) FROM messages").fetchone()[0]
database.commit()
database.close()
with open(os.path.join(directory, "metadata.yaml"), "w", encoding="utf-8") as file:
    file.write(
        f"""rosbag2_bagfile_information:
  version: 5
  storage_identifier: sqlite3
  duration:
    nanoseconds: 0
  starting_time:
    nanoseconds_since_epoch: 0
  message_count: {count}
  topics_with_message_count: []
  compression_format: ""
  compression_mode: ""
  relative_file_paths:
    - {name}
"""
    )
