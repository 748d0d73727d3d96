"""The peer on Cyclone DDS 11, whose Python package brings its own library.

Command line and log: README.md.
"""

import argparse
import json
import os
import queue
import select
import signal
import sys
import threading
import time
from dataclasses import dataclass

from cyclonedds.core import Listener, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, annotations, types
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.sub import DataReader, Subscriber
from cyclonedds.topic import Topic
from cyclonedds.util import duration

STACK = "cyclonedds11"
UNSUPPORTED = ["filter"]
SUPPORTED = [
    "reliability",
    "durability",
    "late_joiner",
    "ownership",
    "arbitration",
    "deadline",
    "lifespan",
    "liveliness",
    "partition",
    "fragments",
    "incompatible_qos",
    "matched",
]
# The standard names of the policies, by their standard numbers.
POLICIES = [
    "INVALID",
    "USER_DATA",
    "DURABILITY",
    "PRESENTATION",
    "DEADLINE",
    "LATENCY_BUDGET",
    "OWNERSHIP",
    "OWNERSHIP_STRENGTH",
    "LIVELINESS",
    "TIME_BASED_FILTER",
    "PARTITION",
    "RELIABILITY",
    "DESTINATION_ORDER",
    "HISTORY",
    "RESOURCE_LIMITS",
    "ENTITY_FACTORY",
    "WRITER_DATA_LIFECYCLE",
    "READER_DATA_LIFECYCLE",
    "TOPIC_DATA",
    "GROUP_DATA",
    "TRANSPORT_PRIORITY",
    "LIFESPAN",
    "DURABILITY_SERVICE",
    "DATA_REPRESENTATION",
    "TYPE_CONSISTENCY_ENFORCEMENT",
]
SHAPE_SIZE = 30
# The time between the match and the first sample, unless a line on standard input starts it.
SETTLE_TIME = 0.5
POLL_INTERVAL = 0.002

stopped = threading.Event()


@dataclass
@annotations.final
class ShapeType(IdlStruct, typename="ShapeType"):
    color: str
    annotations.key("color")
    x: types.int32
    y: types.int32
    shapesize: types.int32
    additional_payload: types.sequence[types.byte]


def options():
    parser = argparse.ArgumentParser(allow_abbrev=False)
    parser.add_argument("--role", choices=["pub", "sub"])
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--topic", default="Square")
    parser.add_argument("--color", default="BLUE")
    parser.add_argument("--best-effort", action="store_true")
    parser.add_argument("--reliable", dest="best_effort", action="store_false", default=False)
    parser.add_argument("--durability", choices=["volatile", "transient-local"], default="volatile")
    parser.add_argument("--depth", type=int, default=100)
    parser.add_argument("--keep-all", action="store_true")
    parser.add_argument("--ownership-strength", type=int)
    parser.add_argument("--exclusive", action="store_true")
    parser.add_argument("--deadline", type=int)
    parser.add_argument("--lifespan", type=int)
    parser.add_argument("--liveliness-lease", type=int)
    parser.add_argument("--partition", action="append", default=[])
    parser.add_argument("--filter")
    parser.add_argument("--size", type=int, default=0)
    parser.add_argument("--rate", type=float, default=20.0)
    parser.add_argument("--count", type=int, default=0)
    parser.add_argument("--peers", type=int, default=1)
    parser.add_argument("--hold", action="store_true")
    parser.add_argument("--stretch", type=int, default=0)
    parser.add_argument("--linger", type=float, default=1.0)
    parser.add_argument("--log")
    parser.add_argument("--capabilities", action="store_true")
    given = parser.parse_args()
    if given.capabilities:
        print(json.dumps(dict.fromkeys(SUPPORTED, True) | dict.fromkeys(UNSUPPORTED, False)))
        sys.exit()
    if not given.role:
        parser.error("--role is missing")
    if given.filter:
        parser.error("--filter is not supported by this library")
    return given


def qos_of(options):
    history = Policy.History.KeepAll if options.keep_all else Policy.History.KeepLast(options.depth)
    policies = [
        Policy.Reliability.BestEffort
        if options.best_effort
        else Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.Durability.TransientLocal
        if options.durability == "transient-local"
        else Policy.Durability.Volatile,
        history,
        # What a writer keeps for late readers.
        Policy.DurabilityService(0, history, -1, -1, -1),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    ]
    if options.exclusive or options.ownership_strength is not None:
        policies.append(Policy.Ownership.Exclusive)
        if options.role == "pub":
            policies.append(Policy.OwnershipStrength(options.ownership_strength or 0))
    if options.deadline is not None:
        policies.append(Policy.Deadline(duration(milliseconds=options.deadline)))
    if options.lifespan is not None and options.role == "pub":
        policies.append(Policy.Lifespan(duration(milliseconds=options.lifespan)))
    if options.liveliness_lease is not None:
        lease = duration(milliseconds=options.liveliness_lease)
        policies.append(Policy.Liveliness.Automatic(lease))
    return Qos(*policies)


def say(line):
    print(line, flush=True)


class Log:
    def __init__(self, path):
        self.file = open(path, "w", buffering=1) if path else None

    def write(self, event, **fields):
        if self.file:
            line = {"t": time.time_ns(), "ev": event, **fields}
            self.file.write(json.dumps(line, separators=(",", ":")) + "\n")


def listener_of(role, events):
    def matched(_, status):
        events.put(("matched", {"total": status.current_count}))

    def incompatible(_, status):
        policy = POLICIES[status.last_policy_id]
        events.put(("incompatible", {"policy": policy}))

    if role == "pub":
        return Listener(on_publication_matched=matched, on_offered_incompatible_qos=incompatible)
    return Listener(on_subscription_matched=matched, on_requested_incompatible_qos=incompatible)


class Peer:
    """One participant with one endpoint."""

    def __init__(self, options):
        self.events = queue.SimpleQueue()
        self.options = options
        self.matched = self.received = 0
        self.participant = DomainParticipant(options.domain)
        topic = Topic(self.participant, options.topic, ShapeType)
        qos = qos_of(options)
        group = Qos(Policy.Partition(options.partition)) if options.partition else None
        listener = listener_of(options.role, self.events)
        if options.role == "pub":
            self.group = Publisher(self.participant, qos=group)
            self.endpoint = DataWriter(self.group, topic, qos=qos, listener=listener)
        else:
            self.group = Subscriber(self.participant, qos=group)
            self.endpoint = DataReader(self.group, topic, qos=qos, listener=listener)
        self.log = Log(options.log)
        self.log.write("start", stack=STACK, pid=os.getpid(), guid=self.endpoint.guid.hex)

    def poll(self):
        while not self.events.empty():
            event, fields = self.events.get()
            if event == "matched":
                if fields["total"] == self.matched:
                    continue
                self.matched = fields["total"]
            self.log.write(event, **fields)
        if self.options.role == "sub":
            for sample in self.endpoint.take(N=100):
                if sample.sample_info.valid_data:
                    length = len(sample.additional_payload)
                    self.log.write("sub", seq=sample.x, color=sample.color, len=length)
                    self.received += 1

    def is_complete(self):
        return 0 < self.options.count <= self.received

    def pump(self, condition):
        """Logs what happens while the condition holds, at least once."""
        self.poll()
        while not stopped.is_set() and condition():
            time.sleep(POLL_INTERVAL)
            self.poll()

    def pump_until(self, due):
        self.pump(lambda: time.monotonic() < due)

    def wait_matched(self):
        self.pump(lambda: self.matched < self.options.peers and not self.is_complete())
        if not stopped.is_set():
            say("matched")

    def wait_for_line(self):
        self.pump(lambda: not select.select([sys.stdin], [], [], 0)[0])
        if not stopped.is_set() and not sys.stdin.readline():
            sys.exit("standard input ended before the line")

    def publish(self):
        if self.options.hold:
            self.wait_for_line()
        else:
            self.pump_until(time.monotonic() + SETTLE_TIME)
        payload = bytes(place % 256 for place in range(self.options.size))
        shape = ShapeType(self.options.color, 0, 0, SHAPE_SIZE, payload)
        start, first = time.monotonic(), 0
        while self.options.count == 0 or shape.x < self.options.count:
            if 0 < self.options.stretch == shape.x - first:
                self.wait_for_line()
                start, first = time.monotonic(), shape.x
            self.pump_until(start + (shape.x - first) / self.options.rate)
            if stopped.is_set():
                break
            self.endpoint.write(shape)
            self.log.write("pub", seq=shape.x, len=self.options.size)
            shape.x += 1
        say("done")
        self.pump_until(time.monotonic() + self.options.linger)

    def run(self):
        say("ready")
        self.wait_matched()
        if self.options.role == "pub":
            self.publish()
        else:
            self.pump(lambda: not self.is_complete())
        self.log.write("stop")


def main():
    for number in [signal.SIGINT, signal.SIGTERM]:
        signal.signal(number, lambda *_: stopped.set())
    Peer(options()).run()


main()
