//! Limits on the speed of CPUs, from `/sys`: a lower maximum frequency, cooling, and the firmware
//! of Raspberry Pi.
//!
//! The files are described in the kernel's documents on CPUFreq (`admin-guide/pm/cpufreq`) and on
//! the thermal framework (`driver-api/thermal/sysfs-api`). Every user may read them.

use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;

use ros2probe_model::facts::calls::late::CpuLimit;

/// Maximum number of limits that are reported at once.
pub const MAX_CPU_LIMITS: usize = 8;
/// Maximum number of entries that are read from a directory.
const MAX_ENTRIES: usize = 64;
/// Maximum number of bytes that are read from a file.
const MAX_FILE_BYTES: u64 = 64;

const FREQUENCY_PATH: &str = "devices/system/cpu/cpufreq";
const THERMAL_PATH: &str = "class/thermal";
const FIRMWARE_PATH: &str = "devices/platform/soc/soc:firmware/get_throttled";

/// Reads the limits that hold at present. `sys` is the mount point of sysfs.
#[must_use]
pub fn read(sys: &Path) -> Arc<[CpuLimit]> {
    let frequencies = entries(&sys.join(FREQUENCY_PATH), "policy");
    let frequencies = frequencies
        .into_iter()
        .filter_map(|policy| frequency(&policy));
    let cooling = entries(&sys.join(THERMAL_PATH), "cooling_device");
    let cooling = cooling.into_iter().filter_map(|device| cooled(&device));
    let all = frequencies
        .chain(cooling)
        .chain(firmware(&sys.join(FIRMWARE_PATH)));
    all.take(MAX_CPU_LIMITS).collect()
}

/// Returns the limit of a frequency policy, if it is below the maximum of its CPUs.
fn frequency(policy: &Path) -> Option<CpuLimit> {
    let cpus = text(&policy.join("related_cpus"))?;
    let allowed: u32 = number(&policy.join("scaling_max_freq"))?;
    let maximum: u32 = number(&policy.join("cpuinfo_max_freq"))?;
    (allowed < maximum).then(|| CpuLimit::Frequency {
        cpus: cpus.into(),
        allowed_mhz: allowed / 1000,
        maximum_mhz: maximum / 1000,
    })
}

/// Returns the state of a device that cools CPUs by slowing them down, if it does so.
fn cooled(device: &Path) -> Option<CpuLimit> {
    let name = text(&device.join("type"))?;
    // Fans are cooling devices too.
    let lower = name.to_ascii_lowercase();
    let slows_cpus = lower.contains("cpu") || lower == "processor";
    let state: u32 = number(&device.join("cur_state"))?;
    (slows_cpus && state > 0).then(|| CpuLimit::Cooling {
        device: name.into(),
        state,
        maximum: number(&device.join("max_state")).unwrap_or(state),
    })
}

/// Returns what the firmware of Raspberry Pi does. The lower bits hold at present, the upper ones
/// since the boot.
fn firmware(file: &Path) -> impl Iterator<Item = CpuLimit> + use<> {
    let bits = text(file).and_then(|text| {
        let digits = text.strip_prefix("0x").unwrap_or(&text);
        u32::from_str_radix(digits, 16).ok()
    });
    let bits = bits.unwrap_or_default();
    let all = [
        CpuLimit::UnderVoltage,
        CpuLimit::FrequencyCapped,
        CpuLimit::Throttled,
        CpuLimit::SoftTemperatureLimit,
    ];
    let numbered = all.into_iter().enumerate();
    numbered.filter_map(move |(bit, limit)| (bits >> bit & 1 != 0).then_some(limit))
}

/// Returns the paths in a directory whose names begin with `prefix`, sorted.
fn entries(directory: &Path, prefix: &str) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(directory) else {
        return Vec::new();
    };
    let named = entries.filter_map(Result::ok).filter(|entry| {
        let name = entry.file_name();
        name.to_str().is_some_and(|name| name.starts_with(prefix))
    });
    let mut paths: Vec<_> = named.take(MAX_ENTRIES).map(|entry| entry.path()).collect();
    paths.sort();
    paths
}

fn number<T: FromStr>(file: &Path) -> Option<T> {
    text(file)?.parse().ok()
}

fn text(file: &Path) -> Option<String> {
    let mut text = String::new();
    let file = File::open(file).ok()?;
    file.take(MAX_FILE_BYTES).read_to_string(&mut text).ok()?;
    Some(text.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Writes files below a directory that stands for `/sys`.
    fn sys(files: &[(&str, &str)]) -> tempfile::TempDir {
        let sys = tempfile::tempdir().unwrap();
        for (path, text) in files {
            let path = sys.path().join(path);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, format!("{text}\n")).unwrap();
        }
        sys
    }

    #[test]
    fn a_hot_raspberry_pi_with_a_weak_power_supply_has_four_limits() {
        let policy = "devices/system/cpu/cpufreq/policy0";
        let cooling = "class/thermal/cooling_device";
        let sys = sys(&[
            (&format!("{policy}/related_cpus"), "0 1 2 3"),
            (&format!("{policy}/scaling_max_freq"), "600000"),
            (&format!("{policy}/cpuinfo_max_freq"), "1500000"),
            (&format!("{cooling}0/type"), "cpufreq-cpu0"),
            (&format!("{cooling}0/cur_state"), "3"),
            (&format!("{cooling}0/max_state"), "9"),
            (&format!("{cooling}1/type"), "pwm-fan"),
            (&format!("{cooling}1/cur_state"), "4"),
            (&format!("{cooling}1/max_state"), "4"),
            (FIRMWARE_PATH, "50005"),
        ]);
        let expected = [
            "CPUs 0 1 2 3 run at 600 of 1500 MHz at most",
            "heat: cpufreq-cpu0 slows CPUs down (3 of 9)",
            "the power supply is too weak: the voltage is low",
            "the firmware slows the CPUs down",
        ];
        let words: Vec<_> = read(sys.path()).iter().map(CpuLimit::in_words).collect();
        assert_eq!(words, expected);
    }

    #[test]
    fn a_machine_at_full_speed_or_without_these_files_has_no_limit() {
        let policy = "devices/system/cpu/cpufreq/policy0";
        let full = sys(&[
            (&format!("{policy}/related_cpus"), "0"),
            (&format!("{policy}/scaling_max_freq"), "1500000"),
            (&format!("{policy}/cpuinfo_max_freq"), "1500000"),
            ("class/thermal/cooling_device0/type", "Processor"),
            ("class/thermal/cooling_device0/cur_state", "0"),
            (FIRMWARE_PATH, "0x50000"),
        ]);
        assert!(read(full.path()).is_empty());
        let malformed = sys(&[
            (&format!("{policy}/related_cpus"), "0"),
            (&format!("{policy}/scaling_max_freq"), "<unknown>"),
            (&format!("{policy}/cpuinfo_max_freq"), "1500000"),
            (FIRMWARE_PATH, "not a number"),
        ]);
        assert!(read(malformed.path()).is_empty());
        assert!(read(Path::new("/nonexistent")).is_empty());
    }

    #[test]
    fn limits_beyond_the_cap_are_left_out() {
        let mut files = Vec::new();
        for number in 0..100 {
            let policy = format!("devices/system/cpu/cpufreq/policy{number}");
            files.push((format!("{policy}/related_cpus"), number.to_string()));
            files.push((format!("{policy}/scaling_max_freq"), "1000000".to_owned()));
            files.push((format!("{policy}/cpuinfo_max_freq"), "2000000".to_owned()));
        }
        let files: Vec<_> = files
            .iter()
            .map(|(path, text)| (&**path, &**text))
            .collect();
        assert_eq!(read(sys(&files).path()).len(), MAX_CPU_LIMITS);
    }
}
