//! Switches an agent that root started by hand to the package's user, so that it writes no file as
//! root. Capabilities are kept until they are dropped later.

use std::fs;
use std::io;

use rustix::process::{Gid, Uid, geteuid};
use rustix::thread::{
    CapabilitySet, capabilities, set_capabilities, set_keep_capabilities, set_thread_groups,
    set_thread_res_gid, set_thread_res_uid,
};

use super::capabilities::capability_names;

/// Name of the user and of the group.
const USER_NAME: &str = "ros2probe";

/// User of the agent.
#[derive(Debug, PartialEq, Eq)]
pub enum Identity {
    /// The user that started it, which is not root.
    AsStarted,
    /// The package's user.
    Own,
    /// Root, soon without capabilities, for this reason.
    Root(String),
}

/// Switches to the package's user if this process is root and the user exists. Call it while the
/// process has one thread, after everything is opened and before any file is written.
#[must_use]
pub fn become_own_user() -> Identity {
    if !geteuid().is_root() {
        return Identity::AsStarted;
    }
    let read = |path| fs::read_to_string(path).unwrap_or_default();
    let Some((user, group)) = find(&read("/etc/passwd"), &read("/etc/group")) else {
        return Identity::Root(format!("user {USER_NAME} does not exist"));
    };
    let effective =
        capabilities(None).map_or_else(|_| CapabilitySet::empty(), |sets| sets.effective);
    let needed = [CapabilitySet::SETUID, CapabilitySet::SETGID];
    if let Some(missing) = needed.into_iter().find(|one| !effective.contains(*one)) {
        let missing = capability_names(missing).concat();
        return Identity::Root(format!("switching to user {USER_NAME} needs {missing}"));
    }
    match become_user(user, group) {
        Ok(()) => Identity::Own,
        Err(error) => Identity::Root(format!("cannot switch to user {USER_NAME}: {error}")),
    }
}

/// Returns the ids of the package's user and group; without the group, the user's primary group.
/// `None` if the user does not exist, or is root.
fn find(users: &str, groups: &str) -> Option<(Uid, Gid)> {
    let line = |text: &str| -> Option<Vec<String>> {
        let mut lines = text.lines().map(|line| line.split(':'));
        let found = lines.find(|fields| fields.clone().next() == Some(USER_NAME))?;
        Some(found.map(str::to_owned).collect())
    };
    let number = |fields: &[String], index: usize| fields.get(index)?.parse::<u32>().ok();
    let user = line(users)?;
    let group = line(groups).and_then(|group| number(&group, 2));
    let group = group.or_else(|| number(&user, 3))?;
    let user = number(&user, 2).filter(|user| *user != 0)?;
    Some((Uid::from_raw(user), Gid::from_raw(group)))
}

/// Returns the id of a user; `None` if the user does not exist.
#[must_use]
pub fn user_id(name: &str) -> Option<u32> {
    let users = fs::read_to_string("/etc/passwd").ok()?;
    let mut lines = users.lines().map(|line| line.split(':'));
    let mut found = lines.find(|fields| fields.clone().next() == Some(name))?;
    found.nth(2)?.parse().ok()
}

fn become_user(user: Uid, group: Gid) -> io::Result<()> {
    set_thread_groups(&[])?;
    set_thread_res_gid(group, group, group)?;
    // Otherwise all capabilities would be lost with root's user id.
    set_keep_capabilities(true)?;
    set_thread_res_uid(user, user, user)?;
    set_keep_capabilities(false)?;
    let mut sets = capabilities(None)?;
    sets.effective = sets.permitted;
    Ok(set_capabilities(None, sets)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_user_is_found_by_its_name_and_is_never_root() {
        let users = "root:x:0:0:root:/root:/bin/sh\nros2probe2:x:7:7::/:/bin/false\n\
            ros2probe:x:998:997:agent:/var/lib/ros2probe:/usr/sbin/nologin\n";
        let found = |user, group| Some((Uid::from_raw(user), Gid::from_raw(group)));
        assert_eq!(
            find(users, "root:x:0:\nros2probe:x:996:ada\n"),
            found(998, 996)
        );
        assert_eq!(find(users, "root:x:0:\n"), found(998, 997));
        assert_eq!(find("root:x:0:0::/:/bin/sh\n", "ros2probe:x:996:\n"), None);
        assert_eq!(find("ros2probe:x:0:0::/:/bin/sh\n", ""), None);
        assert_eq!(find("ros2probe:x\n", ""), None);
    }

    #[test]
    fn switching_the_user_keeps_capabilities_and_drops_the_ids_of_root() {
        assert!(geteuid().is_root(), "this takes root: run `make test`");
        let thread = std::thread::spawn(|| {
            let before = capabilities(None).unwrap().effective;
            become_user(Uid::from_raw(65534), Gid::from_raw(65533)).unwrap();
            assert_eq!(capabilities(None).unwrap().effective, before);
            fs::read_to_string("/proc/thread-self/status").unwrap()
        });
        let status = thread.join().unwrap();
        let line = |name| status.lines().find(|line| line.starts_with(name)).unwrap();
        assert_eq!(line("Uid:"), "Uid:\t65534\t65534\t65534\t65534");
        assert_eq!(line("Gid:"), "Gid:\t65533\t65533\t65533\t65533");
        assert_eq!(line("Groups:").trim_end(), "Groups:\t".trim_end());
        assert!(geteuid().is_root(), "only that thread has become another");
    }
}
