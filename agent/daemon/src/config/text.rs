//! Texts with restricted values, by their keys.

use std::net::SocketAddr;

use globset::Glob;

use super::watch::{PatternError, check_pattern};
use crate::events::Trigger;
use crate::fleet::{Link, is_engine};
use ros2probe_message::filter::{Filter, FilterError};
use ros2probe_metrics::otlp::otlp_endpoint;
use ros2probe_metrics::remote_write;
use ros2probe_ship::Window;

/// Why the text at a key is invalid.
#[derive(Debug, thiserror::Error)]
pub(super) enum InvalidText {
    #[error(transparent)]
    Pattern(#[from] PatternError),
    #[error("{}", .0.kind())]
    Glob(#[from] globset::Error),
    #[error("must be an absolute path, as in {0}")]
    RelativePath(&'static str),
    #[error("must be one of {}, or the name of an event, as in `ros2.node.lost`", .0.join(", "))]
    Trigger(Vec<&'static str>),
    #[error(
        "is `{text}`, must be an IP address and port, as in `127.0.0.1:{port}` or \
         `[::1]:{port}`, or `off`"
    )]
    Address { text: String, port: u16 },
    #[error("is no field: {}", .0.message)]
    Field(#[from] FilterError),
    #[error("must be {0}")]
    Unsuitable(&'static str),
}

/// Checks the text at a key with restricted values.
pub(super) fn check_text(key: &str, text: &str) -> Result<(), InvalidText> {
    match without_indices(key).as_str() {
        "watch[]" | "watch[].topic" | "recordings.snapshots[].topics[]" => Ok(check_pattern(text)?),
        "chains[].from" | "chains[].to" if text.contains('*') => Err(InvalidText::Unsuitable(
            "the name of one topic, as in `/points`",
        )),
        "chains[].from" | "chains[].to" => Ok(check_pattern(text)?),
        "capture.interfaces.include[]"
        | "capture.interfaces.exclude[]"
        | "capture.mirror_interfaces[]" => {
            if text.is_empty() || text.contains(|c: char| c.is_whitespace() || c == '/') {
                return Err(InvalidText::Unsuitable(
                    "an interface name or glob, as in `eth*`",
                ));
            }
            Glob::new(text)?;
            Ok(())
        }
        "capture.cgroup" if !text.starts_with('/') => {
            Err(InvalidText::RelativePath("`/sys/fs/cgroup/robot.slice`"))
        }
        "capture.network_namespaces[]" if !text.starts_with('/') => {
            Err(InvalidText::RelativePath("`/run/netns/robot`"))
        }
        "state_directory" if !matches!(text, "auto" | "off") && !text.starts_with('/') => Err(
            InvalidText::RelativePath("`/var/lib/ros2probe`, `auto` or `off`"),
        ),
        "robot.diagnostic_values[]" if text.len() > 256 || !text.contains('/') => {
            Err(InvalidText::Unsuitable(
                "name, slash and key, as in `battery*/Voltage*`, in at most 256 bytes",
            ))
        }
        "robot.active[]" | "robot.parameters_expected[].node"
            if text.len() > 256 || !text.starts_with('/') =>
        {
            Err(InvalidText::Unsuitable(
                "the full name of a node, as in `/lidar`",
            ))
        }
        "robot.parameters_expected[].name" if text.is_empty() || text.len() > 128 => Err(
            InvalidText::Unsuitable("the name of a parameter, in at most 128 bytes"),
        ),
        "robot.parameters_expected[].value" if text.len() > 256 => {
            Err(InvalidText::Unsuitable("at most 256 bytes long"))
        }
        "robot.extract[].topic" if text.contains('*') || check_pattern(text).is_err() => Err(
            InvalidText::Unsuitable("the name of one topic, as in `/battery`"),
        ),
        "robot.extract[].field" => {
            Filter::of_field(text)?;
            Ok(())
        }
        "robot.extract[].metric" if !is_metric(text) => Err(InvalidText::Unsuitable(
            "1 to 128 lower-case letters, digits and `_`, as in `robot_battery_ratio`; the \
             prefixes `ros2` and `process_`, and suffixes of other types, such as `_total`, are reserved",
        )),
        "recordings.snapshots[].name" if !is_plain(text) => Err(InvalidText::Unsuitable(
            "1 to 64 letters, digits, `_` or `-`: it names directories",
        )),
        "recordings.snapshots[].trigger[]" if Trigger::parse(text).is_none() => {
            let short = Trigger::names().filter(|name| !name.contains('.'));
            Err(InvalidText::Trigger(short.collect()))
        }
        "recordings.directory" if !matches!(text, "auto" | "off") && !text.starts_with('/') => {
            Err(InvalidText::RelativePath("`/data/bags`, `auto` or `off`"))
        }
        "api.socket" if !matches!(text, "auto" | "off") && !text.starts_with('/') => Err(
            InvalidText::RelativePath("`/run/ros2probe/api.sock`, `auto` or `off`"),
        ),
        "upgrade.feed"
            if !["/", "https://", "http://"]
                .iter()
                .any(|start| text.starts_with(start)) =>
        {
            Err(InvalidText::Unsuitable(
                "an absolute path or an address, as in `https://example.org/release.json`",
            ))
        }
        "metrics.web_config" if !text.starts_with('/') => {
            Err(InvalidText::RelativePath("`/etc/ros2probe/web.yml`"))
        }
        "api.token_file" if !text.starts_with('/') => Err(InvalidText::RelativePath(
            "`/run/credentials/ros2probe.service/token`",
        )),
        "foxglove.origins[]" if !is_origin(text) => Err(InvalidText::Unsuitable(
            "an origin, as in `https://app.foxglove.dev` or `file://`, without a path",
        )),
        key @ ("metrics.listen" | "api.listen" | "foxglove.listen")
            if text != "off" && text.parse::<SocketAddr>().is_err() =>
        {
            let port = match key {
                "api.listen" => 17401,
                "foxglove.listen" => 8765,
                _ => 17400,
            };
            let text = text.to_owned();
            Err(InvalidText::Address { text, port })
        }
        "otlp.endpoint" if text != "off" && otlp_endpoint(text).is_none() => {
            Err(InvalidText::Unsuitable(
                "the URL of a receiver, as in `http://collector:4317`, or `off`",
            ))
        }
        "otlp.headers_file" if !text.starts_with('/') => {
            Err(InvalidText::RelativePath("`/etc/ros2probe/otlp.headers`"))
        }
        "remote_write.url" if remote_write::receiver(text).is_none() => {
            Err(InvalidText::Unsuitable(
                "the URL of a receiver, as in `https://prometheus.example/api/v1/write`",
            ))
        }
        "remote_write.token_file"
        | "remote_write.ca_file"
        | "remote_write.certificate_file"
        | "remote_write.key_file"
            if !text.starts_with('/') =>
        {
            Err(InvalidText::RelativePath("`/etc/ros2probe/robot.pem`"))
        }
        "ship.url" | "fleet.store.url" if !ros2probe_ship::is_destination(text) => {
            Err(InvalidText::Unsuitable(
                "a destination, as in `s3://bucket/prefix`, `gs://bucket`, `az://container` or \
             `file:///mnt/bags`",
            ))
        }
        "ship.endpoint" | "fleet.store.endpoint" if remote_write::receiver(text).is_none() => Err(
            InvalidText::Unsuitable("the URL of a store, as in `https://minio.example:9000`"),
        ),
        "ship.instance" if text.is_empty() || text.len() > 128 => Err(InvalidText::Unsuitable(
            "the name of a robot, in at most 128 bytes",
        )),
        "ship.credentials_file"
        | "ship.ca_file"
        | "fleet.store.credentials_file"
        | "fleet.store.ca_file"
            if !text.starts_with('/') =>
        {
            Err(InvalidText::RelativePath("`/etc/ros2probe/ship.env`"))
        }
        "fleet.engine" if !is_engine(text) => Err(InvalidText::Unsuitable(
            "the URL of an engine, as in `https://prometheus.example:9090`",
        )),
        "fleet.token_file" if !text.starts_with('/') => {
            Err(InvalidText::RelativePath("`/etc/ros2probe/engine.token`"))
        }
        "fleet.job" if text.is_empty() || text.len() > 128 => Err(InvalidText::Unsuitable(
            "the value of a label, in at most 128 bytes",
        )),
        "fleet.link" if text.parse::<Link>().is_err() => Err(InvalidText::Unsuitable(
            "a URL with `{robot}`, as in `http://{robot}.example:17401/`",
        )),
        "ship.windows[]" => match text.parse::<Window>() {
            Ok(_) => Ok(()),
            Err(_) => Err(InvalidText::Unsuitable(
                "two times of the day, as in `22:00-06:00`",
            )),
        },
        _ => Ok(()),
    }
}

/// Returns whether the text is an origin as browsers send it: a scheme and, except for files, a
/// host.
fn is_origin(text: &str) -> bool {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-._:[]".contains(c);
    match text.split_once("://") {
        Some(("file", rest)) => rest.is_empty(),
        Some((scheme, host)) => {
            !scheme.is_empty() && !host.is_empty() && host.chars().all(is_plain)
        }
        None => false,
    }
}

/// Returns whether the name is that of a gauge, and no metric of the agent begins like it.
fn is_metric(name: &str) -> bool {
    let taken = ["_total", "_info", "_bucket", "_count", "_sum", "_created"];
    let is_plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
    (1..=128).contains(&name.len())
        && name.starts_with(|c: char| c.is_ascii_lowercase())
        && name.chars().all(is_plain)
        && !["ros2", "process_", "target_"]
            .iter()
            .any(|taken| name.starts_with(taken))
        && !taken.iter().any(|taken| name.ends_with(taken))
}

/// Returns whether the name is a valid file name on every system.
fn is_plain(name: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-');
    (1..=64).contains(&name.len()) && name.chars().all(plain)
}

/// Replaces indices: `watch[2].topic` becomes `watch[].topic`.
fn without_indices(key: &str) -> String {
    let mut inside = false;
    let mut shown = |c: char| {
        let shown = !inside || c == ']';
        inside = c == '[' || (inside && c != ']');
        shown
    };
    key.chars().filter(|c| shown(*c)).collect()
}
