//! Responses as rcl sends them, and hostile ones.

#[path = "../../../testing/src/type_description.rs"]
mod response;

use response::{Described, Field, Response, described, field, nested};

use super::*;
use crate::library::{DescribedFigures, Library, NotFound, Sources};
use crate::{python, yaml};

const THING: &str = "my_msgs/msg/Thing";
const PART: &str = "my_msgs/msg/Part";
const THING_TEXT: &str =
    "# A thing.\nuint8 RED=1\nPart[<=3] parts\nstring<=9 label\nfloat64[2] xy\n";
const PART_TEXT: &str = "int32 count 5 # how many\n";

/// Returns the description of the type that `THING_TEXT` and `PART_TEXT` define.
fn thing() -> Response {
    let bounded = |capacity, field| Field { capacity, ..field };
    Response::of(&[
        described(
            THING,
            &[
                bounded(3, nested("parts", 97, PART)),
                Field {
                    string_capacity: 9,
                    ..field("label", 21)
                },
                bounded(2, field("xy", 59)),
            ],
        ),
        described(PART, &[field("count", 6)]),
    ])
}

fn thing_with_sources() -> Response {
    let response = thing().with_source(THING, "msg", THING_TEXT);
    response.with_source(PART, "msg", PART_TEXT)
}

/// Returns the type that the files define.
fn expected() -> MessageType {
    let text = format!("{THING_TEXT}{}\nMSG: {PART}\n{PART_TEXT}", "=".repeat(80));
    MessageType::parse(&THING.parse().unwrap(), &text).unwrap()
}

fn library() -> Library {
    Library::new(Sources::default())
}

fn refused(response: &Response) -> NotDescribed {
    described_type(&response.payload()).unwrap_err()
}

#[test]
fn a_description_without_files_suffices() {
    let found = described_type(&thing().payload()).unwrap();
    assert_eq!(found.type_hash(), expected().type_hash());
    assert!(found.structures().eq(expected().structures()));
    assert_eq!(
        found.schema_text().1,
        format!(
            "my_msgs/Part[<=3] parts\nstring<=9 label\nfloat64[2] xy\n\n{}\nMSG: my_msgs/Part\n\
             int32 count\n",
            "=".repeat(80)
        )
    );
    let payload = b"\0\x01\0\0\x01\0\0\0\x07\0\0\0\x02\0\0\0x\0\0\0\
        \0\0\0\0\0\0\xf8\x3f\0\0\0\0\0\0\0\x40";
    let decoded = decode(&found, payload, &Limits::default()).unwrap();
    assert_eq!(
        python::repr(&Value::Message(decoded.message)),
        "my_msgs.msg.Thing(parts=[my_msgs.msg.Part(count=7)], label='x', \
         xy=array([1.5, 2. ]))"
    );
}

#[test]
fn files_of_the_described_type_are_used_with_their_comments() {
    let found = described_type(&thing_with_sources().payload()).unwrap();
    assert_eq!(found.type_hash(), expected().type_hash());
    let text = found.schema_text().1;
    assert!(
        text.starts_with(THING_TEXT) && text.ends_with(PART_TEXT),
        "{text}"
    );
}

#[test]
fn files_of_another_type_and_unreadable_ones_are_not_used() {
    let other = PART_TEXT.replace("int32", "int16");
    for (encoding, text) in [
        ("msg", other.as_str()),
        ("msg", "int9 x"),
        ("idl", "union"),
        ("implicit", ""),
        ("zip", PART_TEXT),
    ] {
        let response = thing().with_source(THING, "msg", THING_TEXT);
        let response = response.with_source(PART, encoding, text);
        let found = described_type(&response.payload()).unwrap();
        assert_eq!(found, described_type(&thing().payload()).unwrap(), "{text}");
    }
    let idl = "module my_msgs { module msg { struct Part { long count; }; }; };";
    let response = thing().with_source(THING, "msg", THING_TEXT);
    let response = response.with_source(PART, "idl", idl);
    let found = described_type(&response.payload()).unwrap();
    assert!(found.schema_text().1.starts_with(THING_TEXT));
}

#[test]
fn every_type_of_the_embedded_packages_has_the_hash_of_its_description() {
    // The hashes that nodes announce, from `type_hashes.txt`, prove the numbers of the field types.
    let library = library();
    let mut count = 0;
    for line in include_str!("../../../testing/data/message/type_hashes.txt").lines() {
        let Some((name, hash)) = line.split_once(' ') else {
            continue;
        };
        let Ok(found) = library.find(name, Some(hash)) else {
            continue;
        };
        let roots = found.structures().filter(|one| one.name == found.root);
        let others = found.structures().filter(|one| one.name != found.root);
        let types: Vec<_> = roots.chain(others).map(description).collect();
        let read = described_type(&Response::of(&types).payload()).unwrap();
        assert_eq!(read.type_hash(), hash, "{name}");
        count += 1;
    }
    assert!(count > 300, "{count}");
}

/// Returns the description of a structure, as `rosidl_generator_type_description` writes it.
fn description(structure: &Structure) -> Described {
    let mut fields: Vec<_> = structure.fields.iter().map(field_description).collect();
    if fields.is_empty() {
        fields.push(field(PLACEHOLDER_MEMBER, 3));
    }
    described(&structure.name.to_string(), &fields)
}

fn field_description(one: &crate::Field) -> Field {
    let (offset, capacity) = match one.shape {
        Shape::Single => (0, 0),
        Shape::Array(size) => (48, size),
        Shape::Bounded(size) => (96, size),
        Shape::Unbounded => (144, 0),
    };
    let (id, bound, nested) = match &one.element {
        Element::Nested(name) => (1, 0, name.to_string()),
        Element::Int8 => (2, 0, String::new()),
        Element::UInt8 | Element::Char => (3, 0, String::new()),
        Element::Int16 => (4, 0, String::new()),
        Element::UInt16 => (5, 0, String::new()),
        Element::Int32 => (6, 0, String::new()),
        Element::UInt32 => (7, 0, String::new()),
        Element::Int64 => (8, 0, String::new()),
        Element::UInt64 => (9, 0, String::new()),
        Element::Float32 => (10, 0, String::new()),
        Element::Float64 => (11, 0, String::new()),
        Element::Bool => (15, 0, String::new()),
        Element::Byte => (16, 0, String::new()),
        Element::String { bound } => (bound.map_or(17, |_| 21), bound.unwrap_or(0), String::new()),
        Element::WString { bound } => (bound.map_or(18, |_| 22), bound.unwrap_or(0), String::new()),
    };
    Field {
        name: one.name.clone(),
        type_id: id + offset,
        capacity: capacity.into(),
        string_capacity: bound.into(),
        nested,
    }
}

#[test]
fn a_response_that_is_truncated_or_changed_anywhere_causes_no_panic() {
    let payload = thing_with_sources().payload();
    for length in 0..payload.len() {
        // Padding after `extra_information` is not needed.
        let read = described_type(&payload[..length]);
        assert!(read.is_err() || length + 3 >= payload.len(), "{length}");
    }
    let mut changed = payload.clone();
    for place in 0..payload.len() {
        for byte in [0, 0xff, payload[place] ^ 1, payload[place] ^ 0x80] {
            changed[place] = byte;
            let _ = described_type(&changed);
        }
        changed[place] = payload[place];
    }
}

#[test]
fn counts_beyond_the_bytes_are_refused_before_memory_is_allocated() {
    let payload = thing().payload();
    // Lengths of lists with one entry, and of empty strings. The first word is `successful`.
    let huge: Vec<_> = (8..payload.len() - 4)
        .step_by(4)
        .filter(|place| payload[*place..place + 4] == [1, 0, 0, 0])
        .collect();
    assert!(huge.len() >= 2);
    for place in huge {
        let mut changed = payload.clone();
        changed[place..place + 4].fill(0xff);
        let _ = described_type(&changed).unwrap_err();
    }
    let long = vec![0; MAX_RESPONSE + 1];
    assert_eq!(described_type(&long).unwrap_err(), NotDescribed::TooLong);
}

#[test]
fn unsuccessful_and_incomplete_responses_are_refused_with_the_reason() {
    let unknown = Response {
        failure: Some("type not found".to_owned()),
        ..Response::default()
    };
    assert_eq!(refused(&unknown), NotDescribed::Unknown);
    let one = |fields: &[Field]| refused(&Response::of(&[described("a/msg/B", fields)]));
    let missing = one(&[nested("c", 1, "a/msg/C")]);
    let absent = NotClosed::Missing("a/msg/C".parse().unwrap());
    assert_eq!(missing, NotDescribed::NotClosed(absent));
    for (fields, expected) in [
        (vec![field("x", 0)], "field type 0 is not supported"),
        (vec![field("x", 12)], "field type 12 is not supported"),
        (vec![field("x", 255)], "field type 255 is not supported"),
        (
            vec![field("x", 50)],
            "0 is not a capacity from 1 to 4294967295",
        ),
        (
            vec![field("x", 21)],
            "0 is not a capacity from 1 to 4294967295",
        ),
        (vec![field("x y", 2)], "`x y` is not a valid name"),
        (vec![nested("x", 1, "../a")], "`../a` is not a valid name"),
        (vec![field("x", 2), field("x", 2)], "`x` is described twice"),
        (vec![nested("x", 1, "a/msg/B")], "a/msg/B contains itself"),
    ] {
        assert_eq!(one(&fields).to_string(), expected);
    }
    let huge = Field {
        capacity: 1 << 32,
        ..field("x", 50)
    };
    assert_eq!(one(&[huge]), NotDescribed::Capacity(1 << 32));
    let many: Vec<_> = (0..=MAX_FIELDS)
        .map(|number| field(&format!("x{number}"), 2))
        .collect();
    assert_eq!(one(&many), NotDescribed::TooManyFields);
}

#[test]
fn cycles_and_deep_or_many_types_are_refused() {
    let chain = |count: usize, last: Field| {
        let mut types: Vec<_> = (0..count)
            .map(|number| {
                let next = format!("a/msg/T{}", number + 1);
                described(&format!("a/msg/T{number}"), &[nested("next", 1, &next)])
            })
            .collect();
        types.push(described(&format!("a/msg/T{count}"), &[last]));
        refused(&Response::of(&types))
    };
    assert_eq!(
        chain(3, nested("next", 145, "a/msg/T1")).to_string(),
        "a/msg/T1 contains itself"
    );
    assert_eq!(
        chain(100, field("x", 2)),
        NotDescribed::NotClosed(NotClosed::TooDeep)
    );
    assert_eq!(
        chain(MAX_TYPES + 1, field("x", 2)),
        NotDescribed::NotClosed(NotClosed::TooMany)
    );
}

#[test]
fn a_lookup_finds_an_offered_type_only_by_its_hash() {
    let (library, hash) = (library(), expected().type_hash());
    library.find(THING, Some(&hash)).unwrap_err();
    let before = library.revision();
    library.offer(thing().payload().into());
    library.offer(thing().payload().into());
    assert!(library.revision() > before);
    assert_eq!(library.find(THING, Some(&hash)).unwrap().type_hash(), hash);
    assert_eq!(library.find(THING, None).unwrap().type_hash(), hash);
    let other = format!("RIHS01_{}", "0".repeat(64));
    let failure = library.find(THING, Some(&other)).unwrap_err();
    assert!(
        matches!(failure, NotFound::OtherDefinition { .. }),
        "{failure}"
    );
    assert!(
        failure.to_string().contains("that a node described"),
        "{failure}"
    );
    // Nested types are known as parts only.
    library.find(PART, None).unwrap_err();
    library.offer(Arc::from(&b"\0\x01\0\0\x01"[..]));
    library.find(THING, Some(&hash)).unwrap();
    let figures = library.described_figures();
    let DescribedFigures {
        types,
        learned,
        refused,
        mismatched,
        ..
    } = figures;
    assert_eq!((types, learned, refused, mismatched), (1, 1, 1, 1));
    let message = library.find(THING, Some(&hash)).unwrap();
    assert!(message.structure(&PART.parse().unwrap()).is_some());
}

#[test]
fn an_installed_definition_precedes_a_description() {
    let library = library();
    let hash = library
        .find("std_msgs/msg/String", None)
        .unwrap()
        .type_hash();
    let forged = described("std_msgs/msg/String", &[field("data", 2)]);
    library.offer(Response::of(&[forged]).payload().into());
    let found = library.find("std_msgs/msg/String", None).unwrap();
    assert_eq!(found.type_hash(), hash);
    assert_eq!(
        library
            .find("std_msgs/msg/String", Some(&hash))
            .unwrap()
            .type_hash(),
        hash
    );
}

#[test]
fn waiting_responses_and_forged_types_are_bounded_and_do_not_displace_used_ones() {
    let (library, hash) = (library(), expected().type_hash());
    library.offer(thing().payload().into());
    library.find(THING, Some(&hash)).unwrap();
    for number in 0..2000 {
        let forged = described(&format!("a/msg/T{number}"), &[field("x", 2)]);
        library.offer(Response::of(&[forged]).payload().into());
        if number % 100 == 0 {
            let _ = library.find("a/msg/T0", None);
        }
    }
    assert!(library.described_figures().evicted > 0);
    for number in 0..100 {
        let name = format!("b/msg/T{number}");
        let fields: Vec<_> = (0..2000)
            .map(|number| field(&format!("x{number}"), 2))
            .collect();
        library.offer(Response::of(&[described(&name, &fields)]).payload().into());
        let _ = library.find(&name, None);
        let figures = library.described_figures();
        assert!(figures.types <= DescribedFigures::MAX_TYPES, "{figures:?}");
        assert!(figures.bytes <= DescribedFigures::MAX_BYTES, "{figures:?}");
    }
    library.find(THING, Some(&hash)).unwrap();
    for number in 0..200_u32 {
        library.offer(vec![number as u8; 200_000].into());
    }
    let figures = library.described_figures();
    let most = DescribedFigures::MAX_WAITING_BYTES;
    assert!(figures.waiting_bytes <= most, "{figures:?}");
}

#[test]
fn responses_that_are_dropped_unread_count_apart_from_types() {
    let library = library();
    let most = DescribedFigures::MAX_WAITING;
    for number in 0..most + 2 {
        library.offer(vec![number as u8; 8].into());
    }
    let figures = library.described_figures();
    let waiting = (
        figures.waiting,
        figures.waiting_bytes,
        figures.waiting_evicted,
    );
    assert_eq!(waiting, (most, 8 * most, 2));
    let types = (figures.types, figures.bytes, figures.evicted);
    assert_eq!(types, (0, 0, 0));
}

#[test]
fn a_type_without_fields_is_an_octet() {
    let empty = described("a/msg/Empty", &[field(PLACEHOLDER_MEMBER, 3)]);
    let found = described_type(&Response::of(&[empty]).payload()).unwrap();
    let decoded = decode(&found, &[0, 1, 0, 0, 0], &Limits::default()).unwrap();
    let text = yaml::document(&decoded.message, &Default::default(), yaml::Style::Block);
    assert_eq!(text, "{}\n");
}
