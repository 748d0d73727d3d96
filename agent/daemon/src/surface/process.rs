//! Resource usage of this process and others, from `/proc`. Unreadable values are absent, because
//! the sandbox of a service may hide some values.

use std::fs;
use std::io::Read as _;

/// Resource usage of this process.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Process {
    pub(super) cpu_seconds: Option<f64>,
    pub(super) resident_bytes: Option<f64>,
    pub(super) unreclaimable_bytes: Option<f64>,
    pub(super) virtual_bytes: Option<f64>,
    pub(super) open_fds: Option<f64>,
    pub(super) max_fds: Option<f64>,
    pub(super) start_time: Option<f64>,
}

/// Resource usage of another process.
#[derive(Clone, Debug)]
pub(super) struct Usage {
    pub(super) name: String,
    pub(super) cpu_seconds: f64,
    pub(super) resident_bytes: u64,
    pub(super) threads: u32,
    /// Clock ticks from the start of the system to that of the process.
    pub(super) start_ticks: Option<u64>,
}

impl Usage {
    /// Returns the usage of a process, or `None` if the process has ended or is hidden.
    pub(super) fn read(id: u32) -> Option<Self> {
        let stat = fs::read_to_string(format!("/proc/{id}/stat")).ok()?;
        let fields = Fields::of(&stat);
        let (before, _) = stat.rsplit_once(") ")?;
        let (_, name) = before.split_once('(')?;
        let ticks = ticks_per_second();
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a whole number of bytes far below 2^53"
        )]
        let resident_bytes = (fields.number(24)? * page_bytes()).max(0.0) as u64;
        Some(Self {
            name: name.to_owned(),
            cpu_seconds: (fields.number(14)? + fields.number(15)?) / ticks,
            resident_bytes,
            threads: fields.text(20)?.parse().ok()?,
            start_ticks: fields.text(22)?.parse().ok(),
        })
    }

    /// Returns the Unix time of the process's start.
    pub(super) fn started(&self) -> Option<f64> {
        #[expect(clippy::cast_precision_loss, reason = "exact for centuries")]
        let start = self.start_ticks? as f64;
        Some(boot_time()? + start / ticks_per_second())
    }
}

/// Maximum length of a command line that is read, in bytes.
const COMMAND_LINE: u64 = 4096;
/// Beginnings of the names of interpreters.
const INTERPRETER_PREFIXES: [&str; 6] = ["python", "node", "ruby", "perl", "bash", "sh"];

/// Returns the file or module that an interpreter runs; `None` for another program.
pub(super) fn script(id: u32) -> Option<String> {
    let mut line = Vec::new();
    let file = fs::File::open(format!("/proc/{id}/cmdline")).ok()?;
    file.take(COMMAND_LINE).read_to_end(&mut line).ok()?;
    script_of(&line)
}

/// Returns the script in a command line, whose words end with a zero byte.
fn script_of(line: &[u8]) -> Option<String> {
    let words = line.split(|byte| *byte == 0).map(String::from_utf8_lossy);
    let mut words = words.filter(|word| !word.is_empty());
    let file_name = |path: &str| path.rsplit('/').next().unwrap_or_default().to_owned();
    let program = file_name(&words.next()?);
    let is_interpreter = INTERPRETER_PREFIXES.iter().any(|name| {
        let version = program.strip_prefix(name);
        version.is_some_and(|version| {
            version
                .chars()
                .all(|each| each.is_ascii_digit() || each == '.')
        })
    });
    if !is_interpreter {
        return None;
    }
    loop {
        match &*words.next()? {
            "-m" => return words.next().map(|module| module.into_owned()),
            "-c" | "-e" => return None,
            // These take a further word.
            "-W" | "-X" | "-r" => drop(words.next()),
            word if word.starts_with('-') => {}
            word => return Some(file_name(word)).filter(|name| !name.is_empty()),
        }
    }
}

/// The fields of `/proc/PID/stat`, by their numbers in proc(5).
struct Fields<'a>(Vec<&'a str>);

impl<'a> Fields<'a> {
    fn of(stat: &'a str) -> Self {
        // The command name may contain spaces and parentheses, so the fields begin after the last
        // closing parenthesis.
        Self(match stat.rsplit_once(") ") {
            Some((_, rest)) => rest.split(' ').collect(),
            None => Vec::new(),
        })
    }

    /// Returns a field by its number: proc(5) counts from 1, and the state is the third.
    fn text(&self, number: usize) -> Option<&'a str> {
        Some(self.0.get(number.checked_sub(3)?)?.trim())
    }

    fn number(&self, number: usize) -> Option<f64> {
        self.text(number)?.parse().ok()
    }
}

impl Process {
    pub(super) fn read() -> Self {
        let stat = fs::read_to_string("/proc/self/stat").unwrap_or_default();
        let fields = Fields::of(&stat);
        let field = |number: usize| fields.number(number);
        let ticks = ticks_per_second();
        Self {
            cpu_seconds: field(14)
                .zip(field(15))
                .map(|(user, system)| (user + system) / ticks),
            resident_bytes: field(24).map(|pages| pages * page_bytes()),
            unreclaimable_bytes: unreclaimable_bytes(),
            virtual_bytes: field(23),
            #[expect(clippy::cast_precision_loss, reason = "far below 2^53")]
            open_fds: fs::read_dir("/proc/self/fd")
                .ok()
                .map(|fds| fds.count() as f64),
            max_fds: max_fds(),
            start_time: field(22)
                .zip(boot_time())
                .map(|(start, boot)| boot + start / ticks),
        }
    }
}

/// Returns the memory that the kernel cannot reclaim while the process runs, in bytes. It consists
/// of the process's own pages (anonymous, changed, swapped), and of the rings shared with the
/// kernel, which are mapped as files. Returns `None` if the kernel hides it.
fn unreclaimable_bytes() -> Option<f64> {
    let maps = fs::read_to_string("/proc/self/smaps").ok()?;
    let mut bytes = 0.0;
    let mut is_ring = false;
    for line in maps.lines() {
        let mut words = line.split_ascii_whitespace();
        let key = words.next().unwrap_or_default();
        let counts = match key {
            // The rings are mapped twice in a row, so RSS counts them twice.
            "Pss:" => is_ring,
            "Anonymous:" | "Swap:" => !is_ring,
            address if address.contains('-') => {
                let name = words.nth(4).unwrap_or_default();
                is_ring = name.starts_with("anon_inode:bpf") || name.starts_with("socket:");
                false
            }
            _ => false,
        };
        if counts {
            let kilobytes = words.next().and_then(|word| word.parse::<f64>().ok());
            bytes += kilobytes? * 1024.0;
        }
    }
    Some(bytes)
}

fn boot_time() -> Option<f64> {
    let stat = fs::read_to_string("/proc/stat").ok()?;
    stat.lines()
        .find_map(|line| line.strip_prefix("btime "))?
        .trim()
        .parse()
        .ok()
}

fn max_fds() -> Option<f64> {
    let limits = fs::read_to_string("/proc/self/limits").ok()?;
    let line = limits
        .lines()
        .find_map(|line| line.strip_prefix("Max open files"))?;
    line.split_whitespace().next()?.parse().ok()
}

fn ticks_per_second() -> f64 {
    // USER_HZ is 100 on every supported architecture, regardless of the kernel's own HZ.
    100.0
}

/// Returns the page size from the auxiliary vector, such as 16 KiB on a Raspberry Pi 5.
fn page_bytes() -> f64 {
    const AT_PAGESZ: usize = 6;
    let vector = fs::read("/proc/self/auxv").unwrap_or_default();
    let (entries, _) = vector.as_chunks::<{ size_of::<usize>() }>();
    let (pairs, _) = entries.as_chunks::<2>();
    let page = pairs
        .iter()
        .find(|[key, _]| usize::from_ne_bytes(*key) == AT_PAGESZ);
    #[expect(
        clippy::cast_precision_loss,
        reason = "page sizes are small powers of two"
    )]
    page.map_or(4096.0, |[_, value]| usize::from_ne_bytes(*value) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_of_an_interpreter_is_named_by_its_script() {
        for (line, script) in [
            (
                "/usr/bin/python3.11\0-u\0/opt/robot/robot.py\0--ros-args\0",
                Some("robot.py"),
            ),
            ("python3\0-W\0ignore\0-m\0robot.main\0", Some("robot.main")),
            ("/bin/sh\0/opt/robot/start\0", Some("start")),
            ("node\0server.js\0", Some("server.js")),
            ("python3\0-c\0import robot\0", None),
            ("python3\0", None),
            ("/opt/ros/lib/nodelet\0robot.py\0", None),
            ("/opt/ros/lib/python_bridge\0robot.py\0", None),
            ("", None),
        ] {
            assert_eq!(script_of(line.as_bytes()).as_deref(), script, "{line}");
        }
        assert_eq!(script(std::process::id()), None);
        assert_eq!(script(u32::MAX - 1), None);
    }

    #[test]
    fn a_process_can_read_its_own_resource_usage() {
        let process = Process::read();
        assert!(process.resident_bytes.unwrap() > 100_000.0);
        assert!(process.virtual_bytes >= process.resident_bytes);
        let own = process.unreclaimable_bytes.unwrap();
        assert!(own > 10_000.0 && Some(own) < process.virtual_bytes, "{own}");
        assert!(process.open_fds.unwrap() >= 3.0 && process.open_fds <= process.max_fds);
        let now = std::time::SystemTime::UNIX_EPOCH
            .elapsed()
            .unwrap()
            .as_secs_f64();
        let age = now - process.start_time.unwrap();
        assert!((-2.0..600.0).contains(&age), "{age}");
        assert!((4096.0..=65536.0).contains(&page_bytes()));
    }
}
