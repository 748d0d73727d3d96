//! Facts of an observed process: start, name, CPU time, and its domain.

use std::fs::File;
use std::io::Read as _;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::DomainId;

/// Variable with the domain of a ROS process.
const DOMAIN: &[u8] = b"ROS_DOMAIN_ID=";
/// Most bytes of `/proc/<pid>/stat`.
const MAX_STAT: u64 = 4096;

/// Reads memory: process, address and most bytes; `None` if it cannot be read.
pub type ReadMemory = Box<dyn FnMut(u32, u64, u64) -> Option<Vec<u8>> + Send>;

/// One reading of `/proc/<pid>/stat` (proc_pid_stat(5)).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Stat {
    /// Name of the process.
    pub name: Arc<str>,
    /// CPU time so far, user and system.
    pub cpu: Duration,
    /// Start in clock ticks since boot, which differs for processes with the same id.
    pub started: u64,
    /// Addresses between which its environment lies; 0 without the right to read it.
    environment: (u64, u64),
}

impl Stat {
    /// Reads the state of a process; `None` if it has ended.
    #[must_use]
    pub fn read(process: u32) -> Option<Self> {
        let mut text = String::new();
        let file = File::open(format!("/proc/{process}/stat")).ok()?;
        file.take(MAX_STAT).read_to_string(&mut text).ok()?;
        Self::parse(&text, ticks_per_second())
    }

    fn parse(text: &str, ticks_per_second: u64) -> Option<Self> {
        // The name may contain spaces and parentheses.
        let (head, rest) = text.rsplit_once(')')?;
        let (_, name) = head.split_once('(')?;
        let fields: Vec<_> = rest.split_ascii_whitespace().collect();
        // The state is field 3 and comes first here.
        let field = |number: usize| fields.get(number - 3)?.parse::<u64>().ok();
        let state = fields.first()?;
        if matches!(*state, "Z" | "X" | "x") {
            return None;
        }
        let ticks = field(14)?.checked_add(field(15)?)?;
        let nanoseconds = u128::from(ticks) * 1_000_000_000 / u128::from(ticks_per_second.max(1));
        Some(Self {
            name: name.into(),
            cpu: Duration::from_nanos(u64::try_from(nanoseconds).unwrap_or(u64::MAX)),
            started: field(22)?,
            environment: (field(50).unwrap_or(0), field(51).unwrap_or(0)),
        })
    }

    /// Returns the domain in the process's environment, 0 without one. `None` if the environment
    /// cannot be read. `read` reads the process's memory.
    #[must_use]
    pub fn domain(&self, process: u32, read: &mut ReadMemory) -> Option<DomainId> {
        let (start, end) = self.environment;
        let length = end.checked_sub(start).filter(|length| *length > 0)?;
        let bytes = read(process, start, length)?;
        Some(domain_in(&bytes))
    }
}

fn domain_in(environment: &[u8]) -> DomainId {
    let mut variables = environment.split(|byte| *byte == 0);
    let value = variables.find_map(|variable| variable.strip_prefix(DOMAIN));
    let value = value.and_then(|value| std::str::from_utf8(value).ok()?.trim().parse().ok());
    DomainId(value.unwrap_or(0))
}

fn ticks_per_second() -> u64 {
    // SAFETY: sysconf has no preconditions.
    let ticks = unsafe { libc::sysconf(libc::_SC_CLK_TCK) };
    u64::try_from(ticks).unwrap_or(100)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_with_parentheses_is_read_whole() {
        let mut text = "42 (a) b (c) S 1 1 1 0 -1 0 0 0 0 0 250 50 0 0 20 0 1 0 777".to_owned();
        for _ in 23..50 {
            text.push_str(" 0");
        }
        text.push_str(" 4096 8192 0");
        let stat = Stat::parse(&text, 100).unwrap();
        assert_eq!(&*stat.name, "a) b (c");
        assert_eq!((stat.cpu, stat.started), (Duration::from_secs(3), 777));
        assert_eq!(stat.environment, (4096, 8192));
        assert_eq!(Stat::parse(&text.replace(" S ", " Z "), 100), None);
        for end in 0..40 {
            let _ = Stat::parse(&text[..end], 100);
        }
    }

    #[test]
    fn the_domain_is_that_of_the_environment() {
        assert_eq!(domain_in(b"A=1\0ROS_DOMAIN_ID=42\0B=2\0"), DomainId(42));
        for without in [
            &b"A=1\0"[..],
            b"ROS_DOMAIN_ID=\0",
            b"ROS_DOMAIN_ID=x\0",
            b"",
        ] {
            assert_eq!(domain_in(without), DomainId(0));
        }
        let own = std::process::id();
        let stat = Stat::read(own).unwrap();
        let (start, end) = stat.environment;
        let mut read: ReadMemory = Box::new(move |process, address, length| {
            assert_eq!((process, address, length), (own, start, end - start));
            Some(b"ROS_DOMAIN_ID=9\0".to_vec())
        });
        assert_eq!(stat.domain(own, &mut read), Some(DomainId(9)));
        assert_eq!(
            stat.domain(own, &mut (Box::new(|_, _, _| None) as ReadMemory)),
            None
        );
    }
}
