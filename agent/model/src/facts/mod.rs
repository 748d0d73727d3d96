//! Identities, names, times, bounded tables, and the values that the other layers exchange.

pub mod bounded;
pub mod calls;
pub mod churn;
pub mod diagnosis;
pub mod dispatch;
pub mod event;
pub mod glob;
pub mod header;
pub mod histogram;
pub mod identity;
pub mod journal;
pub mod limits;
pub mod loss;
pub mod loss_share;
pub mod measurement;
pub mod model_time;
pub mod names;
pub mod naming;
pub mod observation;
pub mod rate;
pub mod route;
pub mod selection;
pub mod tables;
pub mod topic_kind;
pub mod wall_clock;
pub mod watch;
