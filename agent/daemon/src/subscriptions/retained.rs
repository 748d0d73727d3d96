//! Requests for topics whose watch has `retain: last`. All messages of these topics are captured,
//! as for a client, so that the model has the last one, whatever its size.

use std::sync::Arc;

use crate::config::{Retain, Watch};
use ros2probe_model::facts::selection::{Depth, SampleRequest, Selection};

/// First id of the requests of watches; lower ids belong to readers.
const FIRST_REQUEST_ID: u64 = 1 << 63;

/// Returns the requests of these watches.
pub(super) fn sample_requests(watches: &[Arc<Watch>]) -> Vec<SampleRequest> {
    let asking = watches.iter().filter(|watch| watch.retain == Retain::Last);
    let sample_requests = asking.zip(FIRST_REQUEST_ID..).filter_map(|(watch, id)| {
        Some(SampleRequest {
            id,
            // The configuration's check has accepted the pattern.
            selection: Arc::new(Selection::named([watch.pattern.as_str()]).ok()?),
            domain_id: watch.domain_id,
            depth: Depth::Payloads,
        })
    });
    sample_requests.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_watch_with_retain_last_requests_all_of_its_topics() {
        let asking = Watch {
            retain: Retain::Last,
            ..Watch::named("/maps/**").unwrap()
        };
        let watches = [Watch::named("/other").unwrap(), asking].map(Arc::new);
        let [request] = &sample_requests(&watches)[..] else {
            panic!("one watch asks")
        };
        assert_eq!(
            (request.id, request.depth),
            (FIRST_REQUEST_ID, Depth::Payloads)
        );
        assert!(request.selection.globs().eq(["/maps/**"]));
    }
}
