//! Prometheus remote write: samples are pushed to a receiver on a thread of their own.
//!
//! The samples are those of a scrape of the page. While the receiver is out of reach, they wait in
//! a bounded queue, on disk if there is a state directory. They are delivered in order, also after
//! a restart. The caller starts the thread, with the privileges of exports.

mod backlog;
mod client;
mod delivery;
mod figures;
mod new_series;
mod record;
mod request;
pub(crate) mod samples;
mod settings;

pub use delivery::{Inputs, StartError, start};
pub use figures::{Figures, Request, SampleFate};
pub use settings::{RemoteWriteSettings, Settings, SettingsError, receiver};
