//! The closed lists of libraries whose mappings the broker reads, and of functions to which it
//! attaches programs.

use serde::{Deserialize, Serialize};

use crate::request::AttachMethod;

/// Names of Fast DDS's library: 2.x, 3.x. A version may follow.
const FAST_DDS: [&str; 2] = ["libfastrtps.so", "libfastdds.so"];
/// The library through which ROS 2 reports its calls.
const TRACING: [&str; 1] = ["libtracetools.so"];

/// Prefix of the names of functions in `libtracetools.so`.
const PREFIX: &str = "ros_trace_";
/// The function that reports messages entering a ring buffer, since Iron. Without it, only
/// callbacks show messages within a process.
pub const ENQUEUE: &str = "rclcpp_ring_buffer_enqueue";
/// Program at `callback_start` if only messages are observed and the library lacks [`ENQUEUE`].
const RECEPTION_PROGRAM: (&str, &str) = ("callback_received", "callback_start");

/// Observed functions that handle messages. Each has a program of the same name.
const MESSAGES: [&str; 14] = [
    "rcl_publish",
    "rmw_take",
    "rclcpp_intra_publish",
    "rclcpp_construct_ring_buffer",
    ENQUEUE,
    "rclcpp_ring_buffer_dequeue",
    "rclcpp_ring_buffer_clear",
    "rclcpp_buffer_to_ipb",
    "rclcpp_ipb_to_subscription",
    "rcl_node_init",
    "rcl_publisher_init",
    "rcl_subscription_init",
    "rclcpp_subscription_init",
    "rclcpp_subscription_callback_added",
];
/// Functions of callbacks, with programs of the same name. `rclcpp_executor_get_next_ready` is not
/// one of them: an executor calls it twice for each message, and the other functions suffice.
const CALLBACKS: [&str; 10] = [
    "callback_start",
    "callback_end",
    "rclcpp_executor_execute",
    "rcl_timer_init",
    "rclcpp_timer_link_node",
    "rclcpp_timer_callback_added",
    "rcl_service_init",
    "rclcpp_service_callback_added",
    "rcl_lifecycle_state_machine_init",
    "rcl_lifecycle_transition",
];
/// Functions of messages and callbacks that a process calls for each message or callback: the
/// runtime events of `ros2_tracing`. A process calls the other functions when it creates or
/// configures something.
const RUNTIME: [&str; 9] = [
    "rcl_publish",
    "rmw_take",
    "rclcpp_intra_publish",
    ENQUEUE,
    "rclcpp_ring_buffer_dequeue",
    "rclcpp_ring_buffer_clear",
    "callback_start",
    "callback_end",
    "rclcpp_executor_execute",
];

/// `SharedMemTransport::copy_to_shared_buffer`, called once per message that goes into shared
/// memory. Its caller `send` is called for all other messages, too. The parameters follow in the
/// mangled name.
pub const FAST_DDS_COPY: &str =
    "_ZN8eprosima7fastdds4rtps18SharedMemTransport21copy_to_shared_bufferE";
/// `(unsigned char const*, unsigned int, ..)`: Fast DDS 2.x.
pub(crate) const CONTIGUOUS_PARAMETERS: &str = "PKhj";
/// `(std::vector<NetworkBuffer> const&, unsigned int, ..)`: Fast DDS 3.x.
pub(crate) const BUFFER_LIST_PARAMETERS: &str = "RKSt6vectorINS1_13NetworkBuffer";

/// A library whose users the broker can list.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Library {
    /// Fast DDS.
    FastDds,
    /// `libtracetools.so`.
    Tracing,
}

impl Library {
    /// Returns whether a file of this name is the library, or a version of it.
    #[must_use]
    pub fn has_name(self, name: &str) -> bool {
        let names: &[&str] = match self {
            Self::FastDds => &FAST_DDS,
            Self::Tracing => &TRACING,
        };
        names.iter().any(|library| is_version_of(library, name))
    }
}

/// Functions to which programs are attached together.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Calls {
    /// The copy of a message into Fast DDS's shared memory.
    SharedMemory,
    /// Messages that are published and taken.
    Messages,
    /// Messages, callbacks, timers and lifecycle transitions.
    Callbacks,
    /// The part of [`Self::Callbacks`] for the creation of nodes and their entities, and for
    /// lifecycle transitions.
    Initialization,
    /// The part of [`Self::Callbacks`] that runs for each message or callback.
    Runtime,
}

impl Calls {
    /// Returns the library that has the functions.
    #[must_use]
    pub const fn library(self) -> Library {
        match self {
            Self::SharedMemory => Library::FastDds,
            Self::Messages | Self::Callbacks | Self::Initialization | Self::Runtime => {
                Library::Tracing
            }
        }
    }

    /// Returns the programs with the functions to which they belong. Programs of shared memory
    /// belong to one function, each for another form of its parameters. Parts of
    /// [`Self::Callbacks`] have the same programs.
    #[must_use]
    pub fn programs(self) -> Vec<(&'static str, &'static str)> {
        let same = |name: &&'static str| (*name, *name);
        match self {
            Self::SharedMemory => vec![
                ("shm_handed", CONTIGUOUS_PARAMETERS),
                ("shm_handed_list", BUFFER_LIST_PARAMETERS),
            ],
            Self::Messages => MESSAGES
                .iter()
                .map(same)
                .chain([RECEPTION_PROGRAM])
                .collect(),
            Self::Callbacks | Self::Initialization | Self::Runtime => {
                MESSAGES.iter().chain(&CALLBACKS).map(same).collect()
            }
        }
    }

    /// Returns the number of programs that come with a request. With links, one program calls the
    /// others, except for shared memory.
    #[must_use]
    pub fn expected(self, means: AttachMethod) -> usize {
        match (self.library(), means) {
            (Library::Tracing, AttachMethod::Links) => 1,
            _ => self.programs().len(),
        }
    }

    /// Returns whether programs are attached to this function of `libtracetools.so`.
    pub(crate) fn includes(self, function: &str) -> bool {
        match self {
            Self::Initialization => !RUNTIME.contains(&function),
            Self::Runtime => RUNTIME.contains(&function),
            Self::SharedMemory | Self::Messages | Self::Callbacks => true,
        }
    }

    /// Returns whether a program is left out, because a program at another function of the library
    /// reports the same.
    pub(crate) fn excludes(program: &str, has: impl Fn(&str) -> bool) -> bool {
        program == RECEPTION_PROGRAM.0 && has(ENQUEUE)
    }
}

/// Returns the symbol of a function of `libtracetools.so`.
pub(crate) fn symbol(function: &str) -> String {
    format!("{PREFIX}{function}")
}

fn is_version_of(library: &str, name: &str) -> bool {
    let version = name.strip_prefix(library);
    version.is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_versioned_name_matches_the_library_and_a_similar_name_does_not() {
        for (library, name, is_it) in [
            (Library::FastDds, "libfastrtps.so", true),
            (Library::FastDds, "libfastdds.so.3.1", true),
            (Library::FastDds, "libfastrtpsx.so.2", false),
            (Library::FastDds, "librmw_fastrtps_cpp.so", false),
            (Library::FastDds, "libfastrtps.sock", false),
            (Library::FastDds, "libtracetools.so", false),
            (Library::Tracing, "libtracetools.so", true),
            (Library::Tracing, "libtracetools.so.1", true),
            (Library::Tracing, "libc.so.6", false),
            (Library::Tracing, "", false),
        ] {
            assert_eq!(library.has_name(name), is_it, "{name}");
        }
    }

    #[test]
    fn the_programs_of_callbacks_include_those_of_messages() {
        let callbacks = Calls::Callbacks.programs();
        let mut messages = Calls::Messages.programs();
        messages.retain(|(program, _)| *program != RECEPTION_PROGRAM.0);
        assert!(messages.iter().all(|each| callbacks.contains(each)));
        assert_eq!(Calls::Callbacks.expected(AttachMethod::PerfEvents), 24);
        assert_eq!(Calls::Callbacks.expected(AttachMethod::Links), 1);
        assert_eq!(Calls::SharedMemory.expected(AttachMethod::Links), 2);
    }

    #[test]
    fn each_function_of_callbacks_belongs_to_initialization_or_to_runtime() {
        let functions = Calls::Callbacks.programs();
        for (_, function) in &functions {
            let (begins, runs) = (Calls::Initialization, Calls::Runtime);
            assert_ne!(begins.includes(function), runs.includes(function));
        }
        let is_known = |each: &&str| functions.iter().any(|(_, function)| function == each);
        assert!(RUNTIME.iter().all(is_known));
        assert_eq!(Calls::Runtime.programs(), functions);
        assert_eq!(Calls::Initialization.expected(AttachMethod::Links), 1);
    }
}
