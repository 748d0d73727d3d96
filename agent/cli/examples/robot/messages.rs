//! The robot's ROS messages, with fields in the order of their `.msg` definitions, which serde and
//! CDR follow. The module contains only the messages of the roles, all of them complete.

use std::fmt;

use anyhow::{Context as _, Result, ensure};
use ros2_client::Message;
use ros2_client::builtin_interfaces::Time;
use serde::de::{Deserializer, Visitor};
use serde::{Deserialize, Serialize, Serializer};

/// Size of a serialized `PointCloud2` besides its `data`: 4 bytes of encapsulation, 48 before the
/// data and 1 after it. Assumes empty `fields` and the `frame_id` `lidar`.
const POINT_CLOUD_OVERHEAD: usize = 53;
const FLOAT32: u8 = 7;

/// `std_msgs/Header`
#[derive(Clone, Serialize, Deserialize)]
pub(crate) struct Header {
    pub(crate) stamp: Time,
    frame_id: String,
}

impl Header {
    fn now(frame_id: &str) -> Header {
        Header {
            stamp: Time::now(),
            frame_id: frame_id.to_owned(),
        }
    }
}

/// `sensor_msgs/PointCloud2`
#[derive(Clone, Serialize, Deserialize)]
pub(crate) struct PointCloud2 {
    pub(crate) header: Header,
    height: u32,
    width: u32,
    fields: Vec<PointField>,
    is_bigendian: bool,
    point_step: u32,
    row_step: u32,
    data: Bytes,
    is_dense: bool,
}

impl PointCloud2 {
    /// Returns a cloud of x, y, z and intensity with about `data_size` bytes of points.
    pub(crate) fn with_fields(data_size: usize) -> PointCloud2 {
        let names = ["x", "y", "z", "intensity"];
        let fields = names.iter().zip((0_u32..).step_by(4));
        let fields = fields.map(|(name, offset)| PointField {
            name: (*name).to_owned(),
            offset,
            datatype: FLOAT32,
            count: 1,
        });
        PointCloud2::of(fields.collect(), 16, data_size - data_size % 16)
    }

    /// Returns a cloud whose serialized form, encapsulation included, has exactly `size` bytes.
    pub(crate) fn of_serialized_size(size: usize) -> Result<PointCloud2> {
        let data = size
            .checked_sub(POINT_CLOUD_OVERHEAD)
            .context("size is below 64 bytes")?;
        ensure!(data >= 8, "size is below 64 bytes");
        ensure!(size.is_multiple_of(4), "size is not a multiple of 4");
        Ok(PointCloud2::of(Vec::new(), 1, data))
    }

    fn of(fields: Vec<PointField>, point_step: u32, data_size: usize) -> PointCloud2 {
        let row_step = u32::try_from(data_size).unwrap_or(u32::MAX);
        PointCloud2 {
            header: Header::now("lidar"),
            height: 1,
            width: row_step / point_step,
            fields,
            is_bigendian: false,
            point_step,
            row_step,
            data: Bytes((0..data_size).map(pattern).collect()),
            is_dense: true,
        }
    }

    pub(crate) fn stamped(&self) -> PointCloud2 {
        PointCloud2 {
            header: Header::now("lidar"),
            ..self.clone()
        }
    }

    /// Returns a copy with the current time as stamp and the application's sequence number in the
    /// first eight bytes of the points.
    pub(crate) fn numbered(&self, sequence: u64) -> PointCloud2 {
        let mut cloud = self.stamped();
        for (byte, number) in cloud.data.0.iter_mut().zip(sequence.to_le_bytes()) {
            *byte = number;
        }
        cloud
    }

    pub(crate) fn sequence(&self) -> Option<u64> {
        Some(u64::from_le_bytes(*self.data.0.first_chunk()?))
    }

    pub(crate) fn serialized_size(&self) -> usize {
        self.data.0.len() + POINT_CLOUD_OVERHEAD
    }
}

/// Returns the byte at an offset of the points. Adjacent bytes differ, and so do fragments. Equals
/// `pattern` in `agent/cli/tests/peers/peer.hpp`.
fn pattern(place: usize) -> u8 {
    let [low, ..] = (place * 7 + (place >> 8) * 13 + (place >> 16)).to_le_bytes();
    low
}

/// `sensor_msgs/PointField`
#[derive(Clone, Serialize, Deserialize)]
struct PointField {
    name: String,
    offset: u32,
    datatype: u8,
    count: u32,
}

/// `sensor_msgs/Imu`
#[derive(Clone, Serialize, Deserialize)]
pub(crate) struct Imu {
    header: Header,
    orientation: [f64; 4],
    orientation_covariance: [f64; 9],
    angular_velocity: [f64; 3],
    angular_velocity_covariance: [f64; 9],
    linear_acceleration: [f64; 3],
    linear_acceleration_covariance: [f64; 9],
}

impl Imu {
    pub(crate) fn now() -> Imu {
        Imu {
            header: Header::now("imu_link"),
            orientation: [0.0, 0.0, 0.0, 1.0],
            orientation_covariance: [0.0; 9],
            angular_velocity: [0.0, 0.0, 0.1],
            angular_velocity_covariance: [0.0; 9],
            linear_acceleration: [0.0, 0.0, 9.81],
            linear_acceleration_covariance: [0.0; 9],
        }
    }
}

/// `sensor_msgs/LaserScan`
#[derive(Clone, Serialize, Deserialize)]
pub(crate) struct LaserScan {
    header: Header,
    angle_min: f32,
    angle_max: f32,
    angle_increment: f32,
    time_increment: f32,
    scan_time: f32,
    range_min: f32,
    range_max: f32,
    ranges: Vec<f32>,
    intensities: Vec<f32>,
}

impl LaserScan {
    pub(crate) fn now(beams: u16) -> LaserScan {
        let turn = std::f32::consts::TAU;
        LaserScan {
            header: Header::now("laser"),
            angle_min: -turn / 2.0,
            angle_max: turn / 2.0,
            angle_increment: turn / f32::from(beams),
            time_increment: 0.0,
            scan_time: 0.1,
            range_min: 0.1,
            range_max: 30.0,
            ranges: vec![2.5; usize::from(beams)],
            intensities: Vec::new(),
        }
    }
}

/// `geometry_msgs/Twist`
#[derive(Clone, Serialize, Deserialize)]
pub(crate) struct Twist {
    linear: [f64; 3],
    angular: [f64; 3],
}

impl Twist {
    pub(crate) fn turning(count: u64) -> Twist {
        let swing = if count % 20 < 10 { 0.2 } else { -0.2 };
        Twist {
            linear: [0.5, 0.0, 0.0],
            angular: [0.0, 0.0, swing],
        }
    }
}

/// Request of `example_interfaces/AddTwoInts`
#[derive(Clone, Serialize, Deserialize)]
pub(crate) struct AddTwoIntsRequest {
    pub(crate) a: i64,
    pub(crate) b: i64,
}

/// Response of `example_interfaces/AddTwoInts`
#[derive(Clone, Serialize, Deserialize)]
pub(crate) struct AddTwoIntsResponse {
    pub(crate) sum: i64,
}

impl Message for AddTwoIntsRequest {}
impl Message for AddTwoIntsResponse {}

/// `uint8[]`, copied as one block: copying a point cloud element by element takes a whole core.
#[derive(Clone)]
struct Bytes(Vec<u8>);

impl Serialize for Bytes {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_bytes(&self.0)
    }
}

impl<'de> Deserialize<'de> for Bytes {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Bytes, D::Error> {
        struct Block;
        impl Visitor<'_> for Block {
            type Value = Bytes;

            fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
                formatter.write_str("a sequence of octets")
            }

            fn visit_bytes<E>(self, block: &[u8]) -> Result<Bytes, E> {
                Ok(Bytes(block.to_vec()))
            }

            fn visit_byte_buf<E>(self, block: Vec<u8>) -> Result<Bytes, E> {
                Ok(Bytes(block))
            }
        }
        deserializer.deserialize_byte_buf(Block)
    }
}
