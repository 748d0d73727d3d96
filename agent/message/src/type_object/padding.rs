//! Writes zeros as the padding of a TypeObject, because its hash is that of zeros.
//!
//! Fast DDS 3 sends other bytes there: those that its buffer had before. The caller compares the
//! hash of the result, so the walk checks no value, only that the bytes do not end.

use super::{EK_COMPLETE, EK_MINIMAL, EQUIVALENCE_HASH, MAX_COLLECTIONS};

/// Length of a `NameHash`, in bytes.
const NAME_HASH: usize = 4;

/// Returns the complete TypeObject, from its size on, with zeros as padding. Returns `None` if it
/// ends too early, or has another kind of type.
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
            0x41 => self.sized(Self::bitmask),
            0x51 => self.structure(),
            0x52 => self.union_type(),
            0x53 => self.sized(Self::bitset),
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
            body.member_annotations()
        })
    }

    fn enumeration(&mut self) -> Option<()> {
        self.u16()?;
        self.sized(Self::bounded_header)?;
        self.each(|literal| {
            literal.sized(|common| {
                common.u32()?;
                common.u16()
            })?;
            literal.member_detail()
        })
    }

    fn bitmask(&mut self) -> Option<()> {
        self.u16()?;
        self.sized(Self::bounded_header)?;
        self.each(|flag| {
            flag.u16()?;
            flag.u16()?;
            flag.member_detail()
        })
    }

    fn bitset(&mut self) -> Option<()> {
        self.u16()?;
        self.sized(Self::type_detail)?;
        self.each(|field| {
            field.u16()?;
            field.u16()?;
            field.skip(2)?;
            field.member_detail()
        })
    }

    fn union_type(&mut self) -> Option<()> {
        self.u16()?;
        self.sized(Self::type_detail)?;
        self.sized(|discriminator| {
            discriminator.u16()?;
            discriminator.identifier(0)?;
            discriminator.type_annotations()
        })?;
        self.each(|member| {
            member.u32()?;
            member.u16()?;
            member.identifier(0)?;
            let labels = member.u32()?;
            member.words(labels)?;
            member.member_detail()
        })
    }

    /// Passes the header of an enumeration or a bitmask: its size in bits, and its name.
    fn bounded_header(&mut self) -> Option<()> {
        self.u16()?;
        self.type_detail()
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
        self.type_annotations()?;
        self.string()
    }

    fn member_detail(&mut self) -> Option<()> {
        self.string()?;
        self.member_annotations()
    }

    /// Passes the annotations of a type: `@verbatim`, and those of users.
    fn type_annotations(&mut self) -> Option<()> {
        self.annotations(|builtin| {
            builtin.optional(|verbatim| {
                verbatim.string()?;
                verbatim.string()?;
                verbatim.string()
            })
        })
    }

    /// Passes the annotations of a member: `@unit`, `@min`, `@max`, `@hashid`, and those of users.
    fn member_annotations(&mut self) -> Option<()> {
        self.annotations(|builtin| {
            builtin.optional(Self::string)?;
            builtin.optional(Self::value)?;
            builtin.optional(Self::value)?;
            builtin.optional(Self::string)
        })
    }

    fn annotations(&mut self, builtin: impl FnOnce(&mut Self) -> Option<()>) -> Option<()> {
        self.optional(|all| all.sized(builtin))?;
        self.optional(|all| {
            all.each(|annotation| {
                annotation.identifier(0)?;
                annotation.optional(|parameters| {
                    parameters.each(|parameter| {
                        parameter.skip(NAME_HASH)?;
                        parameter.value()
                    })
                })
            })
        })
    }

    /// Passes an AnnotationParameterValue (7.3.4.5). Unknown kinds have a size.
    fn value(&mut self) -> Option<()> {
        match self.u8()? {
            0x01 | 0x02 | 0x0c | 0x0d | 0x10 => self.skip(1),
            0x03 | 0x06 | 0x11 => self.u16(),
            0x04 | 0x07 | 0x09 | 0x40 => self.words(1),
            0x05 | 0x08 | 0x0a => self.words(2),
            0x0b => self.words(4),
            0x20 | 0x21 => self.string(),
            _ => self.sized(|_| Some(())),
        }
    }

    fn optional(&mut self, content: impl FnOnce(&mut Self) -> Option<()>) -> Option<()> {
        match self.u8()? {
            0 => Some(()),
            _ => content(self),
        }
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

    /// Passes numbers of four bytes.
    fn words(&mut self, count: usize) -> Option<()> {
        for _ in 0..count {
            self.u32()?;
        }
        Some(())
    }

    fn skip(&mut self, count: usize) -> Option<()> {
        self.position = self.position.checked_add(count)?;
        (self.position <= self.bytes.len()).then_some(())
    }
}
