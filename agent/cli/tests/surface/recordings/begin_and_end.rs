//! The start and the interruption of a recording of many topics.

use std::io::{Read as _, Write as _};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use ros2probe_testing::pseudo_terminal::Terminal;

use super::*;
use crate::page::get;
use crate::replay;

/// Relays connections to the API. Returns the address of the relay, and the number of requests.
fn counting_relay(api: SocketAddr) -> (SocketAddr, Arc<AtomicUsize>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let requests = Arc::new(AtomicUsize::new(0));
    let counted = Arc::clone(&requests);
    std::thread::spawn(move || {
        for client in listener.incoming().map_while(Result::ok) {
            let Ok(agent) = TcpStream::connect(api) else {
                return;
            };
            let mut answers = agent.try_clone().unwrap();
            let mut back = client.try_clone().unwrap();
            std::thread::spawn(move || {
                let _ = std::io::copy(&mut answers, &mut back);
                let _ = back.shutdown(Shutdown::Both);
            });
            let counted = Arc::clone(&counted);
            std::thread::spawn(move || relay_requests(client, agent, &counted));
        }
    });
    (address, requests)
}

/// Passes the requests of a client on, and counts them.
fn relay_requests(mut client: TcpStream, mut agent: TcpStream, counted: &AtomicUsize) {
    let mut bytes = [0; 65_536];
    while let Ok(count @ 1..) = client.read(&mut bytes) {
        let text = String::from_utf8_lossy(&bytes[..count]);
        counted.fetch_add(text.matches(" HTTP/1.1\r\n").count(), Ordering::Relaxed);
        if agent.write_all(&bytes[..count]).is_err() {
            break;
        }
    }
    let _ = agent.shutdown(Shutdown::Both);
}

/// Waits for a message of each topic, which has one per second of the capture.
fn wait_for_messages(agent: &LocalAgent) {
    let time = |replay: &Value| replay["timestamp_seconds"].as_f64();
    let since = time(&get(agent, "/replay")).unwrap();
    replay::wait_for(agent, "1.5 s later", |replay| {
        time(replay) > Some(since + 1.5)
    });
}

#[test]
fn a_recording_of_many_topics_begins_and_ends_without_a_request_for_each_topic() {
    let directory = tempfile::tempdir().unwrap();
    let capture = directory.path().join("many.pcap");
    many_topics(&capture);
    let agent = LocalAgent::replay(&mut rp(), &capture, &["--speed", "1"]);
    agent.wait_for_metric("ros2_topics{domain_id=\"0\",kind=\"topic\"}", |topics| {
        topics == MANY as f64
    });
    let bag = directory.path().join("bag");
    let (relay, requests) = counting_relay(agent.api);
    let mut recording = Recording::start(relay, &bag, &[]);
    let began = recording.wait_for("Recording...");
    wait_for_messages(&agent);
    recording.signal("-INT");
    let (status, ended) = recording.end();
    eprintln!("{MANY} topics: began after {began:?}, ended after {ended:?}");
    assert_eq!(status.code(), Some(0), "{:#?}", recording.printed);
    let requests = requests.load(Ordering::Relaxed);
    assert!((1..MANY).contains(&requests), "{requests} requests");
    assert!(began < Duration::from_secs(30), "began after {began:?}");
    // The end waits for the next clock of the replay, which differs from the current time.
    assert!(ended < Duration::from_secs(30), "ended after {ended:?}");
    assert_eq!(messages(&bag).len(), MANY);
}

#[test]
fn a_recording_that_is_interrupted_at_its_start_leaves_no_bag() {
    let directory = tempfile::tempdir().unwrap();
    // An agent that accepts the request and never answers.
    let socket = directory.path().join("api.sock");
    let listener = UnixListener::bind(&socket).unwrap();
    let bag = directory.path().join("bag");
    let mut command = rp();
    command
        .args(["bag", "record", "-a", "--socket"])
        .arg(&socket);
    let mut recording = Recording::of(command.arg("-o").arg(&bag));
    let asked = listener.accept().unwrap();
    recording.signal("-INT");
    let (status, ended) = recording.end();
    assert_eq!(status.code(), Some(2), "{:#?}", recording.printed);
    assert!(ended < Duration::from_secs(30), "{ended:?}");
    assert!(
        recording.printed[0].contains("no bag was created"),
        "{:?}",
        recording.printed
    );
    assert!(!bag.exists());
    drop(asked);
}

#[test]
fn a_second_interrupt_ends_a_recording_without_waiting_but_with_its_report() {
    let directory = tempfile::tempdir().unwrap();
    let capture = directory.path().join("many.pcap");
    many_topics(&capture);
    let (recording, bag) = (1..)
        .find_map(|attempt| {
            let agent = LocalAgent::replay(&mut rp(), &capture, &["--speed", "1"]);
            let bag = directory.path().join(attempt.to_string());
            let mut recording = Recording::start(agent.api, &bag, &[]);
            recording.wait_for("Recording...");
            wait_for_messages(&agent);
            // The first signal waits for messages in transit until a time that a replay never
            // reaches.
            recording.signal("-INT");
            recording.wait_for("Completing the bag");
            recording.signal("-INT");
            let (status, ended) = recording.end();
            assert_eq!(status.code(), Some(0), "{:#?}", recording.printed);
            // Without the second signal, it ends 5 s after the first one each time. A busy machine
            // delays a process once.
            let is_soon = ended < Duration::from_secs(4);
            assert!(is_soon || attempt < 3, "{ended:?}");
            is_soon.then_some((recording, bag))
        })
        .unwrap();
    let count: usize = messages(&bag).values().map(Vec::len).sum();
    assert!(count > 0);
    let report = format!("{count} messages in {}", bag.display());
    assert!(
        recording.printed.iter().any(|line| line.ends_with(&report)),
        "{:#?}",
        recording.printed
    );
}

/// Serves recordings at a socket: each stream has its first line, and no other request has an
/// answer. `held` is the path whose connections stay open, as those of streams do.
fn serve_silent_streams(listener: UnixListener, held: Option<&'static str>) {
    std::thread::spawn(move || {
        let mut open = Vec::new();
        for client in listener.incoming() {
            let (mut client, mut request) = (client.unwrap(), [0; 4096]);
            let count = client.read(&mut request).unwrap_or(0);
            let request = String::from_utf8_lossy(&request[..count]);
            if request.starts_with("GET /samples?") {
                let head = "HTTP/1.1 200 OK\r\ntransfer-encoding: chunked\r\n\r\n";
                let line = "{\"open\":{\"topics\":[]}}\n";
                write!(client, "{head}{:x}\r\n{line}\r\n", line.len()).unwrap();
                open.push(client);
            } else if held.is_some_and(|path| request.starts_with(&format!("GET {path} "))) {
                open.push(client);
            }
        }
    });
}

/// Returns `rp bag record -a` of the agent at a socket.
fn record_at(socket: &Path, bag: &Path) -> Command {
    let mut command = rp();
    command.env_remove("ROS_DISTRO").env_remove("ROS_DOMAIN_ID");
    command.args(["bag", "record", "-a", "--socket"]);
    command.arg(socket).arg("-o").arg(bag);
    command
}

#[test]
fn a_recording_of_an_agent_that_falls_silent_ends_with_an_error() {
    let directory = tempfile::tempdir().unwrap();
    let socket = directory.path().join("api.sock");
    let bag = directory.path().join("bag");
    serve_silent_streams(UnixListener::bind(&socket).unwrap(), None);
    let mut recording = Recording::of(&mut record_at(&socket, &bag));
    recording.wait_for("Recording...");
    let (status, ended) = recording.end();
    assert_eq!(status.code(), Some(1), "{:#?}", recording.printed);
    assert!((4.0..30.0).contains(&ended.as_secs_f64()), "{ended:?}");
    let last = recording.printed.last().unwrap();
    assert!(last.contains("does not answer"), "{:#?}", recording.printed);
    assert!(bag.join("metadata.yaml").exists());
}

#[test]
fn a_recording_in_the_background_of_a_shell_is_not_stopped() {
    let directory = tempfile::tempdir().unwrap();
    let socket = directory.path().join("api.sock");
    serve_silent_streams(UnixListener::bind(&socket).unwrap(), None);
    let record = record_at(&socket, &directory.path().join("bag"));
    let mut shell = Command::new("bash");
    shell.env_remove("ROS_DISTRO").env_remove("ROS_DOMAIN_ID");
    // With job control, the recording has a process group of its own.
    let script = r#"set -m; "$@" & wait $!"#;
    shell.args(["-c", script, "bash"]);
    shell.arg(record.get_program()).args(record.get_args());
    let mut terminal = Terminal::start(&mut shell);
    terminal.wait_for("Keyboard handling disabled");
    terminal.wait_for("Recording...");
    // It ends because the agent is silent.
    assert_eq!(terminal.ends(), Some(1), "{}", terminal.written());
    let written = terminal.written();
    assert!(written.contains("does not answer"), "{written}");
    terminal.assert_settings_given_back();
}

#[test]
fn a_third_interrupt_restores_the_terminal() {
    let directory = tempfile::tempdir().unwrap();
    let socket = directory.path().join("api.sock");
    // The recording waits for an answer, so it cannot end in order.
    let listener = UnixListener::bind(&socket).unwrap();
    serve_silent_streams(listener, Some("/participants"));
    let bag = directory.path().join("bag");
    let mut terminal = Terminal::start(&mut record_at(&socket, &bag));
    terminal.wait_for("Press SPACE");
    terminal.wait_for("Recording...");
    for _ in 0..3 {
        // Signals of the same kind that arrive together count as one.
        std::thread::sleep(Duration::from_secs(1));
        terminal.signal("-INT");
    }
    assert_eq!(terminal.ends(), Some(2), "{}", terminal.written());
    let written = terminal.written();
    assert!(written.contains("rp bag reindex"), "{written}");
    terminal.assert_settings_given_back();
}
