//! Compares the model's list of types that begin with a header with their definitions.

use ros2probe_message::{Dialect, Element, Library, Sources};
use ros2probe_model::facts::header::begins_with_header;

/// Uses the definitions built into the program. A unit test finds each of them in this list.
#[test]
fn the_list_of_types_with_a_header_agrees_with_the_message_definitions() {
    let listed = include_str!("../../../testing/data/message/type_hashes.txt");
    let names = listed.lines().filter_map(|line| line.split(' ').next());
    let messages = names.filter(|name| name.contains("/msg/"));
    let header = Element::Nested("std_msgs/msg/Header".parse().unwrap());
    let dialects = [
        Dialect::Humble,
        Dialect::Jazzy,
        Dialect::Kilted,
        Dialect::Rolling,
    ];
    let libraries = dialects.map(|dialect| {
        Library::new(Sources {
            dialect,
            ..Sources::default()
        })
    });
    let mut count = 0;
    for name in messages {
        for library in &libraries {
            let found = library.find(name, None).unwrap();
            let first = found.structure(&found.root).unwrap().fields.first();
            let begins = first.is_some_and(|field| field.element == header);
            assert_eq!(begins_with_header(name), begins, "{name}");
            count += 1;
        }
    }
    assert!(count > 4 * 150, "{count}");
}
