//! Mistakes in a configuration, with their positions.

use std::fmt;

use crate::escape::visible;

/// Position in the file, counted from one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Position {
    /// Line number.
    pub line: usize,
    /// Column in characters.
    pub column: usize,
}

impl fmt::Display for Position {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.line, self.column)
    }
}

/// One mistake.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Mistake {
    /// Position of the mistake.
    pub position: Position,
    /// The key with its parents, `watch[2].min_rate_hz`; empty for the document itself.
    pub key: String,
    /// The mistake, and the accepted values.
    pub message: String,
}

impl fmt::Display for Mistake {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: ", self.position)?;
        // Key and message quote the file.
        if !self.key.is_empty() {
            write!(f, "{}: ", visible(&self.key))?;
        }
        f.write_str(&visible(&self.message))
    }
}

/// All mistakes of one file, in file order.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Mistakes(Vec<Mistake>);

impl Mistakes {
    /// Maximum number of mistakes printed.
    const MAX_SHOWN: usize = 50;

    /// Adds a mistake.
    pub fn add(&mut self, position: Position, key: &str, message: impl Into<String>) {
        self.0.push(Mistake {
            position,
            key: key.to_owned(),
            message: message.into(),
        });
    }

    /// Returns `value` if there are no mistakes.
    ///
    /// # Errors
    ///
    /// Returns all mistakes in file order.
    pub fn none_or<T>(mut self, value: T) -> Result<T, Self> {
        if self.0.is_empty() {
            return Ok(value);
        }
        self.0.sort();
        self.0.dedup();
        Err(self)
    }

    /// Returns whether there are no mistakes.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Iterates over all mistakes.
    pub fn iter(&self) -> impl Iterator<Item = &Mistake> {
        self.0.iter()
    }

    /// Formats one line per mistake, as compilers do: `file:line:column: key: message`.
    #[must_use]
    pub fn report(&self, file: &str) -> String {
        let mut lines: Vec<String> = self
            .0
            .iter()
            .take(Self::MAX_SHOWN)
            .map(|mistake| format!("{file}:{mistake}"))
            .collect();
        if let Some(more) = self
            .0
            .len()
            .checked_sub(Self::MAX_SHOWN)
            .filter(|more| *more > 0)
        {
            lines.push(format!("{file}: and {more} more"));
        }
        lines.join("\n")
    }
}
