//! Declarations: aliases of keys, and liveliness tokens.

use ros2probe_wire::zenoh::{Declaration, WireExpr};

use super::Zenoh;
use super::connections::lease;
use super::stream::StreamId;

impl Zenoh {
    pub(super) fn declaration(&mut self, stream: &StreamId, declaration: Declaration<'_>) {
        match declaration {
            Declaration::KeyExpr { id, key } => self.declare_alias(stream, id, key),
            Declaration::UndeclareKeyExpr { id } => {
                if let Some(direction) = self.directions.get(stream) {
                    self.aliases.remove(direction.number, &id);
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
        if let (Some(direction), Some(key)) = (self.directions.get(stream), key) {
            self.aliases.insert(direction.number, id, key, 0);
        }
    }

    fn declare_token(&mut self, stream: &StreamId, id: u32, key: WireExpr<'_>) {
        let Some(key) = self.resolve(stream, key) else {
            return;
        };
        let Some(direction) = self.directions.get(stream).map(|known| known.number) else {
            return;
        };
        let router = self.passing_router(stream);
        let directions = &self.directions;
        let lease = |session| lease(directions, session);
        let is_known = self.graph.declare(&key.key, (direction, id), lease);
        if let Some(router) = router.filter(|_| is_known) {
            self.revision += u64::from(self.graph.add_passage(&key.key, router));
        }
    }

    fn undeclare_token(&mut self, stream: &StreamId, id: u32, key: Option<WireExpr<'_>>) {
        let Some(direction) = self.directions.get(stream) else {
            return;
        };
        let (by, direction) = (direction.session(), direction.number);
        let named = key.filter(|key| key.scope != 0 || !key.suffix.is_empty());
        let named = named.and_then(|key| self.resolve(stream, key));
        let named = named.as_ref().map(|alias| &*alias.key);
        self.graph.undeclare((direction, id), named, by);
    }
}
