//! Counts calls of `libtracetools.so` in the ROS processes that make them.
//!
//! `rcl`, `rclcpp` and the middlewares call a function of this library for each event, whether a
//! tracer is installed or not. A uprobe at the entry of that function runs in the calling process.
//! The programs read arguments and, once for each handle, names; they write only their own maps. No
//! data leaves the kernel for each message, except bounded numbers of causal publications and late
//! calls.
//!
//! The programs use only what the verifier of Linux 5.10 accepts, as the packet filter does.

#![no_std]
#![no_main]
#![feature(asm_experimental_arch)]

mod accounting;
mod callbacks;
#[path = "../instructions.rs"]
mod instructions;
mod late;
mod maps;
mod messages;
mod names;
#[path = "../registers.rs"]
mod registers;
mod scheduler;
#[path = "../settings.rs"]
mod settings;

use aya_ebpf::{
    EbpfContext as _,
    helpers::generated::bpf_get_attach_cookie,
    macros::{map, raw_tracepoint, uprobe},
    maps::ProgramArray,
    programs::{ProbeContext, RawTracePointContext},
};
use ros2probe_wire::inside::announced;

use crate::{
    registers::{is_aarch64, register},
    settings::keep_frames_of_task,
};

/// Declares programs at the entry of functions. Each program reads as many arguments as it names.
macro_rules! calls {
    ($($(#[$doc:meta])* $name:ident($($argument:ident),*) { $($body:tt)* })*) => {
        $(
            $(#[$doc])*
            #[uprobe]
            pub fn $name(context: ProbeContext) -> u32 {
                arguments!(context; $($argument),*);
                $($body)*
                keep_frames_of_task(&context);
                0
            }
        )*
    };
}

/// Binds arguments in the order of the System V ABI or of AAPCS64.
macro_rules! arguments {
    ($context:ident;) => {
        let _ = $context;
    };
    ($context:ident; $a:ident $(, $b:ident $(, $c:ident $(, $d:ident)?)?)?) => {
        let registers = $context.as_ptr() as *const u64;
        let $a = if is_aarch64() { register!(registers, 0) } else { register!(registers, 112) };
        $(
            let $b = if is_aarch64() { register!(registers, 8) } else { register!(registers, 104) };
            $(
                let $c = if is_aarch64() { register!(registers, 16) } else { register!(registers, 96) };
                $(
                    let $d =
                        if is_aarch64() { register!(registers, 24) } else { register!(registers, 88) };
                )?
            )?
        )?
    };
}

/// Maximum number of programs that [`called`] runs.
const PROGRAMS: u32 = 32;

/// The programs of functions, by cookie. Set by user space.
#[map]
static CALLS: ProgramArray = ProgramArray::with_max_entries(PROGRAMS, 0);

/// Runs at each function of a library that one link covers, and calls the program of that function.
/// It is loaded on kernels with such links (Linux 6.6).
#[uprobe]
pub fn called(context: ProbeContext) -> u32 {
    // SAFETY: the context is the kernel's.
    let cookie = unsafe { bpf_get_attach_cookie(context.as_ptr()) };
    // SAFETY: programs of the same type, which user space has set.
    unsafe { CALLS.tail_call(&context, cookie as u32) };
    0
}

/// Runs whenever a CPU changes from one thread to another.
#[raw_tracepoint]
pub fn sched_switch(context: RawTracePointContext) -> u32 {
    scheduler::on_sched_switch(&context);
    0
}

/// Runs whenever a thread is woken.
#[raw_tracepoint]
pub fn sched_waking(context: RawTracePointContext) -> u32 {
    scheduler::on_sched_waking(&context);
    0
}

calls! {
    /// `(rcl_publisher_t *, message)`.
    rcl_publish(publisher) { messages::published(publisher, false); }
    /// `(rcl_publisher_t *, message)`, before the message enters the subscriptions' buffers.
    rclcpp_intra_publish(publisher) { messages::published(publisher, true); }
    /// `(rmw_subscription_t *, message, source timestamp, bool taken)`.
    rmw_take(subscription, _message, source_timestamp, taken) {
        messages::taken(subscription, source_timestamp, taken as u8 != 0);
    }
    /// `(buffer, index, size, bool overwritten)`.
    rclcpp_ring_buffer_enqueue(buffer, index, size, overwritten) {
        messages::enqueued(buffer, index, size as u32, overwritten as u8 != 0);
    }
    /// `(buffer, index, size)`.
    rclcpp_ring_buffer_dequeue(buffer, index, size) {
        messages::dequeued(buffer, index, size as u32);
    }
    /// `(buffer)`.
    rclcpp_ring_buffer_clear(buffer) { messages::cleared(buffer); }

    /// `(callback, bool intra_process)`.
    callback_start(callback, intra_process) {
        callbacks::on_callback_start(callback, intra_process as u8 != 0);
    }
    /// As `callback_start`, if only received messages are counted.
    callback_received(callback, intra_process) {
        if intra_process as u8 != 0 {
            callbacks::count_intra_process_message(callback);
        }
    }
    /// `(callback)`.
    callback_end(callback) { callbacks::on_callback_end(callback); }
    /// `(rcl_timer_t * or rcl_subscription_t *)`.
    rclcpp_executor_execute(handle) { callbacks::on_executor_execute(handle); }

    /// `(rcl_node_t *, rmw_node_t *, name, namespace)`.
    rcl_node_init(node, _rmw, name, namespace) {
        names::announce(announced::NODE, node, 0, 0, name, namespace);
    }
    /// `(rcl_publisher_t *, rcl_node_t *, rmw_publisher_t *, topic, depth)`.
    rcl_publisher_init(publisher, node, rmw, topic) {
        names::publisher_created(publisher, node, rmw, topic);
    }
    /// `(rcl_subscription_t *, rcl_node_t *, rmw_subscription_t *, topic, depth)`.
    rcl_subscription_init(subscription, node, rmw, topic) {
        names::subscription_created(subscription, node, rmw, topic);
    }
    /// `(rcl_subscription_t *, rclcpp subscription)`.
    rclcpp_subscription_init(handle, subscription) {
        names::announce(announced::SUBSCRIPTION_OBJECT, subscription, handle, 0, 0, 0);
    }
    /// `(rclcpp subscription, callback)`.
    rclcpp_subscription_callback_added(subscription, callback) {
        names::callback_created(announced::SUBSCRIPTION_CALLBACK, callback, subscription);
    }
    /// `(rcl_timer_t *, period)`.
    rcl_timer_init(timer, period) {
        names::announce(announced::TIMER, timer, 0, period, 0, 0);
    }
    /// `(rcl_timer_t *, rcl_node_t *)`.
    rclcpp_timer_link_node(timer, node) {
        names::announce(announced::TIMER_NODE, timer, node, 0, 0, 0);
    }
    /// `(rcl_timer_t *, callback)`.
    rclcpp_timer_callback_added(timer, callback) {
        names::callback_created(announced::TIMER_CALLBACK, callback, timer);
    }
    /// `(rcl_service_t *, rcl_node_t *, rmw_service_t *, name)`.
    rcl_service_init(service, node, _rmw, name) {
        names::announce(announced::SERVICE, service, node, 0, name, 0);
    }
    /// `(rcl_service_t *, callback)`.
    rclcpp_service_callback_added(service, callback) {
        names::callback_created(announced::SERVICE_CALLBACK, callback, service);
    }
    /// `(rcl_node_t *, state machine)`.
    rcl_lifecycle_state_machine_init(node, machine) {
        names::announce(announced::STATE_MACHINE, machine, node, 0, 0, 0);
    }
    /// `(state machine, label of the start state, label of the goal state)`.
    rcl_lifecycle_transition(machine, start, goal) {
        names::announce(announced::TRANSITION, machine, 0, 0, start, goal);
    }
    /// `(buffer, capacity)`.
    rclcpp_construct_ring_buffer(buffer, capacity) {
        names::buffer_created(buffer, capacity);
    }
    /// `(ring buffer, intra-process buffer)`.
    rclcpp_buffer_to_ipb(buffer, owner) {
        names::announce(announced::BUFFER_OWNER, owner, buffer, 0, 0, 0);
    }
    /// `(intra-process buffer, rclcpp subscription)`.
    rclcpp_ipb_to_subscription(owner, subscription) {
        names::announce(announced::BUFFER_SUBSCRIPTION, owner, subscription, 0, 0, 0);
    }
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    loop {}
}

#[unsafe(link_section = "license")]
#[unsafe(no_mangle)]
static LICENSE: [u8; 4] = *b"GPL\0";
