//! The web page at `/`: files built into the program, and tokens that grant a page more rights than
//! its listener does.
//!
//! The files contain no data of the robot and need no token. Their content security policy
//! restricts loading and requests to this listener. Pages of other origins cannot embed or load
//! them.

mod tokens;

use std::net::SocketAddr;
use std::sync::{Arc, LazyLock, OnceLock};

use axum::body::{Body, Bytes};
use axum::extract::{Path, State};
use axum::http::header::{
    ACCEPT_ENCODING, CACHE_CONTROL, CONTENT_ENCODING, CONTENT_SECURITY_POLICY, CONTENT_TYPE, ETAG,
    HeaderName, IF_NONE_MATCH, REFERRER_POLICY, VARY, X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Json, Router};
use flate2::Compression;
use flate2::write::GzEncoder;
use ros2probe_api::health::PageToken;
use ros2probe_page::File;
use sha2::{Digest as _, Sha256};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::Context;
use super::problem::{Code, Problem};
pub(super) use tokens::Tokens;

/// The page can only load from and connect to its own origin.
const PAGE_POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' \
    data: blob:; connect-src 'self'; worker-src 'self'; manifest-src 'self'; base-uri 'none'; \
    form-action 'none'; frame-ancestors 'none'";
/// Headers of every file.
const PAGE_HEADERS: [(HeaderName, &str); 7] = [
    (CONTENT_SECURITY_POLICY, PAGE_POLICY),
    (X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (REFERRER_POLICY, "no-referrer"),
    (
        HeaderName::from_static("cross-origin-opener-policy"),
        "same-origin",
    ),
    (
        HeaderName::from_static("cross-origin-resource-policy"),
        "same-origin",
    ),
    // Browsers revalidate, so an upgrade of the agent takes effect immediately.
    (CACHE_CONTROL, "no-cache"),
    (VARY, "accept-encoding"),
];
/// Bytes of a file's hash that identify its version.
const TAG_BYTES: usize = 16;

/// State of the web page, shared by listeners and routes.
#[derive(Debug, Default)]
pub struct Page {
    /// Addresses that serve the page.
    addresses: Vec<SocketAddr>,
    pub(super) tokens: Tokens,
}

/// The files of the page with their derived forms.
static SERVED_FILES: LazyLock<Vec<Served>> = LazyLock::new(|| {
    let served = |file| Served {
        file,
        forms: OnceLock::new(),
    };
    ros2probe_page::FILES.iter().map(served).collect()
});

/// A file of the page.
struct Served {
    file: &'static File,
    forms: OnceLock<Forms>,
}

/// Forms of a file that are derived at the first request.
struct Forms {
    tag: String,
    packed: Bytes,
}

impl Page {
    /// Creates the state of a page that is served at `addresses`.
    #[must_use]
    pub fn new(addresses: Vec<SocketAddr>) -> Self {
        Self {
            addresses,
            tokens: Tokens::default(),
        }
    }

    /// Returns whether a listener serves the page.
    pub(super) const fn is_served(&self) -> bool {
        !self.addresses.is_empty()
    }

    /// Returns the address of the page on the agent's host; `None` if the page is not served.
    pub(super) fn address(&self) -> Option<String> {
        let is_near = |address: &&SocketAddr| address.ip().is_loopback();
        let near = self.addresses.iter().find(is_near);
        let address = near.or_else(|| self.addresses.first())?;
        Some(if address.ip().is_loopback() && address.is_ipv4() {
            format!("http://localhost:{}/", address.port())
        } else {
            format!("http://{address}/")
        })
    }
}

impl Served {
    fn forms(&self) -> &Forms {
        self.forms.get_or_init(|| {
            let hash = Sha256::digest(self.file.bytes);
            let tag = hash.iter().take(TAG_BYTES);
            Forms {
                tag: tag.map(|byte| format!("{byte:02x}")).collect(),
                packed: packed(self.file.bytes).into(),
            }
        })
    }

    /// Returns the file, or 304 if the client has the current version.
    fn answer(&'static self, headers: &HeaderMap) -> Response {
        let forms = self.forms();
        let is_packed = accepts_gzip(headers) && !forms.packed.is_empty();
        // A compressed form is another representation (RFC 9110, 8.8.3).
        let tag = match is_packed {
            true => format!("\"{}-gzip\"", forms.tag),
            false => format!("\"{}\"", forms.tag),
        };
        let known = headers.get_all(IF_NONE_MATCH).iter();
        let known = known.filter_map(|list| list.to_str().ok());
        let mut known = known.flat_map(|list| list.split(','));
        let is_known = known.any(|known| {
            let known = known.trim();
            known == "*" || known.trim_start_matches("W/") == tag
        });
        let always = (PAGE_HEADERS, [(ETAG, tag)]);
        if is_known {
            return (StatusCode::NOT_MODIFIED, always).into_response();
        }
        let kind = [(CONTENT_TYPE, self.file.media_type)];
        if is_packed {
            let encoding = [(CONTENT_ENCODING, "gzip")];
            let body = Body::from(forms.packed.clone());
            return (always.0, always.1, kind, encoding, body).into_response();
        }
        let body = Body::from(Bytes::from_static(self.file.bytes));
        (always.0, always.1, kind, body).into_response()
    }
}

/// Returns the compressed bytes, or an empty vector if compression saves nothing.
fn packed(bytes: &[u8]) -> Vec<u8> {
    let mut packer = GzEncoder::new(Vec::new(), Compression::best());
    let packed = std::io::Write::write_all(&mut packer, bytes).and_then(|()| packer.finish());
    let packed = packed.unwrap_or_default();
    if packed.len() < bytes.len() {
        packed
    } else {
        Vec::new()
    }
}

/// Returns whether the client accepts gzip (RFC 9110, 12.5.3).
fn accepts_gzip(headers: &HeaderMap) -> bool {
    let lists = headers.get_all(ACCEPT_ENCODING).iter();
    let lists = lists.filter_map(|list| list.to_str().ok());
    lists.flat_map(|list| list.split(',')).any(|coding| {
        let mut words = coding.split(';');
        let name = words.next().unwrap_or_default().trim();
        let is_refused = words.any(|word| {
            let quality = word.trim().strip_prefix("q=");
            quality.is_some_and(|quality| quality.parse() == Ok(0.0))
        });
        (name.eq_ignore_ascii_case("gzip") || name == "*") && !is_refused
    })
}

/// Returns the routes of the files, for listeners that serve the page.
pub(super) fn files() -> Router<Context> {
    Router::new()
        .route("/", get(index))
        .route("/page/{*file}", get(file))
}

async fn index(headers: HeaderMap) -> Response {
    find("index.html", &headers)
}

async fn file(Path(path): Path<String>, headers: HeaderMap) -> Response {
    find(&path, &headers)
}

fn find(path: &str, headers: &HeaderMap) -> Response {
    let file = SERVED_FILES.iter().find(|served| served.file.path == path);
    let missing = || Problem::new(Code::NotFound, "the page has no such file").into_response();
    file.map_or_else(missing, |file| file.answer(headers))
}

/// Returns the API routes of the page.
pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(token))
}

/// Create a token for the page
///
/// The token grants the rights of the unix socket, such as payloads, recordings and downloads. `rp
/// page` requests one.
#[utoipa::path(
    post,
    path = "/page/token",
    tag = "agent",
    responses((status = 200, description = "A new token.", body = PageToken))
)]
async fn token(State(context): State<Context>) -> Result<Json<PageToken>, Problem> {
    let token = context.page.tokens.create();
    let token = token.map_err(|error| Problem::new(Code::StorageRefuses, error.to_string()))?;
    Ok(Json(PageToken {
        token,
        address: context.page.address(),
    }))
}

/// The page, shared among listeners and routes.
pub(super) type Shared = Arc<Page>;

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::fs;

    use super::*;

    /// Maximum total size of the compressed files, in bytes.
    const BUDGET: usize = 190_000;

    fn headers(pairs: &[(&HeaderName, &str)]) -> HeaderMap {
        let pairs = pairs.iter();
        pairs
            .map(|(name, value)| ((*name).clone(), value.parse().unwrap()))
            .collect()
    }

    /// Collects the files of a folder that should be served.
    fn listed(folder: &std::path::Path, prefix: &str, into: &mut BTreeSet<String>) {
        for entry in fs::read_dir(folder).unwrap() {
            let entry = entry.unwrap();
            let name = entry.file_name().into_string().unwrap();
            let path = format!("{prefix}{name}");
            if entry.file_type().unwrap().is_dir() {
                if path != "test" {
                    listed(&entry.path(), &format!("{path}/"), into);
                }
                continue;
            }
            let kinds = [
                "html",
                "css",
                "js",
                "mjs",
                "svg",
                "json",
                "png",
                "ico",
                "webmanifest",
            ];
            let end = name.rsplit_once('.').map_or("", |(_, end)| end);
            if kinds.contains(&end) {
                into.insert(path);
            }
        }
    }

    #[test]
    fn every_file_of_the_folder_is_served_and_no_other() {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../page");
        let mut expected = BTreeSet::new();
        listed(&folder, "", &mut expected);
        let served: BTreeSet<_> = SERVED_FILES
            .iter()
            .map(|served| served.file.path.to_owned())
            .collect();
        assert_eq!(served, expected);
        assert!(served.contains("index.html"));
        for file in SERVED_FILES.iter().map(|served| served.file) {
            let (_, end) = file.path.rsplit_once('.').unwrap();
            let expected = match end {
                "html" => "text/html; charset=utf-8",
                "css" => "text/css; charset=utf-8",
                "js" | "mjs" => "text/javascript; charset=utf-8",
                "svg" => "image/svg+xml",
                other => panic!("no media type for {other}"),
            };
            assert_eq!(file.media_type, expected, "{}", file.path);
            assert_eq!(
                file.bytes,
                fs::read(folder.join(file.path)).unwrap(),
                "{}",
                file.path
            );
        }
    }

    #[test]
    fn the_compressed_page_stays_within_its_size_budget() {
        let sizes = SERVED_FILES
            .iter()
            .map(|served| match served.forms().packed.len() {
                0 => served.file.bytes.len(),
                packed => packed,
            });
        let all: usize = sizes.sum();
        println!("{all} bytes");
        assert!(all <= BUDGET, "{all} bytes");
    }

    #[test]
    fn a_file_that_the_client_has_is_not_sent_again() {
        let file = SERVED_FILES
            .iter()
            .find(|served| served.file.path == "index.html")
            .unwrap();
        let first = file.answer(&HeaderMap::new());
        assert_eq!(first.status(), StatusCode::OK);
        let tag = first.headers()[ETAG].to_str().unwrap().to_owned();
        let again = file.answer(&headers(&[(&IF_NONE_MATCH, &format!("\"other\", {tag}"))]));
        assert_eq!(again.status(), StatusCode::NOT_MODIFIED);
        assert_eq!(again.headers()[ETAG], tag.as_str());
        let packed = file.answer(&headers(&[
            (&IF_NONE_MATCH, &tag),
            (&ACCEPT_ENCODING, "br, gzip;q=0.8"),
        ]));
        assert_eq!(packed.status(), StatusCode::OK);
        assert_eq!(packed.headers()[CONTENT_ENCODING], "gzip");
        assert_ne!(packed.headers()[ETAG], tag.as_str());
    }

    #[test]
    fn gzip_is_sent_to_clients_that_accept_it() {
        for (given, expected) in [
            ("gzip", true),
            ("deflate, GZIP;q=1", true),
            ("*", true),
            ("gzip;q=0", false),
            ("identity", false),
            ("", false),
        ] {
            let headers = headers(&[(&ACCEPT_ENCODING, given)]);
            assert_eq!(accepts_gzip(&headers), expected, "{given}");
        }
    }

    #[test]
    fn the_page_address_is_that_of_a_loopback_listener_if_one_exists() {
        let page = |addresses: &[&str]| {
            let addresses = addresses.iter().map(|address| address.parse().unwrap());
            Page::new(addresses.collect()).address()
        };
        assert_eq!(page(&[]), None);
        let near = page(&["10.0.0.1:17401", "127.0.0.1:1"]);
        assert_eq!(near.as_deref(), Some("http://localhost:1/"));
        assert_eq!(page(&["[::1]:5"]).as_deref(), Some("http://[::1]:5/"));
        assert_eq!(page(&["10.0.0.1:5"]).as_deref(), Some("http://10.0.0.1:5/"));
    }
}
