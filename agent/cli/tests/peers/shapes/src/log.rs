//! The event log: one JSON object per line, written immediately, so that a killed process leaves a
//! complete log.

use std::fs::File;
use std::io::Write as _;
use std::time::{SystemTime, UNIX_EPOCH};

use serde_json::{Value, json};

use crate::Result;

pub struct Log(Option<File>);

impl Log {
    pub fn create(path: Option<&str>) -> Result<Log> {
        Ok(Log(path.map(File::create).transpose()?))
    }

    /// Writes an event with its fields, which are an object.
    pub fn write(&mut self, name: &str, fields: Value) -> Result<()> {
        let Some(file) = &mut self.0 else {
            return Ok(());
        };
        let now = SystemTime::now().duration_since(UNIX_EPOCH)?.as_nanos() as u64;
        let mut event = json!({"t": now, "ev": name});
        if let (Some(event), Value::Object(mut fields)) = (event.as_object_mut(), fields) {
            event.append(&mut fields);
        }
        file.write_all(format!("{event}\n").as_bytes())?;
        Ok(())
    }
}
