//! ROS types that begin with a `std_msgs/Header`, and the plausibility of its stamp.
//!
//! The frame in a header is a place on the robot, except for some types.
//!
//! Message definitions are not available while messages are measured, so this module lists the
//! types of the common interface packages that begin with a header. Other types have no header
//! latency. Implausible stamps, such as simulated time or an unset header, are ignored.

use std::time::Duration;

use ros2probe_wire::Timestamp;
use ros2probe_wire::time::SECOND;

/// A stamp that differs more than this from the capture time comes from another clock.
pub const MAX_PLAUSIBLE_OFFSET: Duration = Duration::from_secs(3600);

/// Types from packages other than `sensor_msgs` and `geometry_msgs`.
const OTHERS: [&str; 37] = [
    "ackermann_msgs/msg/AckermannDriveStamped",
    "actionlib_msgs/msg/GoalStatusArray",
    "can_msgs/msg/Frame",
    "control_msgs/msg/DynamicJointState",
    "control_msgs/msg/InterfaceValue",
    "control_msgs/msg/JointControllerState",
    "control_msgs/msg/JointJog",
    "control_msgs/msg/JointTrajectoryControllerState",
    "control_msgs/msg/PidState",
    "control_msgs/msg/SteeringControllerStatus",
    "diagnostic_msgs/msg/DiagnosticArray",
    "geographic_msgs/msg/GeoPointStamped",
    "geographic_msgs/msg/GeoPoseStamped",
    "map_msgs/msg/OccupancyGridUpdate",
    "mavros_msgs/msg/State",
    "nav2_msgs/msg/Costmap",
    "nav2_msgs/msg/ParticleCloud",
    "nav_msgs/msg/Goals",
    "nav_msgs/msg/GridCells",
    "nav_msgs/msg/OccupancyGrid",
    "nav_msgs/msg/Odometry",
    "nav_msgs/msg/Path",
    "nav_msgs/msg/Trajectory",
    "nav_msgs/msg/TrajectoryPoint",
    "nmea_msgs/msg/Sentence",
    "radar_msgs/msg/RadarScan",
    "radar_msgs/msg/RadarTracks",
    "stereo_msgs/msg/DisparityImage",
    "trajectory_msgs/msg/JointTrajectory",
    "trajectory_msgs/msg/MultiDOFJointTrajectory",
    "vision_msgs/msg/Detection2DArray",
    "vision_msgs/msg/Detection3DArray",
    "visualization_msgs/msg/ImageMarker",
    "visualization_msgs/msg/InteractiveMarker",
    "visualization_msgs/msg/InteractiveMarkerFeedback",
    "visualization_msgs/msg/InteractiveMarkerPose",
    "visualization_msgs/msg/Marker",
];

/// Messages of `sensor_msgs` that are parts of others and have no header.
const SENSOR_PARTS: [&str; 7] = [
    "ChannelFloat32",
    "JoyFeedback",
    "JoyFeedbackArray",
    "LaserEcho",
    "NavSatStatus",
    "PointField",
    "RegionOfInterest",
];

/// Types whose header has a stamp, and a frame that is no place: the name of a device or a clock.
const WITHOUT_PLACE: [&str; 7] = [
    "actionlib_msgs/msg/GoalStatusArray",
    "can_msgs/msg/Frame",
    "mavros_msgs/msg/State",
    "nmea_msgs/msg/Sentence",
    "sensor_msgs/msg/BatteryState",
    "sensor_msgs/msg/Joy",
    "sensor_msgs/msg/TimeReference",
];

/// Returns whether the header of this ROS type names a frame of the robot.
#[must_use]
pub fn names_a_frame(message_type: &str) -> bool {
    begins_with_header(message_type) && WITHOUT_PLACE.binary_search(&message_type).is_err()
}

/// Returns whether messages of this ROS type begin with a header.
#[must_use]
pub fn begins_with_header(message_type: &str) -> bool {
    if let Some(name) = message_type.strip_prefix("sensor_msgs/msg/") {
        return !SENSOR_PARTS.contains(&name);
    }
    if let Some(name) = message_type.strip_prefix("geometry_msgs/msg/") {
        return name.ends_with("Stamped") || name == "PoseArray";
    }
    OTHERS.binary_search(&message_type).is_ok()
}

/// Returns the stamp as a time, or `None` if it comes from another clock than `now`.
#[must_use]
pub fn stamp_time((seconds, nanoseconds): (i32, u32), now: Timestamp) -> Option<Timestamp> {
    let seconds = u64::try_from(seconds).ok()?;
    let stamp = Timestamp(seconds * SECOND + u64::from(nanoseconds));
    (stamp.distance(now) <= MAX_PLAUSIBLE_OFFSET).then_some(stamp)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn listed_types_begin_with_a_header_and_others_do_not() {
        assert!(OTHERS.is_sorted());
        for name in [
            "sensor_msgs/msg/Imu",
            "nav_msgs/msg/Odometry",
            "geometry_msgs/msg/PoseArray",
        ] {
            assert!(begins_with_header(name), "{name}");
        }
        for name in [
            "sensor_msgs/msg/PointField",
            "geometry_msgs/msg/Twist",
            "std_msgs/msg/String",
            "",
        ] {
            assert!(!begins_with_header(name), "{name}");
        }
    }

    #[test]
    fn headers_of_devices_without_a_place_name_no_frame() {
        assert!(WITHOUT_PLACE.is_sorted());
        for name in WITHOUT_PLACE {
            assert!(begins_with_header(name) && !names_a_frame(name), "{name}");
        }
        assert!(names_a_frame("sensor_msgs/msg/Image"));
        assert!(!names_a_frame("std_msgs/msg/String"));
    }

    #[test]
    fn stamps_in_simulated_time_are_ignored() {
        let now = Timestamp(1_795_143_000_000_000_000);
        assert_eq!(stamp_time((12, 0), now), None);
        assert_eq!(stamp_time((-1, 0), now), None);
        assert_eq!(stamp_time((0, 0), now), None);
        let stamp = Timestamp(1_795_142_999_500_000_000);
        assert_eq!(stamp_time((1_795_142_999, 500_000_000), now), Some(stamp));
    }
}
