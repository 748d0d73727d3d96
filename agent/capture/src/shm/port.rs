//! A port: the ring that announces messages to the participants that listen there.
//!
//! Reads PortNode, ring and cells of Fast DDS 2.3 to 3.6 and follows the write position like a
//! listener. It is not a listener: it counts no reference and pops nothing. A writer first moves
//! `write_p`, then fills the cell, and sets its reference counter last. Therefore a cell counts as
//! filled if it is referenced or if it differs from its content one round before.

use ros2probe_model::facts::bounded::Bounded;

use super::cell::{Cell, Descriptor};
use super::source::Source;
use crate::tables::PortCells;

/// PortNode follows the allocator's administration, at 0x100 on x86-64 and 0x110 on aarch64: it is
/// found in the first page by its content.
const FIRST_OFFSET: u64 = 0x40;
const LAST_OFFSET: u64 = 0x1000;
/// Fields of PortNode and of the ring's node.
const CELLS_OFFSET: u64 = 12;
const RING_OFFSET: u64 = 16;
const PORT_ID: u64 = 20;
const CAPACITY_OFFSET: u64 = 36;
const TOTAL_CELLS: u64 = 8;
/// A cell that is not filled after this time stays unfilled: its writer died.
const UNFILLED_NANOSECONDS: u64 = 100_000_000;
/// Maximum number of attempts to read a ring without a concurrent write.
const MAX_ATTEMPTS: usize = 3;
/// Interval over which a port's rate is measured; each interval decays the peak by an eighth.
const PACE_NANOSECONDS: u64 = 100_000_000;

/// Offsets in a port's file.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
struct Layout {
    ring: u64,
    cells: u64,
    capacity: u32,
}

/// Read position in one port.
#[derive(Debug)]
pub struct Port {
    layout: Layout,
    /// Position of the next cell: its index, plus the capacity in every other round.
    position: u32,
    shadow: Bounded<PortCells, Vec<Descriptor>>,
    unfilled_since: Option<u64>,
    last_polled: u64,
    peak_rate: PeakRate,
    bytes: Vec<u8>,
}

/// Result of one poll of a port, in addition to messages.
#[derive(Clone, Copy, PartialEq, Eq, Default, Debug)]
pub struct PortPoll {
    /// Messages announced since the previous poll.
    pub pushed: u64,
    /// Announced messages that were overwritten before they were read.
    pub overwritten: u64,
    /// Announced messages that were never filled in.
    pub unfilled: u64,
    /// Whether the pause was long enough for the ring to wrap around unnoticed.
    pub is_uncertain: bool,
}

/// Recent peak rate of the port, in messages per second.
#[derive(Debug, Default)]
struct PeakRate {
    since: u64,
    count: u64,
    peak: u64,
}

impl Port {
    /// Finds port number `number` in its file and the messages in its ring, the oldest first.
    /// `None` if the file is not a port, or not of this layout.
    pub fn attach<S: Source + ?Sized>(
        source: &S,
        number: u32,
        now: u64,
    ) -> Option<(Self, Vec<Descriptor>)> {
        let layout = Layout::find(source, number)?;
        let mut port = Self {
            layout,
            position: 0,
            shadow: Bounded::default(),
            unfilled_since: None,
            last_polled: now,
            peak_rate: PeakRate::default(),
            bytes: Vec::new(),
        };
        let mut before = port.write_position(source)?;
        let mut cells = Vec::new();
        for _ in 0..MAX_ATTEMPTS {
            cells.clear();
            port.cells(source, 0, layout.capacity, &mut cells)?;
            let after = port.write_position(source)?;
            port.position = before;
            if before == after {
                break;
            }
            before = after;
        }
        port.shadow = cells.iter().map(|cell| cell.descriptor).collect();
        let oldest = layout.index(port.position);
        let (newer, older) = cells.split_at_checked(oldest as usize)?;
        let filled = older.iter().chain(newer).map(|cell| cell.descriptor);
        let filled = filled.filter(|descriptor| *descriptor != Descriptor::default());
        Some((port, filled.collect()))
    }

    /// Appends the messages announced since the last poll. Returns `None` if the file is no longer
    /// a port.
    pub fn poll<S: Source + ?Sized>(
        &mut self,
        source: &S,
        now: u64,
        found: &mut Vec<Descriptor>,
    ) -> Option<PortPoll> {
        let elapsed = now.saturating_sub(std::mem::replace(&mut self.last_polled, now));
        let write = self.write_position(source)?;
        let capacity = self.layout.capacity;
        let mut ahead = self.layout.distance(self.position, write);
        let mut look = PortPoll {
            is_uncertain: self.peak_rate.may_have_lapped(elapsed, capacity),
            ..PortPoll::default()
        };
        if ahead == 0 {
            self.unfilled_since = None;
            return Some(look);
        }
        if ahead > capacity {
            let overwritten = ahead - capacity;
            self.position = self.layout.advance(self.position, overwritten);
            (look.overwritten, look.pushed) = (overwritten.into(), overwritten.into());
            ahead = capacity;
            self.unfilled_since = None;
        }
        // Cells may change during the read: only a cell that reads the same twice counts.
        let first = self.layout.index(self.position);
        let (mut cells, mut again) = (Vec::new(), Vec::new());
        self.cells(source, first, ahead, &mut cells)?;
        self.cells(source, first, ahead, &mut again)?;
        for (cell, again) in cells.iter().zip(&again) {
            let index = self.layout.index(self.position) as usize;
            let shadow = self.shadow.get_mut(index)?;
            let is_fresh = cell.references > 0 || cell.descriptor != *shadow;
            if !is_fresh || cell.descriptor != again.descriptor {
                let since = *self.unfilled_since.get_or_insert(now);
                if now.saturating_sub(since) < UNFILLED_NANOSECONDS {
                    break;
                }
                look.unfilled += 1;
            } else {
                *shadow = cell.descriptor;
                found.push(cell.descriptor);
            }
            self.unfilled_since = None;
            look.pushed += 1;
            self.position = self.layout.advance(self.position, 1);
        }
        self.peak_rate.count(look.pushed, now);
        Some(look)
    }

    fn write_position<S: Source + ?Sized>(&self, source: &S) -> Option<u32> {
        let word = source.word(self.layout.ring)?;
        let (index, is_odd_round) = (word & (u32::MAX >> 1), word >> 31 == 1);
        (index < self.layout.capacity).then(|| {
            index
                + if is_odd_round {
                    self.layout.capacity
                } else {
                    0
                }
        })
    }

    /// Reads `count` cells starting at `first`, wrapping around the ring's end; `None` if the file
    /// is too short.
    fn cells<S: Source + ?Sized>(
        &mut self,
        source: &S,
        first: u32,
        count: u32,
        cells: &mut Vec<Cell>,
    ) -> Option<()> {
        let until_end = count.min(self.layout.capacity - first);
        for (first, count) in [(first, until_end), (0, count - until_end)] {
            self.bytes.resize(count as usize * Cell::LEN, 0);
            let offset = self.layout.cells + u64::from(first) * Cell::LEN as u64;
            if !source.read(offset, &mut self.bytes) {
                return None;
            }
            let (read, _) = self.bytes.as_chunks::<{ Cell::LEN }>();
            cells.extend(read.iter().copied().map(Cell::parse));
        }
        Some(())
    }
}

impl Layout {
    fn find<S: Source + ?Sized>(source: &S, number: u32) -> Option<Self> {
        (FIRST_OFFSET..LAST_OFFSET)
            .step_by(8)
            .find_map(|node| Self::at(source, node, number))
    }

    fn at<S: Source + ?Sized>(source: &S, node: u64, number: u32) -> Option<Self> {
        if source.word(node + PORT_ID)? != number {
            return None;
        }
        let capacity = source.word(node + CAPACITY_OFFSET)?;
        let ring = u64::from(source.word(node + RING_OFFSET)?);
        let cells = u64::from(source.word(node + CELLS_OFFSET)?);
        let fits = (1..=PortCells::CAP as u32).contains(&capacity)
            && ring.is_multiple_of(4)
            && source.word(ring + TOTAL_CELLS)? == capacity;
        let last = cells + u64::from(capacity - fits.then_some(1)?) * Cell::LEN as u64;
        let mut cell = [0; Cell::LEN];
        source.read(last, &mut cell).then_some(Self {
            ring,
            cells,
            capacity,
        })
    }

    const fn index(&self, position: u32) -> u32 {
        position % self.capacity
    }

    const fn advance(&self, position: u32, by: u32) -> u32 {
        (position + by) % (2 * self.capacity)
    }

    /// Returns the number of cells from one position to a later or equal one.
    const fn distance(&self, from: u32, to: u32) -> u32 {
        (to + 2 * self.capacity - from) % (2 * self.capacity)
    }
}

impl PeakRate {
    /// Returns whether the ring may have wrapped around twice at the recent rate, which looks like
    /// no message.
    fn may_have_lapped(&self, elapsed: u64, capacity: u32) -> bool {
        let pushed = u128::from(self.peak) * u128::from(elapsed) / 1_000_000_000;
        pushed >= 2 * u128::from(capacity)
    }

    fn count(&mut self, pushed: u64, now: u64) {
        self.count += pushed;
        let elapsed = now.saturating_sub(self.since);
        if elapsed >= PACE_NANOSECONDS {
            let pace = u128::from(self.count) * 1_000_000_000 / u128::from(elapsed);
            let pace = u64::try_from(pace).unwrap_or(u64::MAX);
            self.peak = pace.max(self.peak - self.peak / 8);
            (self.since, self.count) = (now, 0);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::image::PortImage;
    use super::*;
    use crate::tables::tests::assert_driven;

    use ros2probe_wire::time::SECOND;

    fn descriptor(number: u32) -> Descriptor {
        Descriptor {
            node: number,
            validity: number,
            ..Descriptor::default()
        }
    }

    fn poll(port: &mut Port, image: &PortImage, now: u64) -> (Vec<u32>, PortPoll) {
        let mut found = Vec::new();
        let look = port.poll(image.bytes(), now, &mut found).unwrap();
        (found.iter().map(|found| found.node).collect(), look)
    }

    #[test]
    fn pushed_messages_are_found_once_and_in_order_over_many_rounds() {
        let mut image = PortImage::new(7411, 8, 0x100);
        let (mut port, backlog) = Port::attach(image.bytes(), 7411, 0).unwrap();
        assert!(backlog.is_empty());
        let (mut next, mut wanted) = (1, 1);
        for step in 0..100 {
            for _ in 0..step % 9 {
                image.push(descriptor(next));
                next += 1;
            }
            let (found, look) = poll(&mut port, &image, step);
            for found in found {
                assert_eq!(found, wanted);
                wanted += 1;
            }
            assert_eq!((look.overwritten, look.unfilled), (0, 0));
            assert_eq!(wanted, next);
        }
    }

    #[test]
    fn the_node_is_found_at_the_offsets_of_other_architectures() {
        for node in [0x40, 0x100, 0x110, 0x400] {
            let image = PortImage::new(7411, 8, node);
            assert!(Port::attach(image.bytes(), 7411, 0).is_some(), "{node:#x}");
            assert!(Port::attach(image.bytes(), 7413, 0).is_none());
        }
    }

    #[test]
    fn messages_already_in_the_ring_are_read_oldest_first() {
        let mut image = PortImage::new(7411, 8, 0x100);
        for number in 1..=11 {
            image.push(descriptor(number));
        }
        let (mut port, backlog) = Port::attach(image.bytes(), 7411, 0).unwrap();
        let backlog: Vec<_> = backlog.iter().map(|found| found.node).collect();
        assert_eq!(backlog, [4, 5, 6, 7, 8, 9, 10, 11]);
        image.push(descriptor(12));
        assert_eq!(poll(&mut port, &image, 1).0, [12]);
    }

    #[test]
    fn a_message_that_a_listener_has_already_read_is_found() {
        let mut image = PortImage::new(7411, 8, 0x100);
        let (mut port, _) = Port::attach(image.bytes(), 7411, 0).unwrap();
        image.push(descriptor(1));
        image.pop_all();
        assert_eq!(poll(&mut port, &image, 1).0, [1]);
    }

    #[test]
    fn a_cell_that_is_being_filled_is_awaited_for_a_limited_time() {
        let mut image = PortImage::new(7411, 8, 0x100);
        let (mut port, _) = Port::attach(image.bytes(), 7411, 0).unwrap();
        let begun = image.begin_push();
        image.push(descriptor(2));
        assert_eq!(poll(&mut port, &image, 1).0, [0; 0]);
        image.fill(begun, descriptor(1));
        assert_eq!(poll(&mut port, &image, 2).0, [1, 2]);
        image.begin_push();
        image.push(descriptor(4));
        assert_eq!(poll(&mut port, &image, 3).0, [0; 0]);
        let (found, seen) = poll(&mut port, &image, 3 + UNFILLED_NANOSECONDS);
        assert_eq!((found, seen.unfilled, seen.pushed), (vec![4], 1, 2));
    }

    #[test]
    fn overwritten_messages_are_counted_and_the_others_are_read() {
        let mut image = PortImage::new(7411, 8, 0x100);
        let (mut port, _) = Port::attach(image.bytes(), 7411, 0).unwrap();
        for number in 1..=13 {
            image.push(descriptor(number));
        }
        let (found, seen) = poll(&mut port, &image, 1);
        assert_eq!(found, [6, 7, 8, 9, 10, 11, 12, 13]);
        assert_eq!((seen.overwritten, seen.pushed), (5, 13));
    }

    #[test]
    fn a_pause_in_which_the_ring_may_have_wrapped_twice_is_uncertain() {
        let mut image = PortImage::new(7411, 8, 0x100);
        let (mut port, _) = Port::attach(image.bytes(), 7411, 0).unwrap();
        for step in 1..=200 {
            image.push(descriptor(step));
            let (_, seen) = poll(&mut port, &image, u64::from(step) * SECOND / 100);
            assert!(!seen.is_uncertain);
        }
        // At 100 messages per second, 16 messages take 160 ms.
        let now = 2 * SECOND;
        assert!(!poll(&mut port, &image, now + 150_000_000).1.is_uncertain);
        assert!(poll(&mut port, &image, now + 500_000_000).1.is_uncertain);
    }

    #[test]
    fn a_ring_with_too_many_cells_is_rejected() {
        let capacity = PortCells::CAP as u32;
        let image = PortImage::new(7411, capacity, 0x100);
        assert!(Port::attach(image.bytes(), 7411, 0).is_some());
        let image = PortImage::new(7411, capacity + 1, 0x100);
        assert!(Port::attach(image.bytes(), 7411, 0).is_none());
        assert_driven::<PortCells>();
    }

    #[test]
    fn a_truncated_or_inconsistent_port_is_rejected() {
        let image = PortImage::new(7411, 8, 0x100);
        let (mut port, _) = Port::attach(image.bytes(), 7411, 0).unwrap();
        for end in 0..image.bytes().len() {
            let cut = &image.bytes()[..end];
            assert!(Port::attach(cut, 7411, 0).is_none(), "{end}");
            let _ = port.poll(cut, 1, &mut Vec::new());
        }
        let mut image = PortImage::new(7411, 8, 0x100);
        image.set_write(8);
        assert!(port.poll(image.bytes(), 1, &mut Vec::new()).is_none());
    }

    proptest! {
        #[test]
        fn reading_an_arbitrary_ring_ends_and_stays_within_its_bounds(
            damage in proptest::collection::vec((0_usize..1200, any::<[u8; 4]>()), 0..60),
            later in proptest::collection::vec((0_usize..1200, any::<[u8; 4]>()), 0..60),
        ) {
            let mut image = PortImage::new(7411, 8, 0x100);
            image.push(descriptor(1));
            let mut bytes = image.bytes().to_vec();
            let change = |bytes: &mut Vec<u8>, damage: &[(usize, [u8; 4])]| {
                for (at, word) in damage {
                    let at = at % (bytes.len() - 4);
                    bytes[at..at + 4].copy_from_slice(word);
                }
            };
            change(&mut bytes, &damage);
            if let Some((mut port, backlog)) = Port::attach(bytes.as_slice(), 7411, 0) {
                prop_assert!(backlog.len() <= PortCells::CAP);
                for now in 1..4 {
                    change(&mut bytes, &later);
                    let mut found = Vec::new();
                    let _ = port.poll(bytes.as_slice(), now * SECOND, &mut found);
                    prop_assert!(found.len() <= PortCells::CAP);
                }
            }
        }
    }
}
