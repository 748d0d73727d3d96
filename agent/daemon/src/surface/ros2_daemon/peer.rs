//! The process at the other end of a loopback connection: its ROS distribution and RMW
//! implementation, if the agent's user can inspect it.
//!
//! The process controls both values. They only select the format of the answers that this process
//! receives.

use std::fs;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use ros2probe_message::Dialect;

/// Maximum number of bytes read of the table of connections and of a memory map, and of a process's
/// environment.
const MAX_TABLE: u64 = 4 << 20;
const MAX_VARIABLES: u64 = 128 << 10;
/// Maximum number of processes inspected for one connection, and of descriptors per process.
const MAX_PROCESSES: usize = 4096;
const MAX_DESCRIPTORS: usize = 4096;
/// 127.0.0.1 as `/proc/net/tcp` writes it on little-endian machines.
const LOOPBACK_HEX: &str = "0100007F";
/// Columns of the user and of the inode in `/proc/net/tcp`.
const USER_COLUMN: usize = 7;
const INODE_COLUMN: usize = 9;

/// Facts about a client's process.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct PeerProcess {
    /// ROS distribution of the process.
    pub(super) dialect: Option<Dialect>,
    /// RMW implementation of the process, such as `rmw_cyclonedds_cpp`.
    pub(super) rmw_implementation: Option<String>,
}

/// Finds the process with the connection from port `client` to port `server`. `proc` is `/proc`.
pub(super) fn find(proc: &Path, client: u16, server: u16) -> Option<PeerProcess> {
    let table = text(&proc.join("net/tcp"), MAX_TABLE)?;
    let (user, inode) = socket(&table, client, server)?;
    let process = process(proc, user, inode)?;
    Some(read(&process))
}

/// Returns the user and the inode of the client's socket.
fn socket(table: &str, client: u16, server: u16) -> Option<(u32, u64)> {
    let address = |port: u16| format!("{LOOPBACK_HEX}:{port:04X}");
    let ends = (address(client), address(server));
    table.lines().find_map(|line| {
        let columns: Vec<&str> = line.split_ascii_whitespace().collect();
        if (columns.get(1)?, columns.get(2)?) != (&ends.0.as_str(), &ends.1.as_str()) {
            return None;
        }
        Some((
            columns.get(USER_COLUMN)?.parse().ok()?,
            columns.get(INODE_COLUMN)?.parse().ok()?,
        ))
    })
}

/// Returns the directory in `/proc` of the user's process that has this socket open.
fn process(proc: &Path, user: u32, inode: u64) -> Option<PathBuf> {
    let wanted = format!("socket:[{inode}]");
    let processes = fs::read_dir(proc)
        .ok()?
        .filter_map(|entry| Some(entry.ok()?.path()));
    let mut processes = process_paths(processes)
        .filter(|path| fs::metadata(path).is_ok_and(|metadata| metadata.uid() == user));
    processes.find(|path| {
        let descriptors = fs::read_dir(path.join("fd")).into_iter().flatten();
        let mut descriptors = descriptors.take(MAX_DESCRIPTORS).flatten();
        descriptors.any(|descriptor| {
            fs::read_link(descriptor.path()).is_ok_and(|target| target.as_os_str() == &*wanted)
        })
    })
}

/// Returns the paths of processes, whose names are numbers, up to the cap.
fn process_paths(paths: impl Iterator<Item = PathBuf>) -> impl Iterator<Item = PathBuf> {
    let is_number = |path: &PathBuf| {
        let name = path.file_name().and_then(|name| name.to_str());
        name.is_some_and(|name| name.bytes().all(|byte| byte.is_ascii_digit()))
    };
    paths.filter(is_number).take(MAX_PROCESSES)
}

/// Reads the facts from the environment variables, and missing facts from the mapped libraries.
fn read(process: &Path) -> PeerProcess {
    let variables = text(&process.join("environ"), MAX_VARIABLES).unwrap_or_default();
    let variable = |name: &str| {
        let mut lines = variables.split('\0');
        lines.find_map(|line| line.strip_prefix(name)?.strip_prefix('='))
    };
    let dialect = variable("ROS_DISTRO").and_then(Dialect::of_distro);
    let dialect = dialect.or_else(|| installed(variable("AMENT_PREFIX_PATH")?));
    let rmw = variable("RMW_IMPLEMENTATION").filter(|name| is_rmw(name));
    let map = match (&dialect, &rmw) {
        (Some(_), Some(_)) => String::new(),
        _ => text(&process.join("maps"), MAX_TABLE).unwrap_or_default(),
    };
    PeerProcess {
        dialect: dialect.or_else(|| installed(&map)),
        rmw_implementation: rmw.or_else(|| mapped_rmw(&map)).map(str::to_owned),
    }
}

/// Returns the distribution of the first path below `/opt/ros`.
fn installed(text: &str) -> Option<Dialect> {
    let paths = text.split("/opt/ros/").skip(1);
    let mut names = paths.map(|rest| rest.split(['/', ':', '\n']).next().unwrap_or_default());
    names.find_map(Dialect::of_distro)
}

/// Returns the RMW implementation whose library is mapped.
fn mapped_rmw(map: &str) -> Option<&str> {
    let mut names = map.lines().filter_map(|line| {
        let name = line.rsplit('/').next()?.split(".so").next()?;
        name.strip_prefix("lib")
    });
    names.find(|name| is_rmw(name) && name.ends_with("_cpp") && !name.contains("_shared_"))
}

fn is_rmw(name: &str) -> bool {
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || byte == b'_';
    name.starts_with("rmw_") && name.len() <= 64 && name.bytes().all(is_plain)
}

fn text(path: &Path, most: u64) -> Option<String> {
    let bytes = crate::file::read(path, most).ok()?;
    Some(String::from_utf8_lossy(&bytes).into_owned())
}

#[cfg(test)]
mod tests {
    use std::io::Read as _;
    use std::net::{TcpListener, TcpStream};
    use std::os::unix::fs::symlink;
    use std::process::{Command, Stdio};

    use super::*;

    const TABLE: &str = "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when \
        retrnsmt   uid  timeout inode\n   0: 0100007F:2CF7 0100007F:A001 01 00000000:00000000 \
        00:00000000 00000000     0        0 111 1 0 20 4 30 10 -1\n   1: 0100007F:A001 \
        0100007F:2CF7 01 00000000:00000000 00:00000000 00000000  1000        0 222 1 0 20 4 30 10 \
        -1\n";

    #[test]
    fn the_client_socket_of_a_connection_is_found_in_the_table() {
        assert_eq!(socket(TABLE, 0xa001, 11_511), Some((1000, 222)));
        assert_eq!(socket(TABLE, 0xa002, 11_511), None);
        assert_eq!(socket("", 0xa001, 11_511), None);
        assert_eq!(socket("a b\n0: c", 0xa001, 11_511), None);
    }

    /// A directory in the form of `/proc`, with one process that has the connection.
    fn proc(variables: &str, map: &str) -> tempfile::TempDir {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path();
        let user = fs::metadata(root).unwrap().uid().to_string();
        fs::create_dir_all(root.join("net")).unwrap();
        fs::write(
            root.join("net/tcp"),
            TABLE.replace(" 1000 ", &format!(" {user} ")),
        )
        .unwrap();
        for (id, target) in [("7", "socket:[333]"), ("8", "socket:[222]")] {
            fs::create_dir_all(root.join(id).join("fd")).unwrap();
            symlink(target, root.join(id).join("fd/3")).unwrap();
        }
        fs::write(root.join("8/environ"), variables).unwrap();
        fs::write(root.join("8/maps"), map).unwrap();
        directory
    }

    #[test]
    fn environment_variables_or_else_libraries_show_distribution_and_middleware() {
        let found = |variables: &str, map: &str| {
            let proc = proc(variables, map);
            let found = find(proc.path(), 0xa001, 11_511).unwrap();
            (found.dialect, found.rmw_implementation)
        };
        let named = |name: &str| Some(name.to_owned());
        assert_eq!(
            found(
                "A=b\0ROS_DISTRO=humble\0RMW_IMPLEMENTATION=rmw_cyclonedds_cpp\0",
                ""
            ),
            (Some(Dialect::Humble), named("rmw_cyclonedds_cpp"))
        );
        assert_eq!(
            found("AMENT_PREFIX_PATH=/home/a:/opt/ros/kilted\0", ""),
            (Some(Dialect::Kilted), None)
        );
        let map = "7f00 r-xp 0 fe:00 1 /opt/ros/jazzy/lib/librmw_fastrtps_shared_cpp.so\n\
                   7f01 r-xp 0 fe:00 1 /opt/ros/jazzy/lib/librmw_fastrtps_cpp.so\n";
        let found_by_map = (Some(Dialect::Jazzy), named("rmw_fastrtps_cpp"));
        assert_eq!(
            found("ROS_DISTRO=other\0RMW_IMPLEMENTATION=<x>\0", map),
            found_by_map
        );
        assert_eq!(found("", ""), (None, None));
    }

    #[test]
    fn processes_beyond_the_cap_are_not_inspected() {
        let ids: Vec<PathBuf> = (0..MAX_PROCESSES + 5)
            .map(|id| id.to_string().into())
            .collect();
        let names = ids.iter().cloned().chain(["net".into(), "self".into()]);
        assert_eq!(process_paths(names).count(), MAX_PROCESSES);
    }

    #[test]
    fn a_real_process_is_found_by_its_connection() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let server = listener.local_addr().unwrap().port();
        let script = format!("exec 3<>/dev/tcp/127.0.0.1/{server}; read -r line");
        let mut client = Command::new("bash")
            .args(["-c", &script])
            .env("ROS_DISTRO", "kilted")
            .env("RMW_IMPLEMENTATION", "rmw_zenoh_cpp")
            .stdin(Stdio::piped())
            .spawn()
            .unwrap();
        let (mut stream, address): (TcpStream, _) = listener.accept().unwrap();
        let found = find(Path::new("/proc"), address.port(), server).unwrap();
        drop(client.stdin.take());
        client.wait().unwrap();
        let _ = stream.read(&mut [0]);
        assert_eq!(found.dialect, Some(Dialect::Kilted));
        assert_eq!(found.rmw_implementation.as_deref(), Some("rmw_zenoh_cpp"));
    }
}
