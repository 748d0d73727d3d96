//! State of `rp top`, and its changes by keys and facts. Keys and facts come in; state and commands
//! go out. This module draws nothing, sends no request and reads no clock.

use std::collections::{BTreeMap, HashMap};
use std::time::{Duration, Instant};

use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyEventKind, KeyModifiers};

use super::Options;
use super::event_pane::EventPane;
use super::row::{Column, Key, Past, Row, RowState, shown_name};
use super::text::escaped;
use ros2probe_api::events::{Event, Lagged};
use ros2probe_api::health::Health;
use ros2probe_api::topics::{TopicDetails, TopicList};

/// Time for which a drop counts as recent.
const RECENT_DROP_TIME: Duration = Duration::from_secs(30);
/// Time for which the answer to a key stays on the screen.
const STATUS_LINE_TIME: Duration = Duration::from_secs(8);

/// Facts received from the agent.
#[derive(Debug)]
pub enum Fact {
    /// All topics.
    Topics(Box<TopicList<'static>>),
    /// State of the agent.
    Health(Box<Health>),
    /// The selected topic with all details. `None` if it no longer exists.
    Details(Key, Option<Box<TopicDetails<'static>>>),
    /// An event.
    Event(Box<Event<'static>>),
    /// A gap in the events.
    Lagged(Lagged),
    /// The agent does not answer, for this reason.
    Gone(String),
    /// Result of a command.
    Status(String),
    /// Topics that are measured on behalf of this program.
    Measured(BTreeMap<Key, MeasuredBy>),
}

/// Means by which a topic is measured on behalf of this program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MeasuredBy {
    /// A stream, until the program ends.
    Session,
    /// A watch, which outlives the program.
    Watch,
}

/// Command for the program.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Command {
    /// End the program.
    Quit,
    /// Request details of this topic, or of none.
    Select(Option<Key>),
    /// Whether to request hidden topics.
    Hidden(bool),
    /// Start or stop measuring a topic.
    Toggle(Key, String),
    /// Measure a topic permanently.
    Keep(Key, String),
}

/// Part of the screen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Pane {
    /// Table of topics.
    #[default]
    Topics,
    /// Details of the selected topic.
    Details,
    /// Latest events.
    Events,
}

/// Filter of the table.
#[derive(Clone, Debug, Default)]
pub struct Filter {
    /// Text in the name, type or state.
    pub text: String,
    /// Only topics with problems.
    pub problems: bool,
    /// Only measured topics.
    pub measured: bool,
}

impl Filter {
    /// Returns whether any condition is set.
    #[must_use]
    pub fn is_set(&self) -> bool {
        !self.text.is_empty() || self.problems || self.measured
    }

    fn admits(&self, row: &Row) -> bool {
        let text = self.text.to_lowercase();
        let has = |field: &str| field.to_lowercase().contains(&text);
        (text.is_empty() || has(&row.name) || has(&row.message_type) || has(&row.state()))
            && (!self.problems || !row.problems.is_empty())
            && (!self.measured || row.is_measured)
    }
}

/// State of the screen.
#[derive(Debug, Default)]
pub struct App {
    /// Domain to request; `None` for all domains.
    pub domain_id: Option<u32>,
    /// Address of the agent, shown if the agent does not report its host.
    pub place: String,
    /// Column by which the table is sorted.
    pub sort: Column,
    /// Whether the order is reversed.
    pub reverse: bool,
    /// Filter of the table.
    pub filter: Filter,
    /// Text of the filter before the edit in progress. `None` outside of an edit.
    pub editing: Option<String>,
    /// Pane that the arrow keys move.
    pub focus: Pane,
    /// Whether the details are open.
    pub details_open: bool,
    /// Whether the events are open.
    pub events_open: bool,
    /// Whether the focused pane fills the screen.
    pub zoomed: bool,
    /// Whether the help is open.
    pub help: bool,
    /// Whether hidden topics are requested.
    pub hidden: bool,
    /// All topics, sorted.
    rows: Vec<Row>,
    /// Indices into `rows` of the topics that pass the filter.
    shown: Vec<usize>,
    /// Details of the selected topic.
    pub details: Option<Box<TopicDetails<'static>>>,
    /// The selected topic.
    pub selected: Option<Key>,
    /// The latest events.
    pub event_pane: EventPane,
    /// First visible line of the details.
    pub details_scroll: usize,
    /// Number of newer events below the visible ones.
    pub events_back: usize,
    /// First visible topic.
    pub offset: usize,
    /// Lines of each pane when last drawn.
    pub heights: Heights,
    /// State of the agent, and the time of its receipt.
    pub health: Option<(Health, Instant)>,
    /// Start of the agent's silence and its reason, while the agent does not answer.
    pub unreachable_since: Option<(Instant, String)>,
    /// Time of the last topic list.
    pub updated: Option<Instant>,
    /// Time of the last increase of a drop counter.
    dropped_at: Option<Instant>,
    past: HashMap<Key, Past>,
    /// Topics that are measured on behalf of this program.
    pub measured_topics: BTreeMap<Key, MeasuredBy>,
    status: Option<(Instant, String)>,
}

/// Lines of each pane.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Heights {
    /// Lines of the table without its heading.
    pub topics: usize,
    /// Visible lines of the details.
    pub details: usize,
    /// Total lines of the details.
    pub details_needed: usize,
    /// Visible lines of the events.
    pub events: usize,
}

impl App {
    /// Creates the initial state for the agent at `place`.
    #[must_use]
    pub fn new(options: &Options, place: String) -> Self {
        Self {
            domain_id: options.domain_id,
            place,
            sort: options.sort,
            reverse: options.reverse,
            filter: Filter {
                text: options.filter.clone(),
                problems: options.problems,
                measured: false,
            },
            hidden: options.hidden,
            ..Self::default()
        }
    }

    /// Returns the topics that pass the filter, in order.
    pub fn shown(&self) -> impl ExactSizeIterator<Item = &Row> {
        // The indices are computed together with the rows.
        let rows = |at: &usize| self.rows.get(*at);
        let shown: Vec<_> = self.shown.iter().filter_map(rows).collect();
        shown.into_iter()
    }

    /// Returns all known topics.
    #[must_use]
    pub fn rows(&self) -> &[Row] {
        &self.rows
    }

    /// Returns the index of the selected topic in the table; `None` if it is not shown.
    #[must_use]
    pub fn selected_index(&self) -> Option<usize> {
        let selected = self.selected.as_ref()?;
        let mut rows = self.shown();
        rows.position(|row| row.key == *selected)
    }

    /// Returns the answer to the last key, while it is recent.
    #[must_use]
    pub fn status(&self, now: Instant) -> Option<&str> {
        let (at, text) = self.status.as_ref()?;
        (now.saturating_duration_since(*at) < STATUS_LINE_TIME).then_some(text.as_str())
    }

    /// Returns whether the agent dropped data recently.
    #[must_use]
    pub fn is_dropping(&self, now: Instant) -> bool {
        let dropped_at = self.dropped_at;
        dropped_at.is_some_and(|at| now.saturating_duration_since(at) < RECENT_DROP_TIME)
    }

    /// Returns the age of the topic list; `None` before the first list.
    #[must_use]
    pub fn age(&self, now: Instant) -> Option<Duration> {
        let age = now.saturating_duration_since(self.updated?);
        let health = self.health.as_ref();
        let before = health.and_then(|(health, _)| health.age_seconds);
        let before = before.filter(|age| (0.0..1e9).contains(age));
        Some(age + Duration::from_secs_f64(before.unwrap_or_default()))
    }

    /// Processes a fact from the agent.
    pub fn take(&mut self, fact: Fact, now: Instant) -> Vec<Command> {
        match fact {
            Fact::Topics(topics) => {
                (self.updated, self.unreachable_since) = (Some(now), None);
                return self.take_topics(&topics, now);
            }
            Fact::Health(health) => {
                let before = self.health.as_ref().map(|(health, _)| health.dropped());
                if before.is_some_and(|before| health.dropped() > before) {
                    self.dropped_at = Some(now);
                }
                self.health = Some((*health, now));
            }
            Fact::Details(key, topic) if self.selected.as_ref() == Some(&key) => {
                self.details = topic;
            }
            Fact::Details(..) => {}
            Fact::Event(event) => {
                let before = self.event_pane.shown().count();
                self.event_pane.add(&event, self.domain_id);
                self.keep_scroll_position(before);
            }
            Fact::Lagged(lagged) => {
                let before = self.event_pane.shown().count();
                self.event_pane.lag(&lagged);
                self.keep_scroll_position(before);
            }
            Fact::Gone(why) => {
                let since = self
                    .unreachable_since
                    .as_ref()
                    .map_or(now, |(since, _)| *since);
                self.unreachable_since = Some((since, escaped(&why)));
            }
            Fact::Status(text) => self.status = Some((now, escaped(&text))),
            Fact::Measured(holds) => self.measured_topics = holds,
        }
        Vec::new()
    }

    /// Keeps the visible lines in place after the user has scrolled back.
    fn keep_scroll_position(&mut self, before: usize) {
        if self.events_back > 0 {
            let more = self.event_pane.shown().count().saturating_sub(before);
            self.events_back += more;
        }
    }

    fn take_topics(&mut self, topics: &TopicList<'_>, now: Instant) -> Vec<Command> {
        let mut past = std::mem::take(&mut self.past);
        let rows = topics.topics.iter().map(|topic| {
            let key = Key {
                domain_id: topic.domain_id,
                dds_name: topic.dds_name.to_string(),
            };
            let mut own = past.remove(&key).unwrap_or_default();
            let row = Row::new(topic, &mut own, now);
            self.past.insert(key, own);
            row
        });
        self.rows = rows.collect();
        self.sort_and_filter()
    }

    /// Sorts and filters. The selected topic stays selected. If it no longer exists, the topic at
    /// its position is selected.
    pub fn sort_and_filter(&mut self) -> Vec<Command> {
        let place = self.selected_index().unwrap_or(0);
        let (sort, reverse) = (self.sort, self.reverse);
        self.rows
            .sort_by(|one, other| sort.order(reverse, one, other));
        let rows = self.rows.iter().enumerate();
        let shown = rows.filter(|(_, row)| self.filter.admits(row));
        self.shown = shown.map(|(at, _)| at).collect();
        if self.selected_index().is_some() {
            self.scroll();
            return Vec::new();
        }
        self.select(place)
    }

    fn select(&mut self, place: usize) -> Vec<Command> {
        let last = self.shown.len().saturating_sub(1);
        let row = self.shown().nth(place.min(last));
        let key = row.map(|row| row.key.clone());
        if key == self.selected {
            self.scroll();
            return Vec::new();
        }
        self.selected.clone_from(&key);
        self.details = None;
        self.details_scroll = 0;
        self.scroll();
        vec![Command::Select(key)]
    }

    /// Scrolls so that the selected topic is visible, given the current [`Heights`].
    pub fn scroll(&mut self) {
        let height = self.heights.topics.max(1);
        let place = self.selected_index().unwrap_or(0);
        let last = self.shown.len().saturating_sub(height);
        let lowest = place.saturating_sub(height - 1);
        self.offset = self.offset.clamp(lowest, place.max(lowest)).min(last);
        let needed = self.heights.details_needed;
        let last = needed.saturating_sub(self.heights.details.max(1));
        self.details_scroll = self.details_scroll.min(last);
        let events = self.event_pane.shown().count();
        let last = events.saturating_sub(self.heights.events.max(1));
        self.events_back = self.events_back.min(last);
    }

    /// Processes a key.
    pub fn key(&mut self, key: KeyEvent) -> Vec<Command> {
        if key.kind == KeyEventKind::Release {
            return Vec::new();
        }
        let control = key.modifiers.contains(KeyModifiers::CONTROL);
        if control && matches!(key.code, KeyCode::Char('c' | 'C')) {
            return vec![Command::Quit];
        }
        if self.help {
            self.help = false;
            return match key.code {
                KeyCode::Char('q') => vec![Command::Quit],
                _ => Vec::new(),
            };
        }
        if self.editing.is_some() {
            return self.edit(key.code, control);
        }
        match key.code {
            KeyCode::Char('b') if control => self.move_selection(-self.page()),
            KeyCode::Char('f') if control => self.move_selection(self.page()),
            KeyCode::Char('u') if control => self.move_selection(-self.page() / 2),
            KeyCode::Char('d') if control => self.move_selection(self.page() / 2),
            KeyCode::Char(_) if control => Vec::new(),
            KeyCode::Char('q') => vec![Command::Quit],
            KeyCode::Char('?') | KeyCode::F(1) => {
                self.help = true;
                Vec::new()
            }
            KeyCode::Up | KeyCode::Char('k') => self.move_selection(-1),
            KeyCode::Down | KeyCode::Char('j') => self.move_selection(1),
            KeyCode::PageUp => self.move_selection(-self.page()),
            KeyCode::PageDown | KeyCode::Char(' ') => self.move_selection(self.page()),
            KeyCode::Home | KeyCode::Char('g') => self.move_selection(isize::MIN),
            KeyCode::End | KeyCode::Char('G') => self.move_selection(isize::MAX),
            KeyCode::Char('w' | 'W') => self.measure(key.code),
            code => self.switch(code),
        }
    }

    /// Processes keys that change the view.
    fn switch(&mut self, code: KeyCode) -> Vec<Command> {
        match code {
            KeyCode::Enter | KeyCode::Char('d') => {
                self.details_open = !self.details_open;
                self.details_scroll = 0;
                self.settle(Pane::Details, self.details_open);
            }
            KeyCode::Char('e') => {
                self.events_open = !self.events_open;
                self.events_back = 0;
                self.settle(Pane::Events, self.events_open);
            }
            KeyCode::Char('v') => {
                self.event_pane.only_warnings = !self.event_pane.only_warnings;
                self.events_back = 0;
            }
            KeyCode::Tab => self.focus_next(),
            KeyCode::Char('z') => self.zoomed = !self.zoomed,
            KeyCode::Esc => self.back(),
            KeyCode::Char('/') => {
                self.editing = Some(self.filter.text.clone());
                return Vec::new();
            }
            KeyCode::Char('p') => self.filter.problems = !self.filter.problems,
            KeyCode::Char('m') => self.filter.measured = !self.filter.measured,
            KeyCode::Char('h') => {
                self.hidden = !self.hidden;
                return vec![Command::Hidden(self.hidden)];
            }
            KeyCode::Char('s' | '>') => self.sort_by(1),
            KeyCode::Char('<') => self.sort_by(Column::ALL.len() - 1),
            KeyCode::Char('r') => self.reverse = !self.reverse,
            KeyCode::Char(digit @ '1'..='9') => {
                let place = digit as usize - '1' as usize;
                if let Some(column) = Column::ALL.get(place) {
                    (self.sort, self.reverse) = (*column, false);
                }
            }
            _ => return Vec::new(),
        }
        self.sort_and_filter()
    }

    fn edit(&mut self, code: KeyCode, control: bool) -> Vec<Command> {
        match code {
            KeyCode::Enter => self.editing = None,
            KeyCode::Esc => self.filter.text = self.editing.take().unwrap_or_default(),
            KeyCode::Backspace => drop(self.filter.text.pop()),
            KeyCode::Char('u') if control => self.filter.text.clear(),
            KeyCode::Char(' '..='~') if control => return Vec::new(),
            KeyCode::Char(character @ ' '..='~') => self.filter.text.push(character),
            KeyCode::Up => return self.move_selection(-1),
            KeyCode::Down => return self.move_selection(1),
            _ => return Vec::new(),
        }
        self.sort_and_filter()
    }

    fn measure(&mut self, code: KeyCode) -> Vec<Command> {
        let selected = self.selected.as_ref();
        let row = self.rows.iter().find(|row| Some(&row.key) == selected);
        let Some(row) = row.filter(|row| row.state != RowState::Gone) else {
            return Vec::new();
        };
        let (key, name) = (row.key.clone(), row.name.clone());
        vec![match code {
            KeyCode::Char('W') => Command::Keep(key, name),
            _ => Command::Toggle(key, name),
        }]
    }

    fn sort_by(&mut self, further: usize) {
        let here = Column::ALL.iter().position(|column| *column == self.sort);
        let next = (here.unwrap_or(0) + further) % Column::ALL.len();
        self.sort = Column::ALL.get(next).copied().unwrap_or_default();
        self.reverse = false;
    }

    /// Focuses a pane that opens while zoomed, and unfocuses one that closes.
    fn settle(&mut self, pane: Pane, is_open: bool) {
        match is_open {
            true if self.zoomed => self.focus = pane,
            false if self.focus == pane => (self.focus, self.zoomed) = (Pane::Topics, false),
            _ => {}
        }
    }

    fn focus_next(&mut self) {
        let open = [
            (Pane::Topics, true),
            (Pane::Details, self.details_open),
            (Pane::Events, self.events_open),
        ];
        let open = open.into_iter().filter(|(_, is_open)| *is_open);
        let open: Vec<_> = open.map(|(pane, _)| pane).collect();
        let here = open.iter().position(|pane| *pane == self.focus);
        let next = here.map_or(0, |here| (here + 1) % open.len());
        self.focus = open.get(next).copied().unwrap_or_default();
    }

    /// Leaves the zoom, the focus, the details or the filter, whichever is innermost.
    fn back(&mut self) {
        if self.zoomed {
            self.zoomed = false;
        } else if self.focus != Pane::Topics {
            self.focus = Pane::Topics;
        } else if self.details_open {
            self.details_open = false;
        } else if self.filter.is_set() {
            self.filter = Filter::default();
        }
    }

    fn page(&self) -> isize {
        let height = match self.focus {
            Pane::Topics => self.heights.topics,
            Pane::Details => self.heights.details,
            Pane::Events => self.heights.events,
        };
        isize::try_from(height.saturating_sub(1).max(1)).unwrap_or(1)
    }

    fn move_selection(&mut self, steps: isize) -> Vec<Command> {
        match self.focus {
            Pane::Topics => {
                let place = self.selected_index().unwrap_or(0);
                return self.select(place.saturating_add_signed(steps));
            }
            Pane::Details => {
                self.details_scroll = self.details_scroll.saturating_add_signed(steps);
            }
            Pane::Events => {
                let steps = steps.checked_neg().unwrap_or(isize::MAX);
                self.events_back = self.events_back.saturating_add_signed(steps);
            }
        }
        self.scroll();
        Vec::new()
    }

    /// Returns the name of the selected topic, for the heading of the details.
    #[must_use]
    pub fn selected_name(&self) -> Option<String> {
        let details = self
            .details
            .as_ref()
            .map(|details| shown_name(&details.topic));
        let selected = self.selected.as_ref();
        let row = || self.rows.iter().find(|row| Some(&row.key) == selected);
        details.or_else(|| row().map(|row| row.name.clone()))
    }
}

#[cfg(test)]
mod tests;
