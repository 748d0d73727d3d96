"""A node that logs at each level and publishes diagnostics, once a line of standard input comes."""

import sys
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.logging import LoggingSeverity

TEXTS = [
    "no scan for 1 s",
    "",
    "two  spaces, [brackets]: 100 %",
    "Überhitzt: 81 °C, 温度",
    "x" * 400,
]
STATUSES = [
    (DiagnosticStatus.ERROR, "lidar: connection", "no data for 3 s", "sick-17"),
    (DiagnosticStatus.WARN, "battery: charge", "18 %", "pack 1"),
    (DiagnosticStatus.OK, "imu: calibration", "valid", ""),
    (DiagnosticStatus.STALE, "arm: temperature", "Überhitzt", "arm"),
    (DiagnosticStatus.OK, "wheel", "", "left"),
    (DiagnosticStatus.OK, "wheel", "", "right"),
]


def diagnostics(node):
    array = DiagnosticArray()
    array.header.stamp = node.get_clock().now().to_msg()
    for level, name, message, hardware in STATUSES:
        status = DiagnosticStatus(level=level, name=name, message=message, hardware_id=hardware)
        status.values = [KeyValue(key="Voltage", value="11.5")]
        array.status.append(status)
    return array


def main():
    rclpy.init()
    node = rclpy.create_node("lidar", namespace="/front")
    logger = node.get_logger()
    logger.set_level(LoggingSeverity.DEBUG)
    publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
    while node.count_subscribers("/rosout") < 1 or publisher.get_subscription_count() < 1:
        time.sleep(0.05)
    print("matched", flush=True)
    for line in sys.stdin:
        for text in TEXTS:
            logger.debug(text)
            logger.info(text)
            logger.warning(text)
            logger.error(text)
            logger.fatal(text)
        publisher.publish(diagnostics(node))
        print("done", flush=True)


main()
