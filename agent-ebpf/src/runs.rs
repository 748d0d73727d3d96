//! Joins the DATA_FRAGs of one sample: a point cloud in two thousand fragments becomes one record.
//!
//! A run begins with a sample's first fragment and ends with its last, or before a missing
//! fragment. All other fragments (a retransmission, the rest after a gap) are written immediately.
//! If the sender moves to another CPU during a run, the run is written and a new one starts on that
//! CPU. User space removes runs that have stopped growing; it checks at least once a second.

use aya_ebpf::helpers::bpf_get_smp_processor_id;
use ros2probe_wire::record::{Record, flag, kind};

use crate::{
    maps::{RUN_CPUS, RUNS, RunKeys, copy, run, run_keys},
    verdict::write,
};

/// Writes a record. With `joins`, a DATA_FRAG may be kept for the fragments that follow; the record
/// must then be valid already and not complete a datagram.
#[inline(always)]
pub fn give(slot: u32, record: &Record, joins: bool) {
    if record.kind != kind::DATA_FRAG {
        write(slot, record);
        return;
    }
    let Some(mut keys) = run_keys(slot) else {
        write(slot, record);
        return;
    };
    let keys = keys.get();
    copy(&record.writer, &mut keys.here.stream.writer);
    copy(&record.destination, &mut keys.here.stream.destination);
    keys.here.stream.destination_port = u32::from(record.destination_port);
    keys.here.stream.interface = record.interface | u32::from(record.flags & flag::OUTGOING) << 29;
    keys.here.stream.socket = [record.socket as u32, (record.socket >> 32) as u32];
    // SAFETY: no preconditions.
    keys.here.cpu = unsafe { bpf_get_smp_processor_id() } as u32;
    let mut goes_on = false;
    // The key contains this CPU, and programs for received packets run with bottom halves disabled,
    // so nothing else extends the run. A task that sends may be preempted here. If another task
    // then sends fragments of the same writer from the same socket, fragments are counted in two
    // records or not at all.
    if let Some(known) = run(&keys.here) {
        let run = &mut keys.run;
        known.load(run);
        if joins && run.extend(record) {
            if run.ends_sample() {
                write(slot, run);
                let _ = RUNS.remove(&keys.here);
            } else {
                known.store(run);
            }
            return;
        }
        write(slot, run);
        if joins && begins(record) {
            known.store(record);
            return;
        }
        let _ = RUNS.remove(&keys.here);
    } else if joins {
        goes_on = take_over(slot, keys, record);
    }
    if joins && (goes_on || begins(record)) && !record.ends_sample() {
        if RUNS.insert(&keys.here, record, 0).is_ok() {
            return;
        }
    }
    write(slot, record);
}

/// Returns whether a run starts with the record: it has a sample's first fragments, and more
/// follow.
#[inline(always)]
fn begins(record: &Record) -> bool {
    record.fragment_start == 1 && !record.ends_sample()
}

/// Writes the run that the stream has left behind on another CPU; returns whether `record`
/// continues it.
#[inline(always)]
fn take_over(slot: u32, keys: &mut RunKeys, record: &Record) -> bool {
    let Some(last) = RUN_CPUS.get_ptr_mut(&keys.here.stream) else {
        let _ = RUN_CPUS.insert(&keys.here.stream, &keys.here.cpu, 0);
        return false;
    };
    // SAFETY: a map value pointer checked against null.
    let before = unsafe { *last };
    if before == keys.here.cpu {
        return false;
    }
    // SAFETY: as above.
    unsafe { *last = keys.here.cpu };
    copy(&keys.here.stream, &mut keys.elsewhere.stream);
    keys.elsewhere.cpu = before;
    // The other CPU does not extend this run, since its next fragment is here. If it writes the run
    // at the same moment, fragments are reported twice, and repeated fragments do not count.
    let Some(known) = run(&keys.elsewhere) else {
        return false;
    };
    let run = &mut keys.run;
    known.load(run);
    let goes_on = run.is_followed_by(record);
    write(slot, run);
    let _ = RUNS.remove(&keys.elsewhere);
    goes_on
}
