//! The shipped static binaries, which are the same program for two architectures. The aarch64
//! binary runs under qemu, which has everything but BPF. `make test` covers an unoptimized build of
//! it and the tests' own `rp`. `make dist` covers the release binaries (`ROS2PROBE_DIST`).

mod elf;
pub(crate) mod program;
mod release;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use elf::{Elf, Machine};
use program::{Binary, Program};
use ros2probe_testing::local_agent::{Answer, LocalAgent, request};
use serde_json::Value;

fn data(file: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(file);
    assert!(path.exists(), "{}", path.display());
    path.to_str().unwrap().to_owned()
}

/// Returns captures of two vendors, and one with fragmented messages of which some were lost.
fn captures() -> [String; 3] {
    [
        data("../../wire/tests/data/cyclonedds-samehost-any.pcap.gz"),
        data("../../wire/tests/data/fastdds-samehost-any.pcap.gz"),
        data("../testing/data/cyclonedds/points-besteffort-lossy-2ns/capture.pcap.gz"),
    ]
}

/// Returns the capture of a robot with services and actions.
fn graph() -> String {
    data("tests/fixtures/cli/graph.pcap.gz")
}

/// Runs both programs, and returns their output after checking that it is the same.
fn both(arguments: &[&str]) -> Output {
    let native = Program::native().run(arguments);
    let arm = Program::arm().run(arguments);
    assert_eq!(arm, native, "rp {}", arguments.join(" "));
    native
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

#[test]
fn each_binary_is_static_and_of_its_architecture() {
    for Binary { architecture, path } in program::shipped() {
        let elf = Elf::read(&path);
        let name = path.display();
        let machine = match architecture {
            "x86_64" => Machine::X86_64,
            "aarch64" => Machine::AARCH64,
            other => panic!("{other}"),
        };
        assert_eq!(elf.machine(), machine, "{name}");
        assert!(!elf.has_interpreter(), "{name} needs a dynamic linker");
        assert_eq!(elf.needed(), 0, "{name} needs shared libraries");
        assert!(!elf.has_executable_stack(), "{name}");
        // A kernel with pages of 16 or 64 KiB cannot map a segment with a smaller alignment.
        if machine == Machine::AARCH64 {
            let alignments = elf.load_alignments();
            let fits = |alignment: &u64| alignment.is_multiple_of(65_536);
            assert!(
                !alignments.is_empty() && alignments.iter().all(fits),
                "{name}: {alignments:?}"
            );
        }
    }
}

#[test]
fn the_same_kernel_objects_are_in_each_binary_byte_for_byte() {
    let objects = ["filter", "inside"]
        .map(|name| std::fs::read(data(&format!("../../agent-ebpf/{name}.bpf.o"))).unwrap());
    let all = program::all();
    for (path, object) in all
        .iter()
        .flat_map(|path| objects.iter().map(move |o| (path, o)))
    {
        let binary = std::fs::read(path).unwrap();
        // The offset of the object is a multiple of 8, because it is read in place.
        let found = binary
            .chunks_exact(8)
            .zip((0..).step_by(8))
            .any(|(chunk, at)| chunk == &object[..8] && binary[at..].starts_with(object));
        assert!(found, "not in {}", path.display());
    }
}

#[test]
fn version_help_and_generated_texts_are_the_same_on_both_architectures() {
    let version = both(&["--version"]);
    let expected = concat!("rp ", env!("CARGO_PKG_VERSION"), "\n");
    assert_eq!(text(&version.stdout), expected);
    // Each program calls itself by the name of its file.
    let help = [Program::native(), Program::arm()].map(|program| {
        let help = text(&program.run(&["--help"]).stdout);
        help.replace(&format!("Usage: {} ", program.file_name()), "Usage: rp ")
    });
    assert!(help[0].contains("Usage: rp ["), "{}", help[0]);
    assert_eq!(help[1], help[0]);
    assert!(both(&["completions", "bash"]).stdout.len() > 1000);
    let checked = both(&["check-config", &data("../../config/ros2probe.yaml")]);
    assert!(checked.status.success() && text(&checked.stdout).contains("is valid"));
    let refused = both(&["check-config", "/nowhere.yaml"]);
    assert_eq!(refused.status.code(), Some(78));

    let directory = tempfile::tempdir().unwrap();
    for program in [Program::native(), Program::arm()] {
        let place = directory.path().join(program.name());
        std::fs::create_dir(&place).unwrap();
        let written = program.run(&["man", place.to_str().unwrap()]);
        assert!(written.status.success(), "{}", text(&written.stderr));
    }
    let pages = |program: &Program| tree(&directory.path().join(program.name()));
    let native = pages(&Program::native());
    assert!(native.len() > 10, "{} pages", native.len());
    assert_eq!(pages(&Program::arm()), native);
}

/// Returns names and contents of all files below a directory.
fn tree(directory: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(tree(&path));
        } else {
            let name = path.strip_prefix(directory).unwrap().to_owned();
            files.push((name, std::fs::read(&path).unwrap()));
        }
    }
    files.sort();
    files
}

/// Returns the page without values of the process, its build and its time.
fn of_the_robot(page: &str) -> String {
    let other = [
        "ros2probe_build_info{",
        "ros2probe_snapshot_age_seconds ",
        "ros2probe_config_last_reload_success_timestamp_seconds ",
        "process_",
        // qemu has no system call filters.
        "ros2probe_sandbox_info{",
    ];
    let lines = page
        .lines()
        .filter(|line| !other.iter().any(|name| line.starts_with(name)));
    lines.map(|line| format!("{line}\n")).collect()
}

#[test]
fn a_replay_leads_to_the_same_report_on_both_architectures() {
    for capture in captures() {
        let arguments = ["run", "--replay", &capture, "--watch", "/**", "--report"];
        let pages = [Program::native(), Program::arm()].map(|program| {
            let output = program.run(&arguments);
            assert!(output.status.success(), "{}", text(&output.stderr));
            let page = text(&output.stdout);
            let build = format!("arch=\"{}\"", program.architecture());
            assert!(page.contains(&build), "no {build}");
            of_the_robot(&page)
        });
        let [native, arm] = pages;
        assert!(native.contains("ros2_topic_messages_total{"), "{native}");
        let other = arm
            .lines()
            .zip(native.lines())
            .find(|(arm, native)| arm != native);
        assert_eq!(other, None, "{capture}");
        assert_eq!(arm.len(), native.len(), "{capture}");
    }
}

/// Returns an agent that serves a replay after its end.
fn served(program: &Program, capture: &str) -> LocalAgent {
    let arguments = ["--speed", "max", "--watch", "/**"];
    let mut agent = LocalAgent::replay(&mut program.command(), Path::new(capture), &arguments);
    agent.wait_for_log("the capture has ended");
    agent
}

fn ask(agent: &LocalAgent, path: &str) -> Answer {
    request(agent.api, "GET", path, "")
}

#[test]
fn a_replay_is_served_identically_on_both_architectures() {
    let capture = &graph();
    let [native, arm] = [Program::native(), Program::arm()].map(|each| served(&each, capture));
    let pages = [&native, &arm].map(|agent| of_the_robot(&agent.get("/metrics").body));
    assert!(pages[0].contains("ros2_topic_messages_total{"));
    let robot = |page: &str| -> Vec<String> {
        let lines = page.lines().filter(|line| line.starts_with("ros2_"));
        lines.map(str::to_owned).collect()
    };
    assert_eq!(robot(&pages[1]), robot(&pages[0]));
    for path in ["/healthz", "/readyz"] {
        let (native, arm) = (native.get(path), arm.get(path));
        assert_eq!(
            (arm.status, arm.body),
            (native.status, native.body),
            "{path}"
        );
    }

    let api: Value = serde_json::from_str(&ask(&native, "/openapi.json").body).unwrap();
    let views = api["paths"].as_object().unwrap().iter();
    let views = views.filter(|(_, methods)| methods.get("get").is_some());
    let mut asked = 0;
    for (view, _) in views {
        // Streams end with the agent; the agent's own metrics and times differ.
        let own = ["/samples", "/health", "/events", "/live", "/processes"];
        if own.contains(&view.as_str()) || view.ends_with("/messages") || view.ends_with("/history")
        {
            continue;
        }
        let path = match view.as_str() {
            "/nodes/{node}" => "/nodes/robot1/sensor_node",
            other => &other
                .replace("{topic}", "rosout")
                .replace("{name}", "none")
                .replace("{file}", "none_0.mcap"),
        };
        let (native, arm) = (ask(&native, path), ask(&arm, path));
        assert_eq!(
            (arm.status, &arm.body),
            (native.status, &native.body),
            "{path}"
        );
        asked += 1;
    }
    assert!(asked >= 10, "{asked} views");
    for agent in [&native, &arm] {
        let health: Value = serde_json::from_str(&ask(agent, "/health").body).unwrap();
        assert_eq!(health["version"], env!("CARGO_PKG_VERSION"), "{health}");
    }
}

#[test]
fn commands_print_the_same_from_a_capture_and_from_an_agent() {
    let capture = &graph();
    let agent = served(&Program::arm(), capture);
    let host = agent.api.to_string();
    for words in [
        "topic list -t",
        "topic info -v /rosout",
        "node list",
        "node info /robot1/sensor_node",
        "service list -t",
        "action list -t",
    ] {
        let words: Vec<&str> = words.split(' ').collect();
        let replayed = both(&[&words[..], &["--replay", capture]].concat());
        assert!(
            replayed.status.success(),
            "{words:?}: {}",
            text(&replayed.stderr)
        );
        assert!(!replayed.stdout.is_empty(), "{words:?}");
        let asked = both(&[&words[..], &["--host", &host]].concat());
        assert_eq!(asked, replayed, "{words:?}");
    }
    let capture = &captures()[0];
    let echo = ["topic", "echo", "/chatter", "--once", "--replay", capture];
    assert!(text(&both(&echo).stdout).contains("data: "));
}

#[test]
fn a_bag_recorded_from_a_replay_can_be_read() {
    let capture = &captures()[0];
    let directory = tempfile::tempdir().unwrap();
    let bags = [Program::native(), Program::arm()].map(|program| {
        let bag = directory.path().join(program.name());
        let bag = bag.to_str().unwrap().to_owned();
        let recorded = program.run(&["bag", "record", "-a", "--replay", capture, "-o", &bag]);
        assert!(recorded.status.success(), "{}", text(&recorded.stderr));
        bag
    });
    let reported = bags.each_ref().map(|bag| {
        let info = both(&["bag", "info", bag]);
        assert!(info.status.success(), "{}", text(&info.stderr));
        text(&info.stdout).replace(bag, "")
    });
    assert_eq!(messages(&bags[1]), messages(&bags[0]));
    assert!(reported[0].contains("/chatter"), "{}", reported[0]);
}

/// Returns topic, times and bytes of a bag's messages, as the `mcap` crate reads them.
fn messages(bag: &str) -> Vec<(String, u64, u64, Vec<u8>)> {
    let files = tree(Path::new(bag));
    let mut files = files
        .iter()
        .filter(|(name, _)| name.extension().is_some_and(|end| end == "mcap"));
    let (_, bytes) = files.next().expect("no .mcap");
    let messages = mcap::MessageStream::new(bytes).unwrap().map(Result::unwrap);
    let messages = messages.map(|message| {
        let topic = message.channel.topic.clone();
        (
            topic,
            message.log_time,
            message.publish_time,
            message.data.to_vec(),
        )
    });
    let messages: Vec<_> = messages.collect();
    assert!(!messages.is_empty());
    messages
}

#[test]
fn live_capture_without_bpf_is_refused_with_one_line() {
    let refused = Program::arm().run(&["run", "--metrics", "off", "--api", "off"]);
    let printed = text(&refused.stderr);
    assert_eq!(refused.status.code(), Some(1), "{printed}");
    assert_eq!(
        printed.lines().last(),
        Some(
            "rp: BPF is not available: not supported by this kernel or emulator: Function not \
             implemented (os error 38)"
        ),
        "{printed}"
    );
}

/// The cryptography crate of rustls, and the crate that compiles its C.
const TLS: [&str; 2] = ["cc", "ring"];
/// Crates whose build compiles C or needs an installed library.
const C: [&str; 8] = [
    "cc",
    "cmake",
    "ring",
    "aws-lc-rs",
    "pkg-config",
    "bindgen",
    "vcpkg",
    "nasm-rs",
];
/// Crates with declarations of system interfaces, in Rust alone.
const DECLARATIONS: [&str; 2] = ["linux-raw-sys", "windows-sys"];

#[test]
fn ring_is_the_only_crate_that_compiles_c_into_the_binary() {
    for architecture in ["x86_64", "aarch64"] {
        let crates = crates(architecture, "normal,build");
        assert!(
            crates.contains("aya") && crates.contains("tokio"),
            "{crates:?}"
        );
        let of_c = |name: &&String| {
            let declares = DECLARATIONS.contains(&name.as_str());
            let is_tls = TLS.contains(&name.as_str());
            !is_tls && (C.contains(&name.as_str()) || name.ends_with("-sys") && !declares)
        };
        let found: Vec<_> = crates.iter().filter(of_c).collect();
        assert!(found.is_empty(), "{architecture}: {found:?}");
    }
}

/// Returns the names of the crates of which `rp` is built, along these edges.
fn crates(architecture: &str, edges: &str) -> BTreeSet<String> {
    let output = Command::new(env!("CARGO"))
        .args(["tree", "--locked", "--offline", "--package", "ros2probe"])
        .args(["--edges", edges, "--prefix", "none", "--format", "{p}"])
        .args(["--target", &format!("{architecture}-unknown-linux-musl")])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", text(&output.stderr));
    let tree = text(&output.stdout);
    let names = tree.lines().filter_map(|line| line.split(' ').next());
    names.map(str::to_owned).collect()
}
