//! The directory of files: three tiers, their budgets, and what is read from them.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::ops::Range;
use std::os::unix::fs::DirBuilderExt as _;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use crate::block::{Block, Header, Kind};
use crate::columns::{self, Name, Row};
use crate::documents::{Document, DocumentVersion, VersionReader, Versions};
use crate::file::{Blocks, FIRST_PLACE};
use crate::merge::{Merge, merge_by_name};
use crate::rows::{ProcessName, ProcessRow, Series, TopicName, TopicRow};

/// Step of the rows in [`Tier::Tens`], in seconds.
const TEN_SECONDS: u32 = 10;
/// Time of a block in [`Tier::Tens`], in seconds.
const WINDOW_SECONDS: u32 = 600;
/// Maximum number of these blocks that one call writes.
const MAX_WINDOWS: usize = 12;
/// A file ends after this part of its tier's budget, so that deleting one frees little history.
const FILES_PER_TIER: u64 = 24;
/// Maximum number of files of a tier. The oldest of more is deleted.
const MAX_FILES: usize = 256;
/// Free space below which nothing is written, in bytes. Other programs need the rest.
const MIN_FREE: u64 = 64 << 20;
/// File name extension.
const FILE_EXTENSION: &str = "history";
/// Maximum length of all documents of a time, in bytes, before they are compressed.
const MAX_DOCUMENT_BYTES: u64 = 4 << 20;

/// Resolution of rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tier {
    /// One row per second, and a state per minute.
    Seconds,
    /// One row per ten seconds, and a state per ten minutes.
    Tens,
    /// Documents.
    Documents,
}

/// History in a directory. Readers never wait for the writer.
#[derive(Debug)]
pub struct Store {
    directory: PathBuf,
    /// Maximum size of all files, in bytes.
    limit: u64,
    tiers: Mutex<[Vec<Blocks>; 3]>,
    /// Versions of the documents that were written last. Only the writer locks them.
    versions: Mutex<Versions>,
}

/// Times from which a tier has blocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Span {
    /// Unix time at which the oldest block begins.
    pub begin: u32,
    /// Unix time at which the latest block ends.
    pub end: u32,
}

/// Size and reach of a store.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Facts {
    /// Size of all files, in bytes.
    pub bytes: u64,
    /// Maximum size, in bytes.
    pub limit: u64,
    /// Reach of [`Tier::Seconds`]; `None` without a block.
    pub seconds: Option<Span>,
    /// Reach of [`Tier::Tens`]; `None` without a block.
    pub tens: Option<Span>,
    /// Reach of [`Tier::Documents`]; `None` without a block.
    pub documents: Option<Span>,
}

impl Tier {
    const ALL: [Self; 3] = [Self::Seconds, Self::Tens, Self::Documents];

    const fn name(self) -> &'static str {
        match self {
            Self::Seconds => "seconds",
            Self::Tens => "tens",
            Self::Documents => "documents",
        }
    }

    /// Returns the tier's part of a limit. With the default limit, each part is enough for the
    /// documented times of 200 topics.
    const fn budget(self, limit: u64) -> u64 {
        match self {
            Self::Seconds => limit / 24 * 13,
            Self::Tens => limit / 24 * 7,
            Self::Documents => limit / 24 * 4,
        }
    }

    /// Returns the time that one file covers at most, in seconds.
    const fn span(self) -> u32 {
        match self {
            Self::Seconds => 3_600,
            Self::Tens => 12 * 3_600,
            // A damaged block hides the changes until the next file.
            Self::Documents => 3 * 3_600,
        }
    }
}

impl Store {
    /// Opens a directory with at most `limit` bytes. The first write creates it if it is missing.
    ///
    /// # Errors
    ///
    /// Fails if the directory cannot be read.
    pub fn open(directory: &Path, limit: u64) -> io::Result<Self> {
        let mut tiers: [Vec<Blocks>; 3] = Default::default();
        let entries = match fs::read_dir(directory) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => None,
            entries => Some(entries?),
        };
        for entry in entries.into_iter().flatten() {
            let path = entry?.path();
            let Some(tier) = tier_of(&path) else {
                continue;
            };
            if let Some(files) = tiers.get_mut(tier as usize) {
                files.extend(Blocks::open(&path));
            }
        }
        for files in &mut tiers {
            files.sort_by(|one, other| one.path.cmp(&other.path));
        }
        Ok(Self {
            directory: directory.to_path_buf(),
            limit,
            tiers: Mutex::new(tiers),
            versions: Mutex::default(),
        })
    }

    /// Appends blocks to a tier, and deletes its oldest files beyond the limit.
    ///
    /// # Errors
    ///
    /// Fails if the blocks cannot be written, or if little space is free. The store is as before.
    pub fn append(&self, tier: Tier, blocks: &[Block]) -> io::Result<()> {
        let begin = blocks.iter().map(|block| block.begin).min();
        let Some((begin, first)) = begin.zip(blocks.first()) else {
            return Ok(());
        };
        prepare(&self.directory)?;
        let unfinished = self.unfinished(tier, begin, (first.begin, first.end));
        let mut file = match unfinished {
            Some(file) => file,
            None => Blocks::create(self.free_path(tier, begin), begin)?,
        };
        match file.append(blocks) {
            // An operator has deleted the file to gain space.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                file = Blocks::create(self.free_path(tier, begin), begin)?;
                file.append(blocks)?;
            }
            appended => appended?,
        }
        self.finish_append(tier, file);
        Ok(())
    }

    /// Returns how many bytes the documents of one time may have together: 4 MiB, and at most half of
    /// the tier's part of the limit.
    #[must_use]
    pub fn document_room(&self) -> usize {
        let most = (Tier::Documents.budget(self.limit) / 2).min(MAX_DOCUMENT_BYTES);
        usize::try_from(most).unwrap_or(usize::MAX)
    }

    /// Appends the documents of a time: whole ones at the begin of a file, and later what changed.
    /// A document beyond [`Self::document_room`] is left out.
    ///
    /// # Errors
    ///
    /// Fails if they cannot be written, or if little space is free. The store is as before.
    pub fn append_documents(
        &self,
        begin: u32,
        end: u32,
        documents: impl Iterator<Item = Document>,
    ) -> io::Result<()> {
        let tier = Tier::Documents;
        let mut versions = self.versions.lock().unwrap_or_else(PoisonError::into_inner);
        prepare(&self.directory)?;
        let continued = self.unfinished(tier, begin, (begin, end)).filter(|file| {
            // An operator may have deleted the file to gain space.
            Some(&file.path) == versions.path.as_ref() && file.path.exists()
        });
        let file = match continued {
            Some(file) => file,
            None => {
                versions.forget();
                Blocks::create(self.free_path(tier, begin), begin)?
            }
        };
        let content = versions.block(documents, self.document_room());
        versions.path = None;
        let (path, is_new) = (file.path.clone(), file.length == FIRST_PLACE);
        let file = file.with(&[Block {
            kind: Kind::Documents,
            begin,
            end,
            content,
        }]);
        let file = file.inspect_err(|_| {
            // Nothing would delete a file without a block.
            if is_new {
                let _ = fs::remove_file(&path);
            }
        })?;
        versions.path = Some(file.path.clone());
        drop(versions);
        self.finish_append(tier, file);
        Ok(())
    }

    /// Returns the last file of a tier if blocks continue it that begin at `begin`, the first of them
    /// with these times.
    fn unfinished(&self, tier: Tier, begin: u32, first: (u32, u32)) -> Option<Blocks> {
        let last = self.files(tier).pop()?;
        // After a step back of the clock, a new file keeps the two times apart.
        let is_continued = last.length < tier.budget(self.limit) / FILES_PER_TIER
            && begin.abs_diff(last.begin) < tier.span()
            && match tier {
                Tier::Seconds => !is_set_back(last.end, begin),
                Tier::Tens => first.0 >= last.end,
                Tier::Documents => first.1 >= last.end,
            };
        is_continued.then_some(last)
    }

    /// Stores the new state of a file, and deletes the oldest files that exceed the tier's budget.
    fn finish_append(&self, tier: Tier, file: Blocks) {
        // A slow storage must not hold the lock, for which readers would wait.
        for excess in self.replace_last(tier, file, tier.budget(self.limit)) {
            let _ = fs::remove_file(excess.path);
        }
    }

    /// Stores the new state of the last file of a tier. Returns the oldest files that exceed the
    /// budget.
    fn replace_last(&self, tier: Tier, file: Blocks, budget: u64) -> Vec<Blocks> {
        let mut tiers = self.lock();
        let Some(files) = tiers.get_mut(tier as usize) else {
            return Vec::new();
        };
        match files.last_mut().filter(|last| last.path == file.path) {
            Some(last) => *last = file,
            None => files.push(file),
        }
        let mut size: u64 = files.iter().map(|file| file.length).sum();
        let mut excess = 0;
        for file in files.iter().take(files.len().saturating_sub(1)) {
            if size <= budget && files.len() - excess <= MAX_FILES {
                break;
            }
            size = size.saturating_sub(file.length);
            excess += 1;
        }
        files.drain(..excess).collect()
    }

    /// Merges rows of [`Tier::Seconds`] into [`Tier::Tens`], for each ten minutes that have passed
    /// at the time `now`: at most [`MAX_WINDOWS`] of them in one call.
    ///
    /// # Errors
    ///
    /// Fails if the blocks cannot be written.
    pub fn condense(&self, now: u32) -> io::Result<()> {
        for _ in 0..MAX_WINDOWS {
            let files = self.latest_run();
            let Some(times) = self.next_window(now, &files) else {
                return Ok(());
            };
            let topics = gathered(&files, Kind::Topics, &times);
            let processes = gathered(&files, Kind::Processes, &times);
            let mut blocks = vec![Block::of_topics(times.start, times.end, &topics)];
            if !processes.is_empty() {
                blocks.push(Block::of_processes(times.start, times.end, &processes));
            }
            let state = self
                .state(times.end)
                .filter(|state| state.end > times.start);
            blocks.extend(state);
            let mut events = Vec::new();
            visit(&files, Kind::Events, &times, &mut |block| {
                events.push(block);
            });
            // A block that ends later belongs to the next window, because the latest end is the
            // time up to which rows are merged.
            events.retain(|block| block.end <= times.end);
            blocks.extend(events);
            self.append(Tier::Tens, &blocks)?;
        }
        Ok(())
    }

    /// Visits the rows of the wanted topics that end after the begin of the times and not after
    /// their end, the oldest first. Rows are those of [`Tier::Tens`] if `step` is ten seconds or
    /// more, or if they are too old for [`Tier::Seconds`].
    pub fn topics(
        &self,
        times: Range<u32>,
        step: u32,
        wanted: &dyn Fn(&TopicName) -> bool,
        each: &mut dyn FnMut(&TopicName, TopicRow),
    ) {
        for (tier, times) in self.parts(times, step) {
            rows(&self.files(tier), Kind::Topics, &times, wanted, each);
        }
    }

    /// Visits the rows of the wanted processes, as [`Self::topics`] does.
    pub fn processes(
        &self,
        times: Range<u32>,
        step: u32,
        wanted: &dyn Fn(&ProcessName) -> bool,
        each: &mut dyn FnMut(&ProcessName, ProcessRow),
    ) {
        for (tier, times) in self.parts(times, step) {
            rows(&self.files(tier), Kind::Processes, &times, wanted, each);
        }
    }

    /// Visits the content of the blocks of events that overlap the times, the oldest first.
    pub fn events(&self, times: Range<u32>, each: &mut dyn FnMut(&[u8])) {
        for (tier, times) in self.parts(times, TEN_SECONDS) {
            visit(&self.files(tier), Kind::Events, &times, &mut |block| {
                each(&block.content);
            });
        }
    }

    /// Returns the latest state of the robot at this time; `None` if no earlier one is kept.
    #[must_use]
    pub fn state(&self, time: u32) -> Option<Block> {
        let (file, header, place) = self.latest_state(time)?;
        file.block(&header, place)
    }

    /// Returns the end of [`Self::state`], which it does not decompress.
    #[must_use]
    pub fn state_end(&self, time: u32) -> Option<u32> {
        self.latest_state(time).map(|(_, header, _)| header.end)
    }

    /// Returns the file, header and place of the latest state at this time.
    fn latest_state(&self, time: u32) -> Option<(Blocks, Header, u64)> {
        let tiers = [Tier::Seconds, Tier::Tens];
        let states = tiers.into_iter().filter_map(|tier| {
            let mut files = self.files(tier);
            files.retain(|file| file.begin <= time);
            files.sort_by_key(|file| file.begin);
            files.into_iter().rev().find_map(|file| {
                let (header, place) = file.last(Kind::State, time)?;
                Some((file, header, place))
            })
        });
        states.max_by_key(|(_, header, _)| header.end)
    }

    /// Returns a document as it was at this time; `None` if it was not kept, or is damaged.
    #[must_use]
    pub fn document(&self, name: &str, time: u32) -> Option<DocumentVersion> {
        let mut files = self.files(Tier::Documents);
        files.retain(|file| file.begin <= time);
        files.sort_by_key(|file| file.begin);
        for file in files.iter().rev() {
            let (mut reader, mut last) = (VersionReader::new(name), None);
            file.visit(Kind::Documents, &(0..u32::MAX), &mut |block| {
                if block.end <= time {
                    reader.read(&block.content);
                    last = Some(block.end);
                }
            });
            if let Some(at) = last {
                let content = reader.content()?;
                return Some(DocumentVersion { at, content });
            }
        }
        None
    }

    /// Returns size and reach.
    #[must_use]
    pub fn facts(&self) -> Facts {
        let bytes = self.lock().iter().flatten().map(|file| file.length).sum();
        Facts {
            bytes,
            limit: self.limit,
            seconds: self.span(Tier::Seconds),
            tens: self.span(Tier::Tens),
            documents: self.span(Tier::Documents),
        }
    }

    /// Returns the reach of a tier; `None` without a block.
    #[must_use]
    pub fn span(&self, tier: Tier) -> Option<Span> {
        let files = self.files(tier);
        Some(Span {
            begin: files.iter().map(|file| file.begin).min()?,
            end: files.iter().map(|file| file.end).max()?,
        })
    }

    /// Returns the begin of the first file of a tier that ends after a time; `None` without one.
    #[must_use]
    pub fn begin_after(&self, tier: Tier, time: u32) -> Option<u32> {
        let files = self.files(tier);
        let files = files.iter().filter(|file| file.end > time);
        files.map(|file| file.begin).min()
    }

    fn lock(&self) -> MutexGuard<'_, [Vec<Blocks>; 3]> {
        self.tiers.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn files(&self, tier: Tier) -> Vec<Blocks> {
        self.lock().get(tier as usize).cloned().unwrap_or_default()
    }

    /// Returns which tier has which part of the times.
    fn parts(&self, times: Range<u32>, step: u32) -> [(Tier, Range<u32>); 2] {
        let border = if step >= TEN_SECONDS {
            let files = self.latest_run();
            let begin = files.iter().map(|file| file.begin).min();
            let done = self.condensed(&files).or(begin);
            done.unwrap_or(u32::MAX)
        } else {
            // A file from before the clock was set says nothing about these times.
            self.begin_after(Tier::Seconds, times.start)
                .unwrap_or(u32::MAX)
        };
        let older = times.start..times.end.min(border);
        let newer = times.start.max(border)..times.end;
        [(Tier::Tens, older), (Tier::Seconds, newer)]
    }

    /// Returns the files of [`Tier::Seconds`] since the clock was set back last.
    fn latest_run(&self) -> Vec<Blocks> {
        let mut files = self.files(Tier::Seconds);
        let ends = files.iter().map(|file| file.end);
        let begins = files.iter().skip(1).map(|file| file.begin);
        let is_step = ends.zip(begins).map(|(end, begin)| is_set_back(end, begin));
        let steps: Vec<bool> = is_step.collect();
        let before = steps.iter().rposition(|is_step| *is_step);
        files.drain(..before.map_or(0, |place| place + 1));
        files
    }

    /// Returns the time up to which [`Tier::Tens`] has the rows of the latest run of files; `None`
    /// if it has none of them.
    fn condensed(&self, run: &[Blocks]) -> Option<u32> {
        let end = run.iter().map(|file| file.end).max()?;
        let done = self.files(Tier::Tens).last()?.end;
        // A later time is that of a run before the clock was set back.
        (done < end.saturating_add(WINDOW_SECONDS)).then_some(done)
    }

    /// Returns the next ten minutes for [`Tier::Tens`] that the latest run of files has whole.
    fn next_window(&self, now: u32, run: &[Blocks]) -> Option<Range<u32>> {
        let whole = now / WINDOW_SECONDS * WINDOW_SECONDS;
        let done = self.condensed(run).unwrap_or(0);
        // A time without observation has no files, and is skipped.
        let left = run
            .iter()
            .filter(|file| file.begin < whole && file.end > done);
        let begin = left.map(|file| file.begin.max(done)).min()? / WINDOW_SECONDS * WINDOW_SECONDS;
        let begin = begin.max(done);
        (begin < whole).then(|| begin..(begin / WINDOW_SECONDS + 1) * WINDOW_SECONDS)
    }

    /// Returns a name that no file of the tier has. After a step back of the clock, a begin may
    /// occur twice.
    fn free_path(&self, tier: Tier, begin: u32) -> PathBuf {
        let files = self.files(tier);
        let last = files.last().and_then(|last| begin_of(&last.path));
        // The order of the names is that of writing.
        let number = last.map_or(begin, |last| begin.max(last.saturating_add(1)));
        let name = format!("{}-{number:010}.{FILE_EXTENSION}", tier.name());
        self.directory.join(name)
    }
}

/// Returns whether the clock was set back by more than a window between two files or blocks.
const fn is_set_back(end: u32, next_begin: u32) -> bool {
    next_begin.saturating_add(WINDOW_SECONDS) < end
}

fn visit(files: &[Blocks], kind: Kind, times: &Range<u32>, each: &mut dyn FnMut(Block)) {
    for file in files {
        if file.overlaps(times) {
            file.visit(kind, times, each);
        }
    }
}

fn rows<N: Name, R: Row + Merge>(
    files: &[Blocks],
    kind: Kind,
    times: &Range<u32>,
    wanted: &dyn Fn(&N) -> bool,
    each: &mut dyn FnMut(&N, R),
) {
    visit(files, kind, times, &mut |block| {
        columns::read(&block.content, wanted, &mut |name, row: R| {
            if row.end_time() > times.start && row.end_time() <= times.end {
                each(name, row);
            }
        });
    });
}

/// Returns the merged rows of all topics or processes in these files.
fn gathered<N: Name + Ord + Clone, R: Row + Merge>(
    files: &[Blocks],
    kind: Kind,
    times: &Range<u32>,
) -> Vec<Series<N, R>> {
    let mut all = BTreeMap::<N, Vec<R>>::new();
    rows(files, kind, times, &|_| true, &mut |name, row| {
        merge_by_name(&mut all, name, row, TEN_SECONDS);
    });
    let series = all.into_iter();
    series.map(|(of, rows)| Series { of, rows }).collect()
}

/// Creates a directory if it is missing. Fails if little space is free.
pub(crate) fn prepare(directory: &Path) -> io::Result<()> {
    let exists = directory.is_dir();
    let parent = directory.parent().filter(|_| !exists);
    let space = rustix::fs::statvfs(parent.unwrap_or(directory))?;
    if space.f_bavail.saturating_mul(space.f_frsize) < MIN_FREE {
        return Err(io::Error::from(io::ErrorKind::StorageFull));
    }
    if !exists {
        fs::DirBuilder::new().mode(0o700).create(directory)?;
    }
    Ok(())
}

/// Returns the tier of a file by its name; `None` for other files.
fn tier_of(path: &Path) -> Option<Tier> {
    begin_of(path)?;
    let name = path.file_stem()?.to_str()?;
    Tier::ALL.into_iter().find(|tier| {
        name.strip_prefix(tier.name())
            .is_some_and(|rest| rest.starts_with('-'))
    })
}

fn begin_of(path: &Path) -> Option<u32> {
    let is_ours = path.extension()?.to_str()? == FILE_EXTENSION;
    let (_, number) = path.file_stem()?.to_str()?.split_once('-')?;
    number.parse().ok().filter(|_| is_ours)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Documented bytes a day of 200 topics (docs/history.md): rows, and documents if the rate of
    /// each publisher varies.
    const ROWS_A_DAY: u64 = 89_000_000;
    const DOCUMENTS_A_DAY: u64 = 5_500_000;

    #[test]
    fn the_default_limit_has_a_day_of_seconds_and_a_week_of_documents() {
        let limit = 256 << 20;
        let [seconds, tens, documents] = Tier::ALL.map(|tier| tier.budget(limit));
        assert!(seconds + tens + documents <= limit);
        assert!(seconds >= ROWS_A_DAY, "{seconds}");
        // The oldest file is deleted as a whole.
        let file = DOCUMENTS_A_DAY / 86_400 * u64::from(Tier::Documents.span());
        assert!(documents >= 7 * DOCUMENTS_A_DAY + file, "{documents}");
    }
}
