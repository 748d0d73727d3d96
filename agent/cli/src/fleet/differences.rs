//! What distinguishes a robot from the others.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use serde::Serialize;

/// Minimum number of robots for a comparison: of two, none is usual.
const MIN_ROBOTS: usize = 3;
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

/// A property in which a robot differs from most others.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// Name of the property.
    pub what: String,
    /// Its value; `None` = the robot does not have it.
    pub here: Option<String>,
    /// The usual value; `None` = the others do not have it.
    pub usual: Option<String>,
    /// Number of robots with the usual value.
    pub robots: usize,
    /// Number of compared robots.
    pub of: usize,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            what, robots, of, ..
        } = self;
        match (&self.here, &self.usual) {
            (None, Some(usual)) if usual == "present" => write!(f, "{what} is missing")?,
            (Some(here), None) if here == "present" => write!(f, "{what} is only here")?,
            (None, Some(usual)) => write!(f, "{what}: none, usually {usual}")?,
            (Some(here), None) => write!(f, "{what}: {here}, usually none")?,
            (Some(here), Some(usual)) => write!(f, "{what}: {here}, usually {usual}")?,
            (None, None) => write!(f, "{what}")?,
        }
        write!(f, " ({robots} of {of})")
    }
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
                what: what.clone(),
                here: here.map(text),
                usual: usual.map(text),
                robots: count,
                of: robots.len(),
            });
        }
    }
    for differences in found.values_mut() {
        drop_details(differences);
    }
    found
}

/// Returns the value that more than half of the robots have.
fn majority_value<'a>(values: &[(&String, Option<&'a Trait>)]) -> Option<Option<&'a Trait>> {
    let candidates = values.iter().map(|(_, value)| *value);
    candidates
        .map(|candidate| {
            let same = values
                .iter()
                .filter(|(_, value)| is_same(*value, candidate));
            (candidate, same.count())
        })
        .max_by_key(|(_, count)| *count)
        .filter(|(_, count)| count * 2 > values.len())
        .map(|(candidate, _)| candidate)
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
                    *value = Some("present".to_owned());
                }
            };
            present(&mut difference.here);
            present(&mut difference.usual);
        }
    }
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
            .map(|(name, all)| (name.as_str(), all.iter().map(ToString::to_string).collect()))
            .collect()
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
