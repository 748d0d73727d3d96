//! What a DATA carries behind its inline QoS (RTPS 2.5, 9.4.5.4).

/// What a change carries, encapsulation header included; up to three bytes of it may be padding.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Payload<'a> {
    /// The whole value.
    Data(&'a [u8]),
    /// Its key only: the instance is disposed or unregistered.
    Key(&'a [u8]),
    /// Nothing; what there is to know stands in the inline QoS.
    None,
}

impl<'a> Payload<'a> {
    /// The bytes, whatever they are; empty for none.
    #[must_use]
    pub const fn bytes(self) -> &'a [u8] {
        match self {
            Self::Data(bytes) | Self::Key(bytes) => bytes,
            Self::None => &[],
        }
    }
}
