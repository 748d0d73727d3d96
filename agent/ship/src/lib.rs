//! Delivery of finished bags to an object store or a folder.
//!
//! A bag is a directory below that of the recordings. Its files are delivered in parts, then a
//! manifest with their checksums: a bag is complete at the destination if and only if its manifest
//! exists. Each part is recorded once it is delivered, so that a killed process continues.
//!
//! - [`Settings`] select destination, bandwidth and times.
//! - [`Shipper`] delivers bags, and deletes delivered ones if space is needed.
//! - [`is_delivered`] returns whether the destination has a bag, for programs that delete bags.
//! - [`Archive`] lists the bags of all robots at a destination.
//! - [`Status`] is what `rp ship --status` prints.
//!
//! The crate neither records nor repairs bags. An unfinished bag is delivered as it is, and its
//! manifest names it as incomplete.

#![forbid(unsafe_code)]

mod archive;
mod bags;
mod credentials;
mod delivery;
mod http;
mod link;
mod manifest;
mod settings;
mod shipper;
mod space;
mod state;
mod status;
mod store;
mod windows;

pub use archive::{Archive, ArchiveError, Listing, StoredBag};
pub use manifest::{Manifest, ManifestFile};
pub use settings::{Settings, SettingsError, SpaceLimits, StoreSettings, is_destination};
pub use shipper::{Findings, Observer, ShipError, Shipper};
pub use state::{RECORDS_DIRECTORY, is_delivered};
pub use status::{Delivered, Failure, Status, StatusError, Uploading};
pub use windows::{InvalidWindow, Window, Windows};
