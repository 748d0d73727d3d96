//! The API within one process: requests come through pipes in memory instead of sockets.
//!
//! The process itself holds the other ends, so only the protection from floods remains.

use std::io;
use std::sync::Arc;

use axum::serve::Listener;
use tokio::io::DuplexStream;
use tokio::sync::mpsc;

use super::security::{Door, Granted, Kind};
use super::{Context, router};
use crate::config::Access;

/// Pipes as they are opened.
#[derive(Debug)]
struct Pipes(mpsc::UnboundedReceiver<DuplexStream>);

impl Listener for Pipes {
    type Io = DuplexStream;
    type Addr = ();

    async fn accept(&mut self) -> (DuplexStream, ()) {
        match self.0.recv().await {
            Some(pipe) => (pipe, ()),
            // No further request can come; the server ends with its runtime.
            None => std::future::pending().await,
        }
    }

    fn local_addr(&self) -> io::Result<()> {
        Ok(())
    }
}

/// Answers on every pipe.
///
/// # Errors
/// Never: pipes do not fail to be accepted.
pub async fn serve(
    pipes: mpsc::UnboundedReceiver<DuplexStream>,
    context: Context,
) -> io::Result<()> {
    let granted = Granted::new(Access::All, None);
    let router = router(&context, Arc::new(Door::new(Kind::Socket, granted)));
    axum::serve(Pipes(pipes), router).await
}
