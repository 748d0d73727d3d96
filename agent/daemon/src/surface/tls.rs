//! TLS on the metrics listener, with rustls. Its crypto provider is ring, which is partly C and
//! assembly. The provider in pure Rust, rustls-rustcrypto, is an alpha release. The provider
//! graviola needs AES instructions, which a Raspberry Pi 4 lacks.
//!
//! The handshake runs during reads of the connection, so a slow client only delays itself. The
//! limits of the underlying connection apply as well.

use std::io;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio_rustls::rustls::crypto::ring::default_provider;
use tokio_rustls::rustls::pki_types::pem::{self, PemObject as _};
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::server::{VerifierBuilderError, WebPkiClientVerifier};
use tokio_rustls::rustls::version::{TLS12, TLS13};
use tokio_rustls::rustls::{self, RootCertStore, ServerConfig};
use tokio_rustls::server::TlsStream;
use tokio_rustls::{Accept, TlsAcceptor};

use super::connection::Connection;
use super::serving::WrapStream;
use super::web_config::TlsFiles;

/// Maximum size of a file with certificates or a key, in bytes.
const MAX_BYTES: u64 = 1 << 20;

/// Why TLS cannot be set up.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file cannot be read.
    #[error("cannot read {} (`tls_server_config`)", path.display())]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// A file is not valid PEM.
    #[error("{} (`tls_server_config`) is invalid", path.display())]
    Pem {
        /// Path of the file.
        path: PathBuf,
        /// Error of the parser.
        source: pem::Error,
    },
    /// Certificates and key cannot be used, for example because they do not match.
    #[error("certificate and key (`tls_server_config`) cannot be used")]
    Unusable(#[from] rustls::Error),
    /// The client authorities are invalid.
    #[error("client_ca_file (`tls_server_config`) cannot be used")]
    Authorities(#[from] VerifierBuilderError),
}

/// Certificates and key, loaded and checked.
#[derive(Clone)]
pub(super) struct Acceptor(TlsAcceptor);

/// A connection with TLS, including its handshake.
pub(super) enum Stream<S> {
    /// The handshake is in progress.
    Handshake(Box<Accept<S>>),
    /// The handshake is complete.
    Open(Box<TlsStream<S>>),
    /// The handshake failed.
    Failed,
}

impl Acceptor {
    /// Loads certificates and key from the files.
    pub(super) fn new(files: &TlsFiles) -> Result<Self, TlsError> {
        let provider = Arc::new(default_provider());
        let versions: &[_] = if files.only_tls13 {
            &[&TLS13]
        } else {
            &[&TLS13, &TLS12]
        };
        let builder = ServerConfig::builder_with_provider(Arc::clone(&provider));
        let builder = builder.with_protocol_versions(versions)?;
        let builder = match &files.client_authorities {
            None => builder.with_no_client_auth(),
            Some(path) => {
                let mut roots = RootCertStore::empty();
                for certificate in certificates(path)? {
                    roots.add(certificate)?;
                }
                let verifier =
                    WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider);
                builder.with_client_cert_verifier(verifier.build()?)
            }
        };
        let key = PrivateKeyDer::from_pem_slice(&read(&files.key)?);
        let key = key.map_err(|source| TlsError::Pem {
            path: files.key.clone(),
            source,
        })?;
        let mut config = builder.with_single_cert(certificates(&files.certificates)?, key)?;
        config.alpn_protocols = vec![b"http/1.1".to_vec()];
        Ok(Self(TlsAcceptor::from(Arc::new(config))))
    }
}

impl std::fmt::Debug for Acceptor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Acceptor")
    }
}

fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let bytes = read(path)?;
    let certificates: Result<Vec<_>, pem::Error> = CertificateDer::pem_slice_iter(&bytes).collect();
    certificates.map_err(|source| TlsError::Pem {
        path: path.to_path_buf(),
        source,
    })
}

fn read(path: &Path) -> Result<Vec<u8>, TlsError> {
    let text = crate::file::read_text(path, MAX_BYTES);
    text.map(String::into_bytes)
        .map_err(|source| TlsError::Read {
            path: path.to_path_buf(),
            source,
        })
}

impl<S: AsyncRead + AsyncWrite + Unpin + Send + 'static> WrapStream<S> for Acceptor {
    type Io = Stream<Connection<S>>;

    fn wrap(&self, connection: Connection<S>) -> Self::Io {
        Stream::Handshake(Box::new(self.0.accept(connection)))
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> Stream<S> {
    /// Advances the handshake, and returns the stream once the handshake is complete.
    fn poll_open(&mut self, context: &mut Context<'_>) -> Poll<io::Result<Pin<&mut TlsStream<S>>>> {
        if let Self::Handshake(accept) = self {
            let agreed = ready!(Pin::new(&mut **accept).poll(context));
            *self = Self::Failed;
            *self = Self::Open(Box::new(agreed?));
        }
        Poll::Ready(match self {
            Self::Open(stream) => Ok(Pin::new(stream)),
            Self::Handshake(_) | Self::Failed => Err(io::ErrorKind::NotConnected.into()),
        })
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> AsyncRead for Stream<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        ready!(self.poll_open(context))?.poll_read(context, buffer)
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> AsyncWrite for Stream<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        ready!(self.poll_open(context))?.poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        ready!(self.poll_open(context))?.poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        match ready!(self.poll_open(context)) {
            Ok(stream) => stream.poll_shutdown(context),
            // After a failed handshake, no shutdown message is possible.
            Err(_) => Poll::Ready(Ok(())),
        }
    }
}
