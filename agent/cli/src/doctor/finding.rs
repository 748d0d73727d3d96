//! What a check says: one sentence, what it rests on, what to do. Nothing here looks at anything.

use serde::Serialize;

/// How one thing is, from good to bad.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// As it should be.
    Ok,
    /// Good to know: what will not be shown, and by what choice.
    Note,
    /// It could not be looked at.
    Unknown,
    /// It costs something: an answer will be wrong or missing.
    Warning,
    /// It is broken.
    Problem,
}

/// What a check is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Area {
    /// The agent itself.
    Agent,
    /// What it can see here.
    Sight,
    /// What the kernel has.
    Kernel,
    /// What this shell and the agent may do.
    Privileges,
    /// Network interfaces.
    Interfaces,
    /// ROS variables of this shell.
    Shell,
    /// ROS processes of this host.
    Processes,
    /// What the agent found.
    Graph,
    /// Buffers of sockets and of IP reassembly.
    Buffers,
    /// The clock.
    Clock,
}

/// The result of one check.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// What it is about.
    pub area: Area,
    /// The check's name, the same on every host.
    pub check: &'static str,
    /// How it is.
    #[serde(rename = "verdict")]
    pub severity: Severity,
    /// In plain words.
    pub sentence: String,
    /// What that rests on.
    pub evidence: Vec<Evidence>,
    /// What to do, each by itself.
    pub remedies: Vec<Remedy>,
}

/// A value that was read.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Evidence {
    /// The value, or why there is none.
    pub value: String,
    /// Where it was read: a file, a path of the control API, a system call.
    pub from: String,
}

/// One thing that helps.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Remedy {
    /// Where the line goes.
    pub kind: RemedyTarget,
    /// To be pasted there; what is in capitals is to be filled in.
    pub line: String,
    /// What to know of it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub comment: Option<String>,
}

/// Where a remedy goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RemedyTarget {
    /// A shell.
    Command,
    /// The agent's configuration file.
    Configuration,
    /// Settings of another program, which the comment names.
    Elsewhere,
}

impl Area {
    /// Its heading.
    #[must_use]
    pub const fn title(self) -> &'static str {
        match self {
            Self::Agent => "Agent",
            Self::Sight => "What it sees",
            Self::Kernel => "Kernel",
            Self::Privileges => "Privileges",
            Self::Interfaces => "Interfaces",
            Self::Shell => "ROS in this shell",
            Self::Processes => "ROS processes",
            Self::Graph => "Graph",
            Self::Buffers => "Buffers",
            Self::Clock => "Clock",
        }
    }
}

impl Severity {
    /// All, from bad to good.
    pub const ALL: [Self; 5] = [
        Self::Problem,
        Self::Warning,
        Self::Unknown,
        Self::Note,
        Self::Ok,
    ];

    /// As it is printed.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Note => "note",
            Self::Unknown => "unknown",
            Self::Warning => "warning",
            Self::Problem => "problem",
        }
    }
}

impl Finding {
    /// Without evidence and remedies so far.
    pub fn new(
        area: Area,
        check: &'static str,
        severity: Severity,
        sentence: impl Into<String>,
    ) -> Self {
        Self {
            area,
            check,
            severity,
            sentence: sentence.into(),
            evidence: Vec::new(),
            remedies: Vec::new(),
        }
    }

    /// Rests on this too.
    #[must_use]
    pub fn seen(mut self, value: impl Into<String>, from: impl Into<String>) -> Self {
        let (value, from) = (value.into(), from.into());
        self.evidence.push(Evidence { value, from });
        self
    }

    /// This command helps. Four spaces and `#` begin a comment, here and below.
    #[must_use]
    pub fn remedy(self, line: impl Into<String>) -> Self {
        self.with(RemedyTarget::Command, line.into())
    }

    /// This in the agent's configuration helps.
    #[must_use]
    pub fn configure(self, line: impl Into<String>) -> Self {
        self.with(RemedyTarget::Configuration, line.into())
    }

    /// This helps, where the comment says.
    #[must_use]
    pub fn elsewhere(self, line: impl Into<String>) -> Self {
        self.with(RemedyTarget::Elsewhere, line.into())
    }

    fn with(mut self, kind: RemedyTarget, line: String) -> Self {
        let (line, comment) = match line.split_once("    # ") {
            Some((line, comment)) => (line.to_owned(), Some(comment.to_owned())),
            None => (line, None),
        };
        self.remedies.push(Remedy {
            kind,
            line,
            comment,
        });
        self
    }
}
