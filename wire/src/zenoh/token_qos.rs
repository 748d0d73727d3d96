//! QoS of an endpoint as its liveliness token has it (rmw_zenoh,
//! `liveliness_utils.cpp`).
//!
//! The text has eleven numbers. Kinds have the numbers of the enumerations in `rmw/types.h`. An
//! absent number means the default of rmw_zenoh:
//! `<reliability>:<durability>:<history>,<depth>:<deadline s>,<ns>:<lifespan s>,<ns>:<liveliness>,
//! <lease s>,<ns>`.

use core::time::Duration;

use crate::qos::{Durability, History, HistoryKind, Liveliness, Qos, Reliability, Role};
use crate::rtps::VendorId;
use crate::time::RtpsDuration;

/// Depth of an endpoint whose token has none.
const DEFAULT_DEPTH: i32 = 42;

/// Parses the QoS of an endpoint; `None` if the text has another form or an undefined number.
pub(super) fn parse(text: &str) -> Option<Qos> {
    let mut qos = Qos::defaults(Role::Writer, VendorId::UNKNOWN);
    let mut policies = text.split(':');
    let mut next = || policies.next();
    // 0 is SYSTEM_DEFAULT in each enumeration of rmw.
    qos.reliability = match number(next()?)?.unwrap_or(0) {
        0 | 1 => Reliability::RELIABLE,
        2 => Reliability::BEST_EFFORT,
        _ => return None,
    };
    qos.durability = match number(next()?)?.unwrap_or(0) {
        1 => Durability::TRANSIENT_LOCAL,
        0 | 2 => Durability::VOLATILE,
        _ => return None,
    };
    let (kind, depth) = next()?.split_once(',')?;
    qos.history = Some(History {
        kind: match number(kind)?.unwrap_or(0) {
            0 | 1 => HistoryKind::KEEP_LAST,
            2 => HistoryKind::KEEP_ALL,
            _ => return None,
        },
        depth: match number(depth)? {
            Some(depth) => i32::try_from(depth).ok()?,
            None => DEFAULT_DEPTH,
        },
    });
    qos.deadline = duration(next()?)?;
    qos.lifespan = duration(next()?)?;
    let (kind, lease) = next()?.split_once(',')?;
    qos.liveliness = match number(kind)?.unwrap_or(0) {
        0 | 1 => Liveliness::AUTOMATIC,
        2 => Liveliness::MANUAL_BY_PARTICIPANT,
        3 => Liveliness::MANUAL_BY_TOPIC,
        _ => return None,
    };
    qos.liveliness_lease = duration(lease)?;
    next().is_none().then_some(qos)
}

/// Parses a number: `Some(None)` for an empty text, `None` for text that is not a number.
fn number(text: &str) -> Option<Option<u64>> {
    if text.is_empty() {
        return Some(None);
    }
    let is_number = text.bytes().all(|c| c.is_ascii_digit());
    is_number.then_some(Some(text.parse().ok()?))
}

/// Parses seconds and nanoseconds. Absent, zero and rmw's largest duration are infinite.
fn duration(text: &str) -> Option<RtpsDuration> {
    let (seconds, nanoseconds) = text.split_once(',')?;
    let seconds = number(seconds)?.unwrap_or(0);
    let nanoseconds = number(nanoseconds)?.unwrap_or(0);
    let duration = Duration::from_secs(seconds).checked_add(Duration::from_nanos(nanoseconds))?;
    // RMW_DURATION_INFINITE: 9223372036 s 854775807 ns.
    let is_infinite =
        duration.is_zero() || duration >= Duration::from_nanos(i64::MAX.unsigned_abs());
    Some(if is_infinite {
        RtpsDuration::Infinite
    } else {
        RtpsDuration::Finite(duration)
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn absent_values_have_the_defaults_of_rmw_zenoh() {
        let qos = parse("::,7:,:,:,,").unwrap();
        assert_eq!(qos.reliability, Reliability::RELIABLE);
        assert_eq!(qos.durability, Durability::VOLATILE);
        let history = qos.history.unwrap();
        assert_eq!((history.kind, history.depth), (HistoryKind::KEEP_LAST, 7));
        assert_eq!(qos.deadline, RtpsDuration::Infinite);
        assert_eq!(qos.liveliness, Liveliness::AUTOMATIC);
        assert_eq!(parse("::,:,:,:,,").unwrap().history.unwrap().depth, 42);
    }

    #[test]
    fn values_that_differ_from_the_defaults_are_parsed() {
        let qos = parse("2:1:2,5:1,500000000:2,0:3,9223372036,854775807").unwrap();
        assert_eq!(qos.reliability, Reliability::BEST_EFFORT);
        assert_eq!(qos.durability, Durability::TRANSIENT_LOCAL);
        assert_eq!(qos.history.unwrap().kind, HistoryKind::KEEP_ALL);
        let finite = RtpsDuration::Finite;
        assert_eq!(qos.deadline, finite(Duration::from_millis(1500)));
        assert_eq!(qos.lifespan, finite(Duration::from_secs(2)));
        assert_eq!(qos.liveliness, Liveliness::MANUAL_BY_TOPIC);
        assert_eq!(qos.liveliness_lease, RtpsDuration::Infinite);
    }

    #[test]
    fn text_of_another_form_is_refused() {
        for text in [
            "",
            "1:2:1,10",
            "::,7:,:,:,,:",
            "9::,7:,:,:,,",
            "::,-7:,:,:,,",
            "::,4294967296:,:,:,,",
            "::7:,:,:,,",
        ] {
            assert_eq!(parse(text), None, "{text}");
        }
    }

    proptest! {
        #[test]
        fn no_text_makes_the_parser_of_qos_panic(text in "[0-9:,]{0,40}") {
            let _ = parse(&text);
        }
    }
}
