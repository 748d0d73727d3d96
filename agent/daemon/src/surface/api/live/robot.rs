//! Findings about what the robot itself says, and about the clocks of its hosts, in words.

use ros2probe_wire::diagnostics::DiagnosticLevel;
use ros2probe_wire::{DomainId, Guid};

use super::findings::{finding, of_node};
use super::structure::Ids;
use ros2probe_api::live::{Finding, Severity};
use ros2probe_model::facts::diagnosis::{Diagnosis, Difference, StampFault, TopicKey};
use ros2probe_model::facts::robot::{TransformFault, TransformFaultKind};
use ros2probe_model::facts::shared_memory::MemoryFault;

/// Returns such a finding in words, with its remedy.
pub(super) fn in_words(ids: &Ids, diagnosis: &Diagnosis) -> Finding {
    let kind = diagnosis.kind();
    match diagnosis {
        Diagnosis::LogErrors {
            domain_id,
            node,
            errors,
            text,
        } => {
            let sentence = format!("{node} logged {errors} errors within a minute: {text}");
            let found = of_node(kind, ids, (*domain_id, node), sentence);
            found.with_remedy(format!("`rp log {node} --level error` prints them"))
        }
        Diagnosis::DiagnosticError {
            domain_id,
            topic,
            node,
            name,
            hardware_id,
            level,
            message,
        } => {
            let text = match level {
                DiagnosticLevel::Stale => {
                    format!("`{name}` sends no new diagnostics; the last message is: {message}")
                }
                _ => format!("`{name}` is in error: {message}"),
            };
            let about = format!("{domain_id}|{topic}|{name}|{hardware_id}");
            let found = Finding {
                domain_id: Some(domain_id.0),
                node: node.as_ref().and_then(|node| ids.node(*domain_id, node)),
                ..finding(kind, Severity::Warning, &about, text)
            };
            found.with_remedy("`rp diag --verbose` prints its values")
        }
        Diagnosis::TransformFault {
            domain_id,
            namespace,
            fault,
        } => of_transforms(kind, *domain_id, namespace, fault),
        Diagnosis::ClocksApart {
            peer,
            offset,
            uncertainty,
        } => {
            let ahead = if *offset < 0 { "behind" } else { "ahead of" };
            let text = format!(
                "the clock of {peer} is {} {ahead} the clock of this host (± {}): latencies between \
                 them are wrong by that, and transforms may be refused",
                of_clock(offset.unsigned_abs()),
                of_clock(uncertainty.unsigned_abs()),
            );
            finding(kind, Severity::Warning, peer, text)
                .with_remedy("synchronise both clocks (NTP, PTP): `chronyc tracking` on each host")
        }
        Diagnosis::NearMiss {
            topic,
            subscription,
            difference,
        } => near_miss(kind, topic, subscription, *difference),
        Diagnosis::NodeInactive {
            domain_id,
            node,
            state,
            has_failed,
        } => {
            let why = match has_failed {
                true => "a transition of its lifecycle failed",
                false => "the configuration expects it to be active",
            };
            let text = format!("{node} is {}, not active: {why}", state.label());
            of_node(kind, ids, (*domain_id, node), text).with_remedy(format!(
                "`rp log {node}` prints why; `ros2 lifecycle set {node} activate`"
            ))
        }
        Diagnosis::ParameterDrift {
            domain_id,
            node,
            name,
            expected,
            value,
        } => {
            let text = format!("{name} of {node} is {value}; the configuration expects {expected}");
            let found = of_node(kind, ids, (*domain_id, node), text);
            Finding {
                id: format!("{}|{name}", found.id),
                ..found.with_remedy(format!("`rp param changes {node}` prints who changed it"))
            }
        }
        Diagnosis::MixedTime {
            domain_id,
            simulated,
            system,
        } => {
            let text = format!(
                "{} use simulated time, {} do not: stamps of one clock look old or future to the other",
                simulated.join(", "),
                system.join(", ")
            );
            Finding {
                domain_id: Some(domain_id.0),
                ..finding(kind, Severity::Warning, &domain_id.to_string(), text)
            }
            .with_remedy("give all nodes the same value of use_sim_time")
        }
        Diagnosis::WrongStamps {
            topic,
            writer,
            fault,
            nanoseconds,
        } => wrong_stamps(kind, topic, *writer, (*fault, *nanoseconds)),
        Diagnosis::SharedMemoryFault { fault, figure } => memory_fault(kind, *fault, *figure),
        _ => finding(kind, Severity::Warning, "", kind.to_owned()),
    }
}

/// Returns what is wrong with shared memory.
fn memory_fault(kind: &'static str, fault: MemoryFault, figure: u64) -> Finding {
    const SHM_CLEAN_REMEDY: &str = "`fastdds shm clean` removes what ended nodes left";
    let (severity, text, remedy) = match fault {
        MemoryFault::Full => (
            Severity::Warning,
            "/dev/shm, of this host or of a container, is nearly full: Fast DDS then sends over the \
             network, or nodes fail at start"
                .to_owned(),
            format!("df -h /dev/shm; {SHM_CLEAN_REMEDY}"),
        ),
        MemoryFault::Stale => (
            Severity::Warning,
            format!(
                "files of ended nodes take {} MB of /dev/shm: nodes that are killed leave them",
                figure >> 20
            ),
            SHM_CLEAN_REMEDY.to_owned(),
        ),
        MemoryFault::Split => (
            Severity::Error,
            format!(
                "nodes of one domain and one network use {figure} different directories /dev/shm: \
                 Fast DDS considers them to be on one host, and no message passes between them"
            ),
            "share it between the containers (docker run --ipc=host), or disable shared memory in them: \
             FASTDDS_BUILTIN_TRANSPORTS=UDPv4"
                .to_owned(),
        ),
    };
    finding(kind, severity, fault.label(), text).with_remedy(remedy)
}

/// Returns a publisher and a subscription that were probably meant for each other.
fn near_miss(
    kind: &'static str,
    topic: &TopicKey,
    subscription: &TopicKey,
    difference: Difference,
) -> Finding {
    let text = format!(
        "{} has a publisher and no subscription, {} of the same type a subscription and no publisher: \
         the names differ only in {}",
        topic.name,
        subscription.name,
        match difference {
            Difference::Case => "upper and lower case",
            Difference::Slash => "a slash",
            Difference::Namespace => "the namespace",
            Difference::Letter => "one letter",
            Difference::Domain => "the domain",
        }
    );
    let about = format!(
        "{}|{}|{}|{}",
        topic.domain_id, topic.dds_name, subscription.domain_id, subscription.dds_name
    );
    let found = finding(kind, Severity::Warning, &about, text);
    match difference {
        Difference::Domain => Finding {
            text: format!(
                "{} has a publisher in domain {} and a subscription in domain {}, on one host",
                topic.name, topic.domain_id, subscription.domain_id
            ),
            ..found
        }
        .with_remedy("start both nodes with the same ROS_DOMAIN_ID"),
        _ => found.with_remedy(format!(
            "if they belong together: --ros-args -r {}:={}    # at the publisher",
            topic.name, subscription.name
        )),
    }
}

/// Returns a publisher whose stamps cannot be right.
fn wrong_stamps(
    kind: &'static str,
    topic: &TopicKey,
    writer: Guid,
    (fault, nanoseconds): (StampFault, i64),
) -> Finding {
    let by = of_clock(nanoseconds.unsigned_abs());
    let what = match fault {
        StampFault::Future => format!("are {by} in the future when it is published"),
        StampFault::WentBack => format!("went back by {by}"),
        StampFault::Drifting => format!("drift by {by} in two minutes"),
        StampFault::OtherClock => "come from another clock".to_owned(),
    };
    let remedy = match fault {
        StampFault::Future => "stamp a message with the time of its measurement",
        StampFault::WentBack => "look for two sources behind one publisher, or a step of its clock",
        StampFault::Drifting | StampFault::OtherClock => {
            "synchronise the clock of the sensor (PTP), or let the driver stamp its messages"
        }
    };
    let about = format!("{}|{}|{writer}", topic.domain_id, topic.dds_name);
    Finding {
        writer: Some(writer.to_string()),
        ..finding(
            kind,
            Severity::Warning,
            &about,
            format!("the stamps of {} {what}", topic.name),
        )
    }
    .with_remedy(remedy)
}

/// Returns a fault of transforms.
fn of_transforms(
    kind: &'static str,
    domain_id: DomainId,
    namespace: &str,
    fault: &TransformFault,
) -> Finding {
    let others = match fault.edges {
        0 | 1 => String::new(),
        edges => format!(" (and {} others)", edges - 1),
    };
    let edge = format!("the transform {} -> {}{others}", fault.parent, fault.child);
    let names = fault.names.join(", ");
    let (text, remedy) = match fault.kind {
        TransformFaultKind::Silent => (
            format!("{edge} is no longer broadcast, although {names} is announced"),
            "look at the log and the inputs of that node",
        ),
        TransformFaultKind::SeveralBroadcasters => (
            format!("{edge} has several broadcasters at once: {names}"),
            "let one of them broadcast it",
        ),
        TransformFaultKind::TimeWentBack => (
            format!("{edge} has a stamp before an earlier one, from {names}"),
            "look at the clock of that host, and for a bag that plays in a loop",
        ),
        TransformFaultKind::Jumps => (
            format!("{edge} jumps again and again, broadcast by {names}"),
            "look at what that node localises with: its sensors, its map, or a second robot that \
             publishes its inputs",
        ),
        TransformFaultKind::UnknownFrame => (
            format!(
                "no transform has the frame {}, which messages of {names} name",
                fault.child
            ),
            "start the node that broadcasts it, or correct the frame_id",
        ),
        TransformFaultKind::Apart => (
            format!("the frames are in several trees, with the roots {names}"),
            "find the missing transform between them with `rp tf`",
        ),
    };
    let about = format!(
        "{domain_id}|{namespace}|{}|{}",
        fault.child,
        fault.kind.label()
    );
    Finding {
        domain_id: Some(domain_id.0),
        ..finding(kind, Severity::Warning, &about, text)
    }
    .with_remedy(remedy)
}

/// Returns nanoseconds of a clock in words.
fn of_clock(nanoseconds: u64) -> String {
    match std::time::Duration::from_nanos(nanoseconds).as_secs_f64() {
        seconds if seconds < 1.0 => format!("{:.1} ms", seconds * 1e3),
        seconds => format!("{seconds:.3} s"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_model::facts::names::TopicName;
    use ros2probe_model::facts::topic_kind::TopicKind;
    use ros2probe_wire::lifecycle::LifecycleState;

    fn topic(domain_id: u32, name: &str) -> TopicKey {
        TopicKey {
            domain_id: DomainId(domain_id),
            dds_name: format!("rt{name}").into(),
            name: TopicName::from(name),
            kind: TopicKind::Topic,
        }
    }

    #[test]
    fn findings_have_a_sentence_and_a_remedy() {
        let near = |subscription: TopicKey, difference| Diagnosis::NearMiss {
            topic: topic(0, "/scan"),
            subscription,
            difference,
        };
        let stamps = |fault, nanoseconds| Diagnosis::WrongStamps {
            topic: topic(0, "/imu"),
            writer: Guid::default(),
            fault,
            nanoseconds,
        };
        for (diagnosis, text, remedy) in [
            (
                near(topic(0, "/Scan"), Difference::Case),
                "/scan has a publisher and no subscription, /Scan of the same type a subscription \
                 and no publisher: the names differ only in upper and lower case",
                "if they belong together: --ros-args -r /scan:=/Scan    # at the publisher",
            ),
            (
                near(topic(5, "/scan"), Difference::Domain),
                "/scan has a publisher in domain 0 and a subscription in domain 5, on one host",
                "start both nodes with the same ROS_DOMAIN_ID",
            ),
            (
                Diagnosis::NodeInactive {
                    domain_id: DomainId(0),
                    node: "/lidar".into(),
                    state: LifecycleState::Unconfigured,
                    has_failed: true,
                },
                "/lidar is unconfigured, not active: a transition of its lifecycle failed",
                "`rp log /lidar` prints why; `ros2 lifecycle set /lidar activate`",
            ),
            (
                Diagnosis::ParameterDrift {
                    domain_id: DomainId(0),
                    node: "/planner".into(),
                    name: "speed".into(),
                    expected: "0.5".into(),
                    value: "1.5".into(),
                },
                "speed of /planner is 1.5; the configuration expects 0.5",
                "`rp param changes /planner` prints who changed it",
            ),
            (
                stamps(StampFault::Future, 80_000_000),
                "the stamps of /imu are 80.0 ms in the future when it is published",
                "stamp a message with the time of its measurement",
            ),
            (
                stamps(StampFault::Drifting, -4_000_000),
                "the stamps of /imu drift by 4.0 ms in two minutes",
                "synchronise the clock of the sensor (PTP), or let the driver stamp its messages",
            ),
        ] {
            let ids = Ids::default();
            let found = in_words(&ids, &diagnosis);
            assert_eq!(
                (&*found.text, found.remedy.as_deref()),
                (text, Some(remedy))
            );
        }
    }
}
