//! Checks of every request before its route: the `Host` header, the origin of a web page, the
//! token, the rate and the size. The rights of a request then depend on its listener; see
//! [`Access`].
//!
//! Host and Origin matter because a web page can make a browser on this host send requests to
//! loopback (CSRF). It can also do so under its own host name (DNS rebinding).

use std::io::{self, Read as _};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use axum::extract::{Extension, Request, State};
use axum::http::header::{AUTHORIZATION, CONNECTION, CONTENT_LENGTH, HOST, HeaderName, ORIGIN};
use axum::http::{HeaderMap, HeaderValue, Method};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use subtle::ConstantTimeEq as _;

use super::page;
use super::problem::{Code, Problem};
use crate::config::Access;
use crate::surface::authority;

/// Maximum size of a request body in bytes, larger than any valid body.
pub(super) const MAX_BODY: usize = 16 << 10;
/// Sustained number of requests per second and size of a burst. Each listener has one limit for
/// clients with a token or on the unix socket, one for other clients, and one for refused requests.
const REQUEST_RATE: f64 = 500.0;
const REQUEST_BURST: f64 = 1_000.0;
/// Valid length of a token. Shorter tokens can be guessed, and a longer file is not a token.
const TOKEN_BYTES: std::ops::RangeInclusive<usize> = 16..=4096;

const SEC_FETCH_SITE: HeaderName = HeaderName::from_static("sec-fetch-site");
const SEC_FETCH_MODE: HeaderName = HeaderName::from_static("sec-fetch-mode");

/// A token that clients must send.
#[derive(Clone)]
pub(in crate::surface) struct Token(Arc<[u8]>);

/// Why the token cannot be loaded.
#[derive(Debug, thiserror::Error)]
pub enum TokenError {
    /// The file cannot be read.
    #[error("cannot read the token in {} (`api.token_file`)", path.display())]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The file does not contain a valid token.
    #[error(
        "{} (`api.token_file`) must hold one line of {} to {} printable characters without blanks, \
         as `openssl rand -hex 32` prints", path.display(), TOKEN_BYTES.start(), TOKEN_BYTES.end()
    )]
    Unfit {
        /// Path of the file.
        path: PathBuf,
    },
}

/// The access rules of one listener.
#[derive(Debug)]
pub(in crate::surface) struct AccessRules {
    kind: Kind,
    rights: Rights,
    page: page::Shared,
    token_bucket: Mutex<Bucket>,
    client_bucket: Mutex<Bucket>,
    refused_bucket: Mutex<Bucket>,
}

/// The rights that a listener grants to a request.
#[derive(Clone, Debug)]
pub(in crate::surface) struct Rights {
    access: Access,
    /// Whether the client sent a valid token or uses the unix socket.
    has_token: bool,
    /// The agent's unix socket, which grants all rights.
    socket: Option<Arc<Path>>,
}

/// The rights that the routes of a noun need, for reading and for changes.
#[derive(Clone, Copy, Debug)]
pub(super) struct RequiredRights {
    pub(super) read: Access,
    pub(super) change: Access,
}

/// The clients that can connect.
#[derive(Debug)]
pub(in crate::surface) enum Kind {
    /// Processes with permission to open the unix socket.
    Socket,
    /// Processes on this host, with the token if one is configured.
    Loopback(Option<Token>),
    /// Hosts in the network, with the token.
    Network(Token),
}

/// A token bucket that limits the rate of requests.
#[derive(Debug)]
struct Bucket {
    left: f64,
    at: Instant,
}

impl Token {
    /// Loads the token from a file.
    pub(in crate::surface) fn load(path: &Path) -> Result<Self, TokenError> {
        let mut bytes = Vec::new();
        let limit = *TOKEN_BYTES.end() as u64 + 2;
        let read =
            crate::file::open(path).and_then(|file| file.take(limit).read_to_end(&mut bytes));
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

    /// Returns whether the token is the right one, in constant time for tokens of the right length.
    fn is(&self, offered: &[u8]) -> bool {
        self.0.ct_eq(offered).into()
    }
}

impl std::fmt::Debug for Token {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Token")
    }
}

impl AccessRules {
    pub(in crate::surface) fn new(kind: Kind, granted: Rights) -> Self {
        let bucket = || {
            Mutex::new(Bucket {
                left: REQUEST_BURST,
                at: Instant::now(),
            })
        };
        Self {
            kind,
            rights: granted,
            page: page::Shared::default(),
            token_bucket: bucket(),
            client_bucket: bucket(),
            refused_bucket: bucket(),
        }
    }

    /// Returns the access rules with the tokens of web pages.
    pub(in crate::surface) fn with(self, page: page::Shared) -> Self {
        Self { page, ..self }
    }

    /// Returns whether browsers can connect.
    pub(super) const fn is_for_browsers(&self) -> bool {
        matches!(self.kind, Kind::Loopback(_) | Kind::Network(_))
    }

    /// Checks a request and returns its rights.
    fn check_request(&self, headers: &HeaderMap, now: Instant) -> Result<Rights, Problem> {
        let granted = self.limit_rate(self.request_rights(headers), Rights::has_token, now)?;
        check_length(headers)?;
        Ok(granted)
    }

    /// Checks a request for a file of the page. The request needs no token, because a browser
    /// requests the page before it can have a token.
    fn check_file_request(&self, headers: &HeaderMap, now: Instant) -> Result<(), Problem> {
        let host = match self.kind {
            Kind::Loopback(_) => own_host(headers),
            Kind::Socket | Kind::Network(_) => Ok(()),
        };
        // A link to the page may be on any web page.
        let is_link = headers
            .get(SEC_FETCH_MODE)
            .is_some_and(|mode| mode.as_bytes() == b"navigate");
        let admitted = host.and_then(|()| match is_link {
            true => Ok(()),
            false => own_pages(headers),
        });
        // A browser requests files before it can have a token.
        self.limit_rate(admitted, |()| false, now)
    }

    /// Checks the handshake of a viewer and returns its rights. Viewers send a token in the URL. A
    /// viewer with a token may be a web page of any origin. Without a token, the web page must be
    /// on this host or among `origins`.
    pub(in crate::surface) fn check_viewer(
        &self,
        headers: &HeaderMap,
        token: Option<&[u8]>,
        origins: &[String],
        now: Instant,
    ) -> Result<Rights, Problem> {
        let admitted = self.viewer_rights(headers, token, origins);
        self.limit_rate(admitted, Rights::has_token, now)
    }

    /// Returns the token that a request needs, if any. Returns `None` for the unix socket, whose
    /// file mode controls access. Fails if a request on loopback names another host.
    fn token(&self, headers: &HeaderMap) -> Result<Option<Option<&Token>>, Problem> {
        Ok(match &self.kind {
            Kind::Socket => None,
            Kind::Loopback(token) => {
                own_host(headers)?;
                Some(token.as_ref())
            }
            Kind::Network(token) => Some(Some(token)),
        })
    }

    fn viewer_rights(
        &self,
        headers: &HeaderMap,
        offered: Option<&[u8]>,
        origins: &[String],
    ) -> Result<Rights, Problem> {
        let Some(token) = self.token(headers)? else {
            return Ok(self.rights.with_token());
        };
        if let Some(offered) = offered.or_else(|| bearer(headers)) {
            let is_right =
                self.page.tokens.is_valid(offered) || token.is_some_and(|token| token.is(offered));
            return match is_right {
                true => Ok(self.rights.everything()),
                false => Err(Problem::new(Code::Unauthorized, "the token is wrong")),
            };
        }
        if token.is_some() {
            let detail = "add `?token=TOKEN` to the address; `rp foxglove` prints it";
            return Err(Problem::new(Code::Unauthorized, detail));
        }
        viewers_pages(headers, origins)?;
        Ok(self.rights.clone())
    }

    /// Applies the rate limit. Each class of clients has its own limit, which other classes cannot
    /// exhaust.
    fn limit_rate<T>(
        &self,
        admitted: Result<T, Problem>,
        is_holder: impl FnOnce(&T) -> bool,
        now: Instant,
    ) -> Result<T, Problem> {
        let bucket = match &admitted {
            Ok(granted) if is_holder(granted) => &self.token_bucket,
            Ok(_) => &self.client_bucket,
            Err(_) => &self.refused_bucket,
        };
        let mut bucket = bucket.lock().unwrap_or_else(PoisonError::into_inner);
        if !bucket.draw(now) {
            let detail = format!("at most {REQUEST_RATE} requests a second are answered");
            return Err(Problem::new(Code::TooManyRequests, detail));
        }
        drop(bucket);
        admitted
    }

    fn request_rights(&self, headers: &HeaderMap) -> Result<Rights, Problem> {
        let Some(token) = self.token(headers)? else {
            return Ok(self.rights.with_token());
        };
        own_pages(headers)?;
        if bearer(headers).is_some_and(|offered| self.page.tokens.is_valid(offered)) {
            return Ok(self.rights.everything());
        }
        let Some(token) = token else {
            return Ok(self.rights.clone());
        };
        authorized(headers, token)?;
        Ok(self.rights.with_token())
    }
}

impl Kind {
    /// Returns the rights of clients. Loopback clients without a token have the rights `loopback`.
    pub(in crate::surface) const fn access(&self, loopback: Access) -> Access {
        match self {
            Self::Loopback(None) => loopback,
            Self::Socket | Self::Loopback(Some(_)) | Self::Network(_) => Access::All,
        }
    }
}

impl Rights {
    pub(in crate::surface) const fn new(access: Access, socket: Option<Arc<Path>>) -> Self {
        Self {
            access,
            has_token: false,
            socket,
        }
    }

    /// Returns whether the client sent a valid token or uses the unix socket. Some slots are
    /// reserved for these clients.
    pub(in crate::surface) const fn has_token(&self) -> bool {
        self.has_token
    }

    pub(in crate::surface) const fn access(&self) -> Access {
        self.access
    }

    /// Returns all rights, for a client with a valid token.
    fn everything(&self) -> Self {
        Self {
            access: Access::All,
            ..self.with_token()
        }
    }

    /// Returns the same rights, for a client with a token or on the unix socket.
    fn with_token(&self) -> Self {
        Self {
            has_token: true,
            ..self.clone()
        }
    }

    /// Fails if the listener does not grant `needed`. The problem describes how to get these
    /// rights.
    pub(super) fn require(&self, needed: Access) -> Result<(), Problem> {
        if needed <= self.access {
            return Ok(());
        }
        let what = match needed {
            Access::Read | Access::Watch => "watches and streams of messages",
            Access::All => "message payloads, recordings, snapshots and reloads",
        };
        let way = match &self.socket {
            Some(path) => format!(
                "use the unix socket {}, open to root and its group (`sudo usermod -aG ros2probe \
                 $USER`, then log in again), or a token that `rp page` prints",
                path.display()
            ),
            None => "configure `api.socket` or `api.token_file`".to_owned(),
        };
        let detail = format!(
            "loopback grants no {what} without a token: {way}, or set `api.loopback: {needed}`"
        );
        Err(Problem::new(Code::NeedsSocket, detail))
    }
}

impl Bucket {
    fn draw(&mut self, now: Instant) -> bool {
        let passed = now.saturating_duration_since(self.at).as_secs_f64();
        self.left = (self.left + passed * REQUEST_RATE).min(REQUEST_BURST);
        self.at = now;
        let any = self.left >= 1.0;
        if any {
            self.left -= 1.0;
        }
        any
    }
}

/// Answers refused requests and closes their connections.
pub(super) async fn guard(
    State(door): State<Arc<AccessRules>>,
    mut request: Request,
    next: Next,
) -> Response {
    match door.check_request(request.headers(), Instant::now()) {
        Ok(granted) => {
            request.extensions_mut().insert(granted);
            next.run(request).await
        }
        Err(problem) => refusal(problem),
    }
}

/// Answers refused requests for files of the page.
pub(super) async fn guard_files(
    State(door): State<Arc<AccessRules>>,
    request: Request,
    next: Next,
) -> Response {
    match door.check_file_request(request.headers(), Instant::now()) {
        Ok(()) => next.run(request).await,
        Err(problem) => refusal(problem),
    }
}

fn refusal(problem: Problem) -> Response {
    let close = [(CONNECTION, HeaderValue::from_static("close"))];
    (close, problem).into_response()
}

/// Refuses requests that need more rights than the listener grants.
pub(super) async fn require_rights(
    State(needs): State<RequiredRights>,
    Extension(granted): Extension<Rights>,
    request: Request,
    next: Next,
) -> Response {
    let needed = match *request.method() {
        Method::GET | Method::HEAD | Method::OPTIONS => needs.read,
        _ => needs.change,
    };
    match granted.require(needed) {
        Ok(()) => next.run(request).await,
        Err(problem) => problem.into_response(),
    }
}

fn own_host(headers: &HeaderMap) -> Result<(), Problem> {
    authority::own(headers).map_err(|host| {
        let detail = format!(
            "the request is for the host `{host}`; this listener answers to localhost and loopback \
             addresses"
        );
        Problem::new(Code::ForeignHost, detail)
    })
}

/// Checks the headers that only browsers send: the page must come from this listener. All values of
/// a repeated header are checked.
fn own_pages(headers: &HeaderMap) -> Result<(), Problem> {
    let text = |value: &HeaderValue| value.to_str().unwrap_or_default().to_owned();
    let cross = headers
        .get_all(SEC_FETCH_SITE)
        .iter()
        .any(|site| !matches!(site.as_bytes(), b"same-origin" | b"none"));
    let own = headers
        .get(HOST)
        .map(|host| format!("http://{}", text(host)));
    let mut origins = headers.get_all(ORIGIN).iter().map(text);
    let foreign = origins.find(|origin| Some(origin) != own.as_ref());
    if cross || foreign.is_some() {
        let detail = format!(
            "requests from web pages of other origins ({}) are refused",
            foreign.unwrap_or_else(|| "another site".to_owned())
        );
        return Err(Problem::new(Code::ForeignOrigin, detail));
    }
    Ok(())
}

/// Checks the origin of a viewer that is a web page: it must be on this host or among `origins`. A
/// page from elsewhere cannot have an origin on this host.
fn viewers_pages(headers: &HeaderMap, origins: &[String]) -> Result<(), Problem> {
    let mut pages = headers.get_all(ORIGIN).iter();
    let foreign = pages.find(|page| {
        let page = page.to_str().unwrap_or_default();
        let authority = page
            .split_once("://")
            .map_or("", |(_, authority)| authority);
        !authority::is_own(authority) && !origins.iter().any(|origin| origin == page)
    });
    match foreign {
        None => Ok(()),
        Some(page) => {
            let detail = format!(
                "the web page {} may not connect without a token: add `?token=TOKEN` to the \
                 address, as `rp foxglove` prints it, or the page to `foxglove.origins`",
                String::from_utf8_lossy(page.as_bytes())
            );
            Err(Problem::new(Code::ForeignOrigin, detail))
        }
    }
}

fn authorized(headers: &HeaderMap, token: &Token) -> Result<(), Problem> {
    if !headers.contains_key(AUTHORIZATION) {
        let detail = "send the header `Authorization: Bearer TOKEN`";
        return Err(Problem::new(Code::Unauthorized, detail));
    }
    if bearer(headers).is_some_and(|offered| token.is(offered)) {
        return Ok(());
    }
    Err(Problem::new(Code::Unauthorized, "the token is wrong"))
}

/// Returns the bearer token of a request, if it has one.
fn bearer(headers: &HeaderMap) -> Option<&[u8]> {
    let credentials = headers.get(AUTHORIZATION)?.as_bytes();
    let (scheme, offered) = credentials.split_at_checked(7)?;
    scheme
        .eq_ignore_ascii_case(b"bearer ")
        .then(|| offered.trim_ascii())
}

/// Checks the declared length of the body. A body without a length is bounded while it is read.
fn check_length(headers: &HeaderMap) -> Result<(), Problem> {
    let length = headers
        .get(CONTENT_LENGTH)
        .and_then(|length| length.to_str().ok());
    let length = length.and_then(|length| length.parse::<usize>().ok());
    if length.is_some_and(|length| length > MAX_BODY) {
        return Err(too_large());
    }
    Ok(())
}

/// Returns the problem of a body larger than [`MAX_BODY`].
pub(super) fn too_large() -> Problem {
    Problem::new(
        Code::BodyTooLarge,
        format!("at most {MAX_BODY} bytes are read"),
    )
}

#[cfg(test)]
mod tests;
