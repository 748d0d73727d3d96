//! History on disk: figures of each topic and process, states of the robot, events, and what its
//! views contained, for days.
//!
//! A [`Store`] is a directory with three tiers of append-only files. [`Tier::Seconds`] has rows of
//! one second. [`Tier::Tens`] has the same rows merged into steps of ten seconds, which reach further
//! back within the same number of bytes. [`Tier::Documents`] has versions of [`Document`]s, of which
//! only the changes are stored. Each file consists of blocks with a checksum; a
//! block that a power cut damaged is skipped, and the rest stays readable. The oldest file of a tier
//! is deleted when the tier exceeds its part of the limit.
//!
//! A [`Queue`] is a directory of the same files, in which records wait for a receiver.
//!
//! This crate starts no thread and reads no clock. All times are Unix seconds.
//!
//! ```
//! use ros2probe_history::{Block, Kind, Series, Store, Tier, TopicName, TopicRow};
//!
//! let directory = tempfile::tempdir()?;
//! let store = Store::open(directory.path(), 1 << 20)?;
//! let row = TopicRow { at: 1001, seconds: 1, messages: 30, ..TopicRow::default() };
//! let points = TopicName { domain_id: 0, dds_name: "rt/points".into() };
//! let series = [Series { of: points, rows: vec![row] }];
//! store.append(Tier::Seconds, &[Block::of_topics(1000, 1001, &series)])?;
//!
//! let mut seen = Vec::new();
//! store.topics(1000..1001, 1, &|_| true, &mut |_, row| seen.push(row));
//! assert_eq!(seen, [row]);
//! # Ok::<(), std::io::Error>(())
//! ```

mod block;
mod bytes;
mod columns;
mod delta;
mod documents;
mod file;
mod merge;
mod queue;
mod rows;
mod store;

pub use block::{Block, Kind};
pub use documents::{Document, DocumentVersion};
pub use merge::{merge_by_name, merge_into, merged};
pub use queue::{Queue, Record};
pub use rows::{ProcessName, ProcessRow, Series, TopicName, TopicRow};
pub use store::{Facts, Span, Store, Tier};
