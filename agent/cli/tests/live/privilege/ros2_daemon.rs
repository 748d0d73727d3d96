//! The thread that answers the `ros2` command line, confined by the unit.

use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};

use super::*;

const ADDRESS: &str = "127.0.0.1:11511";
const LIST: &str = "<methodCall><methodName>system.listMethods</methodName></methodCall>";

#[test]
fn without_any_privilege_the_thread_takes_over_the_port_and_answers() -> Result<()> {
    let host = Namespace::isolated()?;
    let network = host.network();
    // A real daemon has the port first.
    let other = netns::within(&network, || TcpListener::bind(ADDRESS))??;
    let directory = tempfile::tempdir()?;
    let settings = format!("{}ros2_daemon: on\n", at_the_sockets_of(&host));
    let capabilities = "+net_admin,+bpf,+perfmon";
    let agent = start(&host, directory.path(), capabilities, &settings)?;
    let names = confined(agent.process.pid(), 65534)?;
    ensure!(names.contains("ros2-daemon"), "{names:?}");
    let ports = |state: &'static str| {
        agent.scrape_until(state, |page| {
            page.sum("ros2probe_ros2_daemon_ports", &[("state", state)]) == 1.0
        })
    };
    ports("occupied")?;
    drop(other);
    let page = ports("listening")?;
    let filtered = [("system_calls", "filtered"), ("reason", "")];
    ensure!(page.value("ros2probe_sandbox_info", &filtered) == Some(1.0));
    let mut stream = netns::within(&network, || TcpStream::connect(ADDRESS))??;
    stream.set_read_timeout(Some(Duration::from_secs(30)))?;
    let length = LIST.len();
    write!(
        stream,
        "POST /ros2cli/ HTTP/1.1\r\nHost: {ADDRESS}\r\nContent-Type: text/xml\r\n\
         Content-Length: {length}\r\nConnection: close\r\n\r\n{LIST}"
    )?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer)?;
    ensure!(answer.contains("get_topic_names_and_types"), "{answer}");
    Ok(())
}
