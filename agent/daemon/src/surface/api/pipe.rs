//! The API within one process: requests use pipes in memory instead of sockets.
//!
//! Only the process itself can send requests, so the limits of rate and size are the only checks.

use std::io;
use std::sync::Arc;

use axum::serve::Listener;
use tokio::io::DuplexStream;
use tokio::sync::mpsc;

use super::security::{AccessRules, Kind, Rights};
use super::{Context, router};
use crate::config::Access;

/// The pipes that clients in the process open.
#[derive(Debug)]
struct Pipes(mpsc::UnboundedReceiver<DuplexStream>);

impl Listener for Pipes {
    type Io = DuplexStream;
    type Addr = ();

    async fn accept(&mut self) -> (DuplexStream, ()) {
        match self.0.recv().await {
            Some(pipe) => (pipe, ()),
            // No further pipe can be opened; the server ends with its runtime.
            None => std::future::pending().await,
        }
    }

    fn local_addr(&self) -> io::Result<()> {
        Ok(())
    }
}

/// Serves every pipe.
///
/// # Errors
/// Never fails, because accepting a pipe cannot fail.
pub async fn serve(
    pipes: mpsc::UnboundedReceiver<DuplexStream>,
    context: Context,
) -> io::Result<()> {
    let granted = Rights::new(Access::All, None);
    let router = router(&context, Arc::new(AccessRules::new(Kind::Socket, granted)));
    axum::serve(Pipes(pipes), router).await
}
