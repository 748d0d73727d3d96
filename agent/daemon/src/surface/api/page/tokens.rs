//! Tokens of web pages. They are kept in memory and expire when the agent stops.

use std::collections::VecDeque;
use std::fmt::Write as _;
use std::io;
use std::sync::{Mutex, PoisonError};

use ros2probe_model::facts::bounded::Bounded;
use subtle::ConstantTimeEq as _;

use crate::tables::PageTokens;

/// Random bytes of a token, which is written in hexadecimal.
const TOKEN_BYTES: usize = 32;

/// The valid tokens, oldest first.
#[derive(Default)]
pub(in super::super) struct Tokens(Mutex<Bounded<PageTokens, VecDeque<Box<[u8]>>>>);

impl Tokens {
    /// Creates a token.
    ///
    /// # Errors
    /// Fails if the kernel returns no random bytes.
    pub(in super::super) fn create(&self) -> io::Result<String> {
        let mut bytes = [0; TOKEN_BYTES];
        let flags = rustix::rand::GetRandomFlags::empty();
        // A call returns up to 256 bytes without interruption (getrandom(2)).
        let given = rustix::rand::getrandom(&mut bytes, flags)?;
        if given != TOKEN_BYTES {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        let mut token = String::with_capacity(2 * TOKEN_BYTES);
        for byte in bytes {
            // Writing to a string cannot fail.
            let _ = write!(token, "{byte:02x}");
        }
        let mut tokens = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        tokens.push_back(token.as_bytes().into());
        Ok(token)
    }

    /// Returns whether the token is valid. The check takes the same time for all wrong tokens of
    /// the right length.
    pub(in super::super) fn is_valid(&self, offered: &[u8]) -> bool {
        let tokens = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        tokens.iter().fold(false, |known, token| {
            known | bool::from(token.ct_eq(offered))
        })
    }
}

impl std::fmt::Debug for Tokens {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Tokens")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_beyond_the_cap_replaces_the_oldest_token() {
        let tokens = Tokens::default();
        assert!(!tokens.is_valid(b""));
        let given: Vec<_> = (0..=PageTokens::CAP)
            .map(|_| tokens.create().unwrap())
            .collect();
        assert!(given.iter().all(|token| token.len() == 64));
        crate::tables::tests::assert_driven::<PageTokens>();
        assert!(!tokens.is_valid(given[0].as_bytes()), "the oldest has gone");
        assert!(
            given[1..]
                .iter()
                .all(|token| tokens.is_valid(token.as_bytes()))
        );
        assert!(!tokens.is_valid(&given[1].as_bytes()[1..]));
        assert!(!tokens.is_valid(b""));
    }
}
