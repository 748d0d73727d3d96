//! A long time beside a robot that changes all the while: the agent's graph stays the true one, and
//! its needs stay what they were. Seconds in `make test`, an hour in `make soak`.

#![expect(
    clippy::indexing_slicing,
    reason = "test code says what must hold by failing"
)]

mod forged;
mod harness;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, anyhow, ensure};
use forged::crowd::{Crowd, Graph, Scale, Tally};
use forged::{Carrier, Sender};
use harness::agent::{Agent, METRICS, ON_THE_WIRE, Scrape, at_the_sockets_of, get};
use harness::network::{Link, Namespace};
use harness::soak::{self, Curve, dropped};
use serde_json::Value;

const API: &str = "http://127.0.0.1:17401";
/// How long an agent may take to show what is so.
const PATIENCE: Duration = Duration::from_secs(60);
/// Of `make soak`: until memory is what it will be.
const WARM_UP: f64 = 0.15;
/// What the memory of an hour may rise.
const GROWTH: f64 = 0.02;

#[test]
fn an_hour_of_a_changing_graph_leaves_the_graph_true_and_memory_flat() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let program = soak::program(env!("CARGO_BIN_EXE_rp"));
    let start = |name: &str, host, source: String, watch: &str| {
        let state = directory.path().join(name);
        std::fs::create_dir(&state)?;
        let file = directory.path().join(format!("{name}.yaml"));
        let state = state.display();
        let text = format!("watch: [{watch}]\nstate_directory: {state}\nlog: warn\n{source}");
        std::fs::write(&file, text)?;
        Agent::start(host, &program, &file)
    };
    // All topics, as in the package's configuration; and those that are asked for.
    let wire = start("wire", &link.monitor, ON_THE_WIRE.to_owned(), "/**")?;
    let sockets = at_the_sockets_of(&link.robot);
    let sockets = start("sockets", &link.robot, sockets, "/measured/**")?;
    // Sockets belong to the cgroup that they were made in.
    let sender = link
        .robot
        .hold(|| Sender::between(&link.robot, &link.monitor))??;
    let long = soak::long();
    let scale = match long {
        Some(_) => Scale {
            participants: 1000,
            life: Duration::from_secs(90),
            endpoint_changes: 10.0,
            messages: 200.0,
            leases: &[(4, 25), (10, 35), (20, 39), (100, 1)],
        },
        None => Scale {
            participants: 250,
            life: Duration::from_secs(15),
            endpoint_changes: 10.0,
            messages: 200.0,
            leases: &[(4, 60), (7, 40)],
        },
    };
    let mut crowd = Crowd::new(sender, scale);
    let stop = AtomicBool::new(false);
    let period = Duration::from_secs(long.map_or(1, |_| 5));
    let curves = std::thread::scope(|scope| -> Result<Vec<Curve>> {
        let stop = &stop;
        let looks = [("on the wire", &wire), ("at the sockets", &sockets)];
        let pens = looks.map(|(name, agent)| {
            let (pid, host) = (agent.process.pid(), agent.host);
            scope.spawn(move || Curve::draw(name, (pid, host), period, stop))
        });
        let mut views = Views::of([&wire, &sockets]);
        let lived = live(&mut crowd, &mut views, long);
        stop.store(true, Ordering::Relaxed);
        let curves = pens.map(|pen| pen.join().map_err(|_| anyhow!("a pen died"))?);
        let curves: Vec<Curve> = curves.into_iter().collect::<Result<_>>()?;
        if long.is_some() {
            soak::publish(&curves)?;
        }
        lived?;
        let wrong = views.wrong;
        ensure!(wrong.is_empty(), "{}: {}", wrong.len(), wrong.join("\n"));
        Ok(curves)
    })?;
    for curve in &curves {
        let last = curve.needs.last().context("nothing was drawn")?;
        eprintln!("{}: {} births; at the end {last}", curve.name, crowd.born());
        let Some(long) = long else { continue };
        curve.is_level()?;
        let (slope, end) = curve
            .growth(long.as_secs_f64() * WARM_UP)
            .context("too short for a slope")?;
        let text = format!(
            "memory {:+.2} % by slope, {:+.2} % from begin to end; graph equal at every checkpoint",
            slope * 100.0,
            end * 100.0
        );
        soak::outcome(&format!("changing graph, {}", curve.name), &text)?;
        ensure!(slope <= GROWTH && end <= GROWTH, "{}: {text}", curve.name);
    }
    // More than 1000 topics are measured by no agent of the defaults, and it says so.
    if long.is_some() {
        let refused = wire.scrape()?.sum("ros2probe_topics_rejected_total", &[]);
        ensure!(refused > 0.0, "2000 topics and none refused");
    }
    Ok(())
}

/// Lives through all phases and compares after each.
fn live<C: Carrier>(
    crowd: &mut Crowd<C>,
    views: &mut Views<'_>,
    long: Option<Duration>,
) -> Result<()> {
    let Some(long) = long else {
        crowd.live(Duration::from_secs(6))?;
        views.compare(crowd)?;
        crowd.aim(60);
        crowd.live(Duration::from_secs(3))?;
        return views.compare(crowd);
    };
    let since = Instant::now();
    let mut round = 0;
    while since.elapsed() < long {
        round += 1;
        crowd.aim(usize::MAX);
        crowd.live(
            long.mul_f64(0.03)
                .clamp(Duration::from_secs(20), Duration::from_secs(150)),
        )?;
        views.compare(crowd)?;
        // Most of them go at once, every ten minutes or so.
        if round % 4 == 0 {
            crowd.aim(200);
            crowd.live(Duration::from_secs(20))?;
            views.compare(crowd)?;
        }
    }
    Ok(())
}

/// What each agent says, and what it could not have seen.
struct Views<'a> {
    agents: [&'a Agent<'a>; 2],
    /// What was dropped and what was miscounted for it, by the last checkpoint.
    excused: [(f64, Tally, Vec<f64>); 2],
    since: Instant,
    wrong: Vec<String>,
}

impl<'a> Views<'a> {
    fn of(agents: [&'a Agent<'a>; 2]) -> Views<'a> {
        Views {
            agents,
            excused: Default::default(),
            since: Instant::now(),
            wrong: Vec::new(),
        }
    }

    /// Notes where an agent's graph is another one than the crowd's, or its counts are.
    fn compare<C: Carrier>(&mut self, crowd: &mut Crowd<C>) -> Result<()> {
        for index in 0..self.agents.len() {
            let began = Instant::now();
            let mut said = None;
            loop {
                crowd.rest(Duration::from_millis(500))?;
                let is_late = began.elapsed() > PATIENCE;
                if crowd.is_grey() && !is_late {
                    continue;
                }
                // The crowd stays alive while the agent is asked.
                let (host, before) = (self.agents[index].host, crowd.graph());
                let answer = std::thread::scope(|scope| -> Result<Answer> {
                    let asked = scope.spawn(|| Answer::of(host));
                    while !asked.is_finished() {
                        crowd.rest(Duration::from_millis(10))?;
                    }
                    asked.join().map_err(|_| anyhow!("nobody asked"))?
                })?;
                if crowd.graph() != before && !is_late {
                    continue;
                }
                // What the kernel had no room for nobody can know: it is said again, and counts differ.
                let blind = dropped(&answer.page) > self.excused[index].0;
                let difference = self.difference(index, crowd, &answer, blind || is_late);
                let Some(difference) = difference else { break };
                if is_late {
                    let text = format!("{} s: {difference}", self.since.elapsed().as_secs());
                    eprintln!("agent {index} (0 wire, 1 sockets), {text}");
                    self.wrong.push(text);
                    break;
                }
                if blind && said.is_none_or(|at: Instant| at.elapsed() > PATIENCE / 4) {
                    eprintln!(
                        "{} dropped: everything is said again",
                        dropped(&answer.page)
                    );
                    crowd.repeat()?;
                    said = Some(Instant::now());
                }
            }
        }
        crowd.forget();
        eprintln!(
            "{} s: {} participants of {} compared",
            self.since.elapsed().as_secs(),
            crowd.size(),
            crowd.born()
        );
        Ok(())
    }

    /// What is wrong in an answer; `excused` takes the counts as they are from now on.
    fn difference<C: Carrier>(
        &mut self,
        index: usize,
        crowd: &Crowd<C>,
        answer: &Answer,
        excused: bool,
    ) -> Option<String> {
        let (seen, truth, page) = (&answer.graph, &crowd.graph(), &answer.page);
        let counted = |(entity, event): (&str, &str)| {
            let labels = [("entity", entity), ("event", event)];
            page.sum("ros2_discovery_events_total", &labels) as u64
        };
        let messages: Vec<f64> = crowd
            .messages()
            .map(|(topic, sent)| f64::from(sent) - answer.messages.get(&topic).unwrap_or(&0.0))
            .collect();
        let tally = crowd.tally().iter();
        let errors: Tally = tally
            .map(|(what, count)| (*what, count.wrapping_sub(counted(*what))))
            .collect();
        let (unseen, tally_errors, message_errors) = &mut self.excused[index];
        let wrong_events: Vec<_> = errors
            .iter()
            .filter(|(what, error)| tally_errors.get(what).unwrap_or(&0) != *error)
            .map(|(what, error)| format!("{what:?} {} too few", error.cast_signed()))
            .collect();
        let wrong_messages: Vec<_> = (0..messages.len())
            .filter(|topic| message_errors.get(*topic).unwrap_or(&0.0) != &messages[*topic])
            .map(|topic| format!("topic {topic} {} too few", messages[topic]))
            .collect();
        let strangers = page.sum("ros2_unknown_writers", &[]);
        let wrong: Vec<_> = [wrong_events, wrong_messages].concat();
        let difference = if seen != truth {
            Some(differing(seen, truth))
        } else if strangers > 0.0 || !wrong.is_empty() && dropped(page) <= *unseen {
            let some: Vec<_> = wrong.iter().take(12).cloned().collect();
            Some(format!("{strangers} strangers, {}", some.join(", ")))
        } else {
            None
        };
        if excused && seen == truth {
            *unseen = dropped(page);
            (*tally_errors, *message_errors) = (errors, messages);
        }
        difference
    }
}

/// All that is compared.
struct Answer {
    graph: Graph,
    page: Scrape,
    /// Of each measured topic, less 1e9 for one that is lost.
    messages: BTreeMap<String, f64>,
}

impl Answer {
    fn of(host: &Namespace) -> Result<Answer> {
        let graph = graph_of(host)?;
        let page = Scrape(get(host, &format!("{METRICS}/metrics"))?);
        let mut messages = BTreeMap::new();
        let counters = [
            ("ros2_topic_messages_total{", 1.0),
            ("ros2_topic_lost_messages_total{", -1e9),
        ];
        for line in page.0.lines() {
            let counter = counters.iter().find(|(name, _)| line.starts_with(name));
            let topic = line
                .split("topic=\"")
                .nth(1)
                .and_then(|rest| rest.split('"').next());
            let value = line
                .rsplit(' ')
                .next()
                .and_then(|value| value.parse::<f64>().ok());
            if let (Some((_, factor)), Some(topic), Some(value)) = (counter, topic, value) {
                *messages.entry(topic.to_owned()).or_default() += factor * value;
            }
        }
        Ok(Answer {
            graph,
            page,
            messages,
        })
    }
}

/// Everybody that the agent shows.
fn graph_of(host: &Namespace) -> Result<Graph> {
    let ask = |path: &str| -> Result<Value> {
        Ok(serde_json::from_str(&get(host, &format!("{API}{path}"))?)?)
    };
    let list = |value: &Value, key: &str| value[key].as_array().cloned().unwrap_or_default();
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let mut graph = Graph::default();
    for participant in list(&ask("/participants")?, "participants") {
        let guid = text(&participant["guid"]);
        for node in list(&participant, "nodes") {
            graph.nodes.insert((guid.clone(), text(&node)));
        }
        graph.participants.insert(guid);
    }
    for topic in list(&ask("/topics?hidden=true")?, "topics") {
        for (role, key) in [("writer", "publishers"), ("reader", "subscriptions")] {
            for endpoint in list(&topic, key) {
                let guid = text(&endpoint["guid"]);
                graph
                    .endpoints
                    .insert((text(&topic["dds_name"]), role, guid));
            }
        }
    }
    Ok(graph)
}

fn differing(seen: &Graph, truth: &Graph) -> String {
    fn sides<T: Ord + std::fmt::Debug>(seen: &BTreeSet<T>, truth: &BTreeSet<T>) -> String {
        let ghosts: Vec<_> = seen.difference(truth).collect();
        let missing: Vec<_> = truth.difference(seen).collect();
        let some = |list: &[&T]| format!("{} {:?}", list.len(), &list[..list.len().min(3)]);
        format!("ghosts {}, missing {}", some(&ghosts), some(&missing))
    }
    format!(
        "participants: {}; endpoints: {}; nodes: {}",
        sides(&seen.participants, &truth.participants),
        sides(&seen.endpoints, &truth.endpoints),
        sides(&seen.nodes, &truth.nodes)
    )
}
