//! `/chains`: the path of measurements through nodes.

use std::borrow::Cow;

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use ros2probe_api::chains::{Chain, ChainList, ExpectedChain, Hop, Quantiles};
use ros2probe_model::derive::chain::expected::ExpectedFacts;
use ros2probe_model::derive::chain::path;
use ros2probe_model::report::snapshot::{ChainFacts, Snapshot};
use ros2probe_wire::DomainId;
use serde::Deserialize;
use utoipa::IntoParams;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::parameters::Parameters;
use super::problem::{Code, Problem};
use super::scope::domain;

/// Query parameters that select the chains of an answer.
#[derive(Clone, Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
struct Ends {
    /// Domain id; by default every domain.
    #[param(minimum = 0, maximum = 232)]
    domain_id: Option<u32>,
    /// ROS name of the topic at which chains begin. Chains without the topic are left out.
    from: Option<String>,
    /// ROS name of the topic at which chains end. Chains without the topic are left out.
    to: Option<String>,
    /// Whether the client needs calls inside processes, which show how a callback uses its
    /// messages. With `capture.inside: auto`, calls are observed until ten seconds after the last
    /// such request.
    calls: Option<bool>,
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(list))
}

/// Chains of messages with the time of each hop
#[utoipa::path(
    get,
    path = "/chains",
    tag = "graph",
    params(Ends),
    responses((status = 200, description = "Chains.", body = ChainList<'static>))
)]
async fn list(
    State(context): State<Context>,
    Parameters(ends): Parameters<Ends>,
) -> Result<Response, Problem> {
    let only = domain(ends.domain_id, Code::MalformedRequest)?;
    if ends.calls == Some(true) {
        context.latest.request_calls();
    }
    let state = context.state().await;
    Ok(Json(answer(state.known(), only, &ends)).into_response())
}

/// Returns the answer with all chains.
pub(super) fn all(snapshot: &Snapshot) -> ChainList<'_> {
    answer(snapshot, None, &Ends::default())
}

fn answer<'a>(snapshot: &'a Snapshot, only: Option<DomainId>, ends: &Ends) -> ChainList<'a> {
    let is_meant = |domain_id: DomainId| only.is_none_or(|only| only == domain_id);
    let meant = snapshot.chains.chains.iter();
    let meant = meant.filter(|facts| is_meant(facts.path.domain_id));
    let chains = parts(meant, ends.from.as_deref(), ends.to.as_deref());
    let named = |end: &Option<String>, name: &str| end.as_deref().is_none_or(|end| end == name);
    let configured = snapshot.chains.expected.iter().filter(|each| {
        each.domain_id.is_none_or(is_meant)
            && named(&ends.from, &each.chain.from)
            && named(&ends.to, &each.chain.to)
    });
    ChainList {
        timestamp_seconds: snapshot.time().seconds(),
        chains,
        expected: configured.map(expected).collect(),
    }
}

/// Returns the API representation of chains, cut at the topics with the ROS names `from` and `to`.
/// Omits chains that do not contain both topics. If several parts are equal, keeps the one with the
/// most messages. `None` means no cut.
#[must_use]
pub fn parts<'a>(
    facts: impl Iterator<Item = &'a ChainFacts>,
    from: Option<&str>,
    to: Option<&str>,
) -> Vec<Chain<'a>> {
    let mut chains: Vec<Chain<'a>> = Vec::new();
    for facts in facts {
        let part = section(facts, from, to);
        let Some(chain) = part.and_then(|part| chain(facts, part)) else {
            continue;
        };
        // Chains that differ only outside of the ends have the same part.
        let is_same = |known: &&mut Chain<'_>| is_same(known, &chain);
        match chains.iter_mut().find(is_same) {
            Some(known) if known.messages >= chain.messages => {}
            Some(known) => *known = chain,
            None => chains.push(chain),
        }
    }
    chains
}

/// Returns whether both chains take the same path.
fn is_same(one: &Chain<'_>, other: &Chain<'_>) -> bool {
    let mut hops = one.hops.iter().zip(&other.hops);
    (one.domain_id, &one.method, &one.from) == (other.domain_id, &other.method, &other.from)
        && one.hops.len() == other.hops.len()
        && hops.all(|(one, other)| (&one.node, &one.output) == (&other.node, &other.output))
}

/// Returns the positions of the first and last topic of the part between the ends.
fn section(facts: &ChainFacts, from: Option<&str>, to: Option<&str>) -> Option<(usize, usize)> {
    let topics = &facts.path.topics;
    let (first, _) = topics.first()?;
    let (last, _) = topics.last()?;
    facts
        .path
        .section(from.unwrap_or(first), to.unwrap_or(last))
}

fn chain(facts: &ChainFacts, (from, to): (usize, usize)) -> Option<Chain<'_>> {
    let topics = facts.path.topics.get(from..=to)?;
    let [(first, source), .., (last, _)] = topics else {
        return None;
    };
    let pairs = topics.windows(2).enumerate();
    let hops = pairs.filter_map(|(offset, ends)| hop(facts, from + offset, ends));
    let hops: Vec<Hop<'_>> = hops.collect();
    let slowest = hops.iter().enumerate().max_by(|(_, one), (_, other)| {
        let median = |hop: &Hop<'_>| hop.latency.p50_seconds;
        median(one).total_cmp(&median(other))
    });
    Some(Chain {
        domain_id: facts.path.domain_id.0,
        method: facts.path.method.label().into(),
        from: Cow::Borrowed(first),
        to: Cow::Borrowed(last),
        source: source.as_deref().map(Cow::Borrowed),
        bottleneck: slowest.map(|(place, _)| place as u64),
        messages: facts.count,
        latency: quantiles(facts.between(from, to)),
        last_seen_seconds: facts.last.seconds(),
        hops,
    })
}

type Topic = (
    ros2probe_model::facts::names::TopicName,
    Option<ros2probe_model::facts::names::NodeName>,
);

fn hop<'a>(facts: &ChainFacts, position: usize, ends: &'a [Topic]) -> Option<Hop<'a>> {
    let [(input, _), (output, node)] = ends else {
        return None;
    };
    let figures = facts.hop(position);
    Some(Hop {
        input: Cow::Borrowed(input),
        node: node.as_deref().map(Cow::Borrowed),
        output: Cow::Borrowed(output),
        latency: quantiles(figures.whole),
        transit: figures.transit.map(quantiles),
        wait: figures.wait.map(quantiles),
        callback: figures.callback.map(quantiles),
        processing: figures.node.map(quantiles),
    })
}

fn expected(facts: &ExpectedFacts) -> ExpectedChain<'_> {
    let max_latency = facts.chain.max_latency;
    ExpectedChain {
        domain_id: facts.domain_id.map(|domain_id| domain_id.0),
        from: Cow::Borrowed(&facts.chain.from),
        to: Cow::Borrowed(&facts.chain.to),
        max_latency_ms: max_latency.map(|max| max.as_secs_f64() * 1e3),
        method: facts.method.map(|method| method.label().into()),
        state: facts.state.label().into(),
        latency: facts.latency.map(quantiles),
    }
}

const fn quantiles(figures: path::Quantiles) -> Quantiles {
    Quantiles {
        p50_seconds: figures.p50,
        p99_seconds: figures.p99,
        maximum_seconds: figures.max,
    }
}
