use ros2probe_wire::names::DdsTopic;
use ros2probe_wire::{EntityId, GuidPrefix};

use super::*;
use crate::facts::watch::Watch;

fn naming(name: &str) -> Naming {
    Naming::of(&DdsTopic::parse(name).unwrap())
}

fn guid(number: u8) -> Guid {
    Guid::new(GuidPrefix([number; 12]), EntityId([0, 0, number, 3]))
}

fn watchlist(patterns: &[&str]) -> Watchlist {
    Watchlist::new(
        patterns
            .iter()
            .map(|name| Watch::named(name).unwrap())
            .collect(),
    )
    .unwrap()
}

#[test]
fn the_same_name_in_two_domains_makes_two_topics() {
    let mut topics = Topics::default();
    let naming = naming("rt/chatter");
    let (one, _) = topics.join(
        DomainId(0),
        &naming,
        guid(1),
        Role::Writer,
        ModelTime::from_nanoseconds(1),
    );
    let (two, _) = topics.join(
        DomainId(5),
        &naming,
        guid(2),
        Role::Writer,
        ModelTime::from_nanoseconds(1),
    );
    assert_ne!(one, two);
}

#[test]
fn the_glob_for_all_topics_excludes_hidden_topics_and_services() {
    let all = watchlist(&["/**"]);
    assert_eq!(naming("rt/points").covered_by(DomainId(0), &all), [0]);
    assert!(
        naming("rt/fib/_action/feedback")
            .covered_by(DomainId(0), &all)
            .is_empty()
    );
    assert!(
        naming("rq/addRequest")
            .covered_by(DomainId(0), &all)
            .is_empty()
    );
    assert!(
        naming("ros_discovery_info")
            .covered_by(DomainId(0), &all)
            .is_empty()
    );
    let hidden = watchlist(&["/**/_action/feedback", "/fib/_action/status"]);
    assert_eq!(
        naming("rt/fib/_action/feedback").covered_by(DomainId(0), &hidden),
        [0]
    );
    assert_eq!(
        naming("rt/fib/_action/status").covered_by(DomainId(0), &hidden),
        [1]
    );
}

#[test]
fn cpu_buffer_topics_belong_to_their_base_topic() {
    let mut topics = Topics::default();
    let (main, _) = topics.join(
        DomainId(0),
        &naming("rt/image"),
        guid(1),
        Role::Writer,
        ModelTime::from_nanoseconds(1),
    );
    let buffer = naming("rt/image/_buf_cpu");
    let (same, _) = topics.join(
        DomainId(0),
        &buffer,
        guid(2),
        Role::Writer,
        ModelTime::from_nanoseconds(1),
    );
    assert_eq!(main, same);
    assert_eq!(topics.get(main).unwrap().writers, [guid(1)]);
}

#[test]
fn a_topic_beyond_the_cap_is_rejected_until_a_slot_is_free() {
    let mut topics = Topics::default();
    let all = watchlist(&["/**"]);
    let mut ids = Vec::new();
    for name in ["rt/a", "rt/b", "rt/c"] {
        let (id, _) = topics.join(
            DomainId(0),
            &naming(name),
            guid(1),
            Role::Writer,
            ModelTime::from_nanoseconds(1),
        );
        topics.apply_lists(id, (&all, &[], false), 2, ModelTime::from_nanoseconds(1));
        ids.push(id);
    }
    let state = |topics: &Topics, index: usize| topics.get(ids[index]).unwrap().watched;
    assert_eq!((state(&topics, 2), topics.rejected), (Watched::Rejected, 1));
    topics.leave(ids[0], guid(1), ModelTime::from_nanoseconds(2));
    topics.apply_lists(
        ids[2],
        (&all, &[], false),
        2,
        ModelTime::from_nanoseconds(3),
    );
    assert_eq!((state(&topics, 2), topics.watched()), (Watched::Yes, 2));
    assert!(topics.get(ids[0]).is_none());
}

#[test]
fn a_vanished_topic_stays_for_its_grace_period() {
    let mut topics = Topics::default();
    let (id, _) = topics.join(
        DomainId(0),
        &naming("rt/a"),
        guid(1),
        Role::Writer,
        ModelTime::from_nanoseconds(1),
    );
    topics.leave(id, guid(1), ModelTime::from_nanoseconds(100));
    topics.expire(ModelTime::from_nanoseconds(599), Duration::from_nanos(500));
    assert!(topics.get(id).unwrap().is_vanished());
    topics.expire(ModelTime::from_nanoseconds(600), Duration::from_nanos(500));
    assert!(topics.is_empty());
}
