//! cargo installs `rp` from the published crates.

use std::fs;
use std::process::Command;
use std::time::Instant;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::Agent;
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::repository as sources;
use serde_json::json;

use super::ways::{everything_at, measures};
use super::{VERSION, published, succeed};
use crate::crates;

#[test]
#[ignore = "looks at a release: make release"]
fn cargo_installs_rp_from_the_published_crates_and_uninstalls_it_completely() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let registry = directory.path().join("registry");
    // The libraries of others are copies of what the registry has.
    let mut vendor = Command::new(env!("CARGO"));
    vendor.args(["vendor", "--locked", "--versioned-dirs", "--quiet"]);
    succeed(vendor.arg(&registry).current_dir(sources("")))?;
    for (name, _) in crates::published()? {
        let file = published()?.join(format!("{name}-{VERSION}.crate"));
        let mut unpack = Command::new("tar");
        unpack.arg("--extract").arg("--file").arg(&file);
        succeed(unpack.arg("--directory").arg(&registry))?;
        let sum = succeed(Command::new("sha256sum").arg(&file))?;
        let (sum, _) = sum.split_once(' ').context("no checksum")?;
        let unpacked = registry.join(format!("{name}-{VERSION}"));
        let checksum = json!({ "files": {}, "package": sum });
        fs::write(unpacked.join(".cargo-checksum.json"), checksum.to_string())?;
    }

    let root = directory.path().join("root");
    let cargo = |verb: &str| {
        let mut cargo = Command::new(env!("CARGO"));
        cargo.arg(verb).arg("--root").arg(&root);
        cargo.current_dir(directory.path());
        cargo.env("CARGO_TARGET_DIR", directory.path().join("target"));
        cargo
    };
    let host = Namespace::isolated()?;
    let began = Instant::now();
    let mut install = cargo("install");
    // Only the speed of the program depends on the profile.
    install.args(["--locked", "--offline", "--debug"]);
    install.args(["--config", "source.crates-io.replace-with='published'"]);
    let source = format!("source.published.directory='{}'", registry.display());
    install.args(["--config", &source]);
    succeed(install.arg(format!("ros2probe@{VERSION}")))?;

    let program = root.join("bin/rp");
    let configuration = directory.path().join("robot.yaml");
    fs::write(&configuration, everything_at(&host))?;
    let agent = Agent::start(&host, &program, &configuration)?;
    measures(&agent, "crates, unoptimized", "/by_crates", began)?;
    drop(agent);
    let version = succeed(Command::new(&program).arg("--version"))?;
    ensure!(version == format!("rp {VERSION}\n"), "{version}");
    let capture = sources("wire/tests/data/cyclonedds-samehost-any.pcap.gz");
    let mut list = Command::new(&program);
    list.args(["topic", "list", "--replay"]).arg(capture);
    let topics = succeed(&mut list)?;
    ensure!(topics.lines().any(|topic| topic == "/chatter"), "{topics}");
    let bytes = fs::read(&program)?;
    for name in ["filter", "inside"] {
        let object = fs::read(sources(&format!("agent-ebpf/{name}.bpf.o")))?;
        let is_there = bytes.windows(object.len()).any(|part| part == object);
        ensure!(is_there, "{name}");
    }

    succeed(cargo("uninstall").arg("ros2probe"))?;
    let mut find = Command::new("find");
    let left = succeed(find.arg(&root).args(["-type", "f", "-printf", "%f\\n"]))?;
    // cargo keeps its own lists, which are empty now.
    let is_list = |name: &str| [".crates.toml", ".crates2.json"].contains(&name);
    ensure!(left.lines().all(is_list), "{left}");
    Ok(())
}
