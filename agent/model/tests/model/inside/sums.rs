//! Sums per topic, rates, nodes and domains.

use ros2probe_model::facts::event::EventKind;
use ros2probe_testing::robot_states;

use super::*;

#[test]
fn the_domain_and_the_cpu_time_of_a_process_count_from_the_report_that_has_them() {
    let mut world = World::new();
    for second in 1..=20 {
        let mut report = process(70);
        report.publishers = vec![publisher("/scan", 20 * second, world.now)];
        if second > 3 {
            // It ran for an hour before it was observed.
            report.domain_id = DomainId(3);
            report.cpu = Some(Duration::from_secs(3600) + Duration::from_millis(100 * second));
        }
        world.second(vec![report]);
        let facts = &world.snapshot().inside.unwrap().processes[0];
        let domain_id = DomainId(if second > 3 { 3 } else { 0 });
        assert_eq!(facts.domain_id, domain_id, "second {second}");
        let is_usual = |cpu: f64| (cpu - 0.1).abs() < 0.01;
        assert!(facts.cpu.is_none_or(is_usual), "{:?}", facts.cpu);
        assert!(second < 16 || facts.cpu.is_some(), "second {second}");
    }
}

#[test]
fn a_topic_without_datagrams_appears_with_its_rate_and_ends_with_its_process() {
    let mut world = World::new();
    for second in 1..=12 {
        let mut report = process(70);
        report.domain_id = DomainId(3);
        report.publishers = vec![publisher("/scan", 20 * second, world.now)];
        world.second(vec![report]);
    }
    let topic = world.topic("/scan");
    assert_eq!((topic.domain_id, topic.vanished), (DomainId(3), false));
    assert_eq!(topic.source.label(), "inside");
    let measured = topic.measurement.unwrap();
    assert_eq!(measured.messages, 240);
    assert!(
        (measured.rate_hz - 20.0).abs() < 0.01,
        "{}",
        measured.rate_hz
    );
    let last = world.snapshot().wall_time(measured.last_message.unwrap());
    assert_eq!(last, Timestamp(world.now - SECOND));
    let publishers = world.snapshot().inside.unwrap().publishers.clone();
    assert_eq!(publishers.len(), 1);
    assert!((publishers[0].rate_hz.unwrap() - 20.0).abs() < 0.01);

    let ended = ProcessReport {
        has_ended: true,
        domain_id: DomainId(3),
        publishers: vec![publisher("/scan", 245, world.now)],
        ..process(70)
    };
    world.second(vec![ended]);
    let topic = world.topic("/scan");
    assert!(topic.vanished && world.snapshot().inside.unwrap().processes.is_empty());
    assert_eq!(topic.measurement.unwrap().messages, 245);
}

#[test]
fn a_total_never_decreases_when_processes_end_or_restart() {
    let mut world = World::new();
    let mut totals = Vec::new();
    let counts = [10, 30, 5, 25, 0, 40];
    for (second, count) in counts.into_iter().enumerate() {
        let report = ProcessReport {
            has_ended: second == 3,
            publishers: vec![publisher("/scan", count, world.now)],
            ..process(70)
        };
        world.second(vec![report]);
        totals.push(world.inside("/scan").counts.published);
    }
    // 30, then a new publisher at the same address with 25, then another process with 40.
    assert_eq!(totals, [10, 30, 35, 55, 55, 95]);
}

#[test]
fn handles_omitted_from_a_report_keep_their_counts() {
    let mut world = World::new();
    for second in 1..=8 {
        let report = ProcessReport {
            publishers: vec![publisher("/scan", 10 * second, world.now)],
            ..process(70)
        };
        world.second(vec![report]);
    }
    for _ in 0..12 {
        world.second(Vec::new());
    }
    let inside = world.inside("/scan");
    assert_eq!((inside.counts.published, inside.publishers), (80, 1));
    assert!(inside.rate_hz.abs() < f64::EPSILON, "{}", inside.rate_hz);
}

#[test]
fn on_humble_the_busiest_callback_counts_messages_within_a_process() {
    let mut world = World::new();
    for second in 1..=4 {
        let own = || Trigger::IntraProcess(Some("/image".into()));
        let report = ProcessReport {
            shows_intra_process: false,
            callbacks: vec![
                callback(0x40, own(), 1, 10 * second, world.now),
                callback(0x41, own(), 1, 9 * second, world.now),
            ],
            ..process(70)
        };
        world.second(vec![report]);
    }
    // Receptions count once the next report confirms that no publication follows.
    world.second(vec![process(70)]);
    let inside = world.inside("/image");
    assert_eq!(
        (inside.counts.published, inside.counts.receptions),
        (40, 76)
    );
    assert_eq!((inside.messages, inside.subscriptions), (40, 2));
}

#[test]
fn the_busiest_subscription_counts_messages_of_unobserved_publishers() {
    let mut world = World::new();
    for second in 1..=4 {
        let more = SubscriptionReport {
            handle: 0x21,
            ..subscription("/scan", 4 * second, world.now)
        };
        let report = ProcessReport {
            subscriptions: vec![subscription("/scan", 5 * second, world.now), more],
            ..process(70)
        };
        world.second(vec![report]);
    }
    world.second(vec![process(70)]);
    let inside = world.inside("/scan");
    assert_eq!((inside.counts.published, inside.counts.taken), (0, 36));
    assert_eq!(inside.messages, 20);
    assert_eq!(inside.latency.count(), 36);
    let facts = world.snapshot().inside.unwrap();
    assert_eq!(facts.subscriptions[0].latency.p50, Duration::from_millis(2));
}

#[test]
fn quantiles_of_the_window_exclude_earlier_slow_calls() {
    let mut world = World::new();
    let mut all = durations(100, 80);
    for second in 1..=20 {
        all.merge(&durations(10, 3));
        let report = ProcessReport {
            callbacks: vec![CallbackReport {
                durations: all.clone(),
                ..callback(0x40, timer(100), 1, 100 + 10 * second, world.now)
            }],
            ..process(70)
        };
        world.second(vec![report]);
    }
    let callback = world.snapshot().inside.unwrap().callbacks[0].clone();
    assert_eq!(callback.durations.count(), 300);
    assert!(
        callback.duration.p99 < Duration::from_millis(4),
        "{callback:?}"
    );
    assert!(
        (callback.busy.unwrap() - 0.03).abs() < 0.001,
        "{callback:?}"
    );
    assert!((callback.rate_hz.unwrap() - 10.0).abs() < 0.01);
}

#[test]
fn the_graph_determines_the_node_of_a_handle_only_if_it_is_unambiguous() {
    let mut world = World::new();
    let prefix = world.participant(1, 70);
    let writer = Guid::new(prefix, EntityId([0, 1, 1, 3]));
    let other = Guid::new(prefix, EntityId([0, 1, 2, 3]));
    for (guid, topic) in [(writer, "rt/scan"), (other, "rt/points")] {
        world.announce(guid, topic, STRING);
    }
    world.nodes(prefix, &[("/", "lidar", writer), ("/", "camera", other)]);
    let report = ProcessReport {
        domain_id: DomainId(9),
        publishers: vec![
            publisher("/scan", 1, world.now),
            PublisherReport {
                handle: 0x11,
                ..publisher("/rosout", 1, world.now)
            },
        ],
        ..process(70)
    };
    world.second(vec![report]);
    let publishers = world.snapshot().inside.unwrap().publishers.clone();
    let owners: Vec<_> = publishers.iter().map(|each| &each.owner).collect();
    assert_eq!(owners[0].node, node("/lidar"));
    assert_eq!(owners[1].node, None, "two nodes may have published it");
    // The domain comes from the participant, not from the environment.
    assert!(owners.iter().all(|owner| owner.domain_id == DomainId(0)));
    let topics = world.snapshot().topics;
    assert_eq!(
        topics.iter().filter(|topic| topic.name == "/scan").count(),
        1
    );
}

#[test]
fn callbacks_and_transitions_belong_to_the_only_node_of_a_process() {
    let mut world = World::new();
    let report = ProcessReport {
        nodes: vec!["/lidar".into()],
        callbacks: vec![CallbackReport {
            node: None,
            ..callback(0x40, timer(100), 1, 1, world.now)
        }],
        ..process(70)
    };
    world.second(vec![report]);
    world.transit(Transition {
        process: 70,
        node: None,
        start: "inactive".into(),
        goal: "active".into(),
        at: Timestamp(world.now),
    });
    let facts = world.snapshot().inside.unwrap();
    assert_eq!(facts.callbacks[0].owner.node, node("/lidar"));
    let state = &facts.states[0];
    assert_eq!((&state.node, &*state.state), (&node("/lidar"), "active"));
    // Each transition is an event, even a return to the previous state.
    world.transit(Transition {
        process: 70,
        node: node("/lidar"),
        start: "active".into(),
        goal: "inactive".into(),
        at: Timestamp(world.now),
    });
    let events = world.observer.drain().events.events;
    let transitions = events.iter().filter_map(|event| match &event.kind {
        EventKind::Lifecycle { node, from, to, .. } => Some((node, &**from, &**to)),
        _ => None,
    });
    let lidar = node("/lidar");
    assert_eq!(
        transitions.collect::<Vec<_>>(),
        [
            (&lidar, "inactive", "active"),
            (&lidar, "active", "inactive")
        ]
    );
}

#[test]
fn a_transition_between_two_observations_is_one_event() {
    let mut world = World::new();
    let prefix = world.participant(1, 70);
    let events = Guid::new(prefix, EntityId([0, 0, 0x11, 3]));
    world.announce(
        events,
        "rt/lidar/transition_event",
        robot_states::TRANSITION,
    );
    let lidar = ProcessReport {
        nodes: vec!["/lidar".into()],
        ..process(70)
    };
    let transition = |start: &str, goal: &str, at: u64| Transition {
        process: 70,
        node: node("/lidar"),
        start: start.into(),
        goal: goal.into(),
        at: Timestamp(at),
    };
    let transitions = |world: &mut World| {
        let events = world.observer.drain().events.events;
        let transitions = events.into_iter().filter_map(|event| match event.kind {
            EventKind::Lifecycle { process, to, .. } => Some((process, to.to_string())),
            _ => None,
        });
        transitions.collect::<Vec<_>>()
    };
    world.second(vec![lidar]);
    world.transit(transition("configuring", "inactive", world.now));
    let inside = |goal: &str| (Some(70), goal.to_owned());
    assert_eq!(transitions(&mut world), [inside("inactive")]);

    world.observer.input(Input::InsideDetached);
    let payload = robot_states::transition(13, 3);
    world.put(Message::from_fast(prefix).data(events.entity, 1, &payload));
    let at = world.now;
    assert_eq!(transitions(&mut world), [(None, "active".to_owned())]);
    world.now += 3600 * SECOND;
    world.observer.input(Input::Time(Timestamp(world.now)));
    world.transit(transition("activating", "active", at));
    assert_eq!(transitions(&mut world), []);
    let facts = world.snapshot().inside.unwrap();
    assert_eq!(&*facts.states[0].state, "active");
    world.now += SECOND;
    world.transit(transition("deactivating", "inactive", world.now));
    assert_eq!(transitions(&mut world), [inside("inactive")]);
}

#[test]
fn tables_stay_within_their_caps() {
    let mut world = World::new();
    let mut processes = Vec::new();
    for id in 1..=1_500 {
        let publishers = (0..8).map(|handle| PublisherReport {
            handle,
            ..publisher(&format!("/p{id}/t{handle}"), 1, world.now)
        });
        processes.push(ProcessReport {
            publishers: publishers.collect(),
            nodes: (0..300).map(|each| format!("/n{each}").into()).collect(),
            ..process(id)
        });
    }
    world.second(processes);
    let facts = world.snapshot().inside.unwrap();
    assert_eq!(
        (facts.processes.len(), facts.publishers.len()),
        (1_024, 4_096)
    );
    let tables = world.snapshot().tables;
    let table = tables.iter().find(|table| table.table == "inside").unwrap();
    assert_eq!((table.size, table.limit), (4_096, 4_096));
    assert!(table.evictions > 3_000, "{table:?}");
}

#[test]
fn a_source_that_stops_leaves_no_figures() {
    let mut world = World::new();
    let report = ProcessReport {
        publishers: vec![publisher("/scan", 1, world.now)],
        ..process(70)
    };
    world.second(vec![report]);
    assert!(world.snapshot().inside.is_some());
    world.now += 20 * SECOND;
    world.observer.input(Input::Time(Timestamp(world.now)));
    assert!(world.snapshot().inside.is_none());
    assert!(world.topic("/scan").vanished);
    world.now += 600 * SECOND;
    world.observer.input(Input::Time(Timestamp(world.now)));
    assert!(
        world
            .snapshot()
            .topics
            .iter()
            .all(|topic| topic.name != "/scan")
    );
}
