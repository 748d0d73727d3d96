//! The part of ELF that shows whether a program needs other files (System V ABI, 64-bit,
//! little-endian).

use std::path::Path;

const PT_LOAD: u32 = 1;
const PT_DYNAMIC: u32 = 2;
const PT_INTERP: u32 = 3;
const PT_GNU_STACK: u32 = 0x6474_e551;
const PF_X: u32 = 1;
const DT_NEEDED: u64 = 1;

/// Value of `e_machine`.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Machine(u16);

impl Machine {
    pub const X86_64: Self = Self(62);
    pub const AARCH64: Self = Self(183);
}

/// An executable file.
pub struct Elf(Vec<u8>);

/// A program header.
struct Segment {
    kind: u32,
    flags: u32,
    offset: u64,
    size: u64,
    alignment: u64,
}

impl Elf {
    pub fn read(path: &Path) -> Self {
        let bytes =
            std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        // The file is 64-bit and little-endian.
        assert_eq!(bytes[..6], [0x7f, b'E', b'L', b'F', 2, 1]);
        Self(bytes)
    }

    pub fn machine(&self) -> Machine {
        Machine(self.number(18, 2) as u16)
    }

    pub fn has_interpreter(&self) -> bool {
        self.of_kind(PT_INTERP).next().is_some()
    }

    /// Returns the number of shared libraries that the program needs.
    pub fn needed(&self) -> usize {
        let dynamic = self.of_kind(PT_DYNAMIC);
        let tags = dynamic
            .flat_map(|segment| (0..segment.size / 16).map(move |at| segment.offset + at * 16));
        tags.filter(|at| self.number(*at, 8) == DT_NEEDED).count()
    }

    pub fn has_executable_stack(&self) -> bool {
        self.of_kind(PT_GNU_STACK)
            .all(|stack| stack.flags & PF_X != 0)
    }

    pub fn load_alignments(&self) -> Vec<u64> {
        self.of_kind(PT_LOAD)
            .map(|segment| segment.alignment)
            .collect()
    }

    fn of_kind(&self, kind: u32) -> impl Iterator<Item = Segment> + '_ {
        let (start, size, count) = (self.number(32, 8), self.number(54, 2), self.number(56, 2));
        let segments = (0..count).map(move |index| {
            let at = start + index * size;
            Segment {
                kind: self.number(at, 4) as u32,
                flags: self.number(at + 4, 4) as u32,
                offset: self.number(at + 8, 8),
                size: self.number(at + 32, 8),
                alignment: self.number(at + 48, 8),
            }
        });
        segments.filter(move |segment| segment.kind == kind)
    }

    fn number(&self, at: u64, bytes: usize) -> u64 {
        let at = usize::try_from(at).unwrap();
        let mut number = [0; 8];
        number[..bytes].copy_from_slice(&self.0[at..at + bytes]);
        u64::from_le_bytes(number)
    }
}
