//! Replies of Cyclone DDS 11, and hostile ones.

use super::*;
use crate::MessageType;
use crate::library::{DescribedFigures, Library, NotFound, Sources};

/// Replies on the wire (agent/testing/data/README.md, `cyclonedds11`).
macro_rules! captured {
    ($($name:ident = $file:literal),+) => {
        $(const $name: &[u8] = include_bytes!(concat!(
            "../../../testing/data/cyclonedds11/type-lookup/", $file, ".bin"
        ));)+
        const CAPTURED: &[&[u8]] = &[$($name),+];
    };
}

captured!(
    THING = "thing",
    PART = "part",
    DERIVED = "derived",
    TICKS = "ticks",
    MODE = "mode",
    BASE = "base",
    ODD = "odd",
    CHOICE = "choice"
);

const THING_NAME: &str = "my_robot_msgs/msg/Thing";
const THING_TEXT: &str = "string label\nbool ok\nPart[<=4] parts\nuint8[3] grid\nPart one\n\
    string[] names\nstring<=10 name\nbyte b\nint8 i8\nuint16 u16\nint16 i16\nuint32 u32\nuint64 u64\n\
    int64 i64\nfloat32 f32\n";
const PART_TEXT: &str = "int32 count\nfloat64[] values\n";
const THING_HASH: &str = "XTYPES_2fe06bcbb913727017f940a805a0";

fn thing() -> MessageType {
    let text = format!(
        "{THING_TEXT}{}\nMSG: my_robot_msgs/Part\n{PART_TEXT}",
        "=".repeat(80)
    );
    MessageType::parse(&THING_NAME.parse().unwrap(), &text).unwrap()
}

fn library() -> Library {
    Library::new(Sources::default())
}

/// Returns the type of the first object of the first reply, assembled from all replies.
fn assembled(replies: &[&[u8]]) -> Result<MessageType, NotUsable> {
    let mut all = Vec::new();
    for reply in replies {
        for (hash, bytes) in objects(reply)? {
            all.push((hash, TypeObject::parse(&bytes)));
        }
    }
    message_type(all[0].0, |wanted| {
        let found = all.iter().find(|(hash, _)| *hash == wanted);
        let (_, object) = found.ok_or(NotUsable::Missing(wanted))?;
        object.as_ref().map_err(Clone::clone)
    })
}

fn fields(found: &MessageType) -> String {
    crate::definition::schema::members(found.structure(&found.root).unwrap())
}

#[test]
fn captured_types_equal_their_definitions() {
    let found = assembled(&[THING, PART]).unwrap();
    assert!(
        found.structures().eq(thing().structures()),
        "{}",
        fields(&found)
    );
    assert_eq!(found.type_hash(), thing().type_hash());
    let found = assembled(&[DERIVED, BASE, MODE, TICKS]).unwrap();
    let expected = "uint32 id\nint32 mode\nint32[<=300] ticks\nint16[6] table\n";
    assert_eq!((found.root.name(), &*fields(&found)), ("Derived", expected));
}

#[test]
fn types_without_a_form_in_ros_are_refused_by_name() {
    let refused = |replies: &[&[u8]]| assembled(replies).unwrap_err().to_string();
    assert_eq!(refused(&[ODD, CHOICE]), "a union is not supported");
    let missing = "no reply with the type XTYPES_3b3e1b4e81c88813b5b240e2f5b3 was seen";
    assert_eq!(refused(&[THING]), missing);
    let one = |identifier: Id| {
        refused(&[&reply(&[structure(
            "a::msg::dds_::B_",
            &[("x", identifier)],
        )])])
    };
    for (kind, text) in [
        (0x0b, "long double is not supported"),
        (0x11, "wchar is not supported"),
        (0xa0, "a map is not supported"),
        (0xb0, "a recursive type is not supported"),
        (0xf1, "a minimal type is not supported"),
        (0xee, "an unknown kind of type is not supported"),
    ] {
        assert_eq!(one(Id::Kind(kind)), text);
    }
    let sequence = |inner| Id::Sequence(0, Box::new(inner));
    let nested = "a sequence in a collection is not supported";
    assert_eq!(one(sequence(sequence(Id::Kind(0x04)))), nested);
    let deep = (0..20).fold(Id::Kind(0x04), |inner, _| sequence(inner));
    assert_eq!(one(deep), "nested deeper than 32 types");
    assert_eq!(
        one(Id::Array(vec![200; 8])),
        "320000000000 is not a capacity from 1 to 4294967295"
    );
    let named = |name, member| refused(&[&reply(&[structure(name, &[(member, Id::Kind(4))])])]);
    assert_eq!(named("Shape", "x"), "`Shape` is not the name of a ROS type");
    assert_eq!(
        named("a::msg::dds_::B_", "x y"),
        "`x y` is not a valid name of a field"
    );
    let twice = structure(
        "a::msg::dds_::B_",
        &[("x", Id::Kind(4)), ("x", Id::Kind(4))],
    );
    assert_eq!(refused(&[&reply(&[twice])]), "`x` occurs twice");
    for (flags, member, text) in [
        (4, 1, "a mutable structure is not supported"),
        (1, 9, "an optional member is not supported"),
    ] {
        let object = flagged(
            "a::msg::dds_::B_",
            flags,
            None,
            &[("x", member, Id::Kind(4))],
        );
        assert_eq!(refused(&[&reply(&[object])]), text);
    }
}

#[test]
fn members_with_a_trailing_underscore_have_their_names_in_ros() {
    let object = structure(
        "a::srv::dds_::B_Request_",
        &[("x_", Id::Kind(4)), ("y_", Id::Kind(1))],
    );
    let found = assembled(&[&reply(&[object])]).unwrap();
    assert_eq!(found.root.to_string(), "a/srv/B_Request");
    assert_eq!(fields(&found), "int32 x\nbool y\n");
}

#[test]
fn parts_of_another_extensibility_or_another_type_of_the_same_name_are_refused() {
    let part = |kind| structure("a::msg::dds_::P_", &[("x", Id::Kind(kind))]);
    let (one, other) = (part(4), part(5));
    let ids = [("p", Id::Hash(hash(&one))), ("q", Id::Hash(hash(&other)))];
    let root = structure("a::msg::dds_::B_", &ids);
    let failure = assembled(&[&reply(&[root, one.clone(), other])]).unwrap_err();
    assert_eq!(failure, NotUsable::Ambiguous("a/msg/P".parse().unwrap()));
    let root = flagged(
        "a::msg::dds_::B_",
        2,
        None,
        &[("p", 1, Id::Hash(hash(&one)))],
    );
    let failure = assembled(&[&reply(&[root, one])]).unwrap_err();
    let text = "a mixture of final and appendable structures is not supported";
    assert_eq!(failure.to_string(), text);
}

#[test]
fn every_changed_byte_of_an_object_is_noticed() {
    for reply in CAPTURED {
        let all = objects(reply).unwrap();
        assert_eq!(all.len(), 1);
        let mut changed = reply.to_vec();
        for position in 0..reply.len() {
            for flip in [0x01, 0x80, 0xff] {
                changed[position] ^= flip;
                let read = objects(&changed).unwrap_or_default();
                assert!(read.iter().all(|pair| all.contains(pair)), "{position}");
                changed[position] ^= flip;
            }
        }
        for length in 0..reply.len() {
            let read = objects(&reply[..length]).unwrap_or_default();
            assert!(read.iter().all(|pair| all.contains(pair)), "{length}");
        }
    }
}

/// The padding in replies, from the layout of DDS-XTypes 1.3, 7.3.4.
const THING_PADDING: [usize; 14] = [
    0x5f, 0x85, 0x86, 0x87, 0xb3, 0xbd, 0xbe, 0xbf, 0xde, 0xdf, 0xfa, 0xfb, 0x102, 0x103,
];
const TICKS_PADDING: [usize; 7] = [0x5e, 0x5f, 0x85, 0x86, 0x87, 0x92, 0x93];
const MODE_PADDING: [usize; 5] = [0x9a, 0x9b, 0xa7, 0xb6, 0xb7];
const CHOICE_PADDING: [usize; 8] = [0x5e, 0x5f, 0x86, 0x87, 0x91, 0x92, 0x93, 0xa7];

/// Returns the reply as Fast DDS 3 would send it, with bytes of an earlier message as padding.
fn with_undefined_padding(reply: &[u8], padding: &[usize]) -> Vec<u8> {
    let mut changed = reply.to_vec();
    for position in padding {
        changed[*position] = 0xa5;
    }
    changed
}

#[test]
fn objects_with_undefined_padding_have_their_hash() {
    for (reply, padding) in [
        (THING, &THING_PADDING[..]),
        (TICKS, &TICKS_PADDING),
        (MODE, &MODE_PADDING),
        (CHOICE, &CHOICE_PADDING),
    ] {
        assert!(padding.iter().all(|position| reply[*position] == 0));
        let changed = with_undefined_padding(reply, padding);
        assert_eq!(objects(&changed), objects(reply));
        // Any other byte counts still.
        let mut forged = changed.clone();
        forged[0x54 + 12] ^= 1;
        let failure = objects(&forged).unwrap_err();
        assert!(matches!(failure, NotUsable::Forged(_)), "{failure}");
    }
    let library = library();
    library.offer_objects(with_undefined_padding(THING, &THING_PADDING).into());
    library.offer_objects(PART.into());
    let found = library.find(THING_NAME, Some(THING_HASH)).unwrap();
    assert!(found.structures().eq(thing().structures()));
    assert_eq!(library.described_figures().objects_refused, 0);
}

/// Checks that a TypeObject with undefined padding has the hash of the one with zeros, and returns
/// the latter.
fn without_padding(write: impl Fn(&mut Writer)) -> Vec<u8> {
    let [zeros, undefined] = [0, 0xa5].map(|padding| {
        let mut writer = Writer(Vec::new(), padding);
        writer.sized(&write);
        writer.0
    });
    assert_ne!(zeros, undefined);
    let found = with_hash(&undefined, hash(&zeros));
    assert_eq!(found.as_deref(), Some(&zeros[..]));
    for length in 0..undefined.len() {
        assert_eq!(with_hash(&undefined[..length], hash(&zeros)), None);
    }
    zeros
}

#[test]
fn annotations_with_undefined_padding_do_not_hide_a_type() {
    let object = without_padding(|writer| {
        writer.0.extend([0xf2, 0x51]);
        writer.u16(1);
        writer.sized(|header| {
            // No base type, `@verbatim`, and an annotation of the user with values of all sizes.
            header.0.extend([0, 1]);
            header.sized(|builtin| {
                builtin.0.push(1);
                for text in ["BEFORE_DECLARATION", "comment", "A speed."] {
                    builtin.string(text);
                }
            });
            header.0.push(1);
            header.sized(|all| {
                all.u32(1);
                all.sized(|annotation| {
                    annotation.identifier(&Id::Hash(EquivalenceHash([9; 14])));
                    annotation.0.push(1);
                    annotation.sized(values);
                });
            });
            header.string("a::msg::dds_::B_");
        });
        writer.sized(|all| {
            all.u32(1);
            all.sized(|member| {
                member.u32(0);
                member.u16(1);
                member.identifier(&Id::Kind(0x0a));
                member.string("x");
                member.0.push(1);
                member.sized(|builtin| {
                    builtin.0.push(1);
                    builtin.string("m/s");
                    for number in [0, 7] {
                        builtin.0.extend([1, 0x04]);
                        builtin.u32(number);
                    }
                    builtin.0.push(0);
                });
                member.0.push(0);
            });
        });
    });
    let found = assembled(&[&reply(&[object])]).unwrap();
    assert_eq!(fields(&found), "float64 x\n");
}

/// Writes a parameter of an annotation with a value of each size, and one of an unknown kind.
fn values(parameters: &mut Writer) {
    const KINDS: [u8; 7] = [0x01, 0x03, 0x40, 0x08, 0x0b, 0x20, 0xee];
    parameters.u32(KINDS.len() as u32);
    for kind in KINDS {
        parameters.sized(|parameter| {
            parameter.0.extend([1, 2, 3, 4, kind]);
            match kind {
                0x01 => parameter.0.push(1),
                0x03 => parameter.u16(5),
                0x20 => parameter.string("text"),
                0xee => parameter.sized(|extended| extended.0.push(3)),
                _ => {
                    let words = match kind {
                        0x40 => 1,
                        0x08 => 2,
                        _ => 4,
                    };
                    for number in 0..words {
                        parameter.u32(number);
                    }
                }
            }
        });
    }
}

#[test]
fn bits_with_undefined_padding_are_refused_by_name() {
    let refused = |object: &[u8]| TypeObject::parse(object).unwrap_err().to_string();
    let mask = without_padding(|writer| {
        writer.0.extend([0xf2, 0x41]);
        writer.sized(|mask| {
            mask.u16(0);
            mask.sized(|header| {
                header.u16(8);
                header.0.extend([0, 0]);
                header.string("a::msg::dds_::M_");
            });
            mask.sized(|all| {
                all.u32(2);
                for position in 0..2 {
                    all.sized(|flag| {
                        flag.u16(position);
                        flag.u16(0);
                        flag.string("flag");
                        flag.0.extend([0, 0]);
                    });
                }
            });
        });
    });
    assert_eq!(refused(&mask), "a bitmask is not supported");
    let set = without_padding(|writer| {
        writer.0.extend([0xf2, 0x53]);
        writer.sized(|set| {
            set.u16(0);
            set.sized(|header| {
                header.0.extend([0, 0]);
                header.string("a::msg::dds_::S_");
            });
            set.sized(|all| {
                all.u32(1);
                all.sized(|field| {
                    field.u16(0);
                    field.u16(0);
                    field.0.extend([3, 0x02]);
                    field.string("field");
                    field.0.extend([0, 0]);
                });
            });
        });
    });
    assert_eq!(refused(&set), "a bitset is not supported");
}

#[test]
fn damaged_objects_with_a_fitting_hash_cause_no_panic() {
    for captured in CAPTURED {
        let object = objects(captured).unwrap()[0].1.to_vec();
        let mut changed = object.clone();
        for position in 0..object.len() {
            for value in [0, 1, 0x7f, 0x80, 0xff, object[position] ^ 1] {
                changed[position] = value;
                let _ = assembled(&[&reply(&[changed.clone()]), PART, BASE, MODE, TICKS]);
            }
            changed[position] = object[position];
            let _ = TypeObject::parse(&object[..position]).unwrap_err();
        }
    }
}

#[test]
fn a_reply_with_its_size_is_read() {
    let body = &THING[4..];
    let size = u32::try_from(body.len()).unwrap().to_le_bytes();
    let delimited = [&[0, 9, 0, 0][..], &size, body].concat();
    assert_eq!(objects(&delimited), objects(THING));
    let too_long = [&[0, 9, 0, 0, 0xff, 0xff, 0, 0][..], body].concat();
    let text = objects(&too_long).unwrap_err().to_string();
    assert_eq!(text, "TypeLookup_Reply at offset 8: truncated");
}

#[test]
fn other_encodings_replies_and_sizes_are_refused_or_empty() {
    let with = |range: std::ops::Range<usize>, bytes: &[u8]| {
        let mut changed = THING.to_vec();
        changed[range].copy_from_slice(bytes);
        objects(&changed).map(|all| all.len())
    };
    assert_eq!(with(0..2, &[0, 6]), Err(NotUsable::Encapsulation(6)));
    assert_eq!(with(0..2, &[0, 1]), Err(NotUsable::Encapsulation(1)));
    // A failure of the request, a reply to another request, an empty result.
    assert_eq!(with(28..32, &[1, 0, 0, 0]), Ok(0));
    assert_eq!(with(36..40, &[1, 0, 0, 0]), Ok(0));
    assert_eq!(with(44..48, &[1, 0, 0, 0]), Ok(0));
    assert!(matches!(
        with(60..64, &[0xff; 4]),
        Err(NotUsable::Kind(_) | NotUsable::Malformed(_))
    ));
    assert_eq!(
        objects(&vec![0; MAX_REPLY + 1]).unwrap_err(),
        NotUsable::TooLong
    );
    assert_eq!(
        objects(&[0, 7]).unwrap_err().to_string(),
        "encapsulation options at offset 2: truncated"
    );
}

#[test]
fn recursion_and_growth_are_bounded() {
    // Each base has 4000 fields, and 40 structures extend the one before.
    let names: Vec<_> = (0..4000).map(|number| format!("x{number}")).collect();
    let mut all = Vec::new();
    let mut base = None;
    for level in 0..40 {
        let members: Vec<_> = names
            .iter()
            .map(|name| (format!("l{level}{name}"), 1, Id::Kind(4)))
            .collect();
        let members: Vec<_> = members
            .iter()
            .map(|(name, flags, id)| (name.as_str(), *flags, id.clone()))
            .collect();
        let object = flagged(&format!("a::msg::dds_::T{level}_"), 1, base, &members);
        base = Some(hash(&object));
        all.insert(0, object);
    }
    let replies: Vec<_> = all
        .iter()
        .map(|one| reply(std::slice::from_ref(one)))
        .collect();
    let replies: Vec<_> = replies.iter().map(Vec::as_slice).collect();
    let failure = assembled(&replies).unwrap_err();
    assert_eq!(failure, NotUsable::NotClosed(NotClosed::TooDeep));
    let failure = assembled(&replies[20..]).unwrap_err();
    assert_eq!(failure, NotUsable::NotClosed(NotClosed::TooLong));
    // A count beyond the bytes takes no memory.
    let mut object = structure("a::msg::dds_::B_", &[("x", Id::Kind(4))]);
    let count = object.len() - 4 - 16 - 4;
    object[count..count + 4].copy_from_slice(&[0xff; 4]);
    let failure = assembled(&[&reply(&[object])]).unwrap_err();
    assert!(matches!(failure, NotUsable::Malformed(_)), "{failure}");
}

#[test]
fn a_lookup_finds_the_type_with_the_announced_hash_in_any_order_of_replies() {
    let offers = [[THING, PART], [PART, THING]];
    for offer in offers {
        let library = library();
        for reply in offer {
            library.offer_objects(reply.into());
            library.offer_objects(reply.into());
        }
        for hash in [Some(THING_HASH), Some(&thing().type_hash()), None] {
            let found = library.find(THING_NAME, hash).unwrap();
            assert!(found.structures().eq(thing().structures()), "{hash:?}");
        }
        // The type itself has the hash, not another name.
        library
            .find("my_robot_msgs/msg/Part", Some(THING_HASH))
            .unwrap_err();
        let other = format!("XTYPES_{}", "0".repeat(28));
        let failure = library.find(THING_NAME, Some(&other)).unwrap_err();
        assert!(
            matches!(failure, NotFound::OtherDefinition { .. }),
            "{failure}"
        );
        let other = format!("RIHS01_{}", "0".repeat(64));
        library.find(THING_NAME, Some(&other)).unwrap_err();
        let figures = library.described_figures();
        let counts = (figures.objects, figures.objects_refused, figures.mismatched);
        assert_eq!(counts, (2, 0, 2), "{figures:?}");
    }
}

#[test]
fn a_lookup_names_what_is_missing_and_succeeds_once_it_arrives() {
    let library = library();
    library.offer_objects(THING.into());
    let failure = library.find(THING_NAME, Some(THING_HASH)).unwrap_err();
    let text = "no definition of my_robot_msgs/msg/Thing here, and the one that the nodes sent \
        cannot be used: no reply with the type XTYPES_3b3e1b4e81c88813b5b240e2f5b3 was seen";
    assert_eq!(failure.to_string(), text);
    library
        .find(THING_NAME, Some(&thing().type_hash()))
        .unwrap_err();
    library.offer_objects(PART.into());
    library.find(THING_NAME, Some(THING_HASH)).unwrap();
    library
        .find(THING_NAME, Some(&thing().type_hash()))
        .unwrap();
    library.offer_objects(CHOICE.into());
    library.offer_objects(b"\0\x07\0\0\x01"[..].into());
    library.find(THING_NAME, Some(THING_HASH)).unwrap();
    assert_eq!(library.described_figures().objects_refused, 2);
}

#[test]
fn type_objects_are_bounded_and_do_not_displace_used_ones() {
    let library = library();
    for reply in [THING, PART] {
        library.offer_objects(reply.into());
    }
    library.find(THING_NAME, Some(THING_HASH)).unwrap();
    let check = || {
        let _ = library.find("a/msg/T0", None);
        let figures = library.described_figures();
        assert!(
            figures.objects <= DescribedFigures::MAX_OBJECTS,
            "{figures:?}"
        );
        assert!(
            figures.object_bytes <= DescribedFigures::MAX_OBJECT_BYTES,
            "{figures:?}"
        );
        assert!(figures.types <= DescribedFigures::MAX_TYPES, "{figures:?}");
        assert!(figures.bytes <= DescribedFigures::MAX_BYTES, "{figures:?}");
        figures
    };
    for start in 0..60 {
        let forged = |number| {
            let member = format!("x{start}{number}");
            structure("a::msg::dds_::T0_", &[(&member, Id::Kind(4))])
        };
        library.offer_objects(reply(&(0..50).map(forged).collect::<Vec<_>>()).into());
        check();
    }
    assert_eq!(check().objects, DescribedFigures::MAX_OBJECTS);
    for number in 0..60 {
        let names: Vec<_> = (0..4000)
            .map(|field| format!("f{number}_{field}"))
            .collect();
        let members: Vec<_> = names.iter().map(|name| (&**name, Id::Kind(4))).collect();
        library.offer_objects(reply(&[structure("a::msg::dds_::T1_", &members)]).into());
        check();
    }
    assert!(check().objects_evicted > 0);
    library.find(THING_NAME, Some(THING_HASH)).unwrap();
    library.offer_objects(vec![0; MAX_REPLY + 1].into());
    for number in 0..200_u32 {
        library.offer_objects(vec![number as u8; 200_000].into());
    }
    let figures = library.described_figures();
    let most = DescribedFigures::MAX_WAITING_BYTES;
    assert!(figures.waiting_bytes <= most, "{figures:?}");
}

/// A TypeIdentifier.
#[derive(Clone)]
enum Id {
    Kind(u8),
    Hash(EquivalenceHash),
    Sequence(u8, Box<Id>),
    /// Octets, by the dimensions.
    Array(Vec<u8>),
}

/// Writes XCDR2 in little-endian order, with this byte as padding.
#[derive(Default)]
struct Writer(Vec<u8>, u8);

impl Writer {
    fn align(&mut self, alignment: usize) {
        let length = self.0.len().next_multiple_of(alignment);
        self.0.resize(length, self.1);
    }

    fn u16(&mut self, number: u16) {
        self.align(2);
        self.0.extend(number.to_le_bytes());
    }

    fn u32(&mut self, number: u32) {
        self.align(4);
        self.0.extend(number.to_le_bytes());
    }

    fn string(&mut self, text: &str) {
        self.u32(text.len() as u32 + 1);
        self.0.extend(text.as_bytes());
        self.0.push(0);
    }

    fn sized(&mut self, write: impl FnOnce(&mut Self)) {
        self.u32(0);
        let start = self.0.len();
        write(self);
        let size = (self.0.len() - start) as u32;
        self.0[start - 4..start].copy_from_slice(&size.to_le_bytes());
    }

    fn identifier(&mut self, id: &Id) {
        match id {
            Id::Kind(kind) => self.0.push(*kind),
            Id::Hash(hash) => {
                self.0.push(0xf2);
                self.0.extend(hash.0);
            }
            Id::Sequence(bound, inner) => {
                self.0.extend([0x80, 0xf3]);
                self.u16(1);
                self.0.push(*bound);
                self.identifier(inner);
            }
            Id::Array(dimensions) => {
                self.0.extend([0x90, 0xf3]);
                self.u16(1);
                self.u32(dimensions.len() as u32);
                self.0.extend(dimensions);
                self.0.push(0x0d);
            }
        }
    }
}

/// Returns the TypeObject of a structure, from its size on.
fn flagged(
    name: &str,
    flags: u16,
    base: Option<EquivalenceHash>,
    members: &[(&str, u16, Id)],
) -> Vec<u8> {
    let mut writer = Writer::default();
    writer.sized(|writer| {
        writer.0.extend([0xf2, 0x51]);
        writer.u16(flags);
        writer.sized(|writer| {
            match base {
                Some(hash) => writer.identifier(&Id::Hash(hash)),
                None => writer.0.push(0),
            }
            writer.0.extend([0, 0]);
            writer.string(name);
        });
        writer.sized(|writer| {
            writer.u32(members.len() as u32);
            for (number, (name, flags, id)) in (0..).zip(members) {
                writer.sized(|writer| {
                    writer.u32(number);
                    writer.u16(*flags);
                    writer.identifier(id);
                    writer.string(name);
                    writer.0.extend([0, 0]);
                });
            }
        });
    });
    writer.0
}

fn structure(name: &str, members: &[(&str, Id)]) -> Vec<u8> {
    let members: Vec<_> = members
        .iter()
        .map(|(name, id)| (*name, 1, id.clone()))
        .collect();
    flagged(name, 1, None, &members)
}

fn hash(object: &[u8]) -> EquivalenceHash {
    let digest = Md5::digest(object);
    EquivalenceHash(*digest.first_chunk().unwrap())
}

/// Returns a reply with these TypeObjects.
fn reply(objects: &[Vec<u8>]) -> Vec<u8> {
    let mut writer = Writer(vec![0, 7, 0, 0], 0);
    writer.0.extend([7; REQUEST_IDENTITY]);
    writer.u32(0);
    writer.sized(|writer| {
        writer.u32(GET_TYPES);
        writer.sized(|writer| {
            writer.u32(0);
            writer.sized(|writer| {
                writer.u32(5 << 28 | TYPES);
                writer.sized(|writer| {
                    writer.u32(objects.len() as u32);
                    for object in objects {
                        writer.identifier(&Id::Hash(hash(object)));
                        writer.align(4);
                        writer.0.extend(object);
                    }
                });
            });
        });
    });
    writer.0
}
