//! The broker with hostile clients, and with processes whose memory cannot be read.

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader, IoSlice};
use std::os::fd::{AsFd as _, BorrowedFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::time::{Duration, Instant};

use ros2probe_attach::client::{Broker, BrokerError};
use ros2probe_attach::functions::{Calls, Library};
use ros2probe_attach::mapped::{LibraryId, Use};
use ros2probe_attach::request::{AttachMethod, MAX_PACKET, Place};
use rustix::net::sockopt::{Timeout, set_socket_timeout};
use rustix::net::{
    AddressFamily, RecvFlags, SendAncillaryBuffer, SendAncillaryMessage, SendFlags, SocketAddrUnix,
    SocketFlags, SocketType, bind, connect, listen, recv, sendmsg, socket_with,
};
use serde_json::{Value, json};
use tempfile::TempDir;

const PATIENCE: Duration = Duration::from_secs(60);

/// Maps the file of the first argument as a library. With the second argument `stuck`, reads of its
/// environment block forever (userfaultfd(2)).
const PROCESS: &str = r#"
import ctypes, mmap, platform, struct, sys
libc = ctypes.CDLL(None, use_errno=True)
libc.mmap.restype = ctypes.c_void_p
file = open(sys.argv[1], "rb")
mapped = mmap.mmap(file.fileno(), 4096, mmap.MAP_PRIVATE, mmap.PROT_READ)
if sys.argv[2] == "stuck":
    # A page within the environment, which is longer than two pages.
    fields = open("/proc/self/stat").read().rsplit(")", 1)[1].split()
    page = (int(fields[47]) + 8191) // 4096 * 4096
    assert page + 4096 <= int(fields[48])
    assert libc.mmap(ctypes.c_void_p(page), ctypes.c_size_t(4096), 3, 0x32, -1, 0) == page
    number = {"x86_64": 323, "aarch64": 282}[platform.machine()]
    faults = libc.syscall(number, 0)
    assert faults >= 0, ctypes.get_errno()
    api = ctypes.create_string_buffer(struct.pack("QQQ", 0xaa, 0, 0))
    assert libc.ioctl(faults, ctypes.c_ulong(0xc018aa3f), api) == 0
    region = ctypes.create_string_buffer(struct.pack("QQQQ", page, 4096, 1, 0))
    assert libc.ioctl(faults, ctypes.c_ulong(0xc020aa00), region) == 0
print("ready", flush=True)
sys.stdin.read()
"#;

/// A broker with its own socket.
struct Running {
    child: Child,
    socket: PathBuf,
    directory: TempDir,
}

impl Running {
    fn start() -> Self {
        Self::of("root")
    }

    fn of(user: &str) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let socket = directory.path().join("attach.sock");
        let child = Command::new(env!("CARGO_BIN_EXE_rp"))
            .args(["attach", "--user", user, "--listen"])
            .arg(&socket)
            .spawn()
            .unwrap();
        let running = Self {
            child,
            socket,
            directory,
        };
        drop(running.raw());
        running
    }

    fn client(&self) -> Broker {
        Broker::at(&self.socket)
    }

    fn raw(&self) -> OwnedFd {
        let kind = SocketType::SEQPACKET;
        let socket = socket_with(AddressFamily::UNIX, kind, SocketFlags::CLOEXEC, None).unwrap();
        let address = SocketAddrUnix::new(&self.socket).unwrap();
        // The socket may not exist yet, or the broker may not listen.
        let began = Instant::now();
        while connect(&socket, &address).is_err() {
            assert!(began.elapsed() < PATIENCE, "refused");
            std::thread::sleep(Duration::from_millis(10));
        }
        socket
    }

    fn library(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    fn ends_its_forks(&self) {
        let pid = self.child.id();
        let children = format!("/proc/{pid}/task/{pid}/children");
        let began = Instant::now();
        while !fs::read_to_string(&children).unwrap().is_empty() {
            assert!(began.elapsed() < PATIENCE, "forks are left");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Returns the resident memory of the broker and of the processes of its connections, in kB.
    fn memory(&self) -> u64 {
        let own = self.child.id();
        let children = fs::read_to_string(format!("/proc/{own}/task/{own}/children")).unwrap();
        let children = children.split_whitespace().map(str::to_owned);
        let all = children.chain([own.to_string()]);
        let resident = all.filter_map(|id| {
            let status = fs::read_to_string(format!("/proc/{id}/status")).ok()?;
            let line = status
                .lines()
                .find_map(|line| line.strip_prefix("VmRSS:"))?;
            line.trim().trim_end_matches(" kB").parse::<u64>().ok()
        });
        resident.sum()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

/// A process that maps a library.
struct Mapping {
    child: Child,
    input: Option<ChildStdin>,
}

impl Mapping {
    fn start(library: &Path, how: &str) -> Self {
        let mut child = Command::new("python3")
            .args(["-c", PROCESS])
            .arg(library)
            .arg(how)
            .env_clear()
            .env("PATH", std::env::var("PATH").unwrap())
            .env("ROS_DOMAIN_ID", "42")
            .env("Z", "z".repeat(20_000))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        let mut output = BufReader::new(child.stdout.take().unwrap());
        output.read_line(&mut line).unwrap();
        assert_eq!(line, "ready\n");
        let input = child.stdin.take();
        Self { child, input }
    }

    fn id(&self) -> u32 {
        self.child.id()
    }

    fn place(&self, library: Library) -> Place {
        let used = Use::read(self.id(), library).unwrap();
        let id = used.libraries[0].id.clone();
        Place::Mapped {
            process: self.id(),
            id,
        }
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        drop(self.input.take());
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

fn send(socket: &OwnedFd, bytes: &[u8], descriptors: &[BorrowedFd<'_>]) -> rustix::io::Result<()> {
    let mut space = [std::mem::MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(253))];
    let mut ancillary = SendAncillaryBuffer::new(&mut space);
    if !descriptors.is_empty() {
        ancillary.push(SendAncillaryMessage::ScmRights(descriptors));
    }
    sendmsg(
        socket,
        &[IoSlice::new(bytes)],
        &mut ancillary,
        SendFlags::NOSIGNAL,
    )
    .map(drop)
}

/// Returns the next answer, or `None` if the broker has closed the connection.
fn receive(socket: &OwnedFd) -> Option<Value> {
    let mut bytes = vec![0; MAX_PACKET];
    let (length, _) = recv(socket, &mut bytes[..], RecvFlags::empty()).ok()?;
    serde_json::from_slice(&bytes[..length]).ok()
}

fn refusal<T: std::fmt::Debug>(answer: Result<T, BrokerError>) -> String {
    match answer.unwrap_err() {
        BrokerError::Refused(reason) => reason,
        error => panic!("{error}"),
    }
}

/// The kernel reads an environment only up to a page that a process would have to supply
/// (CVE-2018-1120).
#[test]
fn an_environment_whose_read_blocks_delays_no_request() {
    let running = Running::start();
    let library = running.library("libtracetools.so");
    fs::write(&library, vec![0; 4096]).unwrap();
    let stuck = Mapping::start(&library, "stuck");
    let mut broker = running.client();
    let began = Instant::now();
    for _ in 0..20 {
        assert_eq!(broker.domain(stuck.id()).unwrap(), Some(42));
    }
    assert!(
        began.elapsed() < Duration::from_secs(30),
        "{:?}",
        began.elapsed()
    );
    drop(broker);
    running.ends_its_forks();
}

#[test]
fn processes_with_a_library_are_listed_with_name_and_domain_and_others_are_not_read() {
    let running = Running::start();
    let library = running.library("libfastdds.so.3.1");
    fs::write(&library, vec![0; 4096]).unwrap();
    let process = Mapping::start(&library, "plain");
    let own = std::process::id();
    let mut broker = running.client();
    let all = broker.processes().unwrap();
    assert!(all.contains(&own) && all.contains(&process.id()));
    let users = broker.users(Library::FastDds, &all).unwrap();
    let (_, used) = users
        .used
        .iter()
        .find(|(id, _)| *id == process.id())
        .unwrap();
    assert_eq!(used.libraries[0].path, fs::canonicalize(&library).unwrap());
    assert!(users.used.iter().all(|(id, _)| *id != own));
    let state = broker.activities(&[process.id(), u32::MAX]).unwrap();
    assert_eq!(state.len(), 1);
    assert!(state[0].name.starts_with("python3"), "{state:?}");
    assert_eq!(broker.domain(process.id()).unwrap(), Some(42));
    // The agent must not read the environment of other processes.
    assert_eq!(broker.domain(own).unwrap(), None);
}

/// systemd holds the listening socket, and starts a broker at each connection without one.
#[test]
fn a_broker_whose_program_was_replaced_leaves_the_next_connection_to_the_new_one() {
    let directory = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let (path, program) = (
        directory.path().join("attach.sock"),
        directory.path().join("rp"),
    );
    let kind = SocketType::SEQPACKET;
    let listener = socket_with(AddressFamily::UNIX, kind, SocketFlags::CLOEXEC, None).unwrap();
    bind(&listener, &SocketAddrUnix::new(&path).unwrap()).unwrap();
    listen(&listener, 8).unwrap();
    let start = || {
        fs::hard_link(env!("CARGO_BIN_EXE_rp"), &program).unwrap();
        Command::new(&program)
            .args(["attach", "--user", "root"])
            .stdin(listener.try_clone().unwrap())
            .spawn()
            .unwrap()
    };
    let mut old = start();
    let mut agent = Broker::at(&path);
    agent.processes().unwrap();
    fs::remove_file(&program).unwrap();
    // The connection of the old agent stays until another one begins.
    agent.processes().unwrap();
    let asking = std::thread::spawn(move || Broker::at(&path).processes());
    assert!(old.wait().unwrap().success());
    let mut new = start();
    let answer = asking.join().unwrap();
    new.kill().unwrap();
    new.wait().unwrap();
    answer.unwrap();
}

#[test]
fn only_the_agents_user_and_root_may_connect() {
    let running = Running::of("daemon");
    let users = fs::read_to_string("/etc/passwd").unwrap();
    let line = users
        .lines()
        .find(|line| line.starts_with("daemon:"))
        .unwrap();
    let agent: u32 = line.split(':').nth(2).unwrap().parse().unwrap();
    let socket = &running.socket;
    // File permissions must not decide who may connect.
    let open = std::os::unix::fs::PermissionsExt::from_mode(0o755);
    fs::set_permissions(running.directory.path(), open).unwrap();
    let asks = |user: u32| {
        std::thread::scope(|scope| {
            let asking = scope.spawn(move || {
                // SAFETY: changes the user of this thread only.
                let changed = unsafe { libc::syscall(libc::SYS_setresuid, user, user, user) };
                assert_eq!(changed, 0);
                Broker::at(socket).processes().is_ok()
            });
            asking.join().unwrap()
        })
    };
    assert!(asks(0));
    assert!(asks(agent));
    assert!(!asks(65_534));
    assert!(asks(agent));
}

#[test]
fn requests_of_a_hostile_client_outside_the_closed_list_are_refused() {
    let mut running = Running::start();
    let (elf, tracing) = (running.library("huge"), running.library("libtracetools.so"));
    fs::write(&tracing, vec![0; 4096]).unwrap();
    let process = Mapping::start(&tracing, "plain");
    let mut broker = running.client();
    let null = File::open("/dev/null").unwrap();
    let program = [null.as_fd()];
    let attach = |broker: &mut Broker, calls, place| {
        refusal(broker.attach((calls, place, AttachMethod::Links), &program))
    };
    // Forged paths, links and processes.
    std::os::unix::fs::symlink("/etc/shadow", &elf).unwrap();
    for path in [
        "/etc/shadow",
        "/usr/lib/../../etc/shadow",
        "/proc/1/exe",
        elf.to_str().unwrap(),
    ] {
        let reason = attach(&mut broker, Calls::Messages, Place::Installed(path.into()));
        assert!(
            reason.starts_with("not a library in one of the usual"),
            "{reason}"
        );
    }
    let passwd = fs::metadata("/etc/passwd").unwrap();
    let inode = std::os::unix::fs::MetadataExt::ino(&passwd);
    for (of, device, inode) in [
        (process.id(), "fe:00", inode),
        (std::process::id(), "fe:00", inode),
        (1, "", 0),
        (u32::MAX, "fe:00", u64::MAX),
    ] {
        let id = LibraryId {
            device: device.to_owned(),
            inode,
        };
        let reason = attach(
            &mut broker,
            Calls::Callbacks,
            Place::Mapped { process: of, id },
        );
        assert!(
            reason.contains("does not map it") || reason.contains("cannot open the library"),
            "{reason}"
        );
    }
    // A library of one kind is refused as the other kind, and a descriptor is not a program.
    let reason = attach(
        &mut broker,
        Calls::SharedMemory,
        process.place(Library::Tracing),
    );
    assert!(reason.contains("does not map it"), "{reason}");
    let reason = attach(
        &mut broker,
        Calls::Messages,
        process.place(Library::Tracing),
    );
    assert!(
        reason.contains("not a library for this machine"),
        "{reason}"
    );
    let reason = refusal(broker.attach(
        (
            Calls::Messages,
            process.place(Library::Tracing),
            AttachMethod::PerfEvents,
        ),
        &[null.as_fd(); 253],
    ));
    assert!(reason.contains("BPF programs"), "{reason}");

    // A packet that is not a request ends only its own connection.
    for bytes in [
        &b"x"[..],
        b"{}",
        br#"{"number":1,"content":"shutdown"}"#,
        br#"{"number":1,"content":{"domain":{"process":-1}}}"#,
        br#"{"number":1,"content":{"domain":{"process":1,"address":4096}}}"#,
        &[b'['; 60_000],
        &[b' '; 100_000],
    ] {
        let socket = running.raw();
        send(&socket, bytes, &[null.as_fd()]).unwrap();
        assert_eq!(
            receive(&socket),
            None,
            "{:?}",
            &bytes[..bytes.len().min(40)]
        );
    }
    assert!(broker.processes().is_ok());
    assert_eq!(running.child.try_wait().unwrap(), None);
}

#[test]
fn ten_thousand_requests_and_clients_that_never_read_leave_the_memory_unchanged() {
    let running = Running::start();
    let before = running.memory();
    let mut broker = running.client();
    let all = broker.processes().unwrap();
    let requests = 10_000;
    let socket = running.raw();
    let own = std::process::id();
    let began = Instant::now();
    std::thread::scope(|scope| {
        let sending = scope.spawn(|| {
            for number in 0..requests {
                let request = json!({"number": number, "content": {"domain": {"process": own}}});
                send(&socket, request.to_string().as_bytes(), &[]).unwrap();
            }
        });
        for number in 0..requests {
            let mut answer = receive(&socket).unwrap();
            // On a busy machine, a request that is aborted after its answer has two.
            if answer["number"] == json!(number - 1) {
                assert!(answer["content"]["refused"].is_string(), "{answer}");
                answer = receive(&socket).unwrap();
            }
            assert_eq!(answer["number"], number);
        }
        sending.join().unwrap();
    });
    println!("{requests} requests took {:.1?}", began.elapsed());
    // The broker gives up clients that never read, and another client is still answered.
    let deaf: Vec<_> = (0..3).map(|_| running.raw()).collect();
    for socket in &deaf {
        set_socket_timeout(socket, Timeout::Send, Some(Duration::from_millis(500))).unwrap();
        let request = br#"{"number":1,"content":"processes"}"#;
        while send(socket, request, &[]).is_ok() {}
    }
    let began = Instant::now();
    assert_eq!(broker.processes().unwrap().is_empty(), all.is_empty());
    assert!(
        began.elapsed() < Duration::from_secs(30),
        "{:?}",
        began.elapsed()
    );
    drop(deaf);
    // Connections beyond the maximum number wait, and none is lost.
    drop((broker, socket));
    let many: Vec<_> = (0..16).map(|_| running.raw()).collect();
    for socket in many {
        send(&socket, br#"{"number":1,"content":"processes"}"#, &[]).unwrap();
        assert!(receive(&socket).is_some());
    }
    // The processes of closed connections end a moment later.
    running.ends_its_forks();
    let after = running.memory();
    assert!(
        after < before + 4096,
        "{before} kB before, {after} kB after"
    );
}

#[test]
fn without_a_socket_or_beside_another_broker_the_broker_ends_with_a_clear_error() {
    let running = Running::start();
    let run = |command: &mut Command| {
        let output = command.stdin(Stdio::null()).output().unwrap();
        assert!(!output.status.success());
        String::from_utf8(output.stderr).unwrap()
    };
    let alone = run(Command::new(env!("CARGO_BIN_EXE_rp")).arg("attach"));
    assert!(alone.contains("standard input is not a socket"), "{alone}");
    let second = run(Command::new(env!("CARGO_BIN_EXE_rp"))
        .args(["attach", "--user", "root", "--listen"])
        .arg(&running.socket));
    assert!(second.contains("another broker listens at"), "{second}");
    assert!(running.client().processes().is_ok());
}
