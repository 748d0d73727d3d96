//! Memory that never answers holds up neither the reader's other answers nor its end.

use std::fs::File;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::process::{Child, Command, Stdio};

/// Prints the addresses of a text, and of a page whose faults stay open (userfaultfd(2)).
const STUCK: &str = r#"
import ctypes, mmap, platform, struct, sys
libc = ctypes.CDLL(None, use_errno=True)
libc.mmap.restype = ctypes.c_void_p
text = ctypes.create_string_buffer(b"ROS_DOMAIN_ID=42")
page = libc.mmap(None, ctypes.c_size_t(4096), 3, 0x22, -1, 0)
number = {"x86_64": 323, "aarch64": 282}[platform.machine()]
faults = libc.syscall(number, 0)
assert faults >= 0, ctypes.get_errno()
api = ctypes.create_string_buffer(struct.pack("QQQ", 0xaa, 0, 0))
assert libc.ioctl(faults, ctypes.c_ulong(0xc018aa3f), api) == 0
region = ctypes.create_string_buffer(struct.pack("QQQQ", page, 4096, 1, 0))
assert libc.ioctl(faults, ctypes.c_ulong(0xc020aa00), region) == 0
print(ctypes.addressof(text), page, flush=True)
sys.stdin.read()
"#;
const FAILED: u32 = u32::MAX;

struct Reader {
    child: Child,
    socket: Option<File>,
}

impl Reader {
    fn start() -> Self {
        let (own, other) = UnixStream::pair().unwrap();
        let child = Command::new(env!("CARGO_BIN_EXE_rp"))
            .arg("memory-reader")
            .stdin(Stdio::from(OwnedFd::from(other)))
            .spawn()
            .unwrap();
        Self {
            child,
            socket: Some(File::from(OwnedFd::from(own))),
        }
    }

    fn read(&mut self, process: u32, address: u64, length: u32) -> Option<Vec<u8>> {
        let socket = self.socket.as_mut().unwrap();
        let words = [process.to_ne_bytes(), length.to_ne_bytes()].concat();
        let request = [words, address.to_ne_bytes().to_vec()].concat();
        socket.write_all(&request).unwrap();
        let mut head = [0; 4];
        socket.read_exact(&mut head).unwrap();
        let length = u32::from_ne_bytes(head);
        let mut bytes = vec![0; if length == FAILED { 0 } else { length as usize }];
        socket.read_exact(&mut bytes).unwrap();
        (length != FAILED).then_some(bytes)
    }
}

#[test]
fn memory_that_never_answers_delays_no_other_answer_and_no_end() {
    let mut stuck = Command::new("python3")
        .args(["-c", STUCK])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    let mut output = BufReader::new(stuck.stdout.take().unwrap());
    output.read_line(&mut line).unwrap();
    let (text, page) = line.trim().split_once(' ').unwrap();
    let (text, page) = (text.parse().unwrap(), page.parse().unwrap());
    let process = stuck.id();

    let mut reader = Reader::start();
    let known = Some(b"ROS_DOMAIN_ID=42".to_vec());
    assert_eq!(reader.read(process, text, 16), known);
    assert_eq!(reader.read(process, 8, 16), None);
    assert_eq!(reader.read(process, page, 16), None);
    assert_eq!(reader.read(process, text, 16), known);
    // Forks that do not answer are left behind, but only so many.
    let refused = (0..10).filter(|_| reader.read(process, page, 16).is_none());
    assert_eq!(refused.count(), 10);
    let pid = reader.child.id();
    let forks = std::fs::read_to_string(format!("/proc/{pid}/task/{pid}/children")).unwrap();
    assert!(forks.split_whitespace().count() <= 8, "{forks}");
    reader.socket = None;
    assert!(reader.child.wait().unwrap().success());

    drop(stuck.stdin.take());
    stuck.kill().unwrap();
    stuck.wait().unwrap();
}
