//! Libraries on overlays: those of root are attached, and those of users are not.

use std::os::fd::AsRawFd as _;
use std::path::PathBuf;

use ros2probe_attach::functions::Library;
use ros2probe_attach::mapped::{Mapped, Use};
use ros2probe_attach::open::{OpenError, open};
use ros2probe_attach::request::Place;
use ros2probe_capture::uprobe::library_id::id_as_mapped;
use tempfile::TempDir;

use super::*;

/// The program with its library on an overlay, in a mount namespace of its own.
struct Overlay {
    program: TracedProgram,
    _directory: TempDir,
    process: Process,
}

impl Overlay {
    /// Mounts the overlay in place of the program's directory, and runs `command` there. `options`
    /// are those of `unshare`. The program names its library by this path.
    fn new(options: &[&str], command: &str) -> Self {
        let program = TracedProgram::build(248, &[]).unwrap();
        let directory = tempfile::tempdir().unwrap();
        let at = directory.path().display();
        let lower = program.program().parent().unwrap().display().to_string();
        let script = format!(
            "cd {at} && mkdir on && mount -t tmpfs none on && mkdir on/empty \
             && mount -t overlay -o xino=off,lowerdir=on/empty:{lower} none {lower} \
             && cd {lower} && {command}"
        );
        let all = [options, &["--mount", "sh", "-c", &script]].concat();
        let process = Process::with(Path::new("unshare"), &all);
        Self {
            program,
            _directory: directory,
            process,
        }
    }

    /// Returns the library as other processes can open it.
    fn library(&self) -> PathBuf {
        let id = self.process.child.id();
        let library = self.program.library();
        format!("/proc/{id}/root{}", library.display()).into()
    }
}

fn mapped(process: u32) -> Mapped {
    let used = Use::read(process, Library::Tracing).unwrap();
    used.libraries.into_iter().next().unwrap()
}

fn opened(process: u32) -> Result<File, OpenError> {
    let id = mapped(process).id;
    let opened = open(&Place::Mapped { process, id }, Library::Tracing);
    opened.map(|(file, _)| file)
}

#[test]
fn a_library_on_the_overlay_of_a_container_is_opened() {
    let mut overlay = Overlay::new(&[], "exec ./process");
    overlay.process.run("publish 1");
    assert!(opened(overlay.process.child.id()).is_ok());
}

#[test]
fn a_library_on_the_overlay_of_a_user_is_refused_in_a_process_of_the_host() {
    let options = ["--user", "--map-root-user"];
    let mut overlay = Overlay::new(&options, "echo ready && exec cat");
    overlay.process.end("ready");
    let library = File::open(overlay.library()).unwrap();
    // SAFETY: a new mapping at an address of the kernel's choice; nothing refers to it.
    let page = unsafe {
        libc::mmap(
            std::ptr::null_mut(),
            1,
            libc::PROT_READ,
            libc::MAP_PRIVATE,
            library.as_raw_fd(),
            0,
        )
    };
    assert_ne!(page, libc::MAP_FAILED);
    let opened = opened(std::process::id());
    assert!(
        matches!(opened, Err(OpenError::MayNotAnswer(_))),
        "{opened:?}"
    );
}

#[test]
fn an_installed_library_has_the_identity_that_processes_show() {
    let mut overlay = Overlay::new(&[], "exec ./process");
    overlay.process.run("publish 1");
    let id = id_as_mapped(&overlay.library()).unwrap();
    assert_eq!(id, mapped(overlay.process.child.id()).id);
}
