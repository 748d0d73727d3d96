//! The topics or nodes of one name in an answer that the history keeps.

use std::borrow::Cow;
use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::value::{RawValue, to_raw_value};

use super::super::problem::{Code, Problem};
use super::super::scope::Domain;
use ros2probe_api::history::KeptNoun;
use ros2probe_wire::DomainId;

/// Selects the elements of one name from a list of topics or nodes.
#[derive(Debug)]
pub(super) struct Named {
    /// Member of the answer that has the list.
    list: &'static str,
    /// `None` selects all names.
    name: Option<String>,
    domain: Domain,
}

/// The part of an element that is compared.
#[derive(Deserialize)]
struct Head<'a> {
    domain_id: u32,
    #[serde(borrow)]
    name: Cow<'a, str>,
    /// Only topics have it.
    #[serde(borrow, default)]
    dds_name: Option<Cow<'a, str>>,
}

impl Named {
    /// Returns the selection of a question; `None` if the whole answer is wanted.
    ///
    /// # Errors
    /// Fails if the noun has no list of topics or nodes, or if the domain id is invalid.
    pub(super) fn of(
        noun: KeptNoun,
        name: Option<String>,
        domain_id: Option<u32>,
    ) -> Result<Option<Self>, Problem> {
        if name.is_none() && domain_id.is_none() {
            return Ok(None);
        }
        let invalid = |detail| Problem::new(Code::InvalidRequest, detail);
        if !matches!(noun, KeptNoun::Topics | KeptNoun::Nodes) {
            return Err(invalid(
                "`name` and `domain_id` select topics and nodes alone",
            ));
        }
        let domain = Domain::of(domain_id).checked()?;
        let list = noun.label();
        Ok(Some(Self { list, name, domain }))
    }

    /// Returns the answer without other elements; `None` if it is no such list.
    pub(super) fn part_of(&self, answer: &[u8]) -> Option<Vec<u8>> {
        let mut members: BTreeMap<&str, &RawValue> = serde_json::from_slice(answer).ok()?;
        let list = members.get_mut(self.list)?;
        // The elements stay as they were written, by this version of the agent or by another.
        let mut elements: Vec<&RawValue> = serde_json::from_str(list.get()).ok()?;
        elements.retain(|element| self.selects(element));
        let selected = to_raw_value(&elements).ok()?;
        *list = &selected;
        serde_json::to_vec(&members).ok()
    }

    fn selects(&self, element: &RawValue) -> bool {
        let Ok(head) = serde_json::from_str::<Head<'_>>(element.get()) else {
            return false;
        };
        let name = Some(&*head.name);
        let dds_name = head.dds_name.as_deref();
        let is_called = |wanted: &str| {
            let whole = [name, dds_name].contains(&Some(wanted));
            let short = head.name.strip_prefix('/') == Some(wanted);
            // Clients may begin each name with a slash.
            whole
                || short
                || wanted
                    .strip_prefix('/')
                    .is_some_and(|rest| dds_name == Some(rest))
        };
        self.domain.admits(DomainId(head.domain_id)) && self.name.as_deref().is_none_or(is_called)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the whole elements that a question selects.
    fn selected(
        noun: KeptNoun,
        name: Option<&str>,
        domain_id: Option<u32>,
        answer: &str,
    ) -> Vec<u32> {
        let named = Named::of(noun, name.map(str::to_owned), domain_id).unwrap();
        let part = named.unwrap().part_of(answer.as_bytes()).unwrap();
        let part: serde_json::Value = serde_json::from_slice(&part).unwrap();
        assert_eq!(part["timestamp_seconds"], 7.5);
        let elements = part[noun.label()].as_array().unwrap().iter();
        let mark = |element: &serde_json::Value| element["new"]["mark"].as_u64().unwrap();
        elements.map(|element| mark(element) as u32).collect()
    }

    #[test]
    fn elements_of_one_name_stay_whole_and_all_others_are_left_out() {
        let topics = r#"{"timestamp_seconds":7.5,"topics":[
            {"domain_id":0,"name":"/imu","dds_name":"rt/imu","new":{"mark":1}},
            {"domain_id":1,"name":"/imu","dds_name":"rt/imu","new":{"mark":2}},
            {"domain_id":0,"name":"/imu/raw","dds_name":"rt/imu/raw","new":{"mark":3}},
            {"domain_id":0,"name":"a\"b","dds_name":"a\"b","new":{"mark":4}}]}"#;
        let all = selected(KeptNoun::Topics, None, Some(0), topics);
        assert_eq!(all, [1, 3, 4]);
        let of = |name, domain_id| selected(KeptNoun::Topics, Some(name), domain_id, topics);
        assert_eq!(of("/imu", None), [1, 2]);
        assert_eq!(of("imu", Some(1)), [2]);
        assert_eq!(of("rt/imu/raw", None), [3]);
        assert_eq!(of("/rt/imu/raw", None), [3]);
        assert_eq!(of("a\"b", None), [4]);
        assert_eq!(of("/other", None), [0; 0]);
        let nodes = r#"{"nodes":[{"domain_id":0,"name":"/robot/lidar","new":{"mark":5}},
            {"domain_id":0,"name":"","new":{"mark":6}}],"timestamp_seconds":7.5}"#;
        let lidar = selected(KeptNoun::Nodes, Some("robot/lidar"), None, nodes);
        assert_eq!(lidar, [5]);
        assert_eq!(selected(KeptNoun::Nodes, Some(""), None, nodes), [6]);
    }

    #[test]
    fn only_topics_and_nodes_have_a_name() {
        let of = |noun, name: Option<&str>, domain_id| {
            let named = Named::of(noun, name.map(str::to_owned), domain_id);
            named.map(|named| named.is_some())
        };
        assert!(!of(KeptNoun::Logs, None, None).unwrap());
        assert!(of(KeptNoun::Nodes, Some("/a"), Some(232)).unwrap());
        for (noun, name, domain_id) in [
            (KeptNoun::Logs, Some("/a"), None),
            (KeptNoun::Graph, None, Some(0)),
            (KeptNoun::Topics, Some("/a"), Some(233)),
        ] {
            of(noun, name, domain_id).unwrap_err();
        }
    }
}
