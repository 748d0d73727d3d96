//! Small pictures of large messages: images, maps, scans, point clouds and poses.
//!
//! The layouts are those of the standard packages in all distributions since Foxy, so that no
//! definition is needed. A preview is small however large its message is.

use ros2probe_wire::Endianness;
use ros2probe_wire::cursor::{Cursor, WireError};

/// Length of the encapsulation header (RTPS 2.5, 10.2).
const ENCAPSULATION_BYTES: usize = 4;
/// Maximum width and height of a picture, in pixels.
pub const MAX_SIDE: u32 = 320;
/// Maximum number of points, and of poses.
pub const MAX_POINTS: usize = 4_000;
/// Maximum size of a compressed image, in bytes.
pub const MAX_ENCODED: usize = 512 << 10;

/// A preview.
#[derive(Clone, Debug, PartialEq)]
pub enum Preview {
    /// Pixels of an image or a map.
    Picture(Picture),
    /// An image as its node compressed it.
    Encoded {
        /// Format as the message names it, such as `jpeg`.
        format: String,
        /// The compressed image.
        bytes: Vec<u8>,
    },
    /// Points of a cloud or a scan.
    Points {
        /// Coordinates in metres: x forward, y left, z up.
        points: Vec<[f32; 3]>,
        /// Number of points in the message.
        total: u64,
    },
    /// Poses seen from above.
    Poses(Vec<Pose>),
}

/// Pixels, row by row from the top.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Width and height in the message.
    pub source: [u32; 2],
    /// Red, green and blue of each pixel.
    pub rgb: Vec<u8>,
}

/// A pose on the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Position in metres.
    pub x: f64,
    /// Position in metres.
    pub y: f64,
    /// Rotation about the vertical axis, in radians.
    pub yaw: f64,
}

/// Why a message has no preview.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PreviewError {
    /// The message is malformed.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// The encapsulation is not plain CDR.
    #[error("the message is not in plain CDR")]
    Encapsulation,
    /// The encoding of the image has no preview.
    #[error("images with the encoding `{0}` have no preview")]
    Encoding(String),
    /// The compressed image is too large.
    #[error("the compressed image has {0} bytes, more than {MAX_ENCODED}")]
    TooLarge(usize),
    /// The cloud has no coordinates x and y.
    #[error("the cloud has no fields x and y of type FLOAT32")]
    NoCoordinates,
}

/// How to read a message type.
type Reader = fn(&mut Body<'_>) -> Result<Preview, PreviewError>;

const TYPE_READERS: [(&str, Reader); 9] = [
    ("sensor_msgs/msg/Image", image),
    ("sensor_msgs/msg/CompressedImage", compressed_image),
    ("sensor_msgs/msg/PointCloud2", point_cloud),
    ("sensor_msgs/msg/LaserScan", laser_scan),
    ("nav_msgs/msg/OccupancyGrid", occupancy_grid),
    ("nav_msgs/msg/Odometry", odometry),
    ("nav_msgs/msg/Path", path),
    ("geometry_msgs/msg/PoseStamped", stamped_pose),
    ("geometry_msgs/msg/PoseWithCovarianceStamped", stamped_pose),
];

/// Returns the preview of a payload with its encapsulation header; `None` for a type without one.
/// The type has a ROS name.
///
/// # Errors
///
/// Fails if the message is malformed or unsupported.
pub fn preview(message_type: &str, payload: &[u8]) -> Result<Option<Preview>, PreviewError> {
    let reader = TYPE_READERS.iter().find(|(name, _)| *name == message_type);
    let Some((_, read)) = reader else {
        return Ok(None);
    };
    read(&mut Body::of(payload)?).map(Some)
}

/// The body of a message.
struct Body<'a> {
    cursor: Cursor<'a>,
    /// Alignment of values of eight bytes: 8 in CDR, 4 in CDR2.
    wide: usize,
}

impl<'a> Body<'a> {
    fn of(payload: &'a [u8]) -> Result<Self, PreviewError> {
        let (endianness, wide) = match payload {
            [0, 0, ..] => (Endianness::Big, 8),
            [0, 1, ..] => (Endianness::Little, 8),
            [0, 6, ..] => (Endianness::Big, 4),
            [0, 7, ..] => (Endianness::Little, 4),
            _ => return Err(PreviewError::Encapsulation),
        };
        let body = payload.get(ENCAPSULATION_BYTES..).unwrap_or_default();
        Ok(Self {
            cursor: Cursor::new(body, endianness),
            wide,
        })
    }

    fn u8(&mut self) -> Result<u8, WireError> {
        self.cursor.u8("a byte of the message")
    }

    fn u32(&mut self) -> Result<u32, WireError> {
        self.cursor.align(4);
        self.cursor.u32("a number of the message")
    }

    fn f32(&mut self) -> Result<f32, WireError> {
        self.u32().map(f32::from_bits)
    }

    fn f64(&mut self) -> Result<f64, WireError> {
        self.cursor.align(self.wide);
        self.cursor
            .u64("a number of the message")
            .map(f64::from_bits)
    }

    /// Reads bytes after their number.
    fn bytes(&mut self) -> Result<&'a [u8], WireError> {
        let length = self.u32()? as usize;
        self.cursor.take("an array of the message", length)
    }

    fn text(&mut self) -> Result<String, WireError> {
        let bytes = self.bytes()?;
        let bytes = bytes.strip_suffix(&[0]).unwrap_or(bytes);
        Ok(String::from_utf8_lossy(bytes).into_owned())
    }

    /// Skips the time stamp and the name of the frame.
    fn header(&mut self) -> Result<(), WireError> {
        self.u32()?;
        self.u32()?;
        self.bytes()?;
        Ok(())
    }

    fn pose(&mut self) -> Result<Pose, WireError> {
        let [x, y, _] = [self.f64()?, self.f64()?, self.f64()?];
        let [i, j, k, w] = [self.f64()?, self.f64()?, self.f64()?, self.f64()?];
        let yaw = (2.0 * (w * k + i * j)).atan2(1.0 - 2.0 * (j * j + k * k));
        Ok(Pose { x, y, yaw })
    }
}

/// Where the pixel of an encoding is, and what it means.
#[derive(Clone, Copy)]
enum Pixel {
    /// Bytes of a pixel, and the places of red, green and blue.
    Colour(usize, [usize; 3]),
    /// Bytes of a pixel; the first one is its brightness.
    Grey(usize),
    /// Numbers of 16 bits, from the least to the highest.
    Depth16,
    /// Numbers of single precision, from the least to the highest.
    Depth32,
}

impl Pixel {
    fn of(encoding: &str) -> Option<Self> {
        Some(match encoding {
            "rgb8" => Self::Colour(3, [0, 1, 2]),
            "bgr8" | "8UC3" => Self::Colour(3, [2, 1, 0]),
            "rgba8" => Self::Colour(4, [0, 1, 2]),
            "bgra8" | "8UC4" => Self::Colour(4, [2, 1, 0]),
            "mono8" | "8UC1" => Self::Grey(1),
            "yuv422_yuy2" => Self::Grey(2),
            "mono16" | "16UC1" => Self::Depth16,
            "32FC1" => Self::Depth32,
            _ if encoding.starts_with("bayer_") && encoding.ends_with('8') => Self::Grey(1),
            _ => return None,
        })
    }
}

fn image(body: &mut Body<'_>) -> Result<Preview, PreviewError> {
    body.header()?;
    let (height, width) = (body.u32()?, body.u32()?);
    let encoding = body.text()?;
    let is_big = body.u8()? != 0;
    let step = body.u32()? as usize;
    let data = body.bytes()?;
    let pixel = Pixel::of(&encoding).ok_or(PreviewError::Encoding(encoding))?;
    let row = |y: u32| data.get(step.saturating_mul(y as usize)..);
    let at = |x: u32, y: u32, size: usize| {
        let begin = size.saturating_mul(x as usize);
        row(y)?.get(begin..begin.checked_add(size)?)
    };
    let number = |x: u32, y: u32| match pixel {
        Pixel::Depth16 => {
            let bytes: [u8; 2] = at(x, y, 2)?.try_into().ok()?;
            Some(f32::from(if is_big {
                u16::from_be_bytes(bytes)
            } else {
                u16::from_le_bytes(bytes)
            }))
        }
        _ => {
            let bytes: [u8; 4] = at(x, y, 4)?.try_into().ok()?;
            let bits = if is_big {
                u32::from_be_bytes(bytes)
            } else {
                u32::from_le_bytes(bytes)
            };
            Some(f32::from_bits(bits)).filter(|value| value.is_finite())
        }
    };
    Ok(Preview::Picture(match pixel {
        Pixel::Colour(size, places) => scaled([width, height], |x, y| {
            let bytes = at(x, y, size)?;
            let [red, green, blue] = places.map(|place| bytes.get(place).copied());
            Some([red?, green?, blue?])
        }),
        Pixel::Grey(size) => scaled([width, height], |x, y| {
            at(x, y, size)?.first().map(|grey| [*grey; 3])
        }),
        Pixel::Depth16 | Pixel::Depth32 => {
            let (mut least, mut most) = (f32::INFINITY, f32::NEG_INFINITY);
            // Only the shown pixels count.
            let _ = scaled([width, height], |x, y| {
                let value = number(x, y).filter(|value| *value != 0.0)?;
                (least, most) = (least.min(value), most.max(value));
                None
            });
            let span = (most - least).max(f32::MIN_POSITIVE);
            scaled([width, height], |x, y| {
                let part = (number(x, y)? - least) / span;
                Some([(part.clamp(0.0, 1.0) * 255.0) as u8; 3])
            })
        }
    }))
}

/// Returns a picture that has at most [`MAX_SIDE`] pixels on each side. Missing pixels are black.
fn scaled(source: [u32; 2], mut pixel: impl FnMut(u32, u32) -> Option<[u8; 3]>) -> Picture {
    let [wide, high] = source;
    let longest = wide.max(high).max(1);
    let part = |side: u32| {
        let shown = u64::from(side) * u64::from(longest.min(MAX_SIDE)) / u64::from(longest);
        shown.clamp(u64::from(side.min(1)), u64::from(MAX_SIDE)) as u32
    };
    let (width, height) = (part(wide), part(high));
    let place = |at: u32, shown: u32, side: u32| {
        (u64::from(at) * u64::from(side) / u64::from(shown.max(1))) as u32
    };
    let mut rgb = Vec::with_capacity((width * height * 3) as usize);
    for y in 0..height {
        for x in 0..width {
            let colour = pixel(place(x, width, wide), place(y, height, high));
            rgb.extend_from_slice(&colour.unwrap_or_default());
        }
    }
    Picture {
        width,
        height,
        source,
        rgb,
    }
}

fn compressed_image(body: &mut Body<'_>) -> Result<Preview, PreviewError> {
    body.header()?;
    let format = body.text()?;
    let bytes = body.bytes()?;
    if bytes.len() > MAX_ENCODED {
        return Err(PreviewError::TooLarge(bytes.len()));
    }
    let bytes = bytes.to_vec();
    Ok(Preview::Encoded { format, bytes })
}

fn point_cloud(body: &mut Body<'_>) -> Result<Preview, PreviewError> {
    /// `FLOAT32` in sensor_msgs/msg/PointField.
    const FLOAT32: u8 = 7;
    body.header()?;
    let total = u64::from(body.u32()?) * u64::from(body.u32()?);
    let mut places = [None; 3];
    for _ in 0..body.u32()? {
        let name = body.text()?;
        let offset = body.u32()? as usize;
        let kind = body.u8()?;
        body.u32()?;
        let axis = ["x", "y", "z"].iter().position(|axis| *axis == name);
        if let Some(place) = axis.and_then(|axis| places.get_mut(axis)) {
            *place = (kind == FLOAT32).then_some(offset);
        }
    }
    let is_big = body.u8()? != 0;
    let step = body.u32()? as usize;
    body.u32()?;
    let data = body.bytes()?;
    let [Some(x), Some(y), z] = places else {
        return Err(PreviewError::NoCoordinates);
    };
    let stride = usize::try_from(total)
        .unwrap_or(usize::MAX)
        .div_ceil(MAX_POINTS);
    let chunks = data.chunks_exact(step.max(1));
    let points = chunks.step_by(stride.max(1)).filter_map(|point| {
        let number = |place: usize| {
            let bytes = *point.get(place..)?.first_chunk::<4>()?;
            let value = if is_big {
                f32::from_be_bytes(bytes)
            } else {
                f32::from_le_bytes(bytes)
            };
            Some(value).filter(|value| value.is_finite())
        };
        Some([number(x)?, number(y)?, z.map_or(Some(0.0), number)?])
    });
    let points = points.take(MAX_POINTS).collect();
    Ok(Preview::Points { points, total })
}

fn laser_scan(body: &mut Body<'_>) -> Result<Preview, PreviewError> {
    body.header()?;
    let (begin, _, step) = (body.f32()?, body.f32()?, body.f32()?);
    let (_, _, least, most) = (body.f32()?, body.f32()?, body.f32()?, body.f32()?);
    let total = body.u32()?;
    let stride = total.div_ceil(MAX_POINTS as u32).max(1);
    let mut points = Vec::new();
    for number in 0..total {
        let range = body.f32()?;
        if number % stride == 0 && range.is_finite() && (least..=most).contains(&range) {
            let angle = begin + step * number as f32;
            points.push([range * angle.cos(), range * angle.sin(), 0.0]);
        }
    }
    let total = total.into();
    Ok(Preview::Points { points, total })
}

fn occupancy_grid(body: &mut Body<'_>) -> Result<Preview, PreviewError> {
    /// Colour of a cell of which nothing is known.
    const UNKNOWN_COLOUR: [u8; 3] = [150, 170, 180];
    body.header()?;
    body.u32()?;
    body.u32()?;
    body.f32()?;
    let (width, height) = (body.u32()?, body.u32()?);
    body.pose()?;
    let data = body.bytes()?;
    // The first row of the message is the lowest one.
    let picture = scaled([width, height], |x, y| {
        let row = (height - 1 - y) as usize;
        let cell = data.get(row.checked_mul(width as usize)?.checked_add(x as usize)?)?;
        let occupied = cell.cast_signed();
        Some(match u8::try_from(occupied) {
            Ok(percent) => [255 - (u16::from(percent.min(100)) * 255 / 100) as u8; 3],
            Err(_) => UNKNOWN_COLOUR,
        })
    });
    Ok(Preview::Picture(picture))
}

fn odometry(body: &mut Body<'_>) -> Result<Preview, PreviewError> {
    body.header()?;
    body.bytes()?;
    Ok(Preview::Poses(vec![body.pose()?]))
}

fn stamped_pose(body: &mut Body<'_>) -> Result<Preview, PreviewError> {
    body.header()?;
    Ok(Preview::Poses(vec![body.pose()?]))
}

fn path(body: &mut Body<'_>) -> Result<Preview, PreviewError> {
    body.header()?;
    let total = body.u32()?;
    let stride = total.div_ceil(MAX_POINTS as u32).max(1);
    let mut poses = Vec::new();
    for number in 0..total {
        body.header()?;
        let pose = body.pose()?;
        if number % stride == 0 {
            poses.push(pose);
        }
    }
    Ok(Preview::Poses(poses))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Writes little-endian CDR.
    struct Written(Vec<u8>);

    impl Written {
        fn new() -> Self {
            let mut own = Self(Vec::new());
            own.u32(1).u32(2).text("map");
            own
        }

        fn align(&mut self, to: usize) -> &mut Self {
            while !self.0.len().is_multiple_of(to) {
                self.0.push(0);
            }
            self
        }

        fn u8(&mut self, value: u8) -> &mut Self {
            self.0.push(value);
            self
        }

        fn u32(&mut self, value: u32) -> &mut Self {
            self.align(4).0.extend(value.to_le_bytes());
            self
        }

        fn f32(&mut self, value: f32) -> &mut Self {
            self.u32(value.to_bits())
        }

        fn f64(&mut self, value: f64) -> &mut Self {
            self.align(8).0.extend(value.to_le_bytes());
            self
        }

        fn bytes(&mut self, bytes: &[u8]) -> &mut Self {
            self.u32(bytes.len() as u32).0.extend(bytes);
            self
        }

        fn text(&mut self, text: &str) -> &mut Self {
            self.bytes(format!("{text}\0").as_bytes())
        }

        fn pose(&mut self, x: f64, y: f64, yaw: f64) -> &mut Self {
            self.f64(x).f64(y).f64(0.0).f64(0.0).f64(0.0);
            self.f64((yaw / 2.0).sin()).f64((yaw / 2.0).cos())
        }

        fn preview(&self, message_type: &str) -> Result<Preview, PreviewError> {
            let payload = [&[0, 1, 0, 0], &self.0[..]].concat();
            Ok(preview(message_type, &payload)?.unwrap())
        }
    }

    fn picture(preview: Preview) -> Picture {
        match preview {
            Preview::Picture(picture) => picture,
            other => panic!("{other:?}"),
        }
    }

    fn image_of(
        encoding: &str,
        size: [u32; 2],
        step: u32,
        data: &[u8],
    ) -> Result<Picture, PreviewError> {
        let mut message = Written::new();
        message
            .u32(size[1])
            .u32(size[0])
            .text(encoding)
            .u8(0)
            .u32(step)
            .bytes(data);
        message.preview("sensor_msgs/msg/Image").map(picture)
    }

    #[test]
    fn an_image_becomes_red_green_and_blue() {
        let two = [2, 1];
        assert_eq!(
            image_of("rgb8", two, 6, &[1, 2, 3, 4, 5, 6]).unwrap().rgb,
            [1, 2, 3, 4, 5, 6]
        );
        assert_eq!(
            image_of("bgr8", two, 6, &[1, 2, 3, 4, 5, 6]).unwrap().rgb,
            [3, 2, 1, 6, 5, 4]
        );
        assert_eq!(
            image_of("bgra8", [1, 1], 4, &[1, 2, 3, 9]).unwrap().rgb,
            [3, 2, 1]
        );
        assert_eq!(
            image_of("mono8", two, 2, &[7, 8]).unwrap().rgb,
            [7, 7, 7, 8, 8, 8]
        );
        // The bytes after the pixels of a row are padding.
        assert_eq!(
            image_of("mono8", [1, 2], 3, &[7, 0, 0, 8, 0, 0])
                .unwrap()
                .rgb,
            [7, 7, 7, 8, 8, 8]
        );
        let depth = image_of("16UC1", two, 4, &[0x10, 0x27, 0x20, 0x4e]).unwrap();
        assert_eq!(depth.rgb, [0, 0, 0, 255, 255, 255]);
        let metres = [1.0_f32, f32::NAN].map(f32::to_le_bytes).concat();
        assert_eq!(
            image_of("32FC1", two, 8, &metres).unwrap().rgb[3..],
            [0, 0, 0]
        );
        let unknown = image_of("jpeg2000", two, 2, &[]);
        assert_eq!(unknown, Err(PreviewError::Encoding("jpeg2000".into())));
    }

    #[test]
    fn a_large_image_has_a_small_preview() {
        let data: Vec<u8> = (0..640 * 480).map(|at| (at % 640 / 4) as u8).collect();
        let small = image_of("mono8", [640, 480], 640, &data).unwrap();
        assert_eq!(
            (small.width, small.height, small.source),
            (320, 240, [640, 480])
        );
        assert_eq!((small.rgb[0], small.rgb[319 * 3]), (0, 159));
        // Announced sizes without the bytes for them cost nothing.
        let empty = image_of("rgb8", [u32::MAX, 2], 0, &[]).unwrap();
        assert_eq!((empty.width, empty.height), (320, 1));
        assert_eq!(image_of("rgb8", [0, 0], 0, &[]).unwrap().rgb.len(), 0);
    }

    #[test]
    fn a_map_is_drawn_from_its_top_with_unknown_cells() {
        let mut map = Written::new();
        map.u32(0)
            .u32(0)
            .f32(0.05)
            .u32(1)
            .u32(3)
            .pose(0.0, 0.0, 0.0)
            .bytes(&[0, 100, 255]);
        let map = picture(map.preview("nav_msgs/msg/OccupancyGrid").unwrap());
        assert_eq!(map.rgb, [150, 170, 180, 0, 0, 0, 255, 255, 255]);
    }

    #[test]
    fn scans_and_clouds_become_points() {
        let mut scan = Written::new();
        scan.f32(0.0)
            .f32(1.6)
            .f32(std::f32::consts::FRAC_PI_2)
            .f32(0.0)
            .f32(0.0)
            .f32(0.1)
            .f32(9.0);
        scan.u32(3).f32(2.0).f32(3.0).f32(f32::INFINITY).u32(0);
        let Preview::Points { points, total } = scan.preview("sensor_msgs/msg/LaserScan").unwrap()
        else {
            panic!("no points");
        };
        assert_eq!((points.len(), total, points[0]), (2, 3, [2.0, 0.0, 0.0]));
        assert!(points[1][0].abs() < 1e-6 && points[1][1] == 3.0);

        let cloud = |count: u32, fields: &[(&str, u32)]| {
            let mut cloud = Written::new();
            cloud.u32(1).u32(count).u32(fields.len() as u32);
            for (name, offset) in fields {
                cloud.text(name).u32(*offset).u8(7).u32(1);
            }
            let data: Vec<u8> = (0..count)
                .flat_map(|at| [at as f32, 1.0, 2.0, 9.0].map(f32::to_le_bytes).concat())
                .collect();
            cloud.u8(0).u32(16).u32(16 * count).bytes(&data).u8(1);
            cloud.preview("sensor_msgs/msg/PointCloud2")
        };
        let axes = [("x", 0), ("intensity", 12), ("y", 4), ("z", 8)];
        let Preview::Points { points, total } = cloud(10_000, &axes).unwrap() else {
            panic!("no points");
        };
        assert_eq!((total, points[1]), (10_000, [3.0, 1.0, 2.0]));
        assert!(
            points.len() <= MAX_POINTS && points.len() > MAX_POINTS / 2,
            "{}",
            points.len()
        );
        assert_eq!(cloud(1, &axes[..2]), Err(PreviewError::NoCoordinates));
    }

    #[test]
    fn poses_are_seen_from_above() {
        let mut odometry = Written::new();
        odometry.text("base_link").pose(1.0, 2.0, 0.5);
        let Preview::Poses(poses) = odometry.preview("nav_msgs/msg/Odometry").unwrap() else {
            panic!("no poses");
        };
        assert_eq!((poses[0].x, poses[0].y), (1.0, 2.0));
        assert!((poses[0].yaw - 0.5).abs() < 1e-9);
        let mut path = Written::new();
        path.u32(2);
        for at in 0..2 {
            path.u32(1).u32(2).text("map").pose(at.into(), 0.0, 0.0);
        }
        let Preview::Poses(poses) = path.preview("nav_msgs/msg/Path").unwrap() else {
            panic!("no poses");
        };
        assert_eq!(
            poses[1],
            Pose {
                x: 1.0,
                y: 0.0,
                yaw: 0.0
            }
        );
    }

    #[test]
    fn a_compressed_image_is_passed_on_up_to_a_size() {
        let of = |length: usize| {
            let mut message = Written::new();
            message.text("jpeg").bytes(&vec![1; length]);
            message.preview("sensor_msgs/msg/CompressedImage")
        };
        let bytes = vec![1; 3];
        assert_eq!(
            of(3).unwrap(),
            Preview::Encoded {
                format: "jpeg".into(),
                bytes
            }
        );
        assert_eq!(
            of(MAX_ENCODED + 1),
            Err(PreviewError::TooLarge(MAX_ENCODED + 1))
        );
        assert_eq!(preview("std_msgs/msg/String", &[0, 1, 0, 0]), Ok(None));
    }

    proptest! {
        #[test]
        fn no_payload_makes_a_preview_large_or_panics(
            (message_type, _) in proptest::sample::select(TYPE_READERS.to_vec()), payload: Vec<u8>,
            kind in 0_u8..8,
        ) {
            let payload = [&[0, kind, 0, 0], &payload[..]].concat();
            match preview(message_type, &payload) {
                Ok(Some(Preview::Picture(picture))) => {
                    prop_assert!(picture.width <= MAX_SIDE && picture.height <= MAX_SIDE);
                }
                Ok(Some(Preview::Points { points, .. })) => prop_assert!(points.len() <= MAX_POINTS),
                Ok(Some(Preview::Poses(poses))) => prop_assert!(poses.len() <= MAX_POINTS),
                _ => {}
            }
        }
    }
}
