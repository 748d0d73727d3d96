//! Incidents of a fleet: bags of snapshots that `rp ship` delivered, from their manifests.
//!
//! A manifest does not change, so each is read once. Only what views show is kept of it.

use std::collections::BTreeMap;

use jiff::Timestamp;
use ros2probe_api::fleet::{Incident, Incidents};
use ros2probe_model::facts::bounded::{Bounded, Declared as _};
use ros2probe_ship::{
    Archive, ArchiveError, Listing, Manifest, SettingsError, StoreSettings, StoredBag,
};
use serde_json::Value;

use crate::tables::FleetManifests;

/// Maximum number of manifests.
const MAX_MANIFESTS: usize = FleetManifests::TABLE.entries;

/// Maximum number of manifests of a robot among those of a fleet.
const MAX_OF_ROBOT: usize = 20;
/// Maximum number of kinds of findings of an incident.
const MAX_KINDS: usize = 16;
/// Maximum length of a name from a manifest, in bytes.
const NAME_BYTES: usize = 128;
/// Number of manifests that are read before they are shown.
const STEP: usize = 20;

/// Reads the incidents at a destination.
#[derive(Debug)]
pub struct IncidentReader {
    archive: Archive,
    known: Bounded<FleetManifests, BTreeMap<Key, Known>>,
}

/// Names of the directories of robot and bag.
type Key = (String, String);

/// What is known of a delivered bag.
#[derive(Debug)]
struct Known {
    delivered: Timestamp,
    /// `None` for a recording without a trigger, and for a damaged manifest.
    incident: Option<Incident>,
}

impl IncidentReader {
    /// Creates a reader of a store, without a request.
    ///
    /// # Errors
    ///
    /// Fails if the settings name no store.
    pub fn new(settings: StoreSettings) -> Result<Self, SettingsError> {
        Ok(Self {
            archive: Archive::new(settings)?,
            known: Bounded::default(),
        })
    }

    /// Reads the latest incidents of a robot, or of all robots, and shows them again and again while
    /// more are read.
    ///
    /// # Errors
    ///
    /// Fails if the store cannot be read.
    pub async fn read(
        &mut self,
        robot: Option<&str>,
        show: impl Fn(Incidents),
    ) -> Result<(), ArchiveError> {
        let mut listing = self.archive.bags(robot).await?;
        let listed = listing.bags.len();
        select(
            &mut listing.bags,
            robot.map_or(MAX_OF_ROBOT, |_| usize::MAX),
        );
        let delivered: BTreeMap<_, _> = listing
            .bags
            .iter()
            .map(|bag| (key(bag), bag.delivered))
            .collect();
        self.known
            .retain(|key, known| delivered.get(key) == Some(&known.delivered));
        let is_new = |bag: &&StoredBag| !self.known.contains_key(&key(bag));
        let new: Vec<_> = listing.bags.iter().filter(is_new).cloned().collect();
        for step in new.chunks(STEP) {
            for bag in step {
                let manifest = self.archive.manifest(bag).await?;
                let known = Known {
                    delivered: bag.delivered,
                    incident: manifest.and_then(|manifest| incident(&bag.name, &manifest)),
                };
                self.known.add((key(bag), known));
            }
            show(self.incidents(&listing, listed));
        }
        if new.is_empty() {
            show(self.incidents(&listing, listed));
        }
        Ok(())
    }

    /// Returns the incidents that are known.
    #[expect(
        clippy::cast_precision_loss,
        reason = "milliseconds are exact for ages"
    )]
    fn incidents(&self, listing: &Listing, listed: usize) -> Incidents {
        let mut known: Vec<_> = self.known.values().collect();
        known.sort_by_key(|known| std::cmp::Reverse(known.delivered));
        let bags = known.into_iter().filter_map(|known| known.incident.clone());
        Incidents {
            at: Some(Timestamp::now().as_millisecond() as f64 / 1_000.0),
            problem: None,
            bags: bags.collect(),
            unread: listed.saturating_sub(self.known.len()) as u64,
            unfinished: listing.unfinished,
            is_cut: listing.is_cut,
        }
    }
}

fn key(bag: &StoredBag) -> Key {
    (bag.robot.clone(), bag.name.clone())
}

/// Keeps the latest bags, of each robot at most `most`, the latest first.
fn select(bags: &mut Vec<StoredBag>, most: usize) {
    bags.sort_by(|one, two| {
        two.delivered
            .cmp(&one.delivered)
            .then_with(|| key(one).cmp(&key(two)))
    });
    let mut counts = BTreeMap::<String, usize>::new();
    bags.retain(|bag| {
        let count = counts.entry(bag.robot.clone()).or_default();
        *count += 1;
        *count <= most
    });
    bags.truncate(MAX_MANIFESTS);
}

/// Returns what views show of a manifest; `None` without a trigger.
fn incident(directory: &str, manifest: &Manifest) -> Option<Incident> {
    let trigger = manifest.trigger.as_ref()?;
    let text = |value: &Value, key: &str| Some(name(value.get(key)?.as_str()?));
    let topic = trigger.get("attributes");
    let time = |time: &Option<String>| {
        time.as_ref()
            .filter(|time| time.parse::<Timestamp>().is_ok())
            .cloned()
    };
    Some(Incident {
        robot: name(&manifest.robot),
        bag: name(directory),
        snapshot: text(trigger, "snapshot").unwrap_or_default(),
        trigger: text(trigger, "trigger").unwrap_or_default(),
        event: text(trigger, "event"),
        topic: topic.and_then(|attributes| text(attributes, "topic")),
        start: time(&manifest.start),
        end: time(&manifest.end),
        findings: manifest.findings.as_deref().map(findings),
        messages: manifest.messages,
        bytes: manifest
            .files
            .iter()
            .fold(0, |sum, file| sum.saturating_add(file.bytes)),
        is_complete: manifest.is_complete,
    })
}

/// Returns the numbers of findings by the names of their events.
fn findings(all: &[Value]) -> BTreeMap<String, u64> {
    let mut counts = BTreeMap::new();
    for finding in all {
        let event = finding.get("name").and_then(Value::as_str);
        let event = name(event.unwrap_or("unnamed"));
        if counts.len() < MAX_KINDS || counts.contains_key(&event) {
            *counts.entry(event).or_insert(0) += 1;
        }
    }
    counts
}

/// Returns a name up to the maximum length.
fn name(text: &str) -> String {
    let end = text.floor_char_boundary(NAME_BYTES);
    text.split_at(end).0.to_owned()
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::sync::Mutex;
    use std::time::{Duration, SystemTime};

    use serde_json::json;

    use super::*;
    use crate::tables::tests::assert_driven;

    fn manifest(change: impl FnOnce(&mut Value)) -> Value {
        let mut manifest = json!({
            "version": 1, "robot": "robot-7", "bag": "a", "is_complete": true,
            "trigger": {"snapshot": "incident", "trigger": "message_lost",
                "event": "ros2.message.lost", "attributes": {"topic": "/scan"}},
            "findings": [{"name": "ros2.message.lost"}, {"name": "ros2.message.lost"}, {}],
            "start": "2026-11-20T02:34:00Z", "end": "<script>", "messages": 3, "topics": [],
            "files": [{"name": "a_0.mcap", "bytes": 3, "sha256": ""},
                {"name": "metadata.yaml", "bytes": u64::MAX, "sha256": ""}],
            "program": "ros2probe",
        });
        change(&mut manifest);
        manifest
    }

    fn shown(change: impl FnOnce(&mut Value)) -> Option<Incident> {
        let manifest = serde_json::from_value(manifest(change)).unwrap();
        incident("a-2", &manifest)
    }

    #[test]
    fn an_incident_has_its_trigger_times_findings_and_size() {
        let found = shown(|_| {}).unwrap();
        let findings = [("ros2.message.lost", 2), ("unnamed", 1)];
        let findings = findings.map(|(name, count)| (name.to_owned(), count));
        assert_eq!(found.findings, Some(findings.into()));
        assert_eq!((&*found.bag, &*found.trigger), ("a-2", "message_lost"));
        assert_eq!(found.topic.as_deref(), Some("/scan"));
        assert_eq!(found.start.as_deref(), Some("2026-11-20T02:34:00Z"));
        assert_eq!((found.end, found.bytes), (None, u64::MAX));
        assert_eq!(shown(|it| it["trigger"] = Value::Null), None);
        assert_eq!(
            shown(|it| it["findings"] = Value::Null).unwrap().findings,
            None
        );
    }

    #[test]
    fn names_and_kinds_of_a_manifest_are_bounded() {
        let long = "ä".repeat(NAME_BYTES);
        let kinds = (0..=MAX_KINDS).map(|number| json!({"name": format!("kind {number}")}));
        let kinds: Vec<_> = kinds.collect();
        let found = shown(|it| {
            it["robot"] = long.clone().into();
            it["findings"] = kinds.into();
        });
        let found = found.unwrap();
        assert_eq!(found.robot.len(), NAME_BYTES);
        assert_eq!(found.findings.unwrap().len(), MAX_KINDS);
    }

    #[tokio::test]
    async fn manifests_beyond_the_caps_are_those_of_older_bags() {
        let directory = tempfile::tempdir().unwrap();
        let now = SystemTime::now();
        let write = |robot: usize, bag: usize| {
            let bag_directory = directory.path().join(format!("robot-{robot}/{bag}"));
            fs::create_dir_all(&bag_directory).unwrap();
            let path = bag_directory.join("manifest.json");
            let text = manifest(|it| it["robot"] = format!("robot-{robot}").into());
            fs::write(&path, text.to_string()).unwrap();
            let file = fs::File::options().write(true).open(path).unwrap();
            let age = Duration::from_secs(100 * bag as u64 + robot as u64);
            file.set_modified(now - age).unwrap();
        };
        let mut reader = IncidentReader::new(StoreSettings {
            url: format!("file://{}", directory.path().display()),
            ..StoreSettings::default()
        })
        .unwrap();
        let last = Mutex::new(Incidents::default());
        let show = |incidents| *last.lock().unwrap() = incidents;
        for bag in 0..=MAX_OF_ROBOT {
            write(1, bag);
        }
        reader.read(None, show).await.unwrap();
        let found = last.lock().unwrap().clone();
        assert_eq!((found.bags.len(), found.unread), (MAX_OF_ROBOT, 1));
        assert_eq!(found.bags[0].bag, "0", "the latest first");
        reader.read(Some("robot-1"), show).await.unwrap();
        assert_eq!(last.lock().unwrap().bags.len(), MAX_OF_ROBOT + 1);
        let robots = MAX_MANIFESTS / MAX_OF_ROBOT + 1;
        for robot in 1..=robots {
            (0..MAX_OF_ROBOT).for_each(|bag| write(robot, bag));
        }
        reader.read(None, show).await.unwrap();
        let found = last.lock().unwrap().clone();
        assert_eq!(found.bags.len(), MAX_MANIFESTS);
        assert_eq!(found.unread as usize, 1 + MAX_OF_ROBOT);
        assert_driven::<FleetManifests>();
    }
}
