//! Declarations: aliases of keys, and liveliness tokens.

use std::sync::Arc;

use ros2probe_wire::zenoh::{Declaration, WireExpr};

use super::Zenoh;
use super::connections::lease;
use super::stream::StreamId;
use super::stream_state::MAX_TOKENS;

impl Zenoh {
    pub(super) fn declaration(&mut self, stream: &StreamId, declaration: Declaration<'_>) {
        match declaration {
            Declaration::KeyExpr { id, key } => self.declare_alias(stream, id, key),
            Declaration::UndeclareKeyExpr { id } => {
                if let Some(direction) = self.directions.get_mut(stream) {
                    direction.aliases.remove(&id);
                }
            }
            Declaration::Token { id, key } => self.declare_token(stream, id, key),
            Declaration::UndeclareToken { id, key } => self.undeclare_token(stream, id, key),
            Declaration::Subscriber { .. }
            | Declaration::UndeclareSubscriber { .. }
            | Declaration::Queryable { .. }
            | Declaration::UndeclareQueryable { .. }
            | Declaration::Final => {}
        }
    }

    fn declare_alias(&mut self, stream: &StreamId, id: u16, key: WireExpr<'_>) {
        let key = self.resolve(stream, key);
        if let Some(direction) = self.directions.get_mut(stream)
            && let Some(key) = key
            && !direction.declare(id, key)
        {
            self.evictions += 1;
        }
    }

    fn declare_token(&mut self, stream: &StreamId, id: u32, key: WireExpr<'_>) {
        let Some(key) = self.resolve(stream, key) else {
            return;
        };
        let router = self.passing_router(stream);
        let directions = &self.directions;
        let lease = |session| lease(directions, session);
        let token = self.graph.declare(&key.key, *stream, lease);
        if let (Some(token), Some(router)) = (&token, router) {
            self.revision += u64::from(self.graph.pass_on(token, router));
        }
        if let Some(token) = token
            && let Some(direction) = self.directions.get_mut(stream)
            && direction.tokens.len() < MAX_TOKENS
        {
            if id != 0 && direction.token_ids.len() < MAX_TOKENS {
                direction.token_ids.insert(id, Arc::clone(&token));
            }
            direction.tokens.insert(token);
        }
    }

    fn undeclare_token(&mut self, stream: &StreamId, id: u32, key: Option<WireExpr<'_>>) {
        let Some(direction) = self.directions.get_mut(stream) else {
            return;
        };
        let by = direction.session();
        let declared = direction.token_ids.remove(&id);
        let named = key.filter(|key| key.scope != 0 || !key.suffix.is_empty());
        let named = named.and_then(|key| self.resolve(stream, key));
        if let Some(token) = declared.or(named.map(|alias| alias.key)) {
            if let Some(direction) = self.directions.get_mut(stream) {
                direction.tokens.remove(&token);
            }
            self.graph.undeclare(&token, stream, by);
        }
    }
}
