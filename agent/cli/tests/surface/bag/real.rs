//! Real bags of Humble, and the output of `rp bag` for them.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Files that are not in the repository, and their sizes.
const SIZES: [(&str, u64); 8] = [
    ("bag_all/bag_all_0.mcap", 747_624),
    ("bag_default/bag_default_0.mcap", 9225237),
    ("bag_fastwrite/bag_fastwrite_0.mcap", 427_849),
    ("bag_split/bag_split_0.mcap", 158_126),
    ("bag_split/bag_split_1.mcap", 157_755),
    ("bag_split/bag_split_2.mcap", 158_126),
    ("bag_split/bag_split_3.mcap", 145_808),
    ("bag_sqlite3/bag_sqlite3_0.db3", 24_576),
];

fn real() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data/bags")
}

fn rp(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_rp"))
        .args(arguments)
        .env("TZ", "UTC")
        .env_remove("ROS_DISTRO")
        .output()
        .unwrap()
}

/// Copies all real bags, with files of zeros where only the size is relevant.
fn copies(into: &Path) -> Vec<PathBuf> {
    let mut bags = Vec::new();
    for entry in fs::read_dir(real()).unwrap() {
        let from = entry.unwrap().path();
        if !from.is_dir() {
            continue;
        }
        let to = into.join(from.file_name().unwrap());
        fs::create_dir(&to).unwrap();
        for file in fs::read_dir(&from).unwrap() {
            let file = file.unwrap().path();
            if file.file_name().unwrap() != "info.txt" {
                fs::copy(&file, to.join(file.file_name().unwrap())).unwrap();
            }
        }
        bags.push(to);
    }
    for (name, size) in SIZES {
        File::create(into.join(name))
            .unwrap()
            .set_len(size)
            .unwrap();
    }
    bags.sort();
    bags
}

#[test]
fn info_of_every_real_bag_equals_that_of_ros2_bag_info() {
    let directory = tempfile::tempdir().unwrap();
    let bags = copies(directory.path());
    assert_eq!(bags.len(), 7);
    for bag in bags {
        let name = bag.file_name().unwrap().to_str().unwrap();
        let output_text = fs::read_to_string(real().join(name).join("info.txt")).unwrap();
        let printed = rp(&["bag", "info", bag.to_str().unwrap(), "--distro", "humble"]);
        let printed = String::from_utf8(printed.stdout).unwrap();
        assert_eq!(printed.repeat(2), output_text, "{name}");
    }
}

#[test]
fn info_of_later_distributions_has_services_and_sorted_topics() {
    let bag = real().join("bag_zstd_fast");
    let bag = bag.to_str().unwrap();
    let printed = |arguments: &[&str]| {
        let output = rp(&[&["bag", "info", bag], arguments].concat());
        assert!(output.status.success());
        String::from_utf8(output.stdout).unwrap()
    };
    let jazzy = printed(&["--sort", "count"]);
    let expected =
        "\nStorage id:        mcap\nROS Distro:        unknown\nDuration:          5.752179901s\n";
    assert!(jazzy.contains(expected), "{jazzy}");
    let end = "Topic information: \
        Topic: /tf_static | Type: tf2_msgs/msg/TFMessage | Count: 1 | Serialization Format: cdr
                   Topic: /chatter | Type: std_msgs/msg/String | Count: 58 | Serialization Format: cdr
                   Topic: /robot1/imu/data | Type: sensor_msgs/msg/Imu | Count: 1152 | Serialization Format: cdr
Service:           0\nService information: \n";
    assert!(jazzy.ends_with(end), "{jazzy}");
    let kilted = printed(&["--distro", "kilted"]);
    let end = "\nServices:          0\nService information: \nActions:           0\nAction information: \n";
    assert!(kilted.ends_with(end), "{kilted}");
    assert_eq!(printed(&["-t"]), "/chatter\n/robot1/imu/data\n/tf_static\n");
    let verbose = printed(&["-v"]);
    // The topic has 1152 messages of 324 bytes.
    let imu = "Count: 1152 | Size Contribution: 364.5 KiB | Serialization Format: cdr\n";
    assert!(verbose.contains(imu), "{verbose}");
}

#[test]
fn info_of_a_single_file_is_printed() {
    for (file, messages) in [
        ("bag_zstd_fast/bag_zstd_fast_0.mcap", 1211),
        ("bag_filezstd/bag_filezstd_0.mcap.zstd", 1230),
    ] {
        let path = real().join(file);
        let printed = rp(&["bag", "info", path.to_str().unwrap()]);
        let printed = String::from_utf8(printed.stdout).unwrap();
        assert!(printed.starts_with(&format!("\nFiles:             {}\n", path.display())));
        assert!(
            printed.contains("\nROS Distro:        humble\n"),
            "{printed}"
        );
        assert!(
            printed.contains(&format!("\nMessages:          {messages}\n")),
            "{printed}"
        );
    }
}

#[test]
fn a_path_without_a_bag_is_refused_with_the_message_of_ros2_bag_info() {
    let directory = tempfile::tempdir().unwrap();
    let nothing = directory.path().join("nothing");
    let refused = |path: &Path, code: i32, text: &str| {
        let output = rp(&["bag", "info", path.to_str().unwrap()]);
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{stderr}");
        assert!(
            stderr.contains(&text.replace("{}", path.to_str().unwrap())),
            "{stderr}"
        );
    };
    refused(
        &nothing,
        2,
        "argument bag_path: Bag path '{}' does not exist!",
    );
    refused(
        directory.path(),
        1,
        "Could not find metadata in bag directory {}",
    );
    let text = directory.path().join("a.mcap");
    fs::write(&text, "not a bag").unwrap();
    refused(&text, 1, "No plugin detected that could open file {}");
    let sqlite3 = directory.path().join("a.db3");
    fs::write(&sqlite3, b"SQLite format 3\0 and so on").unwrap();
    refused(
        &sqlite3,
        1,
        "{} is in the sqlite3 storage, which rp does not read",
    );
    fs::write(
        directory.path().join("metadata.yaml"),
        "rosbag2_bagfile_information:\n",
    )
    .unwrap();
    refused(directory.path(), 1, "Exception on parsing info file: ");
}
