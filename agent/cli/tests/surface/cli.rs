//! The command line: its output, its errors, and its end.

use std::fs::Permissions;
use std::net::TcpListener;
use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _};
use std::os::unix::net::UnixDatagram;
use std::path::PathBuf;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use crate::rp;
use ros2probe_capture::tcx;
use ros2probe_testing::local_agent::{LocalAgent, PATIENCE, capture, metric, promtool};

fn run(arguments: &[&str]) -> Output {
    rp().args(arguments).output().unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

fn file(directory: &tempfile::TempDir, name: &str, text: &str) -> PathBuf {
    let path = directory.path().join(name);
    std::fs::write(&path, text).unwrap();
    path
}

/// Asserts that a command fails with one line that has these parts, without a backtrace, and with
/// this exit code.
fn fails_with(output: &Output, code: i32, parts: &[&str]) {
    let printed = stderr(output);
    assert_eq!(output.status.code(), Some(code), "{printed}");
    assert_eq!(printed.lines().count(), 1, "{printed}");
    for part in parts {
        assert!(printed.contains(part), "`{part}` is not in {printed}");
    }
}

#[test]
fn a_valid_configuration_is_reported_as_valid() {
    let shipped = concat!(env!("CARGO_MANIFEST_DIR"), "/../../config/ros2probe.yaml");
    let output = run(&["check-config", shipped]);
    assert!(output.status.success());
    assert!(
        String::from_utf8(output.stdout)
            .unwrap()
            .contains("is valid")
    );
}

#[test]
fn a_broken_configuration_is_reported_line_by_line_and_prevents_the_start() {
    let directory = tempfile::tempdir().unwrap();
    let path = file(&directory, "bad.yaml", "watch:\n  - points\nlgo: info\n");
    let path = path.to_str().unwrap();
    for arguments in [&["check-config", path][..], &["run", "--config", path]] {
        let output = run(arguments);
        assert_eq!(output.status.code(), Some(78));
        assert_eq!(
            stderr(&output),
            format!(
                "{path}:2:5: watch[0]: must begin with a slash, as in `/points`\n\
                 {path}:3:1: lgo: unknown key; did you mean `log`?\n"
            )
        );
    }
}

#[test]
fn missing_files_are_named() {
    fails_with(
        &run(&["check-config", "/nowhere.yaml"]),
        78,
        &["/nowhere.yaml", "No such file"],
    );
    fails_with(
        &run(&["run", "--config", "/nowhere.yaml"]),
        78,
        &["/nowhere.yaml"],
    );
    fails_with(
        &run(&["run", "--replay", "/nowhere.pcap"]),
        1,
        &["/nowhere.pcap", "No such file"],
    );
    let text = concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml");
    fails_with(&run(&["run", "--replay", text]), 1, &["not a capture"]);
}

#[test]
fn a_busy_port_is_reported_with_the_key_that_changes_it() {
    let busy = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = busy.local_addr().unwrap().to_string();
    let capture = capture();
    let output = run(&[
        "run",
        "--replay",
        capture.to_str().unwrap(),
        "--metrics",
        &address,
    ]);
    fails_with(
        &output,
        1,
        &[&address, "metrics.listen", "--metrics", "in use"],
    );
    let output = run(&[
        "run",
        "--replay",
        capture.to_str().unwrap(),
        "--metrics",
        "off",
        "--api",
        &address,
    ]);
    fails_with(&output, 1, &[&address, "api.listen", "--api", "in use"]);
}

#[test]
fn without_privileges_the_error_has_the_missing_capabilities_and_the_command() {
    // The build directory may not be readable for other users.
    let directory = tempfile::tempdir().unwrap();
    let program = directory.path().join("rp");
    std::fs::copy(env!("CARGO_BIN_EXE_rp"), &program).unwrap();
    for path in [directory.path(), &program] {
        std::fs::set_permissions(path, Permissions::from_mode(0o755)).unwrap();
    }
    let mut command = Command::new("setpriv");
    if std::fs::metadata("/proc/self").unwrap().uid() == 0 {
        command.args(["--reuid=65534", "--regid=65534", "--clear-groups"]);
    }
    let output = command
        .args(["--inh-caps=-all"])
        .arg(&program)
        .arg("run")
        .output()
        .unwrap();
    let program = program.to_str().unwrap();
    if tcx::is_supported() {
        let grant = format!("sudo setcap cap_net_admin,cap_bpf,cap_perfmon+ep {program}");
        let either = "CAP_NET_ADMIN, CAP_BPF, CAP_PERFMON for the source `host` or `wire`";
        return fails_with(&output, 77, &[either, &grant]);
    }
    let grant = format!("sudo setcap cap_net_admin,cap_bpf,cap_perfmon,cap_net_raw+ep {program}");
    let host = "CAP_NET_ADMIN, CAP_BPF, CAP_PERFMON for the source `host`";
    let wire = "CAP_NET_RAW, CAP_BPF, CAP_PERFMON for the source `wire`";
    fails_with(&output, 77, &[host, wire, &grant]);
}

#[test]
fn a_report_consists_of_the_metrics_page() {
    let capture = capture();
    let output = run(&[
        "run",
        "--replay",
        capture.to_str().unwrap(),
        "--report",
        "--watch",
        "/**",
    ]);
    assert!(output.status.success(), "{}", stderr(&output));
    let page = String::from_utf8(output.stdout).unwrap();
    assert_eq!(promtool(&page), "");
    assert_eq!(
        metric(
            &page,
            "ros2probe_capture_source_info{source=\"replay\",reason=\"\"}"
        ),
        Some(1.0)
    );
    let packets = metric(
        &page,
        "ros2probe_capture_packets_total{interface=\"replay\"}",
    );
    assert_eq!(packets, Some(620.0));
    for (topic, messages, bytes) in [
        ("/chatter", 30.0, None),
        ("/robot1/points", 4.0, Some(2_576_592.0)),
    ] {
        let labels = format!("{{domain_id=\"0\",topic=\"{topic}\"}}");
        let counter = |name: &str| metric(&page, &format!("ros2_topic_{name}_total{labels}"));
        assert_eq!(counter("messages"), Some(messages), "{topic}\n{page}");
        assert_eq!(counter("lost_messages"), Some(0.0), "{topic}\n{page}");
        assert!(
            bytes.is_none() || counter("bytes") == bytes,
            "{topic}\n{page}"
        );
    }
    assert!(page.contains("ros2_node_info{domain_id=\"0\",ros_node=\"/robot2/cloud_sink\""));
}

#[test]
fn a_cut_capture_is_reported_up_to_the_cut_and_fails() {
    let directory = tempfile::tempdir().unwrap();
    let whole = std::fs::read(capture()).unwrap();
    let path = directory.path().join("cut.pcap.gz");
    std::fs::write(&path, &whole[..whole.len() / 2]).unwrap();
    let output = run(&["run", "--replay", path.to_str().unwrap(), "--report"]);
    fails_with(&output, 1, &["the rest of the capture is unreadable"]);
    let page = String::from_utf8(output.stdout).unwrap();
    let packets = metric(
        &page,
        "ros2probe_capture_packets_total{interface=\"replay\"}",
    );
    assert!(packets > Some(10.0), "{page}");
}

#[test]
fn invalid_options_are_refused_with_a_reason() {
    for (arguments, message) in [
        (&["run", "--report"][..], "--replay"),
        (&["run", "--watch", "points"], "must begin with a slash"),
        (
            &["run", "--metrics", "17400"],
            "must be an IP address and port",
        ),
        (
            &["run", "--replay", "x", "--speed", "fast"],
            "a speed is a number",
        ),
    ] {
        let output = run(arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        assert!(stderr(&output).contains(message), "{}", stderr(&output));
    }
}

#[test]
fn the_printed_version_equals_the_version_of_the_package() {
    let output = run(&["--version"]);
    let version = concat!("rp ", env!("CARGO_PKG_VERSION"), "\n");
    assert_eq!(String::from_utf8(output.stdout).unwrap(), version);
}

#[test]
fn a_signal_ends_the_agent_in_order_and_is_logged() {
    for signal in ["-TERM", "-INT"] {
        let mut agent = LocalAgent::start(&mut rp(), &[]);
        agent.wait_for_log("ready");
        agent.signal(signal);
        assert!(agent.wait().success());
        let line = agent.wait_for_log("ended");
        assert!(line.contains(&format!("SIG{}", &signal[1..])), "{line}");
        assert!(line.contains("drained=true"), "{line}");
    }
}

#[test]
fn the_service_manager_is_notified_of_start_progress_reload_and_stop() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("notify");
    let socket = UnixDatagram::bind(&path).unwrap();
    socket.set_read_timeout(Some(PATIENCE)).unwrap();
    let read_line = || {
        let mut buffer = [0; 512];
        let length = socket.recv(&mut buffer).unwrap();
        String::from_utf8_lossy(&buffer[..length]).into_owned()
    };
    let wait_for = |wanted: &str| while !read_line().contains(wanted) {};

    let config = file(&directory, "c.yaml", "watch: [/a]\n");
    let mut command = rp();
    command
        .env("NOTIFY_SOCKET", &path)
        .env("WATCHDOG_USEC", "1500000");
    let mut agent = LocalAgent::start(&mut command, &["--config", config.to_str().unwrap()]);
    wait_for("READY=1");
    wait_for("WATCHDOG=1");
    wait_for("WATCHDOG=1");
    agent.signal("-HUP");
    wait_for("RELOADING=1");
    wait_for("READY=1");
    agent.signal("-TERM");
    wait_for("STOPPING=1");
    assert!(agent.wait().success());
}

#[test]
fn a_pipe_instead_of_a_file_is_refused_without_waiting() {
    let directory = tempfile::tempdir().unwrap();
    let pipe = |name: &str| {
        let path = directory.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        let made = Command::new("mkfifo").arg(&path).status();
        assert!(made.unwrap().success());
        path.to_str().unwrap().to_owned()
    };
    let metadata = pipe("described/metadata.yaml");
    let described = metadata.trim_end_matches("/metadata.yaml");
    let file = pipe("bare/bag_0.mcap");
    let bare = file.trim_end_matches("/bag_0.mcap");
    let compressed = pipe("bag_0.mcap.zstd");
    let configuration = pipe("ros2probe.yaml");
    let storage = pipe("storage.yaml");
    for arguments in [
        &["bag", "info", described][..],
        &["bag", "info", &file],
        &["bag", "info", &compressed],
        &["bag", "reindex", bare],
        &["check-config", &configuration],
        &["run", "--config", &configuration],
        &["discover", "--config", &configuration],
        &["doctor", "--config", &configuration],
        &[
            "bag",
            "record",
            "--storage-config-file",
            &storage,
            "/chatter",
        ],
    ] {
        let mut rp = rp();
        rp.args(arguments).current_dir(directory.path());
        let (output, time) = within(rp, Duration::from_secs(60));
        let printed = String::from_utf8_lossy(&output.stderr);
        let printed = printed.into_owned() + &String::from_utf8_lossy(&output.stdout);
        println!("{arguments:?} after {time:?}: {printed}");
        assert!(!output.status.success(), "{arguments:?}: {printed}");
        assert!(
            printed.contains("not a regular file"),
            "{arguments:?}: {printed}"
        );
    }
}

/// Runs a command, and kills it if it takes longer.
fn within(mut command: Command, most: Duration) -> (Output, Duration) {
    let begin = Instant::now();
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    while child.try_wait().unwrap().is_none() && begin.elapsed() < most {
        std::thread::sleep(Duration::from_millis(20));
    }
    child.kill().unwrap();
    (child.wait_with_output().unwrap(), begin.elapsed())
}

#[test]
fn rp_without_a_command_prints_what_to_do_next_and_all_commands() {
    let output = run(&[]);
    assert!(output.status.success(), "{output:?}");
    let text = String::from_utf8(output.stdout).unwrap();
    let (steps, commands) = text.split_once("\n\n").unwrap();
    let mut lines = steps.lines();
    let sentence = lines.next().unwrap();
    assert!(
        sentence.contains("agent") && sentence.ends_with('.'),
        "{text}"
    );
    assert!(lines.all(|line| line.starts_with("  ")), "{text}");
    assert!(steps.lines().count() <= 6, "{text}");
    assert!(
        commands.contains("Usage: rp") && commands.contains("  ci "),
        "{text}"
    );
}

#[test]
fn doctor_changes_nothing_without_root_and_without_an_answer() {
    let mut command = Command::new("setpriv");
    command
        .args(["--reuid=65534", "--regid=65534", "--clear-groups"])
        .arg(env!("CARGO_BIN_EXE_rp"))
        .args(["doctor", "--fix", "--yes"]);
    let output = command.stdin(Stdio::null()).output().unwrap();
    fails_with(&output, 1, &["run `sudo rp doctor --fix`"]);
    let output = run(&["doctor", "--fix"]);
    fails_with(&output, 1, &["is not a terminal: pass --yes"]);
    for other in [["--json", "--fix"], ["--yes", "--verbose"]] {
        let output = run(&["doctor", other[0], other[1]]);
        assert_eq!(output.status.code(), Some(2), "{output:?}");
    }
}
