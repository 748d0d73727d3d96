use super::*;

const START: u64 = 1_795_142_331_000_000_000;
const MILLISECOND: u64 = 1_000_000;

/// A generator of pseudo-random delays.
struct Delays(u64);

impl Delays {
    fn next(&mut self, least: u64, spread: u64) -> u64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        least + (self.0 >> 33) % spread
    }
}

/// Adds 100 stamps, each with the topics and delays that `each` returns. The recorder receives each
/// message `transport` nanoseconds after its publication.
fn recorded(
    transport: Option<u64>,
    mut each: impl FnMut(&mut Delays) -> Vec<(&'static str, u64)>,
) -> RecordedChains {
    let mut chains = RecordedChains::default();
    let mut delays = Delays(7);
    for round in 0..100 {
        let stamp = START + round * 100 * MILLISECOND + round * 1_234_567 + 1;
        let mut messages = each(&mut delays);
        messages.sort_by_key(|(_, delay)| *delay);
        for (topic, delay) in messages {
            add(&mut chains, topic, stamp, stamp + delay, transport);
        }
    }
    chains
}

fn add(chains: &mut RecordedChains, topic: &str, stamp: u64, at: u64, transport: Option<u64>) {
    let seconds = i32::try_from(stamp / 1_000_000_000).unwrap();
    let nanoseconds = u32::try_from(stamp % 1_000_000_000).unwrap();
    let published = transport.map(|_| Timestamp(at));
    let logged = Timestamp(at + transport.unwrap_or(0));
    chains.add(&topic.into(), (seconds, nanoseconds), logged, published);
}

fn paths(facts: &RecordedFacts) -> Vec<String> {
    let path = |chain: &ChainFacts| {
        let names: Vec<_> = chain
            .path
            .topics
            .iter()
            .map(|(name, _)| name.as_str())
            .collect();
        format!("{} {}", names.join(" "), chain.count)
    };
    facts.chains.iter().map(path).collect()
}

#[test]
fn topics_whose_delays_add_up_form_a_chain() {
    let chains = recorded(Some(500_000), |delays| {
        let first = delays.next(10 * MILLISECOND, 4 * MILLISECOND);
        let second = first + delays.next(5 * MILLISECOND, 2 * MILLISECOND);
        vec![("/scan", 0), ("/clean", first), ("/cmd", second)]
    });
    let facts = chains.finish(&[]);
    assert_eq!(paths(&facts), ["/scan /clean /cmd 100"]);
    assert_eq!(facts.times, Times::Publish);
    let hop = facts.chains[0].hop(1).whole;
    assert!((0.005..0.007).contains(&hop.p50), "{hop:?}");
}

#[test]
fn branches_of_one_topic_form_no_chain_even_if_one_is_always_first() {
    let chains = recorded(None, |delays| {
        let clean = delays.next(10 * MILLISECOND, 4 * MILLISECOND);
        let map = delays.next(30 * MILLISECOND, 4 * MILLISECOND);
        vec![("/scan", 0), ("/clean", clean), ("/map", map)]
    });
    let facts = chains.finish(&[]);
    assert_eq!(paths(&facts), ["/scan /clean 100", "/scan /map 100"]);
    assert_eq!(facts.times, Times::Log);
}

#[test]
fn constant_delays_leave_the_cause_unclear() {
    let chains = recorded(None, |_| {
        let (clean, map) = (10 * MILLISECOND, 30 * MILLISECOND);
        vec![("/scan", 0), ("/clean", clean), ("/map", map)]
    });
    let facts = chains.finish(&[]);
    assert_eq!(paths(&facts), ["/scan /clean 100"]);
    let others = vec!["/scan".into(), "/clean".into()];
    assert_eq!(facts.unclear, [("/map".into(), others)]);
}

#[test]
fn topics_published_together_count_as_one_and_the_preferred_one_represents_them() {
    let chains = || {
        recorded(None, |delays| {
            let info = delays.next(0, MILLISECOND / 2);
            let rectified = delays.next(8 * MILLISECOND, MILLISECOND);
            vec![("/image", 0), ("/depth", info), ("/rectified", rectified)]
        })
    };
    let facts = chains().finish(&[]);
    assert_eq!(paths(&facts), ["/image /rectified 100"]);
    assert_eq!(facts.together, [("/depth".into(), "/image".into())]);
    let facts = chains().finish(&["/depth"]);
    assert_eq!(paths(&facts), ["/depth /rectified 100"]);
}

#[test]
fn rounded_stamps_and_topics_without_a_fixed_order_form_no_chain() {
    let mut chains = RecordedChains::default();
    for round in 0..100 {
        let stamp = START + round * 100 * MILLISECOND;
        add(&mut chains, "/a", stamp, stamp + MILLISECOND, None);
        add(&mut chains, "/b", stamp, stamp + 9 * MILLISECOND, None);
    }
    let facts = chains.finish(&[]);
    assert_eq!((paths(&facts), facts.rounded), (vec![], 200));
    let chains = recorded(None, |delays| {
        let (one, other) = (
            delays.next(0, 9 * MILLISECOND),
            delays.next(0, 9 * MILLISECOND),
        );
        vec![("/a", one), ("/b", other)]
    });
    assert_eq!(paths(&chains.finish(&[])), Vec::<String>::new());
}

#[test]
fn a_topic_with_new_stamps_belongs_to_no_chain() {
    let mut chains = RecordedChains::default();
    for round in 0..100 {
        let stamp = START + round * 100_000_001 + 1;
        add(&mut chains, "/a", stamp, stamp + MILLISECOND, None);
        let again = stamp + 9 * MILLISECOND;
        add(&mut chains, "/b", again, again, None);
    }
    assert_eq!(paths(&chains.finish(&[])), Vec::<String>::new());
}

#[test]
fn clock_steps_affect_at_most_the_messages_at_the_step() {
    for step in [-3_600_000_000_000_i64, 3_600_000_000_000] {
        let mut chains = RecordedChains::default();
        for round in 0..100_u64 {
            let stamp = START + round * 101_000_001 + 1;
            let after = |is_after: bool, at: u64| match is_after {
                true => at.checked_add_signed(step).unwrap(),
                false => at,
            };
            // The clock steps in round 50, between the two messages.
            let stamp = after(round > 50, stamp);
            add(&mut chains, "/a", stamp, stamp + MILLISECOND, None);
            let second = after(round == 50, stamp + 9 * MILLISECOND);
            add(&mut chains, "/b", stamp, second, None);
        }
        let facts = chains.finish(&[]);
        assert_eq!(paths(&facts), ["/a /b 99"], "{step}");
        let whole = facts.chains[0].between(0, 1);
        assert!((whole.max - 0.008).abs() < 1e-9, "{whole:?}");
    }
}

#[test]
fn a_recording_of_repeated_playback_counts_each_repetition() {
    let mut chains = RecordedChains::default();
    for play in 0..3_u64 {
        for round in 0..10_u64 {
            let stamp = START + round * 101_000_001 + 1;
            let at = stamp + play * 60_000_000_000;
            add(&mut chains, "/a", stamp, at + MILLISECOND, None);
            add(&mut chains, "/b", stamp, at + 9 * MILLISECOND, None);
        }
    }
    assert_eq!(paths(&chains.finish(&[])), ["/a /b 30"]);
}

#[test]
fn all_tables_are_bounded() {
    let mut chains = RecordedChains::default();
    for each in 0..MAX_OPEN as u64 + 100 {
        // The recorder's clock stands still.
        let stamp = START + each * 7 + 1;
        add(&mut chains, "/a", stamp, START, None);
    }
    assert!(chains.open.len() <= MAX_OPEN);
    for each in 0..MAX_TOPICS + 10 {
        add(
            &mut chains,
            &format!("/topic_{each}"),
            START + 1,
            START,
            None,
        );
    }
    assert_eq!(chains.topics.len(), MAX_TOPICS);
    assert_eq!(chains.refused, 11);
    let mut chains = RecordedChains::with_limit(100);
    for round in 0..100 {
        let stamp = START + round * 101_000_001 + 1;
        add(&mut chains, "/a", stamp, stamp + MILLISECOND, None);
        add(&mut chains, "/b", stamp, stamp + 9 * MILLISECOND, None);
    }
    let facts = chains.finish(&[]);
    assert_eq!(
        (paths(&facts), facts.refused),
        (vec!["/a /b 50".into()], 100)
    );
}
