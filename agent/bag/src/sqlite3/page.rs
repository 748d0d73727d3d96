//! Pages of an sqlite3 file, and the tree of a table in them.

use std::collections::HashSet;
use std::fs::File;
use std::io;
use std::ops::ControlFlow;
use std::os::unix::fs::FileExt as _;

use super::row::{Row, varint};

/// Length of the header of the file, at the start of page 1.
const FILE_HEADER_LEN: usize = 100;
/// Kinds of a table's pages: interior and leaf.
const INTERIOR_PAGE: u8 = 5;
const LEAF_PAGE: u8 = 13;
/// Maximum depth of a tree; a file of 2^32 pages has less than 20.
const MAX_DEPTH: usize = 32;

/// An open file.
pub(super) struct Pages {
    file: File,
    page_size: usize,
    /// Number of bytes of each page that hold content.
    usable: usize,
    damaged: u64,
}

/// Called for each row with its number.
pub(super) type Visitor<'a> = dyn FnMut(i64, &Row<'_>) -> ControlFlow<()> + 'a;

impl Pages {
    pub(super) fn open(file: File) -> io::Result<Self> {
        let mut header = [0; FILE_HEADER_LEN];
        file.read_exact_at(&mut header, 0)?;
        let page_size = match u16_at(&header, 16) {
            Some(1) => 65_536,
            Some(size) if size >= 512 && size.is_power_of_two() => usize::from(size),
            _ => return Err(invalid("its page size is invalid")),
        };
        let [.., reserved] = header.get(..21).unwrap_or_default() else {
            return Err(invalid("its header is invalid"));
        };
        if u32_at(&header, 56) != Some(1) {
            return Err(invalid("its text is not UTF-8"));
        }
        Ok(Self {
            file,
            page_size,
            usable: page_size.saturating_sub(usize::from(*reserved)),
            damaged: 0,
        })
    }

    /// Returns the number of pages and rows that could not be read.
    pub(super) const fn damaged(&self) -> u64 {
        self.damaged
    }

    /// Visits the rows of the table with this root in their order, each up to `limit` bytes, until
    /// the visitor breaks.
    pub(super) fn visit(
        &mut self,
        root: u32,
        limit: usize,
        each: &mut Visitor<'_>,
    ) -> io::Result<()> {
        // One list per level on the path to the current page: the pages still to visit, the next
        // one last.
        let mut levels: Vec<Vec<u32>> = vec![vec![root]];
        let mut interior = HashSet::new();
        let mut leaves = 0_u64;
        let file_length = self.file.metadata()?.len();
        let most = file_length / self.page_size as u64 + 1;
        // The overflow pages of a damaged row may form a circle.
        let limit = limit.min(usize::try_from(file_length).unwrap_or(usize::MAX));
        let mut row = Vec::new();
        while let Some(level) = levels.last_mut() {
            let Some(number) = level.pop() else {
                levels.pop();
                continue;
            };
            let Some(page) = self.page(number)? else {
                self.damaged += 1;
                continue;
            };
            let start = if number == 1 { FILE_HEADER_LEN } else { 0 };
            match page.get(start) {
                // A page that occurs twice is damage.
                Some(&INTERIOR_PAGE) if levels.len() < MAX_DEPTH && interior.insert(number) => {
                    levels.push(children(&page, start));
                }
                Some(&LEAF_PAGE) if leaves < most => {
                    leaves += 1;
                    for cell in cells(&page, start, 8) {
                        match self.row(&page, cell, limit, &mut row) {
                            Some(id) if each(id, &Row::new(&row)).is_break() => return Ok(()),
                            Some(_) => {}
                            None => self.damaged += 1,
                        }
                    }
                }
                _ => self.damaged += 1,
            }
        }
        Ok(())
    }

    /// Reads a page; `None` beyond the end of the file.
    fn page(&self, number: u32) -> io::Result<Option<Vec<u8>>> {
        let Some(index) = number.checked_sub(1) else {
            return Ok(None);
        };
        let mut page = vec![0; self.page_size];
        let offset = u64::from(index) * self.page_size as u64;
        match self.file.read_exact_at(&mut page, offset) {
            Ok(()) => Ok(Some(page)),
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Reads the row of a cell into `row`, up to `limit` bytes. Returns its number.
    fn row(&self, page: &[u8], cell: usize, limit: usize, row: &mut Vec<u8>) -> Option<i64> {
        row.clear();
        let (length, rest) = varint(page.get(cell..self.usable)?)?;
        let (id, rest) = varint(rest)?;
        let length = usize::try_from(length).ok()?;
        // This is the rule of the file format for the part of a row that is in its first page.
        let most = self.usable.checked_sub(35)?;
        let local = if length <= most {
            length
        } else {
            let least = ((self.usable - 12) * 32 / 255).checked_sub(23)?;
            let part = least + (length - least) % (self.usable - 4);
            if part <= most { part } else { least }
        };
        let (content, rest) = rest.split_at_checked(local)?;
        row.extend_from_slice(content);
        let wanted = length.min(limit);
        let mut next = if local < length { u32_at(rest, 0)? } else { 0 };
        while row.len() < wanted {
            let page = self.page(next).ok()??;
            next = u32_at(&page, 0)?;
            let left = wanted - row.len();
            let content = page.get(4..self.usable)?;
            row.extend_from_slice(content.get(..left).unwrap_or(content));
        }
        row.truncate(wanted);
        Some(id)
    }
}

/// Returns the offsets of a page's cells; `header` is the length of the page's header.
fn cells(page: &[u8], start: usize, header: usize) -> impl Iterator<Item = usize> {
    let count = u16_at(page, start + 3).unwrap_or(0);
    let offset = move |index: u16| start + header + usize::from(index) * 2;
    (0..count).filter_map(move |index| u16_at(page, offset(index)).map(usize::from))
}

/// Returns the pages below an interior page, in reverse order.
fn children(page: &[u8], start: usize) -> Vec<u32> {
    let mut children: Vec<u32> = cells(page, start, 12)
        .filter_map(|cell| u32_at(page, cell))
        .collect();
    children.extend(u32_at(page, start + 8));
    children.reverse();
    children
}

fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    bytes
        .get(at..)?
        .first_chunk()
        .copied()
        .map(u16::from_be_bytes)
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    bytes
        .get(at..)?
        .first_chunk()
        .copied()
        .map(u32::from_be_bytes)
}

fn invalid(reason: &str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, reason)
}
