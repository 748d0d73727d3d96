"""Publishes three topics. Argument: domain."""
import sys
import time

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from robot_types import Choice, Derived, Mode, Odd, Part, Thing

participant = DomainParticipant(int(sys.argv[1]))
qos = Qos(
    Policy.Reliability.Reliable(duration(seconds=1)),
    Policy.DataRepresentation(use_cdrv0_representation=True),
)
things = DataWriter(participant, Topic(participant, "rt/things", Thing, qos=qos), qos=qos)
derived = DataWriter(participant, Topic(participant, "rt/derived", Derived, qos=qos), qos=qos)
odd = DataWriter(participant, Topic(participant, "rt/odd", Odd, qos=qos), qos=qos)
print("ready", flush=True)
number = 0
while True:
    number += 1
    parts = [Part(number, [1.5, 2.5])]
    numbers = [9, -1, 2, -3, 4, 5, -6, 0.5]
    thing = Thing("hello", True, parts, [1, 2, 3], Part(7, []), ["a", "b"], "n", *numbers)
    things.write(thing)
    derived.write(Derived(number, Mode.BUSY, [1, 2], [[1, 2, 3], [4, 5, 6]]))
    odd.write(Odd(Choice(a=number)))
    time.sleep(0.2)
