"""A broadcaster of static and moving transforms.

It repeats the moving ones with an unchanged stamp. Each line of standard input turns and moves them,
with a new stamp, and prints the stamp as `tf2_echo` does. Without a line, none is sent.
"""

import math
import sys
import threading
import time

import rclpy
from geometry_msgs.msg import TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

PERIOD = 0.1
HALF = math.sqrt(0.5)
# Child: parent, translation, and quaternion. Those of `up` and `down` are at the poles.
STATIC = {
    "lidar": ("base_link", (0.25, 0.0, 1.5), (0.0, 0.0, 0.0, 1.0)),
    "camera": ("base_link", (0.5, -0.125, 0.75), (-0.5, 0.5, -0.5, 0.5)),
    "arm": ("base_link", (-0.3, 0.2, 0.1), (0.1, 0.2, 0.3, math.sqrt(0.86))),
    "hand": ("arm", (0.0, 0.0, -12345.678), (-0.7, 0.1, 0.1, -0.7)),
    "up": ("arm", (0.0, 0.0, 0.0), (0.0, -HALF, 0.0, HALF)),
    "down": ("arm", (0.0, 0.0, 0.0), (0.0, HALF, 0.0, HALF)),
    "wheel": ("base_link", (0.0, 0.0, 0.0), (0.0, 0.0, -0.6, -0.8)),
    "marker": ("map", (-1.0, -2.0, 0.0), (0.0, 0.0, 1.0, 0.0)),
}


def transform(parent, child, translation, quaternion, seconds=0, nanoseconds=0):
    length = math.hypot(*quaternion)
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    message.header.stamp.sec, message.header.stamp.nanosec = seconds, nanoseconds
    to = message.transform
    to.translation.x, to.translation.y, to.translation.z = translation
    to.rotation.x, to.rotation.y, to.rotation.z, to.rotation.w = (it / length for it in quaternion)
    return message


def moving(step):
    """Returns the transforms of a step, with one stamp."""
    # The nanoseconds are few, and have no leading zeros in the output.
    stamp = (int(time.time()), 1 + step)
    odom = (0.0, 0.0, math.sin(step / 7), math.cos(step / 7))
    base = (math.sin(step), math.sin(2 * step), math.sin(3 * step), math.cos(step))
    return TFMessage(transforms=[
        transform("map", "odom", (10.0 * step, -0.0005, 0.0), odom, *stamp),
        transform("odom", "base_link", (-1.5, step / 3, 1e-5), base, *stamp),
    ])


rclpy.init()
node = rclpy.create_node("broadcaster")
qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
static = node.create_publisher(TFMessage, "/tf_static", qos)
publisher = node.create_publisher(TFMessage, "/tf", 100)
edges = [transform(parent, child, at, way) for child, (parent, at, way) in STATIC.items()]
static.publish(TFMessage(transforms=edges))
present = []


def repeat():
    while True:
        for message in present[-1:]:
            publisher.publish(message)
        time.sleep(PERIOD)


threading.Thread(target=repeat, daemon=True).start()
print("ready", flush=True)
for step, _ in enumerate(sys.stdin):
    present.append(moving(step))
    stamp = present[-1].transforms[0].header.stamp
    print(f"At time {stamp.sec}.{stamp.nanosec}", flush=True)
