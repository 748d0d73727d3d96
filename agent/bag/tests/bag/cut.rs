//! Bags whose writer was stopped at any byte, completed by `reindex`.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use ros2probe_bag::info::Bag;
use ros2probe_bag::mcap::{self as records, Opcode};
use ros2probe_bag::read;
use ros2probe_bag::reindex::{Found, ReindexError, reindex};
use ros2probe_bag::{Compression, Form, Options, Storage, Writer};
use ros2probe_wire::{Expansion, Timestamp};

use super::{BEGIN, messages, metadata, text, topic};

/// Writes a bag with many small chunks, or without chunks, and returns its file.
fn written(directory: &Path, storage: Storage, form: Form) -> PathBuf {
    let path = directory.join("whole");
    let options = Options {
        storage,
        form,
        ros_distro: "jazzy".into(),
        ..Options::default()
    };
    let mut writer = Writer::create(&path, options).unwrap();
    let chatter = writer
        .topic(topic("/chatter", "std_msgs/msg/String"))
        .unwrap();
    let other = writer
        .topic(topic("/other", "std_msgs/msg/String"))
        .unwrap();
    for index in 0..60 {
        let topic = if index % 4 == 0 { other } else { chatter };
        writer
            .write(
                topic,
                Timestamp(BEGIN + index),
                Timestamp(BEGIN),
                index,
                &text(index),
            )
            .unwrap();
    }
    let summary = writer.close(BTreeMap::new()).unwrap();
    summary.files[0].clone()
}

/// Returns the offset of each message's end in a file without compression.
fn ends(file: &Path) -> Vec<u64> {
    let bytes = fs::read(file).unwrap();
    let mut ends = Vec::new();
    for index in 0..60 {
        let data = text(index);
        let at = bytes
            .windows(data.len())
            .position(|window| window == data)
            .unwrap();
        ends.push((at + data.len()) as u64);
    }
    ends
}

#[test]
fn a_file_truncated_anywhere_keeps_every_complete_message() {
    for (storage, form) in [
        (
            Storage {
                chunk_bytes: 900,
                ..Storage::default()
            },
            Form::Compatible,
        ),
        (Storage::preset("fastwrite").unwrap(), Form::Named),
    ] {
        let directory = tempfile::tempdir().unwrap();
        let whole = written(directory.path(), storage, form);
        let bytes = fs::read(&whole).unwrap();
        let ends = ends(&whole);
        let bag = directory.path().join("cut");
        let lengths = (0..bytes.len())
            .step_by(211)
            .skip(1)
            .chain([bytes.len() - 1, bytes.len() - 9]);
        for length in lengths {
            let _ = fs::remove_dir_all(&bag);
            fs::create_dir(&bag).unwrap();
            let file = bag.join("cut_0.mcap");
            fs::write(&file, &bytes[..length]).unwrap();
            let report = reindex(&bag, Expansion::Limited).unwrap();
            let expected: Vec<u32> = (0..60)
                .filter(|index| ends[*index as usize] <= length as u64)
                .collect();
            let found: Vec<u32> = messages(&file).iter().map(|message| message.1).collect();
            assert_eq!(found, expected, "{length}: {report:?}");
            // The index is complete as well.
            let again = fs::read(&file).unwrap();
            let summary = mcap::Summary::read(&again).unwrap().unwrap();
            assert_eq!(
                summary.stats.as_ref().unwrap().message_count,
                expected.len() as u64
            );
            let indexed: usize = summary
                .chunk_indexes
                .iter()
                .flat_map(|chunk| {
                    summary
                        .read_message_indexes(&again, chunk)
                        .unwrap()
                        .into_values()
                })
                .map(|entries| entries.len())
                .sum();
            assert_eq!(
                indexed,
                if storage.chunked { expected.len() } else { 0 },
                "{length}"
            );
            let yaml = metadata(&bag);
            assert_eq!(yaml.message_count, expected.len() as u64);
            assert_eq!(yaml.relative_file_paths, ["cut_0.mcap"]);
            // Nothing is lost: incomplete records are kept beside the file.
            if let Found::Unfinished {
                kept: Some(kept), ..
            } = &report.files[0].found
            {
                let kept = fs::read(bag.join(kept)).unwrap();
                assert!(bytes[..length].ends_with(&kept), "{length}");
            }
            // A second run changes nothing.
            let second = reindex(&bag, Expansion::Limited).unwrap();
            assert_eq!(second.files[0].found, Found::Complete, "{length}");
            assert_eq!(fs::read(&file).unwrap(), again);
        }
    }
}

#[test]
fn a_truncated_compressed_chunk_keeps_the_messages_that_can_be_decompressed() {
    for compression in [Compression::Zstd, Compression::Lz4] {
        let directory = tempfile::tempdir().unwrap();
        let storage = Storage {
            chunk_bytes: 1200,
            compression,
            chunk_crc: true,
            ..Storage::default()
        };
        let whole = written(directory.path(), storage, Form::Compatible);
        let bytes = fs::read(&whole).unwrap();
        let scan = read::scan(&whole, Expansion::Limited, &mut |_, _| {}).unwrap();
        assert_eq!(scan.chunks[2].compression, compression.name());
        let bag = directory.path().join("cut");
        fs::create_dir(&bag).unwrap();
        let file = bag.join("cut_0.mcap");
        // The cut is within the third chunk; the first two are complete.
        let third = &scan.chunks[2];
        fs::write(&file, &bytes[..(third.offset + third.length - 20) as usize]).unwrap();
        reindex(&bag, Expansion::Limited).unwrap();
        let mut found = Vec::new();
        let again = read::scan(&file, Expansion::Limited, &mut |message, _| {
            found.push(message.data.to_vec());
        })
        .unwrap();
        let whole = scan.contents.counts.values().sum::<u64>() as usize;
        assert!((20..whole).contains(&found.len()), "{}", found.len());
        for (index, data) in found.iter().enumerate() {
            assert_eq!(data, &text(index as u64));
        }
        assert!(again.is_ended && again.chunks.len() >= 2);
    }
}

#[test]
fn after_a_loss_of_power_a_file_is_truncated_at_its_zeros() {
    let directory = tempfile::tempdir().unwrap();
    let storage = Storage {
        chunk_bytes: 900,
        ..Storage::default()
    };
    let whole = written(directory.path(), storage, Form::Compatible);
    let scan = read::scan(&whole, Expansion::Limited, &mut |_, _| {}).unwrap();
    let bag = directory.path().join("cut");
    fs::create_dir(&bag).unwrap();
    let end = (scan.chunks[1].offset + scan.chunks[1].length) as usize;
    let mut bytes = fs::read(&whole).unwrap()[..end].to_vec();
    bytes.resize(end + 5000, 0);
    let file = bag.join("cut_0.mcap");
    fs::write(&file, &bytes).unwrap();
    let report = reindex(&bag, Expansion::Limited).unwrap();
    let Found::Unfinished {
        cut: 0,
        kept: None,
        salvaged: 0,
        ..
    } = report.files[0].found
    else {
        panic!("{report:?}");
    };
    assert_eq!(messages(&file).len() as u64, report.metadata.message_count);
    assert!(report.metadata.message_count > 10);
}

#[test]
fn missing_metadata_is_regenerated_from_all_files_in_order() {
    let directory = tempfile::tempdir().unwrap();
    for form in [Form::Compatible, Form::Humble, Form::Named] {
        let path = directory.path().join(format!("{form:?}"));
        let split = Some(std::time::Duration::from_millis(300));
        let options = Options {
            form,
            ros_distro: "rolling".into(),
            max_file_duration: split,
            ..Options::default()
        };
        super::bag(&path, options, 50);
        let before = metadata(&path);
        assert!(before.files.len() > 10);
        fs::remove_file(path.join("metadata.yaml")).unwrap();
        let report = reindex(&path, Expansion::Limited).unwrap();
        assert!(
            report
                .files
                .iter()
                .all(|file| file.found == Found::Complete)
        );
        let mut after = metadata(&path);
        // Unlike metadata.yaml, Humble's files do not name the distribution.
        after.ros_distro.clone_from(&before.ros_distro);
        assert_eq!(after, before, "{form:?}");
    }
}

#[test]
fn a_file_that_is_not_mcap_stays_unchanged_and_is_reported() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("bag");
    super::bag(&path, Options::default(), 5);
    fs::write(path.join("bag_1.mcap"), "").unwrap();
    fs::write(path.join("bag_2.mcap"), "something else").unwrap();
    let report = reindex(&path, Expansion::Limited).unwrap();
    assert_eq!(report.files[1].found, Found::NotMcap);
    assert_eq!(report.metadata.relative_file_paths, ["bag_0.mcap"]);
    assert_eq!(
        fs::read(path.join("bag_2.mcap")).unwrap(),
        b"something else"
    );
    let empty = directory.path().join("empty");
    fs::create_dir(&empty).unwrap();
    assert!(matches!(
        reindex(&empty, Expansion::Limited),
        Err(ReindexError::NoFiles(_))
    ));
    fs::write(empty.join("a_0.db3"), "").unwrap();
    assert!(matches!(
        reindex(&empty, Expansion::Limited),
        Err(ReindexError::Sqlite3(_))
    ));
}

#[test]
fn interrupted_compression_of_files_is_completed() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("bag");
    let options = Options {
        file_compression: Compression::Zstd,
        max_file_duration: Some(std::time::Duration::from_secs(1)),
        ..Options::default()
    };
    let mut writer = Writer::create(&path, options).unwrap();
    let chatter = writer
        .topic(topic("/chatter", "std_msgs/msg/String"))
        .unwrap();
    for index in 0..30 {
        let time = Timestamp(BEGIN + index * super::SECOND / 10);
        writer
            .write(chatter, time, time, index, &text(index))
            .unwrap();
    }
    writer.flush().unwrap();
    let done = writer.take_file_compressions().remove(0).run().unwrap();
    writer.compressed(&done).unwrap();
    std::mem::forget(writer);
    let report = reindex(&path, Expansion::Limited).unwrap();
    let names = ["bag_0.mcap.zstd", "bag_1.mcap.zstd", "bag_2.mcap.zstd"];
    assert_eq!(report.metadata.relative_file_paths, names);
    assert_eq!(report.metadata.message_count, 30);
    assert!(names.iter().all(|name| path.join(name).exists()));
    assert!(!path.join("bag_1.mcap").exists());
    assert_eq!(metadata(&path).compression_mode, "FILE");
}

/// Returns a file of `chunks` chunks, each of which expands to `chunk_bytes` zeros.
fn expanding(chunk_bytes: usize, chunks: usize, compression: Compression) -> Vec<u8> {
    let inside = compression.compressed(&vec![0; chunk_bytes]).unwrap();
    let mut file = records::MAGIC.to_vec();
    records::header(&mut file, "ros2", "none");
    for _ in 0..chunks {
        records::record(&mut file, Opcode::CHUNK, |out| {
            out.extend([0; 16]);
            out.extend((chunk_bytes as u64).to_le_bytes());
            out.extend([0; 4]);
            out.extend(
                u32::try_from(compression.name().len())
                    .unwrap()
                    .to_le_bytes(),
            );
            out.extend(compression.name().as_bytes());
            out.extend((inside.len() as u64).to_le_bytes());
            out.extend(&inside);
        });
    }
    file
}

#[test]
fn a_small_file_is_refused_before_it_expands_to_gigabytes() {
    let directory = tempfile::tempdir().unwrap();
    let refused = |name: &str, factor: u32, file: &[u8]| {
        let path = directory.path().join(name);
        fs::write(&path, file).unwrap();
        let error = read::scan(&path, Expansion::Limited, &mut |_, _| {}).unwrap_err();
        let cause = std::error::Error::source(&error).unwrap().to_string();
        let expected = format!(
            "it expands to more than {factor} times its size; if you trust it, pass \
            --no-expansion-limit"
        );
        assert_eq!(cause, expected, "{name}");
        assert!(Bag::open(&path, Expansion::Limited).is_err(), "{name}");
        path
    };
    let (one, many) = (
        expanding(200 << 20, 1, Compression::Zstd),
        expanding(16 << 20, 40, Compression::Zstd),
    );
    assert!(
        one.len() < 64 << 10 && many.len() < 64 << 10,
        "{} {}",
        one.len(),
        many.len()
    );
    refused("one_0.mcap", 16, &one);
    let path = refused("many_0.mcap", 1024, &many);
    assert!(reindex(directory.path(), Expansion::Limited).is_err());
    assert_eq!(fs::read(path).unwrap(), many, "left as it was");
    // A compressed file with one record.
    let mut whole = records::MAGIC.to_vec();
    records::record(&mut whole, Opcode::METADATA, |out| {
        out.resize(out.len() + (200 << 20), 0);
    });
    let whole = Compression::Zstd.compressed(&whole).unwrap();
    let path = refused("whole_0.mcap.zstd", 16, &whole);
    // The user can lift the limit.
    let scan = read::scan(&path, Expansion::Unlimited, &mut |_, _| {}).unwrap();
    assert_eq!(scan.metadata_places.len(), 1);
    // Content that expands like recordings of a still image is readable.
    let path = directory.path().join("still_0.mcap");
    fs::write(&path, expanding(4 << 20, 8, Compression::Lz4)).unwrap();
    let scan = read::scan(&path, Expansion::Limited, &mut |_, _| {}).unwrap();
    assert_eq!((scan.chunks.len(), scan.unreadable_chunks), (8, 8));
}

#[test]
fn files_with_a_number_first_and_a_time_last_are_in_the_order_of_their_numbers() {
    let directory = tempfile::tempdir().unwrap();
    let file = written(directory.path(), Storage::default(), Form::Compatible);
    let bag = directory.path().join("bag_7");
    fs::create_dir(&bag).unwrap();
    let names = [
        "2_bag_7_2026_05_22-10_12_03.mcap",
        "9_bag_7_2026_05_22-10_12_59.mcap",
        "10_bag_7_2026_05_22-10_13_00.mcap",
    ];
    for name in names {
        fs::copy(&file, bag.join(name)).unwrap();
    }
    let report = reindex(&bag, Expansion::Limited).unwrap();
    let found: Vec<_> = report.files.iter().map(|file| &*file.name).collect();
    assert_eq!(found, names);
}
