//! The opening handshake of a viewer (RFC 6455, 4.2): the rights of the client, the subprotocol,
//! and the answer.

use axum::extract::{FromRequestParts, Query, Request};
use axum::http::header::{
    CONNECTION, SEC_WEBSOCKET_ACCEPT, SEC_WEBSOCKET_KEY, SEC_WEBSOCKET_PROTOCOL,
    SEC_WEBSOCKET_VERSION, UPGRADE,
};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use tokio_tungstenite::tungstenite::handshake::derive_accept_key;

use super::protocol::SUBPROTOCOLS;

/// Version of the WebSocket protocol.
const WEBSOCKET_VERSION: &str = "13";

/// Query of the URL. Viewers can choose only the URL and the subprotocols.
#[derive(Default, Deserialize)]
struct Parameters {
    token: Option<String>,
}

/// Why a handshake fails.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum HandshakeError {
    /// The request does not open a WebSocket.
    NoWebSocket,
    /// The client offers none of the supported subprotocols.
    Subprotocol,
}

/// Returns the token in the URL, if any, and the request.
pub(super) async fn token(request: Request) -> (Option<String>, Request) {
    let (mut head, body) = request.into_parts();
    let parameters = Query::<Parameters>::from_request_parts(&mut head, &()).await;
    let token = parameters
        .ok()
        .and_then(|Query(parameters)| parameters.token);
    (token, Request::from_parts(head, body))
}

/// Returns the answer that accepts a handshake.
pub(super) fn accept(request: &Request) -> Result<Response, HandshakeError> {
    let headers = request.headers();
    let has = |name: HeaderName, word: &str| {
        words(headers, &name).any(|each| each.eq_ignore_ascii_case(word))
    };
    let key = headers.get(SEC_WEBSOCKET_KEY);
    let is_websocket = request.method() == Method::GET
        && has(CONNECTION, "upgrade")
        && has(UPGRADE, "websocket")
        && has(SEC_WEBSOCKET_VERSION, WEBSOCKET_VERSION);
    let key = key
        .filter(|_| is_websocket)
        .ok_or(HandshakeError::NoWebSocket)?;
    let mut offered = words(headers, &SEC_WEBSOCKET_PROTOCOL);
    let spoken = offered.find_map(|offered| SUBPROTOCOLS.into_iter().find(|ours| *ours == offered));
    let spoken = spoken.ok_or(HandshakeError::Subprotocol)?;
    let mut response = StatusCode::SWITCHING_PROTOCOLS.into_response();
    let accepted = HeaderValue::try_from(derive_accept_key(key.as_bytes()));
    let headers = response.headers_mut();
    headers.insert(CONNECTION, HeaderValue::from_static("upgrade"));
    headers.insert(UPGRADE, HeaderValue::from_static("websocket"));
    headers.insert(SEC_WEBSOCKET_PROTOCOL, HeaderValue::from_static(spoken));
    headers.insert(
        SEC_WEBSOCKET_ACCEPT,
        accepted.map_err(|_| HandshakeError::NoWebSocket)?,
    );
    Ok(response)
}

/// Returns the comma-separated words in all lines of a header.
fn words<'a>(headers: &'a HeaderMap, name: &HeaderName) -> impl Iterator<Item = &'a str> {
    let lines = headers.get_all(name).into_iter();
    let lines = lines.filter_map(|line| line.to_str().ok());
    lines.flat_map(|line| line.split(',')).map(str::trim)
}

impl IntoResponse for HandshakeError {
    fn into_response(self) -> Response {
        let close = (CONNECTION, HeaderValue::from_static("close"));
        match self {
            Self::NoWebSocket => {
                let headers = [
                    close,
                    (UPGRADE, HeaderValue::from_static("websocket")),
                    (
                        SEC_WEBSOCKET_VERSION,
                        HeaderValue::from_static(WEBSOCKET_VERSION),
                    ),
                ];
                let text = "This port speaks the Foxglove WebSocket protocol. Open its address, \
                            with ws:// in front, in Foxglove, Lichtblick or PlotJuggler.\n";
                (StatusCode::UPGRADE_REQUIRED, headers, text).into_response()
            }
            Self::Subprotocol => {
                let text = format!(
                    "Offer one of the subprotocols {}.\n",
                    SUBPROTOCOLS.join(", ")
                );
                (StatusCode::BAD_REQUEST, [close], text).into_response()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use axum::body::Body;

    use super::*;

    /// The example of RFC 6455, 1.3, with these headers changed.
    fn request(changed: &[(HeaderName, &str)]) -> Request {
        let mut request = Request::builder()
            .uri("/?token=a%2Bb")
            .header(CONNECTION, "keep-alive, Upgrade")
            .header(UPGRADE, "WebSocket")
            .header(SEC_WEBSOCKET_VERSION, "13")
            .header(SEC_WEBSOCKET_KEY, "dGhlIHNhbXBsZSBub25jZQ==")
            .header(SEC_WEBSOCKET_PROTOCOL, "x, foxglove.websocket.v1")
            .body(Body::empty())
            .unwrap();
        for (name, value) in changed {
            let headers = request.headers_mut();
            headers.remove(name);
            if !value.is_empty() {
                headers.insert(name, value.parse().unwrap());
            }
        }
        request
    }

    #[test]
    fn a_valid_handshake_is_accepted_with_the_key_of_the_specification() {
        let response = accept(&request(&[])).unwrap();
        assert_eq!(response.status(), StatusCode::SWITCHING_PROTOCOLS);
        let headers = response.headers();
        assert_eq!(
            headers[SEC_WEBSOCKET_ACCEPT],
            "s3pPLMBiTxaQ9kYGzzhZRbK+xOo="
        );
        assert_eq!(headers[SEC_WEBSOCKET_PROTOCOL], "foxglove.websocket.v1");
        let both = "foxglove.sdk.v1,foxglove.websocket.v1";
        let response = accept(&request(&[(SEC_WEBSOCKET_PROTOCOL, both)])).unwrap();
        assert_eq!(response.headers()[SEC_WEBSOCKET_PROTOCOL], SUBPROTOCOLS[0]);
    }

    #[test]
    fn a_request_that_is_not_a_valid_handshake_is_refused() {
        for (name, value) in [
            (CONNECTION, "keep-alive"),
            (UPGRADE, ""),
            (UPGRADE, "h2c"),
            (SEC_WEBSOCKET_VERSION, "8"),
            (SEC_WEBSOCKET_KEY, ""),
        ] {
            let unfit = accept(&request(&[(name.clone(), value)])).unwrap_err();
            assert_eq!(unfit, HandshakeError::NoWebSocket, "{name} {value}");
        }
        for value in ["", "rosbridge", "Foxglove.sdk.v1", "foxglove.sdk.v2"] {
            let unfit = accept(&request(&[(SEC_WEBSOCKET_PROTOCOL, value)])).unwrap_err();
            assert_eq!(unfit, HandshakeError::Subprotocol, "{value}");
        }
        let mut post = request(&[]);
        *post.method_mut() = Method::POST;
        assert_eq!(accept(&post).unwrap_err(), HandshakeError::NoWebSocket);
    }

    #[tokio::test]
    async fn the_token_is_decoded_from_the_url() {
        let (token, _) = token(request(&[])).await;
        assert_eq!(token.as_deref(), Some("a+b"));
    }
}
