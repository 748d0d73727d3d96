//! Which connections declare which tokens.
//!
//! A router forwards the tokens of all sessions to each session, so there are far more pairs than
//! tokens or connections. Tokens and connections are therefore numbers in the pairs.

use std::collections::BTreeSet;
use std::ops::Bound;

use super::stream_state::DirectionNumber;
use crate::facts::bounded::TableFacts;
use crate::facts::bounded::{Bounded, ByOwner};
use crate::facts::tables::{ZenohDeclared, ZenohTokenIds};

/// Number of a token, never reused.
pub(super) type TokenNumber = u64;

/// Bytes of a pair in the second index.
const INDEX_BYTES_PER_TOKEN: usize = 2 * size_of::<(TokenNumber, DirectionNumber)>();

/// The pairs of directions and tokens.
#[derive(Debug, Default)]
pub(super) struct Declared {
    tokens: ByOwner<ZenohDeclared, DirectionNumber, TokenNumber, ()>,
    /// The same pairs by token.
    directions: Bounded<ZenohDeclared, BTreeSet<(TokenNumber, DirectionNumber)>>,
    /// Tokens by the number that the direction gave them; between routers all are 0.
    ids: ByOwner<ZenohTokenIds, DirectionNumber, u32, TokenNumber>,
}

impl Declared {
    /// Records that a direction declares a token with this number.
    pub(super) fn insert(&mut self, direction: DirectionNumber, id: u32, token: TokenNumber) {
        if id != 0 {
            self.ids.insert(direction, id, token, 0);
        }
        if !self.directions.contains(&(token, direction))
            && self
                .tokens
                .insert(direction, token, (), INDEX_BYTES_PER_TOKEN)
        {
            self.directions.insert((token, direction));
        }
    }

    /// Removes the number of a token and returns the token.
    pub(super) fn take_id(&mut self, direction: DirectionNumber, id: u32) -> Option<TokenNumber> {
        self.ids.remove(direction, &id)
    }

    /// Records that a direction no longer declares a token.
    pub(super) fn remove(&mut self, direction: DirectionNumber, token: TokenNumber) {
        self.tokens.remove(direction, &token);
        self.directions.remove(&(token, direction));
    }

    /// Forgets a direction, and returns its tokens.
    pub(super) fn remove_direction(&mut self, direction: DirectionNumber) -> Vec<TokenNumber> {
        drop(self.ids.remove_owner(direction));
        let tokens: Vec<_> = self.tokens.remove_owner(direction).collect();
        for token in &tokens {
            self.directions.remove(&(*token, direction));
        }
        tokens
    }

    /// Forgets a token.
    pub(super) fn forget(&mut self, token: TokenNumber) {
        let directions: Vec<_> = self.of(token).collect();
        for direction in directions {
            self.remove(direction, token);
        }
    }

    /// Returns the directions that declare a token.
    pub(super) fn of(&self, token: TokenNumber) -> impl Iterator<Item = DirectionNumber> {
        let from = Bound::Included((token, 0));
        let to = Bound::Included((token, DirectionNumber::MAX));
        let pairs = self.directions.range((from, to));
        pairs.map(|(_, direction)| *direction)
    }

    /// Returns whether any direction declares a token.
    pub(super) fn is_declared(&self, token: TokenNumber) -> bool {
        self.of(token).next().is_some()
    }

    pub(super) fn facts(&self) -> [TableFacts; 2] {
        [self.tokens.facts(), self.ids.facts()]
    }
}
