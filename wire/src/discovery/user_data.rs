//! ROS properties in DDS user data: `key=value;` pairs.

use core::fmt;

/// Maximum number of bytes of user data that are read.
const MAX_LEN: usize = 4096;

/// The pairs of one USER_DATA value, borrowed and in any order. NULs and other text are tolerated.
#[derive(Clone, Copy, Debug)]
pub struct UserData<'a>(&'a str);

impl<'a> UserData<'a> {
    /// Wraps the octets of USER_DATA. Octets that are not text have no pairs.
    #[must_use]
    pub fn new(octets: &'a [u8]) -> Self {
        // Fast DDS includes a NUL in the value, Cyclone DDS does not.
        let octets = octets.get(..MAX_LEN).unwrap_or(octets);
        let end = octets
            .iter()
            .rposition(|byte| *byte != 0)
            .map_or(0, |last| last + 1);
        Self(
            octets
                .get(..end)
                .and_then(|octets| str::from_utf8(octets).ok())
                .unwrap_or(""),
        )
    }

    /// Returns the rest of each key that begins with `prefix`.
    pub fn keys_after(self, prefix: &'a str) -> impl Iterator<Item = &'a str> {
        self.0
            .split(';')
            .filter_map(move |pair| pair.split_once('=')?.0.strip_prefix(prefix))
    }

    /// Returns the text after the first occurrence of `mark`.
    #[must_use]
    pub fn after(self, mark: &str) -> Option<&'a str> {
        self.0.split_once(mark).map(|(_, rest)| rest)
    }

    /// Returns the value of the first pair with this key.
    #[must_use]
    pub fn find(self, key: &str) -> Option<&'a str> {
        self.0.split(';').find_map(|pair| {
            let (name, value) = pair.split_once('=')?;
            (name.trim_matches(['\0', ' ']) == key).then_some(value)
        })
    }
}

/// Hash of a ROS type in version 1 of the scheme (`RIHS01_`), as Iron and later announce it.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TypeHash(pub [u8; 32]);

impl TypeHash {
    /// Parses `RIHS01_` and 64 hexadecimal digits; returns `None` for other versions.
    #[must_use]
    pub fn parse(text: &str) -> Option<Self> {
        hexadecimal(text.strip_prefix("RIHS01_")?).map(Self)
    }
}

/// Parses `N` bytes from exactly `2 * N` hexadecimal digits.
pub(super) fn hexadecimal<const N: usize>(text: &str) -> Option<[u8; N]> {
    let (pairs, []) = text.as_bytes().as_chunks::<2>() else {
        return None;
    };
    let pairs: &[[u8; 2]; N] = pairs.try_into().ok()?;
    let mut bytes = [0; N];
    for (byte, [high, low]) in bytes.iter_mut().zip(pairs) {
        *byte = value(*high)? << 4 | value(*low)?;
    }
    Some(bytes)
}

fn value(digit: u8) -> Option<u8> {
    match digit {
        b'0'..=b'9' => Some(digit - b'0'),
        b'a'..=b'f' => Some(digit - b'a' + 10),
        b'A'..=b'F' => Some(digit - b'A' + 10),
        _ => None,
    }
}

impl fmt::Display for TypeHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("RIHS01_")?;
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for TypeHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

#[cfg(test)]
mod tests {
    use std::string::ToString;

    use super::*;

    const HASH: &str = "RIHS01_91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e";

    #[test]
    fn pairs_are_found_in_any_order_with_or_without_a_nul() {
        assert_eq!(UserData::new(b"enclave=/;\0").find("enclave"), Some("/"));
        assert_eq!(
            UserData::new(b"enclave=/robot;").find("enclave"),
            Some("/robot")
        );
        assert_eq!(UserData::new(b"enclave=/a").find("enclave"), Some("/a"));
        let data = UserData::new(b"serviceid= 1.10.b4;typehash=x;");
        assert_eq!(
            (data.find("typehash"), data.find("enclave")),
            (Some("x"), None)
        );
        assert_eq!(UserData::new(b"\xff\xfe=1;").find("typehash"), None);
        assert_eq!(UserData::new(b"").find(""), None);
    }

    #[test]
    fn the_type_hash_of_an_endpoint_with_buffers_is_found() {
        for backends in ["BUFBE:cpu=", "bufbe.cpu=;"] {
            let text = std::format!("typehash={HASH};{backends}");
            assert_eq!(UserData::new(text.as_bytes()).find("typehash"), Some(HASH));
        }
    }

    #[test]
    fn a_type_hash_survives_a_round_trip_and_other_text_is_refused() {
        assert_eq!(TypeHash::parse(HASH).unwrap().to_string(), HASH);
        for bad in [
            "",
            "RIHS01_",
            "RIHS02_00",
            &HASH[..70],
            &HASH.replace('9', "g"),
        ] {
            assert_eq!(TypeHash::parse(bad), None, "{bad}");
        }
    }
}
