//! Table as text, for the screen and for pipes: selection of columns and format of cells.

use std::collections::BTreeSet;

use super::row::{Column, Row};
use super::text;

/// Minimum width of the name column.
const MIN_NAME_WIDTH: usize = 20;
/// Maximum width of the state column.
const MAX_STATE: usize = 28;

/// Column of the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Field {
    Name,
    Domain,
    Type,
    Rate,
    Wanted,
    Bandwidth,
    Loss,
    Median,
    P99,
    Late,
    Ends,
    State,
}

/// The selected columns with their widths.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Table {
    columns: Vec<(Field, usize)>,
    cut: char,
}

impl Field {
    const ORDER: [Self; 12] = [
        Self::Name,
        Self::Domain,
        Self::Type,
        Self::Rate,
        Self::Wanted,
        Self::Bandwidth,
        Self::Loss,
        Self::Median,
        Self::P99,
        Self::Late,
        Self::Ends,
        Self::State,
    ];

    const fn label(self) -> &'static str {
        match self {
            Self::Name => "TOPIC",
            Self::Domain => "DOM",
            Self::Type => "TYPE",
            Self::Rate => "HZ",
            Self::Wanted => "WANTED",
            Self::Bandwidth => "B/S",
            Self::Loss => "LOSS",
            Self::Median => "MED",
            Self::P99 => "P99",
            Self::Late => "LATE",
            Self::Ends => "P/S",
            Self::State => "STATE",
        }
    }

    /// Returns the minimum width of the column.
    const fn width(self) -> usize {
        match self {
            Self::Name => MIN_NAME_WIDTH,
            Self::Type => 12,
            Self::Wanted => 7,
            Self::Rate | Self::Bandwidth => 6,
            Self::Loss | Self::Median | Self::P99 | Self::Ends => 5,
            Self::Late => 4,
            Self::Domain => 3,
            Self::State => 9,
        }
    }

    fn is_sorted_by(self, column: Column) -> bool {
        match self {
            Self::Name => column == Column::Name,
            Self::Rate => column == Column::Rate,
            Self::Bandwidth => column == Column::Bandwidth,
            Self::Loss => column == Column::Loss,
            Self::P99 => column == Column::Latency,
            Self::Late => column == Column::Late,
            Self::Ends => matches!(column, Column::Publishers | Column::Subscribers),
            Self::State => column == Column::State,
            Self::Domain | Self::Type | Self::Wanted | Self::Median => false,
        }
    }

    fn value(self, row: &Row) -> String {
        let known = |value: Option<f64>, shown: fn(f64) -> String| {
            value.map_or_else(|| "-".to_owned(), shown)
        };
        match self {
            Self::Name => row.name.clone(),
            Self::Domain => row.key.domain_id.to_string(),
            Self::Type => row.message_type.clone(),
            Self::Rate => known(row.rate, text::rate),
            Self::Wanted => match row.expected_rate {
                (None, None) => String::new(),
                (Some(least), None) => format!(">={}", text::bound(least)),
                (None, Some(most)) => format!("<={}", text::bound(most)),
                (Some(least), Some(most)) => {
                    format!("{}-{}", text::bound(least), text::bound(most))
                }
            },
            Self::Bandwidth => known(row.bandwidth, text::bytes),
            Self::Loss => known(row.loss, text::ratio),
            Self::Median => known(row.median, text::seconds),
            Self::P99 => known(row.p99, text::seconds),
            Self::Late => row
                .late
                .map_or_else(|| "-".to_owned(), |late| late.to_string()),
            Self::Ends => format!("{}/{}", row.publishers, row.subscriptions),
            Self::State => row.state(),
        }
    }
}

impl Table {
    /// Selects the columns that fit into `width`, in order of importance.
    #[must_use]
    pub fn plan(width: usize, rows: &[&Row], cut: char) -> Self {
        let domains: BTreeSet<_> = rows.iter().map(|row| row.key.domain_id).collect();
        let is_expected = rows.iter().any(|row| row.expected_rate != (None, None));
        let is_late = rows.iter().any(|row| row.late.is_some());
        let longest = |field: Field| {
            let lengths = rows.iter().map(|row| field.value(row).chars().count());
            lengths.max().unwrap_or(0)
        };
        let mut columns = vec![Field::Name, Field::Rate, Field::State];
        let mut left = width.saturating_sub(MIN_NAME_WIDTH + 6 + 9 + 2);
        let commands = [
            (Field::Domain, domains.len() > 1),
            (Field::Bandwidth, true),
            (Field::Loss, true),
            (Field::P99, true),
            (Field::Late, is_late),
            (Field::Ends, true),
            (Field::Wanted, is_expected),
            (Field::Median, true),
        ];
        for (field, is_wanted) in commands {
            if is_wanted && left > field.width() {
                left -= field.width() + 1;
                columns.push(field);
            }
        }
        let grown = |field: Field, most: usize, left: &mut usize| {
            let more = most.saturating_sub(field.width()).min(*left);
            *left -= more;
            field.width() + more
        };
        let name = grown(Field::Name, longest(Field::Name), &mut left);
        let state = grown(
            Field::State,
            longest(Field::State).min(MAX_STATE),
            &mut left,
        );
        let mut message_type = 0;
        if left > Field::Type.width() {
            left -= Field::Type.width() + 1;
            message_type = grown(Field::Type, longest(Field::Type), &mut left);
            columns.push(Field::Type);
        }
        // On a narrow screen, the name takes the remaining width.
        let least = MIN_NAME_WIDTH + 6 + 9 + 2;
        let name = if width < least {
            MIN_NAME_WIDTH.saturating_sub(least - width)
        } else {
            name
        };
        let ordered = Field::ORDER.into_iter().filter(|it| columns.contains(it));
        let sized = ordered.map(|field| match field {
            Field::Name => (field, name),
            Field::State => (field, state),
            Field::Type => (field, message_type),
            field => (field, field.width()),
        });
        Self {
            columns: sized.collect(),
            cut,
        }
    }

    /// Returns all columns, each as wide as its widest cell.
    #[must_use]
    pub fn whole(rows: &[&Row], cut: char) -> Self {
        let is_expected = rows.iter().any(|row| row.expected_rate != (None, None));
        let fields = Field::ORDER.into_iter();
        let is_late = rows.iter().any(|row| row.late.is_some());
        let fields = fields.filter(|field| match field {
            Field::Wanted => is_expected,
            Field::Late => is_late,
            _ => true,
        });
        let sized = fields.map(|field| {
            let lengths = rows.iter().map(|row| field.value(row).chars().count());
            let width = lengths.max().unwrap_or(0).max(field.label().len());
            (field, width)
        });
        Self {
            columns: sized.collect(),
            cut,
        }
    }

    /// Returns the heading, and the range of the sorted column in it.
    #[must_use]
    pub fn heading(&self, sort: Column) -> (String, Option<(usize, usize)>) {
        let (mut line, mut sorted) = (String::new(), None);
        for (field, width) in &self.columns {
            if !line.is_empty() {
                line.push(' ');
            }
            if field.is_sorted_by(sort) {
                sorted = Some((line.chars().count(), *width));
            }
            line.push_str(&self.cell(*field, *width, field.label()));
        }
        (line, sorted)
    }

    /// Returns the line of one topic.
    #[must_use]
    pub fn line(&self, row: &Row) -> String {
        let mut line = String::new();
        for (field, width) in &self.columns {
            if !line.is_empty() {
                line.push(' ');
            }
            line.push_str(&self.cell(*field, *width, &field.value(row)));
        }
        line
    }

    fn cell(&self, field: Field, width: usize, value: &str) -> String {
        match field {
            // Names and types differ most at their ends.
            Field::Name | Field::Type => {
                format!("{:<width$}", text::end(value, width, self.cut))
            }
            Field::State => {
                format!("{:<width$}", text::beginning(value, width, self.cut))
            }
            _ => format!("{:>width$}", text::beginning(value, width, self.cut)),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use serde_json::json;

    use super::super::row::Past;
    use super::*;

    fn rows(name: &str) -> Vec<Row> {
        let topic = json!({
            "name": name, "message_types": ["sensor_msgs/msg/Image"],
            "watches": [{"state": "ok", "min_rate_hz": 9.5, "max_rate_hz": 11.0}],
            "publishers": [{"measurement": {}}], "subscriptions": [{}],
            "measurement": {"messages": 9, "subscriber_expected_messages": 9, "rate_hertz": 10.0,
                "bandwidth_bytes_per_second": 9_216_000.0,
                "latency": {"p50_seconds": 0.0012, "p99_seconds": 0.015}},
        });
        let topic = serde_json::from_value(topic).unwrap();
        vec![Row::new(&topic, &mut Past::default(), Instant::now())]
    }

    #[test]
    fn a_line_fits_every_width_and_the_important_columns_stay() {
        let rows = rows("/robot1/camera/front/left/image_raw");
        for width in 10..200 {
            let table = Table::plan(width, &[&rows[0]], '~');
            let (line, (heading, _)) = (table.line(&rows[0]), table.heading(Column::Rate));
            assert_eq!(line.len(), heading.len(), "{width}\n{heading}\n{line}");
            if width >= 40 {
                assert!(line.len() <= width, "{line}");
                assert!(
                    line.contains("image_raw") && line.contains("10.0"),
                    "{line}"
                );
                assert!(heading.ends_with("STATE    "), "{heading}");
            }
        }
    }

    #[test]
    fn a_topic_with_late_calls_has_a_column_for_their_number() {
        let mut rows = rows("/camera/image");
        let heading = |rows: &[Row]| Table::plan(78, &[&rows[0]], '~').heading(Column::Late);
        assert_eq!(heading(&rows).1, None);
        rows[0].late = Some(34);
        let (names, place) = heading(&rows);
        let (begin, width) = place.unwrap();
        assert_eq!(&names[begin..begin + width], "LATE");
        let line = Table::plan(78, &[&rows[0]], '~').line(&rows[0]);
        assert_eq!(&line[begin..begin + width], "  34");
        assert!(
            Table::whole(&[&rows[0]], '~')
                .line(&rows[0])
                .contains(" 34 ")
        );
    }

    #[test]
    fn eighty_columns_show_all_measured_values() {
        let rows = rows("/camera/image");
        let table = Table::plan(78, &[&rows[0]], '~');
        let (heading, _) = table.heading(Column::Name);
        assert_eq!(
            [heading.trim_end(), table.line(&rows[0]).trim_end()],
            [
                "TOPIC                    HZ  WANTED    B/S  LOSS   MED   P99   P/S STATE",
                "/camera/image          10.0  9.5-11   9.2M    0% 1.2ms  15ms   1/1 ok",
            ]
        );
    }
}
