//! Builds ports and segments in Fast DDS's layout for tests, from the writer's side.

use std::fs;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};

use super::cell::{Cell, Descriptor, SegmentId};

/// A port's file.
pub struct PortImage {
    number: u32,
    capacity: u32,
    bytes: Vec<u8>,
    cells: usize,
    ring: usize,
    file: Option<fs::File>,
}

/// A segment's file.
pub struct SegmentImage {
    id: SegmentId,
    bytes: Vec<u8>,
    used: usize,
    file: Option<fs::File>,
}

impl PortImage {
    /// Creates an empty ring of `capacity` cells, with PortNode at `node`.
    pub fn new(number: u32, capacity: u32, node: usize) -> Self {
        let (ring, cells) = (node + 64, node + 80);
        let mut image = Self {
            number,
            capacity,
            bytes: vec![0; cells + capacity as usize * Cell::LEN],
            cells,
            ring,
            file: None,
        };
        image.put(node + 12, cells as u32);
        image.put(node + 16, ring as u32);
        image.put(node + 20, number);
        image.put(node + 36, capacity);
        image.put(ring + 4, capacity);
        image.put(ring + 8, capacity);
        image.put(ring + 12, 1);
        image
    }

    /// Mirrors every change to a file.
    pub fn in_directory(mut self, directory: &Path) -> Self {
        let path = self.path(directory);
        fs::write(&path, &self.bytes).unwrap();
        self.file = Some(fs::File::options().write(true).open(path).unwrap());
        self
    }

    pub fn path(&self, directory: &Path) -> PathBuf {
        directory.join(format!("fastrtps_port{}", self.number))
    }

    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Pushes as Fast DDS does: first write_p, then the cell.
    pub fn push(&mut self, descriptor: Descriptor) {
        let index = self.begin_push();
        self.fill(index, descriptor);
    }

    /// Does the first half of a push: moves write_p.
    pub fn begin_push(&mut self) -> u32 {
        let write = self.word(self.ring);
        let (index, round) = (write & 0x7fff_ffff, write & 0x8000_0000);
        let next = match index + 1 {
            next if next == self.capacity => round ^ 0x8000_0000,
            next => round | next,
        };
        self.put(self.ring, next);
        index
    }

    /// Does the second half of a push: fills the cell.
    pub fn fill(&mut self, index: u32, descriptor: Descriptor) {
        let at = self.cells + index as usize * Cell::LEN;
        let [low, high] = [&descriptor.segment.0[..4], &descriptor.segment.0[4..]]
            .map(|half| u32::from_le_bytes(half.try_into().unwrap()));
        for (at, word) in [
            (at + 4, low),
            (at + 8, high),
            (at + 12, descriptor.node),
            (at + 16, descriptor.validity),
            (at, 1),
        ] {
            self.put(at, word);
        }
    }

    /// Marks every message as read by all listeners.
    pub fn pop_all(&mut self) {
        for index in 0..self.capacity {
            self.put(self.cells + index as usize * Cell::LEN, 0);
        }
    }

    pub fn set_write(&mut self, word: u32) {
        self.put(self.ring, word);
    }

    fn word(&self, at: usize) -> u32 {
        u32::from_le_bytes(self.bytes[at..at + 4].try_into().unwrap())
    }

    fn put(&mut self, at: usize, word: u32) {
        put(&mut self.bytes, self.file.as_ref(), at, &word.to_le_bytes());
    }
}

impl SegmentImage {
    /// Creates an empty segment.
    pub fn new(id: [u8; 8], length: usize) -> Self {
        Self {
            id: SegmentId(id),
            bytes: vec![0; length],
            used: 0x100,
            file: None,
        }
    }

    /// Mirrors every change to a file.
    pub fn in_directory(mut self, directory: &Path) -> Self {
        let path = self.path(directory);
        fs::write(&path, &self.bytes).unwrap();
        self.file = Some(fs::File::options().write(true).open(path).unwrap());
        self
    }

    pub fn path(&self, directory: &Path) -> PathBuf {
        directory.join(format!("fastrtps_{}", self.id))
    }

    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Writes a message into a new buffer.
    pub fn put(&mut self, message: &[u8]) -> Descriptor {
        let (node, data, validity) = (self.used, self.used + 16, 1);
        self.used = (data + message.len()).next_multiple_of(16);
        self.write(data, message);
        self.write(node + 8, &(message.len() as u32).to_le_bytes());
        self.write(node + 12, &(data as u32).to_le_bytes());
        self.write(node, &u64::from(validity).to_le_bytes());
        Descriptor {
            segment: self.id,
            node: node as u32,
            validity,
        }
    }

    /// Frees the buffer of a message.
    pub fn free(&mut self, descriptor: Descriptor) {
        let next = u64::from(descriptor.validity) + 1;
        self.write(descriptor.node as usize, &next.to_le_bytes());
    }

    fn write(&mut self, at: usize, bytes: &[u8]) {
        put(&mut self.bytes, self.file.as_ref(), at, bytes);
    }
}

fn put(bytes: &mut [u8], file: Option<&fs::File>, at: usize, new: &[u8]) {
    bytes[at..at + new.len()].copy_from_slice(new);
    if let Some(file) = file {
        file.write_all_at(new, at as u64).unwrap();
    }
}
