//! Content of written bags, as other readers find it.

use super::*;
use ros2probe_wire::Expansion;

#[test]
fn messages_larger_than_a_chunk_are_stored_in_order_between_small_ones() {
    let directory = tempfile::tempdir().unwrap();
    let crc = |storage| Storage {
        chunk_crc: true,
        data_crc: true,
        ..storage
    };
    for (name, storage) in [
        ("chunked", Storage::default()),
        ("checked", crc(Storage::default())),
        ("plain", crc(Storage::preset("fastwrite").unwrap())),
        ("packed", crc(Storage::preset("zstd_fast").unwrap())),
    ] {
        let options = Options {
            storage,
            ..Options::default()
        };
        let mut writer = Writer::create(&directory.path().join(name), options).unwrap();
        let id = writer
            .topic(topic("/points", "sensor_msgs/msg/PointCloud2"))
            .unwrap();
        let sizes = [10, 3_000_000, 2_000_000, 20, 30, 1_000_000];
        let data = |index: usize| vec![u8::try_from(index).unwrap(); sizes[index]];
        for index in 0..sizes.len() {
            let time = Timestamp(BEGIN + index as u64);
            writer
                .write(id, time, time, index as u64, &data(index))
                .unwrap();
        }
        let summary = writer.close(BTreeMap::new()).unwrap();
        let mut found = Vec::new();
        read::scan(&summary.files[0], Expansion::Limited, &mut |message, _| {
            found.push((message.sequence as usize, message.data.to_vec()));
        })
        .unwrap();
        let sent: Vec<_> = (0..sizes.len()).map(|index| (index, data(index))).collect();
        assert!(found == sent, "{name}");
        // The `mcap` crate checks the checksums; it is built without zstd here.
        if name != "packed" {
            let theirs = messages(&summary.files[0]).into_iter();
            assert!(
                theirs
                    .map(|message| message.4)
                    .eq(sent.into_iter().map(|sent| sent.1))
            );
        }
        let indexed = read::Contents::of_summary(&summary.files[0])
            .unwrap()
            .unwrap();
        assert_eq!(indexed.counts.values().sum::<u64>(), 6, "{name}");
    }
}

#[test]
fn a_file_is_split_when_its_index_reaches_the_limit() {
    let directory = tempfile::tempdir().unwrap();
    let options = Options {
        max_index_bytes: Some(1000),
        ..Options::default()
    };
    let mut writer = Writer::create(&directory.path().join("long"), options).unwrap();
    let id = writer
        .topic(topic("/chatter", "std_msgs/msg/String"))
        .unwrap();
    for index in 0..40 {
        let time = Timestamp(BEGIN + index);
        writer.write(id, time, time, index, &text(index)).unwrap();
        writer.flush().unwrap();
    }
    let summary = writer.close(BTreeMap::new()).unwrap();
    assert!(summary.files.len() > 2, "{summary:?}");
    assert_eq!(summary.messages, 40);
}

#[test]
fn another_reader_finds_every_message_and_its_index() {
    let directory = tempfile::tempdir().unwrap();
    for (name, storage) in [
        (
            "chunked",
            Storage {
                chunk_crc: true,
                data_crc: true,
                ..Storage::default()
            },
        ),
        ("flat", Storage::preset("fastwrite").unwrap()),
        (
            "small",
            Storage {
                chunk_bytes: 1000,
                ..Storage::default()
            },
        ),
    ] {
        let bag_directory = directory.path().join(name);
        let summary = bag(
            &bag_directory,
            Options {
                storage,
                ..Options::default()
            },
            50,
        );
        assert_eq!(
            summary.files,
            [bag_directory.join(format!("{name}_0.mcap"))]
        );
        assert_eq!(summary.messages, 50);
        assert_eq!(
            summary.bytes,
            fs::metadata(&summary.files[0]).unwrap().len()
        );
        let found = messages(&summary.files[0]);
        assert_eq!(found.len(), 50);
        for (index, (topic, sequence, log_time, publish_time, data)) in
            found.into_iter().enumerate()
        {
            let index = index as u64;
            let of_cloud = index.is_multiple_of(3);
            assert_eq!(topic, if of_cloud { "/points" } else { "/chatter" });
            assert_eq!(data, if of_cloud { cloud(index) } else { text(index) });
            assert_eq!(u64::from(sequence), index + 1);
            assert_eq!(log_time, BEGIN + index * SECOND / 10);
            assert_eq!(publish_time, log_time - 1000);
        }
        let bytes = fs::read(&summary.files[0]).unwrap();
        let read = mcap::Summary::read(&bytes).unwrap().unwrap();
        let statistics = read.stats.as_ref().unwrap();
        assert_eq!(
            (statistics.message_count, statistics.channel_count),
            (50, 2)
        );
        assert_eq!(statistics.message_end_time, BEGIN + 49 * SECOND / 10);
        assert_eq!(read.channels.len(), 3, "also the silent topic");
        let through_index: usize = read
            .chunk_indexes
            .iter()
            .map(|chunk| read.read_message_indexes(&bytes, chunk).unwrap())
            .flat_map(|indexes| indexes.into_values().map(|entries| entries.len()))
            .sum();
        assert_eq!(
            through_index,
            if storage.chunked { 50 } else { 0 },
            "{name}"
        );
    }
}

#[test]
fn metadata_describes_the_content_of_the_bag() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("run");
    let options = Options {
        ros_distro: "humble".into(),
        ..Options::default()
    };
    bag(&path, options, 30);
    let found = metadata(&path);
    assert_eq!((found.version, found.message_count), (5, 30));
    assert_eq!(
        (found.starting_time, found.duration),
        (BEGIN, 29 * SECOND / 10)
    );
    let counts: Vec<_> = found
        .topics
        .iter()
        .map(|topic| (topic.name.as_str(), topic.message_count))
        .collect();
    assert_eq!(counts, [("/chatter", 20), ("/points", 10), ("/silent", 0)]);
    assert_eq!(found.relative_file_paths, ["run_0.mcap"]);
    assert_eq!(found.ros_distro, "humble");
    assert!(
        found.topics[0]
            .offered_qos_profiles
            .starts_with("- history: 1\n  depth: 10\n")
    );
    // The file contains the same metadata, for readers of single files.
    let bytes = fs::read(path.join("run_0.mcap")).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    assert_eq!(summary.metadata_indexes.len(), 2);
    let record = mcap::read::metadata(&bytes, &summary.metadata_indexes[1]).unwrap();
    assert_eq!(record.name, "rosbag2");
    assert_eq!(
        Metadata::read_record(&record.metadata["serialized_metadata"]).unwrap(),
        found
    );
}

#[test]
fn files_are_split_by_size_and_time_without_losing_messages() {
    let directory = tempfile::tempdir().unwrap();
    let by_time = directory.path().join("time");
    let options = Options {
        max_file_duration: Some(Duration::from_secs(2)),
        ..Options::default()
    };
    let summary = bag(&by_time, options, 50);
    // A file holds messages up to 2 s after its first one.
    let counts: Vec<_> = summary
        .files
        .iter()
        .map(|file| messages(file).len())
        .collect();
    assert_eq!(counts, [21, 21, 8]);
    let files = metadata(&by_time).files;
    assert_eq!(files[1].starting_time, BEGIN + 21 * SECOND / 10);
    assert_eq!(
        files
            .iter()
            .map(|file| file.message_count)
            .collect::<Vec<_>>(),
        [21, 21, 8]
    );

    let by_size = directory.path().join("size");
    let options = Options {
        max_file_bytes: Some(300_000),
        ..Options::default()
    };
    let summary = bag(&by_size, options, 50);
    assert!(summary.files.len() > 4, "{:?}", summary.files);
    let all: Vec<_> = summary
        .files
        .iter()
        .flat_map(|file| messages(file))
        .collect();
    let sequences: Vec<_> = all.iter().map(|message| message.1).collect();
    assert_eq!(sequences, (1..=50).collect::<Vec<_>>());
}

#[test]
fn flushed_messages_survive_the_end_of_the_writer() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("killed");
    let mut writer = Writer::create(&path, Options::default()).unwrap();
    let chatter = writer
        .topic(topic("/chatter", "std_msgs/msg/String"))
        .unwrap();
    assert_eq!(metadata(&path).message_count, 0);
    for index in 0..5 {
        writer
            .write(
                chatter,
                Timestamp(BEGIN + index),
                Timestamp(BEGIN),
                index,
                &text(index),
            )
            .unwrap();
        if index == 2 {
            writer.flush().unwrap();
        }
    }
    // The writer is neither closed nor dropped, as after `kill -9`.
    std::mem::forget(writer);
    assert_eq!(metadata(&path).message_count, 3);
    let bytes = fs::read(path.join("killed_0.mcap")).unwrap();
    let options = mcap::read::Options::IgnoreEndMagic;
    let stream = mcap::MessageStream::new_with_options(&bytes, options.into()).unwrap();
    assert_eq!(stream.filter(Result::is_ok).count(), 3);
}

#[test]
fn creating_a_bag_in_an_existing_directory_fails() {
    let directory = tempfile::tempdir().unwrap();
    let error = Writer::create(directory.path(), Options::default()).unwrap_err();
    let text = format!(
        "Output folder '{}' already exists.",
        directory.path().display()
    );
    assert!(matches!(error, Error::Exists(_)));
    assert_eq!(error.to_string(), text);
    assert!(matches!(
        Writer::create(Path::new(".."), Options::default()),
        Err(Error::Exists(_))
    ));
}

#[test]
fn later_publishers_are_listed_separately_from_the_topic() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("later");
    let mut writer = Writer::create(&path, Options::default()).unwrap();
    let mut description = topic("/chatter", "std_msgs/msg/String");
    let chatter = writer.topic(description.clone()).unwrap();
    writer
        .write(chatter, Timestamp(BEGIN), Timestamp(BEGIN), 1, &text(1))
        .unwrap();
    description
        .publishers
        .push(description.publishers[0].clone());
    assert_eq!(writer.topic(description.clone()).unwrap(), chatter);
    writer.split().unwrap();
    writer
        .write(chatter, Timestamp(BEGIN), Timestamp(BEGIN), 2, &text(2))
        .unwrap();
    let other = TopicDescription {
        type_name: "std_msgs/msg/Bool".into(),
        ..description
    };
    assert!(matches!(
        writer.topic(other),
        Err(Error::TypeConflict { .. })
    ));
    let summary = writer.close(BTreeMap::new()).unwrap();
    let profiles = |text: &str| text.matches("- history: 1").count();
    let found = metadata(&path);
    assert_eq!(profiles(&found.topics[0].offered_qos_profiles), 1);
    let later = &found.custom_data["ros2probe.later_qos_profiles /chatter"];
    assert_eq!(profiles(later), 2);
    for file in &summary.files {
        let read = mcap::Summary::read(&fs::read(file).unwrap())
            .unwrap()
            .unwrap();
        let channel = read.channels.values().next().unwrap().clone();
        assert_eq!(profiles(&channel.metadata["offered_qos_profiles"]), 1);
    }
}

#[test]
fn the_form_of_a_bag_follows_the_distribution() {
    let directory = tempfile::tempdir().unwrap();
    for (distro, version, begins) in [
        ("humble", 5, "- history: 1\n"),
        ("jazzy", 9, "- history: keep_last\n"),
    ] {
        let path = directory.path().join(distro);
        let form = Form::of(distro);
        let options = Options {
            form,
            ros_distro: distro.into(),
            ..Options::default()
        };
        let summary = bag(&path, options, 3);
        let found = metadata(&path);
        assert_eq!(found.version, version);
        assert!(
            found.topics[0].offered_qos_profiles.starts_with(begins),
            "{found:?}"
        );
        let bytes = fs::read(&summary.files[0]).unwrap();
        let read = mcap::Summary::read(&bytes).unwrap().unwrap();
        let channel = read.channels.values().next().unwrap();
        let profiles = &channel.metadata["offered_qos_profiles"];
        assert_eq!(profiles, &found.topics[0].offered_qos_profiles);
        assert_eq!(
            channel.metadata.contains_key("topic_type_hash"),
            version == 9
        );
        // Humble writes its record once, at the beginning.
        assert_eq!(
            read.metadata_indexes.len(),
            if version == 5 { 1 } else { 2 }
        );
    }
}

#[test]
fn complete_files_are_compressed_by_the_thread_that_takes_the_task() {
    let directory = tempfile::tempdir().unwrap();
    for compression in [Compression::Zstd, Compression::Lz4] {
        let path = directory.path().join(compression.name());
        let options = Options {
            file_compression: compression,
            max_file_duration: Some(Duration::from_secs(1)),
            ..Options::default()
        };
        let mut writer = Writer::create(&path, options).unwrap();
        let chatter = writer
            .topic(topic("/chatter", "std_msgs/msg/String"))
            .unwrap();
        for index in 0..30 {
            let time = Timestamp(BEGIN + index * SECOND / 10);
            writer
                .write(chatter, time, time, index, &text(index))
                .unwrap();
        }
        let taken = writer.take_file_compressions();
        assert_eq!(
            (taken.len(), metadata(&path).compression_mode.as_str()),
            (2, "")
        );
        let done = std::thread::spawn(move || taken[0].run().unwrap())
            .join()
            .unwrap();
        writer.compressed(&done).unwrap();
        let found = metadata(&path);
        assert_eq!(
            (
                found.compression_mode.as_str(),
                found.compression_format.as_str()
            ),
            ("FILE", compression.name())
        );
        let suffix = compression.name();
        assert_eq!(
            found.relative_file_paths[0],
            format!("{suffix}_0.mcap.{suffix}")
        );
        // Closing compresses the last file, but not the second one, which another thread took.
        let summary = writer.close(BTreeMap::new()).unwrap();
        let names: Vec<_> = summary.files.iter().map(|file| file.exists()).collect();
        assert_eq!(names, [true; 3]);
        let packed = fs::read(&summary.files[2]).unwrap();
        let bytes = compression.decompressed(&packed, 1 << 20).unwrap();
        assert_eq!(mcap::MessageStream::new(&bytes).unwrap().count(), 8);
        assert_eq!(metadata(&path).files[2].path, format!("{suffix}_2.mcap"));
    }
}
