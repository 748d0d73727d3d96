//! Screen: header, panes and footer, drawn from the state.

use std::time::Instant;

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::Modifier;
use ratatui::text::{Line, Span};

use super::app::{App, Heights, MeasuredBy, Pane};
use super::details::{self, Styled};
use super::header;
use super::help;
use super::table::Table;
use super::text::{beginning, escaped};
use super::theme::{Kind, Theme};

/// Minimum usable size: columns and lines.
pub const MIN_SIZE: (u16, u16) = (40, 8);
/// Columns before each topic for two marks: selected, and measured on behalf of this program.
const MARK_COLUMNS: usize = 2;

/// Draws the screen, and stores the heights of the panes in the state.
pub fn draw(app: &mut App, frame: &mut Frame<'_>, theme: Theme, now: Instant) {
    let area = frame.area();
    if area.width < MIN_SIZE.0 || area.height < MIN_SIZE.1 {
        let (width, height) = MIN_SIZE;
        let text = format!("rp top needs {width}x{height}");
        put(frame, area, 0, &text, theme, Kind::Plain);
        return;
    }
    if app.help {
        write(frame, area, &help::lines(), theme, 0);
        return;
    }
    let most = usize::from(area.height / 4).max(3);
    let header = header::lines(app, usize::from(area.width), most, theme, now);
    write(frame, area, &header, theme, 0);
    let top = u16::try_from(header.len()).unwrap_or(u16::MAX);
    let body = Rect {
        y: area.y + top,
        height: area.height.saturating_sub(top + 1),
        ..area
    };
    let panes = Panes::of(app, body);
    app.heights = panes.heights();
    let details = match (panes.details, &app.details) {
        (None, _) => Vec::new(),
        (Some(area), Some(topic)) => details::lines(topic, usize::from(area.width), theme),
        (Some(_), None) => vec![("...".to_owned(), Kind::Faint)],
    };
    app.heights.details_needed = details.len();
    app.scroll();
    if let Some(area) = panes.topics {
        topics(app, frame, area, theme);
    }
    if let Some(area) = panes.details {
        let name = app.selected_name();
        let name = name.unwrap_or_else(|| "no topic selected".to_owned());
        let shown = app.details_scroll + app.heights.details;
        let title = match details.len() > app.heights.details {
            true => format!("{name} ({}/{})", shown.min(details.len()), details.len()),
            false => name,
        };
        rule(frame, area, &title, app.focus == Pane::Details, theme);
        write(frame, below(area), &details, theme, app.details_scroll);
    }
    if let Some(area) = panes.events {
        events(app, frame, area, theme);
    }
    footer(app, frame, area, theme, now);
}

/// Areas of the panes; each has a title line on top.
#[derive(Clone, Copy, Debug, Default)]
struct Panes {
    topics: Option<Rect>,
    details: Option<Rect>,
    events: Option<Rect>,
}

impl Panes {
    fn of(app: &App, body: Rect) -> Self {
        let mut panes = Self::default();
        if app.zoomed {
            match app.focus {
                Pane::Topics => panes.topics = Some(body),
                Pane::Details => panes.details = Some(body),
                Pane::Events => panes.events = Some(body),
            }
            return panes;
        }
        let mut left = body;
        let mut cut = |height: u16| {
            left.height -= height;
            Rect {
                y: left.y + left.height,
                height,
                ..left
            }
        };
        if app.events_open && body.height >= 8 {
            panes.events = Some(cut((body.height / 4).clamp(4, 12)));
        }
        let rest = body.height - panes.events.map_or(0, |area| area.height);
        if app.details_open && rest >= 6 {
            panes.details = Some(cut(rest * 3 / 5));
        }
        panes.topics = Some(left);
        panes
    }

    fn heights(&self) -> Heights {
        let height = |area: Option<Rect>| area.map_or(0, |area| usize::from(below(area).height));
        Heights {
            topics: height(self.topics),
            details: height(self.details),
            details_needed: 0,
            events: height(self.events),
        }
    }
}

fn topics(app: &App, frame: &mut Frame<'_>, area: Rect, theme: Theme) {
    let width = usize::from(area.width) - MARK_COLUMNS;
    let rows: Vec<_> = app.shown().collect();
    let table = Table::plan(width, &rows, theme.cut());
    let (heading, sorted) = table.heading(app.sort);
    let heading = format!("{:MARK_COLUMNS$}{heading}", "");
    put(frame, area, 0, &heading, theme, Kind::Heading);
    if let Some((at, width)) = sorted {
        let column = |at: usize| u16::try_from(at).unwrap_or(u16::MAX);
        let area = Rect {
            x: area.x + column(MARK_COLUMNS + at),
            width: column(width),
            height: 1,
            ..area
        };
        let area = area.intersection(frame.area());
        frame.buffer_mut().set_style(area, Modifier::UNDERLINED);
    }
    let body = below(area);
    if rows.is_empty() {
        put(frame, body, 0, empty_text(app), theme, Kind::Plain);
    }
    let visible = rows.iter().skip(app.offset).zip(0..body.height);
    for (row, at) in visible {
        let is_selected = app.selected.as_ref() == Some(&row.key);
        let hold = match app.measured_topics.get(&row.key) {
            None => ' ',
            Some(MeasuredBy::Session) => '+',
            Some(MeasuredBy::Watch) => '=',
        };
        let mark = if is_selected { '>' } else { ' ' };
        let line = format!("{mark}{hold}{}", table.line(row));
        let kind = match (is_selected, row.problems.is_empty(), row.is_measured) {
            (true, ..) => Kind::Selected,
            (false, false, _) => Kind::Problem,
            (false, true, false) => Kind::Faint,
            (false, true, true) => Kind::Plain,
        };
        put(frame, body, at, &line, theme, kind);
    }
}

/// Returns the reason for an empty table.
fn empty_text(app: &App) -> &'static str {
    match (app.updated, app.rows().is_empty()) {
        (None, _) => "  waiting for the agent",
        (Some(_), true) => "  no topics yet",
        (Some(_), false) => "  no topic matches the filter: Esc clears it",
    }
}

fn events(app: &App, frame: &mut Frame<'_>, area: Rect, theme: Theme) {
    let body = below(area);
    let lines: Vec<_> = app.event_pane.shown().collect();
    let behind = lines.len().saturating_sub(app.events_back);
    let first = behind.saturating_sub(usize::from(body.height));
    let mut title = match app.event_pane.only_warnings {
        true => "events: warnings only".to_owned(),
        false => "events".to_owned(),
    };
    if app.events_back > 0 {
        title.push_str(&format!(" ({} newer below)", app.events_back));
    }
    rule(frame, area, &title, app.focus == Pane::Events, theme);
    if lines.is_empty() {
        put(frame, body, 0, "no events yet", theme, Kind::Faint);
    }
    let shown = lines.get(first..behind).unwrap_or_default();
    for (line, at) in shown.iter().zip(0..body.height) {
        let kind = if line.is_warning {
            Kind::Problem
        } else {
            Kind::Plain
        };
        put(frame, body, at, &line.text, theme, kind);
    }
}

fn footer(app: &App, frame: &mut Frame<'_>, area: Rect, theme: Theme, now: Instant) {
    let last = area.height.saturating_sub(1);
    if app.editing.is_some() {
        let text = format!("/{}", escaped(&app.filter.text));
        put(frame, area, last, &text, theme, Kind::Plain);
        let column = u16::try_from(text.len()).unwrap_or(u16::MAX);
        let x = area.x + column.min(area.width.saturating_sub(1));
        frame.set_cursor_position((x, area.y + last));
        return;
    }
    if let Some(status) = app.status(now) {
        put(frame, area, last, status, theme, Kind::Heading);
        return;
    }
    let keys = match app.focus {
        Pane::Topics => {
            "q quit  ? help  / filter  s sort  Enter details  e events  w measure  p problems"
        }
        _ => "q quit  ? help  Tab next pane  arrows scroll  z whole screen  Esc back",
    };
    put(frame, area, last, keys, theme, Kind::Faint);
}

/// Draws the title line of a pane.
fn rule(frame: &mut Frame<'_>, area: Rect, title: &str, is_focused: bool, theme: Theme) {
    let line = theme.rule(is_focused);
    let width = usize::from(area.width);
    let title = beginning(title, width.saturating_sub(6), theme.cut());
    let text = format!("{line}{line} {title} ");
    let rest = width.saturating_sub(text.chars().count());
    let text: String = text
        .chars()
        .chain(std::iter::repeat_n(line, rest))
        .collect();
    let kind = if is_focused {
        Kind::Heading
    } else {
        Kind::Plain
    };
    put(frame, area, 0, &text, theme, kind);
}

const fn below(area: Rect) -> Rect {
    let height = area.height.saturating_sub(1);
    Rect {
        y: area.y + (area.height - height),
        height,
        ..area
    }
}

/// Draws as many lines as fit, beginning with `first`.
fn write(frame: &mut Frame<'_>, area: Rect, lines: &[Styled], theme: Theme, first: usize) {
    for ((text, kind), at) in lines.iter().skip(first).zip(0..area.height) {
        put(frame, area, at, text, theme, *kind);
    }
}

/// Draws one line, truncated at the end of the area.
fn put(frame: &mut Frame<'_>, area: Rect, at: u16, text: &str, theme: Theme, kind: Kind) {
    if at >= area.height {
        return;
    }
    let width = usize::from(area.width);
    let mut text = beginning(text.trim_end(), width, theme.cut());
    if kind == Kind::Selected {
        text = format!("{text:<width$}");
    }
    let line = Line::from(Span::styled(text, theme.style(kind)));
    frame
        .buffer_mut()
        .set_line(area.x, area.y + at, &line, area.width);
}

#[cfg(test)]
mod tests;
