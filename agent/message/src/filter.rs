//! Conditions on messages: a subset of Python's expressions over `m`, for `--filter`.
//!
//! Supports attributes, indices, numbers, strings, comparisons (also chained), `in`, `and`, `or`,
//! `not`, arithmetic, and lists. Functions: `abs`, `all`, `any`, `bool`, `float`, `int`, `len`,
//! `max`, `min`, `str` and `sum`. Assignments, definitions, imports and loops do not exist: an
//! expression terminates, needs little memory, and changes nothing.

mod evaluate;
mod parse;
mod tokens;

use std::fmt;

pub use evaluate::Subject;

/// Maximum length of an expression, in bytes.
const MAX_LENGTH: usize = 4096;
/// Maximum number of tokens: a chain of operators is as deep as it is long.
const MAX_WORDS: usize = 400;

/// A condition.
#[derive(Debug, Clone, PartialEq)]
pub struct Filter(Node);

/// Why an expression is invalid, or has no value for a message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FilterError {
    /// Position in the expression, counted in characters from 1.
    pub column: usize,
    /// Description of the mistake.
    pub message: String,
}

impl fmt::Display for FilterError {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            formatter,
            "filter, column {}: {}",
            self.column, self.message
        )
    }
}

impl std::error::Error for FilterError {}

impl FilterError {
    fn new(column: usize, message: impl Into<String>) -> Self {
        Self {
            column,
            message: message.into(),
        }
    }
}

impl Filter {
    /// Parses an expression.
    ///
    /// Fails if the expression is outside of the subset, too long or too deep.
    pub fn parse(text: &str) -> Result<Self, FilterError> {
        if text.len() > MAX_LENGTH {
            return Err(FilterError::new(
                1,
                format!("longer than {MAX_LENGTH} bytes"),
            ));
        }
        let tokens = tokens::tokens(text)?;
        if let Some(word) = tokens.get(MAX_WORDS) {
            return Err(FilterError::new(
                word.column,
                format!("more than {MAX_WORDS} words"),
            ));
        }
        parse::expression(&tokens).map(Self)
    }

    /// Parses a field of a message: names with dots, and indices, as in `cells[0].voltage`.
    ///
    /// # Errors
    /// Fails like [`Self::parse`].
    pub fn of_field(field: &str) -> Result<Self, FilterError> {
        Self::parse(&format!("m.{field}"))
    }

    /// Returns whether a message passes.
    ///
    /// # Errors
    /// Fails if Python would raise an exception: for a missing attribute, or a comparison of
    /// incomparable values.
    pub fn passes(&self, subject: Subject<'_>) -> Result<bool, FilterError> {
        evaluate::passes(&self.0, subject)
    }

    /// Returns the value as a number; a boolean is 0 or 1.
    ///
    /// # Errors
    /// Fails like [`Self::passes`], and if the value is neither a number nor a boolean.
    pub fn number(&self, subject: Subject<'_>) -> Result<f64, FilterError> {
        evaluate::number(&self.0, subject)
    }
}

/// A part of an expression and its position.
#[derive(Debug, Clone, PartialEq)]
struct Node {
    column: usize,
    kind: Kind,
}

#[derive(Debug, Clone, PartialEq)]
enum Kind {
    /// `m`.
    Subject,
    None,
    Bool(bool),
    Int(i128),
    Float(f64),
    Text(String),
    List(Vec<Node>),
    Attribute(Box<Node>, String),
    Index(Box<Node>, Box<Node>),
    Call(Function, Vec<Node>),
    /// Call of a string's method.
    Method(Box<Node>, Method, Vec<Node>),
    Negative(Box<Node>),
    Not(Box<Node>),
    And(Box<Node>, Box<Node>),
    Or(Box<Node>, Box<Node>),
    Binary(Operator, Box<Node>, Box<Node>),
    /// `a < b <= c`: the first operand, then each operator with its right operand.
    Compare(Box<Node>, Vec<(Comparison, Node)>),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Operator {
    Add,
    Subtract,
    Multiply,
    Divide,
    FloorDivide,
    Remainder,
    Power,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Comparison {
    Less,
    LessOrEqual,
    Greater,
    GreaterOrEqual,
    Equal,
    NotEqual,
    In,
    NotIn,
}

impl Comparison {
    fn as_str(self) -> &'static str {
        match self {
            Self::Less => "<",
            Self::LessOrEqual => "<=",
            Self::Greater => ">",
            Self::GreaterOrEqual => ">=",
            Self::Equal => "==",
            Self::NotEqual => "!=",
            Self::In | Self::NotIn => "in",
        }
    }
}

/// Functions that an expression may call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Function {
    Abs,
    All,
    Any,
    Bool,
    Float,
    Int,
    Len,
    Max,
    Min,
    Str,
    Sum,
}

impl Function {
    const FUNCTION_NAMES: [(&'static str, Self); 11] = [
        ("abs", Self::Abs),
        ("all", Self::All),
        ("any", Self::Any),
        ("bool", Self::Bool),
        ("float", Self::Float),
        ("int", Self::Int),
        ("len", Self::Len),
        ("max", Self::Max),
        ("min", Self::Min),
        ("str", Self::Str),
        ("sum", Self::Sum),
    ];

    fn named(name: &str) -> Option<Self> {
        Self::FUNCTION_NAMES
            .iter()
            .find(|(known, _)| *known == name)
            .map(|(_, function)| *function)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Method {
    StartsWith,
    EndsWith,
    Lower,
    Upper,
}

impl Method {
    fn named(name: &str) -> Option<Self> {
        Some(match name {
            "startswith" => Self::StartsWith,
            "endswith" => Self::EndsWith,
            "lower" => Self::Lower,
            "upper" => Self::Upper,
            _ => return None,
        })
    }
}

#[cfg(test)]
mod tests;
