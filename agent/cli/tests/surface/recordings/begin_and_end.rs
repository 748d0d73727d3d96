//! The start and the interruption of a recording of many topics.

use super::*;

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
    let mut recording = Recording::start(agent.api, &bag, &[]);
    let began = recording.wait_for("Recording...");
    std::thread::sleep(Duration::from_secs(2));
    recording.signal("-INT");
    let (status, ended) = recording.end();
    eprintln!("{MANY} topics: began after {began:?}, ended after {ended:?}");
    assert_eq!(status.code(), Some(0), "{:#?}", recording.printed);
    assert!(began < Duration::from_secs(3), "began after {began:?}");
    // The end waits for the next clock of the replay, which differs from the current time.
    assert!(ended < Duration::from_secs(5), "ended after {ended:?}");
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
    assert!(ended < Duration::from_secs(5), "{ended:?}");
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
    let agent = LocalAgent::replay(&mut rp(), &capture, &["--speed", "1"]);
    let bag = directory.path().join("bag");
    let mut recording = Recording::start(agent.api, &bag, &[]);
    recording.wait_for("Recording...");
    std::thread::sleep(Duration::from_secs(2));
    // The first signal waits for messages in transit until a time that a replay never reaches.
    recording.signal("-INT");
    recording.wait_for("Completing the bag");
    recording.signal("-INT");
    let (status, ended) = recording.end();
    assert_eq!(status.code(), Some(0), "{:#?}", recording.printed);
    assert!(ended < Duration::from_millis(1500), "{ended:?}");
    let count: usize = messages(&bag).values().map(Vec::len).sum();
    assert!(count > 0);
    let report = format!("{count} messages in {}", bag.display());
    assert!(
        recording.printed.iter().any(|line| line.ends_with(&report)),
        "{:#?}",
        recording.printed
    );
}
