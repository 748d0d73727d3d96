//! `rp top`: a live table of topics in a terminal.
//!
//! It shows what the agent's API says and decides nothing by itself. Names from the network reach the
//! terminal escaped (`text`); the terminal is given back clean however it ends (`terminal`).

pub mod app;
pub mod details;
pub mod facts;
mod header;
mod help;
pub mod look;
mod news;
pub mod row;
mod table;
pub mod text;
pub mod view;
