//! Joins the DATA_FRAGs of one sample: a point cloud in two thousand fragments is one record.
//!
//! A run begins with a sample's first fragment and ends with its last, or where the next fragment is
//! missing. Everything else (a retransmission, the rest behind a gap) is written as it comes. A run
//! that nobody continues is taken out by user space, which looks about ten times a second.

use aya_ebpf::helpers::bpf_get_smp_processor_id;
use ros2probe_wire::record::{Record, flag, kind};

use crate::{
    maps::{RUNS, RunKey, copy},
    verdict::write,
};

/// Writes a record, or keeps it for the fragments that follow if it `joins` others: that is if it
/// counts now and is not the sign that its datagram is complete.
#[inline(always)]
pub fn give(record: &Record, joins: bool) {
    if record.kind != kind::DATA_FRAG {
        write(record);
        return;
    }
    let key = RunKey {
        writer: record.writer,
        destination: record.destination,
        destination_port: u32::from(record.destination_port),
        interface: record.interface | u32::from(record.flags & flag::OUTGOING) << 29,
        // SAFETY: no preconditions.
        cpu: unsafe { bpf_get_smp_processor_id() } as u32,
    };
    if let Some(run) = RUNS.get_ptr_mut(key) {
        // SAFETY: a map value pointer checked against null; the key names this CPU, and packet taps
        // run with bottom halves disabled, so nobody else is in here.
        let run = unsafe { &mut *run };
        if joins && run.extend(record) {
            if run.ends_sample() {
                write(run);
                let _ = RUNS.remove(key);
            }
            return;
        }
        write(run);
        if joins && begins(record) {
            copy(record, run);
            return;
        }
        let _ = RUNS.remove(key);
    } else if joins && begins(record) && RUNS.insert(key, record, 0).is_ok() {
        return;
    }
    write(record);
}

/// A sample's first fragments, with more to come.
#[inline(always)]
fn begins(record: &Record) -> bool {
    record.fragment_start == 1 && !record.ends_sample()
}
