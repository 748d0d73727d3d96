//! The graph in the agent's answers, compared with the robot's.

use super::*;

/// Answers of each agent, and the differences that dropped frames explain.
pub(super) struct Views<'a> {
    pub(super) agents: Vec<&'a Agent<'a>>,
    /// Dropped frames and the differences of counts that they explain, at the last checkpoint.
    pub(super) baseline: Vec<(f64, Tally, Vec<f64>)>,
    pub(super) since: Instant,
    pub(super) wrong: Vec<String>,
}

impl<'a> Views<'a> {
    pub(super) fn of(agents: &[&'a Agent<'a>]) -> Views<'a> {
        Views {
            agents: agents.to_vec(),
            baseline: vec![Default::default(); agents.len()],
            since: Instant::now(),
            wrong: Vec::new(),
        }
    }

    /// Records where an agent's graph or counts differ from the crowd's.
    pub(super) fn compare<C: Carrier>(&mut self, crowd: &mut Crowd<C>) -> Result<()> {
        for index in 0..self.agents.len() {
            let began = Instant::now();
            let mut printed = None;
            loop {
                crowd.idle(Duration::from_millis(500))?;
                let is_late = began.elapsed() > PATIENCE;
                if crowd.is_grey() && !is_late {
                    continue;
                }
                // The crowd stays alive while the agent answers.
                let (host, before) = (self.agents[index].host, crowd.graph());
                let answer = std::thread::scope(|scope| -> Result<Answer> {
                    let asked = scope.spawn(|| Answer::of(host));
                    while !asked.is_finished() {
                        crowd.idle(Duration::from_millis(10))?;
                    }
                    asked.join().map_err(|_| anyhow!("nobody asked"))?
                })?;
                if crowd.graph() != before && !is_late {
                    continue;
                }
                // The content of dropped frames is unknown, so endpoints are announced again and
                // counts differ.
                let blind = dropped(&answer.page) > self.baseline[index].0;
                let difference = self.difference(index, crowd, &answer, blind || is_late);
                let Some(difference) = difference else { break };
                if is_late {
                    let text = format!("{} s: {difference}", self.since.elapsed().as_secs());
                    eprintln!("agent {index} (0 wire, 1 sockets), {text}");
                    self.wrong.push(text);
                    break;
                }
                if blind && printed.is_none_or(|at: Instant| at.elapsed() > PATIENCE / 4) {
                    eprintln!(
                        "{} dropped: everything is said again",
                        dropped(&answer.page)
                    );
                    crowd.repeat()?;
                    printed = Some(Instant::now());
                }
            }
        }
        crowd.forget();
        eprintln!(
            "{} s: {} participants of {} compared",
            self.since.elapsed().as_secs(),
            crowd.size(),
            crowd.participants_created()
        );
        Ok(())
    }

    /// Returns what is wrong in an answer. With `baseline`, the present counts become the
    /// reference.
    fn difference<C: Carrier>(
        &mut self,
        index: usize,
        crowd: &Crowd<C>,
        answer: &Answer,
        baseline: bool,
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
        let (unseen, tally_errors, message_errors) = &mut self.baseline[index];
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
        if baseline && seen == truth {
            *unseen = dropped(page);
            (*tally_errors, *message_errors) = (errors, messages);
        }
        difference
    }
}

/// All parts of an answer that are compared.
struct Answer {
    pub(super) graph: Graph,
    pub(super) page: Scrape,
    /// Messages of each measured topic, minus 1e9 for each lost one.
    pub(super) messages: BTreeMap<String, f64>,
}

impl Answer {
    pub(super) fn of(host: &Namespace) -> Result<Answer> {
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

/// Returns all participants and endpoints that the agent shows.
pub(super) fn graph_of(host: &Namespace) -> Result<Graph> {
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
    pub(super) fn sides<T: Ord + std::fmt::Debug>(
        seen: &BTreeSet<T>,
        truth: &BTreeSet<T>,
    ) -> String {
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
