//! Texts of foreign messages.

/// Returns a text of at most `most` bytes. Bytes that are not UTF-8 become the replacement
/// character.
pub(super) fn truncated_text(bytes: &[u8], most: usize) -> Box<str> {
    let text = String::from_utf8_lossy(bytes.get(..most).unwrap_or(bytes));
    // A replacement character is longer than the byte that it replaces.
    let end = text.floor_char_boundary(most);
    text.get(..end).unwrap_or_default().into()
}
