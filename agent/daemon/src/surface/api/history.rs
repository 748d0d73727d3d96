//! `/topics/{topic}/history`: measurements of the last seconds as columns.

use axum::Json;
use axum::response::{IntoResponse, Response};

use super::Context;
use super::past::TopicRange;
use super::problem::ProblemBody;
use super::scope::Domain;
use super::topics::{TopicParameter, find};
use crate::surface::api::problem::Problem;
use ros2probe_api::topics::History;

/// The last minutes of a topic
///
/// Without `from`, `to` and `step`, the answer covers as many seconds as `page.history_s`, the
/// oldest first. With one of them it covers these times in the history on disk, also of a topic
/// that no longer exists. A topic has a history while it is measured. A path such as
/// `/topics/camera/history` means the topic `/camera/history` if that topic exists. With encoded
/// slashes (`/topics/%2Fcamera%2Fimage/history`), the path is unambiguous.
#[utoipa::path(
    get,
    path = "/topics/{topic}/history",
    tag = "graph",
    params(TopicParameter, TopicRange),
    responses(
        (status = 200, description = "The last minutes of the topic.", body = History),
        (status = 404, description = "The topic does not exist.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "The name exists in several domains; add `domain_id`.",
            body = ProblemBody, content_type = "application/problem+json"),
        (status = 422, description = "A time or the step is invalid.",
            body = ProblemBody, content_type = "application/problem+json"),
    )
)]
pub(super) async fn show(
    context: &Context,
    name: &str,
    domain: Domain,
) -> Result<Response, Problem> {
    let state = context.state().await;
    let topic = find(state.known(), name, domain.checked()?)?;
    let past = context.latest.past();
    let mut view = History {
        topic: topic.name.to_string(),
        domain_id: topic.domain_id.0,
        interval_seconds: 1,
        timestamp_seconds: state.known().time().seconds(),
        ..History::default()
    };
    let seconds = past.topic(topic.domain_id, &topic.dds_name);
    for (at, reading) in seconds.into_iter().flatten() {
        let row = reading.as_ref().map(|reading| &reading.row);
        // Seconds before the topic's first row are omitted.
        if row.is_none() && view.times.is_empty() {
            continue;
        }
        let part = |pair: Option<[f32; 2]>, place: usize| {
            pair.and_then(|pair| pair.get(place).copied())
                .map(stored_precision)
        };
        let latency = row.and_then(|row| row.latency());
        let interarrival = row.and_then(|row| row.interarrival());
        view.times.push(at.seconds());
        view.messages.push(row.map(|row| row.messages));
        view.lost_messages.push(row.map(|row| row.lost));
        let rate = reading.as_ref().and_then(|reading| reading.rate_hz);
        let rate = rate.filter(|rate| *rate > 0.0 || topic.rate_hz().is_some());
        view.rate_hertz.push(rate.map(thousandths));
        let bandwidth = reading.as_ref().and_then(|reading| reading.bandwidth);
        let bandwidth = bandwidth.filter(|bytes| *bytes > 0.0 || topic.bandwidth().is_some());
        view.bandwidth_bytes_per_second
            .push(bandwidth.map(f64::round));
        view.latency_p50_seconds.push(part(latency, 0));
        view.latency_p99_seconds.push(part(latency, 1));
        view.interarrival_p50_seconds.push(part(interarrival, 0));
        view.interarrival_p99_seconds.push(part(interarrival, 1));
    }
    Ok(Json(view).into_response())
}

/// Rounds to the precision of a stored percentile.
pub(super) fn stored_precision(value: f32) -> f64 {
    let value = f64::from(value);
    if value <= 0.0 || !value.is_finite() {
        return 0.0;
    }
    #[expect(
        clippy::cast_possible_truncation,
        reason = "an exponent of a finite number"
    )]
    let digits = 2 - value.log10().floor() as i32;
    let scale = 10_f64.powi(digits.clamp(0, 12));
    (value * scale).round() / scale
}

/// Rounds to three decimal places.
pub(super) fn thousandths(value: f64) -> f64 {
    (value * 1e3).round() / 1e3
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_rounded_to_their_significant_digits() {
        assert_eq!(stored_precision(0.001_234_567), 0.001_23);
        assert_eq!(stored_precision(12.345_678), 12.3);
        assert_eq!(stored_precision(1234.5), 1235.0);
        assert_eq!(
            (
                stored_precision(0.0),
                stored_precision(-1.0),
                stored_precision(f32::NAN)
            ),
            (0.0, 0.0, 0.0)
        );
        assert_eq!(thousandths(9.987_654), 9.988);
    }
}
