"""A broadcaster of static and moving transforms.

It repeats the moving ones with unchanged stamps. Each line of standard input turns and moves them,
with new stamps, and prints the stamp of the first one as `tf2_echo` does. After the line `next` all
have that stamp. After `apart` the others have one before and one after it. Without a line, none is
sent.
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
START = int(time.time())
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


def base(step, stamp):
    way = (math.sin(step), math.sin(2 * step), math.sin(3 * step), math.cos(step))
    return transform("odom", "base_link", (-1.5, step / 3, 1e-5), way, *stamp)


def moving(step, apart):
    """Returns the transforms of a step."""
    # Poses of several steps must not be neighbours in time: a listener that starts later has fewer of
    # them. The nanoseconds are few, and have no leading zeros in the output.
    seconds, nanoseconds = START + 2 * step, 1 + step
    stamp = (seconds, nanoseconds)
    way = (0.0, 0.0, math.sin(step / 7), math.cos(step / 7))
    odom = transform("map", "odom", (10.0 * step, -0.0005, 0.0), way, *stamp)
    if not apart:
        return TFMessage(transforms=[odom, base(step, stamp)])
    before, after = (seconds - 1, 970_000_000), (seconds, 50_000_000)
    return TFMessage(transforms=[odom, base(step, before), base(step + 0.4, after)])


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
for step, line in enumerate(sys.stdin):
    present.append(moving(step, line.strip() == "apart"))
    stamp = present[-1].transforms[0].header.stamp
    print(f"At time {stamp.sec}.{stamp.nanosec}", flush=True)
