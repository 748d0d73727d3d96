//! `rp` together with other tools: pipes, signals, shells and `man`.

use std::io::Read as _;
use std::net::TcpListener;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use super::{run, stderr, stdout};
use crate::rp;
use ros2probe_testing::local_agent::capture;

/// Returns the output of a tool, or `None` if it is not installed.
fn tool(name: &str, arguments: &[&str]) -> Option<Output> {
    let output = Command::new(name).args(arguments).output();
    match output {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => None,
        output => Some(output.unwrap()),
    }
}

#[test]
fn a_closed_pipe_ends_the_command_without_an_error_message() {
    let mut rp = rp();
    rp.args(["topic", "list", "--replay"]).arg(capture());
    let mut child = rp
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert_eq!(
        (stderr(&output).as_str(), output.status.code()),
        ("", Some(141))
    );
}

#[test]
fn an_interrupt_ends_the_command_with_the_exit_code_of_ros2cli() {
    // This server accepts connections and never answers.
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let mut rp = rp();
    rp.args([
        "topic",
        "list",
        "--host",
        &silent.local_addr().unwrap().to_string(),
    ]);
    let child = rp
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let (mut asked, _) = silent.accept().unwrap();
    let mut request = [0; 14];
    asked.read_exact(&mut request).unwrap();
    assert_eq!(&request, b"GET /names?dom");
    let interrupted = tool("kill", &["-INT", &child.id().to_string()]).unwrap();
    assert!(interrupted.status.success());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
    assert_eq!((stdout(&output), stderr(&output)), Default::default());
}

#[test]
fn shells_can_read_their_completions() {
    let directory = tempfile::tempdir().unwrap();
    for (shell, check) in [("bash", "-n"), ("zsh", "-n"), ("fish", "--no-execute")] {
        let script = run(&["completions", shell]);
        assert_eq!(script.status.code(), Some(0), "{}", stderr(&script));
        assert!(stdout(&script).contains("count-topics"), "{shell}");
        let path = directory.path().join(shell);
        std::fs::write(&path, &script.stdout).unwrap();
        if let Some(checked) = tool(shell, &[check, path.to_str().unwrap()]) {
            assert!(checked.status.success(), "{}", stderr(&checked));
        }
    }
    assert_eq!(run(&["completions", "tcsh"]).status.code(), Some(2));
}

/// Returns the commands and verbs below these words, as their help lists them.
fn below(words: &[&str]) -> Vec<String> {
    let help = stdout(&run(&[words, &["--help"]].concat()));
    let Some((_, commands)) = help.split_once("Commands:\n") else {
        return Vec::new();
    };
    let lines = commands.lines().take_while(|line| !line.is_empty());
    let named = lines.filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    let names = named.filter_map(|line| line.split_whitespace().next());
    names
        .filter(|name| *name != "help")
        .map(str::to_owned)
        .collect()
}

#[test]
fn every_command_and_verb_has_a_page_that_man_can_read() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path();
    let written = run(&["man", path.to_str().unwrap()]);
    assert_eq!(written.status.code(), Some(0), "{}", stderr(&written));
    let commands = below(&[]);
    assert!(commands.contains(&"topic".to_owned()), "{commands:?}");
    for command in &commands {
        readable(&path.join(format!("rp-{command}.1")));
        for verb in below(&[command]) {
            readable(&path.join(format!("rp-{command}-{verb}.1")));
        }
    }
    let page = run(&["man"]);
    let written = std::fs::read_to_string(path.join("rp.1")).unwrap();
    assert_eq!(stdout(&page), written);
    let nowhere = run(&["man", "/nowhere"]);
    assert_eq!(nowhere.status.code(), Some(1));
    assert!(stderr(&nowhere).contains("cannot write pages to /nowhere"));
}

fn readable(page: &Path) {
    assert!(page.exists(), "{}", page.display());
    let page = page.to_str().unwrap();
    if let Some(checked) = tool("groff", &["-man", "-Tutf8", "-ww", "-z", page]) {
        assert_eq!(stderr(&checked), "", "{page}");
    }
}
