"""Nodes of a pipeline: a sensor, nodes with a known processing time, and their logs.

chains.py sensor OUT HZ LOG
chains.py node NAME IN OUT MILLISECONDS keep|now LOG
"""
import json
import sys
import time

import rclpy
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2


class Sensor(Node):
    def __init__(self, out, rate, log):
        super().__init__("sensor")
        self.publisher = self.create_publisher(PointCloud2, out, 10)
        self.log = open(log, "w", buffering=1)
        self.create_timer(1 / rate, self.publish)

    def publish(self):
        message = PointCloud2()
        message.header.frame_id = "sensor"
        message.header.stamp = self.get_clock().now().to_msg()
        stamp = message.header.stamp
        before = time.time_ns()
        self.publisher.publish(message)
        line = {"stamp": [stamp.sec, stamp.nanosec], "published": before, "after": time.time_ns()}
        self.log.write(json.dumps(line) + "\n")


class Stage(Node):
    def __init__(self, name, source, out, milliseconds, stamps, log):
        super().__init__(name)
        self.publisher = self.create_publisher(PointCloud2, out, 10)
        self.seconds, self.keeps = milliseconds / 1000, stamps == "keep"
        self.log = open(log, "w", buffering=1)
        self.create_subscription(PointCloud2, source, self.work, 10)

    def work(self, message):
        started = time.time_ns()
        stamp = message.header.stamp
        key = [stamp.sec, stamp.nanosec]
        time.sleep(self.seconds)
        if not self.keeps:
            message.header.stamp = self.get_clock().now().to_msg()
        before = time.time_ns()
        self.publisher.publish(message)
        line = {"stamp": key, "started": started, "published": before, "after": time.time_ns()}
        self.log.write(json.dumps(line) + "\n")


def main():
    role, *rest = sys.argv[1:]
    rclpy.init()
    if role == "sensor":
        out, rate, log = rest
        node = Sensor(out, float(rate), log)
    else:
        name, source, out, milliseconds, stamps, log = rest
        node = Stage(name, source, out, float(milliseconds), stamps, log)
    print("ready", flush=True)
    rclpy.spin(node)


main()
