//! A tick visits only writers with something due. Captures yield the same as with visits of every
//! writer.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use ros2probe_capture::frame_decoder::FrameDecoder;
use ros2probe_capture::pcap::PcapReader;
use ros2probe_capture::reassembly::Limits;
use ros2probe_model::facts::watch::{Watch, Watchlist};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_testing::truth;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{Expansion, Timestamp};

/// Interval between the ticks of the model.
const TICK: u64 = SECOND / 10;
/// A socket that carries no messages. It may belong to any receiver, so its end makes the next tick
/// visit every writer.
const NO_SOCKET: u64 = u64::MAX;

/// Replays a capture. Returns the output of each tick, and all facts of each second.
fn replay(capture: &Path, visits_all: bool) -> Vec<(u64, Vec<String>)> {
    let mut observer = Observer::new(Settings::default());
    let everything = Watchlist::new(vec![Watch::named("/**").unwrap()]).unwrap();
    observer.input(Input::Watchlist(Arc::new(everything)));
    let mut reader = PcapReader::open(capture, Expansion::Limited).unwrap();
    let mut feed = FrameDecoder::new(Limits::default());
    let (mut found, mut now) = (Vec::new(), 0);
    let mut note = |observer: &mut Observer, now: u64| {
        let output = observer.drain();
        let events = output.events.events.iter();
        let mut lines: Vec<_> = events.map(|event| format!("{event:?}")).collect();
        lines.extend(output.interest.iter().map(|each| format!("{each:?}")));
        // Writers that are due at the same tick have no order.
        lines.sort();
        if now.is_multiple_of(SECOND) {
            lines.push(format!("{:?}", observer.snapshot(Timestamp(now))));
        }
        found.push((now, lines));
    };
    while let Some(captured) = reader.next_packet().unwrap() {
        let end = captured.time.0;
        while now > 0 && now < end {
            now = (now / TICK * TICK + TICK).min(end);
            if visits_all {
                observer.input(Input::SocketClosed(NO_SOCKET));
            }
            observer.input(Input::Time(Timestamp(now)));
            note(&mut observer, now);
        }
        now = now.max(end);
        feed.packet(&captured, &mut observer);
    }
    observer.input(Input::End);
    note(&mut observer, (now / SECOND + 1) * SECOND);
    found
}

fn compare(captures: impl Iterator<Item = PathBuf>) {
    for capture in captures {
        let (due, all) = (replay(&capture, false), replay(&capture, true));
        assert_eq!(due.len(), all.len());
        for (due, all) in due.iter().zip(&all) {
            assert_eq!(due, all, "{}", capture.display());
        }
    }
}

#[test]
fn captures_yield_the_same_as_with_visits_of_all_writers() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data");
    let scenarios = truth::scenarios(&data);
    assert!(scenarios.len() >= 8);
    compare(scenarios.into_iter().map(|scenario| scenario.capture));
}

#[test]
#[ignore = "needs the corpus of captures: make test-corpus"]
fn the_whole_corpus_yields_the_same_as_with_visits_of_all_writers() {
    let scenarios = truth::scenarios(&ros2probe_testing::corpus());
    assert!(!scenarios.is_empty());
    compare(scenarios.into_iter().map(|scenario| scenario.capture));
}
