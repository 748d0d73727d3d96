//! Answers a request in a fork. Nothing that the request names is trusted.

use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::{self, Read as _};
use std::os::fd::{AsFd as _, OwnedFd};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use super::Peer;
use crate::attach::attach;
use crate::functions::{Calls, Library};
use crate::kernel;
use crate::mapped::{Mapped, Use};
use crate::open::open;
use crate::request::{
    Activity, Answer, AttachMethod, MAX_DESCRIPTORS, MAX_PROCESSES, Place, Request,
};

/// Number of process ids in one packet.
const IDS_PER_PACKET: usize = 4096;
/// Number of libraries in one packet, each with a short path.
const LIBRARIES_PER_PACKET: usize = 16;
/// Maximum number of characters of a path, which is shown and not opened.
const MAX_PATH: usize = 256;
/// Number of states of processes in one packet.
const STATES_PER_PACKET: usize = 128;
/// Maximum number of process ids: a host has this many unless configured otherwise.
const MAX_IDS: usize = 1 << 16;
/// Time for the maps of one request. The remaining processes count as unreadable.
const MAPS_TIMEOUT: Duration = Duration::from_secs(2);
/// Maximum number of bytes of `/proc/<pid>/stat`, and of an environment.
const MAX_STAT: u64 = 4096;
const MAX_ENVIRONMENT: u64 = 256 << 10;
/// Variable with the domain of a ROS process.
const DOMAIN_VARIABLE: &[u8] = b"ROS_DOMAIN_ID=";
/// Maximum number of characters of the description of a cause.
const MAX_REASON: usize = 1024;

/// Function that takes each part of an answer with its descriptors.
pub(crate) type Sink<'a> = &'a mut dyn FnMut(Answer, Vec<OwnedFd>) -> io::Result<()>;

/// Answers a request with the rights of the calling process. `given` has the descriptors that came
/// with the request.
///
/// # Errors
/// Fails if the sink fails, or if `/proc` cannot be read.
pub(crate) fn answer(
    peer: Peer,
    request: Request,
    given: &[OwnedFd],
    sink: Sink<'_>,
) -> io::Result<()> {
    match request {
        Request::Processes => processes(sink),
        Request::Uses { library, processes } => uses(library, &processes, sink),
        Request::Activities { processes } => activities(&processes, sink),
        Request::Domain { process } => sink(Answer::Domain(domain(process)), Vec::new()),
        Request::Attach {
            calls,
            place,
            means,
        } => attached(peer, (calls, &place, means), given, sink),
        Request::Mappings => mappings(peer, sink),
    }
}

fn processes(sink: Sink<'_>) -> io::Result<()> {
    let entries = fs::read_dir("/proc")?.flatten();
    let ids = entries.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
    let ids: Vec<_> = ids.take(MAX_IDS).collect();
    for part in ids.chunks(IDS_PER_PACKET) {
        sink(Answer::Processes(part.to_vec()), Vec::new())?;
    }
    sink(Answer::End, Vec::new())
}

fn uses(library: Library, processes: &[u32], sink: Sink<'_>) -> io::Result<()> {
    let mut closed = Vec::new();
    let began = Instant::now();
    for process in processes.iter().take(MAX_PROCESSES) {
        // A few processes with very long maps must not hide the others.
        if began.elapsed() > MAPS_TIMEOUT {
            closed.push(*process);
            continue;
        }
        match Use::read(*process, library) {
            Ok(use_of_it) if use_of_it.is_any() => used(*process, use_of_it, sink)?,
            Err(error) if error.kind() == io::ErrorKind::PermissionDenied => {
                closed.push(*process);
            }
            Ok(_) | Err(_) => {}
        }
    }
    let used = Vec::new();
    sink(Answer::Uses { used, closed }, Vec::new())?;
    sink(Answer::End, Vec::new())
}

/// Sends the libraries of a process in parts.
fn used(process: u32, used: Use, sink: Sink<'_>) -> io::Result<()> {
    let shares = used.shares;
    let libraries: Vec<_> = used.libraries.into_iter().map(shortened).collect();
    // A process that links the library statically has no file of it.
    let none = libraries.is_empty().then_some(&[][..]);
    for part in libraries.chunks(LIBRARIES_PER_PACKET).chain(none) {
        let libraries = part.to_vec();
        let part = Use { libraries, shares };
        let (used, closed) = (vec![(process, part)], Vec::new());
        sink(Answer::Uses { used, closed }, Vec::new())?;
    }
    Ok(())
}

fn activities(processes: &[u32], sink: Sink<'_>) -> io::Result<()> {
    for part in processes
        .chunks(STATES_PER_PACKET)
        .take(MAX_PROCESSES / STATES_PER_PACKET)
    {
        let states = part.iter().filter_map(|process| activity(*process));
        sink(Answer::Activities(states.collect()), Vec::new())?;
    }
    sink(Answer::End, Vec::new())
}

fn attached(
    peer: Peer,
    (calls, place, means): (Calls, &Place, AttachMethod),
    given: &[OwnedFd],
    sink: Sink<'_>,
) -> io::Result<()> {
    let Peer {
        process: peer_pid,
        user: peer_uid,
    } = peer;
    let (file, path) = match open(place, calls.library()) {
        Ok(opened) => opened,
        Err(error) => {
            let reason = in_words(&error);
            tracing::warn!(
                peer_pid,
                peer_uid,
                ?calls,
                ?place,
                reason,
                "refused to attach"
            );
            return sink(Answer::Refused(reason), Vec::new());
        }
    };
    let library = path.display();
    let programs: Vec<_> = given.iter().map(OwnedFd::as_fd).collect();
    match attach(&file, calls, means, &programs) {
        Ok(attached) => {
            let functions = attached.functions;
            tracing::info!(peer_pid, peer_uid, %library, functions = functions.len(), "attached");
            sink(Answer::Attached { functions }, attached.descriptors)
        }
        Err(error) => {
            let reason = in_words(&error);
            tracing::warn!(peer_pid, peer_uid, %library, reason, "refused to attach");
            sink(Answer::Refused(reason), Vec::new())
        }
    }
}

fn mappings(peer: Peer, sink: Sink<'_>) -> io::Result<()> {
    let online = fs::read_to_string("/sys/devices/system/cpu/online")?;
    let events = cpus(&online)
        .take(MAX_DESCRIPTORS)
        .map(kernel::mapping_event);
    match events.collect::<io::Result<Vec<_>>>() {
        Ok(events) => {
            let Peer {
                process: peer_pid,
                user: peer_uid,
            } = peer;
            tracing::info!(
                peer_pid,
                peer_uid,
                cpus = events.len(),
                "opened events of mapped files"
            );
            sink(Answer::Mappings, events)
        }
        Err(error) => sink(Answer::Refused(in_words(&error)), Vec::new()),
    }
}

/// Returns the domain of a process that uses ROS 2. The environment is read for nothing else, and
/// not of other processes.
fn domain(process: u32) -> Option<u32> {
    let uses = |library| Use::read(process, library).is_ok_and(|used| used.is_any());
    if !uses(Library::Tracing) && !uses(Library::FastDds) {
        return None;
    }
    let mut environment = Vec::new();
    let file = File::open(format!("/proc/{process}/environ")).ok()?;
    file.take(MAX_ENVIRONMENT)
        .read_to_end(&mut environment)
        .ok()?;
    Some(domain_in(&environment))
}

fn domain_in(environment: &[u8]) -> u32 {
    let mut variables = environment.split(|byte| *byte == 0);
    let value = variables.find_map(|variable| variable.strip_prefix(DOMAIN_VARIABLE));
    let value = value.and_then(|value| std::str::from_utf8(value).ok()?.trim().parse().ok());
    value.unwrap_or(0)
}

/// Reads the state of a process; `None` if it has ended.
fn activity(process: u32) -> Option<Activity> {
    let mut bytes = Vec::new();
    let file = File::open(format!("/proc/{process}/stat")).ok()?;
    file.take(MAX_STAT).read_to_end(&mut bytes).ok()?;
    // A name may contain any bytes.
    let text = String::from_utf8_lossy(&bytes);
    parsed(process, &text, kernel::ticks_per_second())
}

fn parsed(process: u32, text: &str, ticks_per_second: u64) -> Option<Activity> {
    // The name may contain spaces and parentheses.
    let (head, rest) = text.rsplit_once(')')?;
    let (_, name) = head.split_once('(')?;
    let fields: Vec<_> = rest.split_ascii_whitespace().collect();
    // The state is field 3 and comes first here.
    let field = |number: usize| fields.get(number - 3)?.parse::<u64>().ok();
    if matches!(*fields.first()?, "Z" | "X" | "x") {
        return None;
    }
    let ticks = field(14)?.checked_add(field(15)?)?;
    let nanoseconds = u128::from(ticks) * 1_000_000_000 / u128::from(ticks_per_second.max(1));
    Some(Activity {
        process,
        name: name.to_owned(),
        cpu_nanoseconds: u64::try_from(nanoseconds).unwrap_or(u64::MAX),
        started: field(22)?,
    })
}

fn shortened(mapped: Mapped) -> Mapped {
    let path = mapped.path.to_string_lossy();
    let beyond = path.chars().count().saturating_sub(MAX_PATH);
    // The end of a path identifies the library.
    let path = path.chars().skip(beyond).collect::<String>();
    Mapped {
        path: PathBuf::from(path),
        ..mapped
    }
}

/// Returns the numbers of a list such as `0-3,5`.
fn cpus(list: &str) -> impl Iterator<Item = i32> {
    list.trim().split(',').flat_map(|range| {
        let (first, last) = range.split_once('-').unwrap_or((range, range));
        let ends = first.parse().ok().zip(last.parse().ok());
        ends.into_iter().flat_map(|(first, last)| first..=last)
    })
}

/// Returns an error with its causes in one line, cut to [`MAX_REASON`].
fn in_words(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(each) = cause {
        let _ = write!(text, ": {each}");
        cause = each.source();
    }
    text.chars().take(MAX_REASON).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::request::Numbered;

    #[test]
    fn a_list_of_cpus_is_parsed_into_numbers() {
        assert_eq!(cpus("0-3,5\n").collect::<Vec<_>>(), [0, 1, 2, 3, 5]);
        assert_eq!(cpus("0\n").collect::<Vec<_>>(), [0]);
        assert_eq!(cpus("").count(), 0);
    }

    #[test]
    fn a_process_name_with_parentheses_is_read_whole() {
        let text = "42 (a) b (c) S 1 1 1 0 -1 0 0 0 0 0 250 50 0 0 20 0 1 0 777 0";
        let activity = parsed(42, text, 100).unwrap();
        assert_eq!(activity.name, "a) b (c");
        assert_eq!(activity.cpu_nanoseconds, 3_000_000_000);
        assert_eq!(activity.started, 777);
        assert_eq!(parsed(42, &text.replace(" S ", " Z "), 100), None);
        for end in 0..40 {
            let _ = parsed(42, &text[..end], 100);
        }
    }

    #[test]
    fn the_domain_is_read_from_the_environment() {
        assert_eq!(domain_in(b"A=1\0ROS_DOMAIN_ID=42\0B=2\0"), 42);
        for without in [
            &b"A=1\0"[..],
            b"ROS_DOMAIN_ID=\0",
            b"ROS_DOMAIN_ID=x\0",
            b"",
        ] {
            assert_eq!(domain_in(without), 0);
        }
    }

    #[test]
    fn the_environment_of_a_process_without_ros_is_not_read() {
        assert_eq!(domain(std::process::id()), None);
        assert_eq!(domain(u32::MAX), None);
    }

    #[test]
    fn the_longest_answers_do_not_exceed_a_packet() {
        let mapped = Mapped {
            id: crate::mapped::LibraryId {
                device: "ffff:ffff".to_owned(),
                inode: u64::MAX,
            },
            path: PathBuf::from("/\u{1}".repeat(4096)),
            range: "ffffffffffffffff-ffffffffffffffff".to_owned(),
        };
        let libraries = vec![shortened(mapped); LIBRARIES_PER_PACKET];
        let used = vec![(
            u32::MAX,
            Use {
                libraries,
                shares: true,
            },
        )];
        let activity = Activity {
            process: u32::MAX,
            name: "\u{1}".repeat(64),
            cpu_nanoseconds: u64::MAX,
            started: u64::MAX,
        };
        for content in [
            Answer::Uses {
                used,
                closed: Vec::new(),
            },
            Answer::Uses {
                used: Vec::new(),
                closed: vec![u32::MAX; MAX_PROCESSES],
            },
            Answer::Activities(vec![activity; STATES_PER_PACKET]),
            Answer::Processes(vec![u32::MAX; IDS_PER_PACKET]),
            Answer::Refused("\u{1}".repeat(MAX_REASON)),
        ] {
            let bytes = serde_json::to_vec(&Numbered {
                number: u64::MAX,
                content,
            })
            .unwrap();
            assert!(bytes.len() <= crate::request::MAX_PACKET, "{}", bytes.len());
        }
    }
}
