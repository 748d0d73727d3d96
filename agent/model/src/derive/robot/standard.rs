//! Standard types that the agent reads, and the parts that read them.

use ros2probe_wire::{diagnostics, lifecycle, log, ros_parameters, transforms};

/// Standard topics and services that the agent reads; each can be switched off.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Logs of nodes.
    Logs,
    /// Diagnostics.
    Diagnostics,
    /// Parameters of nodes.
    Parameters,
    /// Transforms between frames.
    Transforms,
    /// States of managed nodes.
    Lifecycle,
    /// Fields of messages that have metrics.
    Fields,
    /// Clocks of hosts.
    Clocks,
}

/// A set of parts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Parts(u8);

/// Standard types that the agent reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Standard {
    /// `rcl_interfaces/msg/Log`.
    Log,
    /// `diagnostic_msgs/msg/DiagnosticArray`.
    Diagnostics,
    /// `rcl_interfaces/msg/ParameterEvent`.
    ParameterEvent,
    /// Request of `rcl_interfaces/srv/SetParameters` or of its atomic variant.
    SetParameters,
    /// Requests of `rcl_interfaces/srv/GetParameters`.
    GetParameters,
    /// Replies of `rcl_interfaces/srv/GetParameters`.
    ParameterValues,
    /// `tf2_msgs/msg/TFMessage`.
    Transforms,
    /// `lifecycle_msgs/msg/TransitionEvent`.
    TransitionEvent,
    /// Reply of `lifecycle_msgs/srv/GetState`.
    LifecycleState,
    /// Any type whose fields have metrics.
    Fields,
}

impl Standard {
    /// Returns the standard type of this name.
    #[must_use]
    pub fn of(message_type: &str) -> Option<Self> {
        match message_type {
            log::TYPE => Some(Self::Log),
            diagnostics::TYPE => Some(Self::Diagnostics),
            ros_parameters::EVENT => Some(Self::ParameterEvent),
            transforms::TYPE => Some(Self::Transforms),
            lifecycle::EVENT => Some(Self::TransitionEvent),
            lifecycle::STATE_REPLY => Some(Self::LifecycleState),
            "rcl_interfaces/srv/SetParameters_Request"
            | "rcl_interfaces/srv/SetParametersAtomically_Request" => Some(Self::SetParameters),
            "rcl_interfaces/srv/GetParameters_Request" => Some(Self::GetParameters),
            "rcl_interfaces/srv/GetParameters_Response" => Some(Self::ParameterValues),
            _ => None,
        }
    }

    /// Returns its name as a stage of decoding.
    #[must_use]
    pub const fn stage(self) -> &'static str {
        match self {
            Self::Log => "log",
            Self::Diagnostics => "diagnostics",
            Self::ParameterEvent => "parameter_event",
            Self::SetParameters => "set_parameters",
            Self::GetParameters => "get_parameters",
            Self::ParameterValues => "parameter_values",
            Self::Transforms => "transforms",
            Self::TransitionEvent => "transition_event",
            Self::LifecycleState => "lifecycle_state",
            Self::Fields => "fields",
        }
    }

    /// Returns the part that reads it.
    #[must_use]
    pub const fn part(self) -> Part {
        match self {
            Self::Log => Part::Logs,
            Self::Diagnostics => Part::Diagnostics,
            Self::ParameterEvent
            | Self::SetParameters
            | Self::GetParameters
            | Self::ParameterValues => Part::Parameters,
            Self::Transforms => Part::Transforms,
            Self::TransitionEvent | Self::LifecycleState => Part::Lifecycle,
            Self::Fields => Part::Fields,
        }
    }
}

impl Parts {
    /// All parts, up to the last one.
    pub const ALL: Self = Self((1 << (Part::Clocks as u8 + 1)) - 1);

    /// Returns whether it contains this part.
    #[must_use]
    pub const fn has(self, part: Part) -> bool {
        self.0 >> part as u8 & 1 != 0
    }
}

impl FromIterator<Part> for Parts {
    fn from_iter<T: IntoIterator<Item = Part>>(parts: T) -> Self {
        Self(
            parts
                .into_iter()
                .fold(0, |bits, part| bits | 1 << part as u8),
        )
    }
}
