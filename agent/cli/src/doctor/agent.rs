//! The agent itself: whether it answers, sees, loses nothing and keeps what it knows; where none
//! runs, what would keep it from starting.

use std::fs;
use std::net::SocketAddr;
use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _};
use std::path::Path;

use super::answers::Answers;
use super::finding::{Area, Finding, Verdict};
use super::host_state::HostState;
use super::privileges::is_installed;
use ros2probe_api::health::{Health, Limit};
use ros2probe_api::watches::WatchState;
use ros2probe_daemon::config::{self, Config, StateChoice};

const AREA: Area = Area::Agent;
const FROM: &str = "GET /health";
/// Where the package puts what is kept.
const STATE: &str = "/var/lib/ros2probe";
const SOCKETS: [&str; 2] = ["/proc/net/tcp", "/proc/net/tcp6"];
/// State of a listening socket in those files.
const LISTENING: &str = "0A";
/// Bytes of those files that are read.
const MAX_SOCKETS: u64 = 8 << 20;
/// Watches that are named.
const NAMED: usize = 5;

/// One that answers.
#[must_use]
pub fn check(answers: &Answers, place: &str, own_version: &str) -> Vec<Finding> {
    let health = &answers.health;
    let mut findings = vec![running(health, place), version(health, own_version)];
    findings.extend(losses(health));
    findings.extend(limits(health));
    findings.extend(evictions(health));
    findings.push(watches(answers));
    if health.source != "replay" {
        findings.push(kept(health));
    }
    findings
}

/// None that answers, for this reason.
#[must_use]
pub fn absent(host: &HostState, config: &Config, reason: &str, is_denied: bool) -> Vec<Finding> {
    let finding = if is_denied {
        let sentence = "an agent is running, but this user may not query it";
        Finding::new(AREA, "reachable", Verdict::Unknown, sentence)
            .seen(reason, "connect(2)")
            .remedy("sudo rp doctor    # or: sudo usermod -aG ros2probe $USER, and log in again")
    } else {
        let sentence = "no agent answers: nothing is observed and the graph is unknown";
        Finding::new(AREA, "reachable", Verdict::Warning, sentence)
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

/// A configuration that an agent would not start with.
#[must_use]
pub fn misconfigured(path: &Path, mistakes: &str) -> Finding {
    let first = mistakes.lines().next().unwrap_or_default();
    let count = mistakes.lines().count();
    let more = if count > 1 {
        format!(" (and {} more)", count - 1)
    } else {
        String::new()
    };
    let sentence = format!("the configuration is wrong: {first}{more}");
    let finding = Finding::new(AREA, "configuration", Verdict::Problem, sentence);
    let finding = finding.seen(mistakes, path.display().to_string());
    finding.remedy("rp check-config    # prints all mistakes")
}

fn running(health: &Health, place: &str) -> Finding {
    let since = health
        .uptime_seconds
        .map_or_else(String::new, |up| format!(", up {}", duration(up)));
    let finding = if health.ready {
        let sentence = format!("the agent is running and sees traffic{since}");
        Finding::new(AREA, "ready", Verdict::Ok, sentence).seen("true", format!("{FROM} ready"))
    } else {
        let reason = health.reason.as_deref().unwrap_or("it gives no reason");
        let sentence = format!("the agent is running but sees nothing: {reason}");
        Finding::new(AREA, "ready", Verdict::Problem, sentence)
            .seen(reason, format!("{FROM} reason"))
            .remedy("journalctl -u ros2probe -e")
    };
    finding.seen(place, "this connection")
}

fn version(health: &Health, own: &str) -> Finding {
    let finding = if health.version == own {
        Finding::new(
            AREA,
            "version",
            Verdict::Ok,
            format!("version {own}, same as this rp"),
        )
    } else {
        let sentence = format!(
            "the agent is version {}, this rp is version {own}",
            health.version
        );
        Finding::new(AREA, "version", Verdict::Note, sentence)
            .remedy("sudo systemctl restart ros2probe    # starts the installed version")
    };
    finding.seen(health.version.as_ref(), format!("{FROM} version"))
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
            Finding::new(AREA, check, Verdict::Warning, sentence)
                .seen(count.to_string(), format!("{FROM} {check}"))
                .configure(format!(
                    "capture: {{{ring}: BYTES}}    # double it; a power of two"
                ))
        })
        .collect();
    if findings.is_empty() {
        let finding = Finding::new(
            AREA,
            "losses",
            Verdict::Ok,
            "no packets or records lost by the agent",
        );
        findings.push(finding.seen("0", format!("{FROM} dropped_*")));
    }
    findings
}

/// Caps of the configuration that are or were reached, each with the line to change.
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
        let blinds = *at_limit && known.is_some_and(config::Limit::blinds);
        let (verdict, sentence) = match blinds {
            true => (
                Verdict::Problem,
                format!("{sentence}; part of the robot may not be seen"),
            ),
            false => (Verdict::Warning, sentence),
        };
        let finding = Finding::new(AREA, "limits", verdict, sentence);
        let finding = finding.seen(
            format!("{used} used, {reached} refused or evicted"),
            format!("{FROM} limits {key}"),
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

/// Tables that have no key in the configuration; of an agent that tells no limits, all of them.
fn evictions(health: &Health) -> Vec<Finding> {
    let is_told = |table: &str| {
        let limit = limit(table);
        limit.is_some_and(|key| health.limits.iter().any(|told| told.limit == key))
    };
    let full = health.tables.iter().filter(|table| table.evictions > 0);
    let full = full.filter(|table| !is_told(&table.table));
    let mut findings: Vec<_> = full
        .map(|table| {
            let sentence = format!(
                "its table of {} was full at {}: {} entries were evicted",
                table.table, table.limit, table.evictions
            );
            let finding = Finding::new(AREA, "evictions", Verdict::Warning, sentence).seen(
                table.evictions.to_string(),
                format!("{FROM} tables {}", table.table),
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
    if health.topics_rejected > 0 && !is_told("topics") {
        let sentence = format!(
            "{} watched topics exceed limits.topics and are not measured",
            health.topics_rejected
        );
        let finding = Finding::new(AREA, "topics_rejected", Verdict::Warning, sentence);
        let finding = finding.seen(
            health.topics_rejected.to_string(),
            format!("{FROM} topics_rejected"),
        );
        findings.push(finding.configure("limits: {topics: N}    # or fewer watches"));
    }
    findings
}

/// The key of a table's limit; most have none.
fn limit(table: &str) -> Option<&'static str> {
    const KEYS: [(&str, &str); 7] = [
        ("deliveries", "flows"),
        ("payloads", "payload_bytes"),
        ("participants", "participants"),
        ("endpoints", "endpoints"),
        ("topics", "topics"),
        ("unknown_writers", "unknown_writers"),
        ("reassembly", "reassembly_bytes"),
    ];
    let found = KEYS.iter().find(|(name, _)| *name == table);
    found.map(|(_, key)| *key)
}

fn watches(answers: &Answers) -> Finding {
    let watches = &answers.watches.watches;
    let report = |verdict, sentence: String| {
        let finding = Finding::new(AREA, "watches", verdict, sentence);
        finding.seen(watches.len().to_string(), "GET /watch")
    };
    if watches.is_empty() {
        let sentence = "no watches: the graph is known, but no topic is measured";
        return report(Verdict::Note, sentence.to_owned())
            .configure("watch: ['/**']    # or: curl -X POST localhost:17401/watch/TOPIC");
    }
    let idle: Vec<_> = watches
        .iter()
        .filter(|watch| watch.state == WatchState::Waiting)
        .map(|watch| watch.topic.as_str())
        .collect();
    match idle.len() {
        0 => report(
            Verdict::Ok,
            match watches.len() {
                1 => "1 watch, matching a topic".to_owned(),
                count => format!("{count} watches, each matching a topic"),
            },
        ),
        count => {
            let named: Vec<_> = idle.iter().take(NAMED).copied().collect();
            let more = match count.saturating_sub(NAMED) {
                0 => String::new(),
                more => format!(" and {more} more"),
            };
            let sentence = format!(
                "no topic matches the watches {} yet{more}",
                named.join(", ")
            );
            report(Verdict::Note, sentence).remedy("rp topic list    # check the name")
        }
    }
}

fn kept(health: &Health) -> Finding {
    let finding = if health.watches_kept {
        let sentence = "state is kept across restarts";
        Finding::new(AREA, "state", Verdict::Ok, sentence)
    } else {
        let sentence = "no usable state directory (not writable, or written by a newer rp): a \
            restart loses names and added watches";
        Finding::new(AREA, "state", Verdict::Warning, sentence)
            .remedy("sudo mkdir -p /var/lib/ros2probe    # or the unit's StateDirectory=ros2probe")
    };
    finding.seen(
        health.watches_kept.to_string(),
        format!("{FROM} watches_kept"),
    )
}

/// Listeners that an agent would find taken.
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
        .map(|(key, address)| busy(key, address))
        .collect()
}

fn busy(key: &str, address: SocketAddr) -> Finding {
    let port = address.port();
    let sentence = format!("port {port} is in use by another program: the agent would not start");
    let finding = Finding::new(AREA, "ports", Verdict::Problem, sentence);
    let finding = finding.seen(port.to_string(), SOCKETS.join(", "));
    finding
        .remedy(format!("sudo ss -ltnp 'sport = :{port}'    # who"))
        .configure(key.replace('.', ": {") + ": 127.0.0.1:PORT}    # another one")
}

fn listening(host: &HostState) -> Vec<u16> {
    let mut ports = Vec::new();
    for path in SOCKETS {
        let bytes = host.files.bytes(path, MAX_SOCKETS).unwrap_or_default();
        let text = String::from_utf8_lossy(&bytes);
        ports.extend(text.lines().skip(1).filter_map(|line| {
            // Number, local address and port in hexadecimal, remote ones, state.
            let mut fields = line.split_whitespace();
            let (_, port) = fields.nth(1)?.rsplit_once(':')?;
            (fields.nth(1)? == LISTENING).then(|| u16::from_str_radix(port, 16).ok())?
        }));
    }
    ports
}

/// Whether an agent could write where it keeps what it knows.
fn state_directory(host: &HostState, choice: &StateChoice) -> Option<Finding> {
    let path = match choice {
        StateChoice::Off => return None,
        StateChoice::At(path) => path.display().to_string(),
        StateChoice::Auto => STATE.to_owned(),
    };
    let report = |verdict, sentence: String| Finding::new(AREA, "state", verdict, sentence);
    let finding = match fs::metadata(host.files.path(&path)) {
        Ok(directory) if !directory.is_dir() => report(
            Verdict::Problem,
            format!("{path} is not a directory: the agent cannot save its state"),
        )
        .configure(format!(
            "state_directory: {path}    # must name a directory"
        )),
        Ok(directory) => {
            let is_mine = host.is_root() || directory.uid() == host.user_id;
            let mode = directory.permissions().mode() & 0o7777;
            let report = match is_mine || mode & 0o002 != 0 {
                true => report(Verdict::Ok, format!("{path} is writable for saved state")),
                false => report(
                    Verdict::Note,
                    format!("an agent run by this user could not save its state in {path}"),
                )
                .remedy("sudo rp run    # or the service"),
            };
            report.seen(format!("mode {mode:o}, user {}", directory.uid()), &path)
        }
        Err(error) => report(
            Verdict::Note,
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

/// Whole seconds, minutes, hours or days.
fn duration(seconds: f64) -> String {
    match seconds {
        seconds if seconds < 120.0 => format!("{seconds:.0} s"),
        seconds if seconds < 7_200.0 => format!("{:.0} min", seconds / 60.0),
        seconds if seconds < 172_800.0 => format!("{:.0} h", seconds / 3_600.0),
        seconds => format!("{:.0} days", seconds / 86_400.0),
    }
}

#[cfg(test)]
mod tests {
    use super::super::host_state::tests::host;
    use super::*;

    fn answers(health: &str, watches: &str) -> Answers {
        Answers {
            health: serde_json::from_str(health).unwrap(),
            watches: serde_json::from_str(watches).unwrap(),
            ..Answers::default()
        }
    }

    fn verdict(findings: &[Finding], check: &str) -> Option<Verdict> {
        let found = findings.iter().find(|finding| finding.check == check);
        found.map(|finding| finding.verdict)
    }

    const WELL: &str = r#"{"ready":true,"version":"1.0.0","source":"host","watches_kept":true,
        "uptime_seconds":7300}"#;
    const WATCHED: &str = r#"{"watches":[{"topic":"/a","state":"measuring"}]}"#;

    #[test]
    fn an_agent_that_is_well_is_fine_in_everything() {
        let findings = check(&answers(WELL, WATCHED), "/run/api.sock", "1.0.0");
        assert!(
            findings.iter().all(|each| each.verdict == Verdict::Ok),
            "{findings:?}"
        );
        assert!(
            findings[0].sentence.ends_with("up 2 h"),
            "{}",
            findings[0].sentence
        );
    }

    #[test]
    fn what_is_wrong_with_an_agent_is_said_one_by_one() {
        let ill = r#"{"ready":false,"reason":"no packet for 30 s","version":"0.9.0",
            "source":"host","dropped_packets":5,"dropped_records":6,"topics_rejected":2,
            "tables":[{"table":"endpoints","limit":10,"evictions":3},{"table":"nodes"}]}"#;
        let watches = r#"{"watches":[{"topic":"/nobody","state":"waiting"}]}"#;
        let findings = check(&answers(ill, watches), "here", "1.0.0");
        for (check, expected) in [
            ("ready", Verdict::Problem),
            ("version", Verdict::Note),
            ("dropped_packets", Verdict::Warning),
            ("dropped_records", Verdict::Warning),
            ("evictions", Verdict::Warning),
            ("topics_rejected", Verdict::Warning),
            ("watches", Verdict::Note),
            ("state", Verdict::Warning),
        ] {
            assert_eq!(verdict(&findings, check), Some(expected), "{check}");
        }
        let full = findings.iter().find(|each| each.check == "evictions");
        let remedy = &full.unwrap().remedies[0].line;
        assert_eq!(remedy, "limits: {endpoints: 20}");
        assert!(Config::parse(remedy.as_bytes()).is_ok());
        assert_eq!(verdict(&findings, "dropped_datagrams"), None);
        assert_eq!(
            findings
                .iter()
                .filter(|each| each.check == "evictions")
                .count(),
            1
        );
    }

    #[test]
    fn a_cap_that_is_or_was_reached_is_a_warning_with_the_line_to_change() {
        let full = r#"{"ready":true,"version":"1.0.0","source":"host","watches_kept":true,
            "topics_rejected":2,"tables":[{"table":"deliveries","limit":10,"evictions":3},
            {"table":"nodes","limit":5,"evictions":1}],
            "limits":[{"limit":"topics","cap":10,"used":10,"reached":2},
            {"limit":"flows","cap":10,"used":4,"reached":3},
            {"limit":"recordings","cap":100,"used":100,"reached":0},
            {"limit":"watches","cap":10,"used":9,"reached":0}]}"#;
        let findings = check(&answers(full, WATCHED), "here", "1.0.0");
        let of = |check: &str| {
            let found = findings.iter().filter(|each| each.check == check);
            found.map(|each| each.sentence.as_str()).collect::<Vec<_>>()
        };
        assert_eq!(
            of("limits"),
            [
                "limits.topics is reached (10): 2 refused or evicted so far",
                "limits.flows was reached (10): 3 refused or evicted so far",
                "limits.recordings is reached: 100 of 100, nothing refused so far",
            ]
        );
        assert_eq!(of("evictions").len(), 1, "told once: {findings:?}");
        assert!(of("topics_rejected").is_empty());
        for finding in findings.iter().filter(|each| each.check == "limits") {
            let line = &finding.remedies[0].line;
            assert!(Config::parse(line.as_bytes()).is_ok(), "{line}");
        }
    }

    #[test]
    fn an_agent_that_has_no_room_for_newcomers_is_a_problem_with_the_price_of_more() {
        let full = r#"{"ready":true,"version":"1.0.0","source":"host","watches_kept":true,
            "limits":[{"limit":"participants","cap":1000,"used":1000,"reached":345,"at_limit":true},
            {"limit":"topics","cap":1000,"used":900,"reached":3,"at_limit":false},
            {"limit":"recordings","cap":4,"used":4,"reached":0,"at_limit":true}]}"#;
        let findings = check(&answers(full, WATCHED), "here", "1.0.0");
        let found: Vec<_> = findings
            .iter()
            .filter(|each| each.check == "limits")
            .map(|each| (each.verdict, each.sentence.as_str()))
            .collect();
        assert_eq!(
            found,
            [
                (
                    Verdict::Problem,
                    "limits.participants is reached (1000): 345 refused or evicted so far; part of \
                     the robot may not be seen"
                ),
                (
                    Verdict::Warning,
                    "limits.topics was reached (1000): 3 refused or evicted so far"
                ),
                (
                    Verdict::Warning,
                    "limits.recordings is reached: 4 of 4, nothing refused so far"
                ),
            ]
        );
        let first = findings.iter().find(|each| each.check == "limits");
        let remedy = &first.unwrap().remedies[0];
        assert_eq!(remedy.line, "limits: {participants: 2000}");
        assert_eq!(
            remedy.comment.as_deref(),
            Some("up to 2.0 MiB more memory; forged participants also cause this")
        );
    }

    #[test]
    fn nothing_watched_is_a_note_with_the_command() {
        let findings = check(&answers(WELL, "{}"), "here", "1.0.0");
        assert_eq!(verdict(&findings, "watches"), Some(Verdict::Note));
    }

    #[test]
    fn a_port_that_is_taken_keeps_an_agent_from_starting() {
        let table = "  sl  local_address rem_address   st\n\
            0: 0100007F:43F8 00000000:0000 0A 00000000:00000000\n\
            1: 0100007F:43F9 00000000:0000 01 00000000:00000000\n";
        let (_directory, host) = host(&[("/proc/net/tcp", table)]);
        let findings = absent(&host, &Config::default(), "nobody", false);
        let busy: Vec<_> = findings
            .iter()
            .filter(|each| each.check == "ports")
            .collect();
        assert_eq!(busy.len(), 1);
        assert!(busy[0].sentence.contains("17400"), "{}", busy[0].sentence);
        assert_eq!(
            busy[0].remedies[1].line,
            "metrics: {listen: 127.0.0.1:PORT}"
        );
        assert_eq!(verdict(&findings, "reachable"), Some(Verdict::Warning));
    }

    #[test]
    fn an_agent_that_may_not_be_asked_is_unknown_and_nothing_else_is_guessed() {
        let (_directory, host) = host(&[]);
        let findings = absent(&host, &Config::default(), "permission denied", true);
        assert_eq!(findings.len(), 1);
        assert_eq!(findings[0].verdict, Verdict::Unknown);
    }

    #[test]
    fn where_state_would_be_kept_is_looked_at() {
        let (_directory, mut host) = host(&[("/var/lib/ros2probe/x", ""), ("/file", "")]);
        let of = |host: &HostState, choice| {
            state_directory(host, &choice).map(|finding| finding.verdict)
        };
        let at = |path: &str| StateChoice::At(path.into());
        assert_eq!(of(&host, StateChoice::Off), None);
        assert_eq!(of(&host, at("/nowhere")), Some(Verdict::Note));
        assert_eq!(of(&host, at("/file")), Some(Verdict::Problem));
        host.user_id = 0;
        assert_eq!(of(&host, StateChoice::Auto), Some(Verdict::Ok));
        host.user_id = 4_000_000;
        assert_eq!(of(&host, StateChoice::Auto), Some(Verdict::Note));
    }

    #[test]
    fn a_wrong_configuration_is_a_problem_with_its_first_mistake() {
        let finding = misconfigured(Path::new("/etc/x.yaml"), "x:1: bad\nx:2: worse");
        assert_eq!(finding.verdict, Verdict::Problem);
        assert_eq!(
            finding.sentence,
            "the configuration is wrong: x:1: bad (and 1 more)"
        );
    }
}
