//! Server-sent events, read line by line (WHATWG HTML, 9.2.6).

/// One event.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Message {
    /// Type of the event.
    pub event: String,
    /// Data of the event.
    pub data: String,
}

/// Assembles lines into events. The client limits the length of a line, and an event has one line
/// of data here.
#[derive(Debug, Default)]
pub struct Messages {
    next: Message,
    /// Id of the last event, after which to resume the stream.
    pub last_id: Option<String>,
}

impl Messages {
    /// Adds a line without its end. Returns the event if this line completes it.
    pub fn line(&mut self, line: &[u8]) -> Option<Message> {
        let line = String::from_utf8_lossy(line);
        let line = line.trim_end_matches('\r');
        if line.is_empty() {
            let message = std::mem::take(&mut self.next);
            return (!message.data.is_empty()).then_some(message);
        }
        let (field, value) = line.split_once(':').unwrap_or((line, ""));
        let value = value.strip_prefix(' ').unwrap_or(value);
        match field {
            "event" => value.clone_into(&mut self.next.event),
            "data" => value.clone_into(&mut self.next.data),
            "id" if !value.is_empty() => self.last_id = Some(value.to_owned()),
            _ => {}
        }
        None
    }

    /// Discards an incomplete event after a break; the server sends it again.
    pub fn cut(&mut self) {
        self.next = Message::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_empty_line_ends_a_message_and_the_last_id_is_kept() {
        let mut messages = Messages::default();
        let stream = ": ros2probe\nretry: 2000\nid: 5-0\n\nevent: a.b\nid: 5-1\ndata: {\"x\": \"y: z\"}\n\n:\n\nevent: cut";
        let all: Vec<_> = stream
            .lines()
            .filter_map(|line| messages.line(line.as_bytes()))
            .collect();
        let expected = Message {
            event: "a.b".to_owned(),
            data: r#"{"x": "y: z"}"#.to_owned(),
        };
        assert_eq!(all, [expected]);
        assert_eq!(messages.last_id.as_deref(), Some("5-1"));
        messages.cut();
        assert_eq!(messages.line(b"data: 1"), None);
        assert_eq!(messages.line(b"").unwrap().event, "");
    }
}
