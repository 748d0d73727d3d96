//! Layout of the running kernel's types: offsets of members, values of enumerators. They are read
//! from BTF (Documentation/bpf/btf.rst) in `/sys/kernel/btf/vmlinux`.
//!
//! The module only finds offsets, sizes and enumerators. Although the kernel provides the file,
//! every read is bounded, and unreadable content is an error. Kernels differ, so the caller handles
//! missing members.

use std::io;

/// File with the kernel's types.
const BTF_PATH: &str = "/sys/kernel/btf/vmlinux";
const BTF_MAGIC: u32 = 0xeb9f;
/// Maximum nesting depth of anonymous structures and unions that a search enters.
const MAX_DEPTH: u32 = 8;

/// Kinds of types.
mod kind {
    pub(super) const INT: u32 = 1;
    pub(super) const ARRAY: u32 = 3;
    pub(super) const STRUCT: u32 = 4;
    pub(super) const UNION: u32 = 5;
    pub(super) const ENUM: u32 = 6;
    pub(super) const FUNC_PROTO: u32 = 13;
    pub(super) const VAR: u32 = 14;
    pub(super) const DATASEC: u32 = 15;
    pub(super) const DECL_TAG: u32 = 17;
    pub(super) const ENUM64: u32 = 19;
}

/// Why the kernel's types are unknown.
#[derive(Debug, thiserror::Error)]
pub enum KernelTypesError {
    /// A kernel without CONFIG_DEBUG_INFO_BTF has no such file.
    #[error("cannot read the kernel's types from {BTF_PATH} (needs CONFIG_DEBUG_INFO_BTF)")]
    Unreadable(#[source] io::Error),
    /// The file is malformed.
    #[error("cannot parse the kernel's types ({BTF_PATH}) at byte {0}")]
    Malformed(usize),
}

/// The kernel's types, as bytes with an index.
pub struct KernelTypes {
    bytes: Vec<u8>,
    /// Offset in `bytes` of each type, starting with id 1.
    types: Vec<usize>,
    /// Start and end offset of the strings in `bytes`.
    strings: (usize, usize),
}

/// The first three words of a type.
#[derive(Clone, Copy)]
struct Head {
    at: usize,
    name: u32,
    info: u32,
    /// Size in bytes, or the id of another type, by kind.
    size: u32,
}

impl Head {
    const LEN: usize = 12;

    fn kind(self) -> u32 {
        self.info >> 24 & 0x1f
    }

    /// Returns the number of members, enumerators or parameters that follow.
    fn count(self) -> usize {
        (self.info & 0xffff) as usize
    }

    /// Returns whether bit offsets of members are combined with the size of a bit field.
    fn has_bit_fields(self) -> bool {
        self.info >> 31 == 1
    }

    /// Returns the number of bytes that follow the head; `None` for an unknown kind.
    fn tail(self) -> Option<usize> {
        let count = self.count();
        Some(match self.kind() {
            kind::INT | kind::VAR | kind::DECL_TAG => 4,
            kind::ARRAY => 12,
            kind::STRUCT | kind::UNION | kind::DATASEC | kind::ENUM64 => 12 * count,
            kind::ENUM | kind::FUNC_PROTO => 8 * count,
            // Pointers, forward declarations, aliases, qualifiers, functions, floats, tags.
            2 | 7..=12 | 16 | 18 => 0,
            _ => return None,
        })
    }
}

impl KernelTypes {
    /// Reads the types of the running kernel.
    ///
    /// # Errors
    /// Fails if the kernel provides no types, or if the file is malformed.
    pub fn read() -> Result<Self, KernelTypesError> {
        Self::parse(std::fs::read(BTF_PATH).map_err(KernelTypesError::Unreadable)?)
    }

    /// Parses the bytes of a BTF file.
    ///
    /// # Errors
    /// Returns [`KernelTypesError::Malformed`] if they are malformed.
    pub fn parse(bytes: Vec<u8>) -> Result<Self, KernelTypesError> {
        let malformed = KernelTypesError::Malformed;
        let header = |index: usize| word(&bytes, 4 * index).ok_or(malformed(4 * index));
        if header(0)? & 0xffff != BTF_MAGIC {
            return Err(malformed(0));
        }
        let header_len = header(1)? as usize;
        let section = |index: usize| -> Result<(usize, usize), KernelTypesError> {
            let start = header_len.saturating_add(header(index)? as usize);
            let end = start.saturating_add(header(index + 1)? as usize);
            if end > bytes.len() {
                return Err(malformed(4 * index));
            }
            Ok((start, end))
        };
        let (mut at, end) = section(2)?;
        let strings = section(4)?;
        let mut types = Vec::new();
        while at < end {
            let head = head(&bytes, at).ok_or(malformed(at))?;
            types.push(at);
            at += Head::LEN + head.tail().ok_or(malformed(at))?;
        }
        Ok(Self {
            bytes,
            types,
            strings,
        })
    }

    /// Returns the byte offset of a member in `structure`. Dots separate nested members:
    /// `__sk_common.skc_cookie`. Returns `None` if the member does not exist or is a bit field.
    #[must_use]
    pub fn offset(&self, structure: &str, member: &str) -> Option<u32> {
        self.named(structure, &[kind::STRUCT, kind::UNION])
            .find_map(|head| {
                let (mut head, mut bits) = (head, 0);
                let mut parts = member.split('.').peekable();
                while let Some(part) = parts.next() {
                    let (offset, of_type) = self.member(head, part, MAX_DEPTH)?;
                    bits += offset;
                    if parts.peek().is_some() {
                        head = self.by_id(of_type)?;
                    }
                }
                (bits % 8 == 0).then_some(bits / 8)
            })
    }

    /// Returns the size of a structure in bytes; `None` if the kernel does not have it.
    #[must_use]
    pub fn size(&self, structure: &str) -> Option<u32> {
        let head = self.named(structure, &[kind::STRUCT]).next()?;
        Some(head.size)
    }

    /// Returns the value of an enumerator; `None` if the kernel does not have it.
    #[must_use]
    pub fn enumerator(&self, enumeration: &str, name: &str) -> Option<u32> {
        self.named(enumeration, &[kind::ENUM]).find_map(|head| {
            (0..head.count()).find_map(|index| {
                let at = head.at + Head::LEN + 8 * index;
                let found = self.is_named(word(&self.bytes, at)?, name);
                found.then(|| word(&self.bytes, at + 4)).flatten()
            })
        })
    }

    /// Returns bit offset and type id of a member, searching anonymous structures and unions;
    /// `None` if none has this name.
    fn member(&self, of: Head, name: &str, depth: u32) -> Option<(u32, u32)> {
        (0..of.count()).find_map(|index| {
            let at = of.at + Head::LEN + 12 * index;
            let member_name = word(&self.bytes, at)?;
            let of_type = word(&self.bytes, at + 4)?;
            let mut offset = word(&self.bytes, at + 8)?;
            let mut bit_field = 0;
            if of.has_bit_fields() {
                (bit_field, offset) = (offset >> 24, offset & 0x00ff_ffff);
            }
            if member_name != 0 {
                let found = bit_field == 0 && self.is_named(member_name, name);
                return found.then_some((offset, of_type));
            }
            let inner = self.by_id(of_type)?;
            if depth == 0 || !matches!(inner.kind(), kind::STRUCT | kind::UNION) {
                return None;
            }
            let (inside, of_type) = self.member(inner, name, depth - 1)?;
            Some((offset + inside, of_type))
        })
    }

    fn named<'a>(&'a self, name: &'a str, kinds: &'a [u32]) -> impl Iterator<Item = Head> + 'a {
        self.types
            .iter()
            .filter_map(|at| head(&self.bytes, *at))
            .filter(|head| kinds.contains(&head.kind()) && self.is_named(head.name, name))
    }

    fn by_id(&self, id: u32) -> Option<Head> {
        let index = usize::try_from(id).ok()?.checked_sub(1)?;
        head(&self.bytes, *self.types.get(index)?)
    }

    fn is_named(&self, name: u32, wanted: &str) -> bool {
        let (start, end) = self.strings;
        let strings = self.bytes.get(start..end).unwrap_or(&[]);
        strings
            .get(name as usize..)
            .and_then(|tail| tail.strip_prefix(wanted.as_bytes()))
            .is_some_and(|rest| rest.first() == Some(&0))
    }
}

fn head(bytes: &[u8], at: usize) -> Option<Head> {
    Some(Head {
        at,
        name: word(bytes, at)?,
        info: word(bytes, at + 4)?,
        size: word(bytes, at + 8)?,
    })
}

/// Reads a word in the kernel's own byte order, in which BTF is written; `None` beyond the end.
fn word(bytes: &[u8], at: usize) -> Option<u32> {
    let bytes = bytes.get(at..)?.first_chunk()?;
    Some(u32::from_ne_bytes(*bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    const NAMES: &str = "\0sock\0common\0cookie\0inner\0reason\0DROPPED\0flag\0";

    fn name(of: &str) -> u32 {
        let at = NAMES.find(&format!("\0{of}\0")).unwrap();
        u32::try_from(at + 1).unwrap()
    }

    /// `struct sock { struct common inner; union { struct { u32 flag:1; u64 cookie; }; }; }`, an
    /// enumeration, and an integer.
    fn types() -> Vec<u8> {
        let structure =
            |kind: u32, bit_fields: u32, count: u32| bit_fields << 31 | kind << 24 | count;
        let words = [
            vec![
                name("reason"),
                structure(kind::ENUM, 0, 1),
                4,
                name("DROPPED"),
                77,
            ],
            vec![
                name("common"),
                structure(kind::STRUCT, 0, 1),
                16,
                name("cookie"),
                3,
                64,
            ],
            vec![0, kind::INT << 24, 8, 0],
            vec![
                name("sock"),
                structure(kind::STRUCT, 0, 2),
                40,
                name("inner"),
                2,
                128,
                0,
                5,
                256,
            ],
            vec![0, structure(kind::UNION, 0, 1), 16, 0, 6, 0],
            vec![
                0,
                structure(kind::STRUCT, 1, 2),
                16,
                name("flag"),
                3,
                1 << 24,
                name("cookie"),
                3,
                64,
            ],
        ]
        .concat();
        let len = u32::try_from(4 * words.len()).unwrap();
        let strings = u32::try_from(NAMES.len()).unwrap();
        let header = [BTF_MAGIC | 1 << 16, 24, 0, len, len, strings];
        let words = header.iter().chain(&words);
        let mut bytes: Vec<u8> = words.flat_map(|word| word.to_ne_bytes()).collect();
        bytes.extend_from_slice(NAMES.as_bytes());
        bytes
    }

    #[test]
    fn members_are_found_by_path_and_inside_anonymous_members() {
        let types = KernelTypes::parse(types()).unwrap();
        assert_eq!(types.offset("common", "cookie"), Some(8));
        assert_eq!(types.offset("sock", "inner"), Some(16));
        assert_eq!(types.offset("sock", "inner.cookie"), Some(24));
        assert_eq!(types.offset("sock", "cookie"), Some(40));
        assert_eq!(types.size("sock"), Some(40));
        assert_eq!(types.enumerator("reason", "DROPPED"), Some(77));
    }

    #[test]
    fn missing_members_and_bit_fields_have_no_offset() {
        let types = KernelTypes::parse(types()).unwrap();
        assert_eq!(types.offset("sock", "flag"), None);
        assert_eq!(types.offset("sock", "cook"), None);
        assert_eq!(types.offset("sock", "inner.flag"), None);
        assert_eq!(types.offset("so", "inner"), None);
        assert_eq!(types.enumerator("reason", "DROP"), None);
        assert_eq!(types.enumerator("sock", "DROPPED"), None);
        assert_eq!(types.size("missing"), None);
    }

    #[test]
    fn a_truncated_or_corrupted_file_never_causes_a_panic() {
        let whole = types();
        for end in 0..whole.len() {
            assert!(KernelTypes::parse(whole[..end].to_vec()).is_err(), "{end}");
        }
        for at in 0..whole.len() {
            let mut changed = whole.clone();
            changed[at] ^= 0xff;
            if let Ok(types) = KernelTypes::parse(changed) {
                let _ = types.offset("sock", "inner.cookie");
                let _ = types.offset("sock", "cookie");
                let _ = types.enumerator("reason", "DROPPED");
            }
        }
    }

    #[test]
    fn an_anonymous_type_that_contains_itself_ends_the_search() {
        let mut bytes = types();
        // The union's only member has the union's own type.
        let header = 24;
        let union = header + 4 * (5 + 6 + 4 + 9);
        bytes[union + 16..union + 20].copy_from_slice(&5_u32.to_ne_bytes());
        let types = KernelTypes::parse(bytes).unwrap();
        assert_eq!(types.offset("sock", "cookie"), None);
    }

    #[test]
    fn the_running_kernel_describes_a_socket_and_a_packet() {
        let Ok(types) = KernelTypes::read() else {
            return;
        };
        assert_eq!(types.offset("sock", "__sk_common"), Some(0));
        for (structure, member) in [
            ("sock", "__sk_common.skc_cookie"),
            ("sk_buff", "head"),
            ("sk_buff", "network_header"),
            ("task_struct", "tgid"),
        ] {
            assert!(
                types.offset(structure, member).is_some(),
                "{structure}.{member}"
            );
        }
    }
}
