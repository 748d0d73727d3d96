//! tcpdump's recording of a host's link: the reference for the agent's reports, and for whether the
//! agent itself sent packets.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail};

use super::network::{INTERFACE, Namespace};
use super::process::Process;

/// Time within which tcpdump reads the kernel's buffer: each second, or later on a busy machine. It
/// does not read the buffer when it ends.
pub const SETTLE: Duration = Duration::from_secs(3);
/// Size of tcpdump's buffer: 64 MiB, which is more than a second of point clouds.
const BUFFER_KILOBYTES: &str = "65536";

pub struct Capture {
    process: Process,
    path: PathBuf,
    stderr: PathBuf,
}

impl Capture {
    /// Records every frame of the host's interface into a file until [`Capture::finish`].
    pub fn start(host: &Namespace, path: &Path) -> Result<Capture> {
        Self::start_on(host, INTERFACE, path)
    }

    /// Records every frame of this interface of the host.
    pub fn start_on(host: &Namespace, interface: &str, path: &Path) -> Result<Capture> {
        let stderr = path.with_extension("said");
        let errors =
            File::create(&stderr).with_context(|| format!("cannot create {}", stderr.display()))?;
        let words = ["-i", interface, "-B", BUFFER_KILOBYTES, "-Z", "root", "-w"];
        let words = words.iter().map(AsRef::as_ref).chain([path.as_os_str()]);
        let process = Process::start_with(&host.inside(), "tcpdump", words, errors.into())?;
        let capture = Capture {
            process,
            path: path.to_owned(),
            stderr,
        };
        let deadline = Instant::now() + Duration::from_secs(60);
        while !capture.stderr()?.contains("listening on") {
            if Instant::now() > deadline {
                bail!("tcpdump does not begin: {}", capture.stderr()?);
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(capture)
    }

    /// Ends the recording. The file lacks only the last [`SETTLE`]. Fails if tcpdump dropped
    /// frames.
    pub fn finish(mut self) -> Result<PathBuf> {
        self.process.signal("INT")?;
        let status = self
            .process
            .wait(Duration::from_secs(60))
            .context("tcpdump")?;
        let stderr = self.stderr()?;
        if !status.success() {
            bail!("tcpdump ended with {status}: {stderr}");
        }
        if !stderr.contains("\n0 packets dropped by kernel") {
            bail!("tcpdump missed frames: {stderr}");
        }
        Ok(self.path)
    }

    fn stderr(&self) -> Result<String> {
        fs::read_to_string(&self.stderr).context("cannot read what tcpdump says")
    }
}
