//! What a real `ros2 topic echo` printed of 154 payloads, against what is printed here.

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

use golden::{cases, definitions};
use ros2probe::message::yaml::{self, Style};
use ros2probe::message::{Limits, Shown, csv, decode};

/// What `ros2 topic echo` shows of arrays and strings unless told otherwise.
const ECHO: Shown = Shown {
    truncate: Some(128),
    no_arrays: false,
    no_strings: false,
};

#[test]
fn every_golden_payload_prints_as_the_original_prints_it() {
    let mut count = 0;
    for case in cases()
        .into_iter()
        .filter(|case| case.message_type.starts_with("test_msgs"))
    {
        let message_type = definitions(&case.message_type);
        let decoded = decode(&message_type, &case.payload, &Limits::default());
        let decoded = decoded.unwrap_or_else(|error| panic!("{case}: {error}"));
        let message = &decoded.message;
        let shown = Shown::default();
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
    assert_eq!(count, 62);
}

/// What Python, PyYAML and numpy print (`data/python/forms.py`).
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
