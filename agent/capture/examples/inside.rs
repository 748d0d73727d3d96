//! Checks the programs inside processes on the running kernel. It loads them, attaches them to the
//! library that is given as argument, calls its functions, and compares counts.
//!
//! The example also runs as the first process of a guest. It then mounts what it needs, and powers
//! off.

#![expect(clippy::print_stdout, reason = "its result")]

use std::error::Error;
use std::fs::File;
use std::os::fd::AsRawFd as _;
use std::ptr;
use std::time::Duration;

use ros2probe_attach::client::Broker;
use ros2probe_attach::library;
use ros2probe_capture::breakpoints::AttachMethod;
use ros2probe_capture::inside::programs;
use ros2probe_capture::inside::table::ProcessTable;
use ros2probe_capture::system::Clocks;
use ros2probe_wire::inside::kind;

/// Number of calls of each function.
const CALLS: u64 = 1000;

fn main() {
    let is_first = std::process::id() == 1;
    if is_first {
        for (kind, place) in [(c"proc", c"/proc"), (c"sysfs", c"/sys")] {
            // SAFETY: the arguments are three strings that end with zero, and no data.
            unsafe { libc::mount(kind.as_ptr(), place.as_ptr(), kind.as_ptr(), 0, ptr::null()) };
        }
    }
    let library = std::env::args().nth(1);
    let library = library.unwrap_or_else(|| "/libtracetools.so".to_owned());
    for has_callbacks in [false, true] {
        let mode = if has_callbacks { "full" } else { "topics" };
        match check(&library, has_callbacks) {
            Ok(text) => println!("{mode}: ok, {text}"),
            Err(error) => println!("{mode}: failed, {error:?}"),
        }
    }
    let version = std::fs::read_to_string("/proc/sys/kernel/osrelease");
    println!("checked on {}", version.unwrap_or_default().trim());
    if is_first {
        // SAFETY: the call takes no pointer. The first process of a guest ends the guest.
        unsafe { libc::reboot(libc::RB_POWER_OFF) };
    }
}

fn check(library: &str, has_callbacks: bool) -> Result<String, Box<dyn Error>> {
    let (programs, mut tables) =
        programs::load(has_callbacks, None, AttachMethod::of_this_kernel())?;
    tables.set_clocks(&Clocks::read())?;
    let file = File::open(library)?;
    let attached = programs.attach_here(&file)?;
    let names = ["publish", "take", "start", "end"].map(|name| match name {
        "publish" => "ros_trace_rcl_publish",
        "take" => "ros_trace_rmw_take",
        "start" => "ros_trace_callback_start",
        _ => "ros_trace_callback_end",
    });
    let offsets = library::functions(&file, &names)?;
    let offsets: Vec<u64> = offsets.into_iter().flatten().collect();
    let [publish, take, start, end] = offsets[..] else {
        return Err("the library lacks a function".into());
    };
    let length = usize::try_from(file.metadata()?.len())?;
    // SAFETY: a new mapping at an address of the kernel's choice touches no memory in use.
    let code = unsafe {
        libc::mmap(
            ptr::null_mut(),
            length,
            libc::PROT_READ | libc::PROT_EXEC,
            libc::MAP_PRIVATE,
            file.as_raw_fd(),
            0,
        )
    };
    if code == libc::MAP_FAILED {
        return Err(std::io::Error::last_os_error().into());
    }
    let call = |offset: u64, first: u64, fourth: u64| {
        let address = code
            .cast::<u8>()
            .wrapping_add(usize::try_from(offset).unwrap_or(0));
        // SAFETY: the function is in the mapping above, has no body, and ignores its arguments.
        unsafe {
            let function: extern "C" fn(u64, u64, u64, u64) = std::mem::transmute(address);
            function(first, 0, 1, fourth);
        }
    };
    let message = || {
        call(take, 0x2000, 1);
        call(start, 0x3000, 0);
        call(publish, 0x1000, 0);
        call(end, 0x3000, 0);
    };
    let watched = times(message);
    let counted = |of: u32| {
        let found = tables.figures().find(|(handle, _)| handle.kind == of);
        found.map_or(0, |(_, figures)| figures.count)
    };
    let counts = [kind::PUBLISHER, kind::SUBSCRIPTION, kind::CALLBACK].map(counted);
    let callbacks = if has_callbacks { CALLS } else { 0 };
    if counts != [CALLS, CALLS, callbacks] {
        return Err(format!("counted {counts:?}").into());
    }
    let mut table = ProcessTable::new(has_callbacks);
    let second = Duration::from_secs(1);
    let mut broker = Broker::here();
    let round = table.round(
        &mut tables,
        &Clocks::read(),
        second,
        &mut broker,
        |_| false,
        |_| None,
    );
    drop(attached);
    let alone = times(message);
    let after = table.round(
        &mut tables,
        &Clocks::read(),
        second,
        &mut broker,
        |_| false,
        |_| None,
    );
    Ok(format!(
        "{counts:?} of {CALLS} counted, {} calls, {} after the probes were removed; four calls take \
         {watched} ns with probes and {alone} ns without (median / 99th percentile)",
        round.hits, after.hits
    ))
}

/// Returns median and 99th percentile of the nanoseconds that a message's calls take.
fn times(message: impl Fn()) -> String {
    let mut times: Vec<_> = (0..CALLS)
        .map(|_| {
            let begin = std::time::Instant::now();
            message();
            begin.elapsed().as_nanos()
        })
        .collect();
    times.sort_unstable();
    let at = |part: usize| times.get(part * times.len() / 100).copied();
    format!("{} / {}", at(50).unwrap_or(0), at(99).unwrap_or(0))
}
