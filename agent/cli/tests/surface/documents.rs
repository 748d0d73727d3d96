//! Commands that the documentation shows on captures of this repository print the documented
//! output.

use std::fs;
use std::path::Path;
use std::process::Command;

/// Returns the commands and their outputs in the `console` blocks of a document, without their
/// indentation.
fn commands(text: &str) -> Vec<(String, String)> {
    let mut found = Vec::new();
    for block in text.split("```console\n").skip(1) {
        let before = text.find(block).unwrap() - "```console\n".len();
        let indentation = text[..before].rsplit('\n').next().unwrap();
        let (block, _) = block.split_once(&format!("{indentation}```")).unwrap();
        let lines = block.lines();
        for line in lines.map(|line| line.strip_prefix(indentation).unwrap_or(line)) {
            if let Some(command) = line.strip_prefix("$ ") {
                found.push((command.to_owned(), String::new()));
            } else if let Some((_, output)) = found.last_mut() {
                output.push_str(line);
                output.push('\n');
            }
        }
    }
    found
}

#[test]
fn commands_on_captures_print_the_documented_output() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let rp = Path::new(env!("CARGO_BIN_EXE_rp")).parent().unwrap();
    let path = format!("{}:{}", rp.display(), std::env::var("PATH").unwrap());
    let pages = fs::read_dir(root.join("docs")).unwrap();
    let mut documents: Vec<_> = pages.map(|page| page.unwrap().path()).collect();
    documents.retain(|page| page.extension().is_some_and(|end| end == "md"));
    documents.push(root.join("README.md"));
    let mut run = 0;
    for document in documents {
        for (command, expected) in commands(&fs::read_to_string(&document).unwrap()) {
            if !command.starts_with("rp ") || !command.contains(" --replay ") {
                continue;
            }
            let mut shell = Command::new("sh");
            shell.args(["-c", &command]).current_dir(&root);
            shell.env_remove("ROS_DOMAIN_ID").env_remove("ROS_DISTRO");
            let output = shell.env("PATH", &path).output().unwrap();
            let printed = String::from_utf8(output.stdout).unwrap();
            assert_eq!(printed, expected, "{}: {command}", document.display());
            run += 1;
        }
    }
    assert!(run >= 4, "{run} commands");
}
