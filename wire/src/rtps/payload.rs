//! Content of a DATA after its inline QoS (RTPS 2.5, 9.4.5.4).

/// Content of a change, encapsulation header included. Up to three bytes at its end may be padding.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Payload<'a> {
    /// The whole value.
    Data(&'a [u8]),
    /// Only the key: the instance is disposed or unregistered.
    Key(&'a [u8]),
    /// No content; the inline QoS describes the change.
    None,
}

impl<'a> Payload<'a> {
    /// Returns the bytes of the value or key; empty for [`Self::None`].
    #[must_use]
    pub const fn bytes(self) -> &'a [u8] {
        match self {
            Self::Data(bytes) | Self::Key(bytes) => bytes,
            Self::None => &[],
        }
    }
}
