//! What crossed a host's cable, as tcpdump saw it: the judge of what the agent says, and of whether
//! it sent anything itself.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail};

use super::network::{INTERFACE, Namespace};
use super::process::Process;

pub(crate) struct Capture {
    process: Process,
    path: PathBuf,
}

impl Capture {
    /// Records every frame of the host's interface into a file until [`Capture::finish`].
    pub(crate) fn start(host: &Namespace, path: &Path) -> Result<Capture> {
        let buffer_kilobytes = "65536";
        let words = [
            "-i",
            INTERFACE,
            "-B",
            buffer_kilobytes,
            "-U",
            "-Z",
            "root",
            "-w",
        ];
        let words = words.iter().map(AsRef::as_ref).chain([path.as_os_str()]);
        let process = Process::start(&host.inside(), "tcpdump", words)?;
        let deadline = Instant::now() + Duration::from_secs(10);
        // The file's header is written when the socket is open.
        while std::fs::metadata(path).map_or(true, |file| file.len() == 0) {
            if Instant::now() > deadline {
                bail!("tcpdump does not begin to write {}", path.display());
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(Capture {
            process,
            path: path.to_owned(),
        })
    }

    /// Ends the recording; the file is whole.
    pub(crate) fn finish(mut self) -> Result<PathBuf> {
        self.process.signal("INT")?;
        let status = self
            .process
            .wait(Duration::from_secs(10))
            .context("tcpdump")?;
        if !status.success() {
            bail!("tcpdump ended with {status}");
        }
        Ok(self.path)
    }
}
