//! The metrics listener: read-only, bounded in connections and idle time. `metrics.web_config` can
//! restrict it to certain clients.

use std::io;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::extract::{Extension, Request, State as Extract};
use axum::http::header::{
    ACCEPT, ACCEPT_ENCODING, CACHE_CONTROL, CONNECTION, CONTENT_ENCODING, CONTENT_LENGTH,
    CONTENT_TYPE, HOST, RETRY_AFTER, VARY,
};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode};
use axum::middleware::{self, Next};
use axum::response::{Html, IntoResponse, Response};
use axum::routing::get;
use tokio::net::{TcpListener, TcpStream};
use tokio_util::sync::CancellationToken;

use super::authority;
use super::basic_auth::{self, Gate};
use super::collect::MetricSources;
use super::compressed_text::{Encoding, TextCompressor};
use super::connection::Connection;
use super::large_responses::LargeResponses;
use super::limited_listener::{LimitedListener, Refusal};
use super::listen::listen;
use super::serving::{self, Plain};
use super::tls::Acceptor;
use super::web_config::{WebConfig, WebConfigError};
use crate::config::Limit;
use crate::limit_facts::LimitFigures;
use crate::snapshot_cell::SnapshotCell;
use ros2probe_metrics::exposition::{Exposition, Format};

const INDEX_PAGE: &str = "<!doctype html><title>ros2probe</title><h1>ros2probe</h1>
<p>Watches the ROS 2 robot on this host from copies of its traffic.
<ul><li><a href=\"/metrics\">/metrics</a> for Prometheus
<li><a href=\"/readyz\">/readyz</a> whether the agent observes the robot: 200, or 503 with the reason
<li><a href=\"/livez\">/livez</a> whether the capture makes progress: 200, or 503 with the reason
<li><a href=\"/healthz\">/healthz</a> whether the process runs</ul>
";

/// Why the listener cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum ListenError {
    /// The address is in use, or is a local one that this host does not have.
    #[error(
        "cannot listen on {address}: change `metrics.listen` in the configuration or pass \
         `--metrics`"
    )]
    Address {
        /// The address.
        address: SocketAddr,
        /// Error of the operating system.
        source: io::Error,
    },
    /// `metrics.web_config` cannot be applied.
    #[error(transparent)]
    Web(#[from] WebConfigError),
    /// TLS cannot be set up.
    #[error(transparent)]
    Tls(#[from] super::tls::TlsError),
}

/// A bound listener that is not served yet.
#[derive(Debug)]
pub struct Server {
    listener: std::net::TcpListener,
    sources: MetricSources,
    gate: Option<Arc<Gate>>,
    acceptor: Option<Acceptor>,
}

#[derive(Clone)]
struct Pages {
    latest: Arc<SnapshotCell>,
    limits: Arc<LimitFigures>,
    exposition: Arc<Exposition>,
}

impl Server {
    /// Binds the address without a runtime. The file `web_config` restricts the clients.
    ///
    /// # Errors
    /// Fails if the address cannot be bound, or if the file cannot be applied.
    pub fn bind(
        address: SocketAddr,
        web_config: Option<&Path>,
        sources: MetricSources,
    ) -> Result<Self, ListenError> {
        let web = web_config.map(WebConfig::load).transpose()?;
        let web = web.unwrap_or_default();
        let gate = (!web.users.is_empty()).then(|| Arc::new(Gate::new(web.users)));
        let acceptor = web.tls.as_ref().map(Acceptor::new).transpose()?;
        let listener =
            listen(address).map_err(|source| ListenError::Address { address, source })?;
        Ok(Self {
            listener,
            sources,
            gate,
            acceptor,
        })
    }

    /// Returns the address, with the port that the kernel chose for port 0.
    ///
    /// # Errors
    /// Fails if the kernel does not return the address.
    pub fn local_addr(&self) -> io::Result<SocketAddr> {
        self.listener.local_addr()
    }

    /// Serves requests until `stop`, then completes the answers in progress.
    ///
    /// # Errors
    /// Fails if the runtime cannot take over the socket.
    pub async fn serve(self, stop: CancellationToken) -> io::Result<()> {
        let limit = Limit::MetricsClients;
        let connections = self.sources.limits.caps().get(limit);
        let full = Refusal::new(
            "text/plain; charset=utf-8",
            &format!(
                "{connections} connections are open, which is the limit (limits.metrics_clients)\n"
            ),
        );
        // A client that expects a TLS handshake cannot read a plain answer.
        let full = self.acceptor.is_none().then_some(full);
        let listener = TcpListener::from_std(self.listener)?;
        let listener =
            LimitedListener::new(listener, Arc::clone(&self.sources.limits), limit, full);
        let mut router = router(self.sources);
        if let Some(gate) = self.gate {
            router = router.layer(middleware::from_fn_with_state(gate, basic_auth::guard));
        }
        let router = router.layer(middleware::from_fn(own_names));
        if let Some(acceptor) = self.acceptor {
            serving::serve(listener, acceptor, router, Local::of, stop).await;
            return Ok(());
        }
        serving::serve(listener, Plain, router, Local::of, stop).await;
        Ok(())
    }
}

/// Whether a connection uses loopback.
#[derive(Clone, Copy, Debug)]
struct Local(bool);

impl Local {
    fn of(connection: &Connection<TcpStream>) -> Self {
        let address = connection.stream().local_addr();
        // A connection without an address is broken, and needs no answer.
        Self(address.is_ok_and(|address| address.ip().to_canonical().is_loopback()))
    }
}

/// Rejects requests over loopback that are not for this host's own names. A web page could make a
/// browser on this host resolve its name to loopback. The agent does not know the names of other
/// addresses.
async fn own_names(Extension(local): Extension<Local>, request: Request, next: Next) -> Response {
    let headers = request.headers();
    // A client without the header is not a browser.
    if local.0 && headers.contains_key(HOST) && authority::own(headers).is_err() {
        let reason = "the request is for another host; this listener answers to localhost and \
                      loopback addresses\n";
        let close = [(CONNECTION, HeaderValue::from_static("close"))];
        return (StatusCode::FORBIDDEN, close, reason).into_response();
    }
    next.run(request).await
}

fn router(sources: MetricSources) -> Router {
    let (latest, limits) = (Arc::clone(&sources.latest), Arc::clone(&sources.limits));
    let exposition = Arc::new(Exposition::new(sources));
    Router::new()
        .route("/", get(async || Html(INDEX_PAGE)))
        .route("/metrics", get(metrics))
        .route("/healthz", get(async || "ok\n"))
        .route("/readyz", get(readyz))
        .route("/livez", get(livez))
        .fallback(async || (StatusCode::NOT_FOUND, "not found; see /\n"))
        .method_not_allowed_fallback(async |method: Method| {
            (
                StatusCode::METHOD_NOT_ALLOWED,
                format!("{method} is not allowed; use GET\n"),
            )
        })
        .with_state(Pages {
            latest,
            limits,
            exposition,
        })
}

/// Pages that are being created and read.
static METRICS_RESPONSES: LargeResponses = LargeResponses::new();

/// Maximum time that a scrape waits for a fresh snapshot. The capture thread usually responds
/// immediately.
const REFRESH_TIMEOUT: Duration = Duration::from_millis(600);

async fn metrics(Extract(pages): Extract<Pages>, headers: HeaderMap) -> Response {
    let accepts: Vec<&str> = headers
        .get_all(ACCEPT)
        .iter()
        .filter_map(|value| value.to_str().ok())
        .collect();
    let format = Format::negotiate(&accepts.join(","));
    let encoding = encoding(&headers);
    pages.latest.refresh(REFRESH_TIMEOUT).await;
    let Some(turn) = METRICS_RESPONSES.permit().await else {
        pages.limits.reached(Limit::MetricsClients, 1);
        let reason = "too many pages are being rendered
";
        return (
            StatusCode::SERVICE_UNAVAILABLE,
            [(RETRY_AFTER, "1")],
            reason,
        )
            .into_response();
    };
    let mut packer = TextCompressor::new(encoding);
    let written = pages.exposition.write(format, &mut packer);
    let (Ok(()), Ok(page)) = (written, packer.finish()) else {
        return StatusCode::INTERNAL_SERVER_ERROR.into_response();
    };
    let mut answer = (
        [
            (CONTENT_TYPE, format.content_type()),
            (CACHE_CONTROL, "no-store"),
            (VARY, "accept, accept-encoding"),
        ],
        [(CONTENT_LENGTH, page.len())],
        turn.compressed_body(page),
    )
        .into_response();
    if encoding == Encoding::Gzip {
        let gzip = HeaderValue::from_static("gzip");
        answer.headers_mut().insert(CONTENT_ENCODING, gzip);
    }
    answer
}

/// Returns the encoding that the client accepts (RFC 9110, 12.5.3).
fn encoding(headers: &HeaderMap) -> Encoding {
    let lists = headers.get_all(ACCEPT_ENCODING).iter();
    let lists = lists.filter_map(|list| list.to_str().ok());
    let (mut gzip, mut any) = (None, None);
    for offer in lists.flat_map(|list| list.split(',')) {
        let (coding, weight) = offer.split_once(';').unwrap_or((offer, ""));
        let weight = weight.trim().strip_prefix("q=");
        let accepted = weight.is_none_or(|weight| weight.parse().is_ok_and(|q: f32| q > 0.0));
        match coding.trim() {
            name if name.eq_ignore_ascii_case("gzip") => gzip = Some(accepted),
            "*" => any = Some(accepted),
            _ => {}
        }
    }
    if gzip.or(any) == Some(true) {
        Encoding::Gzip
    } else {
        Encoding::Identity
    }
}

async fn readyz(Extract(pages): Extract<Pages>) -> Response {
    let state = pages.latest.own_state();
    match state.ready(Instant::now()) {
        Ok(()) => match pages.limits.degraded(&state) {
            Some(reason) => format!("ready\ndegraded: {reason}\n").into_response(),
            None => "ready\n".into_response(),
        },
        Err(reason) => (StatusCode::SERVICE_UNAVAILABLE, format!("{reason}\n")).into_response(),
    }
}

/// Answers as the watchdog of the service: a restart would not help an agent whose interface or
/// control group is gone.
async fn livez(Extract(pages): Extract<Pages>) -> Response {
    match pages.latest.own_state().progresses(Instant::now()) {
        Ok(()) => "alive\n".into_response(),
        Err(reason) => (StatusCode::SERVICE_UNAVAILABLE, format!("{reason}\n")).into_response(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::agent_facts::{AgentFacts, SourceKind};
    use crate::settings_cell::Settings;
    use ros2probe_model::report::snapshot::Snapshot;

    #[tokio::test]
    async fn an_agent_without_its_interface_is_alive_but_not_ready() {
        let sources = MetricSources::new(SourceKind::Wire, Settings::default());
        let pages = Pages {
            latest: Arc::clone(&sources.latest),
            limits: Arc::clone(&sources.limits),
            exposition: Arc::new(Exposition::new(sources)),
        };
        let (ok, unready) = (StatusCode::OK, StatusCode::SERVICE_UNAVAILABLE);
        let publish = |missing: Option<&str>, begun: Instant| {
            let agent = AgentFacts {
                missing_object: missing.map(str::to_owned),
                ..AgentFacts::new(SourceKind::Wire, begun)
            };
            pages.latest.publish(Snapshot::default(), agent);
        };
        let status = async || {
            let ready = readyz(Extract(pages.clone())).await.status();
            (ready, livez(Extract(pages.clone())).await.status())
        };
        assert_eq!(status().await, (unready, unready));
        publish(None, Instant::now());
        assert_eq!(status().await, (ok, ok));
        publish(Some("the interface eth0 is gone"), Instant::now());
        assert_eq!(status().await, (unready, ok));
        let stuck = Instant::now().checked_sub(Duration::from_mins(1));
        publish(None, stuck.unwrap());
        assert_eq!(status().await, (unready, unready));
    }

    #[test]
    fn a_page_is_compressed_if_the_client_accepts_gzip() {
        for (accepted, expected) in [
            ("gzip", Encoding::Gzip),
            ("deflate, GZIP;q=0.5, br", Encoding::Gzip),
            ("*", Encoding::Gzip),
            ("gzip;q=0", Encoding::Identity),
            ("gzip; q=0.0, *", Encoding::Identity),
            ("*;q=0", Encoding::Identity),
            ("identity", Encoding::Identity),
            ("gzip;q=x", Encoding::Identity),
            ("", Encoding::Identity),
        ] {
            let headers = [(ACCEPT_ENCODING, accepted.parse().unwrap())];
            let headers = headers.into_iter().collect();
            assert_eq!(encoding(&headers), expected, "{accepted}");
        }
        assert_eq!(encoding(&HeaderMap::new()), Encoding::Identity);
    }
}
