//! Bags in every form, as the PyPI readers read them.

use ros2probe_testing::bag_readers::read_by_others;

use super::*;

/// Returns every form and compression, by name.
fn forms() -> [(&'static str, Options); 8] {
    let usual = Options {
        ros_distro: "jazzy".into(),
        ..Options::default()
    };
    let storage = |preset: &str| Storage::preset(preset).unwrap();
    let lz4 = Storage {
        compression: Compression::Lz4,
        data_crc: true,
        ..storage("none")
    };
    let split = Some(Duration::from_secs(1));
    [
        ("usual", usual.clone()),
        (
            "humble",
            Options {
                form: Form::Humble,
                ..usual.clone()
            },
        ),
        (
            "named",
            Options {
                form: Form::Named,
                max_file_duration: split,
                ..usual.clone()
            },
        ),
        (
            "fastwrite",
            Options {
                storage: storage("fastwrite"),
                ..usual.clone()
            },
        ),
        (
            "zstd_fast",
            Options {
                storage: storage("zstd_fast"),
                ..usual.clone()
            },
        ),
        (
            "zstd_small",
            Options {
                storage: storage("zstd_small"),
                ..usual.clone()
            },
        ),
        (
            "lz4",
            Options {
                storage: lz4,
                ..usual.clone()
            },
        ),
        (
            "files",
            Options {
                file_compression: Compression::Zstd,
                max_file_duration: split,
                ..usual
            },
        ),
    ]
}

#[test]
fn the_python_readers_read_every_form_and_compression() {
    let directory = tempfile::tempdir().unwrap();
    let bags = forms().map(|(name, options)| {
        let path = directory.path().join(name);
        bag(&path, options, 40);
        path
    });
    let paths: Vec<&Path> = bags.iter().map(AsRef::as_ref).collect();
    for (path, found) in bags.iter().zip(read_by_others(&paths)) {
        let name = path.file_name().unwrap().to_str().unwrap();
        let bag = &found["rosbags"];
        assert_eq!(
            (bag["count"].as_u64(), bag["start"].as_u64()),
            (Some(40), Some(BEGIN)),
            "{name}"
        );
        assert_eq!(bag["end"], BEGIN + 39 * SECOND / 10 + 1, "{name}");
        let messages = bag["messages"].as_array().unwrap();
        assert_eq!(messages.len(), 40, "{name}");
        let connections = bag["connections"].as_array().unwrap();
        let counts: Vec<_> = connections
            .iter()
            .map(|connection| &connection["count"])
            .collect();
        assert_eq!(counts, [26, 14, 0], "{name}");
        for connection in &connections[..2] {
            assert_eq!(connection["definition"], "MSG", "{name}");
            let qos = &connection["qos"][0];
            assert_eq!(
                (&qos["history"], &qos["depth"]),
                (&"KEEP_LAST".into(), &10.into())
            );
            assert_eq!(
                (&qos["reliability"], &qos["durability"]),
                (&"RELIABLE".into(), &"VOLATILE".into())
            );
            assert_eq!(qos["deadline"], json!([9_223_372_036_u64, 854_775_807]));
            let hash = if name == "humble" { "" } else { "RIHS01_00" };
            assert_eq!(connection["hash"], hash, "{name}");
        }
        assert_eq!(
            bag["distro"],
            if name == "humble" {
                Value::Null
            } else {
                "jazzy".into()
            }
        );
        let files = found["mcap"].as_array().unwrap();
        if name == "files" {
            continue;
        }
        assert_eq!(files.len(), if name == "named" { 4 } else { 1 }, "{name}");
        let in_files: Vec<_> = files
            .iter()
            .flat_map(|file| file["messages"].as_array().unwrap())
            .collect();
        assert_eq!(in_files.len(), 40, "{name}");
        for (index, message) in in_files.iter().enumerate() {
            assert_eq!(message["sequence"], index + 1, "{name}");
            assert_eq!(message["digest"], messages[index]["digest"], "{name}");
        }
        assert!(files.iter().all(|file| file["profile"] == "ros2"));
    }
}

#[test]
fn rosbags_opens_a_bag_with_an_unknown_type() {
    let directory = tempfile::tempdir().unwrap();
    let bags = [Form::Humble, Form::Compatible, Form::Named].map(|form| {
        let path = directory.path().join(format!("{form:?}"));
        let options = Options {
            form,
            ..Options::default()
        };
        let mut writer = Writer::create(&path, options).unwrap();
        let known = writer
            .topic(topic("/chatter", "std_msgs/msg/String"))
            .unwrap();
        let unknown = TopicDescription {
            schema: None,
            ..topic("/custom", "custom_msgs/msg/Custom")
        };
        let unknown = writer.topic(unknown).unwrap();
        for (index, of) in [known, unknown].into_iter().enumerate() {
            let time = Timestamp(BEGIN + index as u64);
            writer.write(of, time, time, 1, &text(7)).unwrap();
        }
        writer.close(BTreeMap::new()).unwrap();
        path
    });
    let paths: Vec<&Path> = bags.iter().map(AsRef::as_ref).collect();
    for found in read_by_others(&paths) {
        let connections = found["rosbags"]["connections"].as_array().unwrap();
        let definitions: Vec<_> = connections
            .iter()
            .map(|connection| (&connection["topic"], &connection["definition"]))
            .collect();
        assert_eq!(
            definitions,
            [
                (&json!("/chatter"), &json!("MSG")),
                (&json!("/custom"), &json!("NONE"))
            ]
        );
        assert_eq!(found["rosbags"]["messages"].as_array().unwrap().len(), 2);
        let schemas = &found["mcap"][0]["schemas"];
        assert_eq!(schemas["custom_msgs/msg/Custom"], json!(["", 0]));
    }
}
