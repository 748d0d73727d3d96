use proptest::prelude::*;

use super::*;
use crate::{Limits, MessageType, decode};

const SCHEMA: &str = "std_msgs/Header header\nfloat64 x\nint32 n\nbool ok\nstring name\nbyte level
float32[] ranges\nstring[] names\nuint8[3] three\n
================================================================================
MSG: std_msgs/Header\nint32 sec\nstring frame_id";

/// `header {5, "odom"}`, x 2.5, n -3, ok, "robot", 2, [1, 0.5], ["a", "b"], [7, 8, 9].
fn payload() -> Vec<u8> {
    let mut bytes = vec![0, 1, 0, 0];
    bytes.extend(5_i32.to_le_bytes());
    bytes.extend(b"\x05\0\0\0odom\0\0\0\0");
    bytes.extend(2.5_f64.to_le_bytes());
    bytes.extend((-3_i32).to_le_bytes());
    bytes.extend(b"\x01\0\0\0\x06\0\0\0robot\0\x02\0\x02\0\0\0");
    bytes.extend(1_f32.to_le_bytes());
    bytes.extend(0.5_f32.to_le_bytes());
    bytes.extend(b"\x02\0\0\0\x02\0\0\0a\0\0\0\x02\0\0\0b\0\x07\x08\x09");
    bytes
}

fn evaluate(text: &str) -> Result<bool, FilterError> {
    let message_type = MessageType::parse(&"a/msg/B".parse().unwrap(), SCHEMA).unwrap();
    let payload = payload();
    let decoded = decode(&message_type, &payload, &Limits::default()).unwrap();
    assert_eq!(decoded.oddities.trailing, 0);
    Filter::parse(text)?.passes(Subject::Message(&decoded.message))
}

#[test]
fn expressions_evaluate_as_in_python() {
    for (text, value) in [
        ("m.x > 2 and m.n < 0", true),
        ("1 < m.x <= 2.5 < 3", true),
        ("1 < m.x <= 2.4 < 1/0", false),
        ("not m.ok or m.header.frame_id == 'odom'", true),
        ("m.header.sec in [4, 5]", true),
        ("m.header.sec not in (4, 5)", false),
        ("'bot' in m.name and not 'x' in m.name", true),
        ("0.5 in m.ranges and len(m.ranges) == 2", true),
        ("m.names[1] == 'b' and m.names[-2] == \"a\"", true),
        ("m.three == [7, 8, 9] and sum(m.three) == 24", true),
        (
            "max(m.three) - min(m.three) == 2 and max(1, 2.5) == m.x",
            true,
        ),
        ("abs(m.n) ** 2 == 9 and -m.n == 3 and -2 ** 2 == -4", true),
        (
            "m.n // 2 == -2 and m.n % 2 == 1 and m.n / 2 == -1.5 and 7.5 // 2 == 3",
            true,
        ),
        (
            "1 % 0.1 == 0.09999999999999995 and 1 // 0.1 == 9.0 and 1e20 % 3 == 1",
            true,
        ),
        (
            "-7.5 % 2 == 0.5 and 7.5 % -2 == -0.5 and 7.5 // -2 == -4 and -7.5 // 2 == -4",
            true,
        ),
        (
            "str(4.0 % -2) == '-0.0' and str(-4.0 % 2) == '0.0' and str(0.0 // -1) == '-0.0'",
            true,
        ),
        ("2 ** 53 + 1 == 2.0 ** 53", false),
        (
            "2 ** 53 < 2.0 ** 53 + 2 and 2.0 ** 53 < 2 ** 53 + 1 and 2 ** 53 == 2.0 ** 53",
            true,
        ),
        ("-2 > -2.5 and -3 < -2.5 and 2 < 2.5 < 3", true),
        ("2 ** 126 < 1e300 and -(2 ** 126) > -1e300", true),
        (
            "2 < float('nan') or 2 > float('nan') or 2 == float('nan')",
            false,
        ),
        // The smallest number that the filter supports.
        (
            "-(2 ** 126) * 2 % 3 == 1 and -(2 ** 126) * 2 // 3 < -(2 ** 125)",
            true,
        ),
        (
            "1 + 2 * 3 == 7 and (1 + 2) * 3 == 9 and 2 ** 3 ** 2 == 512",
            true,
        ),
        (
            "m.name.startswith('ro') and m.name.upper() == 'ROBOT' and m.name[0] == 'r'",
            true,
        ),
        ("m.ok == True == 1 and m.ok + 1 == 2", true),
        ("m.level and len(m.level) == 1", true),
        (
            "int('12') == 12 and float('1.5') == 1.5 and str(m.x) == '2.5' and int(2.9) == 2",
            true,
        ),
        ("None", false),
        ("None == 0 or ''", false),
        ("m.header != m.header", false),
        ("any(m.ranges) and all(m.three)", true),
        ("0x10 == 16 and 1_000 == 1e3 and .5 == 5e-1", true),
        ("m.name == 'robot\\n'", false),
    ] {
        assert_eq!(evaluate(text), Ok(value), "{text}");
    }
}

#[test]
fn a_large_array_is_iterable() {
    const COUNT: u32 = 300_000;
    let schema = "uint8[] data\nuint8[] same\nuint8[] short";
    let message_type = MessageType::parse(&"a/msg/C".parse().unwrap(), schema).unwrap();
    let mut payload = vec![0, 1, 0, 0];
    for count in [COUNT, COUNT, COUNT - 4] {
        payload.extend(count.to_le_bytes());
        payload.extend((0..count).map(|number| 1 + (number % 250) as u8));
    }
    let decoded = decode(&message_type, &payload, &Limits::default()).unwrap();
    for (text, value) in [
        ("sum(m.data) == 37650000", true),
        ("min(m.data) == 1 and max(m.data) == 250", true),
        ("251 in m.data or 0 in m.data", false),
        ("all(m.data) and any(m.data) and 250 in m.data", true),
        ("m.data == m.same and m.data != m.short", true),
        ("m.short == m.data", false),
    ] {
        let filter = Filter::parse(text).unwrap();
        let passes = filter.passes(Subject::Message(&decoded.message));
        assert_eq!(passes, Ok(value), "{text}");
    }
}

#[test]
fn a_mistake_is_reported_with_its_column() {
    for (text, error) in [
        ("m.x = 3", "column 5: `=` assigns; `==` compares"),
        ("m.x >", "column 6: expected a value: the expression ends"),
        ("", "column 1: expected a value: the expression ends"),
        ("m.y > 1", "column 2: 'B' object has no attribute 'y'"),
        (
            "m.header.frame.x",
            "column 9: 'Header' object has no attribute 'frame'",
        ),
        (
            "m.name < 3",
            "column 1: '<' not supported between instances of 'str' and 'int'",
        ),
        ("m.names[2]", "column 8: index out of range"),
        ("m.names[-3]", "column 8: index out of range"),
        ("m.x / 0", "column 5: division by zero"),
        ("10 ** 100", "column 4: the number is too large"),
        ("'abc", "column 1: unterminated string"),
        ("m.x $ 3", "column 5: `$` is not part of an expression"),
        ("__import__('os')", "column 1: `__import__` is unknown"),
        ("m.__class__.x()", "column 13: `x` cannot be called"),
        ("m.three[0:1]", "column 10: slices are not supported"),
        ("m.x 3", "column 5: expected an operator or the end"),
        ("len(m.x)", "column 1: object of type 'float' has no len()"),
        ("(1, 2", "column 6: expected `)`"),
        (
            "\u{e9} == 1",
            "column 1: `\u{e9}` is not part of an expression",
        ),
    ] {
        let found = evaluate(text).unwrap_err().to_string();
        assert!(found.contains(error), "{text}: {found}");
    }
}

#[test]
fn too_deep_and_too_long_expressions_are_refused() {
    for text in [
        "(".repeat(300),
        "-".repeat(300),
        "not ".repeat(300),
        "[".repeat(300),
    ] {
        assert!(
            Filter::parse(&text).unwrap_err().message.contains("deeper"),
            "{text}"
        );
    }
    assert!(
        Filter::parse(&format!("m{}", ".a".repeat(100)))
            .unwrap_err()
            .message
            .contains("deep")
    );
    assert!(
        Filter::parse(&"1+".repeat(400))
            .unwrap_err()
            .message
            .contains("words")
    );
    assert!(
        Filter::parse(&"1+".repeat(4000))
            .unwrap_err()
            .message
            .contains("longer")
    );
    assert_eq!(evaluate(&format!("1{} == 190", "+1".repeat(189))), Ok(true));
}

proptest! {
    #[test]
    fn no_expression_causes_a_panic(
        tokens in prop::collection::vec(prop::sample::select(vec![
            "m", ".x", ".n", ".name", ".names", ".three", "[", "]", "(", ")", "0", "1", "-1", "2.5",
            "'a'", "+", "-", "*", "/", "//", "%", "**", "<", "==", "in", "not", "and", "or", ",",
            "len", "abs", "sum", "max", "int", "170141183460469231731687303715884105727", "\u{e9}",
        ]), 0..24)
    ) {
        let _ = evaluate(&tokens.join(" "));
        let _ = evaluate(&tokens.concat());
    }
}
