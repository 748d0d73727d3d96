//! The sockets seen by the host hook: the processes that hold them, their control groups, and their
//! unattributed drops. Changes are passed to the model.
//!
//! Queries are rare, because visiting all open files of the host is expensive. The table has at
//! most as many sockets as the hook remembers.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use ros2probe_wire::host::Socket;
use ros2probe_wire::time::SECOND;

use super::cgroup_paths::CgroupPaths;
use super::filter::Filter;
use super::owners::Owner;
use super::tracepoints::Tracepoints;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Observer;
use ros2probe_model::report::snapshot::SocketFacts;

/// Interval of searches for new sockets: every second round of an idle agent.
const SEARCH_INTERVAL: u64 = 19 * SECOND / 10;
/// Minimum interval while a connection of Zenoh begins, which may last for less than a second.
const SHORT_SEARCH_INTERVAL: u64 = SECOND / 10;
/// Interval of reading all owners again, because sockets are closed and their drops increase.
const FULL_SEARCH_INTERVAL: u64 = 15 * SECOND;
/// Maximum number of queries for an owner that was not found.
const MAX_REQUESTS: u8 = 3;

/// State of all sockets.
#[derive(Debug)]
pub struct Sockets {
    groups: CgroupPaths,
    known: BTreeMap<u64, Known>,
    last_search: u64,
    last_request: u64,
    failed: bool,
}

#[derive(Debug, Default)]
struct Known {
    owner: Option<Owner>,
    /// Unattributed drops when the socket's owner was first found.
    dropped_before: Option<u64>,
    requests: u8,
    /// Value of the hook's counter at the last report to the model.
    rcvbuf_errors: u64,
    reported: Option<SocketFacts>,
}

impl Sockets {
    /// Creates an empty table. `hierarchy` is the mount point of the control groups.
    #[must_use]
    pub const fn new(hierarchy: PathBuf) -> Self {
        Self {
            groups: CgroupPaths::new(hierarchy),
            known: BTreeMap::new(),
            last_search: 0,
            last_request: 0,
            failed: false,
        }
    }

    /// Queries the kernel if a query is due, and passes changes to the model.
    pub fn follow(&mut self, filter: &Filter, now: u64, observer: &mut Observer) {
        let is_awaited = observer.awaits_holders();
        let interval = if is_awaited {
            SHORT_SEARCH_INTERVAL
        } else {
            SEARCH_INTERVAL
        };
        if now.saturating_sub(self.last_search) < interval {
            return;
        }
        self.last_search = now;
        let met: BTreeMap<u64, Socket> = filter.sockets().collect();
        self.forget(&met, observer);
        let owners = self.owners(filter.tracepoints(), &met, now);
        let asked = owners.is_some();
        if let Some(owners) = owners {
            self.poll(owners, &met, observer);
        }
        let groups: BTreeSet<u64> = met.values().map(|socket| socket.cgroup).collect();
        self.groups.refresh(&groups);
        self.report(&met, asked, observer);
        if is_awaited {
            observer.input(Input::SocketsRead);
        }
    }

    /// Passes new and changed facts to the model. `asked` = the owners were queried just before.
    fn report(&mut self, met: &BTreeMap<u64, Socket>, asked: bool, observer: &mut Observer) {
        for (cookie, socket) in met {
            let known = self.known.entry(*cookie).or_default();
            if known.reported.is_none() && !known.may_be_open() {
                // The socket was reported as closed, but is still in the hook's table. Facts would
                // open it again for the model.
                continue;
            }
            if !asked && known.reported.is_some() && known.rcvbuf_errors == socket.rcvbuf_errors {
                continue;
            }
            known.rcvbuf_errors = socket.rcvbuf_errors;
            let facts = known.facts(*cookie, socket, &self.groups);
            if known.reported.as_ref() != Some(&facts) {
                known.reported = Some(facts.clone());
                observer.input(Input::Socket(facts));
            }
        }
    }

    /// Forgets sockets that the hook has evicted.
    fn forget(&mut self, met: &BTreeMap<u64, Socket>, observer: &mut Observer) {
        self.known.retain(|cookie, known| {
            let stays = met.contains_key(cookie);
            if !stays && known.reported.is_some() {
                if known.may_be_open() {
                    observer.input(Input::SocketForgotten(*cookie));
                } else {
                    observer.input(Input::SocketClosed(*cookie));
                }
            }
            stays
        });
    }

    /// Returns the owners of all sockets; `None` if no query is due or the query fails.
    fn owners(
        &mut self,
        inside: Option<&Tracepoints>,
        met: &BTreeMap<u64, Socket>,
        now: u64,
    ) -> Option<BTreeMap<u64, Owner>> {
        let owners = inside?.owners()?;
        let unknown = |cookie: &u64| {
            let known = self.known.get(cookie);
            known.is_none_or(|known| known.owner.is_none() && known.requests < MAX_REQUESTS)
        };
        let due = now.saturating_sub(self.last_request) >= FULL_SEARCH_INTERVAL;
        if met.is_empty() || !(due || met.keys().any(unknown)) {
            return None;
        }
        self.last_request = now;
        let found = owners.refresh(&met.keys().copied().collect());
        if let Err(error) = &found
            && !self.failed
        {
            self.failed = true;
            tracing::warn!(%error, "socket owners are no longer known");
        }
        found.ok()
    }

    fn poll(
        &mut self,
        mut owners: BTreeMap<u64, Owner>,
        met: &BTreeMap<u64, Socket>,
        observer: &mut Observer,
    ) {
        for (cookie, socket) in met {
            let known = self.known.entry(*cookie).or_default();
            known.requests = known.requests.saturating_add(1);
            let owner = owners.remove(cookie);
            if owner.is_none() && known.owner.is_some() {
                // The last process that held the socket has closed it.
                *known = Known {
                    requests: MAX_REQUESTS,
                    ..Known::default()
                };
                observer.input(Input::SocketClosed(*cookie));
                continue;
            }
            known.owner = owner.or(known.owner.take());
            if known.dropped_before.is_none() {
                known.dropped_before = known.unnamed(socket);
            }
        }
    }
}

impl Known {
    /// Returns whether a process may hold the socket open.
    const fn may_be_open(&self) -> bool {
        self.owner.is_some() || self.requests < MAX_REQUESTS
    }

    /// Returns the drops of the socket beyond the attributed ones; `None` if the kernel does not
    /// count them, or counts segments of TCP.
    fn unnamed(&self, socket: &Socket) -> Option<u64> {
        if socket.is_stream != 0 {
            return None;
        }
        let dropped = u64::from(self.owner.as_ref()?.drops?);
        Some(dropped.saturating_sub(socket.rcvbuf_errors))
    }

    fn facts(&self, cookie: u64, socket: &Socket, groups: &CgroupPaths) -> SocketFacts {
        let owner = self.owner.as_ref();
        let unnamed = self.unnamed(socket).zip(self.dropped_before);
        SocketFacts {
            cookie,
            process_id: owner.map(|owner| owner.process_id),
            own_process_id: owner.map(|owner| owner.own_process_id),
            process: owner.map(|owner| owner.process_name.as_str().into()),
            cgroup: groups.path(socket.cgroup).map(Into::into),
            unidentified_drops: unnamed.map_or(0, |(now, before)| now.saturating_sub(before)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_model::observe::observer::Settings;

    fn owner(drops: u32) -> Owner {
        Owner {
            inode: 1,
            process_id: 7,
            own_process_id: 7,
            process_name: "listener".to_owned(),
            drops: Some(drops),
        }
    }

    fn sockets(cookies: &[u64], rcvbuf_errors: u64) -> BTreeMap<u64, Socket> {
        let socket = Socket {
            cgroup: 1,
            rcvbuf_errors,
            is_stream: 0,
        };
        cookies.iter().map(|cookie| (*cookie, socket)).collect()
    }

    #[test]
    fn earlier_and_attributed_drops_do_not_count_as_unidentified() {
        let mut observer = Observer::new(Settings::default());
        let mut all = Sockets::new(PathBuf::from("/sys/fs/cgroup"));
        let drops = |all: &Sockets, rcvbuf_errors| {
            let met = sockets(&[1], rcvbuf_errors);
            let known = all.known.get(&1).unwrap();
            known.facts(1, &met[&1], &all.groups).unidentified_drops
        };
        let mut look = |all: &mut Sockets, dropped, rcvbuf_errors| {
            let owners = BTreeMap::from([(1, owner(dropped))]);
            all.poll(owners, &sockets(&[1], rcvbuf_errors), &mut observer);
            drops(all, rcvbuf_errors)
        };
        assert_eq!(look(&mut all, 100, 0), 0);
        assert_eq!(look(&mut all, 110, 10), 0);
        assert_eq!(look(&mut all, 125, 20), 5);
        // Further drops were attributed after the owner's counter was read.
        assert_eq!(drops(&all, 40), 0);
        assert_eq!(look(&mut all, 125, 20), 5);
    }

    #[test]
    fn segments_that_tcp_drops_do_not_count_as_datagrams() {
        let socket = Socket {
            is_stream: 1,
            ..Socket::default()
        };
        let known = Known {
            owner: Some(owner(3)),
            dropped_before: Some(0),
            ..Known::default()
        };
        assert_eq!(known.unnamed(&socket), None);
        let facts = known.facts(1, &socket, &CgroupPaths::new(PathBuf::new()));
        assert_eq!((facts.process_id, facts.unidentified_drops), (Some(7), 0));
    }

    #[test]
    fn a_socket_without_a_holder_is_reported_as_closed_and_not_queried_again() {
        let mut observer = Observer::new(Settings::default());
        let mut all = Sockets::new(PathBuf::from("/sys/fs/cgroup"));
        let met = sockets(&[1, 2], 0);
        let owners = BTreeMap::from([(1, owner(0)), (2, owner(0))]);
        all.poll(owners, &met, &mut observer);
        all.poll(BTreeMap::from([(2, owner(0))]), &met, &mut observer);
        let questions = |all: &Sockets, cookie| all.known.get(&cookie).unwrap().requests;
        assert_eq!(questions(&all, 1), MAX_REQUESTS);
        assert!(all.known.get(&1).unwrap().owner.is_none());
        assert_eq!(questions(&all, 2), 2);
        all.forget(&sockets(&[2], 0), &mut observer);
        assert_eq!(all.known.len(), 1);
    }

    #[test]
    fn a_closed_socket_is_reported_again_only_with_a_new_holder() {
        let mut observer = Observer::new(Settings::default());
        let mut all = Sockets::new(PathBuf::from("/sys/fs/cgroup"));
        let met = sockets(&[1], 0);
        // The hook's table still has the socket after its last holder has ended.
        for (owners, is_reported) in [
            (BTreeMap::from([(1, owner(0))]), true),
            (BTreeMap::new(), false),
            (BTreeMap::new(), false),
            (BTreeMap::from([(1, owner(0))]), true),
        ] {
            all.poll(owners, &met, &mut observer);
            all.report(&met, true, &mut observer);
            assert_eq!(all.known[&1].reported.is_some(), is_reported);
        }
        // A socket whose holder is unknown may be open.
        all.report(&sockets(&[2], 0), false, &mut observer);
        assert!(all.known[&2].reported.is_some());
    }
}
