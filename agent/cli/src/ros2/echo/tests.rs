use super::*;
use ros2probe_api::endpoints::Qos;

const SCHEMA: &str = "Header header\nfloat32[] ranges\nfloat64[3] k\nHeader[] more\nstring name\n
================================================================================
MSG: a/Header\nint32 sec\nstring frame_id";

fn payload() -> Vec<u8> {
    let mut bytes = vec![0, 1, 0, 0];
    bytes.extend(b"\x05\0\0\0\x05\0\0\0odom\0\0\0\0\x02\0\0\0");
    bytes.extend(1_f32.to_le_bytes());
    bytes.extend(0.1_f32.to_le_bytes());
    bytes.extend([0; 4]);
    for value in [1.5_f64, 0.0, 100.25] {
        bytes.extend(value.to_le_bytes());
    }
    bytes.extend(b"\x01\0\0\0\x06\0\0\0\x02\0\0\0x\0\0\0\x05\0\0\0name\0");
    bytes
}

fn sample() -> Sample {
    Sample {
        topic: "/a".to_owned(),
        domain_id: 0,
        message_type: "a/msg/B".to_owned(),
        time_ns: 2_000_000_001,
        writer: "01.02".to_owned(),
        sequence_number: 9,
        source_timestamp_ns: Some(1_999_999_999),
        header_stamp_ns: None,
        size: 8,
        sampled: false,
        payload_bytes: Some(8),
        offered: None,
    }
}

fn message_type() -> MessageType {
    MessageType::parse(&"a/msg/B".parse().unwrap(), SCHEMA).unwrap()
}

fn echo(options: Options) -> Result<Option<String>, Refused> {
    let mut echo = Echo::new(options);
    let printed = echo.message(&sample(), Some(&message_type()), &payload())?;
    assert_eq!(printed.err, "");
    Ok(printed.out)
}

fn fields(paths: &[&str]) -> Options {
    let fields = paths.iter().map(|path| path.parse().unwrap()).collect();
    Options {
        fields,
        ..Options::default()
    }
}

#[test]
fn fields_print_as_yaml_or_as_python() {
    for (path, text) in [
        ("header", "sec: 5\nframe_id: odom\n---\n"),
        ("header.frame_id", "odom\n---\n"),
        ("header.sec", "5\n---\n"),
        ("ranges", "array('f', [1.0, 0.10000000149011612])\n---\n"),
        ("k", "[  1.5    0.   100.25]\n---\n"),
        ("k.[2]", "100.25\n---\n"),
        ("ranges[1]", "0.10000000149011612\n---\n"),
        ("more", "[a.msg.Header(sec=6, frame_id='x')]\n---\n"),
        ("more.0.frame_id", "x\n---\n"),
        ("more.[0]", "sec: 6\nframe_id: x\n---\n"),
    ] {
        assert_eq!(echo(fields(&[path])), Ok(Some(text.to_owned())), "{path}");
    }
    let several = echo(fields(&["header.sec", "more.0", "name"]));
    assert_eq!(
        several.unwrap().unwrap(),
        "5\nsec: 6\nframe_id: x\nname\n---\n"
    );
}

#[test]
fn an_element_of_a_numpy_array_prints_as_few_digits_as_its_type_has() {
    let schema = "float32[2] q\nfloat32[] r\nint8[1] n\n";
    let message_type = MessageType::parse(&"a/msg/B".parse().unwrap(), schema).unwrap();
    let mut payload: Vec<u8> = vec![0, 1, 0, 0];
    payload.extend([0.5_f32, 0.1].map(f32::to_le_bytes).concat());
    payload.extend([1, 0, 0, 0]);
    payload.extend(0.1_f32.to_le_bytes());
    payload.push(7);
    for (path, text) in [
        ("q.[1]", "0.1\n---\n"),
        ("r.[0]", "0.10000000149011612\n---\n"),
        ("n.[0]", "7\n---\n"),
    ] {
        let mut echo = Echo::new(fields(&[path]));
        let printed = echo.message(&sample(), Some(&message_type), &payload);
        assert_eq!(printed.unwrap().out.as_deref(), Some(text), "{path}");
    }
}

#[test]
fn missing_fields_are_refused_with_the_text_of_ros2cli() {
    for (path, reason) in [
        ("x", "'B' object has no attribute 'x'"),
        ("header.x", "'Header' object has no attribute 'x'"),
        ("name.x", "'str' object has no attribute 'x'"),
        ("ranges.x", "'array.array' object has no attribute 'x'"),
        ("k.x", "'numpy.ndarray' object has no attribute 'x'"),
        ("more.1", "list index out of range"),
        ("header.0", "'Header' object is not subscriptable"),
    ] {
        let refused = echo(fields(&[path])).unwrap_err();
        assert_eq!(refused.0, format!("Invalid field '{path}': {reason}"));
    }
    let raw = Options {
        raw: true,
        ..fields(&["header.sec"])
    };
    let reason = "Invalid field 'header.sec': 'bytes' object has no attribute 'header'";
    assert_eq!(echo(raw).unwrap_err().0, reason);
    for path in ["", ".", "..", "a[", "a[x]", "a[0"] {
        let refused = path.parse::<FieldPath>().unwrap_err();
        assert_eq!(refused.0, format!("Invalid field value '{path}'"));
    }
}

#[test]
fn message_info_is_printed_before_the_message() {
    let mut options = fields(&["header"]);
    options.include_info = true;
    let document = "publication_sequence_number: 9\nreceived_timestamp: 2000000001\n\
        reception_sequence_number: null\nsource_timestamp: 1999999999\n---\n\
        sec: 5\nframe_id: odom\n---\n";
    assert_eq!(echo(options.clone()).unwrap().unwrap(), document);
    options.csv = true;
    let line = "1999999999,2000000001,9,None,5,odom\n";
    assert_eq!(echo(options.clone()).unwrap().unwrap(), line);
    options.fields = vec!["header.sec".parse().unwrap()];
    let around = "---Got new message, message info:---\n{'source_timestamp': 1999999999, \
        'received_timestamp': 2000000001, 'publication_sequence_number': 9, \
        'reception_sequence_number': None}\n---Message data:---\n5\n---\n";
    assert_eq!(echo(options.clone()).unwrap().unwrap(), around);
    options.include_info = false;
    options.dialect = Dialect::Humble;
    assert_eq!(echo(options).unwrap().unwrap(), "5\n");
}

#[test]
fn a_filter_is_evaluated_on_the_selected_field() {
    let mut options = fields(&["header"]);
    options.filter = Some(Filter::parse("m.sec == 5").unwrap());
    assert!(echo(options.clone()).unwrap().is_some());
    options.fields.clear();
    assert_eq!(
        echo(options.clone()).unwrap_err().0,
        "filter, column 2: 'B' object has no attribute 'sec'"
    );
    options.filter = Some(Filter::parse("len(m) > 1000").unwrap());
    options.raw = true;
    assert_eq!(echo(options.clone()), Ok(None));
    options.filter = None;
    let raw = echo(options).unwrap().unwrap();
    assert!(raw.starts_with("b'\\x00\\x01\\x00\\x00\\x05"), "{raw}");
    assert!(raw.ends_with("name\\x00'\n---\n"), "{raw}");
}

#[test]
fn a_writer_of_unreadable_messages_is_reported_once() {
    let mut echo = Echo::new(Options::default());
    let message_type = message_type();
    let mut printed_for = |payload: &[u8]| {
        let printed = echo.message(&sample(), Some(&message_type), payload);
        printed.unwrap()
    };
    let first = printed_for(&payload()[..30]);
    assert_eq!(first.out, None);
    assert!(
        first
            .err
            .starts_with("rp: /a of writer 01.02: a message cannot be decoded as a/msg/B: "),
        "{first:?}"
    );
    assert_eq!(printed_for(&[]), MessageText::default());
    assert!(printed_for(&payload()).out.is_some());
    assert_eq!(echo.unreadable(), 2);
}

#[test]
fn types_of_events_print_as_names_in_both_styles() {
    let event = "a/Info info\nuint8[] request\n
================================================================================
MSG: a/Info\nuint8 event_type\nint64 sequence_number";
    let message_type = MessageType::parse(&"a/msg/B".parse().unwrap(), event).unwrap();
    let mut payload = vec![0, 1, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0];
    payload.extend([7, 0, 0, 0, 0, 0, 0, 0, 2, 0, 0, 0, 1, 2]);
    let print = |style, csv, interface| {
        let options = Options {
            style,
            csv,
            ..Options::default()
        };
        let printed = Echo::new(options).event(&sample(), &message_type, &payload, interface);
        printed.out.unwrap()
    };
    assert_eq!(
        print(Style::Block, false, None),
        "info:\n  event_type: RESPONSE_SENT\n  sequence_number: 7\nrequest:\n- 1\n- 2\n---\n"
    );
    assert_eq!(
        print(Style::Flow, false, Some("GOAL_SERVICE")),
        "interface: GOAL_SERVICE\n\
         info:\n  event_type: RESPONSE_SENT\n  sequence_number: 7\nrequest: [1, 2]\n---\n"
    );
    assert_eq!(print(Style::Block, true, None), "2,7,1,2\n");
}

#[test]
fn publishers_with_different_qos_are_reported() {
    let publisher = |reliability: &'static str, durability: &'static str| Endpoint {
        qos: Qos {
            reliability: reliability.into(),
            durability: durability.into(),
            ..Qos::default()
        },
        ..Endpoint::default()
    };
    let reliable = publisher("RELIABLE", "VOLATILE");
    assert_eq!(mixed_offers(&[reliable.clone(), reliable.clone()]), "");
    let mixed = mixed_offers(&[reliable, publisher("BEST_EFFORT", "VOLATILE")]);
    assert_eq!(
        mixed,
        "Some, but not all, publishers are offering QoSReliabilityPolicy.RELIABLE. Falling back to \
         QoSReliabilityPolicy.BEST_EFFORT as it will connect to all publishers\n"
    );
}
