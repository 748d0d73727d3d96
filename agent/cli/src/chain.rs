//! Text of `rp chain`: each chain with a line for each hop. [`bag`] finds the chains of a bag.

pub mod bag;

use std::fmt::Write as _;

use ros2probe_api::chains::{Chain, ChainList, ExpectedChain, Quantiles};

/// Returns the chains as text; empty without any.
#[must_use]
pub fn text(list: &ChainList<'_>) -> String {
    let mut text = String::new();
    for chain in &list.chains {
        if !text.is_empty() {
            text.push('\n');
        }
        write_chain(chain, true, &mut text);
        let is_this = |each: &&ExpectedChain<'_>| {
            (&each.from, &each.to, each.domain_id, each.method.as_deref())
                == (
                    &chain.from,
                    &chain.to,
                    Some(chain.domain_id),
                    Some(&chain.method),
                )
        };
        let expected = list.expected.iter().find(is_this);
        if let Some((limit, state)) =
            expected.and_then(|each| Some((each.max_latency_ms?, &each.state)))
        {
            let _ = writeln!(text, "  limit {limit} ms: {state}");
        }
    }
    text
}

/// Returns the chains of a bag as text, without nodes; empty without any.
#[must_use]
pub fn text_without_nodes(chains: &[Chain<'_>]) -> String {
    let mut text = String::new();
    for chain in chains {
        write_chain(chain, false, &mut text);
        text.push('\n');
    }
    text
}

fn write_chain(chain: &Chain<'_>, with_nodes: bool, text: &mut String) {
    let Chain {
        from,
        to,
        messages,
        method,
        ..
    } = chain;
    let _ = writeln!(text, "{from} to {to}: {messages} messages, by {method}");
    let source = chain.source.as_deref().unwrap_or("unknown node");
    let mut rows = vec![[
        String::new(),
        "p50 ms".to_owned(),
        "p99 ms".to_owned(),
        "max ms".to_owned(),
        String::new(),
    ]];
    let row = |name: String, figures: &Quantiles, note: &str| {
        let milliseconds = |seconds: f64| format!("{:.3}", seconds * 1e3);
        [
            name,
            milliseconds(figures.p50_seconds),
            milliseconds(figures.p99_seconds),
            milliseconds(figures.maximum_seconds),
            note.to_owned(),
        ]
    };
    for (place, hop) in chain.hops.iter().enumerate() {
        let node = hop.node.as_deref().unwrap_or("unknown node");
        let is_slowest = chain.hops.len() > 1 && chain.bottleneck == Some(place as u64);
        let note = if is_slowest { "bottleneck" } else { "" };
        let name = match with_nodes {
            true => format!("{} -> {node} -> {}", hop.input, hop.output),
            false => format!("{} -> {}", hop.input, hop.output),
        };
        rows.push(row(name, &hop.latency, note));
        let parts = [
            ("transit", hop.transit),
            ("wait", hop.wait),
            ("callback", hop.callback),
            // The sum of wait and callback, if they are not known separately.
            ("node", hop.processing.filter(|_| hop.callback.is_none())),
        ];
        for (name, figures) in parts {
            if let Some(figures) = figures {
                rows.push(row(format!("  {name}"), &figures, ""));
            }
        }
    }
    rows.push(row("end to end".to_owned(), &chain.latency, ""));
    let width = |column: usize| {
        let lengths = rows.iter().filter_map(|row| row.get(column));
        lengths.map(|cell| cell.chars().count()).max().unwrap_or(0)
    };
    let widths = [0, 1, 2, 3].map(width);
    if with_nodes {
        let _ = writeln!(text, "  published by {source}");
    }
    for [name, p50, p99, max, note] in &rows {
        let [first, second, third, fourth] = widths;
        let line =
            format!("  {name:first$}  {p50:>second$}  {p99:>third$}  {max:>fourth$}  {note}");
        let _ = writeln!(text, "{}", line.trim_end());
    }
}

#[cfg(test)]
mod tests {
    use ros2probe_api::chains::Hop;

    use super::*;

    #[test]
    fn a_chain_has_a_line_for_each_hop_and_part_and_marks_the_slowest() {
        let times = |milliseconds: f64| Quantiles {
            p50_seconds: milliseconds / 1e3,
            p99_seconds: milliseconds * 2.0 / 1e3,
            maximum_seconds: milliseconds * 3.0 / 1e3,
        };
        let hop = |input: &'static str, node: &'static str, output: &'static str, ms| Hop {
            input: input.into(),
            node: Some(node.into()),
            output: output.into(),
            latency: times(ms),
            ..Hop::default()
        };
        let mut filter = hop("/points", "/filter", "/filtered", 12.5);
        filter.transit = Some(times(0.3));
        filter.processing = Some(times(12.2));
        let list = ChainList {
            chains: vec![Chain {
                method: "stamps".into(),
                from: "/points".into(),
                to: "/cmd".into(),
                source: Some("/lidar".into()),
                hops: vec![filter, hop("/filtered", "/control", "/cmd", 4.0)],
                messages: 100,
                latency: times(16.5),
                bottleneck: Some(0),
                ..Chain::default()
            }],
            expected: vec![ExpectedChain {
                domain_id: Some(0),
                from: "/points".into(),
                to: "/cmd".into(),
                max_latency_ms: Some(15.0),
                method: Some("stamps".into()),
                state: "slow".into(),
                latency: None,
            }],
            ..ChainList::default()
        };
        let expected = "\
/points to /cmd: 100 messages, by stamps
  published by /lidar
                                   p50 ms  p99 ms  max ms
  /points -> /filter -> /filtered  12.500  25.000  37.500  bottleneck
    transit                         0.300   0.600   0.900
    node                           12.200  24.400  36.600
  /filtered -> /control -> /cmd     4.000   8.000  12.000
  end to end                       16.500  33.000  49.500
  limit 15 ms: slow
";
        assert_eq!(text(&list), expected);
        assert_eq!(text(&ChainList::default()), "");
    }
}
