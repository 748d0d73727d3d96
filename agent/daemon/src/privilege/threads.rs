//! Privileges of each thread of this process as the kernel reports them. `/health` shows these
//! values, not those that the agent has set.

use std::fs;

use rustix::thread::CapabilitySet;

use super::capabilities::capability_names;

/// Privileges of one thread.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ThreadCapabilities {
    /// Name of the thread; `rp` for the first one.
    pub name: String,
    /// Names of its permitted capabilities.
    pub capabilities: Vec<String>,
    /// Whether the kernel refuses system calls outside of its role.
    pub filtered: bool,
}

/// Returns all threads in the order of their start; an empty list if `/proc` is unreadable.
#[must_use]
pub fn threads() -> Vec<ThreadCapabilities> {
    let entries = fs::read_dir("/proc/self/task").into_iter().flatten();
    let number = |name: &str| name.parse::<u32>().ok();
    let mut numbers: Vec<_> = entries
        .filter_map(|entry| number(entry.ok()?.file_name().to_str()?))
        .collect();
    numbers.sort_unstable();
    let status = |number| fs::read_to_string(format!("/proc/self/task/{number}/status"));
    // A thread may end while this is read.
    let readable = numbers.into_iter().filter_map(|each| status(each).ok());
    readable.map(|status| read(&status)).collect()
}

fn read(status: &str) -> ThreadCapabilities {
    let value = |name: &str| {
        let mut lines = status.lines();
        let value = lines.find_map(|line| line.strip_prefix(name)?.strip_prefix(':'));
        value.unwrap_or_default().trim()
    };
    let permitted = u64::from_str_radix(value("CapPrm"), 16).unwrap_or(u64::MAX);
    ThreadCapabilities {
        name: value("Name").to_owned(),
        capabilities: capability_names(CapabilitySet::from_bits_retain(permitted)),
        filtered: value("Seccomp") == "2",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn capabilities_and_filter_are_parsed_from_a_status_file() {
        let status = "Name:\tshm\nUmask:\t0077\nState:\tS (sleeping)\nCapInh:\t0000000000000000\n\
            CapPrm:\t0000000000880000\nCapEff:\t0000000000880000\nCapBnd:\t000001ffffffffff\n\
            CapAmb:\t0000000000000000\nNoNewPrivs:\t1\nSeccomp:\t2\nSeccomp_filters:\t1\n";
        assert_eq!(
            read(status),
            ThreadCapabilities {
                name: "shm".to_owned(),
                capabilities: vec!["CAP_SYS_NICE".to_owned(), "CAP_SYS_PTRACE".to_owned()],
                filtered: true,
            }
        );
        assert!(!read("Name:\trp\nSeccomp:\t0\n").filtered);
        assert!(!read("").capabilities.is_empty(), "not known is not none");
    }

    #[test]
    fn every_thread_of_this_process_is_reported() {
        let (stop, stopped) = std::sync::mpsc::channel::<()>();
        // A thread sets its own name once it runs.
        let (runs, running) = std::sync::mpsc::channel();
        let thread = std::thread::Builder::new().name("another".to_owned());
        let thread = thread.spawn(move || {
            runs.send(()).unwrap();
            stopped.recv()
        });
        let thread = thread.unwrap();
        running.recv().unwrap();
        let names: Vec<_> = threads().into_iter().map(|thread| thread.name).collect();
        assert!(names.len() >= 2);
        assert!(names.iter().any(|name| name == "another"), "{names:?}");
        drop(stop);
        let _ = thread.join().unwrap();
    }
}
