//! `rp ci` reports what prevents a run in one sentence, before it starts the command.

use std::fs;
use std::net::TcpListener;
use std::path::Path;

use crate::rp;

/// Runs `rp ci` in a directory, with a command that leaves a trace. Returns the exit code and the
/// error.
fn refused(directory: &Path, arguments: &[&str]) -> (Option<i32>, String) {
    let output = rp()
        .current_dir(directory)
        .arg("ci")
        .args(arguments)
        .args(if arguments.contains(&"--") {
            &[][..]
        } else {
            &["--", "touch", "ran"][..]
        })
        .output()
        .unwrap();
    assert!(!directory.join("ran").exists(), "{arguments:?}");
    let error = String::from_utf8(output.stderr).unwrap();
    (output.status.code(), error)
}

#[test]
fn each_obstacle_is_one_error_before_the_command_runs() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    fs::write(at("broken.yaml"), "watch:\n  - {topic: imu}\n").unwrap();
    fs::write(at("plain.txt"), "").unwrap();
    fs::create_dir_all(at("full/bag")).unwrap();
    fs::write(at("full/bag/thesis.pdf"), "").unwrap();
    let busy = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = busy.local_addr().unwrap().to_string();
    let cases: [(&[&str], i32, &str); 8] = [
        (
            &["--", "no-such-program"],
            127,
            "cannot start `no-such-program`",
        ),
        (
            &["--", "./plain.txt"],
            126,
            "it is not executable: `chmod +x`",
        ),
        (
            &["--expect", "broken.yaml"],
            78,
            "broken.yaml:2:13: watch[0].topic: must begin",
        ),
        (
            &["--expect", "absent.yaml"],
            78,
            "cannot read the configuration absent.yaml",
        ),
        (
            &["-o", "plain.txt/out"],
            1,
            "cannot write to the output directory plain.txt/out",
        ),
        (
            &["-o", "full"],
            1,
            "full/bag has files that are not of a bag",
        ),
        (
            &["--page", &address],
            1,
            "cannot serve the page at 127.0.0.1:",
        ),
        (
            &["--page", "0.0.0.0:17401"],
            2,
            "must be a loopback address",
        ),
    ];
    for (arguments, code, part) in cases {
        let (status, error) = refused(directory.path(), arguments);
        assert_eq!(status, Some(code), "{arguments:?}: {error}");
        assert!(error.contains(part), "{arguments:?}: {error}");
        assert!(code == 2 || error.lines().count() == 1, "{error}");
    }
    assert!(at("full/bag/thesis.pdf").exists());
}

#[test]
fn the_help_names_every_exit_code_and_hides_internal_options() {
    let output = rp().args(["ci", "--help"]).output().unwrap();
    let help = String::from_utf8(output.stdout).unwrap();
    for part in [
        "79 if a condition",
        "126 or 127",
        "77 a capability",
        "78 the watchlist",
    ] {
        assert!(help.contains(part), "{help}");
    }
    assert!(!help.contains("--guard"), "{help}");
    let output = rp().args(["run", "--help"]).output().unwrap();
    let help = String::from_utf8(output.stdout).unwrap();
    assert!(
        !help.contains("--private") && help.contains("--replay"),
        "{help}"
    );
}
