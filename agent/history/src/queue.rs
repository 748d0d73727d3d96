//! A queue on disk: records wait in it until a receiver has them, also across restarts.

use std::collections::VecDeque;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use crate::block::{Block, Kind};
use crate::file::{Blocks, FIRST_PLACE, Reader};
use crate::store::prepare;

/// A file ends after this part of the limit, so that deleting one loses few records.
const FILES_PER_LIMIT: u64 = 32;
/// Maximum number of files. The oldest of more is deleted.
const MAX_FILES: usize = 256;
/// Ending of the names of files.
const FILE_EXTENSION: &str = "queue";
/// Name of the file with the place of the oldest waiting record.
const PLACE_FILE: &str = "place";

/// A bounded queue of records in a directory, the oldest first.
///
/// Its files consist of blocks with a checksum, as those of a [`Store`](crate::Store); a damaged
/// one is skipped. A record may depend on the earlier ones of its file, so [`Self::read`] begins
/// with the first record of a file. After a crash, records that were just removed may wait again.
/// [`Self::settle`] notes how much of a record is delivered.
#[derive(Debug)]
pub struct Queue {
    directory: PathBuf,
    /// Maximum size of all files, in bytes.
    limit: u64,
    files: VecDeque<Numbered>,
    /// Number of the next file.
    next: u32,
    /// Whether the last file may be continued: this process began it.
    continues: bool,
    /// Oldest waiting record, and the next one to read.
    waiting: Place,
    reading: Place,
    /// The record that was read last.
    last_read: Place,
    /// How much of the oldest waiting record is settled.
    settled: u64,
}

/// A record.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Record {
    /// Unix time in seconds, as it was appended.
    pub at: u32,
    /// Content.
    pub content: Vec<u8>,
    /// Whether it is the first record of its file.
    pub is_first: bool,
    /// Whether it waits; `false` for one that was removed, on which later ones may depend.
    pub is_waiting: bool,
    /// How much of it is settled, as [`Queue::settle`] noted.
    pub settled: u64,
}

/// Place of a record: number of the file, and bytes from its begin.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Place(u32, u64);

#[derive(Debug)]
struct Numbered {
    number: u32,
    blocks: Blocks,
}

impl Queue {
    /// Opens a directory with at most `limit` bytes. The first record creates it if it is missing.
    ///
    /// # Errors
    ///
    /// Fails if the directory cannot be read.
    pub fn open(directory: &Path, limit: u64) -> io::Result<Self> {
        let kept = read_place(directory);
        let (waiting, settled) = kept.unwrap_or((Place(0, 0), 0));
        let mut found = Vec::new();
        match fs::read_dir(directory) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            entries => {
                for entry in entries? {
                    let path = entry?.path();
                    found.extend(number_of(&path).map(|number| (number, path)));
                }
            }
        }
        found.sort();
        let next = found
            .last()
            .map_or(0, |(number, _)| number.saturating_add(1));
        let (delivered, left) = found
            .into_iter()
            .partition::<Vec<_>, _>(|(number, _)| *number < waiting.0);
        for (_, path) in delivered {
            let _ = fs::remove_file(path);
        }
        let files = left.into_iter().filter_map(|(number, path)| {
            let blocks = Blocks::open(&path)?;
            Some(Numbered { number, blocks })
        });
        let mut queue = Self {
            directory: directory.to_path_buf(),
            limit,
            files: files.collect(),
            // Records of a new file all wait, also if the kept place is after the end of its file.
            next: kept.map_or(next, |(kept, _)| next.max(kept.0.saturating_add(1))),
            continues: false,
            waiting,
            reading: Place(0, FIRST_PLACE),
            last_read: Place(0, 0),
            settled,
        };
        // All of the last file may have been delivered.
        queue.remove_read_files();
        Ok(queue)
    }

    /// Returns the size of all files, in bytes.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.files.iter().map(|file| file.blocks.length).sum()
    }

    /// Returns the number of the file of the record that was last read.
    #[must_use]
    pub const fn file_of_read(&self) -> u32 {
        self.reading.0
    }

    /// Returns whether the file with this number is still there.
    #[must_use]
    pub fn has_file(&self, number: u32) -> bool {
        self.files.iter().any(|file| file.number == number)
    }

    /// Returns whether no record waits.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.files.is_empty()
    }

    /// Returns whether the next record is the first of a file.
    #[must_use]
    pub fn begins_file(&self) -> bool {
        let last = self.files.back().filter(|_| self.continues);
        last.is_none_or(|last| last.blocks.length >= self.limit / FILES_PER_LIMIT)
    }

    /// Makes the next record the first of a file.
    pub fn begin_file(&mut self) {
        self.continues = false;
    }

    /// Appends a record. If the queue is full, this deletes the oldest file, and calls `lost` with
    /// each of its records that were not read yet.
    ///
    /// # Errors
    ///
    /// Fails if the record cannot be written, or if little space is free. The queue is as before.
    pub fn append(
        &mut self,
        at: u32,
        content: Vec<u8>,
        lost: &mut dyn FnMut(Record),
    ) -> io::Result<()> {
        prepare(&self.directory)?;
        let block = Block {
            kind: Kind::Queued,
            begin: at,
            end: at,
            content,
        };
        if self.begins_file() {
            let number = self.next;
            let path = self
                .directory
                .join(format!("{number:010}.{FILE_EXTENSION}"));
            let mut blocks = Blocks::create(path, at)?;
            let appended = blocks.append_durably(&[block]);
            // The power may fail at any time: the file's name must be on disk, too.
            let appended = appended.and_then(|()| fs::File::open(&self.directory)?.sync_all());
            if let Err(error) = appended {
                let _ = fs::remove_file(&blocks.path);
                return Err(error);
            }
            self.next = number.saturating_add(1);
            self.files.push_back(Numbered { number, blocks });
            self.continues = true;
        } else if let Some(last) = self.files.back_mut() {
            last.blocks.append_durably(&[block])?;
        }
        while self.files.len() > 1 && (self.bytes() > self.limit || self.files.len() > MAX_FILES) {
            self.lose_oldest(lost);
        }
        Ok(())
    }

    /// Returns the next record; `None` after the last one. After [`Self::open`] this begins with
    /// the first record of the oldest file, which may no longer wait.
    ///
    /// # Errors
    ///
    /// Fails if a file cannot be opened. The next call tries again.
    pub fn read(&mut self) -> io::Result<Option<Record>> {
        loop {
            let Some(front) = self.files.front() else {
                return Ok(None);
            };
            self.reading = self.reading.max(Place(front.number, FIRST_PLACE));
            let mut files = self.files.iter();
            let Some(of_reading) = files.find(|file| file.number >= self.reading.0) else {
                return Ok(None);
            };
            if of_reading.number > self.reading.0 {
                self.reading = Place(of_reading.number, FIRST_PLACE);
            }
            let is_last = Some(of_reading.number) == self.files.back().map(|file| file.number);
            let blocks = &of_reading.blocks;
            let reader = match Reader::open(&blocks.path, blocks.length) {
                Ok(reader) => Some(reader),
                // The file was deleted.
                Err(error) if error.kind() == io::ErrorKind::NotFound => None,
                Err(error) => return Err(error),
            };
            if let Some(mut reader) = reader {
                reader.place = self.reading.1;
                while let Some((header, place)) = reader.next() {
                    self.reading.1 = reader.place;
                    if let Some(block) = reader.block(&header, place) {
                        let of_record = Place(self.reading.0, place);
                        self.last_read = of_record;
                        return Ok(Some(Record {
                            at: block.end,
                            content: block.content,
                            is_first: place == FIRST_PLACE,
                            is_waiting: of_record >= self.waiting,
                            settled: match of_record == self.oldest_waiting() {
                                true => self.settled,
                                false => 0,
                            },
                        }));
                    }
                }
            }
            if is_last {
                return Ok(None);
            }
            self.reading = Place(self.reading.0.saturating_add(1), FIRST_PLACE);
        }
    }

    /// Reads the records that wait once more, from the oldest one on.
    pub fn rewind(&mut self) {
        self.reading = self.waiting;
    }

    /// Removes all records that were read.
    pub fn remove(&mut self) {
        self.wait_from(self.waiting.max(self.reading));
        self.remove_read_files();
        self.keep_place();
    }

    /// Notes how much of the record that was read last is settled, in a unit of the caller. Records
    /// before it no longer wait: they are damaged. The note lasts until the record is removed or lost.
    pub fn settle(&mut self, settled: u64) {
        self.wait_from(self.last_read);
        self.settled = settled;
        self.keep_place();
    }

    /// Writes the place of the oldest waiting record. Without this file, the records are delivered
    /// again after a restart.
    fn keep_place(&self) {
        let temporary = self.directory.join("place.new");
        let Place(file, place) = self.waiting;
        let text = match self.settled {
            0 => format!("{file} {place}\n"),
            settled => format!("{file} {place} {settled}\n"),
        };
        let written = fs::write(&temporary, text);
        let _ = written.and_then(|()| fs::rename(&temporary, self.directory.join(PLACE_FILE)));
    }

    /// Returns the place of the oldest waiting record.
    fn oldest_waiting(&self) -> Place {
        let Place(file, place) = self.waiting;
        Place(file, place.max(FIRST_PLACE))
    }

    /// Lets the records before a place no longer wait.
    fn wait_from(&mut self, place: Place) {
        if place > self.waiting {
            (self.waiting, self.settled) = (place, 0);
        }
    }

    /// Deletes the files without a waiting record.
    fn remove_read_files(&mut self) {
        while let Some(first) = self.files.front() {
            let end = Place(first.number, first.blocks.length);
            if self.waiting < end {
                break;
            }
            let after = Place(first.number.saturating_add(1), 0);
            let _ = fs::remove_file(&first.blocks.path);
            self.files.pop_front();
            self.wait_from(after);
        }
        if self.files.is_empty() {
            self.continues = false;
        }
    }

    fn lose_oldest(&mut self, lost: &mut dyn FnMut(Record)) {
        let Some(number) = self.files.front().map(|first| first.number) else {
            return;
        };
        let reached = self.reading;
        // The whole file is read, because a record may depend on earlier ones.
        self.reading = Place(number, FIRST_PLACE);
        while self.reading.0 == number {
            let place = self.reading;
            match self.read() {
                Ok(Some(mut record)) if self.reading.0 == number => {
                    record.is_waiting &= place >= reached;
                    lost(record);
                }
                _ => break,
            }
        }
        self.reading = reached.max(Place(number.saturating_add(1), FIRST_PLACE));
        self.wait_from(Place(number.saturating_add(1), 0));
        if let Some(first) = self.files.pop_front() {
            let _ = fs::remove_file(first.blocks.path);
        }
    }
}

/// Returns the place of the oldest waiting record and how much of it is settled, as
/// [`Queue::keep_place`] writes them.
fn read_place(directory: &Path) -> Option<(Place, u64)> {
    let text = fs::read_to_string(directory.join(PLACE_FILE)).ok()?;
    let mut numbers = text.split_whitespace();
    let file = numbers.next()?.parse().ok()?;
    let place = numbers.next()?.parse().ok()?;
    let settled = numbers.next().map_or(Ok(0), str::parse).ok()?;
    Some((Place(file, place), settled))
}

/// Returns the number of a file by its name; `None` for other files.
fn number_of(path: &Path) -> Option<u32> {
    let is_ours = path.extension()?.to_str()? == FILE_EXTENSION;
    path.file_stem()?.to_str()?.parse().ok().filter(|_| is_ours)
}
