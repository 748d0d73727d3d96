//! Checks of the agent itself: whether it answers, observes, loses nothing and persists its state.
//! If no agent runs, obstacles to starting one.

use std::collections::BTreeSet;
use std::fs;
use std::net::{IpAddr, SocketAddr};
use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _};
use std::path::Path;

use super::answers::Answers;
use super::host_state::HostState;
use super::privileges::is_installed;
use crate::top::text::counted;
use ros2probe_api::doctor::{Area, Finding, Severity};
use ros2probe_api::health::{Foxglove, Health, Limit};
use ros2probe_api::watches::WatchState;
use ros2probe_daemon::config::{self, Config, StateChoice};

const AREA: Area = Area::Agent;
const HEALTH_SOURCE: &str = "GET /health";
/// State directory of the package.
const STATE_DIRECTORY: &str = "/var/lib/ros2probe";
const SOCKET_TABLES: [&str; 2] = ["/proc/net/tcp", "/proc/net/tcp6"];
/// Tables of the addresses of this host: of IPv4 and of IPv6.
const ADDRESS_TABLES: [&str; 2] = ["/proc/net/fib_trie", "/proc/net/if_inet6"];
/// State of a listening socket in `/proc/net/tcp` and `/proc/net/tcp6`.
const LISTENING_STATE: &str = "0A";
/// Maximum number of bytes read of each of [`SOCKET_TABLES`].
const MAX_SOCKETS: u64 = 8 << 20;
/// Maximum number of watches in one sentence.
const MAX_NAMED_WATCHES: usize = 5;

/// Returns the findings about an agent that answers.
#[must_use]
pub fn check(answers: &Answers, place: &str, own_version: &str) -> Vec<Finding> {
    let health = &answers.health;
    let mut findings = vec![running_finding(health, place), version(health, own_version)];
    findings.extend(losses(health));
    findings.extend(limits(health));
    findings.extend(evictions(health));
    findings.push(watches(answers));
    findings.extend(health.foxglove.as_ref().map(foxglove));
    findings.extend(zenoh(health));
    if health.source != "replay" {
        findings.push(kept_watches_finding(health));
    }
    findings
}

/// Returns the findings for a host without an answering agent. `reason` is why the request failed.
#[must_use]
pub fn absent(host: &HostState, config: &Config, reason: &str, is_denied: bool) -> Vec<Finding> {
    let finding = if is_denied {
        let sentence = "an agent is running, but this user has no permission to query it";
        Finding::new(AREA, "reachable", Severity::Unknown, sentence)
            .seen(reason, "connect(2)")
            .remedy("sudo rp doctor    # or: sudo usermod -aG ros2probe $USER, and log in again")
    } else {
        let sentence = "no agent answers: nothing is observed and the graph is unknown";
        Finding::new(AREA, "reachable", Severity::Warning, sentence)
            .seen(reason, "connect(2)")
            .remedy(match is_installed(host) {
                true => "sudo systemctl start ros2probe    # or, in a terminal: sudo rp run",
                false => "sudo rp run",
            })
    };
    let mut findings = vec![finding];
    if !is_denied {
        findings.extend(ports(host, config));
        findings.extend(state_directory(host, &config.state_directory));
    }
    findings
}

/// Returns the finding for a configuration that prevents the agent from starting.
#[must_use]
pub fn misconfigured(path: &Path, mistakes: &str) -> Finding {
    let first = mistakes.lines().next().unwrap_or_default();
    let count = mistakes.lines().count();
    let more = if count > 1 {
        format!(" (and {} more)", count - 1)
    } else {
        String::new()
    };
    let sentence = format!("the configuration is invalid: {first}{more}");
    let finding = Finding::new(AREA, "configuration", Severity::Problem, sentence);
    let finding = finding.seen(mistakes, path.display().to_string());
    finding.remedy("rp check-config    # prints all mistakes")
}

fn running_finding(health: &Health, place: &str) -> Finding {
    let since = health
        .uptime_seconds
        .map_or_else(String::new, |up| format!(", up {}", duration(up)));
    let finding = if health.ready {
        let sentence = format!("the agent is running and sees traffic{since}");
        Finding::new(AREA, "ready", Severity::Ok, sentence)
            .seen("true", format!("{HEALTH_SOURCE} ready"))
    } else {
        let reason = health.reason.as_deref().unwrap_or("it gives no reason");
        let sentence = format!("the agent is running but sees nothing: {reason}");
        Finding::new(AREA, "ready", Severity::Problem, sentence)
            .seen(reason, format!("{HEALTH_SOURCE} reason"))
            .remedy("journalctl -u ros2probe -e")
    };
    finding.seen(place, "this connection")
}

fn version(health: &Health, own: &str) -> Finding {
    let finding = if health.version == own {
        Finding::new(
            AREA,
            "version",
            Severity::Ok,
            format!("version {own}, same as this rp"),
        )
    } else {
        let sentence = format!(
            "the agent is version {}, this rp is version {own}",
            health.version
        );
        Finding::new(AREA, "version", Severity::Note, sentence)
            .remedy("sudo systemctl restart ros2probe    # starts the installed version")
    };
    finding.seen(health.version.as_ref(), format!("{HEALTH_SOURCE} version"))
}

fn losses(health: &Health) -> Vec<Finding> {
    let rings = [
        (
            health.dropped_packets,
            "packets",
            "dropped_packets",
            "ring_bytes",
        ),
        (
            health.dropped_datagrams,
            "captured datagrams",
            "dropped_datagrams",
            "ring_bytes",
        ),
        (
            health.dropped_records,
            "records",
            "dropped_records",
            "record_ring_bytes",
        ),
    ];
    let lossy = rings.iter().filter(|(count, ..)| *count > 0);
    let mut findings: Vec<_> = lossy
        .map(|(count, what, check, ring)| {
            let sentence = format!(
                "{count} {what} were lost because a ring buffer was full: counts are \
                    lower bounds"
            );
            Finding::new(AREA, check, Severity::Warning, sentence)
                .seen(count.to_string(), format!("{HEALTH_SOURCE} {check}"))
                .configure(format!(
                    "capture: {{{ring}: BYTES}}    # double it; a power of two"
                ))
        })
        .collect();
    if findings.is_empty() {
        let finding = Finding::new(
            AREA,
            "losses",
            Severity::Ok,
            "no packets or records lost by the agent",
        );
        findings.push(finding.seen("0", format!("{HEALTH_SOURCE} dropped_*")));
    }
    findings
}

/// Returns the findings for limits that are or were reached, each with the key to change.
fn limits(health: &Health) -> Vec<Finding> {
    let full = |limit: &&Limit| limit.reached > 0 || (limit.cap > 0 && limit.used >= limit.cap);
    let full = health.limits.iter().filter(full);
    full.map(|limit| {
        let Limit {
            limit: key,
            cap,
            used,
            reached,
            at_limit,
        } = limit;
        let now = match used >= cap {
            true => "is reached",
            false => "was reached",
        };
        let sentence = match reached {
            0 => format!("limits.{key} {now}: {used} of {cap}, nothing refused so far"),
            reached => format!("limits.{key} {now} ({cap}): {reached} refused or evicted so far"),
        };
        let known = config::Limit::find(key);
        let blinds = *at_limit && known.is_some_and(config::Limit::hides_data);
        let (severity, sentence) = match blinds {
            true => (
                Severity::Problem,
                format!("{sentence}; part of the robot may be invisible"),
            ),
            false => (Severity::Warning, sentence),
        };
        let finding = Finding::new(AREA, "limits", severity, sentence);
        let finding = finding.seen(
            format!("{used} used, {reached} refused or evicted"),
            format!("{HEALTH_SOURCE} limits {key}"),
        );
        let most = known.map_or(u64::MAX, |limit| limit.row().range.1 as u64);
        let twice = cap.saturating_mul(2).min(most);
        let price = known.map_or(0, |limit| limit.row().bytes as u64);
        let price = price.saturating_mul(twice.saturating_sub(*cap)) as f64 / f64::from(1 << 20);
        finding.configure(format!(
            "limits: {{{key}: {twice}}}    # up to {price:.1} MiB more memory{}",
            match key.as_ref() {
                "participants" | "endpoints" | "unknown_writers" =>
                    "; forged participants also cause this",
                "topics" | "watches" => "; or fewer watches",
                _ => "",
            }
        ))
    })
    .collect()
}

/// Returns the findings for full tables that are not among the limits the agent reports. Older
/// agents report no limits.
fn evictions(health: &Health) -> Vec<Finding> {
    let is_reported = |table: &str| {
        let limit = limit(table);
        limit.is_some_and(|key| health.limits.iter().any(|known| known.limit == key))
    };
    let full = health.tables.iter().filter(|table| table.evictions > 0);
    let full = full.filter(|table| !is_reported(&table.table));
    let mut findings: Vec<_> = full
        .map(|table| {
            let sentence = format!(
                "the table of {} was full at {}: {} entries were evicted",
                table.table, table.limit, table.evictions
            );
            let finding = Finding::new(AREA, "evictions", Severity::Warning, sentence).seen(
                table.evictions.to_string(),
                format!("{HEALTH_SOURCE} tables {}", table.table),
            );
            match limit(&table.table) {
                Some(key) => finding.configure(format!(
                    "limits: {{{key}: {}}}    # forged writers also cause this",
                    table.limit.saturating_mul(2)
                )),
                None => finding,
            }
        })
        .collect();
    if health.topics_rejected > 0 && !is_reported("topics") {
        let sentence = format!(
            "{} watched topics exceed limits.topics and are not measured",
            health.topics_rejected
        );
        let finding = Finding::new(AREA, "topics_rejected", Severity::Warning, sentence);
        let finding = finding.seen(
            health.topics_rejected.to_string(),
            format!("{HEALTH_SOURCE} topics_rejected"),
        );
        findings.push(finding.configure("limits: {topics: N}    # or fewer watches"));
    }
    findings
}

/// Returns the configuration key of a table's limit; `None` for most tables, whose limit is fixed.
fn limit(table: &str) -> Option<&'static str> {
    const LIMIT_KEYS: [(&str, &str); 7] = [
        ("deliveries", "flows"),
        ("payloads", "payload_bytes"),
        ("participants", "participants"),
        ("endpoints", "endpoints"),
        ("topics", "topics"),
        ("unknown_writers", "unknown_writers"),
        ("reassembly", "reassembly_bytes"),
    ];
    let found = LIMIT_KEYS.iter().find(|(name, _)| *name == table);
    found.map(|(_, key)| *key)
}

fn watches(answers: &Answers) -> Finding {
    let watches = &answers.watches.watches;
    let report = |severity, sentence: String| {
        let finding = Finding::new(AREA, "watches", severity, sentence);
        finding.seen(watches.len().to_string(), "GET /watch")
    };
    if watches.is_empty() {
        let sentence = "no watches: the graph is known, but no topic is measured";
        return report(Severity::Note, sentence.to_owned())
            .configure("watch: ['/**']    # or: curl -X POST localhost:17401/watch/TOPIC");
    }
    let idle: Vec<_> = watches
        .iter()
        .filter(|watch| watch.state == WatchState::Waiting)
        .map(|watch| watch.topic.as_str())
        .collect();
    match idle.len() {
        0 => report(
            Severity::Ok,
            match watches.len() {
                1 => "1 watch, matching a topic".to_owned(),
                count => format!("{count} watches, each matching a topic"),
            },
        ),
        count => {
            let named: Vec<_> = idle.iter().take(MAX_NAMED_WATCHES).copied().collect();
            let more = match count.saturating_sub(MAX_NAMED_WATCHES) {
                0 => String::new(),
                more => format!(" and {more} more"),
            };
            let sentence = format!(
                "no topic matches the watches {} yet{more}",
                named.join(", ")
            );
            report(Severity::Note, sentence).remedy("rp topic list    # check the name")
        }
    }
}

/// Returns the findings about connections of Zenoh that cannot be read.
fn zenoh(health: &Health) -> Vec<Finding> {
    let mut abilities = health.abilities.iter();
    let is_counted = abilities.any(|ability| ability.ability == "inside" && ability.able);
    let unseen = health.zenoh.iter().flat_map(|zenoh| &zenoh.unseen);
    let findings = unseen.map(|unseen| {
        let connections = counted(unseen.connections, "connection");
        let which = format!("{connections} of Zenoh {}", unseen.text);
        let finding = |severity, sentence| {
            let count = unseen.connections.to_string();
            let source = format!("{HEALTH_SOURCE} zenoh.unseen");
            Finding::new(AREA, "zenoh", severity, sentence).seen(count, source)
        };
        match &*unseen.reason {
            "shared_memory" => {
                let sentence =
                    format!("payloads of {which} cannot be read; rates and sizes are right");
                finding(Severity::Note, sentence)
            }
            _ if is_counted => {
                let sentence =
                    format!("{which} cannot be read; messages are counted inside the processes");
                finding(Severity::Note, sentence)
            }
            _ => finding(Severity::Warning, format!("{which} cannot be read"))
                .configure("capture: {inside: topics}    # counts them inside the processes"),
        }
    });
    findings.collect()
}

/// Returns the finding for the listener for viewers: its address, their rights and their number.
fn foxglove(listener: &Foxglove) -> Finding {
    let Foxglove {
        address,
        reason,
        access,
        clients,
    } = listener;
    if let Some(reason) = reason {
        let sentence = format!("Foxglove viewers cannot connect to {address}: {reason}");
        return Finding::new(AREA, "foxglove", Severity::Warning, sentence)
            .seen(reason, format!("{HEALTH_SOURCE} foxglove"))
            .remedy("sudo ss -ltnp    # lists the programs that listen")
            .configure("foxglove: {listen: 127.0.0.1:PORT}    # another one, or off");
    }
    let rights = match access.as_deref() {
        None => "every viewer needs a token",
        Some("all") => "all local users receive messages",
        Some(_) => "messages need a token (rp foxglove)",
    };
    let connected = match clients.as_slice() {
        [] => "none is connected".to_owned(),
        [only] => format!(
            "one is connected, with {} subscriptions",
            only.subscriptions
        ),
        several => format!("{} are connected", several.len()),
    };
    let sentence = format!("Foxglove viewers may open {address}: {rights}; {connected}");
    let slow = clients.iter().filter(|client| client.dropped_messages > 0);
    let slow: Vec<_> = slow
        .map(|client| {
            let place = client.address.as_deref().unwrap_or("unknown");
            format!("{place}: {} messages dropped", client.dropped_messages)
        })
        .collect();
    let finding = match slow.is_empty() {
        true => Finding::new(AREA, "foxglove", Severity::Ok, sentence),
        false => {
            let sentence = format!("{sentence}; some read too slowly and lose messages");
            Finding::new(AREA, "foxglove", Severity::Note, sentence).seen(
                slow.join(", "),
                format!("{HEALTH_SOURCE} foxglove clients dropped_messages"),
            )
        }
    };
    finding.seen(
        clients.len().to_string(),
        format!("{HEALTH_SOURCE} foxglove clients"),
    )
}

fn kept_watches_finding(health: &Health) -> Finding {
    let finding = if health.watches_kept {
        let sentence = "state is kept across restarts";
        Finding::new(AREA, "state", Severity::Ok, sentence)
    } else {
        let sentence = "no usable state directory (not writable, or written by a newer rp): a \
            restart loses names and added watches";
        Finding::new(AREA, "state", Severity::Warning, sentence)
            .remedy("sudo mkdir -p /var/lib/ros2probe    # or the unit's StateDirectory=ros2probe")
            .elsewhere("--volume ros2probe-state:/var/lib/ros2probe    # docker run")
    };
    finding.seen(
        health.watches_kept.to_string(),
        format!("{HEALTH_SOURCE} watches_kept"),
    )
}

/// Returns the findings for listen addresses that are already in use.
fn ports(host: &HostState, config: &Config) -> Vec<Finding> {
    let wanted = [
        ("metrics.listen", config.metrics.listen),
        ("api.listen", config.api.listen),
    ];
    let taken = listening(host);
    let wanted = wanted
        .into_iter()
        .filter_map(|(key, address)| Some((key, address?)));
    wanted
        .filter(|(_, address)| taken.contains(&address.port()))
        .map(|(key, address)| port_in_use_finding(key, address))
        .collect()
}

/// Returns the findings for listen addresses that no interface has.
#[must_use]
pub fn absent_addresses(host: &HostState, config: &Config) -> Vec<Finding> {
    let Some(local) = local_addresses(host) else {
        return Vec::new();
    };
    let wanted = [
        ("metrics.listen", config.metrics.listen),
        ("api.listen", config.api.listen),
        ("foxglove.listen", config.foxglove.listen),
    ];
    let wanted = wanted
        .into_iter()
        .filter_map(|(key, address)| Some((key, address?.ip().to_canonical())));
    let absent = wanted.filter(|(_, address)| {
        !address.is_unspecified() && !address.is_loopback() && !local.contains(address)
    });
    absent
        .map(|(key, address)| {
            let sentence = format!(
                "no interface has the address {address} of {key}: clients reach it once one has"
            );
            Finding::new(AREA, "addresses", Severity::Warning, sentence)
                .seen(address.to_string(), ADDRESS_TABLES.join(", "))
                .remedy("ip -brief address    # lists the addresses of this host")
        })
        .collect()
}

/// Returns the findings for tokens that are sent without encryption.
#[must_use]
pub fn readable_tokens(config: &Config) -> Vec<Finding> {
    let tokens = config.readable_tokens().into_iter();
    tokens
        .map(|token| {
            let remedy = format!("# in the configuration: {}: https://...", token.address);
            Finding::new(AREA, "tokens", Severity::Warning, token.to_string())
                .seen(token.host, token.address)
                .remedy(remedy)
        })
        .collect()
}

/// Returns the addresses of this host's interfaces; `None` if the kernel does not list them.
fn local_addresses(host: &HostState) -> Option<BTreeSet<IpAddr>> {
    let [fourth, sixth] = ADDRESS_TABLES;
    let trie = host.files.bytes(fourth, MAX_SOCKETS).ok()?;
    let (mut addresses, mut last) = (BTreeSet::new(), None::<IpAddr>);
    for line in String::from_utf8_lossy(&trie).lines() {
        match line.trim_start().strip_prefix("|-- ") {
            Some(address) => last = address.parse().ok(),
            None if line.trim_start() == "/32 host LOCAL" => addresses.extend(last),
            None => {}
        }
    }
    // A host without IPv6 has no such file.
    let listed = host.files.bytes(sixth, MAX_SOCKETS).unwrap_or_default();
    let listed = String::from_utf8_lossy(&listed);
    addresses.extend(listed.lines().filter_map(|line| {
        let digits = line.split_whitespace().next()?;
        Some(IpAddr::V6(u128::from_str_radix(digits, 16).ok()?.into()))
    }));
    Some(addresses)
}

fn port_in_use_finding(key: &str, address: SocketAddr) -> Finding {
    let port = address.port();
    let sentence = format!("port {port} is in use by another program: the agent would not start");
    let finding = Finding::new(AREA, "ports", Severity::Problem, sentence);
    let finding = finding.seen(port.to_string(), SOCKET_TABLES.join(", "));
    finding
        .remedy(format!(
            "sudo ss -ltnp 'sport = :{port}'    # names the program"
        ))
        .configure(key.replace('.', ": {") + ": 127.0.0.1:PORT}    # a free port")
}

fn listening(host: &HostState) -> Vec<u16> {
    let mut ports = Vec::new();
    for path in SOCKET_TABLES {
        let bytes = host.files.bytes(path, MAX_SOCKETS).unwrap_or_default();
        let text = String::from_utf8_lossy(&bytes);
        ports.extend(text.lines().skip(1).filter_map(|line| {
            // The fields are number, local address and port in hexadecimal, remote address and
            // port, state.
            let mut fields = line.split_whitespace();
            let (_, port) = fields.nth(1)?.rsplit_once(':')?;
            (fields.nth(1)? == LISTENING_STATE).then(|| u16::from_str_radix(port, 16).ok())?
        }));
    }
    ports
}

/// Returns the finding for a state directory that an agent could not write.
fn state_directory(host: &HostState, choice: &StateChoice) -> Option<Finding> {
    let path = match choice {
        StateChoice::Off => return None,
        StateChoice::At(path) => path.display().to_string(),
        StateChoice::Auto => STATE_DIRECTORY.to_owned(),
    };
    let report = |severity, sentence: String| Finding::new(AREA, "state", severity, sentence);
    let finding = match fs::metadata(host.files.path(&path)) {
        Ok(directory) if !directory.is_dir() => report(
            Severity::Problem,
            format!("{path} is not a directory: the agent cannot save its state"),
        )
        .configure(format!(
            "state_directory: {path}    # must name a directory"
        )),
        Ok(directory) => {
            let is_mine = host.is_root() || directory.uid() == host.user_id;
            let mode = directory.permissions().mode() & 0o7777;
            let report = match is_mine || mode & 0o002 != 0 {
                true => report(Severity::Ok, format!("{path} is writable for saved state")),
                false => report(
                    Severity::Note,
                    format!("an agent run by this user could not save its state in {path}"),
                )
                .remedy("sudo rp run    # or the service"),
            };
            report.seen(format!("mode {mode:o}, user {}", directory.uid()), &path)
        }
        Err(error) => report(
            Severity::Note,
            format!(
                "{path} does not exist: an agent started by hand keeps no state across \
                restarts"
            ),
        )
        .seen(error.to_string(), &path)
        .remedy(format!(
            "sudo mkdir -p {path}    # the service creates its own"
        )),
    };
    Some(finding)
}

/// Returns a duration in whole seconds, minutes, hours or days.
fn duration(seconds: f64) -> String {
    match seconds {
        seconds if seconds < 120.0 => format!("{seconds:.0} s"),
        seconds if seconds < 7_200.0 => format!("{:.0} min", seconds / 60.0),
        seconds if seconds < 172_800.0 => format!("{:.0} h", seconds / 3_600.0),
        seconds => format!("{:.0} days", seconds / 86_400.0),
    }
}

#[cfg(test)]
mod tests;
