//! Reads the messages of a bag in rosbag2's sqlite3 storage: a table of topics, and one of
//! messages.
//!
//! The file format is that of <https://www.sqlite.org/fileformat.html>: trees of pages. Only the
//! trees of tables are read, not the indexes, the write-ahead log and the free list. Page numbers
//! and lengths are not trusted: the number of pages read is bounded, and so is the length of a row.

mod page;
mod row;

use std::collections::HashMap;
use std::io;
use std::ops::ControlFlow;
use std::path::Path;

use super::messages::Message;
use super::open_file;
use page::Pages;
use row::Value;

/// Number of bytes of a row that hold all but the end of a large message, or QoS.
pub(super) const PREFIX: usize = 1024;
/// Maximum length of the name of a topic or type, in bytes.
const MAX_NAME: usize = 256;

/// Reads the messages until `each` breaks, up to `longest` bytes of a row. Returns the number of
/// damaged pages and rows.
pub(super) fn read(
    path: &Path,
    longest: usize,
    each: &mut dyn FnMut(&Message<'_>) -> ControlFlow<()>,
) -> io::Result<u64> {
    let mut pages = Pages::open(open_file(path)?)?;
    let mut tables: HashMap<String, Table> = HashMap::new();
    pages.visit(1, PREFIX, &mut |_, row| {
        let text = |place| row.value(place).and_then(Value::text);
        if let (Some("table"), Some(name), Some(root), Some(sql)) = (
            text(0),
            text(1),
            row.value(3).and_then(Value::integer),
            text(4),
        ) && let Ok(root) = u32::try_from(root)
            && matches!(name, "topics" | "messages")
        {
            let columns = columns(sql);
            tables.insert(name.to_owned(), Table { root, columns });
        }
        ControlFlow::Continue(())
    })?;
    let (Some(topics), Some(messages)) = (tables.get("topics"), tables.get("messages")) else {
        return Err(not_a_bag());
    };
    let mut named: HashMap<i64, (String, String)> = HashMap::new();
    let places = [
        topics.place(&["id"])?,
        topics.place(&["name"])?,
        topics.place(&["type"])?,
    ];
    pages.visit(topics.root, PREFIX, &mut |id, row| {
        let [of_id, name, type_name] = places.map(|place| row.value(place));
        // An integer primary key is the row's number; its column then holds NULL.
        let id = of_id.and_then(Value::integer).unwrap_or(id);
        let texts = name
            .and_then(Value::text)
            .zip(type_name.and_then(Value::text));
        if let Some((name, type_name)) = texts
            && name.len().max(type_name.len()) <= MAX_NAME
        {
            named.insert(id, (name.to_owned(), type_name.to_owned()));
        }
        ControlFlow::Continue(())
    })?;
    let topic_id = messages.place(&["topic_id"])?;
    let received = messages.place(&["timestamp", "recv_timestamp"])?;
    let sent = messages.place(&["send_timestamp"]).ok();
    let data = messages.place(&["data"])?;
    pages.visit(messages.root, longest, &mut |_, row| {
        let integer = |place| row.value(place).and_then(Value::integer);
        let topic = integer(topic_id).and_then(|id| named.get(&id));
        let received = integer(received).and_then(|time| u64::try_from(time).ok());
        if let (Some((topic, type_name)), Some(log_time), Some(Value::Blob(begin))) =
            (topic, received, row.value(data))
        {
            return each(&Message {
                topic,
                type_name,
                definition: "",
                log_time,
                publish_time: sent
                    .and_then(integer)
                    .and_then(|time| u64::try_from(time).ok()),
                begin,
            });
        }
        ControlFlow::Continue(())
    })?;
    Ok(pages.damaged())
}

/// A table of the bag.
struct Table {
    root: u32,
    columns: Vec<String>,
}

impl Table {
    /// Returns the position of the first of these columns.
    fn place(&self, names: &[&str]) -> io::Result<usize> {
        let mut columns = self.columns.iter();
        let place = columns.position(|column| names.contains(&column.as_str()));
        place.ok_or_else(not_a_bag)
    }
}

fn not_a_bag() -> io::Error {
    let reason = "it lacks the tables of a bag";
    io::Error::new(io::ErrorKind::InvalidData, reason)
}

/// Returns the names of the columns of `CREATE TABLE name(first TYPE, second TYPE, ...)`.
fn columns(sql: &str) -> Vec<String> {
    let Some((_, list)) = sql.split_once('(') else {
        return Vec::new();
    };
    let name = |column: &str| {
        let name = column.split_whitespace().next().unwrap_or_default();
        name.trim_matches(['"', '`', '[', ']']).to_owned()
    };
    list.split(',').map(name).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_in_the_order_of_the_statement() {
        let sql = "CREATE TABLE messages(id INTEGER PRIMARY KEY,topic_id INTEGER NOT NULL, \
                   timestamp INTEGER NOT NULL, data BLOB NOT NULL)";
        assert_eq!(columns(sql), ["id", "topic_id", "timestamp", "data"]);
        assert_eq!(columns("CREATE VIRTUAL TABLE x"), Vec::<String>::new());
    }
}
