//! Quality of service of endpoints, as discovery announces it.
//!
//! An absent policy has a default that depends on the role (DDS 1.4, 2.2.3), so one table for both
//! roles would be wrong. A policy that an implementation never announces is unknown and has no
//! default.

use alloc::boxed::Box;
use alloc::vec::Vec;
use core::fmt;
use core::time::Duration;

use crate::cursor::{Cursor, Reason, WireError};
use crate::parameters::ParameterId;
use crate::rtps::VendorId;
use crate::text;
use crate::time::RtpsDuration;

/// The side of an endpoint.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Role {
    /// Publishes.
    Writer,
    /// Subscribes.
    Reader,
}

/// Defines the kind of a policy with the ROS names of its values. An unknown value keeps its
/// number.
macro_rules! kind {
    ($(#[$doc:meta])* $name:ident { $($constant:ident = $value:literal),+ $(,)? }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
        pub struct $name(pub u32);

        #[expect(missing_docs, reason = "the names are those of DDS and of ROS")]
        impl $name {
            $(pub const $constant: Self = Self($value);)+

            /// Returns the ROS name of the value; `None` for a value that ROS does not know.
            #[must_use]
            pub const fn name(self) -> Option<&'static str> {
                match self {
                    $(Self::$constant => Some(stringify!($constant)),)+
                    _ => None,
                }
            }

            /// Returns the ROS name of the value, or `UNKNOWN`.
            #[must_use]
            pub const fn label(self) -> &'static str {
                match self.name() {
                    Some(name) => name,
                    None => "UNKNOWN",
                }
            }
        }

        /// Formats the ROS name of the value, or `UNKNOWN`.
        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.pad(self.label())
            }
        }
    };
}

kind!(
    /// Whether lost samples are sent again. Unlike those of other policies, the wire values count
    /// from 1 (RTPS 2.5, 9.4.2.11.2; Fast DDS and Cyclone DDS agree).
    Reliability { BEST_EFFORT = 1, RELIABLE = 2 }
);
kind!(
    /// How long a writer keeps samples for late joiners.
    Durability { VOLATILE = 0, TRANSIENT_LOCAL = 1, TRANSIENT = 2, PERSISTENT = 3 }
);
kind!(
    /// How a writer's liveliness is asserted.
    Liveliness { AUTOMATIC = 0, MANUAL_BY_PARTICIPANT = 1, MANUAL_BY_TOPIC = 2 }
);
kind!(
    /// Whether several writers may update one instance.
    Ownership { SHARED = 0, EXCLUSIVE = 1 }
);
kind!(
    /// The clock that orders samples of several writers.
    DestinationOrder { BY_RECEPTION_TIMESTAMP = 0, BY_SOURCE_TIMESTAMP = 1 }
);
kind!(
    /// Scope in which changes are presented together, narrowest first.
    AccessScope { INSTANCE = 0, TOPIC = 1, GROUP = 2 }
);
kind!(
    /// Whether all samples are kept, or only the last ones.
    HistoryKind { KEEP_LAST = 0, KEEP_ALL = 1 }
);

/// History policy.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct History {
    /// Whether all samples are kept, or only the last ones.
    pub kind: HistoryKind,
    /// Number of samples, for [`HistoryKind::KEEP_LAST`].
    pub depth: i32,
}

/// Formats as ROS does: `KEEP_LAST (10)`, `KEEP_ALL`.
impl fmt::Display for History {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.kind {
            HistoryKind::KEEP_LAST => write!(f, "{} ({})", self.kind, self.depth),
            kind => write!(f, "{kind}"),
        }
    }
}

/// How changes to several instances are presented together.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct Presentation {
    /// Scope in which changes belong together.
    pub access_scope: AccessScope,
    /// Whether a coherent set is presented whole or not at all.
    pub is_coherent: bool,
    /// Whether changes are presented in the order of writing.
    pub is_ordered: bool,
}

/// Encoding of samples (XTypes 1.3, 7.6.3.1.1).
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct DataRepresentation(pub i16);

#[expect(missing_docs, reason = "the names are those of XTypes")]
impl DataRepresentation {
    pub const XCDR1: Self = Self(0);
    pub const XML: Self = Self(1);
    pub const XCDR2: Self = Self(2);
}

/// PID_OWNERSHIP_STRENGTH (RTPS 2.5, table 9.14).
const OWNERSHIP_STRENGTH: ParameterId = ParameterId(0x0006);
/// Maximum number of representations kept per endpoint; three are defined.
const MAX_REPRESENTATIONS: u32 = 8;
/// Maximum number of partitions per endpoint; ROS 2 uses none.
const MAX_PARTITIONS: usize = 16;
/// Maximum length of a partition name, in bytes.
const MAX_PARTITION_LEN: usize = 256;

/// The policies that an endpoint offers or requests.
#[derive(Clone, PartialEq, Eq, Hash, Debug)]
pub struct Qos {
    /// Reliability.
    pub reliability: Reliability,
    /// Durability.
    pub durability: Durability,
    /// History; `None` if the implementation does not announce it (Fast DDS before 3.2).
    pub history: Option<History>,
    /// Maximum time between two samples.
    pub deadline: RtpsDuration,
    /// Age at which samples expire; writers only.
    pub lifespan: RtpsDuration,
    /// Liveliness.
    pub liveliness: Liveliness,
    /// Maximum time between two assertions of liveliness.
    pub liveliness_lease: RtpsDuration,
    /// Ownership.
    pub ownership: Ownership,
    /// Strength of a writer with exclusive ownership: readers accept the samples of the strongest.
    pub ownership_strength: i32,
    /// Minimum time between two samples that a reader accepts.
    pub minimum_separation: RtpsDuration,
    /// Delay that the implementation may add to save work.
    pub latency_budget: RtpsDuration,
    /// Order of samples of several writers.
    pub destination_order: DestinationOrder,
    /// Presentation of coherent sets.
    pub presentation: Presentation,
    /// Data representations: a writer uses the first one, a reader accepts any of them; empty means
    /// XCDR1.
    pub representations: Vec<DataRepresentation>,
    /// Partitions; empty means the default partition.
    pub partitions: Vec<Box<str>>,
}

impl Qos {
    /// Returns the defaults of all policies for a role and vendor.
    #[must_use]
    pub const fn defaults(role: Role, vendor: VendorId) -> Self {
        Self {
            reliability: match role {
                Role::Writer => Reliability::RELIABLE,
                Role::Reader => Reliability::BEST_EFFORT,
            },
            durability: Durability::VOLATILE,
            // The specification's discovery data does not contain the history. Cyclone DDS
            // announces it if it differs from KEEP_LAST 1. Fast DDS 2.x never announces it, and
            // `ros2` shows it as unknown. So it does for KEEP_LAST 1 of 3.2.3 and later, which
            // announces any other history.
            history: match vendor {
                VendorId::CYCLONE => Some(History {
                    kind: HistoryKind::KEEP_LAST,
                    depth: 1,
                }),
                _ => None,
            },
            deadline: RtpsDuration::Infinite,
            lifespan: RtpsDuration::Infinite,
            liveliness: Liveliness::AUTOMATIC,
            liveliness_lease: RtpsDuration::Infinite,
            ownership: Ownership::SHARED,
            ownership_strength: 0,
            minimum_separation: RtpsDuration::Finite(Duration::ZERO),
            latency_budget: RtpsDuration::Finite(Duration::ZERO),
            destination_order: DestinationOrder::BY_RECEPTION_TIMESTAMP,
            presentation: Presentation {
                access_scope: AccessScope::INSTANCE,
                is_coherent: false,
                is_ordered: false,
            },
            representations: Vec::new(),
            partitions: Vec::new(),
        }
    }

    /// Applies one parameter; returns `false` if it is not a QoS policy kept here.
    pub(crate) fn apply(
        &mut self,
        id: ParameterId,
        mut value: Cursor<'_>,
    ) -> Result<bool, WireError> {
        match id {
            ParameterId::RELIABILITY => {
                // Old versions of the specification encoded RELIABLE as 3.
                self.reliability = match value.u32("PID_RELIABILITY")? {
                    3 => Reliability::RELIABLE,
                    kind => Reliability(kind),
                };
            }
            ParameterId::DURABILITY => self.durability = Durability(value.u32("PID_DURABILITY")?),
            ParameterId::HISTORY => {
                self.history = Some(History {
                    kind: HistoryKind(value.u32("PID_HISTORY")?),
                    depth: value.i32("PID_HISTORY")?,
                });
            }
            ParameterId::DEADLINE => self.deadline = duration(&mut value, "PID_DEADLINE")?,
            ParameterId::LIFESPAN => self.lifespan = duration(&mut value, "PID_LIFESPAN")?,
            ParameterId::LIVELINESS => {
                self.liveliness = Liveliness(value.u32("PID_LIVELINESS")?);
                self.liveliness_lease = duration(&mut value, "PID_LIVELINESS")?;
            }
            ParameterId::OWNERSHIP => self.ownership = Ownership(value.u32("PID_OWNERSHIP")?),
            OWNERSHIP_STRENGTH => self.ownership_strength = value.i32("PID_OWNERSHIP_STRENGTH")?,
            ParameterId::TIME_BASED_FILTER => {
                self.minimum_separation = duration(&mut value, "PID_TIME_BASED_FILTER")?;
            }
            ParameterId::LATENCY_BUDGET => {
                self.latency_budget = duration(&mut value, "PID_LATENCY_BUDGET")?;
            }
            ParameterId::DESTINATION_ORDER => {
                self.destination_order = DestinationOrder(value.u32("PID_DESTINATION_ORDER")?);
            }
            ParameterId::PRESENTATION => {
                self.presentation = Presentation {
                    access_scope: AccessScope(value.u32("PID_PRESENTATION")?),
                    is_coherent: value.u8("PID_PRESENTATION")? != 0,
                    is_ordered: value.u8("PID_PRESENTATION")? != 0,
                };
            }
            ParameterId::DATA_REPRESENTATION => {
                self.representations = representations(&mut value)?;
            }
            ParameterId::PARTITION => self.partitions = partitions(&mut value)?,
            _ => return Ok(false),
        }
        Ok(true)
    }
}

/// Reads a duration: seconds and a fraction of 2^-32 seconds.
pub(crate) fn duration(
    value: &mut Cursor<'_>,
    what: &'static str,
) -> Result<RtpsDuration, WireError> {
    let seconds = value.i32(what)?;
    Ok(RtpsDuration::from_wire(seconds, value.u32(what)?))
}

fn partitions(value: &mut Cursor<'_>) -> Result<Vec<Box<str>>, WireError> {
    let start = *value;
    let count = value.u32("PID_PARTITION")?;
    let mut partitions = Vec::new();
    for _ in 0..count {
        if partitions.len() == MAX_PARTITIONS {
            return Err(start.error("PID_PARTITION", Reason::OverLimit));
        }
        partitions.push(text::name(value, "PID_PARTITION", MAX_PARTITION_LEN)?.into());
    }
    Ok(partitions)
}

/// Reads the first representations; those beyond the limit are redundant.
fn representations(value: &mut Cursor<'_>) -> Result<Vec<DataRepresentation>, WireError> {
    let count = value.u32("PID_DATA_REPRESENTATION")?;
    let mut representations = Vec::new();
    for _ in 0..count.min(MAX_REPRESENTATIONS) {
        let kind = value.u16("PID_DATA_REPRESENTATION")?.cast_signed();
        representations.push(DataRepresentation(kind));
    }
    Ok(representations)
}

#[cfg(test)]
mod tests {
    use std::string::ToString;

    use super::*;
    use crate::cursor::Endianness;

    fn apply(qos: &mut Qos, id: ParameterId, value: &[u8]) -> Result<bool, WireError> {
        qos.apply(id, Cursor::new(value, Endianness::Little))
    }

    #[test]
    fn defaults_differ_by_role_and_by_vendor() {
        let writer = Qos::defaults(Role::Writer, VendorId::CYCLONE);
        let reader = Qos::defaults(Role::Reader, VendorId::CYCLONE);
        assert_eq!(writer.reliability, Reliability::RELIABLE);
        assert_eq!(reader.reliability, Reliability::BEST_EFFORT);
        assert_eq!(writer.history.unwrap().depth, 1);
        assert_eq!(
            Qos::defaults(Role::Writer, VendorId::EPROSIMA).history,
            None
        );
    }

    #[test]
    fn unknown_values_are_kept_and_shown_as_unknown() {
        let mut qos = Qos::defaults(Role::Reader, VendorId::EPROSIMA);
        assert_eq!(
            apply(&mut qos, ParameterId::DURABILITY, &[9, 0, 0, 0]),
            Ok(true)
        );
        assert_eq!(
            (qos.durability, qos.durability.to_string()),
            (Durability(9), "UNKNOWN".into())
        );
        assert_eq!(Liveliness::MANUAL_BY_TOPIC.to_string(), "MANUAL_BY_TOPIC");
    }

    #[test]
    fn the_lease_of_liveliness_is_read_after_the_kind() {
        let mut qos = Qos::defaults(Role::Reader, VendorId::EPROSIMA);
        let value = [2, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0x80];
        apply(&mut qos, ParameterId::LIVELINESS, &value).unwrap();
        assert_eq!(qos.liveliness, Liveliness::MANUAL_BY_TOPIC);
        assert_eq!(
            qos.liveliness_lease,
            RtpsDuration::Finite(Duration::from_millis(1500))
        );
    }

    #[test]
    fn the_strength_of_exclusive_ownership_is_read_with_its_sign() {
        let mut qos = Qos::defaults(Role::Writer, VendorId::CYCLONE);
        apply(&mut qos, ParameterId::OWNERSHIP, &[1, 0, 0, 0]).unwrap();
        assert_eq!(
            (qos.ownership, qos.ownership_strength),
            (Ownership::EXCLUSIVE, 0)
        );
        for (value, strength) in [([8_u8, 0, 0, 0], 8), ([0xfe, 0xff, 0xff, 0xff], -2)] {
            assert_eq!(apply(&mut qos, OWNERSHIP_STRENGTH, &value), Ok(true));
            assert_eq!(qos.ownership_strength, strength);
        }
        assert!(apply(&mut qos, OWNERSHIP_STRENGTH, &[8, 0]).is_err());
    }

    #[test]
    fn presentation_destination_order_and_latency_budget_are_read() {
        let mut qos = Qos::defaults(Role::Writer, VendorId::CYCLONE);
        apply(
            &mut qos,
            ParameterId::PRESENTATION,
            &[1, 0, 0, 0, 0, 1, 0, 0],
        )
        .unwrap();
        let Presentation {
            access_scope,
            is_coherent,
            is_ordered,
        } = qos.presentation;
        assert_eq!(access_scope, AccessScope::TOPIC);
        assert_eq!((is_coherent, is_ordered), (false, true));
        apply(&mut qos, ParameterId::DESTINATION_ORDER, &[1, 0, 0, 0]).unwrap();
        assert_eq!(qos.destination_order, DestinationOrder::BY_SOURCE_TIMESTAMP);
        apply(
            &mut qos,
            ParameterId::LATENCY_BUDGET,
            &[1, 0, 0, 0, 0, 0, 0, 0],
        )
        .unwrap();
        assert_eq!(
            qos.latency_budget,
            RtpsDuration::Finite(Duration::from_secs(1))
        );
    }

    #[test]
    fn a_long_list_of_representations_is_cut() {
        let mut qos = Qos::defaults(Role::Reader, VendorId::CYCLONE);
        let value = [2, 0, 0, 0, 2, 0, 0, 0];
        apply(&mut qos, ParameterId::DATA_REPRESENTATION, &value).unwrap();
        assert_eq!(
            qos.representations,
            [DataRepresentation::XCDR2, DataRepresentation::XCDR1]
        );
        let mut many = [0xff; 4 + 2 * 20];
        apply(&mut qos, ParameterId::DATA_REPRESENTATION, &many).unwrap();
        assert_eq!(qos.representations, [DataRepresentation(-1); 8]);
        many[..4].copy_from_slice(&[3, 0, 0, 0]);
        assert!(apply(&mut qos, ParameterId::DATA_REPRESENTATION, &many[..8]).is_err());
    }

    #[test]
    fn a_list_of_too_many_partitions_is_refused() {
        let mut qos = Qos::defaults(Role::Reader, VendorId::EPROSIMA);
        let value = *b"\x02\0\0\0\x02\0\0\0a\0\0\0\x03\0\0\0bc\0\0";
        apply(&mut qos, ParameterId::PARTITION, &value).unwrap();
        assert_eq!(qos.partitions, ["a".into(), "bc".into()]);
        let mut many = [0; 4 + 4 * 40];
        many[0] = 40;
        assert_eq!(
            apply(&mut qos, ParameterId::PARTITION, &many).map_err(|error| error.reason),
            Err(Reason::OverLimit)
        );
        many[..4].copy_from_slice(&[0xff; 4]);
        assert!(apply(&mut qos, ParameterId::PARTITION, &many[..20]).is_err());
    }
}
