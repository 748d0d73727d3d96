//! Writes zeros as the padding of a TypeObject, because its hash is that of zeros.
//!
//! Fast DDS 3 sends other bytes there: those that its buffer had before. The caller compares the
//! hash of the result, so the walk checks no value, only that the bytes do not end.

use super::{EK_COMPLETE, EK_MINIMAL, EQUIVALENCE_HASH, MAX_COLLECTIONS};

/// Returns the complete TypeObject, from its size on, with zeros as padding. Returns `None` if it
/// ends too early, or has a kind of type that a `.msg` file cannot define.
pub(super) fn zeroed(bytes: &[u8]) -> Option<Vec<u8>> {
    let mut object = Object {
        bytes: bytes.to_vec(),
        position: 0,
    };
    object.sized(Object::complete)?;
    Some(object.bytes)
}

struct Object {
    bytes: Vec<u8>,
    position: usize,
}

impl Object {
    fn complete(&mut self) -> Option<()> {
        self.skip(1)?;
        match self.u8()? {
            0x30 => self.alias(),
            0x40 => self.enumeration(),
            0x51 => self.structure(),
            _ => None,
        }
    }

    /// Passes a CompleteStructType (DDS-XTypes 1.3, 7.3.4.6).
    fn structure(&mut self) -> Option<()> {
        self.u16()?;
        self.sized(|header| {
            header.identifier(0)?;
            header.type_detail()
        })?;
        self.each(|member| {
            member.u32()?;
            member.u16()?;
            member.identifier(0)?;
            member.member_detail()
        })
    }

    fn alias(&mut self) -> Option<()> {
        self.u16()?;
        self.sized(Self::type_detail)?;
        self.sized(|body| {
            body.u16()?;
            body.identifier(0)?;
            body.annotations()
        })
    }

    fn enumeration(&mut self) -> Option<()> {
        self.u16()?;
        self.sized(|header| {
            header.u16()?;
            header.type_detail()
        })?;
        self.each(|literal| {
            literal.sized(|common| {
                common.u32()?;
                common.u16()
            })?;
            literal.member_detail()
        })
    }

    /// Passes a TypeIdentifier (7.3.4.2).
    fn identifier(&mut self, depth: usize) -> Option<()> {
        match self.u8()? {
            0x00..=0x11 => Some(()),
            kind @ 0x70..=0x73 => self.bound(kind),
            kind @ (0x80 | 0x81 | 0x90 | 0x91) if depth < MAX_COLLECTIONS => {
                self.skip(1)?;
                self.u16()?;
                let bounds = match kind & 0xf0 {
                    0x80 => 1,
                    _ => self.u32()?,
                };
                for _ in 0..bounds {
                    self.bound(kind)?;
                }
                self.identifier(depth + 1)
            }
            EK_MINIMAL | EK_COMPLETE => self.skip(EQUIVALENCE_HASH),
            _ => None,
        }
    }

    /// Passes a bound, which is large for odd kinds.
    fn bound(&mut self, kind: u8) -> Option<()> {
        if kind & 1 == 0 {
            return self.skip(1);
        }
        self.u32()?;
        Some(())
    }

    fn type_detail(&mut self) -> Option<()> {
        self.annotations()?;
        self.string()
    }

    fn member_detail(&mut self) -> Option<()> {
        self.string()?;
        self.annotations()
    }

    /// Passes `ann_builtin` and `ann_custom`. Padding within annotations stays as it is.
    fn annotations(&mut self) -> Option<()> {
        for _ in 0..2 {
            if self.u8()? != 0 {
                self.sized(|_| Some(()))?;
            }
        }
        Some(())
    }

    fn string(&mut self) -> Option<()> {
        let length = self.u32()?;
        self.skip(length)
    }

    /// Passes a sequence of elements with sizes.
    fn each(&mut self, element: impl Fn(&mut Self) -> Option<()>) -> Option<()> {
        self.sized(|all| {
            for _ in 0..all.u32()? {
                all.sized(&element)?;
            }
            Some(())
        })
    }

    /// Passes a size and the bytes that it counts.
    fn sized(&mut self, content: impl FnOnce(&mut Self) -> Option<()>) -> Option<()> {
        let size = self.u32()?;
        let end = self.position.checked_add(size)?;
        content(self)?;
        self.skip(end.checked_sub(self.position)?)
    }

    fn align(&mut self, alignment: usize) -> Option<()> {
        let start = self.position;
        self.position = start.next_multiple_of(alignment);
        self.bytes.get_mut(start..self.position)?.fill(0);
        Some(())
    }

    fn u8(&mut self) -> Option<u8> {
        let byte = *self.bytes.get(self.position)?;
        self.position += 1;
        Some(byte)
    }

    fn u16(&mut self) -> Option<()> {
        self.align(2)?;
        self.skip(2)
    }

    fn u32(&mut self) -> Option<usize> {
        self.align(4)?;
        let number = *self.bytes.get(self.position..)?.first_chunk::<4>()?;
        self.position += number.len();
        usize::try_from(u32::from_le_bytes(number)).ok()
    }

    fn skip(&mut self, count: usize) -> Option<()> {
        self.position = self.position.checked_add(count)?;
        (self.position <= self.bytes.len()).then_some(())
    }
}
