//! Names of topics, types and nodes. Each kind has its own type, so they cannot be confused.
//!
//! Names are shared text: a snapshot, an event and the model itself use one allocation.
//! [`ros2probe_wire::names`] converts between the DDS and ROS names of a topic.

use std::borrow::Borrow;
use std::fmt;
use std::ops::Deref;
use std::sync::Arc;

use serde::{Serialize, Serializer};

macro_rules! name {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Clone, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub struct $name(Arc<str>);

        impl $name {
            /// Returns the name as text.
            #[must_use]
            pub fn as_str(&self) -> &str {
                &self.0
            }

            /// Returns the name as shared text.
            #[must_use]
            pub fn shared(&self) -> Arc<str> {
                Arc::clone(&self.0)
            }

            /// Returns this name, truncated to at most this many bytes.
            #[must_use]
            pub fn bounded(&self, bytes: usize) -> Self {
                if self.0.len() <= bytes {
                    return self.clone();
                }
                let end = self.0.floor_char_boundary(bytes);
                self.0.get(..end).unwrap_or_default().into()
            }
        }

        impl Deref for $name {
            type Target = str;

            fn deref(&self) -> &str {
                &self.0
            }
        }

        impl AsRef<str> for $name {
            fn as_ref(&self) -> &str {
                &self.0
            }
        }

        impl Borrow<str> for $name {
            fn borrow(&self) -> &str {
                &self.0
            }
        }

        impl From<&str> for $name {
            fn from(text: &str) -> Self {
                Self(text.into())
            }
        }

        impl From<String> for $name {
            fn from(text: String) -> Self {
                Self(text.into())
            }
        }

        impl PartialEq<str> for $name {
            fn eq(&self, other: &str) -> bool {
                *self.0 == *other
            }
        }

        impl PartialEq<&str> for $name {
            fn eq(&self, other: &&str) -> bool {
                *self.0 == **other
            }
        }

        impl PartialEq<String> for $name {
            fn eq(&self, other: &String) -> bool {
                *self.0 == **other
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.pad(&self.0)
            }
        }

        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                fmt::Debug::fmt(&self.0, f)
            }
        }

        impl Serialize for $name {
            fn serialize<S: Serializer>(&self, out: S) -> Result<S::Ok, S::Error> {
                out.serialize_str(&self.0)
            }
        }
    };
}

name!(
    /// A topic as ROS calls it, such as `/points`, or as DDS does where it follows no ROS
    /// convention.
    TopicName
);
name!(
    /// A topic as DDS calls it, such as `rt/points`.
    DdsName
);
name!(
    /// A type as ROS calls it, such as `sensor_msgs/msg/PointCloud2`.
    TypeName
);
name!(
    /// A node with its namespace, such as `/robot1/lidar`.
    NodeName
);

impl TopicName {
    /// Returns the DDS name as the name of a topic without a ROS name.
    #[must_use]
    pub fn of_dds(name: &DdsName) -> Self {
        Self(name.shared())
    }
}
