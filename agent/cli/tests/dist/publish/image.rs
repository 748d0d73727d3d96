//! The OCI image: its content, and podman starts it whatever a container grants.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::repository as sources;
use serde_json::Value;

use super::podman::{Options, Podman};
use super::{VERSION, image, measures_on_arm, on_arm, package, packaging, succeed};

/// Maximum size of the image of one architecture, as registries transfer it.
const MAX_BYTES: u64 = 30_000_000;
const PROGRAM: &str = "usr/bin/rp";
const USER: u32 = 65532;

/// Returns the capabilities of both sources, without their prefix: those of the unit, and that for
/// packet sockets.
fn capabilities() -> Result<Vec<String>> {
    let unit = fs::read_to_string(sources("systemd/ros2probe.service"))?;
    let set = unit
        .lines()
        .find_map(|line| line.strip_prefix("CapabilityBoundingSet="))
        .context("the unit bounds nothing")?;
    Ok(set
        .split(' ')
        .chain(["CAP_NET_RAW"])
        .map(|name| name.trim_start_matches("CAP_").to_owned())
        .collect())
}

/// An unpacked image layout.
struct Layout {
    directory: tempfile::TempDir,
}

impl Layout {
    fn open() -> Result<Self> {
        let directory = tempfile::tempdir()?;
        let mut tar = Command::new("tar");
        tar.arg("-x").arg("-f").arg(image()?);
        succeed(tar.arg("-C").arg(directory.path()))?;
        Ok(Self { directory })
    }

    /// Returns the path of the blob that a descriptor names.
    fn blob(&self, descriptor: &Value) -> Result<PathBuf> {
        let digest = descriptor["digest"].as_str().context("no digest")?;
        let name = digest.strip_prefix("sha256:").context("not SHA-256")?;
        let path = self.directory.path().join("blobs/sha256").join(name);
        let sum = succeed(Command::new("sha256sum").arg(&path))?;
        ensure!(sum.starts_with(name), "{sum} is not {name}");
        ensure!(
            Some(fs::metadata(&path)?.len()) == descriptor["size"].as_u64(),
            "{descriptor}"
        );
        Ok(path)
    }

    fn json(&self, descriptor: &Value) -> Result<Value> {
        Ok(serde_json::from_slice(&fs::read(self.blob(descriptor)?)?)?)
    }

    /// Returns the manifest of each architecture.
    fn manifests(&self) -> Result<BTreeMap<String, Value>> {
        let index = fs::read(self.directory.path().join("index.json"))?;
        let index: Value = serde_json::from_slice(&index)?;
        let images = self.json(&index["manifests"][0])?;
        let images = images["manifests"].as_array().context("no index")?;
        let mut found = BTreeMap::new();
        for descriptor in images {
            let architecture = descriptor["platform"]["architecture"].as_str();
            let architecture = architecture.context("no architecture")?.to_owned();
            found.insert(architecture, self.json(descriptor)?);
        }
        Ok(found)
    }
}

#[test]
#[ignore = "looks at a release: make release"]
fn the_image_has_the_files_of_the_package_for_both_architectures() -> Result<()> {
    let layout = Layout::open()?;
    let manifests = layout.manifests()?;
    let architectures: Vec<&String> = manifests.keys().collect();
    ensure!(architectures == ["amd64", "arm64"], "{architectures:?}");
    for (architecture, manifest) in &manifests {
        let layers = manifest["layers"].as_array().context("no layers")?;
        let bytes: u64 = layers
            .iter()
            .filter_map(|layer| layer["size"].as_u64())
            .sum();
        ensure!(bytes < MAX_BYTES, "{architecture}: {bytes} bytes");
        let config = layout.json(&manifest["config"])?;
        ensure!(config["architecture"] == **architecture, "{config}");
        ensure!(
            config["config"]["User"] == format!("{USER}:{USER}"),
            "{config}"
        );
        ensure!(
            config["config"]["Entrypoint"][0] == "/usr/bin/rp",
            "{config}"
        );
        let labels = &manifest["annotations"];
        ensure!(
            labels["org.opencontainers.image.version"] == VERSION,
            "{labels}"
        );

        let root = tempfile::tempdir()?;
        let mut tar = Command::new("tar");
        tar.args([
            "--extract",
            "--gzip",
            "--numeric-owner",
            "--same-owner",
            "--xattrs",
        ]);
        tar.arg("--xattrs-include=*")
            .arg("--file")
            .arg(layout.blob(&layers[0])?);
        succeed(tar.arg("--directory").arg(root.path()))?;
        contains_the_package(root.path(), architecture)?;
    }
    Ok(())
}

fn contains_the_package(root: &Path, architecture: &str) -> Result<()> {
    let unpacked = tempfile::tempdir()?;
    let mut dpkg = Command::new("dpkg-deb");
    dpkg.arg("--extract").arg(package(architecture)?);
    succeed(dpkg.arg(unpacked.path()))?;
    let mut find = Command::new("find");
    find.arg(root).args(["-type", "f", "-printf", "%P\\n"]);
    let found = succeed(&mut find)?;
    let mut found: Vec<&str> = found.lines().collect();
    found.sort_unstable();
    let expected = [
        "etc/ros2probe/ros2probe.yaml",
        PROGRAM,
        "usr/share/doc/ros2probe/copyright",
        "usr/share/doc/ros2probe/libraries.gz",
    ];
    ensure!(found == expected, "{found:?}");
    for path in expected {
        let same = fs::read(root.join(path))? == fs::read(unpacked.path().join(path))?;
        ensure!(same, "{architecture}: {path} is not the package's");
    }
    for path in ["var/lib/ros2probe", "run/ros2probe"] {
        let metadata = fs::metadata(root.join(path))?;
        let found = (metadata.uid(), metadata.gid(), metadata.mode() & 0o777);
        ensure!(found == (USER, USER, 0o770), "{path}: {found:?}");
    }
    let granted = succeed(Command::new("getcap").arg(root.join(PROGRAM)))?;
    let (_, granted) = granted.trim().rsplit_once(' ').context("no capability")?;
    let (names, kind) = granted.split_once('=').context("not permitted")?;
    let mut names: Vec<String> = names
        .split(',')
        .map(|name| name.trim_start_matches("cap_").to_uppercase())
        .collect();
    let mut expected = capabilities()?;
    names.sort();
    expected.sort();
    // Effective ones would keep a container without one of them from starting.
    ensure!(names == expected && kind == "p", "{granted}");
    if architecture == "arm64" {
        let version = on_arm(&root.join(PROGRAM), &["--version"])?;
        ensure!(
            version.stdout == format!("rp {VERSION}\n").as_bytes(),
            "{version:?}"
        );
        measures_on_arm(&root.join(PROGRAM))?;
    }
    Ok(())
}

#[test]
#[ignore = "looks at a release: make release"]
fn the_same_packages_make_the_same_image() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let again = directory.path().join("image.tar");
    let commit = succeed(
        Command::new("git")
            .args(["rev-parse", "HEAD"])
            .current_dir(sources("")),
    )?;
    let mut script = packaging("image.py")?;
    script.arg(&again).arg(commit.trim());
    // The order of the packages does not matter.
    succeed(script.args([package("arm64")?, package("amd64")?]))?;
    ensure!(fs::read(again)? == fs::read(image()?)?, "the images differ");
    Ok(())
}

#[test]
#[ignore = "looks at a release: make release"]
fn skopeo_reads_both_architectures() -> Result<()> {
    for architecture in ["amd64", "arm64"] {
        let mut skopeo = Command::new("skopeo");
        skopeo.args([
            "inspect",
            "--override-os",
            "linux",
            "--override-arch",
            architecture,
        ]);
        let printed = succeed(skopeo.arg(format!("oci-archive:{}", image()?.display())))?;
        let image: Value = serde_json::from_str(&printed)?;
        ensure!(image["Architecture"] == architecture, "{image}");
        ensure!(image["Labels"]["org.opencontainers.image.title"] == "ros2probe");
    }
    Ok(())
}

#[test]
#[ignore = "looks at a release: make release"]
fn podman_starts_the_image_with_any_of_its_capabilities() -> Result<()> {
    let podman = Podman::load(&[])?;
    let granted = capabilities()?;
    // The file permits capabilities, and requires none: the kernel starts it also with fewer.
    for missing in granted.iter().map(Some).chain([None]) {
        let added = granted
            .iter()
            .filter(|&one| missing.is_some_and(|missing| one != missing));
        for user in ["65532", "0"] {
            let mut options = Options(vec!["--rm".to_owned()])
                .with("--network", "none")
                .with("--cap-drop", "ALL")
                .with("--user", user);
            for capability in added.clone() {
                options = options.with("--cap-add", capability);
            }
            let mut run = podman.start(&options, &["--version"])?;
            run.wait_for(&format!("rp {VERSION}"), Duration::from_secs(30))
                .with_context(|| format!("{options:?}"))?;
        }
    }
    Ok(())
}
