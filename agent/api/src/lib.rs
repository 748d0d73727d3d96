//! What the agent's API answers, declared once for the server and everything that asks it.
//!
//! ```
//! assert_eq!(ros2probe_api::path::encoded("/camera/image raw"), "/camera/image%20raw");
//! ```

#![forbid(unsafe_code)]

pub mod path;
