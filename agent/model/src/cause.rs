//! Where a lost sample died, as far as this host can tell.
//!
//! The classes exclude each other: a sample of which anything died nearest to the reader bears that
//! cause, so the counts of all causes add up to the losses.

/// Where a sample died that never arrived whole.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum LossCause {
    /// It did not reach this host: lost on the network, or never sent to here.
    BeforeHost,
    /// Some of its IP fragments reached this host, and the kernel gave up waiting for the others.
    Reassembly,
    /// It reached the subscriber's socket, whose receive buffer was full.
    SocketBuffer,
}

impl LossCause {
    /// All causes, for exporting one series each.
    pub const ALL: [Self; 3] = [Self::BeforeHost, Self::Reassembly, Self::SocketBuffer];

    /// Label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::BeforeHost => "before_host",
            Self::Reassembly => "reassembly",
            Self::SocketBuffer => "socket_buffer",
        }
    }
}
