//! A program that calls `libtracetools.so` as rclcpp does, and takes commands on standard input.
//!
//! The library and the program are compiled here: ROS 2 Humble has no ring buffers, and a machine
//! without ROS 2 has no such library.

use std::path::PathBuf;
use std::process::Command;

use anyhow::{Context as _, Result, ensure};
use tempfile::TempDir;

const SOURCES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tracetools");

/// The library and the program, in a directory of their own.
pub struct TracedProgram {
    directory: TempDir,
}

impl TracedProgram {
    /// Compiles the library and the program. `place` is the offset of `rmw_handle` in rcl's
    /// structures, 240 or 248. `defines` has compiler arguments such as `-DHUMBLE`.
    pub fn build(place: u32, defines: &[&str]) -> Result<Self> {
        let built = Self {
            directory: tempfile::tempdir()?,
        };
        let name = |path: PathBuf| path.to_str().map(str::to_owned).context("path");
        let (library, program) = (name(built.library())?, name(built.program())?);
        let source = |name: &str| format!("{SOURCES}/{name}");
        let (of_library, of_program) = (source("tracetools.c"), source("process.c"));
        let mut arguments = vec!["-O2", "-shared", "-fPIC", "-o", &library, &of_library];
        arguments.extend(defines);
        compile(&arguments)?;
        let place = format!("-DPLACE={place}");
        let mut arguments = vec![
            "-O2",
            "-pthread",
            &place,
            "-o",
            &program,
            &of_program,
            &library,
        ];
        arguments.push("-Wl,-rpath,$ORIGIN");
        arguments.extend(defines);
        compile(&arguments)?;
        Ok(built)
    }

    pub fn library(&self) -> PathBuf {
        self.directory.path().join("libtracetools.so")
    }

    /// Returns the path of the program. Its arguments are the topic from which it takes, the topic
    /// on which it publishes, and its node; by default `/in`, `/out` and `filter`.
    pub fn program(&self) -> PathBuf {
        self.directory.path().join("process")
    }
}

fn compile(arguments: &[&str]) -> Result<()> {
    let status = Command::new("cc").args(arguments).status();
    let status = status.context("install a C compiler: apt-get install gcc libc6-dev")?;
    ensure!(status.success(), "cc {arguments:?}");
    Ok(())
}
