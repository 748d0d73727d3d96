"""A publisher and a subscription at 1 kHz, in separate processes.

    inside.py publish      each line of standard input is a number of messages; prints `published N`
    inside.py subscribe    prints `received N` for each line of standard input

Both print `ready` first. The publisher prints `matched` when it has a subscription.
"""

import sys
import threading
import time

import rclpy
from std_msgs.msg import Int64

PERIOD = 0.001
# At least the messages of a test: Fast DDS cannot repair messages that are overwritten.
DEPTH = 10_000


def main():
    rclpy.init()
    node = rclpy.create_node(sys.argv[1])
    if sys.argv[1] == "publish":
        publisher = node.create_publisher(Int64, "/counted", DEPTH)
        print("ready", flush=True)
        while publisher.get_subscription_count() == 0:
            time.sleep(0.05)
        print("matched", flush=True)
        for line in sys.stdin:
            begin = time.monotonic()
            for number in range(int(line)):
                time.sleep(max(0, begin + number * PERIOD - time.monotonic()))
                publisher.publish(Int64(data=number))
            print(f"published {int(line)}", flush=True)
    else:
        received = [0]

        def count(_):
            received[0] += 1

        node.create_subscription(Int64, "/counted", count, DEPTH)
        threading.Thread(target=rclpy.spin, args=[node], daemon=True).start()
        print("ready", flush=True)
        for _ in sys.stdin:
            print(f"received {received[0]}", flush=True)


main()
