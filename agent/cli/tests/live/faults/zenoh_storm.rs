//! Forged connections of Zenoh that declare keys and tokens without end, each as long as possible.

use std::io::{self, Write as _};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Result, anyhow};
use ros2probe_capture::netns;
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::zenoh::{Role, declare_key, declare_token, frame, init, open, publisher};

const CONNECTIONS: usize = 200;
/// Number of declarations in one batch, which has at most 65,535 bytes.
const IN_A_BATCH: u32 = 24;
const KEY: usize = 2000;

/// Sends declarations until [`ZenohStorm::end`].
pub(super) struct ZenohStorm {
    stop: Arc<AtomicBool>,
    declared: Arc<AtomicU64>,
    thread: JoinHandle<Result<()>>,
}

impl ZenohStorm {
    /// Connects the robot, whose agent observes it, to the other host, and rests for this time
    /// between two batches.
    pub(super) fn start(link: &Link, rest: Duration) -> Result<ZenohStorm> {
        let address = SocketAddr::from((link.monitor.address(), 0));
        let listener = netns::within(&link.monitor.network(), || TcpListener::bind(address))??;
        let target = listener.local_addr()?;
        std::thread::spawn(move || accept(&listener));
        let connect = || (0..CONNECTIONS).map(|_| TcpStream::connect(target));
        let network = link.robot.network();
        let connected = link.robot.hold(|| {
            netns::within(&network, || {
                connect().collect::<io::Result<Vec<TcpStream>>>()
            })
        });
        let mut connections = connected???;
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let declared = Arc::new(AtomicU64::new(0));
        let counter = Arc::clone(&declared);
        let thread = std::thread::spawn(move || -> Result<()> {
            for (stream, number) in connections.iter_mut().zip(0..) {
                stream.write_all(&batch(&init(session(number), Role::Peer, None)))?;
                stream.write_all(&batch(&open(10)))?;
            }
            for round in 0.. {
                for (stream, number) in connections.iter_mut().zip(0..) {
                    if stopped.load(Ordering::Relaxed) {
                        return Ok(());
                    }
                    stream.write_all(&declarations(number, round))?;
                    counter.fetch_add(u64::from(IN_A_BATCH), Ordering::Relaxed);
                    std::thread::sleep(rest);
                }
            }
            Ok(())
        });
        Ok(ZenohStorm {
            stop,
            declared,
            thread,
        })
    }

    /// Returns the number of declarations so far.
    pub(super) fn declared(&self) -> u64 {
        self.declared.load(Ordering::Relaxed)
    }

    /// Returns the number of declarations.
    pub(super) fn end(self) -> Result<u64> {
        self.stop.store(true, Ordering::Relaxed);
        let result = self.thread.join();
        result.map_err(|_| anyhow!("the storm of Zenoh panicked"))??;
        Ok(self.declared.load(Ordering::Relaxed))
    }
}

/// Answers as a router, and reads until the other side ends.
fn accept(listener: &TcpListener) {
    for (stream, number) in listener.incoming().zip(0..) {
        let Ok(mut stream) = stream else { return };
        std::thread::spawn(move || {
            let router = session(1_000_000 + number);
            let answer = [
                batch(&init(router, Role::Router, Some(&[]))),
                batch(&open(10)),
            ];
            let _ = stream.write_all(&answer.concat());
            let _ = io::copy(&mut stream, &mut io::sink());
        });
        if number + 1 == CONNECTIONS as u32 {
            return;
        }
    }
}

/// Returns keys in even rounds, and tokens in odd ones.
fn declarations(connection: u32, round: u32) -> Vec<u8> {
    let messages = (0..IN_A_BATCH).map(|place| {
        let id = round * IN_A_BATCH + place + 1;
        let name = format!("{connection}_{id}_");
        if round.is_multiple_of(2) {
            let id = u16::try_from(id % 0x1_0000).unwrap_or_default();
            return declare_key(id, &format!("0/{name:a<KEY$}/t/TypeHashNotSupported"));
        }
        let token = publisher(session(connection), id, &format!("/t{name}"));
        declare_token(id, &token.replace("/talker/", &format!("/{name:n<KEY$}/")))
    });
    batch(&frame(round, &messages.collect::<Vec<_>>()))
}

fn session(number: u32) -> [u8; 16] {
    let mut session = [7; 16];
    session[..4].copy_from_slice(&number.to_le_bytes());
    session
}

/// Returns a batch after its length, as on TCP.
fn batch(bytes: &[u8]) -> Vec<u8> {
    let length = u16::try_from(bytes.len()).unwrap_or(u16::MAX);
    [&length.to_le_bytes()[..], bytes].concat()
}
