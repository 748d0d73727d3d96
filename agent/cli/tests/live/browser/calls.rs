//! A process that calls `libtracetools.so` as `rclcpp` does, with steps that ROS 2 Humble does not
//! report.

use std::time::Duration;

use anyhow::Result;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::traced_program::TracedProgram;

use super::robot::Place;

const PATIENCE: Duration = Duration::from_secs(60);

/// The node `/robot1/filter`, which reads `/in` and publishes `/out`.
pub(crate) struct Filter {
    process: Process,
    _program: TracedProgram,
}

impl Filter {
    /// Starts the process, which has called nothing yet.
    pub(crate) fn start(place: &Place) -> Result<Self> {
        let program = TracedProgram::build(240, &[])?;
        let path = program.program().display().to_string();
        let words = ["ROS_DOMAIN_ID=0", &path];
        let process = Process::start(&place.host.inside(), "env", words)?;
        Ok(Self {
            process,
            _program: program,
        })
    }

    /// Creates the node and makes it active.
    pub(crate) fn create(&mut self) -> Result<()> {
        self.run("init")?;
        self.run("transition")
    }

    /// Publishes 60 messages: 30 also within the process, and 20 within the callback of a message
    /// that it takes. Calls a timer 20 times.
    pub(crate) fn publish_messages(&mut self) -> Result<()> {
        self.run("publish 10 100")?;
        self.run("both 30")?;
        self.run("timer 20 100")?;
        // The process prints figures before the name of this command.
        self.process.write_line("receive 4 1000")?;
        self.process.write_line("take 20 2000")?;
        self.run("miss 3")
    }

    /// Calls a callback so often that its usual duration is known.
    pub(crate) fn usual(&mut self) -> Result<()> {
        self.process.write_line("compute 400 100")?;
        self.process.line_with_end("compute", PATIENCE).map(drop)
    }

    /// Calls it once with a sleep that is longer than the waits of a busy machine.
    pub(crate) fn late(&mut self) -> Result<()> {
        self.process.write_line("sleep 1 400000")?;
        self.process.line_with_end("sleep", PATIENCE).map(drop)
    }

    fn run(&mut self, command: &str) -> Result<()> {
        self.process.write_line(command)?;
        let name = command.split(' ').next().unwrap_or(command);
        self.process.wait_for(name, PATIENCE)
    }
}
