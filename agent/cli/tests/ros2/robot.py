"""Two nodes of a robot with seven topics, each in a separate process, and their logs.

    robot.py publish LOG [SECONDS]   announces topics, publishes after a line on standard input
    robot.py subscribe LOG           receives the messages

Both print `ready`, `matched` and, after the last message, `done`. A log has one line of JSON for
each message: its topic, its number (from 0, one below the sequence number of the DDS writer), and
the time.
"""

import heapq
import json
import os
import sys
import threading
import time

import rclpy
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.qos import HistoryPolicy, QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image, Imu, PointCloud2
from std_msgs.msg import Header, Int64
from tf2_msgs.msg import TFMessage

# Enough messages of the fastest topic for a repair of Fast DDS, which may happen after 3 s.
DEPTH = 2500
# Zenoh drops messages of a congested connection, unless the publisher keeps all messages.
IS_ZENOH = os.environ["RMW_IMPLEMENTATION"] == "rmw_zenoh_cpp"
HISTORY = HistoryPolicy.KEEP_ALL if IS_ZENOH else HistoryPolicy.KEEP_LAST
QOS = QoSProfile(depth=DEPTH, history=HISTORY)
DIGITS = "%08d"


def header():
    """Returns a header whose frame has space for the number of a message."""
    return Header(frame_id=DIGITS % 0)


# Name: type, rate in hertz, message.
TOPICS = {
    "/beat": (Int64, 1, Int64()),
    "/mode": (Int64, 0.02, Int64()),
    "/imu": (Imu, 250, Imu(header=header())),
    "/tf": (TFMessage, 100, TFMessage(transforms=[TransformStamped(header=header())])),
    "/odom": (Odometry, 50, Odometry(header=header())),
    "/cam": (Image, 10, Image(header=header(), data=bytes(150_000))),
    "/points": (PointCloud2, 5, PointCloud2(header=header(), data=bytes(2_700_000))),
}


class Log:
    """One line for each message."""

    def __init__(self, path):
        self.file = open(path, "w", buffering=1)

    def write(self, topic, number):
        line = {"topic": topic, "seq": number, "t": time.time_ns()}
        self.file.write(json.dumps(line) + "\n")


class Template:
    """A serialized message in which the number and the stamp change."""

    def __init__(self, kind, message):
        self.bytes = bytearray(serialize_message(message))
        # The stamp follows the encapsulation, and in a TFMessage the number of transforms.
        self.stamp = 8 if kind is TFMessage else 4
        self.is_number = kind is Int64

    def numbered(self, number):
        if self.is_number:
            self.bytes[4:12] = number.to_bytes(8, "little")
            return bytes(self.bytes)
        seconds, nanoseconds = divmod(time.time_ns(), 1_000_000_000)
        at = self.stamp
        self.bytes[at : at + 4] = seconds.to_bytes(4, "little")
        self.bytes[at + 4 : at + 8] = nanoseconds.to_bytes(4, "little")
        self.bytes[at + 12 : at + 20] = (DIGITS % number).encode()
        return bytes(self.bytes)

    def number(self, data):
        if self.is_number:
            return int.from_bytes(data[4:12], "little")
        return int(data[self.stamp + 12 : self.stamp + 20])


def say(word):
    print(word, flush=True)


def spin(node):
    try:
        rclpy.spin(node)
    except Exception:  # The context ends with the process.
        pass


def publish(log, seconds=10):
    node = rclpy.create_node("driver")
    publishers = {
        name: (node.create_publisher(kind, name, QOS), Template(kind, message))
        for name, (kind, _, message) in TOPICS.items()
    }
    threading.Thread(target=spin, args=(node,), daemon=True).start()
    say("ready")
    while not all(it.get_subscription_count() for it, _ in publishers.values()):
        time.sleep(0.05)
    say("matched")
    sys.stdin.readline()
    start = time.monotonic() + 0.1
    due = [(start, name, 0) for name in TOPICS]
    heapq.heapify(due)
    while due:
        at, name, number = heapq.heappop(due)
        time.sleep(max(0.0, at - time.monotonic()))
        publisher, template = publishers[name]
        publisher.publish(template.numbered(number))
        log.write(name, number)
        rate = TOPICS[name][1]
        if number + 1 < int(seconds) * rate:
            heapq.heappush(due, (start + (number + 1) / rate, name, number + 1))
    say("done")
    sys.stdin.readline()


def subscribe(log):
    node = rclpy.create_node("map")
    for name, (kind, _, message) in TOPICS.items():
        template = Template(kind, message)

        def receive(data, name=name, template=template):
            log.write(name, template.number(data))

        node.create_subscription(kind, name, receive, QOS, raw=True)
    say("ready")
    spin(node)


if __name__ == "__main__":
    rclpy.init()
    {"publish": publish, "subscribe": subscribe}[sys.argv[1]](Log(sys.argv[2]), *sys.argv[3:])
