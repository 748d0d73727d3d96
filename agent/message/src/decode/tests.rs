//! Hand-written payloads: alignment, lengths, encodings, and rejected input.

use super::*;
use crate::python;

fn message_type(schema: &str) -> MessageType {
    MessageType::parse(&"a/msg/B".parse().unwrap(), schema).unwrap()
}

fn read(schema: &str, payload: &[u8]) -> Result<(String, Oddities), DecodeError> {
    let message_type = message_type(schema);
    let decoded = decode(&message_type, payload, &Limits::default())?;
    Ok((
        python::repr(&Value::Message(decoded.message)),
        decoded.oddities,
    ))
}

fn text(schema: &str, payload: &[u8]) -> String {
    let (text, oddities) = read(schema, payload).unwrap();
    assert_eq!(oddities, Oddities::default());
    text
}

const NESTED: &str = "Inner[] inner\nint64 last\n
================================================================================
MSG: a/Inner\nuint8 small\nuint32 middle\nfloat64 large\nstring name";

#[test]
fn xcdr1_aligns_to_eight_bytes_and_xcdr2_to_four() {
    let xcdr1 = b"\0\x01\0\0\x01\0\0\0\x05\0\0\0\x09\0\0\0\0\0\0\0\0\0\0\0\0\0\xf8\x3f\
        \x02\0\0\0x\0\0\0\x07\0\0\0\0\0\0\0";
    let shown = "a.msg.B(inner=[a.msg.Inner(small=5, middle=9, large=1.5, name='x')], last=7)";
    assert_eq!(text(NESTED, xcdr1), shown);
    // The sequence's size precedes its length.
    let plain = b"\0\x07\0\0\x1a\0\0\0\x01\0\0\0\x05\0\0\0\x09\0\0\0\0\0\0\0\0\0\xf8\x3f\
        \x02\0\0\0x\0\0\0\x07\0\0\0\0\0\0\0";
    assert_eq!(text(NESTED, plain), shown);
    // Each structure is also preceded by its size.
    let delimited = b"\0\x09\0\0\x2c\0\0\0\x1e\0\0\0\x01\0\0\0\x16\0\0\0\x05\0\0\0\x09\0\0\0\
        \0\0\0\0\0\0\xf8\x3f\x02\0\0\0x\0\0\0\x07\0\0\0\0\0\0\0";
    assert_eq!(text(NESTED, delimited), shown);
}

#[test]
fn members_that_a_newer_type_appends_are_skipped() {
    let newer = b"\0\x09\0\0\x0c\0\0\0\x05\0\0\0\x01\x02\x03\x04\x05\x06\x07\x08";
    assert_eq!(text("uint8 a", newer), "a.msg.B(a=5)");
}

#[test]
fn big_endian_numbers_and_strings_are_read() {
    let payload = b"\0\0\0\0\0\0\0\x02\0\x01\xff\xfe\0\0\0\x04\0\0\0a\0\0\0b\0\0\0c\0\x01\xf6\0";
    let shown = "a.msg.B(n=[1, -2], w='abc\u{1f600}')";
    assert_eq!(text("int16[] n\nwstring w", payload), shown);
}

#[test]
fn utf_16_surrogates_combine_in_code_units_of_two_and_of_four_octets() {
    let one = b"\0\x01\0\0\x02\0\0\0\x3d\xd8\0\0\0\xde\0\0";
    assert_eq!(text("wstring w", one), "a.msg.B(w='\u{1f600}')");
    let two = b"\0\x07\0\0\x04\0\0\0\x3d\xd8\0\xde";
    assert_eq!(text("wstring w", two), "a.msg.B(w='\u{1f600}')");
    let half = b"\0\x01\0\0\x01\0\0\0\x3d\xd8\0\0";
    let (shown, oddities) = read("wstring w", half).unwrap();
    assert_eq!(
        (shown.as_str(), oddities.texts),
        ("a.msg.B(w='\u{fffd}')", 1)
    );
}

#[test]
fn a_leading_byte_order_mark_is_not_part_of_a_wide_string() {
    for (units, shown) in [
        (&b"\xff\xfea\0"[..], "a"),
        (b"\xfe\xff\0a", "a"),
        (b"\xff\xfe", ""),
        (b"a\0\xff\xfe", "a\\ufeff"),
        (b"\xff\xfe\xff\xfe", "\\ufeff"),
    ] {
        let length = u32::try_from(units.len()).unwrap().to_le_bytes();
        let payload = [&b"\0\x07\0\0"[..], &length, units].concat();
        let expected = format!("a.msg.B(w='{shown}')");
        assert_eq!(text("wstring w", &payload), expected);
    }
}

#[test]
fn unsupported_encapsulations_are_refused_by_name() {
    let refused = |id: u8| read("uint8 a", &[0, id, 0, 0, 1]).unwrap_err().to_string();
    assert_eq!(
        refused(3),
        "a parameter list (PL_CDR) (encapsulation 0x0003) is not supported"
    );
    assert_eq!(
        refused(11),
        "a parameter list (PL_CDR2) (encapsulation 0x000b) is not supported"
    );
    assert_eq!(
        refused(0x20),
        "an unknown encoding (encapsulation 0x0020) is not supported"
    );
    assert_eq!(
        read("uint8 a", &[0, 1, 0]),
        Err(DecodeError::NoEncapsulation(3))
    );
}

#[test]
fn a_length_beyond_the_payload_is_refused_before_allocation() {
    let payload = [0, 1, 0, 0, 0x00, 0xe1, 0xf5, 0x05];
    for schema in [
        NESTED,
        "string[] a",
        "float64[] a",
        "wstring a",
        "string a",
        "bool[] a",
    ] {
        let error = read(schema, &payload).unwrap_err();
        assert!(
            matches!(error, DecodeError::Malformed(_)),
            "{schema}: {error}"
        );
    }
    // An element without octets cannot exist: an empty message takes one octet.
    let empty = "Empty[] a\n
================================================================================
MSG: a/Empty\n";
    let mut payload = vec![0, 1, 0, 0, 3, 0, 0, 0, 0, 0, 0];
    let shown = "a.msg.B(a=[a.msg.Empty(), a.msg.Empty(), a.msg.Empty()])";
    assert_eq!(text(empty, &payload), shown);
    payload.pop();
    assert!(read(empty, &payload).is_err());
}

#[test]
fn values_beyond_the_limit_are_validated_but_not_kept() {
    let schema = "Inner[] a\nstring[] b\n
================================================================================
MSG: a/Inner\nuint8 x\nuint8 y";
    let message_type = message_type(schema);
    let mut payload = vec![0, 1, 0, 0, 0xe8, 3, 0, 0];
    payload.extend([7; 2000]);
    payload.extend(b"\x03\0\0\0\x02\0\0\0a\0\0\0\x02\0\0\0b\0\0\0\x02\0\0\0c\0");
    let few = Limits {
        values: 100,
        ..Limits::default()
    };
    assert!(matches!(
        decode(&message_type, &payload, &few),
        Err(DecodeError::Limit(_))
    ));
    let some = Limits { kept: 2, ..few };
    let decoded = decode(&message_type, &payload, &some).unwrap();
    let lengths: Vec<_> = decoded
        .message
        .values
        .iter()
        .map(|value| match value {
            Value::Array(Array {
                length,
                items: Items::Messages(kept),
                ..
            }) => (*length, kept.len()),
            Value::Array(Array {
                length,
                items: Items::Texts(kept),
                ..
            }) => (*length, kept.len()),
            _ => unreachable!(),
        })
        .collect();
    assert_eq!(lengths, [(1000, 2), (3, 2)]);
    payload.pop();
    assert!(decode(&message_type, &payload, &some).is_err());
}

#[test]
fn oddities_are_shown_and_counted() {
    let payload = b"\0\x01\0\0\x05\0\0\0\x03\0\0\0ab\xff\x01";
    let (shown, oddities) = read("bool ok\nstring s", payload).unwrap();
    assert_eq!(shown, "a.msg.B(ok=True, s='ab\u{fffd}')");
    assert_eq!(
        oddities,
        Oddities {
            trailing: 0,
            texts: 1,
            booleans: 1
        }
    );
    let odd = |payload: &[u8]| read("uint8 a", payload).unwrap().1.trailing;
    assert_eq!(odd(&[0, 1, 0, 0, 1, 2, 3, 4]), 0);
    assert_eq!(odd(&[0, 1, 0, 0, 1, 2, 3, 4, 5]), 4);
    // A string without a NUL, and one whose length is 0 although a NUL counts.
    assert_eq!(
        text("string a", b"\0\x01\0\0\x02\0\0\0ab"),
        "a.msg.B(a='ab')"
    );
    assert_eq!(text("string a", b"\0\x01\0\0\0\0\0\0"), "a.msg.B(a='')");
}

#[test]
fn a_value_beyond_its_bound_is_refused() {
    let payload = b"\0\x01\0\0\x03\0\0\0ab\0";
    assert_eq!(text("string<=2 a", payload), "a.msg.B(a='ab')");
    assert!(read("string<=1 a", payload).is_err());
    let payload = b"\0\x01\0\0\x02\0\0\0\x01\x02";
    assert_eq!(text("int8[<=2] a", payload), "a.msg.B(a=[1, 2])");
    assert!(read("int8[<=1] a", payload).is_err());
}
