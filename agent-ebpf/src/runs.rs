//! Joins the DATA_FRAGs of one sample: a point cloud in two thousand fragments becomes one record.
//!
//! A run begins with a sample's first fragment and ends with its last, or before a missing
//! fragment. All other fragments (a retransmission, the rest after a gap) are written immediately.
//! If the sender moves to another CPU during a run, the run is written and a new one starts on that
//! CPU. User space removes runs that have stopped growing; it checks at least once a second.

use aya_ebpf::helpers::bpf_get_smp_processor_id;
use ros2probe_wire::record::{Record, flag, kind};

use crate::{
    maps::{RUN_CPUS, RUNS, RunKeys, copy, fragment_run, run_keys},
    verdict::write_record,
};

/// Writes a record. With `may_merge`, a DATA_FRAG may be kept for the fragments that follow; the
/// record must then be valid already and not complete a datagram.
#[inline(always)]
pub fn write_or_merge(slot: u32, record: &Record, may_merge: bool) {
    if record.kind != kind::DATA_FRAG {
        write_record(slot, record);
        return;
    }
    let Some(mut keys) = run_keys(slot) else {
        write_record(slot, record);
        return;
    };
    let keys = keys.get();
    copy(&record.writer, &mut keys.this_cpu.stream.writer);
    copy(&record.destination, &mut keys.this_cpu.stream.destination);
    keys.this_cpu.stream.destination_port = u32::from(record.destination_port);
    keys.this_cpu.stream.interface =
        record.interface | u32::from(record.flags & flag::OUTGOING) << 29;
    keys.this_cpu.stream.socket = [record.socket as u32, (record.socket >> 32) as u32];
    // SAFETY: no preconditions.
    keys.this_cpu.cpu = unsafe { bpf_get_smp_processor_id() } as u32;
    let mut continues_run = false;
    // The key contains this CPU, and programs for received packets run with bottom halves disabled,
    // so nothing else extends the run. A task that sends may be preempted here. If another task
    // then sends fragments of the same writer from the same socket, fragments are counted in two
    // records or not at all.
    if let Some(stored_run) = fragment_run(&keys.this_cpu) {
        let run = &mut keys.run;
        stored_run.load(run);
        if may_merge && run.extend(record) {
            if run.ends_sample() {
                write_record(slot, run);
                let _ = RUNS.remove(&keys.this_cpu);
            } else {
                stored_run.store(run);
            }
            return;
        }
        write_record(slot, run);
        if may_merge && starts_run(record) {
            stored_run.store(record);
            return;
        }
        let _ = RUNS.remove(&keys.this_cpu);
    } else if may_merge {
        continues_run = flush_run_of_other_cpu(slot, keys, record);
    }
    if may_merge && (continues_run || starts_run(record)) && !record.ends_sample() {
        if RUNS.insert(&keys.this_cpu, record, 0).is_ok() {
            return;
        }
    }
    write_record(slot, record);
}

/// Returns whether a run starts with the record: it has a sample's first fragments, and more
/// follow.
#[inline(always)]
fn starts_run(record: &Record) -> bool {
    record.fragment_start == 1 && !record.ends_sample()
}

/// Writes the run that the stream has left behind on another CPU; returns whether `record`
/// continues it.
#[inline(always)]
fn flush_run_of_other_cpu(slot: u32, keys: &mut RunKeys, record: &Record) -> bool {
    let Some(last) = RUN_CPUS.get_ptr_mut(&keys.this_cpu.stream) else {
        let _ = RUN_CPUS.insert(&keys.this_cpu.stream, &keys.this_cpu.cpu, 0);
        return false;
    };
    // SAFETY: a map value pointer checked against null.
    let previous_cpu = unsafe { *last };
    if previous_cpu == keys.this_cpu.cpu {
        return false;
    }
    // SAFETY: as above.
    unsafe { *last = keys.this_cpu.cpu };
    copy(&keys.this_cpu.stream, &mut keys.other_cpu.stream);
    keys.other_cpu.cpu = previous_cpu;
    // The other CPU does not extend this run, since its next fragment is here. If it writes the run
    // at the same moment, fragments are reported twice, and repeated fragments do not count.
    let Some(stored_run) = fragment_run(&keys.other_cpu) else {
        return false;
    };
    let run = &mut keys.run;
    stored_run.load(run);
    let continues_run = run.is_followed_by(record);
    write_record(slot, run);
    let _ = RUNS.remove(&keys.other_cpu);
    continues_run
}
