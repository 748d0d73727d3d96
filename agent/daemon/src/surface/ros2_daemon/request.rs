//! HTTP requests of the `ros2` command line, and the checks that refuse web pages.

use std::cell::OnceCell;
use std::convert::Infallible;
use std::fmt::Write as _;
use std::net::SocketAddr;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

use axum::body::{Body, Bytes, to_bytes};
use axum::http::header::{CONNECTION, CONTENT_TYPE, ORIGIN, USER_AGENT};
use axum::http::{HeaderMap, HeaderValue, Method, Request, Response, StatusCode};
use hyper::body::Incoming;
use hyper::server::conn::http1::Builder;
use hyper::service::service_fn;
use hyper_util::rt::TokioIo;
use ros2probe_message::Dialect;
use ros2probe_wire::DomainId;
use tokio::sync::{mpsc, oneshot};

use super::call::{self, Call, Malformed};
use super::client::Client;
use super::connection::{ConnectionState, Stream};
use super::figures::{ClientCount, Refused, Ros2DaemonFigures, port};
use super::function::{self, Query, SHUTDOWN};
use super::graph::Graph;
use super::peer::PeerProcess;
use super::value::{Fault, Value, answer};
use super::{Release, Task};
use crate::snapshot_cell::SnapshotCell;
use crate::surface::authority;
use crate::surface::large_responses::LargeResponses;

/// Path of the daemon.
const DAEMON_PATH: &str = "/ros2cli/";
/// Maximum size of a request's body, in bytes.
pub(super) const MAX_BODY: usize = 16 << 10;
/// Maximum size of a request's head in bytes, and maximum number of its fields.
const MAX_HEAD: usize = 8 << 10;
const MAX_FIELDS: usize = 32;
/// Maximum age of a state that is used without a refresh. A command sends several requests in quick
/// succession.
const MAX_STATE_AGE: Duration = Duration::from_millis(200);
/// Maximum time that a request waits for a fresh state.
const STATE_TIMEOUT: Duration = Duration::from_millis(300);
/// Bytes of the random part of the daemon's name.
const NAME_BYTES: usize = 16;

/// Large answers that are being created and read.
static LARGE_ANSWERS: LargeResponses = LargeResponses::new();

/// Handler of all requests.
#[derive(Debug)]
pub(super) struct Requests {
    latest: Arc<SnapshotCell>,
    figures: Arc<Ros2DaemonFigures>,
    distro: Option<Dialect>,
    releases: mpsc::Sender<Release>,
    /// Random part of the daemon's name.
    suffix: String,
}

/// Facts about the connection of a request.
#[derive(Debug)]
struct Origin {
    domain_id: u32,
    address: SocketAddr,
    process: OnceCell<PeerProcess>,
    state: Arc<ConnectionState>,
}

impl Requests {
    /// Creates the handler.
    pub(super) fn new(task: &Task, releases: mpsc::Sender<Release>) -> Self {
        let mut bytes = [0; NAME_BYTES];
        // Without random bytes the name is still valid.
        let _ = rustix::rand::getrandom(&mut bytes, rustix::rand::GetRandomFlags::empty());
        let mut suffix = String::new();
        for byte in bytes {
            let _ = write!(suffix, "{byte:02x}");
        }
        Self {
            latest: Arc::clone(&task.latest),
            figures: Arc::clone(&task.figures),
            distro: task.distro,
            releases,
            suffix,
        }
    }

    /// Counts a client.
    pub(super) fn join(&self) -> ClientCount {
        self.figures.join()
    }

    /// Serves the requests of a connection until its client closes it.
    pub(super) async fn serve(
        self: &Arc<Self>,
        stream: Stream,
        (domain_id, address): (u32, SocketAddr),
        state: &Arc<ConnectionState>,
    ) {
        let origin = Rc::new(Origin {
            domain_id,
            address,
            process: OnceCell::new(),
            state: Arc::clone(state),
        });
        let service = service_fn(|request: Request<Incoming>| {
            let (requests, origin) = (Arc::clone(self), Rc::clone(&origin));
            async move {
                let response = requests.respond(request, &origin).await;
                origin.state.answered();
                Ok::<_, Infallible>(response)
            }
        });
        // Disconnects of clients are not logged.
        let _ = Builder::new()
            .max_buf_size(MAX_HEAD)
            .max_headers(MAX_FIELDS)
            // The connection has a time limit of its own.
            .header_read_timeout(None::<Duration>)
            .serve_connection(TokioIo::new(stream), service)
            .await;
    }

    async fn respond(&self, request: Request<Incoming>, origin: &Origin) -> Response<Body> {
        let (head, body) = request.into_parts();
        if let Err((reason, status)) = check(&head.method, head.uri.path(), &head.headers) {
            self.figures.count_refusal(reason);
            return refusal(status);
        }
        let Ok(body) = to_bytes(Body::new(body), MAX_BODY).await else {
            self.figures.count_refusal(Refused::Size);
            return refusal(StatusCode::PAYLOAD_TOO_LARGE);
        };
        // Until this call, the connection counts as idle and can be closed for others, because its
        // client may never finish.
        origin.state.requested();
        let Some(turn) = LARGE_ANSWERS.permit().await else {
            self.figures.count_refusal(Refused::Memory);
            return refusal(StatusCode::SERVICE_UNAVAILABLE);
        };
        let user_agent = head
            .headers
            .get(USER_AGENT)
            .and_then(|value| value.to_str().ok());
        let (result, is_end) = match call::parse(&body) {
            Ok(call) => self.answer(&call, origin, user_agent).await,
            Err(malformed) => (Err(self.malformed(malformed)), false),
        };
        let body = turn.body(Bytes::from(answer(&result)));
        let mut response = Response::new(body);
        let headers = response.headers_mut();
        headers.insert(CONTENT_TYPE, HeaderValue::from_static("text/xml"));
        if is_end {
            headers.insert(CONNECTION, HeaderValue::from_static("close"));
        }
        response
    }

    /// Answers a call. Returns the result, and whether the connection ends because the call
    /// released the port.
    async fn answer(
        &self,
        call: &Call,
        origin: &Origin,
        user_agent: Option<&str>,
    ) -> (Result<Value, Fault>, bool) {
        self.figures.request(&call.method);
        let is_about_graph = !call.method.starts_with("system.");
        if is_about_graph && self.latest.state().agent.collected_at.elapsed() > MAX_STATE_AGE {
            self.latest.refresh(STATE_TIMEOUT).await;
        }
        let state = self.latest.state();
        let domain_id = DomainId(origin.domain_id);
        let name = format!("_ros2cli_daemon_{}_{}", origin.domain_id, self.suffix);
        let client = Client {
            process: &origin.process,
            ports: (
                origin.address.port(),
                port(origin.domain_id).unwrap_or_default(),
            ),
            configured: self.distro,
            user_agent,
            snapshot: state.known(),
            domain_id,
        };
        let query = Query {
            graph: Graph::new(state.known(), domain_id),
            domain_id,
            name: &name,
            caller: &client,
        };
        let result = function::answer(call, &query);
        let is_end = call.method == SHUTDOWN && result.is_ok();
        if is_end {
            self.release(origin).await;
        }
        (result, is_end)
    }

    /// Releases the port before the answer, so that the client's next attempt to connect fails.
    async fn release(&self, origin: &Origin) {
        origin.state.reset();
        let (done, closed) = oneshot::channel();
        let release = Release {
            domain_id: origin.domain_id,
            done,
        };
        if self.releases.send(release).await.is_ok() {
            let _ = closed.await;
        }
    }

    /// Counts a body that is not a call, and returns Python's exception for it.
    fn malformed(&self, malformed: Malformed) -> Fault {
        self.figures.count_refusal(Refused::Malformed);
        let class = match malformed {
            Malformed::Encoding | Malformed::Xml => "xml.parsers.expat.ExpatError",
            _ => "xmlrpc.client.ResponseError",
        };
        Fault::new(class, malformed.to_string())
    }
}

/// Checks that a request comes from a program of this host, not from a web page.
fn check(method: &Method, path: &str, headers: &HeaderMap) -> Result<(), (Refused, StatusCode)> {
    if authority::own(headers).is_err() {
        return Err((Refused::Host, StatusCode::FORBIDDEN));
    }
    if method != Method::POST {
        return Err((Refused::Path, StatusCode::NOT_IMPLEMENTED));
    }
    if path != DAEMON_PATH {
        return Err((Refused::Path, StatusCode::NOT_FOUND));
    }
    // A web page cannot send this media type to another origin without the permission of that
    // origin.
    let media_type = headers
        .get(CONTENT_TYPE)
        .and_then(|value| value.to_str().ok());
    let is_xml = media_type.is_some_and(|value| value.split(';').next() == Some("text/xml"));
    if headers.contains_key(ORIGIN) || !is_xml {
        return Err((Refused::Origin, StatusCode::FORBIDDEN));
    }
    Ok(())
}

/// Returns an answer with this status that ends the connection.
fn refusal(status: StatusCode) -> Response<Body> {
    let mut response = Response::new(Body::empty());
    *response.status_mut() = status;
    let close = HeaderValue::from_static("close");
    response.headers_mut().insert(CONNECTION, close);
    response
}
