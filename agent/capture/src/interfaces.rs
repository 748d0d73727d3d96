//! The interfaces of a network namespace: lists them, reports changes, and selects those that the
//! configuration includes.
//!
//! It uses rtnetlink (`man 7 rtnetlink`), changes no interface, and sends nothing to the network.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{self, Read, Write};
use std::mem::size_of_val;
use std::os::fd::{AsFd, BorrowedFd, FromRawFd, OwnedFd};

use crate::container::{FAMILIES_LINE, is_service};
use crate::tables::KnownInterfaces;
use globset::{Glob, GlobSet, GlobSetBuilder};
use ros2probe_model::facts::bounded::Bounded;
use ros2probe_wire::{Cursor, Endianness, WireError};

/// Maximum size of a kernel message about one interface, in bytes.
const MAX_MESSAGE_BYTES: usize = 64 << 10;
const IFLA_IFNAME: u16 = 3;
/// Maximum number of attempts to read a list that changes while the kernel writes it.
const MAX_ATTEMPTS: u32 = 5;

/// One interface.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Interface {
    /// Its index, unique in its namespace.
    pub index: u32,
    /// Its name.
    pub name: String,
    /// Its `ARPHRD_` number: 1 Ethernet, 772 loopback, 65534 none (tun).
    pub hardware: u16,
    /// Whether it is administratively up.
    pub up: bool,
}

/// What happened to an interface.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Change {
    /// The interface appeared, was renamed, or went up or down.
    Present(Interface),
    /// The interface was deleted or moved to another namespace.
    Gone(Interface),
}

/// Why the interfaces cannot be listed.
#[derive(Debug, thiserror::Error)]
pub enum InterfacesError {
    /// The service manager forbids the socket.
    #[error(
        "cannot list the network interfaces: the unit needs `{FAMILIES_LINE}` (`systemctl edit`)"
    )]
    Family(#[source] io::Error),
    /// A system call failed.
    #[error("cannot list the network interfaces: {call} failed")]
    System {
        /// Name of the system call.
        call: &'static str,
        /// Error of the system call.
        source: io::Error,
    },
    /// The kernel's answer cannot be parsed.
    #[error("cannot list the network interfaces: the kernel's answer is malformed")]
    Unreadable(#[from] WireError),
    /// The list changed during every attempt.
    #[error("cannot list the network interfaces: they change faster than they can be listed")]
    Unstable,
}

type Known = Bounded<KnownInterfaces, BTreeMap<u32, Interface>>;

/// The interfaces of the namespace in which the socket was opened.
#[derive(Debug)]
pub struct Interfaces {
    socket: File,
    known: Known,
    sequence: u32,
    buffer: Vec<u8>,
    /// Whether changes were missed, so that only a new list is correct.
    is_stale: bool,
}

/// Selects interfaces by name.
#[derive(Clone, Debug)]
pub struct Selection {
    include: GlobSet,
    exclude: GlobSet,
    /// Interfaces included by name, not by a pattern.
    named: BTreeSet<String>,
}

impl Interfaces {
    /// Lists the interfaces of the calling thread's namespace, and subscribes to changes.
    ///
    /// # Errors
    /// Fails if the kernel refuses the socket or the list.
    pub fn open() -> Result<Self, InterfacesError> {
        let socket = File::from(listen()?);
        let mut interfaces = Self {
            socket,
            known: Known::default(),
            sequence: 0,
            buffer: vec![0; MAX_MESSAGE_BYTES],
            is_stale: false,
        };
        interfaces.list(&mut Vec::new())?;
        Ok(interfaces)
    }

    /// Iterates over all interfaces, by index.
    pub fn iter(&self) -> impl Iterator<Item = &Interface> {
        self.known.values()
    }

    /// Returns the interface with this index; `None` if it is unknown.
    #[must_use]
    pub fn by_index(&self, index: u32) -> Option<&Interface> {
        self.known.get(&index)
    }

    /// Returns the changes since the last call. Does not wait. If the kernel reports an error, known
    /// interfaces stay known, and the next call lists all.
    pub fn changes(&mut self) -> Vec<Change> {
        let mut changes = Vec::new();
        // A message that cannot be read may be a change.
        self.is_stale |= self.drain(&mut changes).unwrap_or(true);
        if self.is_stale {
            self.is_stale = self.list(&mut changes).is_err();
        }
        changes
    }

    /// Reads waiting messages; returns `true` if the kernel dropped some.
    fn drain(&mut self, changes: &mut Vec<Change>) -> Result<bool, InterfacesError> {
        let mut lost = false;
        loop {
            match self.socket.read(&mut self.buffer) {
                Ok(count) => {
                    let known = &mut self.known;
                    let bytes = self.buffer.get(..count).unwrap_or_default();
                    read(bytes, |message| changes.extend(apply(known, message)))?;
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(lost),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if error.raw_os_error() == Some(libc::ENOBUFS) => lost = true,
                Err(source) => {
                    return Err(InterfacesError::System {
                        call: "read",
                        source,
                    });
                }
            }
        }
    }

    /// Requests all interfaces and compares them with the known ones. Also after an error, `changes`
    /// has every change of the known ones.
    fn list(&mut self, changes: &mut Vec<Change>) -> Result<(), InterfacesError> {
        'attempt: for _ in 0..MAX_ATTEMPTS {
            // Waiting messages are older than the list, and messages after them may be lost.
            self.drain(changes)?;
            self.request()?;
            let mut listed = BTreeSet::new();
            let mut interrupted = false;
            loop {
                let count = match self.socket.read(&mut self.buffer) {
                    Ok(count) => count,
                    Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                    Err(error) if error.raw_os_error() == Some(libc::ENOBUFS) => continue 'attempt,
                    Err(source) => {
                        return Err(InterfacesError::System {
                            call: "read",
                            source,
                        });
                    }
                };
                let (known, sequence) = (&mut self.known, self.sequence);
                let mut done = None;
                read(self.buffer.get(..count).unwrap_or_default(), |message| {
                    let answer = message.sequence == sequence;
                    interrupted |= answer && message.flags & libc::NLM_F_DUMP_INTR != 0;
                    match &message.body {
                        Body::Present(interface) => {
                            listed.insert(interface.index);
                        }
                        Body::Gone(index) => {
                            listed.remove(index);
                        }
                        Body::End(error) if answer => done = Some(*error),
                        Body::End(_) | Body::Other => {}
                    }
                    changes.extend(apply(known, message));
                })?;
                match done {
                    None => {}
                    Some(0) if interrupted => continue 'attempt,
                    Some(0) => {
                        self.known.retain(|index, interface| {
                            let is_listed = listed.contains(index);
                            if !is_listed {
                                changes.push(Change::Gone(interface.clone()));
                            }
                            is_listed
                        });
                        return Ok(());
                    }
                    Some(error) => {
                        let source = io::Error::from_raw_os_error(error.saturating_neg());
                        return Err(InterfacesError::System {
                            call: "RTM_GETLINK",
                            source,
                        });
                    }
                }
            }
        }
        Err(InterfacesError::Unstable)
    }

    fn request(&mut self) -> Result<(), InterfacesError> {
        self.sequence = self.sequence.wrapping_add(1);
        let mut request = Vec::with_capacity(32);
        request.extend_from_slice(&32_u32.to_ne_bytes());
        request.extend_from_slice(&libc::RTM_GETLINK.to_ne_bytes());
        request.extend_from_slice(&(NLM_F_REQUEST | NLM_F_DUMP).to_ne_bytes());
        request.extend_from_slice(&self.sequence.to_ne_bytes());
        // The port is 0, because the kernel assigns it. An ifinfomsg follows that requests every
        // interface.
        request.extend_from_slice(&[0; 4 + 16]);
        self.socket
            .write_all(&request)
            .map_err(|source| InterfacesError::System {
                call: "write",
                source,
            })
    }
}

impl AsFd for Interfaces {
    /// Returns a descriptor that is readable when changes wait.
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

impl Selection {
    /// Compiles globs such as `eth*`. Without any `include`, every interface is included.
    ///
    /// # Errors
    /// Fails if a glob is invalid.
    pub fn new(include: &[String], exclude: &[String]) -> Result<Self, globset::Error> {
        let set = |globs: &[String]| {
            let mut builder = GlobSetBuilder::new();
            for glob in globs {
                builder.add(Glob::new(glob)?);
            }
            builder.build()
        };
        Ok(Self {
            include: set(include)?,
            exclude: set(exclude)?,
            named: include.iter().cloned().collect(),
        })
    }

    /// Returns whether an interface of this name is observed.
    #[must_use]
    pub fn accepts(&self, name: &str) -> bool {
        (self.include.is_empty() || self.include.is_match(name)) && !self.exclude.is_match(name)
    }

    /// Returns whether the configuration contains exactly this name.
    #[must_use]
    pub fn names(&self, name: &str) -> bool {
        self.named.contains(name) && self.accepts(name)
    }

    /// Iterates over the names of accepted interfaces that the configuration contains exactly, not
    /// as a pattern.
    pub fn exact_names(&self) -> impl Iterator<Item = &str> {
        let is_pattern = |name: &str| name.contains(['*', '?', '[', '{', '\\']);
        let names = self.named.iter().map(String::as_str);
        names.filter(move |name| !is_pattern(name) && self.accepts(name))
    }

    /// Returns whether an interface is observed before its name is known. Interfaces outside of
    /// `include` or in `exclude` must not be observed even briefly.
    #[must_use]
    pub fn accepts_unknown(&self) -> bool {
        self.include.is_empty() && self.exclude.is_empty()
    }
}

/// The relevant fields of one netlink message.
struct Message {
    flags: i32,
    sequence: u32,
    body: Body,
}

enum Body {
    Present(Interface),
    Gone(u32),
    /// End of a list, or an error instead: 0 or a negative error number.
    End(i32),
    Other,
}

const NLM_F_REQUEST: u16 = 1;
const NLM_F_DUMP: u16 = 0x300;
const _: () = assert!(libc::NLM_F_REQUEST == 1 && libc::NLM_F_DUMP == 0x300);

fn apply(known: &mut Known, message: Message) -> Option<Change> {
    match message.body {
        Body::Present(interface) => {
            let is_known = known.get(&interface.index) == Some(&interface);
            if !is_known {
                known.insert(interface.index, interface.clone());
            }
            (!is_known).then_some(Change::Present(interface))
        }
        Body::Gone(index) => known.remove(&index).map(Change::Gone),
        Body::End(_) | Body::Other => None,
    }
}

/// Parses the messages of one datagram.
fn read(bytes: &[u8], mut sink: impl FnMut(Message)) -> Result<(), WireError> {
    const NATIVE_ENDIANNESS: Endianness = if cfg!(target_endian = "big") {
        Endianness::Big
    } else {
        Endianness::Little
    };
    let mut cursor = Cursor::new(bytes, NATIVE_ENDIANNESS);
    while cursor.remaining() > 0 {
        let length = cursor.u32("netlink length")?;
        let body = usize::try_from(length)
            .unwrap_or(usize::MAX)
            .saturating_sub(4);
        let mut message = cursor.sub("netlink message", body)?;
        cursor.align(4);
        let kind = message.u16("netlink type")?;
        let flags = i32::from(message.u16("netlink flags")?);
        let sequence = message.u32("netlink sequence")?;
        message.u32("netlink port")?;
        let body = match kind {
            libc::RTM_NEWLINK | libc::RTM_DELLINK => link(kind, message)?,
            // NLMSG_ERROR and NLMSG_DONE both begin with the error number.
            2 | 3 => Body::End(message.i32("netlink error")?),
            _ => Body::Other,
        };
        sink(Message {
            flags,
            sequence,
            body,
        });
    }
    Ok(())
}

fn link(kind: u16, mut cursor: Cursor<'_>) -> Result<Body, WireError> {
    let family = cursor.u8("link family")?;
    cursor.u8("link padding")?;
    let hardware = cursor.u16("link type")?;
    let index = cursor.u32("link index")?;
    let flags = cursor.u32("link flags")?;
    cursor.u32("link change")?;
    // Bridges send the same message about their ports: a port that leaves the bridge is not
    // deleted.
    if i32::from(family) != libc::AF_UNSPEC {
        return Ok(Body::Other);
    }
    if kind == libc::RTM_DELLINK {
        return Ok(Body::Gone(index));
    }
    let up = flags & 1 != 0;
    while cursor.remaining() >= 4 {
        let length = usize::from(cursor.u16("attribute length")?);
        let code = cursor.u16("attribute type")?;
        let mut value = cursor.sub("attribute", length.saturating_sub(4))?;
        cursor.align(4);
        if code & 0x3fff == IFLA_IFNAME {
            let name = value.take("interface name", value.remaining())?;
            let name = name.split(|byte| *byte == 0).next().unwrap_or_default();
            let name = String::from_utf8_lossy(name).into_owned();
            return Ok(Body::Present(Interface {
                index,
                name,
                hardware,
                up,
            }));
        }
    }
    Ok(Body::Other)
}

fn listen() -> Result<OwnedFd, InterfacesError> {
    let failed = |call, source| InterfacesError::System { call, source };
    let kind = libc::SOCK_RAW | libc::SOCK_CLOEXEC | libc::SOCK_NONBLOCK;
    // SAFETY: the call takes no pointers.
    let fd = unsafe { libc::socket(libc::AF_NETLINK, kind, libc::NETLINK_ROUTE) };
    if fd < 0 {
        let source = io::Error::last_os_error();
        return Err(match source.raw_os_error() {
            Some(libc::EAFNOSUPPORT) if is_service() => InterfacesError::Family(source),
            _ => failed("socket(NETLINK_ROUTE)", source),
        });
    }
    // SAFETY: the descriptor is new and has no other owner.
    let socket = unsafe { OwnedFd::from_raw_fd(fd) };
    // SAFETY: the struct has only integers, for which 0 is valid.
    let mut address: libc::sockaddr_nl = unsafe { std::mem::zeroed() };
    address.nl_family = libc::AF_NETLINK as libc::sa_family_t;
    address.nl_groups = libc::RTMGRP_LINK as u32;
    let length = size_of_val(&address) as libc::socklen_t;
    // SAFETY: `address` is a whole sockaddr_nl and `length` its size.
    if unsafe { libc::bind(fd, (&raw const address).cast(), length) } < 0 {
        return Err(failed("bind(NETLINK_ROUTE)", io::Error::last_os_error()));
    }
    Ok(socket)
}

#[cfg(test)]
mod tests {
    use std::os::unix::net::UnixDatagram;

    use super::*;
    use crate::netns::tests::{in_new_namespace, ip};
    use crate::tables::tests::assert_driven;

    fn globs(list: &[&str]) -> Vec<String> {
        list.iter().map(|glob| (*glob).to_owned()).collect()
    }

    fn change(changes: &[Change], name: &str) -> Option<Change> {
        let named = |change: &&Change| match change {
            Change::Present(interface) | Change::Gone(interface) => interface.name == name,
        };
        changes.iter().rfind(named).cloned()
    }

    #[test]
    fn exclusion_wins_over_inclusion() {
        let all = Selection::new(&[], &[]).unwrap();
        assert!(all.accepts("eth0") && all.accepts_unknown());
        let some = Selection::new(&globs(&["eth*", "lo"]), &globs(&["eth1"])).unwrap();
        let accepted = ["eth0", "eth1", "lo", "wlan0"].map(|name| some.accepts(name));
        assert_eq!(accepted, [true, false, true, false]);
        assert!(!some.accepts_unknown());
        let most = Selection::new(&[], &globs(&["docker*"])).unwrap();
        assert!(most.accepts("eth0") && !most.accepts("docker0") && !most.accepts_unknown());
        assert!(Selection::new(&globs(&["eth["]), &[]).is_err());
    }

    #[test]
    fn exact_names_are_accepted_names_without_a_pattern() {
        let include = globs(&["eth0", "wlan*", "vcan?", "en[op]0", "can{0,1}", "lo"]);
        let selection = Selection::new(&include, &globs(&["lo"])).unwrap();
        assert_eq!(selection.exact_names().collect::<Vec<_>>(), ["eth0"]);
    }

    #[test]
    fn interfaces_are_listed_and_their_changes_are_reported() {
        in_new_namespace(|| {
            let mut interfaces = Interfaces::open().unwrap();
            let lo = interfaces.by_index(1).unwrap().clone();
            assert_eq!((lo.name.as_str(), lo.hardware, lo.up), ("lo", 772, true));
            interfaces.changes();

            ip("link add one type veth peer name two");
            let Some(Change::Present(one)) = change(&interfaces.changes(), "one") else {
                panic!("a new interface is not seen");
            };
            assert_eq!((one.hardware, one.up), (1, false));
            ip("link set one up");
            let up = Interface {
                up: true,
                ..one.clone()
            };
            assert_eq!(
                change(&interfaces.changes(), "one"),
                Some(Change::Present(up))
            );
            ip("link set one down");
            ip("link set one name renamed");
            let renamed = Interface {
                name: "renamed".to_owned(),
                ..one
            };
            assert_eq!(
                change(&interfaces.changes(), "renamed"),
                Some(Change::Present(renamed.clone()))
            );
            assert_eq!(interfaces.by_index(renamed.index), Some(&renamed));
            ip("link delete renamed");
            assert_eq!(
                change(&interfaces.changes(), "renamed"),
                Some(Change::Gone(renamed.clone()))
            );
            assert_eq!(interfaces.by_index(renamed.index), None);
            assert_eq!(interfaces.changes(), []);
        });
    }

    #[test]
    fn a_bridge_port_that_leaves_its_bridge_stays_known() {
        in_new_namespace(|| {
            let mut interfaces = Interfaces::open().unwrap();
            ip("link add port type veth peer name far");
            ip("link add bridge type bridge");
            ip("link set port master bridge");
            interfaces.changes();
            ip("link set port nomaster");
            let changes = interfaces.changes();
            assert!(
                !matches!(change(&changes, "port"), Some(Change::Gone(_))),
                "{changes:?}"
            );
            assert!(interfaces.iter().any(|interface| interface.name == "port"));
        });
    }

    #[test]
    fn interfaces_beyond_the_cap_are_reported_and_not_kept() {
        let mut known = Known::default();
        for index in 1..=5_000 {
            let interface = Interface {
                index,
                name: index.to_string(),
                hardware: 1,
                up: true,
            };
            let message = Message {
                flags: 0,
                sequence: 0,
                body: Body::Present(interface.clone()),
            };
            assert_eq!(apply(&mut known, message), Some(Change::Present(interface)));
        }
        assert_driven::<KnownInterfaces>();
    }

    #[test]
    fn the_list_is_correct_after_a_flood_of_changes() {
        in_new_namespace(|| {
            let mut interfaces = Interfaces::open().unwrap();
            // These are far more messages than the buffer of an unread socket holds.
            let commands: String = (0..400)
                .flat_map(|number| {
                    [
                        "address 02:00:00:00:00:01",
                        "mtu 1400",
                        "address 02:00:00:00:00:02",
                    ]
                    .map(|what| {
                        format!(
                            "link set flood mtu {}\nlink set flood {what}\n",
                            1300 + number
                        )
                    })
                })
                .collect();
            ip("link add flood type veth peer name far");
            let file = tempfile::NamedTempFile::new().unwrap();
            std::fs::write(file.path(), commands).unwrap();
            ip(&format!("-batch {}", file.path().display()));
            ip("link delete flood");
            interfaces.changes();
            let names: Vec<_> = interfaces
                .iter()
                .map(|interface| interface.name.as_str())
                .collect();
            assert_eq!(names, ["lo"]);
        });
    }

    /// Returns messages of the kernel: that interface 1 exists and is up, and the end of a list.
    fn list_of_one(name: &[u8; 8]) -> Vec<u8> {
        let mut bytes = Vec::new();
        let attribute = [&b"\x09\0\x03\0"[..], name].concat();
        for (kind, attribute) in [(libc::RTM_NEWLINK, &attribute[..]), (3, &[0; 4])] {
            let body = if kind == 3 {
                vec![]
            } else {
                vec![0, 0, 4, 3, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0]
            };
            let length = 16 + body.len() + attribute.len();
            bytes.extend_from_slice(&u32::try_from(length).unwrap().to_ne_bytes());
            bytes.extend_from_slice(&kind.to_ne_bytes());
            bytes.extend_from_slice(&[0; 10]);
            bytes.extend_from_slice(&body);
            bytes.extend_from_slice(attribute);
        }
        bytes
    }

    #[test]
    fn a_failed_list_loses_no_change_and_is_repeated() {
        in_new_namespace(|| {
            let mut interfaces = Interfaces::open().unwrap();
            // This kernel reports a change, then something unreadable, and no list.
            let (kernel, socket) = UnixDatagram::pair().unwrap();
            socket.set_nonblocking(true).unwrap();
            kernel.send(&list_of_one(b"eth0\0\0\0\0")).unwrap();
            kernel.send(&[1, 0, 0]).unwrap();
            let socket = File::from(OwnedFd::from(socket));
            let own = std::mem::replace(&mut interfaces.socket, socket);
            let names = |changes: Vec<Change>| {
                let names = changes.into_iter().map(|change| match change {
                    Change::Present(interface) | Change::Gone(interface) => interface.name,
                });
                names.collect::<Vec<_>>()
            };
            assert_eq!(names(interfaces.changes()), ["eth0"]);
            assert_eq!(names(interfaces.changes()), [""; 0]);
            // The list of the other kernel shows that the interface has another name.
            interfaces.socket = own;
            assert_eq!(names(interfaces.changes()), ["lo"]);
            assert!(!interfaces.is_stale);
        });
    }

    #[test]
    fn a_malformed_answer_never_causes_a_panic() {
        let bytes = list_of_one(b"lo\0\0\0\0\0\0");
        let mut seen = Vec::new();
        read(&bytes, |message| seen.push(message)).unwrap();
        assert!(matches!(&seen[..], [
            Message { body: Body::Present(lo), .. },
            Message { body: Body::End(0), .. },
        ] if lo.name == "lo" && lo.up));
        for end in 0..bytes.len() {
            let _ = read(&bytes[..end], |_| ());
            for value in [0, 1, 3, 15, 17, 255] {
                let mut bytes = bytes.clone();
                bytes[end] = value;
                let _ = read(&bytes, |_| ());
            }
        }
    }
}
