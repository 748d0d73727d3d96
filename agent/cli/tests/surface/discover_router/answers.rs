//! Batches of a router, without their lengths.

/// Returns an INIT acknowledgement with a cookie, a version, and extensions without a value.
pub fn init(cookie: &[u8], version: u8, extensions: &[u8]) -> Vec<u8> {
    let more = if extensions.is_empty() { 0 } else { 0x80 };
    let mut batch = vec![0x61 | more, version, 0x10, 0xa1, 0xb2, 0x0a, 0x00, 0xc0];
    batch.extend(number(cookie.len()));
    batch.extend(cookie);
    batch.extend(extensions);
    batch
}

/// Returns an OPEN acknowledgement.
pub fn open() -> Vec<u8> {
    vec![0x62, 60, 0]
}

/// Returns a reliable FRAME with messages.
pub fn frame(messages: &[u8]) -> Vec<u8> {
    [&[0x25, 0], messages].concat()
}

/// Returns the declaration of a token whose key is not shortened.
pub fn token(key: &str) -> Vec<u8> {
    declare(&[0x26, 0, 0], key)
}

/// Returns the declaration of a token whose key begins with an alias of the router.
pub fn aliased(scope: u8, suffix: &str) -> Vec<u8> {
    declare(&[0x66, 0, scope], suffix)
}

/// Returns the declaration of an alias whose key begins with another alias, or with none (0).
pub fn alias(id: u8, scope: u8, suffix: &str) -> Vec<u8> {
    declare(&[0x60, id, scope], suffix)
}

/// Returns the message that ends the answer.
pub fn final_() -> Vec<u8> {
    vec![0x3e, 1, 0x1a]
}

/// Returns the FRAGMENTs of a message, with the priority of declarations.
pub fn fragments(message: &[u8], length: usize, is_marked: bool) -> Vec<Vec<u8>> {
    let count = message.len().div_ceil(length);
    let part = |(index, part): (usize, &[u8])| {
        let more = if index + 1 < count { 0x40 } else { 0 };
        let head = [0xa6 | more, u8::try_from(index).unwrap()];
        let extensions: &[u8] = match (is_marked, index) {
            (true, 0) => &[0xb1, 0, 0x02],
            _ => &[0x31, 0],
        };
        [&head, extensions, part].concat()
    };
    message.chunks(length).enumerate().map(part).collect()
}

fn declare(head: &[u8], suffix: &str) -> Vec<u8> {
    let length = number(suffix.len());
    [&[0x3e, 1], head, &length, suffix.as_bytes()].concat()
}

fn number(mut value: usize) -> Vec<u8> {
    let mut bytes = Vec::new();
    while value > 0x7f {
        bytes.push(u8::try_from(value & 0x7f).unwrap() | 0x80);
        value >>= 7;
    }
    bytes.push(u8::try_from(value).unwrap());
    bytes
}
