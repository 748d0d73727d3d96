//! What the kernel programs of an agent are told about writers.

use anyhow::{Result, bail};
use aya::maps::{HashMap, Map, MapData, MapInfo};

/// Entries of the kernel's map of writers and readers that a process made.
pub(crate) fn interest(process: u32) -> Result<usize> {
    for entry in std::fs::read_dir(format!("/proc/{process}/fdinfo"))? {
        let text = std::fs::read_to_string(entry?.path()).unwrap_or_default();
        let id = text.lines().find_map(|line| line.strip_prefix("map_id:"));
        let Some(id) = id.and_then(|id| id.trim().parse().ok()) else {
            continue;
        };
        if MapInfo::from_id(id)?.name_as_str() == Some("INTEREST") {
            let map = Map::HashMap(MapData::from_id(id)?);
            let map: HashMap<_, [u32; 4], u32> = HashMap::try_from(map)?;
            return Ok(map.keys().flatten().count());
        }
    }
    bail!("the process {process} has no such map")
}
