//! Types of Cyclone DDS 11 that no package on this host defines: the agent learns them when another
//! participant requests them. Needs root.

use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::{Agent, datagrams_alone_of, get};
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::peer::python;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::{self, wait_until};
use serde_json::Value;

const PEERS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/peers/xtypes");
const PATIENCE: Duration = Duration::from_secs(60);
/// What follows the number of a message on `/things`.
const THING: &str = "  values:\n  - 1.5\n  - 2.5\ngrid:\n- 1\n- 2\n- 3\none:\n  count: 7\n  \
    values: []\nnames:\n- a\n- b\nname: n\nb: \"\\t\"\ni8: -1\nu16: 2\ni16: -3\nu32: 4\n\
    u64: 5\ni64: -6\nf32: 0.5\n---\n";

#[test]
fn a_type_without_a_package_is_echoed_after_a_participant_requested_it() -> Result<()> {
    harness::require()?;
    let link = Link::new()?;
    let host = &link.monitor;
    let directory = tempfile::tempdir()?;
    let (file, socket) = (
        directory.path().join("ros2probe.yaml"),
        directory.path().join("api.sock"),
    );
    let source = datagrams_alone_of(host);
    let text = format!("{source}api: {{socket: {}}}\n", socket.display());
    std::fs::write(&file, text)?;
    let _agent = Agent::start(host, env!("CARGO_BIN_EXE_rp"), &file)?;

    let python = python("cyclonedds")?;
    let script = |name: &str| format!("{PEERS}/{name}.py");
    let start = |arguments: &[&str]| Process::start(&host.inside(), &python, arguments);
    let mut publisher = start(&["-B", &script("publish"), "0"])?;
    publisher.wait_for("ready", PATIENCE)?;
    let definition = || -> Result<Value> {
        let text = get(host, "http://127.0.0.1:17401/topics/things/definition")?;
        serde_json::from_str(&text).with_context(|| text)
    };
    let mut reader = start(&["-B", &script("ask"), "0", "60"])?;
    reader.wait_for("rt/things", PATIENCE)?;
    // The publisher announces its topics to the other participant, not before.
    wait_until("the type", || {
        Ok(definition().is_ok_and(|found| found["known"] == true))
    })?;
    let hash = definition()?["equivalence_hash"].clone();
    ensure!(hash == "XTYPES_2fe06bcbb913727017f940a805a0", "{hash}");
    let odd = || get(host, "http://127.0.0.1:17401/topics/odd/definition");
    wait_until("the reason", || {
        Ok(odd().is_ok_and(|text| text.contains("a union is not supported")))
    })?;
    let output = crate::rp()
        .args(["topic", "echo", "/things", "--once", "--socket"])
        .arg(&socket)
        .output()?;
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let errors = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "{errors}");
    let rest = text.strip_prefix("label: hello\nok: true\nparts:\n- count: ");
    let rest = rest.with_context(|| format!("{text}{errors}"))?;
    let (number, rest) = rest.split_once('\n').context("one line")?;
    ensure!(number.parse::<i32>()? > 0, "{text}");
    ensure!(rest == THING, "{text}");
    Ok(())
}
