//! A receiver of Prometheus remote write that answers as a test requires. Its messages are declared
//! here again, so that it decodes bodies independently of the agent.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use http_body_util::{BodyExt as _, Full};
use hyper::body::{Bytes, Incoming};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Request, Response};
use hyper_util::rt::TokioIo;
use prost::Message as _;
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Runtime;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::ServerConfig;

/// Maximum wait for samples.
const PATIENCE: Duration = Duration::from_secs(90);

/// A series: `__name__` and the other labels.
pub type Labels = BTreeMap<String, String>;

/// A request with samples.
#[derive(Clone, Debug, Default)]
pub struct Write {
    /// Header with the version of the protocol.
    pub version: String,
    /// Header `Authorization`.
    pub authorization: String,
    /// Length of the compressed body.
    pub length: usize,
    /// Samples of each series: milliseconds since 1970, and values.
    pub series: Vec<(Labels, Vec<(i64, f64)>)>,
    /// Types of metrics by name, as numbers of version 2.0.
    pub kinds: BTreeMap<String, i32>,
}

/// An answer.
#[derive(Clone, Debug)]
pub struct Reply {
    pub status: u16,
    pub headers: Vec<(&'static str, String)>,
    /// Whether the receiver keeps the samples.
    pub stores: bool,
    pub text: String,
}

type Answer = Box<dyn FnMut(&Write) -> Reply + Send>;

/// A running receiver; dropping the value ends it.
pub struct Receiver {
    pub address: SocketAddr,
    state: Arc<Mutex<State>>,
    _runtime: Runtime,
}

struct State {
    answer: Answer,
    /// What it stored.
    stored: Vec<Write>,
}

impl Write {
    /// Returns the number of samples.
    #[must_use]
    pub fn samples(&self) -> usize {
        self.series.iter().map(|(_, samples)| samples.len()).sum()
    }

    /// Returns the samples of the series of this name without further labels than those of a robot.
    #[must_use]
    pub fn of(&self, name: &str) -> &[(i64, f64)] {
        let found = self
            .series
            .iter()
            .find(|(labels, _)| labels["__name__"] == name);
        found.map_or(&[], |(_, samples)| samples)
    }
}

impl Reply {
    /// Returns the answer of a receiver that stores all samples, and knows the version.
    #[must_use]
    pub fn stored(write: &Write) -> Self {
        let headers = match write.version.as_str() {
            "2.0.0" => vec![(
                "X-Prometheus-Remote-Write-Samples-Written",
                write.samples().to_string(),
            )],
            _ => Vec::new(),
        };
        Self {
            status: 204,
            headers,
            stores: true,
            text: String::new(),
        }
    }

    /// Returns an answer with a status, without storing.
    #[must_use]
    pub fn status(status: u16) -> Self {
        Self {
            status,
            headers: Vec::new(),
            stores: false,
            text: "as the test demands".to_owned(),
        }
    }
}

impl Receiver {
    /// Starts a receiver on a free port of this host.
    #[must_use]
    pub fn start(answer: impl FnMut(&Write) -> Reply + Send + 'static) -> Self {
        Self::listen(free_port(), None, answer)
    }

    /// Starts a receiver on a listener, such as that of another host.
    #[must_use]
    pub fn start_on(
        listener: std::net::TcpListener,
        answer: impl FnMut(&Write) -> Reply + Send + 'static,
    ) -> Self {
        Self::listen(listener, None, answer)
    }

    /// Starts a receiver with TLS.
    #[must_use]
    pub fn start_tls(
        config: ServerConfig,
        answer: impl FnMut(&Write) -> Reply + Send + 'static,
    ) -> Self {
        Self::listen(
            free_port(),
            Some(TlsAcceptor::from(Arc::new(config))),
            answer,
        )
    }

    fn listen(
        listener: std::net::TcpListener,
        tls: Option<TlsAcceptor>,
        answer: impl FnMut(&Write) -> Reply + Send + 'static,
    ) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let address = listener.local_addr().unwrap();
        listener.set_nonblocking(true).unwrap();
        let state = Arc::new(Mutex::new(State {
            answer: Box::new(answer),
            stored: Vec::new(),
        }));
        let shared = Arc::clone(&state);
        runtime.spawn(async move {
            let listener = TcpListener::from_std(listener).unwrap();
            loop {
                let (stream, _) = listener.accept().await.unwrap();
                tokio::spawn(serve(stream, tls.clone(), Arc::clone(&shared)));
            }
        });
        Self {
            address,
            state,
            _runtime: runtime,
        }
    }

    /// Changes its answers.
    pub fn answer(&self, answer: impl FnMut(&Write) -> Reply + Send + 'static) {
        self.state.lock().unwrap().answer = Box::new(answer);
    }

    /// Stores each request that does not have a certain sample, and refuses the others. Like
    /// Prometheus 2, it stores nothing of a request with the refused sample: the one in the middle of
    /// `up` in the first request that has more than two.
    pub fn refuse_one_sample(&self) {
        let mut refused = None;
        self.answer(move |write| {
            let times = write.of("up");
            if times.len() > 2 {
                refused.get_or_insert(times[times.len() / 2].0);
            }
            match times.iter().any(|(at, _)| Some(*at) == refused) {
                true => Reply::status(400),
                false => Reply::stored(write),
            }
        });
    }

    /// Returns what it stored, by request.
    #[must_use]
    pub fn stored(&self) -> Vec<Write> {
        self.state.lock().unwrap().stored.clone()
    }

    /// Returns all stored samples of a series, in the order in which they came.
    #[must_use]
    pub fn of(&self, name: &str) -> Vec<(i64, f64)> {
        let stored = self.stored();
        stored
            .iter()
            .flat_map(|write| write.of(name).to_vec())
            .collect()
    }

    /// Waits until `wanted` accepts what was stored.
    ///
    /// # Panics
    ///
    /// Panics if that takes too long.
    pub fn wait_for(&self, what: &str, wanted: impl Fn(&[Write]) -> bool) {
        let deadline = Instant::now() + PATIENCE;
        while !wanted(&self.state.lock().unwrap().stored) {
            assert!(Instant::now() < deadline, "no {what}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

fn free_port() -> std::net::TcpListener {
    std::net::TcpListener::bind("127.0.0.1:0").unwrap()
}

async fn serve(stream: TcpStream, tls: Option<TlsAcceptor>, state: Arc<Mutex<State>>) {
    let service = service_fn(move |request| answer(request, Arc::clone(&state)));
    let http = http1::Builder::new();
    // A client may end the handshake or the connection.
    match tls {
        None => drop(http.serve_connection(TokioIo::new(stream), service).await),
        Some(tls) => {
            if let Ok(stream) = tls.accept(stream).await {
                drop(http.serve_connection(TokioIo::new(stream), service).await);
            }
        }
    }
}

async fn answer(
    request: Request<Incoming>,
    state: Arc<Mutex<State>>,
) -> Result<Response<Full<Bytes>>, Infallible> {
    let header = |name: &str| {
        let value = request.headers().get(name);
        value.map_or_else(String::new, |value| value.to_str().unwrap().to_owned())
    };
    assert_eq!(request.uri().path(), "/api/v1/write");
    assert_eq!(header("content-encoding"), "snappy");
    let (version, kind) = (
        header("x-prometheus-remote-write-version"),
        header("content-type"),
    );
    let authorization = header("authorization");
    let body = request.into_body().collect().await.unwrap().to_bytes();
    let message = snap::raw::Decoder::new().decompress_vec(&body).unwrap();
    let mut write = match version.as_str() {
        "2.0.0" => {
            let version_two = "application/x-protobuf;proto=io.prometheus.write.v2.Request";
            assert_eq!(kind, version_two);
            RequestTwo::decode(&*message).unwrap().read()
        }
        _ => {
            assert_eq!(
                (version.as_str(), kind.as_str()),
                ("0.1.0", "application/x-protobuf")
            );
            RequestOne::decode(&*message).unwrap().read()
        }
    };
    write.version = version;
    write.authorization = authorization;
    write.length = body.len();
    let mut state = state.lock().unwrap();
    let reply = (state.answer)(&write);
    if reply.stores {
        state.stored.push(write);
    }
    let mut response = Response::builder().status(reply.status);
    for (name, value) in reply.headers {
        response = response.header(name, value);
    }
    Ok(response.body(Full::new(Bytes::from(reply.text))).unwrap())
}

#[derive(prost::Message)]
struct RequestOne {
    #[prost(message, repeated, tag = "1")]
    timeseries: Vec<SeriesOne>,
}

#[derive(prost::Message)]
struct SeriesOne {
    #[prost(message, repeated, tag = "1")]
    labels: Vec<Label>,
    #[prost(message, repeated, tag = "2")]
    samples: Vec<Sample>,
}

#[derive(prost::Message)]
struct Label {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(string, tag = "2")]
    value: String,
}

#[derive(prost::Message)]
struct Sample {
    #[prost(double, tag = "1")]
    value: f64,
    #[prost(int64, tag = "2")]
    timestamp: i64,
}

#[derive(prost::Message)]
struct RequestTwo {
    #[prost(string, repeated, tag = "4")]
    symbols: Vec<String>,
    #[prost(message, repeated, tag = "5")]
    timeseries: Vec<SeriesTwo>,
}

#[derive(prost::Message)]
struct SeriesTwo {
    #[prost(uint32, repeated, tag = "1")]
    labels_refs: Vec<u32>,
    #[prost(message, repeated, tag = "2")]
    samples: Vec<Sample>,
    #[prost(message, optional, tag = "5")]
    metadata: Option<Metadata>,
}

#[derive(prost::Message)]
struct Metadata {
    #[prost(int32, tag = "1")]
    kind: i32,
}

impl RequestOne {
    fn read(self) -> Write {
        let series = self.timeseries.into_iter().map(|series| {
            let labels = series.labels.into_iter();
            let labels = labels.map(|label| (label.name, label.value)).collect();
            (labels_in_order(labels), points(series.samples))
        });
        Write {
            series: series.collect(),
            ..Write::default()
        }
    }
}

impl RequestTwo {
    fn read(self) -> Write {
        let mut write = Write::default();
        assert_eq!(self.symbols.first().map(String::as_str), Some(""));
        for series in self.timeseries {
            let text = |number: &u32| self.symbols[*number as usize].clone();
            let pairs = series.labels_refs.chunks_exact(2);
            let labels = pairs.map(|pair| (text(&pair[0]), text(&pair[1]))).collect();
            let labels = labels_in_order(labels);
            let kind = series.metadata.unwrap_or_default().kind;
            write.kinds.insert(labels["__name__"].clone(), kind);
            write.series.push((labels, points(series.samples)));
        }
        write
    }
}

/// Asserts what the specification demands of labels: sorted by name, none twice, none empty.
fn labels_in_order(labels: Vec<(String, String)>) -> Labels {
    assert!(labels.is_sorted_by(|one, two| one.0 < two.0), "{labels:?}");
    assert!(
        labels.iter().all(|(_, value)| !value.is_empty()),
        "{labels:?}"
    );
    labels.into_iter().collect()
}

/// Asserts that samples are in the order of time.
fn points(samples: Vec<Sample>) -> Vec<(i64, f64)> {
    let points: Vec<_> = samples
        .into_iter()
        .map(|sample| (sample.timestamp, sample.value))
        .collect();
    assert!(points.is_sorted_by(|one, two| one.0 < two.0), "{points:?}");
    points
}
