//! The thread of remote write: collections at each interval, and requests until the receiver has
//! all samples.

use std::io;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use prost::bytes::Bytes;
use tokio::runtime::Builder;
use tokio::sync::Notify;
use tokio::time::{MissedTickBehavior, interval_at, sleep};
use tokio_util::sync::CancellationToken;

use super::backlog::Backlog;
use super::client::{Client, WriteResult};
use super::figures::{Figures, Request, SampleFate, now};
use super::request::{Version, body};
use super::samples::{Samples, Scrape};
use super::settings::{Settings, SettingsError};
use crate::export_thread::{ExportThread, Spawn};
use crate::metric_sink::MetricSink;
use crate::metric_source::MetricSource;

/// Pauses before samples are sent again.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
const LONGEST_PAUSE: Duration = Duration::from_secs(30);
/// Time for the last requests, of the two seconds for stopping.
const LAST_REQUEST_TIMEOUT: Duration = Duration::from_millis(1_400);
/// Maximum time to wait for fresh figures.
const REFRESH_TIMEOUT: Duration = Duration::from_millis(500);

/// Data to send, and its counters.
#[derive(Debug)]
pub struct Inputs {
    /// Metrics.
    pub metrics: Arc<dyn MetricSource>,
    /// Counters of remote write.
    pub figures: Arc<Figures>,
    /// Directory of the queue; `None` = samples wait in memory only.
    pub directory: Option<PathBuf>,
}

/// Why remote write cannot start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// The settings cannot be applied.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// The thread cannot be created, or it could not drop its privileges.
    #[error("cannot start the thread of remote write")]
    Thread(#[source] io::Error),
}

/// Starts remote write in a thread that may open connections.
///
/// # Errors
/// Fails if a file of the settings cannot be used. An unavailable receiver is not an error.
pub fn start(settings: Settings, inputs: Inputs, spawn: Spawn) -> Result<ExportThread, StartError> {
    let settings = Arc::new(settings);
    let client = Client::new(Arc::clone(&settings))?;
    // A blocking thread resolves names.
    let mut runtime = Builder::new_current_thread();
    let runtime = runtime.max_blocking_threads(1).enable_all().build();
    let runtime = runtime.map_err(StartError::Thread)?;
    let stop = CancellationToken::new();
    inputs.figures.enable();
    let job = Job {
        waiting: Waiting::default(),
        figures: inputs.figures,
        stop: stop.clone(),
        settings,
    };
    let work = move || {
        runtime.block_on(job.run(inputs.metrics, client, inputs.directory));
        // A pending name resolution must not delay the end.
        runtime.shutdown_background();
    };
    ExportThread::start("remote_write", stop, spawn, work).map_err(StartError::Thread)
}

struct Job {
    waiting: Waiting,
    figures: Arc<Figures>,
    stop: CancellationToken,
    settings: Arc<Settings>,
}

/// The waiting samples, between collections and requests.
#[derive(Debug, Default)]
struct Waiting {
    state: Mutex<State>,
    added: Notify,
}

#[derive(Debug, Default)]
struct State {
    backlog: Backlog,
    /// Whether the last request failed.
    fails: bool,
    /// Time of the oldest samples in the request.
    taken: Option<i64>,
    /// Whether nothing will be added.
    is_closed: bool,
}

/// Requests to the receiver, and what is known about it.
struct Sender<'a> {
    job: &'a Job,
    client: Client,
    version: Version,
    /// Whether the receiver answered in `version` before.
    is_known: bool,
    /// Whether the last request succeeded; `None` before the first.
    is_working: Option<bool>,
    /// Whether a refusal was logged since the last success.
    is_refusal_logged: bool,
    /// Whether a replaced file could not be used at the last request.
    has_unusable_file: bool,
    /// Number of collections in a request that the link seems to carry in time.
    carried: usize,
}

/// Samples that the receiver did not write.
enum Unwritten {
    /// It did not answer in time, and a smaller request may succeed.
    Late,
    /// It refused them for this reason, and wrote this number of them.
    Refused(String, Option<u64>),
}

impl Waiting {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes the oldest samples, or none at the end. Returns `None` while more may come.
    fn take(&self, figures: &Figures) -> Option<Vec<Arc<Scrape>>> {
        let mut state = self.state();
        let batch = state.backlog.take();
        state.taken = batch.first().map(|scrape| scrape.at);
        state.publish(figures);
        (!batch.is_empty() || state.is_closed).then_some(batch)
    }

    /// Removes the samples that were taken. The next [`Self::take`] publishes the figures, because
    /// it reads the time of the oldest samples on disk.
    fn settled(&self) {
        let mut state = self.state();
        state.backlog.delivered();
        state.taken = None;
    }

    fn change(&self, figures: &Figures, change: impl FnOnce(&mut State)) {
        let mut state = self.state();
        change(&mut state);
        state.publish(figures);
        drop(state);
        self.added.notify_one();
    }
}

impl State {
    fn publish(&self, figures: &Figures) {
        let oldest = self.taken.or(self.backlog.oldest_in_memory());
        figures.waiting(self.backlog.disk_bytes(), oldest);
    }
}

impl Job {
    async fn run(self, metrics: Arc<dyn MetricSource>, client: Client, directory: Option<PathBuf>) {
        if let Some(directory) = directory.filter(|_| self.settings.queue_bytes > 0) {
            let mut state = self.waiting.state();
            state.backlog.open(&directory, self.settings.queue_bytes);
        }
        let sender = Sender::new(&self, client);
        let deliver = async {
            tokio::select! {
                () = sender.run() => {}
                () = self.ended() => {}
            }
        };
        tokio::join!(self.collect(&*metrics), deliver);
        self.waiting.change(&self.figures, |state| {
            let lost = state.backlog.write();
            self.figures.count_samples(SampleFate::Overflow, lost);
            let dropped = state.backlog.clear();
            self.figures.count_samples(SampleFate::Shutdown, dropped);
        });
    }

    /// Completes when the time for the last requests is over.
    async fn ended(&self) {
        self.stop.cancelled().await;
        sleep(LAST_REQUEST_TIMEOUT).await;
    }

    /// Collects at each interval until the agent stops, and then a last time.
    async fn collect(&self, metrics: &dyn MetricSource) {
        let period = self.settings.interval;
        // The offset spreads the requests of a fleet that was switched on simultaneously.
        let mut ticks = interval_at(tokio::time::Instant::now() + period / 4, period);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let mut samples = Samples::new(self.settings.max_new_series);
        let mut previous = Duration::ZERO;
        let mut last = 0;
        loop {
            let stops = tokio::select! {
                _ = ticks.tick() => false,
                () = self.stop.cancelled() => true,
            };
            if !stops {
                metrics.refresh(REFRESH_TIMEOUT).await;
            }
            let begun = Instant::now();
            samples.begin();
            // Writing samples to memory cannot fail.
            let _ = metrics.collect(&mut MetricSink::samples(&mut samples), previous);
            previous = begun.elapsed();
            let at = now();
            let (scrape, refused) = samples.end(if at == last { at + 1 } else { at });
            last = scrape.at;
            self.figures.count_samples(SampleFate::Overflow, refused);
            let omitted = samples.take_omitted();
            self.figures.count_samples(SampleFate::SeriesLimit, omitted);
            self.add(scrape);
            if stops {
                break;
            }
        }
        self.add(samples.end_all(last + 1));
        self.waiting
            .change(&self.figures, |state| state.is_closed = true);
    }

    fn add(&self, scrape: Scrape) {
        self.waiting.change(&self.figures, |state| {
            let lost = state.backlog.add(scrape, !state.fails);
            self.figures.count_samples(SampleFate::Overflow, lost);
        });
    }

    /// Takes the oldest samples as soon as there are some; returns none at the end.
    async fn take(&self) -> Vec<Arc<Scrape>> {
        loop {
            let added = self.waiting.added.notified();
            if let Some(batch) = self.waiting.take(&self.figures) {
                return batch;
            }
            added.await;
        }
    }
}

impl<'a> Sender<'a> {
    const fn new(job: &'a Job, client: Client) -> Self {
        Self {
            job,
            client,
            version: Version::Two,
            is_known: false,
            is_working: None,
            is_refusal_logged: false,
            has_unusable_file: false,
            carried: usize::MAX,
        }
    }

    /// Sends samples until none can follow.
    async fn run(mut self) {
        loop {
            let batch = self.job.take().await;
            if batch.is_empty() {
                return;
            }
            self.settle(&batch).await;
            self.job.waiting.settled();
        }
    }

    /// Sends samples until the receiver has written or refused each of them.
    async fn settle(&mut self, batch: &[Arc<Scrape>]) {
        // Samples of a series must be in the order of time (Remote-Write 1.0 and 2.0, "Ordering"). A
        // request ends where the clock was set back. The oldest samples are in the last part.
        let steps = batch.chunk_by(|one, two| one.at < two.at);
        let parts = steps.flat_map(|part| part.chunks(self.carried));
        let mut parts: Vec<_> = parts.collect();
        parts.reverse();
        while let Some(part) = parts.pop() {
            match self.send_until_settled(part).await {
                Ok(()) => self
                    .job
                    .figures
                    .count_samples(SampleFate::Delivered, samples(part)),
                // A receiver that refuses some samples may refuse the whole request.
                Err(Unwritten::Refused(_, None)) if part.len() > 1 => {
                    let (older, newer) = part.split_at(part.len() / 2);
                    parts.extend([newer, older]);
                }
                Err(Unwritten::Late) => {
                    self.carried = (part.len() / 2).max(1);
                    parts.push(part);
                    let smaller = parts.iter();
                    let smaller = smaller.flat_map(|part| part.chunks(self.carried).rev());
                    parts = smaller.collect();
                }
                Err(Unwritten::Refused(reason, written)) => {
                    self.refused(&reason, samples(part), written.unwrap_or(0));
                }
            }
        }
    }

    /// Sends samples until the receiver writes or refuses them. A single collection is repeated when
    /// no answer arrives in time.
    async fn send_until_settled(&mut self, part: &[Arc<Scrape>]) -> Result<(), Unwritten> {
        let mut pause = FIRST_PAUSE;
        let mut body = self.body(part);
        let mut is_doubted = false;
        loop {
            self.reload_files();
            let length = body.len();
            let begun = Instant::now();
            let answer = match self.client.send(body.clone(), self.version).await {
                // A receiver of version 2.0 states it, but the portal of a network does not.
                WriteResult::Unconfirmed if self.is_known => {
                    let reason = "a success without the number of written samples";
                    WriteResult::RetryLater(reason.to_owned(), None)
                }
                WriteResult::Unconfirmed => WriteResult::UnknownVersion,
                // Only a second refusal shows that another receiver took its place.
                WriteResult::UnknownVersion
                    if self.is_known && !std::mem::replace(&mut is_doubted, true) =>
                {
                    let reason = "a refusal without the number of written samples";
                    WriteResult::RetryLater(reason.to_owned(), None)
                }
                answer => answer,
            };
            let figures = &self.job.figures;
            match answer {
                WriteResult::UnknownVersion | WriteResult::Unconfirmed => {
                    figures.count_request(Request::Retried, length);
                    self.version = Version::One;
                    body = self.body(part);
                    if std::mem::replace(&mut self.is_known, true) {
                        // Another receiver took its place.
                        sleep(pause).await;
                        pause = (pause * 2).min(LONGEST_PAUSE);
                    }
                }
                WriteResult::Accepted => {
                    figures.count_request(Request::Delivered, length);
                    self.delivered();
                    let was_fast = begun.elapsed() < self.job.settings.timeout / 4;
                    if was_fast && part.len() >= self.carried {
                        self.carried = self.carried.saturating_mul(2);
                    }
                    self.limit(length).await;
                    return Ok(());
                }
                WriteResult::Refused(reason, written) => {
                    figures.count_request(Request::Refused, length);
                    self.job.waiting.state().fails = false;
                    self.limit(length).await;
                    return Err(Unwritten::Refused(reason, written));
                }
                WriteResult::Late => {
                    figures.count_request(Request::Retried, length);
                    self.failed("no answer in time");
                    sleep(pause).await;
                    if part.len() > 1 {
                        return Err(Unwritten::Late);
                    }
                    pause = (pause * 2).min(LONGEST_PAUSE);
                }
                WriteResult::RetryLater(reason, demanded) => {
                    figures.count_request(Request::Retried, length);
                    self.failed(&reason);
                    // A receiver can demand a longer pause, but no shorter one.
                    sleep(pause.max(demanded.unwrap_or_default())).await;
                    pause = (pause * 2).min(LONGEST_PAUSE);
                }
            }
        }
    }

    /// Uses replaced files. If one of them cannot be used, the previous ones remain in use, and the
    /// first failure is logged.
    fn reload_files(&mut self) {
        let reloaded = self.client.reload_files();
        let failed_before = std::mem::replace(&mut self.has_unusable_file, reloaded.is_err());
        if let (Err(error), false) = (reloaded, failed_before) {
            tracing::warn!(%error, "a replaced file of remote write cannot be used: the previous one remains in use");
        }
    }

    /// Returns the body of a request with these samples.
    fn body(&self, part: &[Arc<Scrape>]) -> Bytes {
        body(part, &self.job.settings.labels, self.version).into()
    }

    /// Waits until the rate of bytes permits the next request.
    async fn limit(&self, length: usize) {
        if let Some(rate) = self.job.settings.max_bytes_per_second {
            let nanoseconds = (length as u64).saturating_mul(1_000_000_000) / rate.max(1);
            sleep(Duration::from_nanos(nanoseconds)).await;
        }
    }

    fn delivered(&mut self) {
        self.is_known = true;
        self.is_refusal_logged = false;
        self.job.waiting.state().fails = false;
        if self.is_working != Some(true) {
            self.is_working = Some(true);
            let (url, version) = (&self.job.settings.url, self.version.header());
            tracing::info!(%url, version, "sending samples by remote write");
        }
    }

    /// Handles a failed request: logs the first failure until a request succeeds again, and writes
    /// the samples in memory to disk.
    fn failed(&mut self, reason: &str) {
        let is_first = self.is_working != Some(false);
        self.is_working = Some(false);
        if is_first {
            let url = &self.job.settings.url;
            tracing::warn!(%url, reason, "the receiver of remote write is out of reach: samples wait");
        }
        // What waits in memory must survive a power cut from now on.
        self.job.waiting.change(&self.job.figures, |state| {
            state.fails = true;
            let lost = state.backlog.write();
            self.job.figures.count_samples(SampleFate::Overflow, lost);
        });
    }

    /// Counts samples as refused, and logs the first time until a request succeeds again.
    fn refused(&mut self, reason: &str, samples: u64, written: u64) {
        let figures = &self.job.figures;
        figures.count_samples(SampleFate::Delivered, written.min(samples));
        figures.count_samples(SampleFate::Refused, samples.saturating_sub(written));
        if !std::mem::replace(&mut self.is_refusal_logged, true) {
            let url = &self.job.settings.url;
            tracing::warn!(%url, reason, samples, "the receiver of remote write refuses samples");
        }
    }
}

/// Returns the number of samples.
fn samples(part: &[Arc<Scrape>]) -> u64 {
    part.iter().map(|scrape| scrape.samples.len() as u64).sum()
}

#[cfg(test)]
mod tests {
    use std::io::{BufRead as _, BufReader, Read as _, Write as _};
    use std::net::{SocketAddr, TcpListener, TcpStream};

    use super::super::settings::RemoteWriteSettings;
    use super::*;
    use crate::otlp::{Host, ReadText};

    /// Returns remote write to a receiver that answers within this time.
    fn job(receiver: SocketAddr, timeout: Duration) -> Job {
        let file = RemoteWriteSettings {
            url: Some(format!("http://{receiver}/write")),
            timeout,
            ..RemoteWriteSettings::default()
        };
        let read: ReadText = |_, _| Err(std::io::ErrorKind::NotFound.into());
        let settings = Settings::resolve(&file, read, &Host::default());
        Job {
            waiting: Waiting::default(),
            figures: Arc::default(),
            stop: CancellationToken::new(),
            settings: Arc::new(settings.unwrap().unwrap()),
        }
    }

    /// Earlier, one request was repeated without end, and the receiver got no further samples.
    #[test]
    fn a_backlog_passes_a_link_that_carries_only_small_requests_in_time() {
        const CARRIED_BYTES: usize = 2500;
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                let stream = stream.unwrap();
                std::thread::spawn(move || answer_small(stream, CARRIED_BYTES));
            }
        });
        let job = job(address, Duration::from_millis(500));
        let client = Client::new(Arc::clone(&job.settings)).unwrap();
        let mut sender = Sender::new(&job, client);
        // Names that do not compress: some collections fit.
        let mut random = 1_u64;
        let mut letter = || {
            random = random
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            b'a' + u8::try_from((random >> 33) % 26).unwrap()
        };
        let mut scrape = |number: i64| {
            let name = (0..600).map(|_| letter());
            let name: Vec<u8> = [b'g'].into_iter().chain(name).chain([0xff]).collect();
            Arc::new(Scrape {
                at: now() + number,
                samples: vec![(name.into(), 0.0)],
            })
        };
        let batch: Vec<_> = (0..20).map(&mut scrape).collect();
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(sender.settle(&batch));
        assert_eq!(job.figures.samples(SampleFate::Delivered), 20);
        assert!(job.figures.requests(Request::Retried) >= 1);
    }

    /// Earlier, one request had samples before and after the step, which the protocol forbids.
    #[test]
    fn a_request_ends_where_the_clock_was_set_back() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                let stream = stream.unwrap();
                std::thread::spawn(move || answer_small(stream, usize::MAX));
            }
        });
        let job = job(address, Duration::from_secs(60));
        let client = Client::new(Arc::clone(&job.settings)).unwrap();
        let mut sender = Sender::new(&job, client);
        // Two steps back, and a step forward, after which the order is right again.
        let times = [10, 20, 30, 12, 22, 90, 91, 91];
        let scrape = |at: i64| {
            let samples = vec![(vec![b'g', b'a', 0xff].into(), 0.0)];
            Arc::new(Scrape { at, samples })
        };
        let batch: Vec<_> = times.into_iter().map(scrape).collect();
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(sender.settle(&batch));
        assert_eq!(job.figures.samples(SampleFate::Delivered), 8);
        assert_eq!(job.figures.requests(Request::Delivered), 3);
    }

    /// Answers requests of a connection; larger ones only when the client has given up.
    fn answer_small(mut stream: TcpStream, carried: usize) {
        let mut reader = BufReader::new(stream.try_clone().unwrap());
        loop {
            let mut length = 0;
            loop {
                let mut line = String::new();
                if reader.read_line(&mut line).unwrap_or(0) == 0 {
                    return;
                }
                if let Some(value) = line.to_ascii_lowercase().strip_prefix("content-length:") {
                    length = value.trim().parse().unwrap();
                }
                if line == "\r\n" {
                    break;
                }
            }
            let mut body = vec![0; length];
            reader.read_exact(&mut body).unwrap();
            if length > carried {
                std::thread::sleep(Duration::from_secs(1));
                return;
            }
            let answer = "HTTP/1.1 204 No Content\r\nX-Prometheus-Remote-Write-Samples-Written: \
                          1\r\n\r\n";
            if stream.write_all(answer.as_bytes()).is_err() {
                return;
            }
        }
    }

    #[test]
    fn the_age_of_waiting_samples_falls_while_a_queue_on_disk_is_drained() {
        let directory = tempfile::tempdir().unwrap();
        let (waiting, figures) = (Waiting::default(), Figures::default());
        waiting.state().backlog.open(directory.path(), 4 << 20);
        let begun = std::time::Instant::now();
        let begin = now() - 200_000;
        let scrape = |number: i64| Scrape {
            at: begin + number * 1_000,
            samples: vec![(vec![b'g', b'a', 0xff].into(), 0.0)],
        };
        for number in 0..150 {
            waiting.change(&figures, |state| {
                state.backlog.add(scrape(number), false);
            });
        }
        // A busy machine takes longer.
        let latest = |expected: f64| expected + 10.0 + begun.elapsed().as_secs_f64();
        // The receiver is in reach again. Sixty collections are in a request, and others follow.
        for (expected, later) in [(200.0, 150), (140.0, 151), (80.0, 152), (50.0, 153)] {
            let batch = waiting.take(&figures).unwrap();
            assert!(!batch.is_empty());
            let seen = figures.lag_seconds();
            assert!((expected..latest(expected)).contains(&seen), "{seen}");
            waiting.change(&figures, |state| {
                state.backlog.add(scrape(later), true);
            });
            waiting.settled();
            let seen = figures.lag_seconds();
            assert!((expected..latest(expected)).contains(&seen), "{seen}");
        }
    }
}
