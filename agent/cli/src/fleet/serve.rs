//! Serves the page of a fleet on loopback. The engine is queried only while a browser has it open.

use std::convert::Infallible;
use std::io;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use http_body_util::Full;
use hyper::body::Incoming;
use hyper::header::{
    ALLOW, CACHE_CONTROL, CONTENT_TYPE, HeaderValue, REFERRER_POLICY, X_CONTENT_TYPE_OPTIONS,
};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use jiff::Timestamp;
use ros2probe_api::fleet::Fleet;
use ros2probe_daemon::fleet::{Known, Link, POLL_INTERVAL, Reader, Sources};
use ros2probe_daemon::surface::authority;
use tokio::runtime::Builder;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::Semaphore;
use tokio::time::timeout;

use super::page::{Content, html};

/// Maximum number of connections. Further ones wait.
const MAX_CONNECTIONS: usize = 64;
/// Maximum time for the header of a request, and for a whole connection.
const HEADER_TIMEOUT: Duration = Duration::from_secs(5);
const CONNECTION_TIMEOUT: Duration = Duration::from_secs(30);
/// Maximum age of the state that `/fleet.json` has.
const MAX_AGE: Duration = Duration::from_secs(30);
/// Pause before the browser reads the page again while the engine has not answered.
const FIRST_REFRESH: Duration = Duration::from_secs(2);

/// The page of a fleet, which is not served yet.
#[derive(Debug)]
pub struct Page {
    listener: TcpListener,
    link: Option<Link>,
}

/// Why the page cannot be served.
#[derive(Debug, thiserror::Error)]
pub enum PageError {
    /// Every host that reaches the address could read the page.
    #[error("{0} is not a loopback address: use 127.0.0.1, and a tunnel or a proxy with passwords")]
    Exposed(SocketAddr),
    /// The address is in use.
    #[error("cannot listen on {address}")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// Error of the operating system.
        source: io::Error,
    },
    /// No runtime or thread starts.
    #[error("cannot serve the page")]
    Serve(#[from] io::Error),
}

impl Page {
    /// Binds a loopback address. With `link`, names of robots lead to their pages.
    ///
    /// # Errors
    ///
    /// Fails for another address, and if it is in use.
    pub fn bind(address: SocketAddr, link: Option<Link>) -> Result<Self, PageError> {
        if !address.ip().to_canonical().is_loopback() {
            return Err(PageError::Exposed(address));
        }
        let listener = TcpListener::bind(address);
        let listener = listener.and_then(|listener| {
            listener.set_nonblocking(true)?;
            Ok(listener)
        });
        let listener = listener.map_err(|source| PageError::Listen { address, source })?;
        Ok(Self { listener, link })
    }

    /// Returns the address, with the port that the kernel chose for port 0.
    ///
    /// # Errors
    ///
    /// Fails if the kernel does not return it.
    pub fn local_addr(&self) -> io::Result<SocketAddr> {
        self.listener.local_addr()
    }

    /// Serves the page until SIGINT or SIGTERM.
    ///
    /// # Errors
    ///
    /// Fails if no runtime or thread starts.
    pub fn serve(self, sources: Sources) -> Result<(), PageError> {
        let reader = Arc::new(Reader::new(self.link, &sources));
        let polled = Arc::clone(&reader);
        let polling = Builder::new_current_thread().enable_all().build()?;
        let thread = std::thread::Builder::new().name("engine".to_owned());
        thread.spawn(move || polling.block_on(polled.poll(sources)))?;
        let runtime = Builder::new_current_thread().enable_all().build()?;
        runtime.block_on(async {
            let listener = tokio::net::TcpListener::from_std(self.listener)?;
            let mut terminated = signal(SignalKind::terminate())?;
            let mut interrupted = signal(SignalKind::interrupt())?;
            tokio::select! {
                () = accept(listener, reader) => {}
                _ = terminated.recv() => {}
                _ = interrupted.recv() => {}
            }
            Ok(())
        })
    }
}

async fn accept(listener: tokio::net::TcpListener, reader: Arc<Reader>) {
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    loop {
        // The semaphore is never closed.
        let Ok(place) = Arc::clone(&places).acquire_owned().await else {
            return;
        };
        let Ok((stream, _)) = listener.accept().await else {
            // Too many open files: a connection will end.
            tokio::time::sleep(Duration::from_millis(100)).await;
            continue;
        };
        let reader = Arc::clone(&reader);
        tokio::spawn(async move {
            let answer = service_fn(|request: Request<Incoming>| {
                let response = response(&request, &reader);
                async { Ok::<_, Infallible>(response) }
            });
            let mut server = http1::Builder::new();
            server
                .timer(TokioTimer::new())
                .header_read_timeout(HEADER_TIMEOUT)
                .keep_alive(false);
            // A client that went away needs no answer.
            let connection = server.serve_connection(TokioIo::new(stream), answer);
            let _ = timeout(CONNECTION_TIMEOUT, connection).await;
            drop(place);
        });
    }
}

fn response(request: &Request<Incoming>, reader: &Reader) -> Response<Full<Bytes>> {
    if authority::own(request.headers()).is_err() {
        return refusal(
            StatusCode::FORBIDDEN,
            "this page answers to localhost and loopback addresses\n",
        );
    }
    if ![Method::GET, Method::HEAD].contains(request.method()) {
        let mut refused = refusal(StatusCode::METHOD_NOT_ALLOWED, "only GET\n");
        refused
            .headers_mut()
            .insert(ALLOW, HeaderValue::from_static("GET, HEAD"));
        return refused;
    }
    match request.uri().path() {
        "/" => {
            let Known {
                fleet,
                problem,
                incidents,
                ..
            } = reader.ask();
            let is_paused = request.uri().query() == Some("paused");
            let refresh = match fleet {
                Some(_) => POLL_INTERVAL,
                None => FIRST_REFRESH,
            };
            let page = html(&Content {
                fleet: fleet.as_ref().map(|(fleet, at)| (&**fleet, *at)),
                problem: problem.as_deref(),
                incidents: incidents.as_deref(),
                refresh: (!is_paused).then_some(refresh),
            });
            answer(StatusCode::OK, "text/html; charset=utf-8", page)
        }
        "/fleet.json" => {
            let Known {
                fleet,
                problem,
                incidents,
                ..
            } = reader.ask();
            let is_fresh = |at: &Timestamp| {
                let age = Timestamp::now().duration_since(*at);
                age.unsigned_abs() < MAX_AGE
            };
            let fleet = fleet.filter(|(_, at)| is_fresh(at));
            let (Some((fleet, _)), None) = (fleet, &problem) else {
                let problem = problem.as_deref();
                let problem = problem.unwrap_or("the engine is asked: try again in a second");
                return refusal(StatusCode::SERVICE_UNAVAILABLE, &format!("{problem}\n"));
            };
            // Numbers and texts cannot fail to serialize.
            let fleet = Fleet {
                incidents: incidents.as_deref().cloned(),
                ..(*fleet).clone()
            };
            let text = serde_json::to_string_pretty(&fleet).unwrap_or_default();
            answer(StatusCode::OK, "application/json", text + "\n")
        }
        _ => refusal(StatusCode::NOT_FOUND, "only / and /fleet.json\n"),
    }
}

fn refusal(status: StatusCode, text: &str) -> Response<Full<Bytes>> {
    answer(status, "text/plain; charset=utf-8", text.to_owned())
}

fn answer(status: StatusCode, content_type: &'static str, text: String) -> Response<Full<Bytes>> {
    let mut response = Response::new(Full::new(Bytes::from(text)));
    *response.status_mut() = status;
    for (name, value) in [
        (CONTENT_TYPE, content_type),
        (CACHE_CONTROL, "no-store"),
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (REFERRER_POLICY, "no-referrer"),
    ] {
        let value = HeaderValue::from_static(value);
        response.headers_mut().insert(name, value);
    }
    response
}
