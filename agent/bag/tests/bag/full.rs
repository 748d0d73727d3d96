//! Full file systems, and paths that cannot be written.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use ros2probe_bag::{Error, Options, Writer};
use ros2probe_wire::Timestamp;

use super::{BEGIN, cloud, messages, metadata, topic};

const PLACE: &str = "ROS2PROBE_TEST_SMALL_DISK";

#[test]
fn a_full_disk_leaves_a_complete_bag() {
    let directory = tempfile::tempdir().unwrap();
    let output = Command::new("unshare")
        .args(["--map-root-user", "--mount", "sh", "-c"])
        .arg("mount -t tmpfs -o size=5m none \"$1\" && exec \"$0\" --exact full::a_bag_on_a_small_disk_ends_with_disk_full --ignored")
        .arg(std::env::current_exe().unwrap())
        .arg(directory.path())
        .env(PLACE, directory.path())
        .output()
        .unwrap();
    let printed = String::from_utf8_lossy(&output.stdout);
    assert!(
        output.status.success() && printed.contains("1 passed"),
        "{output:?}"
    );
}

#[test]
#[ignore = "started by another test, on a small disk"]
fn a_bag_on_a_small_disk_ends_with_disk_full() {
    let path = PathBuf::from(std::env::var_os(PLACE).unwrap()).join("bag");
    let mut writer = Writer::create(&path, Options::default()).unwrap();
    let points = writer
        .topic(topic("/points", "sensor_msgs/msg/PointCloud2"))
        .unwrap();
    let mut taken = 0;
    let error = loop {
        let time = Timestamp(BEGIN + taken);
        match writer.write(points, time, time, taken, &cloud(taken)) {
            Ok(()) => taken += 1,
            Err(error) => break error,
        }
        assert!(taken < 100, "the disk is not small");
        if taken % 10 == 0 {
            writer.flush().unwrap();
        }
    };
    assert!(matches!(error, Error::DiskFull { .. }), "{error:?}");
    assert!(taken > 30, "{taken}");
    // The final report also fits.
    let report = BTreeMap::from([("ros2probe.report".to_owned(), "x".repeat(20_000))]);
    let summary = writer.close(report).unwrap();
    let found = messages(&summary.files[0]);
    assert_eq!(found.len() as u64, summary.messages);
    assert_eq!(summary.messages + summary.topics[0].unwritten, taken);
    assert!(summary.topics[0].unwritten > 0);
    let bytes = fs::read(&summary.files[0]).unwrap();
    let read = mcap::Summary::read(&bytes).unwrap().unwrap();
    assert_eq!(read.stats.unwrap().message_count, summary.messages);
    let yaml = metadata(&path);
    assert_eq!(yaml.message_count, summary.messages);
    assert_eq!(yaml.custom_data["ros2probe.report"].len(), 20_000);
    // No space stays reserved.
    let again = path.with_file_name("again");
    fs::write(&again, vec![0; 100_000]).unwrap();
    // A bag that cannot be started leaves nothing behind.
    let rest = fs::write(path.with_file_name("rest"), vec![0; 6 << 20]);
    assert!(rest.is_err());
    let third = path.with_file_name("third");
    let error = Writer::create(&third, Options::default()).unwrap_err();
    assert!(matches!(error, Error::DiskFull { .. }), "{error:?}");
    assert!(!third.exists());
}

#[test]
fn an_unwritable_path_is_named_in_the_error() {
    let error = Writer::create(Path::new("/proc/bag"), Options::default()).unwrap_err();
    assert!(matches!(error, Error::Create { .. }), "{error:?}");
    assert_eq!(error.to_string(), "cannot create /proc/bag");
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("file");
    fs::write(&file, "").unwrap();
    assert!(matches!(
        Writer::create(&file, Options::default()),
        Err(Error::Exists(_))
    ));
    let below = file.join("bag");
    assert!(matches!(
        Writer::create(&below, Options::default()),
        Err(Error::Create { .. })
    ));
}
