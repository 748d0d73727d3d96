//! Metrics of what the robot itself says.

use super::Metric;

pub const CLOCK_OFFSET: Metric = Metric::gauge(
    "ros2_clock_offset_seconds",
    &["host", "peer"],
    "Time by which the peer's clock is ahead of the host's; absent without evidence for both bounds.",
)
.unit("seconds")
.experimental();
pub const CLOCK_UNCERTAINTY: Metric = Metric::gauge(
    "ros2_clock_offset_uncertainty_seconds",
    &["host", "peer"],
    "Distance from ros2_clock_offset_seconds to the bounds of the offset.",
)
.unit("seconds")
.experimental();
pub const CLOCK_STEPS: Metric = Metric::counter(
    "ros2_clock_steps_total",
    &["peer"],
    "Steps of a peer's clock, and contradictions in the evidence; both reset the bounds.",
)
.experimental();
pub const LOG_MESSAGES: Metric = Metric::counter(
    "ros2_log_messages_total",
    &["domain_id", "ros_node", "level"],
    "Messages of a node's log on /rosout, each counted once; only those that were sent and seen.",
)
.experimental();
pub const DIAGNOSTICS_LEVEL: Metric = Metric::gauge(
    "ros2_diagnostics_level",
    &["domain_id", "topic", "name", "hardware_id"],
    "Level of a part of the robot in its diagnostics: 0 ok, 1 warn, 2 error, 3 stale. It is also \
     stale if its messages cease.",
)
.experimental();
pub const DIAGNOSTICS_VALUE: Metric = Metric::gauge(
    "ros2_diagnostics_value",
    &["domain_id", "topic", "name", "hardware_id", "key"],
    "Last number of a value in diagnostics that `robot.diagnostic_values` selects.",
)
.experimental();
pub const PARAMETER_CHANGES: Metric = Metric::counter(
    "ros2_parameter_changes_total",
    &["domain_id", "ros_node"],
    "Changes of a node's parameters, without those that it declares; only those that were seen.",
)
.experimental();
pub const TRANSFORM_MESSAGES: Metric = Metric::counter(
    "ros2_transform_messages_total",
    TRANSFORM,
    "Transforms of an edge that were seen; its rate is that of its broadcasters together.",
)
.experimental();
pub const TRANSFORM_AGE: Metric = Metric::gauge(
    "ros2_transform_age_seconds",
    TRANSFORM,
    "Time since the last transform of an edge; absent for static ones.",
)
.experimental();
pub const TRANSFORM_BROADCASTERS: Metric = Metric::gauge(
    "ros2_transform_broadcasters",
    TRANSFORM,
    "Publishers that broadcast an edge, at most four.",
)
.experimental();
pub const TRANSFORM_JUMPS: Metric = Metric::counter(
    "ros2_transform_jumps_total",
    &["domain_id", "namespace", "parent", "child", "kind"],
    "Sudden changes of an edge: its translation, its rotation, or its time, which went back.",
)
.experimental();

pub const BATTERY_CHARGE: Metric = Metric::gauge(
    "ros2_battery_charge_ratio",
    TOPIC,
    "Charge of a battery, from 0 to 1 (`percentage` of BatteryState); absent if it is not measured.",
)
.unit("ratio")
.experimental();
pub const BATTERY_VOLTAGE: Metric =
    Metric::gauge("ros2_battery_voltage_volts", TOPIC, "Voltage of a battery.")
        .unit("volts")
        .experimental();
pub const BATTERY_CURRENT: Metric = Metric::gauge(
    "ros2_battery_current_amperes",
    TOPIC,
    "Current of a battery, negative while it discharges; absent if it is not measured.",
)
.unit("amperes")
.experimental();
pub const BATTERY_TEMPERATURE: Metric = Metric::gauge(
    "ros2_battery_temperature_celsius",
    TOPIC,
    "Temperature of a battery; absent if it is not measured.",
)
.unit("celsius")
.experimental();
pub const FIELD_UNREADABLE: Metric = Metric::gauge(
    "ros2probe_field_unreadable",
    &["domain_id", "topic", "metric", "reason"],
    "1 while a metric of a field has no value: unknown_type, malformed or no_number.",
)
.experimental();

const TOPIC: &[&str] = &["domain_id", "topic"];
const TRANSFORM: &[&str] = &["domain_id", "namespace", "parent", "child"];
