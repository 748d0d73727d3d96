//! Programs at the functions of `libtracetools.so`, in processes that call them as rclcpp does.

mod deliveries;
mod handoffs;
mod kernel_trace;
mod late;
mod overlays;
mod thread_states;

use std::fs::File;
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use ros2probe_attach::client::Broker;
use ros2probe_capture::breakpoints::AttachMethod;
use ros2probe_capture::filter::Deliveries;
use ros2probe_capture::inside::programs::{self, Attached, Events, Programs, Tables};
use ros2probe_capture::inside::table::{MAX_PROCESS_HITS, ProcessTable, Round};
use ros2probe_capture::system::Clocks;
use ros2probe_model::facts::calls::report::{Durations, ProcessReport, Trigger};
use ros2probe_testing::harness::traced_program::TracedProgram;
use ros2probe_wire::inside::{Counter, HANDLE_CAPACITY, HOPS_PER_SECOND};

/// Time in which the kernel removes breakpoints on a busy machine.
const PATIENCE: Duration = Duration::from_secs(20);

/// A library and a program, with the kernel programs attached.
struct Robot {
    program: TracedProgram,
    programs: Programs,
    tables: Tables,
    table: ProcessTable,
    attached: Option<Attached>,
    events: Option<Events>,
    deliveries: Option<Deliveries>,
}

/// A process that takes commands.
struct Process {
    child: Child,
    commands: ChildStdin,
    answers: BufReader<ChildStdout>,
}

impl Robot {
    /// Builds the program with compiler options `defines`, such as `-DHUMBLE`.
    fn new(place: u32, defines: &[&str], has_callbacks: bool) -> Self {
        Self::by(
            AttachMethod::of_this_kernel(),
            place,
            defines,
            has_callbacks,
        )
    }

    fn by(means: AttachMethod, place: u32, defines: &[&str], has_callbacks: bool) -> Self {
        let program = TracedProgram::build(place, defines).unwrap();
        let (programs, mut tables) = programs::load(has_callbacks, None, means)
            .expect("loading the kernel programs needs root: run the tests with sudo");
        tables.set_clocks(&Clocks::read()).unwrap();
        Self {
            program,
            programs,
            tables,
            table: ProcessTable::new(has_callbacks),
            attached: None,
            events: None,
            deliveries: None,
        }
    }

    fn attach(&mut self) {
        let library = File::open(self.program.library()).unwrap();
        self.attached = Some(self.programs.attach_here(&library).unwrap());
    }

    fn start(&self) -> Process {
        Process::start(&self.program.program())
    }

    fn round(&mut self) -> Round {
        self.round_after(Duration::from_secs(1))
    }

    /// Reads the tables as if this time had passed since the last round.
    fn round_after(&mut self, elapsed: Duration) -> Round {
        self.round_with(&mut Broker::here(), elapsed)
    }

    fn round_with(&mut self, broker: &mut Broker, elapsed: Duration) -> Round {
        let shows = self
            .attached
            .as_ref()
            .is_some_and(|it| it.shows_intra_process);
        let clocks = Clocks::read();
        let deliveries = self.deliveries.as_ref();
        self.table.round(
            &mut self.tables,
            &clocks,
            elapsed,
            broker,
            |_| shows,
            |call| deliveries?.of(call),
        )
    }

    /// Returns the report of a process.
    fn report(&mut self, process: &Process) -> ProcessReport {
        let id = process.child.id();
        let reports = self.round().report.processes;
        let report = reports.into_iter().find(|report| report.id == id);
        report.unwrap()
    }

    fn counter(&self, counter: Counter) -> u64 {
        self.tables.counters().unwrap()[counter as usize]
    }
}

impl Process {
    fn start(program: &Path) -> Self {
        Self::with(program, &[])
    }

    fn with(program: &Path, arguments: &[&str]) -> Self {
        let mut child = Command::new(program)
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .env("ROS_DOMAIN_ID", "7")
            .spawn()
            .unwrap();
        let commands = child.stdin.take().unwrap();
        let answers = BufReader::new(child.stdout.take().unwrap());
        Self {
            child,
            commands,
            answers,
        }
    }

    fn run(&mut self, command: &str) -> String {
        self.begin(command);
        self.end(command.split(' ').next().unwrap())
    }

    fn begin(&mut self, command: &str) {
        writeln!(self.commands, "{command}").unwrap();
    }

    /// Waits for the end of a command, and returns its answer.
    fn end(&mut self, name: &str) -> String {
        let mut answer = String::new();
        self.answers.read_line(&mut answer).unwrap();
        assert!(answer.trim_end().ends_with(name), "{name}: {answer}");
        answer
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Returns the means of this kernel, and the means that every kernel has; they may be the same.
fn attach_methods() -> [AttachMethod; 2] {
    [AttachMethod::of_this_kernel(), AttachMethod::PerfEvents]
}

fn milliseconds(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1000.0
}

#[test]
fn messages_of_a_process_older_than_the_probes_are_counted_and_named() {
    for (place, means) in [240, 248].into_iter().zip(attach_methods()) {
        let mut robot = Robot::by(means, place, &[], false);
        let mut process = robot.start();
        // The programs are attached while the process runs, so it has announced nothing.
        process.run("publish 5");
        robot.attach();
        process.run("publish 1000");
        process.run("take 200");
        process.run("miss 3");
        let report = robot.report(&process);
        let [publisher] = &report.publishers[..] else {
            panic!("{report:?}");
        };
        assert_eq!((&*publisher.topic, publisher.published), ("/out", 1200));
        assert_eq!(publisher.middleware.as_deref(), Some("rmw_test_cpp"));
        assert_eq!(publisher.intervals.count(), 1199);
        let [subscription] = &report.subscriptions[..] else {
            panic!("{report:?}");
        };
        assert_eq!(&*subscription.topic, "/in");
        assert_eq!((subscription.taken, subscription.failed), (200, 3));
        let latency = subscription.latency.quantile(0.5).unwrap();
        assert!((5.0..9.0).contains(&milliseconds(latency)), "{latency:?}");
        assert_eq!(
            (report.domain_id.0, report.name.as_deref()),
            (7, Some("process"))
        );
        assert!(report.callbacks.is_empty());
        // Nothing has changed since.
        let again = robot.report(&process);
        assert!(again.publishers.is_empty() && again.subscriptions.is_empty());
    }
}

#[test]
fn a_process_has_its_domain_and_name_once_the_broker_answers() {
    let mut robot = Robot::new(248, &[], false);
    robot.attach();
    let mut process = robot.start();
    process.run("publish 5");
    let mut absent = Broker::at(Path::new("/nonexistent/broker.sock"));
    let reports = robot.round_with(&mut absent, Duration::from_secs(1)).report;
    let report = &reports.processes[0];
    assert_eq!((report.domain_id.0, &report.name), (0, &None));
    assert_eq!(report.cpu, None);
    let report = robot.report(&process);
    assert_eq!(report.domain_id.0, 7);
    assert!(report.cpu.is_some() && report.name.is_some());
}

#[test]
fn a_message_within_a_process_and_beyond_it_counts_once() {
    let mut robot = Robot::new(248, &[], false);
    robot.attach();
    let mut process = robot.start();
    process.run("init");
    // The process publishes to other processes, then to all, then only to itself.
    process.run("publish 10");
    process.run("both 100");
    process.run("enqueue 50");
    process.run("both 1");
    let report = robot.report(&process);
    let publisher = &report.publishers[0];
    assert_eq!((publisher.published, publisher.within_process), (161, 151));
    assert_eq!(publisher.node.as_deref(), Some("/robot1/filter"));
    assert_eq!(report.nodes, ["/robot1/filter"]);
    assert!(report.shows_intra_process);
}

#[test]
fn overwritten_messages_equal_those_that_the_subscription_misses() {
    for has_init in [true, false] {
        let mut robot = Robot::new(248, &[], true);
        let mut process = robot.start();
        if has_init {
            robot.attach();
            process.run("init");
        }
        robot.attach();
        let mut received = 0;
        for (sent, taken) in [(3, 3), (10, 2), (1, 9), (7, 1), (0, 9)] {
            process.run(&format!("enqueue {sent}"));
            let answer = process.run(&format!("receive {taken} 200"));
            received += answer.split(' ').next().unwrap().parse::<u64>().unwrap();
        }
        let report = robot.report(&process);
        let buffer = &report.buffers[0];
        assert_eq!(
            buffer.topic.as_deref(),
            Some(if has_init { "/in" } else { "/out" })
        );
        assert_eq!(buffer.capacity, has_init.then_some(4));
        assert_eq!((buffer.enqueued, buffer.dequeued), (21, received));
        assert_eq!(buffer.overwritten, buffer.enqueued - received);
        assert_eq!((buffer.depth, buffer.max_depth), (0, 4));
        assert_eq!(buffer.waiting.count(), received);
        let callback = &report.callbacks[0];
        assert_eq!(callback.calls, received);
        assert!(matches!(&callback.trigger, Trigger::IntraProcess(Some(_))));
        assert!(callback.durations.range().unwrap().0 >= Duration::from_micros(200));
        assert_eq!(callback.waits.count(), received);
    }
}

#[test]
fn messages_within_a_process_without_ring_buffers_appear_in_callbacks() {
    for has_callbacks in [false, true] {
        let mut robot = Robot::new(240, &["-DHUMBLE"], has_callbacks);
        robot.attach();
        let mut process = robot.start();
        process.run("init");
        process.run("receive 12");
        let report = robot.report(&process);
        assert!(!report.shows_intra_process);
        let [callback] = &report.callbacks[..] else {
            panic!("{report:?}");
        };
        assert_eq!(callback.calls, 12);
        assert_eq!(callback.trigger, Trigger::IntraProcess(None));
    }
}

#[test]
fn callbacks_have_triggers_durations_waits_and_effects() {
    let mut robot = Robot::new(248, &[], true);
    robot.attach();
    let mut process = robot.start();
    process.run("init");
    let measured = process.run("take 20 3000");
    let measured: Vec<f64> = measured
        .split(' ')
        .filter_map(|ns| ns.parse().ok())
        .collect();
    process.run("timer 10 400");
    process.run("timer 1 0");
    process.run("transition");
    let round = robot.round();
    let report = round.report.processes.into_iter().next().unwrap();
    let callback = |trigger: &Trigger| {
        let mut callbacks = report.callbacks.iter();
        callbacks
            .find(|callback| callback.trigger == *trigger)
            .unwrap()
    };
    let subscription = callback(&Trigger::Subscription("/in".into()));
    assert_eq!(
        (subscription.calls, subscription.node.as_deref()),
        (20, Some("/robot1/filter"))
    );
    assert!(subscription.durations.range().unwrap().0 >= Duration::from_millis(3));
    let timer = callback(&Trigger::Timer(Some(Duration::from_millis(1))));
    assert_eq!(
        (timer.calls, timer.node.as_deref()),
        (11, Some("/robot1/filter"))
    );
    let wait = timer.waits.quantile(0.5).unwrap();
    assert!(milliseconds(wait) >= 0.4, "{wait:?}");
    // On a busy machine, some calls wait longer for a CPU.
    let (shortest, _) = timer.waits.range().unwrap();
    assert!(milliseconds(shortest) < 5.0, "{shortest:?}");

    let hops = &round.publications;
    assert_eq!(hops.len(), 20);
    let mut differences: Vec<f64> = hops
        .iter()
        .zip(&measured)
        .map(|(hop, measured)| {
            assert_eq!((&*hop.input, &*hop.output), ("/in", "/out"));
            assert!(
                hop.taken - hop.input_source >= Duration::from_millis(5),
                "{hop:?}"
            );
            (milliseconds(hop.published - hop.started) - measured / 1e6).abs()
        })
        .collect();
    // The process may lose its CPU between its clock and the call, but not often.
    differences.sort_by(f64::total_cmp);
    assert!(differences[10] < 0.2, "{differences:?}");
    let [transition] = &round.report.transitions[..] else {
        panic!("{:?}", round.report.transitions);
    };
    assert_eq!(
        (&*transition.start, &*transition.goal),
        ("inactive", "active")
    );
    assert_eq!(transition.node.as_deref(), Some("/robot1/filter"));
}

#[test]
fn messages_of_a_publisher_whose_clock_is_ahead_have_waits() {
    let mut robot = Robot::new(248, &[], true);
    robot.attach();
    let mut process = robot.start();
    process.run("init");
    for ahead in [40, 40, 40, 20].map(Duration::from_secs) {
        let source = SystemTime::now().duration_since(UNIX_EPOCH).unwrap() + ahead;
        process.run(&format!("relay {} 0", source.as_nanos()));
    }
    let report = robot.report(&process);
    let [callback] = &report.callbacks[..] else {
        panic!("{report:?}");
    };
    let (_, longest) = callback.waits.range().unwrap();
    let expected = Duration::from_secs(10)..Duration::from_secs(30);
    assert!(expected.contains(&longest), "{longest:?}");
}

/// `rmw_fastrtps_cpp` of Lyrical takes messages of buffer topics without `rmw_take`. The process is
/// older than the probes in one round, and younger in the other.
#[test]
fn the_period_and_the_wait_of_a_timer_are_read_by_either_steady_clock() {
    for clock in ["CLOCK_MONOTONIC_RAW", "CLOCK_MONOTONIC"] {
        let mut robot = Robot::new(248, &[&format!("-DSTEADY={clock}")], true);
        robot.attach();
        let mut process = robot.start();
        process.run("timer 20 400");
        let report = robot.report(&process);
        let [timer] = &report.callbacks[..] else {
            panic!("{clock}: {report:?}");
        };
        let period = Trigger::Timer(Some(Duration::from_millis(1)));
        assert_eq!((timer.calls, &timer.trigger), (20, &period), "{clock}");
        let wait = timer.waits.quantile(0.5).unwrap();
        assert!(milliseconds(wait) >= 0.4, "{clock}: {wait:?}");
        // On a busy machine, some calls wait longer for a CPU.
        let (shortest, _) = timer.waits.range().unwrap();
        assert!(milliseconds(shortest) < 5.0, "{clock}: {shortest:?}");
    }
}

/// Returns an observed process, which is older than the observation or creates its entities under
/// it.
fn attached(is_older: bool) -> (Robot, Process) {
    let mut robot = Robot::new(248, &[], true);
    if !is_older {
        robot.attach();
    }
    let mut process = robot.start();
    if is_older {
        robot.attach();
    } else {
        process.run("init");
    }
    (robot, process)
}

#[test]
fn messages_taken_without_rmw_take_count_as_subscription_calls() {
    for is_older in [true, false] {
        let (mut robot, mut process) = attached(is_older);
        process.run("buffers 7 2000");
        let report = robot.report(&process);
        let [callback] = &report.callbacks[..] else {
            panic!("{:?}", report.callbacks);
        };
        assert_eq!(callback.trigger, Trigger::Subscription("/in".into()));
        assert_eq!(callback.calls, 7);
        let [subscription] = &report.subscriptions[..] else {
            panic!("{:?}", report.subscriptions);
        };
        assert_eq!((&*subscription.topic, subscription.taken), ("/in", 7));
    }
}

#[test]
fn a_request_after_a_message_that_was_not_there_belongs_to_the_service() {
    for is_older in [true, false] {
        let (mut robot, mut process) = attached(is_older);
        process.run("serve 7 2000");
        let report = robot.report(&process);
        let [callback] = &report.callbacks[..] else {
            panic!("{:?}", report.callbacks);
        };
        let name = (!is_older).then(|| "/robot1/reset".into());
        assert_eq!(callback.trigger, Trigger::Service(name));
        assert_eq!(callback.calls, 7);
        let taken: u64 = report.subscriptions.iter().map(|of| of.taken).sum();
        assert_eq!(taken, 0, "{:?}", report.subscriptions);
    }
}

#[test]
fn causal_publications_beyond_the_rate_are_skipped_and_counted() {
    let mut robot = Robot::new(248, &[], true);
    robot.attach();
    let mut process = robot.start();
    let begun = Instant::now();
    process.run("take 1000");
    let seconds = usize::try_from(begun.elapsed().as_secs()).unwrap();
    let round = robot.round();
    let reported = round.publications.len();
    // The calls belong to one second more than they take, or two.
    let per_second = HOPS_PER_SECOND as usize;
    let expected = per_second..=per_second * (seconds + 2);
    assert!(expected.contains(&reported), "{reported} {seconds}");
    assert!(reported < 1000, "{seconds}");
    assert_eq!(robot.counter(Counter::HopsSkipped), 1000 - reported as u64);
    assert_eq!(round.report.processes[0].publishers[0].published, 1000);
}

#[test]
fn a_killed_process_leaves_its_last_figures_and_no_entry() {
    let mut robot = Robot::new(248, &[], false);
    robot.attach();
    let mut process = robot.start();
    process.run("publish 77");
    process.child.kill().unwrap();
    process.child.wait().unwrap();
    let report = robot.report(&process);
    assert!(report.has_ended);
    assert_eq!(report.publishers[0].published, 77);
    assert!(robot.round().report.processes.is_empty());
    assert_eq!((robot.table.len(), robot.tables.figures().count()), (0, 0));
}

#[test]
fn no_breakpoint_remains_after_the_probes_are_removed() {
    for means in attach_methods() {
        let mut robot = Robot::by(means, 248, &[], true);
        robot.attach();
        let mut process = robot.start();
        process.run("publish 1");
        assert!(breakpoint(&robot.program, &process));
        robot.attached = None;
        process.run("publish 1000");
        // The kernel restores the code later than it ends the programs.
        let began = Instant::now();
        while breakpoint(&robot.program, &process) {
            assert!(began.elapsed() < PATIENCE, "a breakpoint remains");
            std::thread::sleep(Duration::from_millis(50));
        }
        assert_eq!(robot.report(&process).publishers[0].published, 1);
    }
}

/// Returns whether the process's code of the library differs from the file.
fn breakpoint(program: &TracedProgram, process: &Process) -> bool {
    use std::os::unix::fs::FileExt as _;
    let library = program.library();
    let maps = std::fs::read_to_string(format!("/proc/{}/maps", process.child.id())).unwrap();
    let line = maps
        .lines()
        .find(|line| line.contains("r-xp") && line.ends_with(library.to_str().unwrap()))
        .unwrap();
    let mut fields = line.split([' ', '-']);
    let mut hexadecimal = || u64::from_str_radix(fields.next().unwrap(), 16).unwrap();
    let (start, end) = (hexadecimal(), hexadecimal());
    let offset = line.split(' ').nth(2).unwrap();
    let offset = u64::from_str_radix(offset, 16).unwrap();
    let mut loaded = vec![0; usize::try_from(end - start).unwrap()];
    let memory = File::open(format!("/proc/{}/mem", process.child.id())).unwrap();
    memory.read_exact_at(&mut loaded, start).unwrap();
    let file = std::fs::read(&library).unwrap();
    let offset = usize::try_from(offset).unwrap();
    let length = loaded.len().min(file.len() - offset);
    loaded[..length] != file[offset..offset + length]
}

#[test]
fn handles_with_invalid_addresses_are_bounded_and_counted() {
    let mut robot = Robot::new(248, &[], true);
    robot.attach();
    let mut hostile = robot.start();
    let mut process = robot.start();
    process.run("publish 10");
    hostile.run("nowhere 100000");
    process.run("publish 10");
    let round = robot.round();
    let of = |id: u32| {
        let reports = &round.report.processes;
        reports.iter().find(|report| report.id == id).unwrap()
    };
    assert_eq!(of(process.child.id()).publishers[0].published, 20);
    let hostile = of(hostile.child.id());
    assert!(hostile.refused > 100_000, "{hostile:?}");
    assert!(hostile.publishers.is_empty() && hostile.subscriptions.is_empty());
    assert!(hostile.is_suspended);
    assert_eq!(robot.tables.figures().count(), HANDLE_CAPACITY as usize);
    assert!(robot.counter(Counter::Unreadable) > 0);
    assert!(robot.counter(Counter::HandlesFull) > 100_000);
}

#[test]
fn endlessly_created_processes_are_bounded_and_forgotten() {
    let mut robot = Robot::new(248, &[], false);
    robot.attach();
    let mut process = robot.start();
    process.run("publish 1");
    process.run("fork 1500");
    let refused = robot.counter(Counter::ProcessesFull);
    assert_eq!(refused, 1501 - 1024);
    let round = robot.round();
    let reports = &round.report.processes;
    assert_eq!(reports.len(), 1024);
    assert_eq!(
        reports.iter().filter(|report| report.has_ended).count(),
        1023
    );
    assert_eq!(robot.table.len(), 1);
    process.run("fork 1");
    assert_eq!(robot.counter(Counter::ProcessesFull), refused);
}

#[test]
fn a_process_beyond_its_budget_is_no_longer_counted_until_it_slows_down() {
    let mut robot = Robot::new(248, &[], false);
    robot.attach();
    let mut process = robot.start();
    process.run(&format!("publish {}", MAX_PROCESS_HITS + 1));
    let report = robot.report(&process);
    assert!(report.is_suspended);
    assert_eq!(report.publishers[0].published, MAX_PROCESS_HITS + 1);
    process.run("publish 100");
    assert_eq!(robot.counter(Counter::Suspended), 100);
    let report = robot.report(&process);
    assert!(!report.is_suspended && report.publishers.is_empty());
    process.run("publish 5");
    assert_eq!(
        robot.report(&process).publishers[0].published,
        MAX_PROCESS_HITS + 6
    );
}

#[test]
fn the_budget_applies_before_announcements_are_read() {
    let mut robot = Robot::new(248, &[], true);
    robot.attach();
    let mut process = robot.start();
    let over = Duration::from_millis(500);
    process.run(&format!("publish {}", MAX_PROCESS_HITS));
    let tables = &mut robot.tables;
    let hits = (robot.table).apply_budgets(tables, over, &mut Broker::here());
    assert!(hits >= 2 * MAX_PROCESS_HITS, "{hits}");
    process.run("transition");
    assert_eq!(robot.counter(Counter::Suspended), 1);
    assert!(robot.round().report.transitions.is_empty());
}

#[test]
fn no_call_or_interval_after_a_suspension_includes_it() {
    let mut robot = Robot::new(248, &[], true);
    robot.attach();
    let mut process = robot.start();
    process.run("init");
    process.run("take 1");
    process.run(&format!("publish {}", MAX_PROCESS_HITS + 1));
    // One callback begins before the suspension, and the next one during it.
    let pause = Duration::from_millis(150);
    for is_suspended in [true, false] {
        process.begin("take 1 300000");
        std::thread::sleep(pause);
        assert_eq!(robot.report(&process).is_suspended, is_suspended);
        process.end("take");
        if is_suspended {
            std::thread::sleep(2 * pause);
        }
    }
    process.run("take 1");
    let report = robot.report(&process);
    let callback = &report.callbacks[0];
    let longest = |durations: &Durations| durations.range().unwrap().1;
    assert_eq!(callback.calls, 2, "the other two were not observed whole");
    assert!(longest(&callback.durations) < pause, "{callback:?}");
    let publisher = &report.publishers[0];
    assert!(longest(&publisher.intervals) < 3 * pause, "{publisher:?}");
    let subscription = &report.subscriptions[0];
    assert_eq!(subscription.intervals.count(), 1, "between the first two");
}

#[test]
fn calls_in_a_very_short_time_are_evaluated_with_later_calls() {
    let mut robot = Robot::new(240, &[], false);
    robot.attach();
    let mut process = robot.start();
    process.run("init");
    let calls = MAX_PROCESS_HITS / 10;
    for milliseconds in [1, 498] {
        process.run(&format!("publish {calls}"));
        let round = robot.round_after(Duration::from_millis(milliseconds));
        assert_eq!(round.hits, 0);
        assert!(!round.report.processes[0].is_suspended);
    }
    let round = robot.round_after(Duration::from_millis(1));
    assert_eq!(round.hits / 1000, 2 * calls / 500);
    assert!(!round.report.processes[0].is_suspended);
}

#[test]
fn a_file_without_the_functions_is_refused() {
    let robot = Robot::new(248, &[], false);
    let program = File::open(robot.program.program()).unwrap();
    let refused = robot.programs.attach_here(&program).err().unwrap();
    assert!(
        refused.to_string().contains("ros_trace_rcl_publish"),
        "{refused}"
    );
    let garbage = robot.program.library().with_extension("garbage");
    std::fs::write(&garbage, [0x7f, b'E', b'L', b'F', 2, 1].repeat(999)).unwrap();
    assert!(
        robot
            .programs
            .attach_here(&File::open(garbage).unwrap())
            .is_err()
    );
}
