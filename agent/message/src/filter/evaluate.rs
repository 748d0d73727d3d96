//! Evaluates an expression for a message as Python does. An exception in Python is an error here,
//! with the same text if that is short.

use std::borrow::Cow;
use std::cmp::Ordering;

use super::{Comparison, FilterError, Function, Kind, Method, Node, Operator};
use crate::python;
use crate::value::{Array, Items, Message, Scalar, Value};

/// Why an expression has no value: the exception that Python would raise. Types have their Python
/// names.
#[derive(Debug, thiserror::Error)]
enum Exception {
    #[error("'{0}' object has no attribute '{1}'")]
    NoAttribute(String, String),
    #[error("'{0}' object has no methods here")]
    NoMethod(String),
    #[error("'{0}' object is not subscriptable")]
    NotSubscriptable(String),
    #[error("'{0}' object is not iterable")]
    NotIterable(String),
    #[error("object of type '{0}' has no len()")]
    NoLength(String),
    #[error("bad operand type for {0}: '{1}'")]
    BadOperand(&'static str, String),
    #[error("cannot calculate with '{0}' and '{1}'")]
    NotNumbers(String, String),
    #[error("'{}' not supported between instances of '{left}' and '{right}'", comparison.as_str())]
    NotComparable {
        comparison: Comparison,
        left: String,
        right: String,
    },
    #[error("'in' needs a string or a list, not '{0}'")]
    NotContainer(String),
    #[error("an index must be a number, not '{0}'")]
    BadIndex(String),
    #[error("index out of range")]
    OutOfRange,
    #[error("the number is too large")]
    TooLarge,
    #[error("division by zero")]
    DivisionByZero,
    #[error("not a number: '{0}'")]
    NotNumber(String),
    #[error("not a whole number: '{0}'")]
    NotInteger(String),
    #[error("'{0}' cannot be converted to a {1}")]
    NotConvertible(String, &'static str),
    #[error("the argument is empty")]
    EmptyArgument,
    #[error("takes {0}")]
    Arguments(&'static str),
    #[error("takes one argument, not {0}")]
    ArgumentCount(usize),
}

/// The value of `m`.
#[derive(Debug, Clone, Copy)]
pub enum Subject<'a> {
    /// The whole message.
    Message(&'a Message<'a>),
    /// The part of the message that `--field` selects.
    Value(&'a Value<'a>),
    /// The payload, with `--raw`.
    Bytes(&'a [u8]),
}

pub(super) fn passes(node: &Node, subject: Subject<'_>) -> Result<bool, FilterError> {
    Ok(evaluate(node, &Object::subject(subject))?.is_true())
}

pub(super) fn number(node: &Node, subject: Subject<'_>) -> Result<f64, FilterError> {
    let value = evaluate(node, &Object::subject(subject))?;
    let number = value.number().map(Number::float);
    let wrong = || Exception::NotNumber(value.type_name());
    number.ok_or_else(|| FilterError::new(node.column, wrong().to_string()))
}

/// An intermediate value.
#[derive(Debug, Clone)]
enum Object<'a> {
    None,
    Bool(bool),
    Int(i128),
    Float(f64),
    Text(Cow<'a, str>),
    Bytes(Cow<'a, [u8]>),
    List(Vec<Object<'a>>),
    Array(&'a Array<'a>),
    Message(&'a Message<'a>),
}

impl<'a> Object<'a> {
    fn subject(subject: Subject<'a>) -> Self {
        match subject {
            Subject::Message(message) => Self::Message(message),
            Subject::Value(value) => Self::of(value),
            Subject::Bytes(bytes) => Self::Bytes(Cow::Borrowed(bytes)),
        }
    }

    fn of(value: &'a Value<'a>) -> Self {
        match value {
            Value::Scalar(scalar) => Self::scalar(*scalar),
            Value::Text(text) => Self::Text(Cow::Borrowed(text)),
            Value::Array(array) => Self::Array(array),
            Value::Message(message) => Self::Message(message),
        }
    }

    fn scalar(scalar: Scalar) -> Self {
        match scalar {
            Scalar::Bool(value) => Self::Bool(value),
            Scalar::Byte(byte) => Self::Bytes(Cow::Owned(vec![byte])),
            Scalar::Int(number) => Self::Int(number.into()),
            Scalar::UInt(number) => Self::Int(number.into()),
            Scalar::Float32(number) => Self::Float(number.into()),
            Scalar::Float64(number) => Self::Float(number),
        }
    }

    fn is_true(&self) -> bool {
        match self {
            Self::None => false,
            Self::Bool(value) => *value,
            Self::Int(number) => *number != 0,
            Self::Float(number) => *number != 0.0,
            Self::Text(text) => !text.is_empty(),
            Self::Bytes(bytes) => !bytes.is_empty(),
            Self::List(items) => !items.is_empty(),
            Self::Array(array) => array.length > 0,
            Self::Message(_) => true,
        }
    }

    fn type_name(&self) -> String {
        let name = match self {
            Self::None => "NoneType",
            Self::Bool(_) => "bool",
            Self::Int(_) => "int",
            Self::Float(_) => "float",
            Self::Text(_) => "str",
            Self::Bytes(_) => "bytes",
            Self::List(_) => "list",
            Self::Array(_) => "array",
            Self::Message(message) => message.structure.name.name(),
        };
        name.to_owned()
    }

    /// Returns a number or boolean as a number; `None` for other values.
    fn number(&self) -> Option<Number> {
        match self {
            Self::Bool(value) => Some(Number::Int(i128::from(*value))),
            Self::Int(number) => Some(Number::Int(*number)),
            Self::Float(number) => Some(Number::Float(*number)),
            _ => None,
        }
    }

    /// Returns the elements, if the value is iterable. An element is up to 30 times as large as its
    /// bytes, so only one at a time exists.
    fn elements(&self) -> Option<Box<dyn Iterator<Item = Self> + '_>> {
        let elements: Box<dyn Iterator<Item = Self> + '_> = match self {
            Self::List(items) => Box::new(items.iter().cloned()),
            Self::Array(array) => match &array.items {
                Items::Scalars(scalars) => Box::new(scalars.iter().map(Self::scalar)),
                Items::Texts(texts) => {
                    Box::new(texts.iter().map(|text| Self::Text(Cow::Borrowed(text))))
                }
                Items::Messages(messages) => Box::new(messages.iter().map(Self::Message)),
            },
            Self::Bytes(bytes) => Box::new(bytes.iter().map(|byte| Self::Int((*byte).into()))),
            _ => return None,
        };
        Some(elements)
    }

    fn equals(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::None, Self::None) => true,
            (Self::Text(one), Self::Text(other)) => one == other,
            (Self::Bytes(one), Self::Bytes(other)) => one == other,
            (Self::Message(one), Self::Message(other)) => one == other,
            _ => match (self.number(), other.number()) {
                (Some(one), Some(other)) => one.compare(other) == Some(Ordering::Equal),
                _ => match (self.elements(), other.elements()) {
                    (Some(one), Some(other)) => are_equal(one, other),
                    _ => false,
                },
            },
        }
    }
}

fn are_equal<'a>(
    mut one: impl Iterator<Item = Object<'a>>,
    mut other: impl Iterator<Item = Object<'a>>,
) -> bool {
    loop {
        match (one.next(), other.next()) {
            (None, None) => return true,
            (Some(one), Some(other)) if one.equals(&other) => {}
            _ => return false,
        }
    }
}

#[derive(Debug, Clone, Copy)]
enum Number {
    Int(i128),
    Float(f64),
}

impl Number {
    #[expect(clippy::cast_precision_loss, reason = "as Python's float() does")]
    fn float(self) -> f64 {
        match self {
            Self::Int(number) => number as f64,
            Self::Float(number) => number,
        }
    }

    /// Compares two numbers exactly, as Python does; `None` if one is not a number.
    fn compare(self, other: Self) -> Option<Ordering> {
        match (self, other) {
            (Self::Int(one), Self::Int(other)) => Some(one.cmp(&other)),
            (Self::Float(one), Self::Float(other)) => one.partial_cmp(&other),
            (Self::Int(one), Self::Float(other)) => compare_with_float(one, other),
            (Self::Float(one), Self::Int(other)) => {
                compare_with_float(other, one).map(Ordering::reverse)
            }
        }
    }
}

/// Compares an integer with a float without rounding the integer.
fn compare_with_float(one: i128, other: f64) -> Option<Ordering> {
    /// 2^127, the first float above all integers here.
    const BEYOND: f64 = -(i128::MIN as f64);
    if other.is_nan() {
        return None;
    }
    if other >= BEYOND {
        return Some(Ordering::Less);
    }
    if other < -BEYOND {
        return Some(Ordering::Greater);
    }
    #[expect(clippy::cast_possible_truncation, reason = "a whole number in range")]
    let whole = other.trunc() as i128;
    let rest = other.fract();
    let order = match one.cmp(&whole) {
        Ordering::Equal => 0.0_f64.partial_cmp(&rest)?,
        order => order,
    };
    Some(order)
}

fn evaluate<'a>(node: &Node, subject: &Object<'a>) -> Result<Object<'a>, FilterError> {
    let wrong = |exception: Exception| FilterError::new(node.column, exception.to_string());
    let of = |inner: &Node| evaluate(inner, subject);
    Ok(match &node.kind {
        Kind::Subject => subject.clone(),
        Kind::None => Object::None,
        Kind::Bool(value) => Object::Bool(*value),
        Kind::Int(number) => Object::Int(*number),
        Kind::Float(number) => Object::Float(*number),
        Kind::Text(text) => Object::Text(Cow::Owned(text.clone())),
        Kind::List(nodes) => Object::List(nodes.iter().map(of).collect::<Result<_, _>>()?),
        Kind::Attribute(inner, name) => {
            let object = of(inner)?;
            let field = match &object {
                Object::Message(message) => message.get(name).map(Object::of),
                _ => None,
            };
            let missing = || Exception::NoAttribute(object.type_name(), name.clone());
            field.ok_or_else(|| wrong(missing()))?
        }
        Kind::Index(inner, index) => element(&of(inner)?, &of(index)?).map_err(wrong)?,
        Kind::Not(inner) => Object::Bool(!of(inner)?.is_true()),
        Kind::And(left, right) => match of(left)? {
            left if left.is_true() => of(right)?,
            left => left,
        },
        Kind::Or(left, right) => match of(left)? {
            left if left.is_true() => left,
            _ => of(right)?,
        },
        Kind::Negative(inner) => {
            let object = of(inner)?;
            match object.number() {
                Some(Number::Int(number)) => Object::Int(
                    number
                        .checked_neg()
                        .ok_or_else(|| wrong(Exception::TooLarge))?,
                ),
                Some(Number::Float(number)) => Object::Float(-number),
                None => {
                    let kind = object.type_name();
                    return Err(wrong(Exception::BadOperand("unary -", kind)));
                }
            }
        }
        Kind::Binary(operator, left, right) => {
            binary(*operator, &of(left)?, &of(right)?).map_err(wrong)?
        }
        Kind::Compare(first, rest) => {
            let mut left = of(first)?;
            for (comparison, right) in rest {
                let right = of(right)?;
                if !compare(*comparison, &left, &right).map_err(wrong)? {
                    return Ok(Object::Bool(false));
                }
                left = right;
            }
            Object::Bool(true)
        }
        Kind::Call(function, arguments) => {
            let arguments = arguments.iter().map(of).collect::<Result<Vec<_>, _>>()?;
            call(*function, &arguments).map_err(wrong)?
        }
        Kind::Method(inner, method, arguments) => {
            let arguments = arguments.iter().map(of).collect::<Result<Vec<_>, _>>()?;
            self::method(&of(inner)?, *method, &arguments).map_err(wrong)?
        }
    })
}

fn element<'a>(object: &Object<'a>, index: &Object<'a>) -> Result<Object<'a>, Exception> {
    let index = match index {
        Object::Int(index) => *index,
        Object::Bool(index) => i128::from(*index),
        _ => return Err(Exception::BadIndex(index.type_name())),
    };
    let index = |length: usize| {
        let length = i128::try_from(length).unwrap_or(i128::MAX);
        let index = if index < 0 { index + length } else { index };
        usize::try_from(index)
            .ok()
            .filter(|_| index < length)
            .ok_or(Exception::OutOfRange)
    };
    Ok(match object {
        Object::Array(array) => {
            let index = index(array.length)?;
            let element = match &array.items {
                Items::Scalars(scalars) => scalars.get(index).map(Object::scalar),
                Items::Texts(texts) => texts
                    .get(index)
                    .map(|text| Object::Text(Cow::Borrowed(text))),
                Items::Messages(messages) => messages.get(index).map(Object::Message),
            };
            element.ok_or(Exception::OutOfRange)?
        }
        Object::List(items) => items
            .get(index(items.len())?)
            .cloned()
            .ok_or(Exception::OutOfRange)?,
        Object::Bytes(bytes) => {
            let byte = bytes
                .get(index(bytes.len())?)
                .ok_or(Exception::OutOfRange)?;
            Object::Int((*byte).into())
        }
        Object::Text(text) => {
            let index = index(text.chars().count())?;
            let character = text.chars().nth(index).ok_or(Exception::OutOfRange)?;
            Object::Text(Cow::Owned(character.to_string()))
        }
        _ => return Err(Exception::NotSubscriptable(object.type_name())),
    })
}

fn binary<'a>(
    operator: Operator,
    left: &Object<'a>,
    right: &Object<'a>,
) -> Result<Object<'a>, Exception> {
    if let (Operator::Add, Object::Text(left), Object::Text(right)) = (operator, left, right) {
        return Ok(Object::Text(Cow::Owned(format!("{left}{right}"))));
    }
    let (Some(one), Some(other)) = (left.number(), right.number()) else {
        return Err(Exception::NotNumbers(left.type_name(), right.type_name()));
    };
    if let (Number::Int(one), Number::Int(other)) = (one, other) {
        let remainder = |one: i128, other: i128| {
            let remainder = one.wrapping_rem(other);
            // The result has the divisor's sign. Operands of different signs cannot overflow in the
            // sum.
            let differs = remainder != 0 && (remainder < 0) != (other < 0);
            if differs {
                remainder + other
            } else {
                remainder
            }
        };
        let floor = |one: i128, other: i128| {
            let quotient = one.checked_div(other)?;
            let rest = one.wrapping_rem(other);
            // With a remainder, the divisor is not 1 or -1, so subtracting 1 from the quotient
            // cannot overflow.
            let below = rest != 0 && (rest < 0) != (other < 0);
            Some(quotient - i128::from(below))
        };
        if other == 0
            && matches!(
                operator,
                Operator::Divide | Operator::FloorDivide | Operator::Remainder
            )
        {
            return Err(Exception::DivisionByZero);
        }
        let result = match operator {
            Operator::Add => one.checked_add(other),
            Operator::Subtract => one.checked_sub(other),
            Operator::Multiply => one.checked_mul(other),
            Operator::FloorDivide => floor(one, other),
            Operator::Remainder => Some(remainder(one, other)),
            Operator::Power if other >= 0 => u32::try_from(other)
                .ok()
                .and_then(|other| one.checked_pow(other)),
            Operator::Divide | Operator::Power => {
                return floats(
                    operator,
                    Number::Int(one).float(),
                    Number::Int(other).float(),
                );
            }
        };
        return result.map(Object::Int).ok_or(Exception::TooLarge);
    }
    floats(operator, one.float(), other.float())
}

fn floats<'a>(operator: Operator, one: f64, other: f64) -> Result<Object<'a>, Exception> {
    let dividing = matches!(
        operator,
        Operator::Divide | Operator::FloorDivide | Operator::Remainder
    );
    if dividing && other == 0.0 {
        return Err(Exception::DivisionByZero);
    }
    Ok(Object::Float(match operator {
        Operator::Add => one + other,
        Operator::Subtract => one - other,
        Operator::Multiply => one * other,
        Operator::Divide => one / other,
        Operator::FloorDivide => floor_divide(one, other),
        Operator::Remainder => remainder(one, other),
        Operator::Power => one.powf(other),
    }))
}

/// Returns `one % other` with the sign of `other`, as CPython computes it.
fn remainder(one: f64, other: f64) -> f64 {
    let rest = one % other;
    if rest == 0.0 {
        return 0.0_f64.copysign(other);
    }
    if (rest < 0.0) == (other < 0.0) {
        rest
    } else {
        rest + other
    }
}

/// Returns `one // other`, as CPython computes it: the rounded quotient may be a whole number that
/// is too large.
fn floor_divide(one: f64, other: f64) -> f64 {
    let rest = one % other;
    let mut quotient = (one - rest) / other;
    if rest != 0.0 && (rest < 0.0) != (other < 0.0) {
        quotient -= 1.0;
    }
    if quotient == 0.0 {
        return 0.0_f64.copysign(one / other);
    }
    let floor = quotient.floor();
    if quotient - floor > 0.5 {
        floor + 1.0
    } else {
        floor
    }
}

fn compare(
    comparison: Comparison,
    left: &Object<'_>,
    right: &Object<'_>,
) -> Result<bool, Exception> {
    match comparison {
        Comparison::Equal => return Ok(left.equals(right)),
        Comparison::NotEqual => return Ok(!left.equals(right)),
        Comparison::In => return contains(right, left),
        Comparison::NotIn => return contains(right, left).map(|found| !found),
        Comparison::Less
        | Comparison::LessOrEqual
        | Comparison::Greater
        | Comparison::GreaterOrEqual => {}
    }
    let order = match (left, right) {
        (Object::Text(left), Object::Text(right)) => Some(left.cmp(right)),
        (Object::Bytes(left), Object::Bytes(right)) => Some(left.cmp(right)),
        _ => match (left.number(), right.number()) {
            (Some(left), Some(right)) => left.compare(right),
            _ => {
                return Err(Exception::NotComparable {
                    comparison,
                    left: left.type_name(),
                    right: right.type_name(),
                });
            }
        },
    };
    Ok(order.is_some_and(|order| match comparison {
        Comparison::Less => order.is_lt(),
        Comparison::LessOrEqual => order.is_le(),
        Comparison::Greater => order.is_gt(),
        _ => order.is_ge(),
    }))
}

fn contains(whole: &Object<'_>, part: &Object<'_>) -> Result<bool, Exception> {
    if let (Object::Text(whole), Object::Text(part)) = (whole, part) {
        return Ok(whole.contains(part.as_ref()));
    }
    if let (Object::Bytes(whole), Object::Bytes(part)) = (whole, part) {
        return Ok(part.is_empty()
            || whole
                .windows(part.len())
                .any(|window| window == part.as_ref()));
    }
    match whole.elements() {
        Some(mut elements) => Ok(elements.any(|element| element.equals(part))),
        None => Err(Exception::NotContainer(whole.type_name())),
    }
}

fn call<'a>(function: Function, arguments: &[Object<'a>]) -> Result<Object<'a>, Exception> {
    let several = matches!(function, Function::Min | Function::Max) && arguments.len() > 1;
    if several {
        return extreme(function, arguments.iter().cloned());
    }
    let [argument] = arguments else {
        return Err(Exception::ArgumentCount(arguments.len()));
    };
    let kind = || argument.type_name();
    let elements = || {
        let elements = argument.elements();
        elements.ok_or_else(|| Exception::NotIterable(kind()))
    };
    Ok(match function {
        Function::Len => {
            let length = match argument {
                Object::Text(text) => text.chars().count(),
                Object::Bytes(bytes) => bytes.len(),
                Object::List(items) => items.len(),
                Object::Array(array) => array.length,
                _ => return Err(Exception::NoLength(kind())),
            };
            Object::Int(i128::try_from(length).unwrap_or(i128::MAX))
        }
        Function::Abs => match argument.number() {
            Some(Number::Int(number)) => {
                Object::Int(number.checked_abs().ok_or(Exception::TooLarge)?)
            }
            Some(Number::Float(number)) => Object::Float(number.abs()),
            None => return Err(Exception::BadOperand("abs()", kind())),
        },
        Function::Bool => Object::Bool(argument.is_true()),
        Function::All => Object::Bool(elements()?.all(|element| element.is_true())),
        Function::Any => Object::Bool(elements()?.any(|element| element.is_true())),
        Function::Min | Function::Max => extreme(function, elements()?)?,
        Function::Sum => {
            let mut total = Object::Int(0);
            for element in elements()? {
                total = binary(Operator::Add, &total, &element)?;
            }
            total
        }
        Function::Int => integer(argument)?,
        Function::Float => match (argument, argument.number()) {
            (_, Some(number)) => Object::Float(number.float()),
            (Object::Text(text), None) => {
                let number = text.trim().parse();
                Object::Float(number.map_err(|_| Exception::NotNumber(text.to_string()))?)
            }
            _ => return Err(Exception::NotConvertible(kind(), "number")),
        },
        Function::Str => Object::Text(Cow::Owned(match argument {
            Object::None => "None".to_owned(),
            Object::Bool(value) => python::scalar(Scalar::Bool(*value)),
            Object::Int(number) => number.to_string(),
            Object::Float(number) => python::float(*number),
            Object::Text(text) => text.to_string(),
            Object::Bytes(bytes) => python::bytes(bytes),
            Object::List(_) | Object::Array(_) | Object::Message(_) => {
                return Err(Exception::NotConvertible(kind(), "string"));
            }
        })),
    })
}

fn integer<'a>(object: &Object<'a>) -> Result<Object<'a>, Exception> {
    const MAX_MAGNITUDE: f64 = 1e38;
    Ok(Object::Int(match (object, object.number()) {
        (_, Some(Number::Int(number))) => number,
        (_, Some(Number::Float(number))) if number.abs() < MAX_MAGNITUDE => {
            #[expect(clippy::cast_possible_truncation, reason = "int() drops the fraction")]
            let whole = number.trunc() as i128;
            whole
        }
        (Object::Text(text), None) => text
            .trim()
            .parse()
            .map_err(|_| Exception::NotInteger(text.to_string()))?,
        _ => {
            return Err(Exception::NotConvertible(
                object.type_name(),
                "whole number",
            ));
        }
    }))
}

fn extreme<'a>(
    function: Function,
    mut objects: impl Iterator<Item = Object<'a>>,
) -> Result<Object<'a>, Exception> {
    let comparison = if function == Function::Min {
        Comparison::Less
    } else {
        Comparison::Greater
    };
    let mut best = objects.next().ok_or(Exception::EmptyArgument)?;
    for object in objects {
        if compare(comparison, &object, &best)? {
            best = object;
        }
    }
    Ok(best)
}

fn method<'a>(
    object: &Object<'a>,
    method: Method,
    arguments: &[Object<'a>],
) -> Result<Object<'a>, Exception> {
    let Object::Text(text) = object else {
        return Err(Exception::NoMethod(object.type_name()));
    };
    Ok(match (method, arguments) {
        (Method::StartsWith, [Object::Text(part)]) => Object::Bool(text.starts_with(part.as_ref())),
        (Method::EndsWith, [Object::Text(part)]) => Object::Bool(text.ends_with(part.as_ref())),
        (Method::Lower, []) => Object::Text(Cow::Owned(text.to_lowercase())),
        (Method::Upper, []) => Object::Text(Cow::Owned(text.to_uppercase())),
        (Method::StartsWith | Method::EndsWith, _) => {
            return Err(Exception::Arguments("one string"));
        }
        (Method::Lower | Method::Upper, _) => return Err(Exception::Arguments("no argument")),
    })
}
