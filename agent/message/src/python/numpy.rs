//! One-dimensional arrays as numpy prints them: columns of one width, wrapped at 75 characters.
//!
//! Implements numpy's rules for numbers in one dimension only, with the default options.

use crate::digits;
use crate::python;
use crate::value::{Scalar, ScalarKind, Scalars};

/// `numpy.get_printoptions()`: precision, threshold, edgeitems, linewidth.
const PRECISION: usize = 8;
const THRESHOLD: usize = 1000;
const EDGE: usize = 3;
const WIDTH: usize = 75;
/// If a number has at least this magnitude or is below [`SMALL`], all numbers have an exponent.
const LARGE: f64 = 1e8;
const SMALL: f64 = 1e-4;
/// The same applies if the largest number is more than this many times the smallest.
const SPREAD: f64 = 1000.0;

/// Returns `str()` of an array: `[0.   0.25 1.  ]`.
pub fn str(scalars: Scalars<'_>) -> String {
    Layout {
        separator: " ",
        prefix: 0,
        suffix: 0,
    }
    .lines(scalars)
}

/// Returns `repr()` of an array: `array([1, 2], dtype=uint8)`.
pub fn repr(scalars: Scalars<'_>) -> String {
    const PREFIX: &str = "array(";
    let dtype = match scalars.kind() {
        ScalarKind::Bool => "bool",
        ScalarKind::Byte | ScalarKind::UInt8 => "uint8",
        ScalarKind::Int8 => "int8",
        ScalarKind::Int16 => "int16",
        ScalarKind::UInt16 => "uint16",
        ScalarKind::Int32 => "int32",
        ScalarKind::UInt32 => "uint32",
        ScalarKind::UInt64 => "uint64",
        ScalarKind::Float32 => "float32",
        ScalarKind::Int64 | ScalarKind::Float64 => "",
    };
    let layout = Layout {
        separator: ", ",
        prefix: PREFIX.len(),
        suffix: 1,
    };
    let lines = layout.lines(scalars);
    if dtype.is_empty() {
        return format!("{PREFIX}{lines})");
    }
    let start = format!("{PREFIX}{lines},");
    let last = start.rsplit('\n').next().map_or(0, str::len);
    let dtype = format!("dtype={dtype})");
    if last + dtype.len() + 1 > WIDTH {
        format!("{start}\n{}{dtype}", " ".repeat(PREFIX.len()))
    } else {
        format!("{start} {dtype}")
    }
}

struct Layout {
    separator: &'static str,
    prefix: usize,
    suffix: usize,
}

impl Layout {
    fn lines(&self, scalars: Scalars<'_>) -> String {
        let length = scalars.len();
        let (shown, gap) = if length > THRESHOLD {
            let edges = (0..EDGE).chain(length - EDGE..length);
            (
                edges
                    .filter_map(|index| scalars.get(index))
                    .collect::<Vec<_>>(),
                Some(EDGE),
            )
        } else {
            (scalars.iter().collect(), None)
        };
        let indent = " ".repeat(self.prefix + 1);
        let width = WIDTH - self.suffix - 1.max(self.separator.trim_end().len());
        let mut text = String::new();
        let mut line = indent.clone();
        let mut words = columns(&shown);
        if let Some(gap) = gap {
            words.insert(gap, "...".to_owned());
        }
        let count = words.len();
        for (index, word) in words.into_iter().enumerate() {
            if line.len() + word.len() > width && line.len() > indent.len() {
                text.push_str(line.trim_end());
                text.push('\n');
                line.clone_from(&indent);
            }
            line.push_str(&word);
            if index + 1 < count {
                line.push_str(self.separator);
            }
        }
        text.push_str(&line);
        format!("[{}]", text.get(indent.len()..).unwrap_or_default())
    }
}

/// Formats all numbers with the same width.
fn columns(scalars: &[Scalar]) -> Vec<String> {
    let floats = |scalar: &Scalar| match scalar {
        Scalar::Float32(number) => Some(Float::Single(*number)),
        Scalar::Float64(number) => Some(Float::Double(*number)),
        _ => None,
    };
    let floats: Vec<_> = scalars.iter().filter_map(floats).collect();
    if floats.len() == scalars.len() && !floats.is_empty() {
        return float_columns(&floats);
    }
    let words: Vec<_> = scalars
        .iter()
        .map(|scalar| python::scalar(*scalar))
        .collect();
    let width = words.iter().map(String::len).max().unwrap_or(0);
    words.iter().map(|word| format!("{word:>width$}")).collect()
}

#[derive(Clone, Copy)]
enum Float {
    Single(f32),
    Double(f64),
}

impl Float {
    fn value(self) -> f64 {
        match self {
            Self::Single(number) => number.into(),
            Self::Double(number) => number,
        }
    }

    /// Returns the shortest digits as whole part and fraction, which has at most `PRECISION`
    /// digits.
    fn positional(self) -> (String, String) {
        let (short, exact) = match self {
            Self::Single(number) => (digits::positional(number), format!("{number:.PRECISION$}")),
            Self::Double(number) => (digits::positional(number), format!("{number:.PRECISION$}")),
        };
        split(&short, &exact)
    }

    /// Returns digits with an exponent and this many digits after the point, including those
    /// beyond the shortest.
    fn exact(self, precision: usize) -> (String, i32) {
        let text = match self {
            Self::Single(number) => format!("{number:.precision$e}"),
            Self::Double(number) => format!("{number:.precision$e}"),
        };
        let (mantissa, exponent) = text.split_once('e').unwrap_or((&text, "0"));
        let point = if precision == 0 { "." } else { "" };
        (format!("{mantissa}{point}"), exponent.parse().unwrap_or(0))
    }

    /// Returns the shortest digits with an exponent, as whole part, fraction and exponent.
    fn scientific(self) -> (String, String, i32) {
        let (short, exact) = match self {
            Self::Single(number) => (digits::scientific(number), format!("{number:.PRECISION$e}")),
            Self::Double(number) => (digits::scientific(number), format!("{number:.PRECISION$e}")),
        };
        let mantissa = |text: &str| text.split('e').next().unwrap_or_default().to_owned();
        let (whole, fraction) = split(&mantissa(&short), &mantissa(&exact));
        let chosen = if short.len() > exact.len() {
            &exact
        } else {
            &short
        };
        let exponent = chosen
            .split('e')
            .nth(1)
            .and_then(|text| text.parse().ok())
            .unwrap_or(0);
        (whole, fraction, exponent)
    }
}

fn split(short: &str, exact: &str) -> (String, String) {
    let parts = |text: &str| {
        let (whole, fraction) = text.split_once('.').unwrap_or((text, ""));
        (whole.to_owned(), fraction.trim_end_matches('0').to_owned())
    };
    let (whole, fraction) = parts(short);
    if fraction.len() > PRECISION {
        parts(exact)
    } else {
        (whole, fraction)
    }
}

fn float_columns(floats: &[Float]) -> Vec<String> {
    let finite: Vec<_> = floats
        .iter()
        .filter(|float| float.value().is_finite())
        .collect();
    let sizes = finite
        .iter()
        .map(|float| float.value().abs())
        .filter(|size| *size > 0.0);
    let (small, large) = sizes.fold((f64::INFINITY, 0.0_f64), |(small, large), size| {
        (small.min(size), large.max(size))
    });
    let scientific = large > 0.0 && (large >= LARGE || small < SMALL || large / small > SPREAD);
    let width = |lengths: &mut dyn Iterator<Item = usize>| lengths.max().unwrap_or(0);
    let (mut left, right);
    let mut exponents = 0;
    if scientific {
        let parts: Vec<_> = finite.iter().map(|float| float.scientific()).collect();
        let digits = |exponent: i32| exponent.unsigned_abs().to_string().len().max(2);
        left = width(&mut parts.iter().map(|(whole, ..)| whole.len()));
        right = width(&mut parts.iter().map(|(_, fraction, _)| fraction.len()));
        exponents = width(&mut parts.iter().map(|(.., exponent)| digits(*exponent)));
    } else {
        let parts: Vec<_> = finite.iter().map(|float| float.positional()).collect();
        left = width(&mut parts.iter().map(|(whole, _)| whole.len()));
        right = width(&mut parts.iter().map(|(_, fraction)| fraction.len()));
    }
    // Characters after the whole part; `nan` and `inf` may be wider than the numbers.
    let behind = if scientific {
        right + exponents + 3
    } else {
        right + 1
    };
    if finite.len() < floats.len() {
        let negative = floats
            .iter()
            .any(|float| float.value() == f64::NEG_INFINITY);
        left = left.max(3_usize.saturating_sub(behind));
        left = left.max((3 + usize::from(negative)).saturating_sub(behind));
    }
    let total = left + behind;
    let word = |float: &Float| {
        if !float.value().is_finite() {
            return format!("{:>total$}", python::float(float.value()));
        }
        if scientific {
            let (mantissa, exponent) = float.exact(right);
            let sign = if exponent < 0 { '-' } else { '+' };
            let exponent = exponent.unsigned_abs();
            let digits = left + right + 1;
            return format!("{mantissa:>digits$}e{sign}{exponent:0>exponents$}");
        }
        let (whole, fraction) = float.positional();
        format!("{whole:>left$}.{fraction:<right$}")
    };
    floats.iter().map(word).collect()
}
