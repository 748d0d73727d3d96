//! Finds functions of a library in its symbol table, above all the function of Fast DDS that copies
//! a message into shared memory.
//!
//! The file is untrusted, because it may belong to a container. Every read is bounded, nothing is
//! mapped, and no more is allocated than the file holds. Only symbols, strings and loadable
//! segments of ELF64 for this machine are read (System V ABI, gABI chapters 4 and 5).

use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt as _;

use ros2probe_wire::{Cursor, Endianness, WireError};

use crate::functions::{BUFFER_LIST_PARAMETERS, CONTIGUOUS_PARAMETERS, FAST_DDS_COPY as FUNCTION};

const MACHINE: u16 = if cfg!(target_arch = "aarch64") {
    183
} else {
    62
};
const HEADER_LEN: usize = 64;
const SECTION_LEN: usize = 64;
const SEGMENT_LEN: usize = 56;
const SYMBOL_LEN: usize = 24;
const SYMBOL_TABLES: [u32; 2] = [DYNAMIC_SYMBOLS, SYMBOL_TABLE];
const SYMBOL_TABLE: u32 = 2;
const DYNAMIC_SYMBOLS: u32 = 11;
const LOADED_SEGMENT: u32 = 1;
const IS_FUNCTION: u8 = 2;
/// Maximum number of sections, and of segments, in a header table.
const MAX_ENTRIES: u16 = 1024;
/// Maximum size of a table, in bytes. Fast DDS has some ten thousand symbols with one or two
/// megabytes of names; with all debugging symbols, ten times that.
const MAX_TABLE: u64 = 16 << 20;
const MAX_NAMES: u64 = 32 << 20;
/// Maximum number of bytes of all symbols and names: one table of each kind of the maximum size.
const MAX_READ: u64 = 2 * (MAX_TABLE + MAX_NAMES);
/// Maximum length of a function's name that is compared, in bytes.
const MAX_NAME: usize = 512;
/// x86-64: `endbr64`, the landing pad of indirect calls. The kernel single-steps a breakpoint on
/// it, which is slow, but emulates the `push` that follows.
const ENDBR64: [u8; 4] = [0xf3, 0x0f, 0x1e, 0xfa];

/// How a library's function receives its message.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Form {
    /// The message is in one piece (Fast DDS 2.x).
    Whole,
    /// The message is in a list of buffers (Fast DDS 3.x).
    List,
}

impl Form {
    /// Returns the start of the mangled parameters.
    pub(crate) const fn parameters(self) -> &'static str {
        match self {
            Self::Whole => CONTIGUOUS_PARAMETERS,
            Self::List => BUFFER_LIST_PARAMETERS,
        }
    }
}

/// The probe's position in a library.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Entry {
    /// Offset of the instruction in the file.
    pub offset: u64,
    /// How the function receives its message.
    pub form: Form,
}

/// Why a library cannot be probed.
#[derive(Debug, thiserror::Error)]
pub enum LibraryError {
    /// The file cannot be read.
    #[error("it cannot be read")]
    Read(#[from] io::Error),
    /// A length or offset exceeds the file.
    #[error("not a library: {0}")]
    Malformed(WireError),
    /// The file is not ELF for this machine, or too large for a library.
    #[error("not a library for this machine")]
    Foreign,
    /// The library was built without symbols, or the function has another name.
    #[error(
        "it has no symbol SharedMemTransport::copy_to_shared_buffer of Fast DDS 2.x or 3.x: use an \
         unstripped library"
    )]
    NoSymbol,
}

/// Converts the error of a parser over bytes in memory.
impl From<WireError> for LibraryError {
    fn from(error: WireError) -> Self {
        Self::Malformed(error)
    }
}

/// Offset and size of a table in the file.
#[derive(Clone, Copy)]
struct Section {
    kind: u32,
    offset: u64,
    size: u64,
    link: u32,
}

/// A part of the file that is loaded at an address.
struct Segment {
    kind: u32,
    offset: u64,
    address: u64,
    size: u64,
}

/// Finds the function that copies messages into shared memory.
///
/// # Errors
/// Fails if the file is malformed, or has no symbol of the function.
pub fn find(file: &File) -> Result<Entry, LibraryError> {
    let mut found = None;
    let header = visit(file, |name, address| {
        let parameters = name.strip_prefix(FUNCTION.as_bytes());
        let form = parameters.and_then(|parameters| match parameters {
            _ if parameters.starts_with(CONTIGUOUS_PARAMETERS.as_bytes()) => Some(Form::Whole),
            _ if parameters.starts_with(BUFFER_LIST_PARAMETERS.as_bytes()) => Some(Form::List),
            _ => None,
        });
        found = found.or(form.map(|form| (address, form)));
    })?;
    let (address, form) = found.ok_or(LibraryError::NoSymbol)?;
    let offset = place(file, &header, address)?;
    Ok(Entry { offset, form })
}

/// Returns the offset in the file of each function of these names, in the same order; `None` for a
/// function that does not exist.
///
/// # Errors
/// Fails if the file is malformed.
pub fn functions(file: &File, names: &[&str]) -> Result<Vec<Option<u64>>, LibraryError> {
    let mut found = vec![None; names.len()];
    let header = visit(file, |name, address| {
        let name = name.split(|byte| *byte == 0).next().unwrap_or_default();
        let index = names.iter().position(|each| each.as_bytes() == name);
        if let Some(found) = index.and_then(|index| found.get_mut(index)) {
            *found = Some(address);
        }
    })?;
    let offsets = found.into_iter().map(|address| {
        let offset = address.map(|address| place(file, &header, address));
        offset.transpose()
    });
    offsets.collect()
}

/// Calls `with` for each function of a library, with the bytes that begin with its name, and its
/// address.
fn visit(file: &File, mut with: impl FnMut(&[u8], u64)) -> Result<Header, LibraryError> {
    let bytes: [u8; HEADER_LEN] = array(file, 0)?;
    let header = Header::read(&bytes)?;
    let sections = table(file, header.sections, header.section_count, SECTION_LEN)?;
    let (sections, _) = sections.as_chunks::<SECTION_LEN>();
    let sections = sections
        .iter()
        .map(|bytes| section(bytes))
        .collect::<Result<Vec<_>, _>>()?;
    let mut left = MAX_READ;
    // A stripped library has only the first kind, which is sufficient.
    for kind in SYMBOL_TABLES {
        let tables = sections.iter().filter(|section| section.kind == kind);
        for symbols in tables {
            let names = usize::try_from(symbols.link).ok();
            let Some(names) = names.and_then(|index| sections.get(index)) else {
                continue;
            };
            let needed = symbols.size.saturating_add(names.size);
            left = left.checked_sub(needed).ok_or(LibraryError::Foreign)?;
            search(file, symbols, names, &mut with)?;
        }
    }
    Ok(header)
}

/// Positions of the tables, from the file header.
struct Header {
    segments: u64,
    segment_count: u16,
    sections: u64,
    section_count: u16,
}

impl Header {
    fn read(bytes: &[u8]) -> Result<Self, LibraryError> {
        // The magic is followed by the codes for 64 bits and little-endian.
        if !bytes.starts_with(b"\x7fELF\x02\x01") {
            return Err(LibraryError::Foreign);
        }
        let mut cursor = Cursor::new(bytes, Endianness::Little);
        cursor.take("e_ident and e_type", 18)?;
        if cursor.u16("e_machine")? != MACHINE {
            return Err(LibraryError::Foreign);
        }
        cursor.take("e_version and e_entry", 12)?;
        let (segments, sections) = (cursor.u64("e_phoff")?, cursor.u64("e_shoff")?);
        cursor.take("e_flags and e_ehsize", 6)?;
        let segment_size = cursor.u16("e_phentsize")?;
        let segment_count = cursor.u16("e_phnum")?;
        let section_size = cursor.u16("e_shentsize")?;
        let section_count = cursor.u16("e_shnum")?;
        let is_known =
            usize::from(segment_size) == SEGMENT_LEN && usize::from(section_size) == SECTION_LEN;
        if !is_known || segment_count.max(section_count) > MAX_ENTRIES {
            return Err(LibraryError::Foreign);
        }
        Ok(Self {
            segments,
            segment_count,
            sections,
            section_count,
        })
    }
}

/// Calls `with` for each function in these symbols.
fn search(
    file: &File,
    symbols: &Section,
    names: &Section,
    with: &mut impl FnMut(&[u8], u64),
) -> Result<(), LibraryError> {
    if symbols.size > MAX_TABLE || names.size > MAX_NAMES {
        return Err(LibraryError::Foreign);
    }
    let symbols = part(file, symbols.offset, symbols.size)?;
    let names = part(file, names.offset, names.size)?;
    let (symbols, _) = symbols.as_chunks::<SYMBOL_LEN>();
    for bytes in symbols {
        let mut cursor = Cursor::new(bytes, Endianness::Little);
        let name = cursor.u32("st_name")?;
        let info = cursor.u8("st_info")?;
        cursor.take("st_other", 1)?;
        let section = cursor.u16("st_shndx")?;
        let address = cursor.u64("st_value")?;
        if info & 0xf != IS_FUNCTION || section == 0 {
            continue;
        }
        let name = usize::try_from(name).ok().and_then(|at| names.get(at..));
        if let Some(name) = name {
            // A name without an end must not cost the whole table for each symbol.
            with(name.get(..MAX_NAME).unwrap_or(name), address);
        }
    }
    Ok(())
}

/// Returns the file offset of the code loaded at this address, after a landing pad.
fn place(file: &File, header: &Header, address: u64) -> Result<u64, LibraryError> {
    let segments = table(file, header.segments, header.segment_count, SEGMENT_LEN)?;
    let (segments, _) = segments.as_chunks::<SEGMENT_LEN>();
    for bytes in segments {
        let segment = segment(bytes)?;
        let within = address.checked_sub(segment.address);
        let Some(within) = within.filter(|within| *within < segment.size) else {
            continue;
        };
        if segment.kind != LOADED_SEGMENT {
            continue;
        }
        let offset = segment.offset.checked_add(within);
        let offset = offset.ok_or(LibraryError::Foreign)?;
        let first: [u8; ENDBR64.len()] = array(file, offset)?;
        return Ok(if first == ENDBR64 {
            offset + ENDBR64.len() as u64
        } else {
            offset
        });
    }
    Err(LibraryError::Foreign)
}

fn section(bytes: &[u8]) -> Result<Section, LibraryError> {
    let mut cursor = Cursor::new(bytes, Endianness::Little);
    cursor.take("sh_name", 4)?;
    let kind = cursor.u32("sh_type")?;
    cursor.take("sh_flags and sh_addr", 16)?;
    Ok(Section {
        kind,
        offset: cursor.u64("sh_offset")?,
        size: cursor.u64("sh_size")?,
        link: cursor.u32("sh_link")?,
    })
}

fn segment(bytes: &[u8]) -> Result<Segment, LibraryError> {
    let mut cursor = Cursor::new(bytes, Endianness::Little);
    let kind = cursor.u32("p_type")?;
    cursor.take("p_flags", 4)?;
    let (offset, address) = (cursor.u64("p_offset")?, cursor.u64("p_vaddr")?);
    cursor.take("p_paddr", 8)?;
    Ok(Segment {
        kind,
        offset,
        address,
        size: cursor.u64("p_filesz")?,
    })
}

fn table(file: &File, offset: u64, count: u16, size: usize) -> Result<Vec<u8>, LibraryError> {
    part(file, offset, u64::from(count) * size as u64)
}

/// Reads a part of the file; the caller has bounded `size`. Allocates nothing if the file is
/// shorter.
fn part(file: &File, offset: u64, size: u64) -> Result<Vec<u8>, LibraryError> {
    let end = offset.checked_add(size);
    if end.is_none_or(|end| end > file.metadata().map_or(0, |metadata| metadata.len())) {
        return Err(LibraryError::Foreign);
    }
    let mut bytes = vec![0; usize::try_from(size).map_err(|_| LibraryError::Foreign)?];
    file.read_exact_at(&mut bytes, offset)?;
    Ok(bytes)
}

fn array<const N: usize>(file: &File, offset: u64) -> Result<[u8; N], LibraryError> {
    let mut bytes = [0; N];
    match file.read_exact_at(&mut bytes, offset) {
        Ok(()) => Ok(bytes),
        Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Err(LibraryError::Foreign),
        Err(error) => Err(error.into()),
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::*;

    /// The end of the mangled name in a 2.x and in a 3.x library.
    const OF_2: &str = "PKhjRKNSt6chrono10time_pointE";
    const OF_3: &str = "RKSt6vectorINS1_13NetworkBufferESaIS4_EEjRKNSt6chronoE";

    /// Returns a library with one segment, loaded at 0x1000, whose first 0x200 bytes are tables.
    fn image(name: &str, code: &[u8]) -> Vec<u8> {
        let mut names = vec![0];
        names.extend(name.as_bytes());
        names.push(0);
        let mut bytes = b"\x7fELF\x02\x01\x01".to_vec();
        bytes.resize(16, 0);
        bytes.extend(3_u16.to_le_bytes());
        bytes.extend(MACHINE.to_le_bytes());
        bytes.extend([1, 0, 0, 0]);
        bytes.extend([0; 8]);
        bytes.extend(64_u64.to_le_bytes());
        bytes.extend(128_u64.to_le_bytes());
        bytes.extend([0; 4]);
        for half in [64_u16, 56, 1, 64, 3, 0] {
            bytes.extend(half.to_le_bytes());
        }
        assert_eq!(bytes.len(), 64);
        for word in [1_u32, 5] {
            bytes.extend(word.to_le_bytes());
        }
        for long in [0x200_u64, 0x1200, 0x1200, 0x100, 0x100, 0x1000] {
            bytes.extend(long.to_le_bytes());
        }
        bytes.resize(128 + 64, 0);
        let mut section = |kind: u32, offset: u64, size: u64, link: u32| {
            bytes.extend([0; 4]);
            bytes.extend(kind.to_le_bytes());
            bytes.extend([0; 16]);
            bytes.extend(offset.to_le_bytes());
            bytes.extend(size.to_le_bytes());
            bytes.extend(link.to_le_bytes());
            bytes.extend([0; 20]);
        };
        section(DYNAMIC_SYMBOLS, 0x400, 48, 2);
        section(3, 0x500, names.len() as u64, 0);
        bytes.resize(0x240, 0);
        bytes.extend(code);
        bytes.resize(0x400 + 24, 0);
        bytes.extend(1_u32.to_le_bytes());
        bytes.extend([0x12, 0, 12, 0]);
        bytes.extend(0x1240_u64.to_le_bytes());
        bytes.extend([0; 8]);
        bytes.resize(0x500, 0);
        bytes.extend(names);
        bytes
    }

    fn found(bytes: &[u8]) -> Result<Entry, LibraryError> {
        let mut file = tempfile::tempfile().unwrap();
        file.write_all(bytes).unwrap();
        find(&file)
    }

    #[test]
    fn the_function_of_fast_dds_2_and_3_is_found_after_its_landing_pad() {
        for (parameters, form) in [(OF_2, Form::Whole), (OF_3, Form::List)] {
            let name = format!("{FUNCTION}{parameters}");
            let entry = |offset| Entry { offset, form };
            let plain = found(&image(&name, &[0x41, 0x54, 0x55, 0x53])).unwrap();
            assert_eq!(plain, entry(0x240));
            let landing = found(&image(&name, &ENDBR64)).unwrap();
            assert_eq!(landing, entry(0x244));
        }
    }

    #[test]
    fn a_library_without_the_function_is_rejected() {
        let newer = format!("{FUNCTION}RKNS1_10OtherThingE");
        for name in ["_ZN4sendE", &newer] {
            assert!(matches!(
                found(&image(name, &ENDBR64)),
                Err(LibraryError::NoSymbol)
            ));
        }
        assert!(matches!(found(b"#!/bin/sh"), Err(LibraryError::Foreign)));
    }

    #[test]
    fn a_truncated_file_is_an_error_and_a_corrupted_one_causes_no_panic() {
        let good = image(&format!("{FUNCTION}{OF_2}"), &ENDBR64);
        for length in (0..good.len()).step_by(7) {
            assert!(found(&good[..length]).is_err(), "{length}");
        }
        for at in 0..0x600.min(good.len()) {
            for value in [0, 0x7f, 0xff] {
                let mut bad = good.clone();
                bad[at] = value;
                let _ = found(&bad);
            }
        }
    }

    #[test]
    fn a_name_without_an_end_is_cut_to_the_maximum_length() {
        let mut file = tempfile::tempfile().unwrap();
        file.write_all(&image(&"x".repeat(50_000), &ENDBR64))
            .unwrap();
        let mut lengths = Vec::new();
        visit(&file, |name, _| lengths.push(name.len())).unwrap();
        assert_eq!(lengths, [MAX_NAME]);
    }

    #[test]
    fn tables_beyond_the_budget_of_bytes_are_rejected() {
        let mut bytes = image(&format!("{FUNCTION}{OF_2}"), &ENDBR64);
        let sections = bytes.len() as u64;
        bytes[40..48].copy_from_slice(&sections.to_le_bytes());
        bytes[60..62].copy_from_slice(&21_u16.to_le_bytes());
        let headers = (0..21).map(|number| match number {
            0 => (3_u32, 1_u64),
            _ => (SYMBOL_TABLE, MAX_TABLE),
        });
        for (kind, size) in headers {
            bytes.extend([0; 4]);
            bytes.extend(kind.to_le_bytes());
            bytes.extend([0; 24]);
            bytes.extend(size.to_le_bytes());
            bytes.extend([0; 24]);
        }
        let mut file = tempfile::tempfile().unwrap();
        file.write_all(&bytes).unwrap();
        file.set_len(2 * MAX_TABLE).unwrap();
        let mut symbols = 0;
        let visited = visit(&file, |_, _| symbols += 1);
        assert!(matches!(visited, Err(LibraryError::Foreign)));
    }

    #[test]
    fn the_function_is_found_in_the_installed_library_of_this_machine() {
        let directories = ["/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu"];
        let libraries = directories
            .iter()
            .map(|directory| format!("{directory}/libfastrtps.so"))
            .filter_map(|path| File::open(path).ok());
        for library in libraries {
            let entry = find(&library).unwrap();
            assert_eq!(entry.form, Form::Whole);
            assert!(entry.offset > 0x1000);
        }
    }
}
