"""Publishers and subscriptions that count, in separate processes.

    counting.py publish NAME TOPIC RATE BYTES DEPTH RELIABILITY [LOG]
    counting.py subscribe NAME TOPIC DEPTH RELIABILITY [PAUSE]
    counting.py log NAME TOPIC DEPTH RELIABILITY LOG
    counting.py bag PATH

Publisher and subscription print `ready` first. Each line of standard input is a number of messages.
The publisher sends them and prints `published N` with the total number of sent messages. For each
line the subscription prints `received N first F last L`, with the numbers in the messages. PAUSE is
the time that its callback takes, in seconds.

A DEPTH of 0 keeps all messages. LOG is a file with the SHA-256 of the serialized bytes of each
message, one per line. `log` subscribes and only writes this file. `bag` prints the topic and the
hash of each message that rosbag2 reads.
"""

import hashlib
import random
import sys
import threading
import time

import rclpy
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from std_msgs.msg import UInt8MultiArray


def qos(depth, reliability):
    history = HistoryPolicy.KEEP_LAST if int(depth) else HistoryPolicy.KEEP_ALL
    reliability = ReliabilityPolicy[reliability]
    return QoSProfile(depth=int(depth), history=history, reliability=reliability)


def digest(data):
    return hashlib.sha256(data).hexdigest()


def publish(node, topic, rate, size, depth, reliability, log=None):
    publisher = node.create_publisher(UInt8MultiArray, topic, qos(depth, reliability))
    print("ready", flush=True)
    while publisher.get_subscription_count() == 0:
        time.sleep(0.05)
    print("matched", flush=True)
    number = 0
    file = open(log, "w", buffering=1) if log else None
    message = UInt8MultiArray(data=random.Random(topic).randbytes(int(size)))
    for line in sys.stdin:
        begin = time.monotonic()
        for step in range(int(line)):
            time.sleep(max(0, begin + step / float(rate) - time.monotonic()))
            number += 1
            message.data[0:8] = message.data.__class__("B", number.to_bytes(8, "little"))
            publisher.publish(message)
            if file:
                file.write(digest(serialize_message(message)) + "\n")
        print(f"published {number}", flush=True)


def subscribe(node, topic, depth, reliability, pause="0"):
    numbers = []

    def count(message):
        numbers.append(int.from_bytes(bytes(message.data[0:8]), "little"))
        time.sleep(float(pause))

    node.create_subscription(UInt8MultiArray, topic, count, qos(depth, reliability))
    threading.Thread(target=rclpy.spin, args=[node], daemon=True).start()
    print("ready", flush=True)
    for _ in sys.stdin:
        first, last = (numbers[0], numbers[-1]) if numbers else (0, 0)
        print(f"received {len(numbers)} first {first} last {last}", flush=True)


def log(node, topic, depth, reliability, log):
    file = open(log, "w", buffering=1)

    def write(data):
        file.write(digest(data) + "\n")

    node.create_subscription(UInt8MultiArray, topic, write, qos(depth, reliability), raw=True)
    print("ready", flush=True)
    rclpy.spin(node)


def bag(path):
    from rosbag2_py import ConverterOptions, SequentialReader, StorageOptions

    reader = SequentialReader()
    reader.open(StorageOptions(uri=path, storage_id="mcap"), ConverterOptions("cdr", "cdr"))
    while reader.has_next():
        topic, data, _ = reader.read_next()
        print(topic, digest(data))


def main():
    if sys.argv[1] == "bag":
        return bag(sys.argv[2])
    rclpy.init()
    node = rclpy.create_node(sys.argv[2])
    act = {"publish": publish, "subscribe": subscribe, "log": log}[sys.argv[1]]
    act(node, *sys.argv[3:])


main()
