//! Inline SVG: a chart of a rate over the run, and the graph of nodes and topics. Colours are those
//! of the text around it, so light and dark need no second picture.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use quick_xml::escape::escape;

use super::observation::Observation;
use super::series::Series;
use crate::top::text;

/// Maximum number of topics in the drawn graph.
const MAX_DRAWN: usize = 60;
/// Topics of every node, which the drawing leaves out as rqt_graph does.
const COMMON_TOPICS: [&str; 2] = ["/rosout", "/parameter_events"];
/// Maximum number of characters of a name in the drawing.
const NAME_CHARACTERS: usize = 34;
const CHART_WIDTH: f64 = 160.0;
const CHART_HEIGHT: f64 = 28.0;
const ROW_HEIGHT: f64 = 22.0;
const COLUMN_WIDTH: f64 = 260.0;
const COLUMN_GAP: f64 = 70.0;

/// Draws the rate of a topic over a run of `seconds`. Lines mark the judged part.
pub(super) fn chart(series: &Series, seconds: f64, judged: (f64, f64)) -> String {
    let highest = series.rates().map(|(_, rate)| rate).fold(0.0, f32::max);
    let highest = f64::from(highest);
    // The last state is that after the end.
    let x = |time: f64| (time / seconds.max(1.0) * CHART_WIDTH).min(CHART_WIDTH);
    let y = |rate: f64| {
        CHART_HEIGHT - 1.0 - rate / highest.max(f64::MIN_POSITIVE) * (CHART_HEIGHT - 4.0)
    };
    let mut path = String::new();
    let mut is_down = false;
    for (time, rate) in series.rates() {
        if rate.is_nan() {
            is_down = false;
            continue;
        }
        let command = if is_down { 'L' } else { 'M' };
        is_down = true;
        let _ = write!(path, "{command}{:.1} {:.1}", x(time), y(f64::from(rate)));
    }
    let mark = |time: f64| {
        let x = x(time);
        format!(
            "<path d=\"M{x:.1} 0V{CHART_HEIGHT}\" stroke=\"currentColor\" opacity=\".25\" \
             stroke-dasharray=\"2 2\"/>"
        )
    };
    format!(
        "<svg viewBox=\"0 0 {CHART_WIDTH} {CHART_HEIGHT}\" width=\"{CHART_WIDTH}\" \
         height=\"{CHART_HEIGHT}\" role=\"img\" aria-label=\"rate up to {highest:.1} Hz\">{}{}\
         <path d=\"{path}\" fill=\"none\" stroke=\"currentColor\" stroke-width=\"1.5\"/></svg>",
        mark(judged.0),
        mark(judged.1)
    )
}

/// Draws the graph: publishing nodes, topics, subscribing nodes. Topics in `marked` are drawn
/// first, and as failed. Returns the drawing and the number of topics that it leaves out.
pub(super) fn graph(seen: &Observation, marked: &BTreeSet<&str>) -> (String, usize) {
    let mut topics: Vec<&str> = seen
        .topics
        .iter()
        .filter(|(name, topic)| !topic.is_hidden && !COMMON_TOPICS.contains(&&***name))
        .map(|(name, _)| &**name)
        .collect();
    topics.sort_by_key(|name| !marked.contains(name));
    let left_out = topics.len().saturating_sub(MAX_DRAWN);
    topics.truncate(MAX_DRAWN);
    topics.sort_unstable();
    let drawn: BTreeSet<&str> = topics.iter().copied().collect();
    let edges = seen
        .edges
        .iter()
        .filter(|edge| drawn.contains(&*edge.topic));
    let edges: Vec<_> = edges.collect();
    let nodes = |is_publisher: bool| {
        let nodes = edges.iter().filter(|it| it.is_publisher == is_publisher);
        let nodes: BTreeSet<&str> = nodes.map(|it| &*it.node).collect();
        nodes.into_iter().collect::<Vec<_>>()
    };
    let columns = [nodes(true), topics, nodes(false)];
    let rows = columns.iter().map(Vec::len).max().unwrap_or_default();
    let height = to_f64(rows) * ROW_HEIGHT;
    let width = 3.0 * COLUMN_WIDTH + 2.0 * COLUMN_GAP;
    let mut boxes = String::new();
    let mut places = [BTreeMap::new(), BTreeMap::new(), BTreeMap::new()];
    for (column, (names, places)) in columns.iter().zip(&mut places).enumerate() {
        let x = to_f64(column) * (COLUMN_WIDTH + COLUMN_GAP);
        let top = (height - to_f64(names.len()) * ROW_HEIGHT) / 2.0;
        for (row, name) in names.iter().enumerate() {
            let y = top + to_f64(row) * ROW_HEIGHT;
            places.insert(*name, y + ROW_HEIGHT / 2.0);
            let round = if column == 1 { 2 } else { 9 };
            let class = if column == 1 && marked.contains(name) {
                "bad"
            } else {
                "box"
            };
            let _ = write!(
                boxes,
                "<g class=\"{class}\"><title>{0}</title><rect x=\"{x}\" y=\"{1}\" width=\"{COLUMN_WIDTH}\" \
                 height=\"{2}\" rx=\"{round}\" fill=\"none\" stroke=\"currentColor\"/><text x=\"{3}\" \
                 y=\"{4}\" font-size=\"11\" fill=\"currentColor\">{5}</text></g>",
                escape(*name),
                y + 2.0,
                ROW_HEIGHT - 4.0,
                x + 8.0,
                y + ROW_HEIGHT / 2.0 + 4.0,
                escape(&*text::end(name, NAME_CHARACTERS, '…'))
            );
        }
    }
    let [publishers, topics, subscribers] = &places;
    let mut lines = String::new();
    for edge in edges {
        let topic = topics.get(&*edge.topic);
        let (ends, from) = match edge.is_publisher {
            true => (publishers.get(&*edge.node).zip(topic), COLUMN_WIDTH),
            false => (
                topic.zip(subscribers.get(&*edge.node)),
                2.0 * COLUMN_WIDTH + COLUMN_GAP,
            ),
        };
        let Some((begin, end)) = ends else { continue };
        let (middle, to) = (from + COLUMN_GAP / 2.0, from + COLUMN_GAP);
        let _ = write!(
            lines,
            "<path d=\"M{from} {begin}C{middle} {begin} {middle} {end} {to} {end}\"/>"
        );
    }
    let svg = format!(
        "<svg viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" role=\"img\" \
         aria-label=\"graph of nodes and topics\"><g fill=\"none\" stroke=\"currentColor\" \
         opacity=\".4\">{lines}</g>{boxes}</svg>"
    );
    (svg, left_out)
}

#[expect(
    clippy::cast_precision_loss,
    reason = "counts of drawn things are small"
)]
const fn to_f64(count: usize) -> f64 {
    count as f64
}

#[cfg(test)]
mod tests {
    use super::super::observation::tests::{RULES, graph as graph_of};
    use super::*;

    #[test]
    fn topics_beyond_the_cap_are_not_drawn_but_failed_ones_are() {
        let names: Vec<&'static str> = (0..MAX_DRAWN + 5)
            .map(|index| -> &'static str { format!("/t{index:03}").leak() })
            .collect();
        let mut seen = Observation::new(RULES, 0);
        seen.line(graph_of(1, &names), 0.0);
        let last = names.last().unwrap();
        let (svg, left_out) = graph(&seen, &[*last].into());
        assert_eq!(left_out, 5);
        assert_eq!(svg.matches("<rect").count(), MAX_DRAWN + 1);
        assert!(
            svg.contains(&format!("class=\"bad\"><title>{last}<")),
            "{svg}"
        );
    }

    #[test]
    fn names_are_escaped_and_shortened() {
        let mut seen = Observation::new(RULES, 0);
        seen.line(
            graph_of(
                1,
                &[
                    "/<script>&\"",
                    "/a/long/namespace/with/many/parts/and/a/name",
                ],
            ),
            0.0,
        );
        let (svg, _) = graph(&seen, &BTreeSet::new());
        assert!(!svg.contains("<script>"), "{svg}");
        assert!(svg.contains("/&lt;script&gt;&amp;&quot;"), "{svg}");
        assert!(
            svg.contains(">…espace/with/many/parts/and/a/name<"),
            "{svg}"
        );
    }
}
