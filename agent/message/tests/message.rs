//! Compares the output for 154 payloads with that of a real `ros2 topic echo`.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a failed expectation may panic"
)]

#[path = "message/forms.rs"]
mod forms;
#[path = "message/golden.rs"]
mod golden;

use golden::{cases, library};
use ros2probe_message::value::{Items, Scalar};
use ros2probe_message::yaml::{self, Style};
use ros2probe_message::{Decoded, Limits, Truncation, Value, csv, decode};

/// The defaults of `ros2 topic echo` for arrays and strings.
const ECHO: Truncation = Truncation {
    truncate: Some(128),
    no_arrays: false,
    no_strings: false,
};

#[test]
fn every_golden_payload_prints_as_ros2_topic_echo_prints_it() {
    let mut count = 0;
    let library = library();
    for case in cases() {
        let message_type = library.find(&case.message_type, None).unwrap();
        let decoded = decode(&message_type, &case.payload, &Limits::default());
        let decoded = decoded.unwrap_or_else(|error| panic!("{case}: {error}"));
        let message = &decoded.message;
        let shown = Truncation::default();
        assert_eq!(
            yaml::document(message, &ECHO, Style::Block),
            case.yaml_echo,
            "{case}"
        );
        assert_eq!(
            yaml::document(message, &shown, Style::Block),
            case.yaml_full,
            "{case}"
        );
        assert_eq!(csv::line(message, &ECHO), case.csv, "{case}");
        assert_eq!(
            decoded.oddities.texts + decoded.oddities.booleans,
            0,
            "{case}"
        );
        count += 1;
    }
    assert_eq!(count, 154);
}

/// Compares the output with that of Python, PyYAML and numpy (`data/python/forms.py`).
#[test]
fn strings_numbers_and_arrays_print_as_python_prints_them() {
    let mut wrong = 0;
    let mut kinds = [0; 3];
    for form in forms::read() {
        let (kind, differences) = form.differences();
        kinds[kind] += 1;
        for difference in differences {
            wrong += 1;
            eprintln!("{difference}");
        }
    }
    assert_eq!(kinds, [1500, 601, 500]);
    assert_eq!(wrong, 0);
}

/// Decoding returns however a payload is cut or changed. The result does not depend on whether
/// elements are kept.
#[test]
fn damaged_payloads_are_decoded_or_refused_without_a_panic() {
    let library = library();
    let few = Limits {
        kept: 2,
        ..Limits::default()
    };
    for mut case in cases() {
        case.payload.truncate(600);
        let message_type = library.find(&case.message_type, None).unwrap();
        let read = |payload: &[u8]| {
            let all = decode(&message_type, payload, &Limits::default());
            let some = decode(&message_type, payload, &few);
            if let Ok(decoded) = &all {
                assert!(
                    csv::line(&decoded.message, &ECHO).len() <= payload.len() * 40,
                    "{case}"
                );
                let _ = yaml::document(&decoded.message, &ECHO, Style::Flow);
            }
            let trailing = |decoded: &Decoded<'_>| decoded.oddities.trailing;
            assert_eq!(
                all.as_ref().map(trailing),
                some.as_ref().map(trailing),
                "{case}"
            );
        };
        for length in 0..case.payload.len() {
            read(&case.payload[..length]);
        }
        let mut payload = case.payload.clone();
        for position in 0..payload.len().min(250) {
            let byte = payload[position];
            for changed in [0xff, byte ^ 0x01] {
                payload[position] = changed;
                read(&payload);
            }
            payload[position] = byte;
        }
    }
}

/// Compares with a second oracle: `rosbags` of PyPI, which has no `wstring`.
#[test]
fn rosbags_reads_the_same_values() {
    let library = library();
    let mut lines = String::new();
    let mut expected = Vec::new();
    for case in cases() {
        if case.message_type.ends_with("/WStrings") {
            continue;
        }
        let message_type = library.find(&case.message_type, None).unwrap();
        let decoded = decode(&message_type, &case.payload, &Limits::default()).unwrap();
        // rosbags rejects bytes after the last field.
        let length = case.payload.len() - decoded.oddities.trailing;
        let payload = golden::hex(&case.payload[..length]);
        lines.push_str(&serde_json::to_string(&(&case.message_type, payload)).unwrap());
        lines.push('\n');
        expected.push((case.to_string(), plain(&Value::Message(decoded.message))));
    }
    let found = golden::rosbags(&lines);
    let found: Vec<serde_json::Value> = found
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    assert_eq!(found.len(), expected.len());
    for ((name, expected), found) in expected.into_iter().zip(found) {
        assert_eq!(expected, found, "{name}");
    }
}

/// Returns a value in the form that `read.py` writes.
fn plain(value: &Value<'_>) -> serde_json::Value {
    let scalar = |scalar: Scalar| match scalar {
        Scalar::Bool(value) => value.into(),
        // rosbags reads an octet as a signed number.
        Scalar::Byte(byte) => byte.cast_signed().into(),
        Scalar::Int(number) => number.into(),
        Scalar::UInt(number) => number.into(),
        Scalar::Float32(number) => format!("f{:016x}", f64::from(number).to_bits()).into(),
        Scalar::Float64(number) => format!("f{:016x}", number.to_bits()).into(),
    };
    match value {
        Value::Scalar(value) => scalar(*value),
        Value::Text(text) => text.as_ref().into(),
        Value::Message(message) => message.values.iter().map(plain).collect(),
        Value::Array(array) => match &array.items {
            Items::Scalars(scalars) => scalars.iter().map(scalar).collect(),
            Items::Texts(texts) => texts.iter().map(|text| text.as_ref()).collect(),
            Items::Messages(messages) => messages
                .iter()
                .map(|message| plain(&Value::Message(message.clone())))
                .collect(),
        },
    }
}
