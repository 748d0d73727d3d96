//! Messages with a small picture on the page, in little-endian CDR.

use crate::robot_diagnostics::{double, number, text};

/// Type of [`image`].
pub const IMAGE: &str = "sensor_msgs::msg::dds_::Image_";
/// Type of [`compressed_image`].
pub const COMPRESSED_IMAGE: &str = "sensor_msgs::msg::dds_::CompressedImage_";
/// Type of [`map`].
pub const MAP: &str = "nav_msgs::msg::dds_::OccupancyGrid_";
/// Type of [`scan`].
pub const SCAN: &str = "sensor_msgs::msg::dds_::LaserScan_";
/// Type of [`odometry`].
pub const ODOMETRY: &str = "nav_msgs::msg::dds_::Odometry_";
/// Type of [`stamped_pose`].
pub const STAMPED_POSE: &str = "geometry_msgs::msg::dds_::PoseStamped_";
/// Type of [`path`].
pub const PATH: &str = "nav_msgs::msg::dds_::Path_";

/// A red pixel as PNG.
const RED_PIXEL: [u8; 69] = [
    137, 80, 78, 71, 13, 10, 26, 10, 0, 0, 0, 13, 73, 72, 68, 82, 0, 0, 0, 1, 0, 0, 0, 1, 8, 2, 0,
    0, 0, 144, 119, 83, 222, 0, 0, 0, 12, 73, 68, 65, 84, 120, 156, 99, 248, 207, 192, 0, 0, 3, 1,
    1, 0, 201, 254, 146, 239, 0, 0, 0, 0, 73, 69, 78, 68, 174, 66, 96, 130,
];

/// Returns the header of a message.
fn header() -> Vec<u8> {
    let mut body = Vec::new();
    number(&mut body, 1);
    number(&mut body, 2);
    text(&mut body, "map");
    body
}

fn floats(body: &mut Vec<u8>, values: &[f32]) {
    for value in values {
        number(body, value.to_bits() as usize);
    }
}

fn bytes(body: &mut Vec<u8>, bytes: &[u8]) {
    number(body, bytes.len());
    body.extend(bytes);
}

fn pose(body: &mut Vec<u8>, x: f64, y: f64) {
    for value in [x, y, 0.0, 0.0, 0.0, 0.0, 1.0] {
        double(body, value);
    }
}

/// Returns a body with its encapsulation header.
fn payload(body: &[u8]) -> Vec<u8> {
    [&[0, 1, 0, 0], body].concat()
}

/// Returns an image of this width and height in one colour: red, green and blue.
#[must_use]
pub fn image(width: usize, height: usize, colour: [u8; 3]) -> Vec<u8> {
    let mut body = header();
    number(&mut body, height);
    number(&mut body, width);
    text(&mut body, "rgb8");
    body.push(0);
    number(&mut body, 3 * width);
    bytes(&mut body, &colour.repeat(width * height));
    payload(&body)
}

/// Returns a compressed image of one red pixel.
#[must_use]
pub fn compressed_image() -> Vec<u8> {
    let mut body = header();
    text(&mut body, "png");
    bytes(&mut body, &RED_PIXEL);
    payload(&body)
}

/// Returns a map with a free, an occupied and an unknown cell.
#[must_use]
pub fn map() -> Vec<u8> {
    let mut body = header();
    number(&mut body, 0);
    number(&mut body, 0);
    floats(&mut body, &[0.05]);
    number(&mut body, 3);
    number(&mut body, 1);
    pose(&mut body, 0.0, 0.0);
    bytes(&mut body, &[0, 100, 255]);
    payload(&body)
}

/// Returns a scan with this number of ranges of two metres.
#[must_use]
pub fn scan(count: u16) -> Vec<u8> {
    let mut body = header();
    let step = 3.0 / f32::from(count);
    floats(&mut body, &[-1.5, 1.5, step, 0.0, 0.1, 0.1, 10.0]);
    number(&mut body, count.into());
    floats(&mut body, &vec![2.0; count.into()]);
    number(&mut body, 0);
    payload(&body)
}

/// Returns a pose with a header.
#[must_use]
pub fn stamped_pose(x: f64, y: f64) -> Vec<u8> {
    let mut body = header();
    pose(&mut body, x, y);
    payload(&body)
}

/// Returns a path through these places.
#[must_use]
pub fn path(places: &[(f64, f64)]) -> Vec<u8> {
    let mut body = header();
    number(&mut body, places.len());
    for (x, y) in places {
        body.extend(header());
        pose(&mut body, *x, *y);
    }
    payload(&body)
}

/// Returns the beginning of an odometry message, without its covariances.
#[must_use]
pub fn odometry(x: f64, y: f64) -> Vec<u8> {
    let mut body = header();
    text(&mut body, "base_link");
    pose(&mut body, x, y);
    payload(&body)
}
