//! Basic authentication against bcrypt hashes.
//!
//! Computing a hash takes a core for a tenth of a second by design. One hash is computed at a time,
//! on a blocking thread. Correct passwords are remembered, since a scraper sends its password every
//! few seconds.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use axum::extract::{Request, State};
use axum::http::header::{AUTHORIZATION, WWW_AUTHENTICATE};
use axum::http::{HeaderMap, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use subtle::ConstantTimeEq as _;
use tokio::sync::Semaphore;

/// A hash without a known password. It makes the check of an unknown name as slow as that of a
/// known name.
const UNKNOWN_USER_HASH: &str = "$2y$10$QOauhQNbBCuQDKes6eFzPeMqBSjb7Mr5DUmpZ/VcEd00UAV/LDeSi";

/// Checks the credentials of requests.
#[derive(Debug)]
pub(super) struct Gate {
    /// Hashes by name.
    users: BTreeMap<String, String>,
    /// Correct passwords by name.
    known: Mutex<BTreeMap<String, Vec<u8>>>,
    hash_permit: Semaphore,
}

impl Gate {
    pub(super) fn new(users: BTreeMap<String, String>) -> Self {
        Self {
            users,
            known: Mutex::default(),
            hash_permit: Semaphore::new(1),
        }
    }

    async fn is_authorized(&self, headers: &HeaderMap) -> bool {
        let Some((name, password)) = credentials(headers) else {
            return false;
        };
        if self.is_cached(&name, &password) {
            return true;
        }
        let hash = self.users.get(&name);
        let is_known = hash.is_some();
        let hash = hash.map_or(UNKNOWN_USER_HASH, String::as_str).to_owned();
        let offered = password.clone();
        // The semaphore is never closed.
        let _turn = self.hash_permit.acquire().await;
        let verified = tokio::task::spawn_blocking(move || bcrypt::verify(offered, &hash));
        let is_right = matches!(verified.await, Ok(Ok(true))) && is_known;
        if is_right {
            let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
            known.insert(name, password);
        }
        is_right
    }

    fn is_cached(&self, name: &str, password: &[u8]) -> bool {
        let known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        let right = known.get(name);
        right.is_some_and(|right| right.as_slice().ct_eq(password).into())
    }
}

/// Refuses requests without valid credentials.
pub(super) async fn guard(State(gate): State<Arc<Gate>>, request: Request, next: Next) -> Response {
    if gate.is_authorized(request.headers()).await {
        return next.run(request).await;
    }
    let challenge = [(WWW_AUTHENTICATE, "Basic")];
    (StatusCode::UNAUTHORIZED, challenge, "unauthorized\n").into_response()
}

fn credentials(headers: &HeaderMap) -> Option<(String, Vec<u8>)> {
    let value = headers.get(AUTHORIZATION)?.as_bytes();
    let (scheme, rest) = value.split_at_checked(6)?;
    let encoded = scheme.eq_ignore_ascii_case(b"basic ").then_some(rest)?;
    let decoded = STANDARD.decode(encoded.trim_ascii()).ok()?;
    let colon = decoded.iter().position(|byte| *byte == b':')?;
    let (name, password) = decoded.split_at_checked(colon)?;
    let name = String::from_utf8(name.to_vec()).ok()?;
    Some((name, password.get(1..)?.to_vec()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(value: &str) -> HeaderMap {
        [(AUTHORIZATION, value.parse().unwrap())]
            .into_iter()
            .collect()
    }

    fn basic(credentials: &str) -> HeaderMap {
        headers(&format!("Basic {}", STANDARD.encode(credentials)))
    }

    #[tokio::test]
    async fn the_right_password_is_accepted_and_remembered_and_others_are_refused() {
        // This is the hash of "open sesame" at the lowest cost.
        let hash = bcrypt::hash("open sesame", 4).unwrap();
        let users = [("alice".to_owned(), hash)];
        let gate = Gate::new(users.into_iter().collect());
        assert!(!gate.is_cached("alice", b"open sesame"));
        assert!(gate.is_authorized(&basic("alice:open sesame")).await);
        assert!(gate.is_cached("alice", b"open sesame"));
        assert!(gate.is_authorized(&basic("alice:open sesame")).await);
        for wrong in [
            "alice:open sesam",
            "alice:",
            "alice",
            "bob:open sesame",
            ":open sesame",
            "",
        ] {
            assert!(!gate.is_authorized(&basic(wrong)).await, "{wrong}");
        }
        for wrong in [
            "",
            "Basic",
            "Basic ",
            "Basic !!!",
            "Bearer x",
            "basic\u{7f}",
        ] {
            if let Ok(value) = wrong.parse() {
                let headers = [(AUTHORIZATION, value)].into_iter().collect();
                assert!(!gate.is_authorized(&headers).await, "{wrong}");
            }
        }
        assert!(!gate.is_authorized(&HeaderMap::new()).await);
        assert_eq!(gate.known.lock().unwrap().len(), 1);
        assert!(bcrypt::verify("x", UNKNOWN_USER_HASH).is_ok());
    }
}
