//! What distinguishes a robot from the others.

use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet};

use ros2probe_api::fleet::{Difference, PRESENT, Part};

/// Minimum number of robots in reach for a comparison: of two, none is usual.
pub(super) const MIN_ROBOTS: usize = 3;
/// Fraction of the usual rate by which another may differ.
const RATE_TOLERANCE: f64 = 0.2;
/// Rates below this one, in hertz, are not compared: an interval has too few messages.
const MIN_RATE_HZ: f64 = 0.1;

/// A property of a robot that others have, too.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Trait {
    /// One of several values.
    Text(String),
    /// A rate.
    Hertz(f64),
}

/// Returns the differences of each robot. A value is usual if more than half of all robots have it.
pub(super) fn find(
    robots: &BTreeMap<String, BTreeMap<String, Trait>>,
) -> BTreeMap<String, Vec<Difference>> {
    let mut found: BTreeMap<String, Vec<Difference>> = BTreeMap::new();
    if robots.len() < MIN_ROBOTS {
        return found;
    }
    let properties: BTreeSet<&String> = robots.values().flat_map(BTreeMap::keys).collect();
    for what in properties {
        let values: Vec<_> = robots
            .iter()
            .map(|(name, traits)| (name, traits.get(what)))
            .collect();
        let Some(usual) = majority_value(&values) else {
            continue;
        };
        let same = |value: Option<&Trait>| is_same(value, usual);
        let count = values.iter().filter(|(_, value)| same(*value)).count();
        for (name, here) in values.iter().filter(|(_, value)| !same(*value)) {
            found.entry((*name).clone()).or_default().push(Difference {
                part: part(what),
                what: what.clone(),
                here: here.map(text),
                usual: usual.map(text),
                robots: count,
                of: robots.len(),
                text: String::new(),
            });
        }
    }
    for differences in found.values_mut() {
        drop_details(differences);
        for difference in differences {
            difference.text = difference.to_string();
        }
    }
    found
}

/// Returns the value that more than half of the robots have.
fn majority_value<'a>(values: &[(&String, Option<&'a Trait>)]) -> Option<Option<&'a Trait>> {
    let mut sorted: Vec<_> = values.iter().map(|(_, value)| *value).collect();
    sorted.sort_by(|one, two| {
        order(*one)
            .total_cmp(&order(*two))
            .then_with(|| text_order(*one, *two))
    });
    // Equal values are side by side, and so are similar rates.
    let same = |candidate: Option<&Trait>, place: usize| {
        let (before, after) = sorted.split_at_checked(place)?;
        let first = before.partition_point(|value| !is_same(*value, candidate));
        let end = after.partition_point(|value| is_same(*value, candidate));
        Some(place + end - first)
    };
    let counted = sorted.iter().enumerate();
    counted
        .filter_map(|(place, candidate)| Some((*candidate, same(*candidate, place)?)))
        .max_by_key(|(_, count)| *count)
        .filter(|(_, count)| count * 2 > values.len())
        .map(|(candidate, _)| candidate)
}

/// Returns the place of a value: texts first, then rates, of which a missing one is 0.
fn order(value: Option<&Trait>) -> f64 {
    match value {
        Some(Trait::Text(_)) => f64::NEG_INFINITY,
        Some(Trait::Hertz(rate)) => *rate,
        None => 0.0,
    }
}

fn text_order(one: Option<&Trait>, two: Option<&Trait>) -> Ordering {
    match (one, two) {
        (Some(Trait::Text(one)), Some(Trait::Text(two))) => one.cmp(two),
        _ => Ordering::Equal,
    }
}

fn is_same(one: Option<&Trait>, two: Option<&Trait>) -> bool {
    match (one, two) {
        (Some(Trait::Hertz(one)), Some(Trait::Hertz(two))) => {
            let (low, high) = (one.min(*two), one.max(*two));
            high < MIN_RATE_HZ || high - low <= RATE_TOLERANCE * high
        }
        // A topic without a rate has no messages.
        (Some(Trait::Hertz(rate)), None) | (None, Some(Trait::Hertz(rate))) => *rate < MIN_RATE_HZ,
        _ => one == two,
    }
}

/// Removes properties of a topic that the robot, or each other one, does not have at all, and those
/// of a topic without publishers: one difference shows each of these.
fn drop_details(differences: &mut Vec<Difference>) {
    let is_whole =
        |difference: &Difference| difference.here.is_none() || difference.usual.is_none();
    let silent: BTreeSet<String> = differences
        .iter()
        .filter(|difference| difference.here.as_deref() == Some("0"))
        .filter_map(|difference| difference.what.strip_prefix("publishers of "))
        .map(str::to_owned)
        .collect();
    differences.retain(|difference| {
        let topic = difference.what.split_once(" of ");
        let of_silent = |(property, topic): (&str, &str)| {
            silent.contains(topic) && property != "publishers" && property != "subscriptions"
        };
        !topic.is_some_and(of_silent)
    });
    let topics: BTreeSet<String> = differences
        .iter()
        .filter(|difference| is_whole(difference))
        .filter_map(|difference| difference.what.strip_prefix("message type of "))
        .map(str::to_owned)
        .collect();
    differences.retain(|difference| {
        let topic = difference.what.split_once(" of ");
        topic.is_none_or(|(property, topic)| property == "message type" || !topics.contains(topic))
    });
    for difference in differences {
        if is_whole(difference)
            && let Some(topic) = difference.what.strip_prefix("message type of ")
        {
            difference.what = format!("topic {topic}");
            let present = |value: &mut Option<String>| {
                if value.is_some() {
                    *value = Some(PRESENT.to_owned());
                }
            };
            present(&mut difference.here);
            present(&mut difference.usual);
        }
    }
}

/// Returns the part of a robot that a property belongs to, by the property's name.
fn part(what: &str) -> Part {
    let parts = [
        ("node ", Part::Nodes),
        ("message type of ", Part::Topics),
        ("publishers of ", Part::Endpoints),
        ("subscriptions of ", Part::Endpoints),
        ("endpoints with ", Part::Endpoints),
        ("reliability of ", Part::Qos),
        ("durability of ", Part::Qos),
        ("rate of ", Part::Rates),
    ];
    let found = parts.iter().find(|(prefix, _)| what.starts_with(prefix));
    found.map_or(Part::Agent, |(_, part)| *part)
}

fn text(value: &Trait) -> String {
    match value {
        Trait::Text(text) => text.clone(),
        Trait::Hertz(rate) => format!("{rate:.1} Hz"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn robots(own: &[&[(&str, Trait)]]) -> BTreeMap<String, BTreeMap<String, Trait>> {
        let named = own.iter().enumerate().map(|(index, traits)| {
            let traits = traits
                .iter()
                .map(|(what, value)| ((*what).to_owned(), value.clone()));
            (format!("r{index}"), traits.collect())
        });
        named.collect()
    }

    fn texts(found: &BTreeMap<String, Vec<Difference>>) -> Vec<(&str, Vec<String>)> {
        let robots = found.iter();
        robots
            .map(|(name, all)| {
                (
                    name.as_str(),
                    all.iter().map(|it| it.text.clone()).collect(),
                )
            })
            .collect()
    }

    #[test]
    fn the_usual_value_is_found_among_many_robots() {
        let name = String::new();
        let rates: Vec<_> = (0..1000)
            .map(|number| Trait::Hertz(10.0 + f64::from(number % 3)))
            .collect();
        let missing = (0..400).map(|_| None);
        let values: Vec<_> = rates
            .iter()
            .map(Some)
            .chain(missing)
            .map(|it| (&name, it))
            .collect();
        let usual = majority_value(&values).unwrap().unwrap();
        assert!(is_same(Some(usual), Some(&Trait::Hertz(11.0))), "{usual:?}");
        let texts: Vec<_> = (0..1000)
            .map(|number| Trait::Text((number % 2).to_string()))
            .collect();
        let values: Vec<_> = texts.iter().map(|it| (&name, Some(it))).collect();
        assert_eq!(majority_value(&values), None);
        let values = [(&name, None), (&name, None), (&name, texts.first())];
        assert_eq!(majority_value(&values), Some(None));
    }

    #[test]
    fn the_odd_robot_is_found_and_the_others_have_no_difference() {
        let text = |text: &str| Trait::Text(text.to_owned());
        let usual: &[_] = &[
            ("node /planner", text("present")),
            ("message type of /scan", text("sensor_msgs/msg/LaserScan")),
            ("reliability of /scan", text("reliable")),
            ("rate of /scan", Trait::Hertz(10.0)),
            ("version of the agent", text("1.2.0")),
            ("durability of /map", text("volatile")),
            ("publishers of /map", text("1")),
        ];
        let odd: &[_] = &[
            ("node /other", text("present")),
            ("message type of /scan", text("sensor_msgs/msg/LaserScan")),
            ("reliability of /scan", text("best_effort")),
            ("rate of /scan", Trait::Hertz(5.0)),
            ("version of the agent", text("1.1.0")),
            ("durability of /map", text("volatile")),
            ("publishers of /map", text("1")),
        ];
        let without: &[_] = &[
            ("node /planner", text("present")),
            ("durability of /map", text("volatile")),
            ("publishers of /map", text("1")),
            ("version of the agent", text("1.2.0")),
        ];
        let near: &[_] = &[
            ("rate of /scan", Trait::Hertz(9.2)),
            ("publishers of /map", text("0")),
            ("node /planner", text("present")),
            ("message type of /scan", text("sensor_msgs/msg/LaserScan")),
            ("reliability of /scan", text("reliable")),
            ("version of the agent", text("1.2.0")),
        ];
        let found = find(&robots(&[usual, odd, near, without, usual, usual]));
        let odd = [
            "node /other is only here (5 of 6)",
            "node /planner is missing (5 of 6)",
            "rate of /scan: 5.0 Hz, usually 10.0 Hz (4 of 6)",
            "reliability of /scan: best_effort, usually reliable (4 of 6)",
            "version of the agent: 1.1.0, usually 1.2.0 (5 of 6)",
        ];
        let near = ["publishers of /map: 0, usually 1 (5 of 6)"];
        let without = ["topic /scan is missing (5 of 6)"];
        let owned = |texts: &[&str]| texts.iter().map(|text| (*text).to_owned()).collect();
        assert_eq!(
            texts(&found),
            [
                ("r1", owned(&odd)),
                ("r2", owned(&near)),
                ("r3", owned(&without))
            ]
        );
    }

    #[test]
    fn without_a_majority_no_robot_is_odd() {
        let version = |text: &str| [("version", Trait::Text(text.to_owned()))];
        let (one, two, three) = (version("1"), version("2"), version("3"));
        assert!(find(&robots(&[&one, &two])).is_empty());
        assert!(find(&robots(&[&one, &two, &three])).is_empty());
        assert!(find(&robots(&[&one, &one, &two, &two])).is_empty());
        let slow = |rate| [("rate of /a", Trait::Hertz(rate))];
        assert!(find(&robots(&[&slow(0.01), &slow(0.09), &slow(0.0)])).is_empty());
    }
}
