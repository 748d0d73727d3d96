"""Requests the types of all topics by their hashes, then reads the topics.

Arguments: domain, seconds.
"""
import sys
import time

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.dynamic import get_types_for_typeid
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

participant = DomainParticipant(int(sys.argv[1]))
publications = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
end = time.time() + float(sys.argv[2])
known = {}
while time.time() < end:
    for sample in publications.take(N=20):
        name = sample.topic_name
        if name in known or not name.startswith("rt/"):
            continue
        found, _ = get_types_for_typeid(participant, sample.type_id, duration(seconds=5))
        print(name, flush=True)
        qos = Qos(
            Policy.Reliability.Reliable(duration(seconds=1)),
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )
        topic = Topic(participant, name, found, qos=qos)
        known[name] = DataReader(participant, topic, qos=qos)
    time.sleep(0.05)
