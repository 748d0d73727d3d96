use super::super::host_state::tests::host;
use super::*;

#[test]
fn a_token_that_the_network_can_read_is_a_warning_with_its_remedy() {
    let of = |url: &str| {
        let yaml = format!("fleet: {{engine: '{url}', token_file: /token}}\n");
        readable_tokens(&Config::parse(yaml.as_bytes()).unwrap())
    };
    let found = of("http://prometheus.example:9090");
    let [finding] = &found[..] else {
        panic!("{found:?}");
    };
    assert_eq!(finding.severity, Severity::Warning);
    assert!(finding.sentence.contains("fleet.token_file"), "{finding:?}");
    assert!(of("http://127.0.0.1:9090").is_empty());
}

fn answers(health: &str, watches: &str) -> Answers {
    Answers {
        health: serde_json::from_str(health).unwrap(),
        watches: serde_json::from_str(watches).unwrap(),
        ..Answers::default()
    }
}

fn severity(findings: &[Finding], check: &str) -> Option<Severity> {
    let found = findings.iter().find(|finding| finding.check == check);
    found.map(|finding| finding.severity)
}

const WELL: &str = r#"{"ready":true,"version":"1.0.0","source":"host","watches_kept":true,
        "uptime_seconds":7300}"#;
const WATCHED: &str = r#"{"watches":[{"topic":"/a","state":"measuring"}]}"#;

#[test]
fn a_healthy_agent_passes_every_check() {
    let findings = check(&answers(WELL, WATCHED), "/run/api.sock", "1.0.0");
    assert!(
        findings.iter().all(|each| each.severity == Severity::Ok),
        "{findings:?}"
    );
    assert!(
        findings[0].sentence.ends_with("up 2 h"),
        "{}",
        findings[0].sentence
    );
}

#[test]
fn each_fault_of_an_agent_is_reported_separately() {
    let ill = r#"{"ready":false,"reason":"no packet for 30 s","version":"0.9.0",
            "source":"host","dropped_packets":5,"dropped_records":6,"topics_rejected":2,
            "tables":[{"table":"endpoints","limit":10,"evictions":3},{"table":"nodes"}]}"#;
    let watches = r#"{"watches":[{"topic":"/nobody","state":"waiting"}]}"#;
    let findings = check(&answers(ill, watches), "here", "1.0.0");
    for (check, expected) in [
        ("ready", Severity::Problem),
        ("version", Severity::Note),
        ("dropped_packets", Severity::Warning),
        ("dropped_records", Severity::Warning),
        ("evictions", Severity::Warning),
        ("topics_rejected", Severity::Warning),
        ("watches", Severity::Note),
        ("state", Severity::Warning),
    ] {
        assert_eq!(severity(&findings, check), Some(expected), "{check}");
    }
    let full = findings.iter().find(|each| each.check == "evictions");
    let remedy = &full.unwrap().remedies[0].line;
    assert_eq!(remedy, "limits: {endpoints: 20}");
    assert!(Config::parse(remedy.as_bytes()).is_ok());
    assert_eq!(severity(&findings, "dropped_datagrams"), None);
    assert_eq!(
        findings
            .iter()
            .filter(|each| each.check == "evictions")
            .count(),
        1
    );
}

#[test]
fn a_cap_that_is_or_was_reached_leads_to_a_warning_with_the_line_to_change() {
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
    assert_eq!(of("evictions").len(), 1, "reported once: {findings:?}");
    assert!(of("topics_rejected").is_empty());
    for finding in findings.iter().filter(|each| each.check == "limits") {
        let line = &finding.remedies[0].line;
        assert!(Config::parse(line.as_bytes()).is_ok(), "{line}");
    }
}

#[test]
fn an_agent_at_a_limit_of_the_graph_is_a_problem_with_the_memory_of_a_higher_limit() {
    let full = r#"{"ready":true,"version":"1.0.0","source":"host","watches_kept":true,
            "limits":[{"limit":"participants","cap":1000,"used":1000,"reached":345,"at_limit":true},
            {"limit":"topics","cap":1000,"used":900,"reached":3,"at_limit":false},
            {"limit":"recordings","cap":4,"used":4,"reached":0,"at_limit":true}]}"#;
    let findings = check(&answers(full, WATCHED), "here", "1.0.0");
    let found: Vec<_> = findings
        .iter()
        .filter(|each| each.check == "limits")
        .map(|each| (each.severity, each.sentence.as_str()))
        .collect();
    assert_eq!(
        found,
        [
            (
                Severity::Problem,
                "limits.participants is reached (1000): 345 refused or evicted so far; part of \
                     the robot may be invisible"
            ),
            (
                Severity::Warning,
                "limits.topics was reached (1000): 3 refused or evicted so far"
            ),
            (
                Severity::Warning,
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
fn unreadable_connections_of_zenoh_are_reported_with_their_reason() {
    let health = r#"{"ready":true,"version":"1.0.0","source":"host","zenoh":{"unseen":[
            {"reason":"tls","text":"encrypted with TLS","connections":1},
            {"reason":"compression","text":"with compressed batches","connections":2},
            {"reason":"shared_memory","text":"with shared memory","connections":1}]}}"#;
    let findings = check(&answers(health, WATCHED), "here", "1.0.0");
    let zenoh = findings.iter().filter(|finding| finding.check == "zenoh");
    let sentences: Vec<_> = zenoh
        .map(|finding| (finding.severity, &*finding.sentence))
        .collect();
    let (warning, note) = (Severity::Warning, Severity::Note);
    assert_eq!(
        sentences,
        [
            (
                warning,
                "1 connection of Zenoh encrypted with TLS cannot be read"
            ),
            (
                warning,
                "2 connections of Zenoh with compressed batches cannot be read"
            ),
            (
                note,
                "payloads of 1 connection of Zenoh with shared memory cannot be read; rates and \
                 sizes are right"
            ),
        ]
    );
    let counted = health.replace(
        r#""zenoh""#,
        r#""abilities":[{"ability":"inside","able":true}],"zenoh""#,
    );
    let findings = check(&answers(&counted, WATCHED), "here", "1.0.0");
    let mut zenoh = findings.iter().filter(|finding| finding.check == "zenoh");
    let first = zenoh.next().unwrap();
    assert_eq!(first.severity, note);
    assert!(first.sentence.ends_with("counted inside the processes"));
}

#[test]
fn viewers_are_shown_with_their_rights_and_a_busy_port_with_a_remedy() {
    let with = |foxglove: &str| {
        let health = WELL.replacen('{', &format!(r#"{{"foxglove":{foxglove},"#), 1);
        let findings = check(&answers(&health, WATCHED), "here", "1.0.0");
        let found = findings.into_iter().find(|each| each.check == "foxglove");
        found.unwrap()
    };
    let shown = with(r#"{"address":"ws://localhost:8765/","access":"watch"}"#);
    assert_eq!(shown.severity, Severity::Ok);
    assert_eq!(
        shown.sentence,
        "Foxglove viewers may open ws://localhost:8765/: messages need a token (rp foxglove); \
         none is connected"
    );
    let slow = with(
        r#"{"address":"ws://10.0.0.1:8765/","access":null,"clients":[
            {"address":"10.0.0.2:40000","access":"all","subscriptions":3,"dropped_messages":7}]}"#,
    );
    assert_eq!(slow.severity, Severity::Note);
    for part in [
        "every viewer needs a token",
        "with 3 subscriptions",
        "too slowly",
    ] {
        assert!(slow.sentence.contains(part), "{}", slow.sentence);
    }
    let busy = with(r#"{"address":"ws://localhost:8765/","reason":"Address already in use"}"#);
    assert_eq!(busy.severity, Severity::Warning);
    assert!(busy.sentence.ends_with("Address already in use"));
    let off = check(&answers(WELL, WATCHED), "here", "1.0.0");
    assert!(off.iter().all(|each| each.check != "foxglove"));
}

#[test]
fn an_agent_without_watches_leads_to_a_note_with_the_command() {
    let findings = check(&answers(WELL, "{}"), "here", "1.0.0");
    assert_eq!(severity(&findings, "watches"), Some(Severity::Note));
}

#[test]
fn a_port_in_use_is_reported_as_an_obstacle_to_starting_an_agent() {
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
    assert_eq!(severity(&findings, "reachable"), Some(Severity::Warning));
}

#[test]
fn a_listen_address_that_no_interface_has_is_reported() {
    let trie = "Local:\n  +-- 0.0.0.0/0 3 0 5\n     |-- 10.8.0.0\n        /24 link UNICAST\n     \
                |-- 10.8.0.2\n        /32 host LOCAL\n";
    let sixth = "fd000000000000000000000000000002 04 40 00 82     eth0\n";
    let (_directory, known) = host(&[("/proc/net/fib_trie", trie), ("/proc/net/if_inet6", sixth)]);
    let absent = |host: &HostState, address: &str| {
        let mut config = Config::default();
        config.foxglove.listen = Some(address.parse().unwrap());
        absent_addresses(host, &config).len()
    };
    for (address, count) in [
        ("10.8.0.2:8765", 0),
        ("[fd00::2]:8765", 0),
        ("127.0.0.1:8765", 0),
        ("0.0.0.0:8765", 0),
        ("10.8.0.0:8765", 1),
        ("10.8.0.20:8765", 1),
        ("[fd00::3]:8765", 1),
    ] {
        assert_eq!(absent(&known, address), count, "{address}");
    }
    let (_directory, unknown) = host(&[]);
    assert_eq!(absent(&unknown, "10.8.0.20:8765"), 0);
}

#[test]
fn an_agent_that_refuses_access_leads_to_one_unknown_finding() {
    let (_directory, host) = host(&[]);
    let findings = absent(&host, &Config::default(), "permission denied", true);
    assert_eq!(findings.len(), 1);
    assert_eq!(findings[0].severity, Severity::Unknown);
}

#[test]
fn a_missing_or_unusable_state_directory_is_reported() {
    let (_directory, mut host) = host(&[("/var/lib/ros2probe/x", ""), ("/file", "")]);
    let of =
        |host: &HostState, choice| state_directory(host, &choice).map(|finding| finding.severity);
    let at = |path: &str| StateChoice::At(path.into());
    assert_eq!(of(&host, StateChoice::Off), None);
    assert_eq!(of(&host, at("/nowhere")), Some(Severity::Note));
    assert_eq!(of(&host, at("/file")), Some(Severity::Problem));
    host.user_id = 0;
    assert_eq!(of(&host, StateChoice::Auto), Some(Severity::Ok));
    host.user_id = 4_000_000;
    assert_eq!(of(&host, StateChoice::Auto), Some(Severity::Note));
}

#[test]
fn an_invalid_configuration_is_a_problem_with_its_first_mistake() {
    let finding = misconfigured(Path::new("/etc/x.yaml"), "x:1: bad\nx:2: worse");
    assert_eq!(finding.severity, Severity::Problem);
    assert_eq!(
        finding.sentence,
        "the configuration is invalid: x:1: bad (and 1 more)"
    );
}
