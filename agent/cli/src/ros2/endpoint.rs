//! Block of one writer or reader in `topic info -v`.

use std::borrow::Cow;
use std::fmt::Write as _;

use ros2probe_api::endpoints::{Endpoint, Qos};

use super::Dialect;

/// ros2cli's node name for an endpoint whose participant has not announced its nodes yet.
const UNKNOWN_NODE: [&str; 2] = ["_NODE_NAME_UNKNOWN_", "_NODE_NAMESPACE_UNKNOWN_"];
/// ros2cli's node name for an endpoint of a participant without ROS.
const BARE_DDS_NODE: [&str; 2] = ["_CREATED_BY_BARE_DDS_APP_"; 2];
/// Trailing zero bytes of a GID in Humble, which is longer than a GUID.
const GID_PADDING: usize = 8;

/// Returns the block without the empty line after it.
#[must_use]
pub fn block(endpoint: &Endpoint<'_>, kind: &str, dialect: Dialect) -> String {
    let mut text = String::new();
    let [name, namespace] = node(endpoint);
    let _ = writeln!(text, "Node name: {name}");
    let _ = writeln!(text, "Node namespace: {namespace}");
    let _ = writeln!(text, "Topic type: {}", endpoint.message_type);
    if dialect > Dialect::Humble {
        let hash = endpoint.type_hash.as_deref().unwrap_or("INVALID");
        let _ = writeln!(text, "Topic type hash: {hash}");
    }
    let _ = writeln!(text, "Endpoint type: {kind}");
    let _ = writeln!(text, "GID: {}", gid(endpoint, dialect));
    let _ = writeln!(text, "QoS profile:");
    qos(&mut text, &endpoint.qos, "  ");
    text
}

/// Returns name and namespace of the endpoint's node.
fn node<'a>(endpoint: &'a Endpoint<'_>) -> [&'a str; 2] {
    match (&endpoint.node, &endpoint.enclave) {
        (Some(node), _) => match node.rsplit_once('/') {
            Some(("", name)) => [name, "/"],
            Some((namespace, name)) => [name, namespace],
            None => [node, "/"],
        },
        (None, Some(_)) => UNKNOWN_NODE,
        (None, None) => BARE_DDS_NODE,
    }
}

/// Returns the bytes of a GID, separated by points.
fn gid(endpoint: &Endpoint<'_>, dialect: Dialect) -> String {
    // Older agents report only the GUID.
    let text = match endpoint.gid.as_str() {
        "" => &endpoint.guid,
        gid => gid,
    };
    let digits: Vec<char> = text.chars().filter(|digit| *digit != '.').collect();
    let mut bytes: Vec<String> = digits.chunks(2).map(|byte| byte.iter().collect()).collect();
    if dialect == Dialect::Humble {
        bytes.extend(std::iter::repeat_n("00".to_owned(), GID_PADDING));
    }
    bytes.join(".")
}

fn qos(text: &mut String, qos: &Qos<'_>, indent: &str) {
    let lines = [
        ("Reliability", qos.reliability.clone()),
        ("History (Depth)", qos.history.clone()),
        ("Durability", qos.durability.clone()),
        ("Lifespan", duration(qos.lifespan_seconds)),
        ("Deadline", duration(qos.deadline_seconds)),
        ("Liveliness", qos.liveliness.clone()),
        (
            "Liveliness lease duration",
            duration(qos.liveliness_lease_seconds),
        ),
    ];
    for (key, value) in lines {
        let _ = writeln!(text, "{indent}{key}: {value}");
    }
}

fn duration(seconds: Option<f64>) -> Cow<'static, str> {
    match seconds {
        None => "Infinite".into(),
        Some(seconds) => format!("{:.0} nanoseconds", seconds * 1e9).into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn endpoint() -> Endpoint<'static> {
        Endpoint {
            guid: "010f8b216e5c3a0200000000.00001203".to_owned(),
            node: Some("/robot1/talker".into()),
            enclave: Some("/".into()),
            message_type: "std_msgs/msg/String".into(),
            type_hash: Some("RIHS01_df".into()),
            equivalence_hash: None,
            qos: Qos {
                reliability: "RELIABLE".into(),
                durability: "TRANSIENT_LOCAL".into(),
                history: "KEEP_LAST (10)".into(),
                lifespan_seconds: Some(10.0),
                liveliness: "AUTOMATIC".into(),
                ..Qos::default()
            },
            ..Endpoint::default()
        }
    }

    #[test]
    fn a_block_has_the_format_of_the_distribution() {
        let qos = "QoS profile:\n  Reliability: RELIABLE\n  History (Depth): KEEP_LAST (10)\n  \
            Durability: TRANSIENT_LOCAL\n  Lifespan: 10000000000 nanoseconds\n  \
            Deadline: Infinite\n  Liveliness: AUTOMATIC\n  Liveliness lease duration: Infinite\n";
        let head = "Node name: talker\nNode namespace: /robot1\nTopic type: std_msgs/msg/String\n";
        let gid = "01.0f.8b.21.6e.5c.3a.02.00.00.00.00.00.00.12.03";
        assert_eq!(
            block(&endpoint(), "PUBLISHER", Dialect::Humble),
            format!("{head}Endpoint type: PUBLISHER\nGID: {gid}.00.00.00.00.00.00.00.00\n{qos}")
        );
        for dialect in [Dialect::Jazzy, Dialect::Kilted, Dialect::Rolling] {
            assert_eq!(
                block(&endpoint(), "SUBSCRIPTION", dialect),
                format!(
                    "{head}Topic type hash: RIHS01_df\nEndpoint type: SUBSCRIPTION\nGID: {gid}\n\
                     {qos}"
                )
            );
        }
        let unhashed = Endpoint {
            type_hash: None,
            equivalence_hash: None,
            ..endpoint()
        };
        assert!(
            block(&unhashed, "PUBLISHER", Dialect::Jazzy).contains("Topic type hash: INVALID\n")
        );
    }

    #[test]
    fn an_unknown_node_has_the_placeholder_of_its_participant() {
        let named = |name: Option<&str>, enclave: Option<&str>| {
            let endpoint = Endpoint {
                node: name.map(Cow::Borrowed),
                enclave: enclave.map(Cow::Borrowed),
                ..endpoint()
            };
            node(&endpoint).map(str::to_owned)
        };
        assert_eq!(named(Some("/talker"), None), ["talker", "/"]);
        assert_eq!(named(Some("/a/b/talker"), None), ["talker", "/a/b"]);
        assert_eq!(named(None, Some("/")), UNKNOWN_NODE);
        assert_eq!(named(None, None), BARE_DDS_NODE);
    }
}
