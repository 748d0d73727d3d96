//! Wire expressions: keys, abbreviated by the aliases of a connection (`zenoh-protocol`,
//! `core/wire_expr.rs`).

use crate::cursor::WireError;

use super::reader::Reader;

/// The side of a connection whose table of aliases a wire expression refers to.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Mapping {
    /// The sender of the message declared the alias.
    Sender,
    /// The receiver of the message declared the alias.
    Receiver,
}

/// A key or an alias with the rest of a key.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct WireExpr<'a> {
    /// Id of the alias; 0 for none.
    pub scope: u16,
    /// Rest of the key after the alias's key; the whole key without an alias.
    pub suffix: &'a str,
    /// The side that declared the alias.
    pub mapping: Mapping,
}

impl<'a> WireExpr<'a> {
    /// Returns the key if the expression has no alias.
    #[must_use]
    pub const fn key(&self) -> Option<&'a str> {
        if self.scope == 0 {
            Some(self.suffix)
        } else {
            None
        }
    }

    /// Reads an expression with the flags N (a suffix follows) and M (the sender declared the
    /// alias).
    pub(super) fn read(
        reader: &mut Reader<'a>,
        is_named: bool,
        is_senders: bool,
    ) -> Result<Self, WireError> {
        Ok(Self {
            scope: reader.number("scope of a key")?,
            suffix: if is_named {
                reader.text("suffix of a key", u64::from(u16::MAX))?
            } else {
                ""
            },
            mapping: Mapping::of(is_senders),
        })
    }

    /// Reads an expression after a header with the flags N 0x20 and M 0x40.
    pub(super) fn behind(header: u8, reader: &mut Reader<'a>) -> Result<Self, WireError> {
        Self::read(reader, header & 0x20 != 0, header & 0x40 != 0)
    }

    /// Reads the extension of an undeclaration: flags, scope, and the suffix up to the end.
    pub(super) fn extension(mut value: Reader<'a>) -> Result<Self, WireError> {
        let flags = value.u8("flags of a key")?;
        let scope = value.number("scope of a key")?;
        let rest = value.take("suffix of a key", value.rest().length)?;
        let suffix = if flags & 1 == 0 { &[] } else { rest };
        let bad = value.error("suffix of a key", crate::Reason::BadText);
        Ok(Self {
            scope,
            suffix: str::from_utf8(suffix).map_err(|_| bad)?,
            mapping: Mapping::of(flags & 2 != 0),
        })
    }
}

impl Mapping {
    const fn of(is_senders: bool) -> Self {
        if is_senders {
            Self::Sender
        } else {
            Self::Receiver
        }
    }
}
