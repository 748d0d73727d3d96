//! A store with the part of the S3 protocol that deliveries need. It shares no code with the
//! product, verifies checksums, and refuses or cuts requests as a test requires. It does not verify
//! signatures, but the key in them.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use http_body_util::{BodyExt as _, Full};
use hyper::body::{Bytes, Incoming};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{HeaderMap, Method, Request, Response};
use hyper_util::rt::TokioIo;
use sha2::{Digest as _, Sha256};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Runtime;

/// Maximum wait for a state of the store.
const PATIENCE: Duration = Duration::from_secs(60);
/// Name of the bucket.
pub const BUCKET: &str = "bags";
/// Maximum number of objects in a page of a listing; a store may return fewer than requested.
const PAGE_OBJECTS: usize = 2;
/// Minimum size of a part, except the last one.
const PART_BYTES: usize = 5 << 20;

/// A request, without its body.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Call {
    /// What it requests.
    pub operation: Operation,
    /// Name of the object, without the bucket.
    pub object: String,
    /// Length of its body.
    pub length: usize,
    /// Access key.
    pub key: String,
}

/// Operations on objects.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operation {
    Get,
    Head,
    /// A page of the objects below a prefix, which is the object of the call.
    List,
    Put,
    Begin,
    /// A part, numbered from 1.
    Part(usize),
    Complete,
    Abort,
}

/// What becomes of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RequestOutcome {
    /// The store serves it.
    Serve,
    /// The store refuses it with a status, and a pause in seconds.
    Refuse(u16, Option<u32>),
    /// The connection ends after these bytes of the body.
    CutAfter(usize),
    /// The store serves it, and the connection ends before the answer.
    CutAnswer,
}

type Decide = Box<dyn FnMut(&Call) -> RequestOutcome + Send>;

/// A running store; dropping the value ends it.
pub struct Store {
    pub address: SocketAddr,
    state: Arc<Mutex<State>>,
    _runtime: Runtime,
}

#[derive(Default)]
struct State {
    decide: Option<Decide>,
    /// Keys that it accepts; empty = every key.
    keys: BTreeSet<String>,
    objects: BTreeMap<String, Bytes>,
    /// Seconds at which they were written, each one later than the one before.
    written: BTreeMap<String, u64>,
    uploads: BTreeMap<String, (String, BTreeMap<usize, Bytes>)>,
    /// Requests that were served, in their order.
    served: Vec<Call>,
    /// Number of the last upload.
    last: usize,
    /// Bytes of bodies that came in, also of requests that were cut.
    received: usize,
}

/// The connection ends.
#[derive(Debug)]
struct Cut;

impl std::fmt::Display for Cut {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("cut")
    }
}

impl std::error::Error for Cut {}

impl Store {
    /// Starts a store on a free port of this host.
    #[must_use]
    pub fn start() -> Self {
        let mut runtime = tokio::runtime::Builder::new_multi_thread();
        let runtime = runtime.worker_threads(1).enable_all().build().unwrap();
        let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0")).unwrap();
        let address = listener.local_addr().unwrap();
        let state = Arc::<Mutex<State>>::default();
        let shared = Arc::clone(&state);
        runtime.spawn(async move {
            loop {
                let (stream, _) = listener.accept().await.unwrap();
                tokio::spawn(serve(stream, Arc::clone(&shared)));
            }
        });
        Self {
            address,
            state,
            _runtime: runtime,
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap()
    }

    /// Decides on the fate of each request from now on.
    pub fn decide(&self, decide: impl FnMut(&Call) -> RequestOutcome + Send + 'static) {
        self.state().decide = Some(Box::new(decide));
    }

    /// Accepts only this key from now on.
    pub fn accept_key(&self, key: &str) {
        self.state().keys = BTreeSet::from([key.to_owned()]);
    }

    /// Returns all objects.
    #[must_use]
    pub fn objects(&self) -> BTreeMap<String, Bytes> {
        self.state().objects.clone()
    }

    /// Adds an object.
    pub fn insert(&self, object: &str, content: Vec<u8>) {
        self.state().write(object.to_owned(), content.into());
    }

    /// Removes an object.
    pub fn remove(&self, object: &str) {
        self.state().objects.remove(object).unwrap();
    }

    /// Forgets all unfinished uploads, as the rules of a bucket may require.
    pub fn expire_uploads(&self) {
        self.state().uploads.clear();
    }

    /// Returns the requests that were served, in their order.
    #[must_use]
    pub fn served(&self) -> Vec<Call> {
        self.state().served.clone()
    }

    /// Returns the number of bytes of bodies that came in.
    #[must_use]
    pub fn received(&self) -> usize {
        self.state().received
    }

    /// Waits until `wanted` accepts this store.
    ///
    /// # Panics
    ///
    /// Panics if that takes too long.
    pub fn wait_for(&self, what: &str, wanted: impl Fn(&Self) -> bool) {
        let deadline = Instant::now() + PATIENCE;
        while !wanted(self) {
            let served = self.served();
            assert!(Instant::now() < deadline, "no {what}; served: {served:#?}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

async fn serve(stream: TcpStream, state: Arc<Mutex<State>>) {
    let service = service_fn(move |request| answer(request, Arc::clone(&state)));
    // A connection that is cut is an error here.
    let _ = http1::Builder::new()
        .serve_connection(TokioIo::new(stream), service)
        .await;
}

async fn answer(
    request: Request<Incoming>,
    state: Arc<Mutex<State>>,
) -> Result<Response<Full<Bytes>>, Cut> {
    let (head, mut body) = request.into_parts();
    let query: BTreeMap<_, _> = head
        .uri
        .query()
        .unwrap_or_default()
        .split('&')
        .map(|pair| pair.split_once('=').unwrap_or((pair, "")))
        .map(|(name, value)| (name.to_owned(), value.to_owned()))
        .collect();
    let object = head.uri.path().strip_prefix(&format!("/{BUCKET}"));
    let object = object.unwrap_or_else(|| panic!("{}", head.uri));
    let object = match query.get("prefix") {
        Some(prefix) => prefix.replace("%2F", "/"),
        None => object.trim_start_matches('/').to_owned(),
    };
    let length = header(&head.headers, "content-length").parse().unwrap_or(0);
    let authorization = header(&head.headers, "authorization");
    let key = authorization
        .split("Credential=")
        .nth(1)
        .and_then(|rest| rest.split('/').next());
    let call = Call {
        operation: operation(&head.method, &query),
        object,
        length,
        key: key.unwrap_or_default().to_owned(),
    };
    let fate = {
        let mut state = state.lock().unwrap();
        let is_known = state.keys.is_empty() || state.keys.contains(&call.key);
        match &mut state.decide {
            _ if !is_known => RequestOutcome::Refuse(403, None),
            Some(decide) => decide(&call),
            None => RequestOutcome::Serve,
        }
    };
    if let RequestOutcome::Refuse(status, pause) = fate {
        return Ok(refusal(status, "RefusedByTheTest", pause));
    }
    let mut content = Vec::new();
    while let Some(frame) = body.frame().await {
        let data = frame.map_err(|_| Cut)?.into_data().unwrap_or_default();
        state.lock().unwrap().received += data.len();
        content.extend_from_slice(&data);
        if matches!(fate, RequestOutcome::CutAfter(bytes) if content.len() >= bytes) {
            return Err(Cut);
        }
    }
    if matches!(fate, RequestOutcome::CutAfter(_)) {
        return Err(Cut);
    }
    let checksum = header(&head.headers, "x-amz-content-sha256");
    if checksum != hex(&content) {
        return Ok(refusal(400, "XAmzContentSHA256Mismatch", None));
    }
    let upload = query.get("uploadId").map_or("", String::as_str);
    let mut state = state.lock().unwrap();
    let token = query.get("continuation-token");
    let response = match call.operation {
        Operation::List => state.list(&call.object, token.map_or("", String::as_str)),
        _ => state.serve(&call, upload, content.into()),
    };
    state.served.push(call);
    match fate {
        RequestOutcome::CutAnswer => Err(Cut),
        _ => Ok(response),
    }
}

impl State {
    fn write(&mut self, object: String, content: Bytes) {
        let last = self.written.values().max().copied().unwrap_or_default();
        self.written.insert(object.clone(), last + 1);
        self.objects.insert(object, content);
    }

    /// Returns the page that begins after `token`, which a client has as it was sent.
    fn list(&self, prefix: &str, token: &str) -> Response<Full<Bytes>> {
        let token = token.replace("%2F", "/");
        let is_listed = |(name, _): &(&String, &Bytes)| {
            name.starts_with(prefix) && name.as_str() > token.as_str()
        };
        let mut left = self.objects.iter().filter(is_listed);
        let mut text = "<ListBucketResult>".to_owned();
        let mut last = None;
        for (name, content) in left.by_ref().take(PAGE_OBJECTS) {
            let seconds = self.written[name];
            text += &format!(
                "<Contents><Key>{name}</Key><Size>{}</Size>\
                 <LastModified>2026-11-01T{:02}:{:02}:{:02}.000Z</LastModified></Contents>",
                content.len(),
                seconds / 3600,
                seconds / 60 % 60,
                seconds % 60,
            );
            last = Some(name);
        }
        if let (Some(last), Some(_)) = (last, left.next()) {
            text += &format!("<NextContinuationToken>{last}</NextContinuationToken>");
        }
        xml(&(text + "</ListBucketResult>"))
    }

    fn serve(&mut self, call: &Call, upload: &str, content: Bytes) -> Response<Full<Bytes>> {
        let object = call.object.clone();
        let is_of = |found: &(String, BTreeMap<usize, Bytes>)| found.0 == object;
        match call.operation {
            Operation::Get | Operation::Head => match self.objects.get(&object) {
                None => refusal(404, "NoSuchKey", None),
                Some(found) => {
                    let response = Response::builder()
                        .header("etag", etag(found))
                        .header("last-modified", "Sun, 01 Nov 2026 00:00:00 GMT")
                        .header("content-length", found.len());
                    let body = match call.operation {
                        Operation::Get => found.clone(),
                        _ => Bytes::new(),
                    };
                    response.body(Full::new(body)).unwrap()
                }
            },
            Operation::List => unreachable!("it has no object"),
            Operation::Put => {
                let etag = etag(&content);
                self.write(object, content);
                with_etag(&etag)
            }
            Operation::Begin => {
                self.last += 1;
                let id = format!("upload-{}", self.last);
                self.uploads
                    .insert(id.clone(), (object, BTreeMap::default()));
                xml(&format!(
                    "<InitiateMultipartUploadResult><UploadId>{id}</UploadId>\
                     </InitiateMultipartUploadResult>"
                ))
            }
            Operation::Part(number) => {
                let Some((_, parts)) = self.uploads.get_mut(upload).filter(|found| is_of(found))
                else {
                    return refusal(404, "NoSuchUpload", None);
                };
                let etag = etag(&content);
                parts.insert(number, content);
                with_etag(&etag)
            }
            Operation::Complete => {
                let Some((_, parts)) = self.uploads.get(upload).filter(|found| is_of(found)) else {
                    return refusal(404, "NoSuchUpload", None);
                };
                let text = String::from_utf8(content.to_vec()).unwrap();
                let listed: Vec<_> = elements(&text, "Part")
                    .map(|part| {
                        let number = elements(part, "PartNumber").next().unwrap();
                        let etag = elements(part, "ETag").next().unwrap();
                        (
                            number.parse::<usize>().unwrap(),
                            etag.replace("&quot;", "\""),
                        )
                    })
                    .collect();
                let stored: Vec<_> = parts.iter().map(|(n, part)| (*n, etag(part))).collect();
                if listed != stored || listed.is_empty() {
                    return refusal(400, "InvalidPart", None);
                }
                let all_but_last = parts.values().take(parts.len() - 1);
                if all_but_last.clone().any(|part| part.len() < PART_BYTES) {
                    return refusal(400, "EntityTooSmall", None);
                }
                let whole: Vec<u8> = parts.values().flat_map(|part| part.to_vec()).collect();
                self.uploads.remove(upload);
                self.write(object, whole.into());
                xml("<CompleteMultipartUploadResult><ETag>\"whole\"</ETag>\
                     </CompleteMultipartUploadResult>")
            }
            Operation::Abort => {
                self.uploads.remove(upload);
                Response::builder()
                    .status(204)
                    .body(Full::default())
                    .unwrap()
            }
        }
    }
}

fn operation(method: &Method, query: &BTreeMap<String, String>) -> Operation {
    let (is_upload, part) = (query.contains_key("uploadId"), query.get("partNumber"));
    match (method.as_str(), is_upload, part) {
        ("GET", false, None) if query.contains_key("list-type") => Operation::List,
        ("GET", false, None) => Operation::Get,
        ("HEAD", false, None) => Operation::Head,
        ("PUT", false, None) => Operation::Put,
        ("PUT", true, Some(number)) => Operation::Part(number.parse().unwrap()),
        ("POST", true, None) => Operation::Complete,
        ("POST", false, None) if query.contains_key("uploads") => Operation::Begin,
        ("DELETE", true, None) => Operation::Abort,
        other => panic!("unexpected request: {other:?}"),
    }
}

fn header(headers: &HeaderMap, name: &str) -> String {
    let value = headers.get(name);
    value.map_or_else(String::new, |value| value.to_str().unwrap().to_owned())
}

/// Returns the SHA-256 of bytes in hexadecimal digits.
#[must_use]
pub fn hex(content: &[u8]) -> String {
    let digest = Sha256::digest(content);
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn etag(content: &[u8]) -> String {
    format!("\"{}\"", &hex(content)[..32])
}

/// Returns the contents of the elements of a name.
fn elements<'a>(text: &'a str, name: &str) -> impl Iterator<Item = &'a str> {
    let (begin, end) = (format!("<{name}>"), format!("</{name}>"));
    let parts: Vec<_> = text.split(&begin).skip(1).collect();
    parts
        .into_iter()
        .map(move |part| part.split(&end).next().unwrap())
}

fn with_etag(etag: &str) -> Response<Full<Bytes>> {
    let response = Response::builder().header("etag", etag);
    response.body(Full::default()).unwrap()
}

fn xml(text: &str) -> Response<Full<Bytes>> {
    let response = Response::builder().header("content-type", "application/xml");
    response.body(Full::new(text.to_owned().into())).unwrap()
}

fn refusal(status: u16, code: &str, pause: Option<u32>) -> Response<Full<Bytes>> {
    let mut response = Response::builder().status(status);
    if let Some(pause) = pause {
        response = response.header("retry-after", pause);
    }
    let text = format!("<Error><Code>{code}</Code><Message>no</Message></Error>");
    response.body(Full::new(text.into())).unwrap()
}
