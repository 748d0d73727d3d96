//! What the sample robot itself says, and the clocks of its hosts.

use std::sync::Arc;
use std::time::Duration;

use crate::robot_states::battery;
use ros2probe_model::derive::clocks::Source as ClockSource;
use ros2probe_model::facts::model_time::ModelTime;
use ros2probe_model::facts::names::NodeName;
use ros2probe_model::report::snapshot::{
    Broadcaster, ClockFacts, ClockOffset, DiagnosticFacts, DiagnosticStatus, EdgeFacts,
    FieldMessage, Jumps, LifecycleFacts, LogFacts, LogMessage, ManagedNode, NodeLogFacts,
    ParameterChange, ParameterFacts, ParametersFacts, PeerClock, Requester, TransformFacts,
    TreeFacts,
};
use ros2probe_wire::diagnostics::DiagnosticLevel;
use ros2probe_wire::lifecycle::LifecycleState;
use ros2probe_wire::log::LogLevel;
use ros2probe_wire::transforms::Pose;
use ros2probe_wire::{DomainId, Guid, SequenceNumber};

/// Returns the diagnostics of one part, which is in error.
pub(super) fn diagnostics(writer: Guid) -> DiagnosticFacts {
    let at = ModelTime::from_nanoseconds(1_699_999_999_000_000_000);
    DiagnosticFacts {
        are_read: true,
        statuses: vec![Arc::new(DiagnosticStatus {
            domain_id: DomainId(0),
            topic: "/diagnostics".into(),
            name: "lidar: connection".into(),
            hardware_id: "vlp16".into(),
            node: Some("/lidar".into()),
            writer,
            level: DiagnosticLevel::Error,
            message: "no data".into(),
            values: vec![("packet rate (Hz)".into(), "0.5".into())],
            at,
            since: at,
        })],
    }
}

/// Returns a managed node that is active.
pub(super) fn lifecycle() -> LifecycleFacts {
    LifecycleFacts {
        are_read: true,
        nodes: vec![ManagedNode {
            domain_id: DomainId(0),
            node: "/lidar".into(),
            state: LifecycleState::Active,
            at: ModelTime::from_nanoseconds(1_699_999_990_000_000_000),
        }],
    }
}

/// Returns the last message about a battery, and a truncated one about another.
pub(super) fn fields() -> Vec<FieldMessage> {
    let message = |topic: &str, payload: &[u8]| FieldMessage {
        domain_id: DomainId(0),
        topic: topic.into(),
        message_type: "sensor_msgs/msg/BatteryState".into(),
        hash: None,
        at: ModelTime::from_nanoseconds(1_699_999_999_000_000_000),
        payload: payload.into(),
    };
    let whole = battery("base_link", 24.5, 31.0, 0.75);
    let begin = whole.get(..20).unwrap_or_default();
    vec![
        message("/battery", &whole),
        message("/spare_battery", begin),
    ]
}

/// Returns a tree with one edge at 50 Hz.
pub(super) fn transforms(writer: Guid) -> TransformFacts {
    TransformFacts {
        are_read: true,
        trees: vec![TreeFacts {
            domain_id: DomainId(0),
            namespace: "".into(),
            edges: vec![EdgeFacts {
                parent: "odom".into(),
                child: "base_link".into(),
                is_static: false,
                broadcasters: vec![Broadcaster {
                    writer,
                    node: Some("/ekf".into()),
                }],
                count: 500,
                rate: Some(50.0),
                longest_interval: Some(Duration::from_millis(21)),
                at: ModelTime::from_nanoseconds(1_699_999_999_000_000_000),
                stamp: (1_699_999_999, 0),
                pose: Pose {
                    translation: [1.0, 0.0, 0.0],
                    rotation: [0.0, 0.0, 0.0, 1.0],
                },
                jumps: Jumps {
                    translation: 1,
                    rotation: 0,
                    time: 0,
                },
            }],
            unread_static: 1,
        }],
    }
}

/// Returns one parameter, which a client changed.
pub(super) fn parameters(writer: Guid) -> ParametersFacts {
    let at = ModelTime::from_nanoseconds(1_699_999_999_000_000_000);
    let (domain_id, node) = (DomainId(0), NodeName::from("/lidar"));
    ParametersFacts {
        are_read: true,
        known: vec![ParameterFacts {
            domain_id,
            node: node.clone(),
            name: "rpm".into(),
            value: "600".into(),
            at,
        }],
        changes: vec![Arc::new(ParameterChange {
            at,
            domain_id,
            node: node.clone(),
            name: "rpm".into(),
            before: Some("300".into()),
            value: Some("600".into()),
            requested_by: Some(Requester {
                node: Some("/tuner".into()),
                writer,
            }),
        })],
        counts: vec![(domain_id, node, 1)],
    }
}

/// Returns the log of a node with one error.
pub(super) fn clocks() -> ClockFacts {
    let offset = |host: Option<&str>, peer: &str| ClockOffset {
        host: host.map(Into::into),
        peer: peer.into(),
        offset: -20_000_000,
        uncertainty: 300_000,
    };
    ClockFacts {
        are_compared: true,
        peers: vec![PeerClock {
            peer: "camera-pc".into(),
            address: [10, 0, 0, 2].into(),
            ahead: (Some(-20_300_000), Some(-19_700_000)),
            source: Some(ClockSource::Reply),
            steps: 1,
        }],
        offsets: vec![
            offset(None, "camera-pc"),
            offset(Some("camera-pc"), "arm-pc"),
        ],
    }
}

pub(super) fn logs(writer: Guid) -> LogFacts {
    let message = Arc::new(LogMessage {
        at: ModelTime::from_nanoseconds(1_699_999_999_000_000_000),
        stamp: (1_699_999_998, 5),
        domain_id: DomainId(0),
        writer,
        number: SequenceNumber(7),
        node: "/lidar".into(),
        level: LogLevel::Error,
        logger: "lidar".into(),
        text: "no data".into(),
        file: "lidar.cpp".into(),
        function: "read".into(),
        line: 81,
    });
    let level = |level| match level {
        LogLevel::Error => (1, Some(Arc::clone(&message))),
        _ => (0, None),
    };
    LogFacts {
        are_read: true,
        nodes: vec![NodeLogFacts {
            domain_id: DomainId(0),
            node: "/lidar".into(),
            levels: LogLevel::ALL.map(level),
        }],
        latest: vec![message],
    }
}
