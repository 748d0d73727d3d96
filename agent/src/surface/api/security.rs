//! What every request has to pass before a route sees it: not too fast, not too large, sent to this
//! agent's own name, by no foreign web page, with the token where one is asked for.
//!
//! Host and Origin are looked at because a browser on this host can be made to send requests to
//! loopback by any web page it shows (CSRF), also under a name of the page's own (DNS rebinding).

use std::fs::File;
use std::io::{self, Read as _};
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use axum::extract::{Request, State};
use axum::http::header::{AUTHORIZATION, CONTENT_LENGTH, HOST, HeaderName, ORIGIN};
use axum::http::{HeaderMap, HeaderValue};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use subtle::ConstantTimeEq as _;

use super::problem::{Code, Problem};

/// More than any request needs.
pub(super) const MAX_BODY: usize = 16 << 10;
/// Requests a second that a door lets in for long, and how many at once.
const RATE: f64 = 500.0;
const BURST: f64 = 1_000.0;
/// A shorter token can be guessed; a longer file is no token.
const TOKEN_BYTES: std::ops::RangeInclusive<usize> = 16..=4096;

const SEC_FETCH_SITE: HeaderName = HeaderName::from_static("sec-fetch-site");

/// What clients have to know.
#[derive(Clone)]
pub(super) struct Token(Arc<[u8]>);

/// Why there is no token.
#[derive(Debug, thiserror::Error)]
pub enum TokenError {
    /// The file cannot be read.
    #[error("cannot read the token in {} (`api.token_file`)", path.display())]
    Read {
        /// Which file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// It holds something else.
    #[error(
        "{} (`api.token_file`) must hold one line of {} to {} printable characters without blanks, \
         as `openssl rand -hex 32` prints", path.display(), TOKEN_BYTES.start(), TOKEN_BYTES.end()
    )]
    Unfit {
        /// Which file.
        path: PathBuf,
    },
}

/// One of the API's listeners, as far as it matters who may pass.
#[derive(Debug)]
pub(super) struct Door {
    kind: Kind,
    bucket: Mutex<Bucket>,
}

/// Who can knock.
#[derive(Debug)]
pub(super) enum Kind {
    /// Who may open the unix socket's file.
    Socket,
    /// Everybody on this host, with the token if there is one.
    Loopback(Option<Token>),
    /// Everybody who has the token.
    Network(Token),
}

/// Requests that may still come in now.
#[derive(Debug)]
struct Bucket {
    left: f64,
    at: Instant,
}

impl Token {
    /// Reads it from a file.
    pub(super) fn load(path: &Path) -> Result<Self, TokenError> {
        let mut bytes = Vec::new();
        let limit = *TOKEN_BYTES.end() as u64 + 2;
        let read = File::open(path).and_then(|file| file.take(limit).read_to_end(&mut bytes));
        read.map_err(|source| TokenError::Read {
            path: path.to_path_buf(),
            source,
        })?;
        let token = bytes.trim_ascii();
        if !TOKEN_BYTES.contains(&token.len()) || !token.iter().all(u8::is_ascii_graphic) {
            let path = path.to_path_buf();
            return Err(TokenError::Unfit { path });
        }
        Ok(Self(token.into()))
    }

    /// Takes the same time for every wrong token of the right length.
    fn is(&self, offered: &[u8]) -> bool {
        self.0.ct_eq(offered).into()
    }
}

impl std::fmt::Debug for Token {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Token")
    }
}

impl Door {
    pub(super) fn new(kind: Kind) -> Self {
        let bucket = Mutex::new(Bucket {
            left: BURST,
            at: Instant::now(),
        });
        Self { kind, bucket }
    }

    fn let_in(&self, headers: &HeaderMap, now: Instant) -> Result<(), Problem> {
        let mut bucket = self.bucket.lock().unwrap_or_else(PoisonError::into_inner);
        if !bucket.draw(now) {
            let detail = format!("at most {RATE} requests a second are answered");
            return Err(Problem::new(Code::TooManyRequests, detail));
        }
        drop(bucket);
        match &self.kind {
            Kind::Socket => {}
            Kind::Loopback(token) => {
                own_host(headers)?;
                own_pages(headers)?;
                token
                    .as_ref()
                    .map_or(Ok(()), |token| authorized(headers, token))?;
            }
            Kind::Network(token) => {
                own_pages(headers)?;
                authorized(headers, token)?;
            }
        }
        small(headers)
    }
}

impl Bucket {
    fn draw(&mut self, now: Instant) -> bool {
        let passed = now.saturating_duration_since(self.at).as_secs_f64();
        self.left = (self.left + passed * RATE).min(BURST);
        self.at = now;
        let any = self.left >= 1.0;
        if any {
            self.left -= 1.0;
        }
        any
    }
}

/// Answers what may not come in.
pub(super) async fn guard(State(door): State<Arc<Door>>, request: Request, next: Next) -> Response {
    match door.let_in(request.headers(), Instant::now()) {
        Ok(()) => next.run(request).await,
        Err(problem) => problem.into_response(),
    }
}

/// A name that resolves to loopback for everybody, or a loopback address: no name that a web page
/// could have made its own.
fn own_host(headers: &HeaderMap) -> Result<(), Problem> {
    let host = headers.get(HOST).and_then(|host| host.to_str().ok());
    if host.is_some_and(is_own) && headers.get_all(HOST).iter().count() == 1 {
        return Ok(());
    }
    let detail = format!(
        "the request is for the host `{}`; this listener answers to localhost and loopback addresses",
        host.unwrap_or_default()
    );
    Err(Problem::new(Code::ForeignHost, detail))
}

fn is_own(host: &str) -> bool {
    let name = match host.strip_prefix('[') {
        Some(rest) => rest.split(']').next().unwrap_or_default(),
        None => host.split(':').next().unwrap_or_default(),
    };
    name.eq_ignore_ascii_case("localhost")
        || name
            .parse()
            .is_ok_and(|address: IpAddr| address.is_loopback())
}

/// Only browsers send these headers: the page must have come from this listener itself.
fn own_pages(headers: &HeaderMap) -> Result<(), Problem> {
    let text = |value: &HeaderValue| value.to_str().unwrap_or_default().to_owned();
    let site = headers.get(SEC_FETCH_SITE).map(text);
    let cross = site.is_some_and(|site| !matches!(site.as_str(), "same-origin" | "none"));
    let origin = headers.get(ORIGIN).map(text);
    let own = headers
        .get(HOST)
        .map(|host| format!("http://{}", text(host)));
    let foreign = origin.is_some() && origin != own;
    if cross || foreign {
        let detail = format!(
            "requests of web pages from elsewhere ({}) are not answered",
            origin.unwrap_or_else(|| "another site".to_owned())
        );
        return Err(Problem::new(Code::ForeignOrigin, detail));
    }
    Ok(())
}

fn authorized(headers: &HeaderMap, token: &Token) -> Result<(), Problem> {
    let Some(credentials) = headers.get(AUTHORIZATION).map(HeaderValue::as_bytes) else {
        let detail = "send the header `Authorization: Bearer TOKEN`";
        return Err(Problem::new(Code::Unauthorized, detail));
    };
    let (scheme, offered) = credentials.split_at_checked(7).unwrap_or_default();
    if scheme.eq_ignore_ascii_case(b"bearer ") && token.is(offered.trim_ascii()) {
        return Ok(());
    }
    Err(Problem::new(Code::Unauthorized, "the token is wrong"))
}

/// A body without a length is bounded while it is read.
fn small(headers: &HeaderMap) -> Result<(), Problem> {
    let length = headers
        .get(CONTENT_LENGTH)
        .and_then(|length| length.to_str().ok());
    let length = length.and_then(|length| length.parse::<usize>().ok());
    if length.is_some_and(|length| length > MAX_BODY) {
        return Err(too_large());
    }
    Ok(())
}

/// The body has more than [`MAX_BODY`] bytes.
pub(super) fn too_large() -> Problem {
    Problem::new(
        Code::BodyTooLarge,
        format!("at most {MAX_BODY} bytes are read"),
    )
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    const SECRET: &str = "0123456789abcdef";

    fn token() -> Token {
        Token(SECRET.as_bytes().into())
    }

    fn headers(pairs: &[(&str, &str)]) -> HeaderMap {
        let pair = |(name, value): &(&str, &str)| {
            (
                HeaderName::from_bytes(name.as_bytes()).unwrap(),
                value.parse().unwrap(),
            )
        };
        pairs.iter().map(pair).collect()
    }

    /// The code of the refusal.
    fn refusal(door: &Door, pairs: &[(&str, &str)]) -> Option<Code> {
        let answer = door.let_in(&headers(pairs), Instant::now());
        answer.err().map(|problem| problem.code())
    }

    #[test]
    fn loopback_answers_to_its_own_names_only() {
        let door = Door::new(Kind::Loopback(None));
        for host in [
            "localhost",
            "LOCALHOST:17401",
            "127.0.0.1:17401",
            "127.8.9.1",
            "[::1]:9000",
            "[::1]",
        ] {
            assert_eq!(refusal(&door, &[("host", host)]), None, "{host}");
        }
        for host in [
            "evil.example",
            "localhost.evil.example",
            "127.0.0.1.evil.example:17401",
            "10.0.0.1:17401",
            "[::2]",
            "",
            "[",
            "127.0.0.1@evil.example",
        ] {
            let refused = refusal(&door, &[("host", host)]);
            assert_eq!(refused, Some(Code::ForeignHost), "{host}");
        }
        assert_eq!(refusal(&door, &[]), Some(Code::ForeignHost));
        let two = [("host", "localhost"), ("host", "evil.example")];
        assert_eq!(refusal(&door, &two), Some(Code::ForeignHost));
    }

    #[test]
    fn web_pages_from_elsewhere_are_not_answered() {
        for door in [
            Door::new(Kind::Loopback(None)),
            Door::new(Kind::Network(token())),
        ] {
            let host = ("host", "localhost:17401");
            let bearer = ("authorization", "Bearer 0123456789abcdef");
            let answer = |pair| refusal(&door, &[host, bearer, pair]);
            for good in [
                ("origin", "http://localhost:17401"),
                ("sec-fetch-site", "same-origin"),
                ("sec-fetch-site", "none"),
            ] {
                assert_eq!(answer(good), None, "{good:?}");
            }
            for bad in [
                ("origin", "http://evil.example"),
                ("origin", "http://localhost:3000"),
                ("origin", "null"),
                ("origin", ""),
                ("sec-fetch-site", "cross-site"),
                ("sec-fetch-site", "same-site"),
            ] {
                assert_eq!(answer(bad), Some(Code::ForeignOrigin), "{bad:?}");
            }
        }
    }

    #[test]
    fn the_network_needs_the_token_and_the_socket_nothing() {
        for door in [
            Door::new(Kind::Network(token())),
            Door::new(Kind::Loopback(Some(token()))),
        ] {
            let with = |value| refusal(&door, &[("host", "localhost"), ("authorization", value)]);
            assert_eq!(with("Bearer 0123456789abcdef"), None);
            assert_eq!(with("bearer  0123456789abcdef "), None);
            for wrong in [
                "Bearer 0123456789abcdeg",
                "Bearer 0123456789abcde",
                "Bearer 0123456789abcdef0",
                "Bearer ",
                "Bearer",
                "",
                "Basic 0123456789abcdef",
                "0123456789abcdef",
            ] {
                assert_eq!(with(wrong), Some(Code::Unauthorized), "{wrong}");
            }
            let without = refusal(&door, &[("host", "localhost")]);
            assert_eq!(without, Some(Code::Unauthorized));
        }
        let named = [
            ("host", "robot1:17401"),
            ("authorization", "Bearer 0123456789abcdef"),
        ];
        assert_eq!(refusal(&Door::new(Kind::Network(token())), &named), None);
        let anything = [("host", "evil.example"), ("origin", "http://evil.example")];
        assert_eq!(refusal(&Door::new(Kind::Socket), &anything), None);
    }

    #[test]
    fn a_long_body_is_refused_before_it_is_read() {
        let door = Door::new(Kind::Socket);
        let length = |length: &str| refusal(&door, &[("content-length", length)]);
        assert_eq!(length("16384"), None);
        assert_eq!(length("16385"), Some(Code::BodyTooLarge));
    }

    #[test]
    fn a_flood_is_slowed_down_and_forgiven() {
        let start = Instant::now();
        let mut bucket = Bucket {
            left: BURST,
            at: start,
        };
        let drawn = (0..2000).filter(|_| bucket.draw(start)).count();
        assert_eq!(drawn, 1000);
        let later = start + Duration::from_millis(10);
        assert_eq!((0..100).filter(|_| bucket.draw(later)).count(), 5);
        let door = Door::new(Kind::Socket);
        let refused = |_: &u32| door.let_in(&HeaderMap::new(), start).is_err();
        assert_eq!((0..2000).filter(refused).count(), 1000);
        let again = door.let_in(&HeaderMap::new(), start).unwrap_err();
        assert_eq!(again.code(), Code::TooManyRequests);

        let rested = start + Duration::from_secs(3600);
        assert_eq!((0..2000).filter(|_| bucket.draw(rested)).count(), 1000);
    }

    #[test]
    fn a_token_that_could_be_guessed_is_none() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("token");
        let load = |text: &[u8]| {
            std::fs::write(&path, text).unwrap();
            Token::load(&path)
        };
        assert!(load(b"0123456789abcdef\n").unwrap().is(SECRET.as_bytes()));
        for unfit in [
            &b""[..],
            b"short\n",
            b"0123456789 abcdef",
            b"0123456789abcde\xff",
            b"0123456789\nabcdef",
            &[b'a'; 5000],
        ] {
            assert!(matches!(load(unfit), Err(TokenError::Unfit { .. })));
        }
        std::fs::remove_file(&path).unwrap();
        let error = Token::load(&path).unwrap_err();
        assert!(error.to_string().contains("api.token_file"), "{error}");
    }
}
