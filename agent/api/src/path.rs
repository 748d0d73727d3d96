//! Percent encoding of names in paths and queries.

/// Returns the name percent-encoded for a path or a query value. Slashes are not encoded.
#[must_use]
pub fn encoded(name: &str) -> String {
    let mut path = String::with_capacity(name.len());
    for byte in name.bytes() {
        if byte.is_ascii_alphanumeric() || b"/_-.~".contains(&byte) {
            path.push(char::from(byte));
        } else {
            path.push_str(&format!("%{byte:02X}"));
        }
    }
    path
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_keeps_its_slashes_and_reserved_bytes_are_encoded() {
        assert_eq!(encoded("/robot1/imu_data"), "/robot1/imu_data");
        assert_eq!(encoded("/a?b#c d%é"), "/a%3Fb%23c%20d%25%C3%A9");
    }
}
