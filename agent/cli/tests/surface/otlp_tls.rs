//! Exports over TLS only to a receiver whose certificate is signed by a known authority.

use std::convert::Infallible;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;

use crate::rp;
use http_body_util::{BodyExt as _, Full};
use hyper::body::{Bytes, Incoming};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::TokioIo;
use opentelemetry_proto::tonic::collector::metrics::v1::metrics_service_server::{
    MetricsService, MetricsServiceServer,
};
use opentelemetry_proto::tonic::collector::metrics::v1::{
    ExportMetricsServiceRequest, ExportMetricsServiceResponse,
};
use prost::Message as _;
use ros2probe_testing::local_agent::LocalAgent;
use tokio::net::TcpListener;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::ServerConfig;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tonic::transport::server::{Server, TcpIncoming};
use tonic::transport::{Identity, ServerTlsConfig};
use tonic::{Request, Response, Status};

/// Creates a private authority and a certificate for `localhost` that it signs, in the files
/// `authority`, `certificate` and `key`.
pub(crate) fn make_certificate(directory: &Path) {
    let make = |name: &str, key: &str, out: &str, more: &[&str]| {
        let made = Command::new("openssl")
            .args(["req", "-x509", "-nodes", "-days", "2", "-newkey", "ec"])
            .args(["-pkeyopt", "ec_paramgen_curve:prime256v1", "-subj", name])
            .args(["-keyout", key, "-out", out])
            .args(more)
            .current_dir(directory)
            .output()
            .unwrap_or_else(|error| panic!("openssl: {error}; `apt-get install openssl`"));
        let stderr = String::from_utf8_lossy(&made.stderr);
        assert!(made.status.success(), "{stderr}");
    };
    make("/CN=authority", "authority.key", "authority", &[]);
    let signed = [
        "-CA",
        "authority",
        "-CAkey",
        "authority.key",
        "-addext",
        "subjectAltName=DNS:localhost",
        "-addext",
        "basicConstraints=critical,CA:FALSE",
    ];
    make("/CN=collector", "key", "certificate", &signed);
}

/// Creates the files of [`make_certificate`], and returns the configuration of a server that presents
/// the certificate.
pub(crate) fn make_server_config(directory: &Path) -> ServerConfig {
    make_certificate(directory);
    let certificate = CertificateDer::from_pem_file(directory.join("certificate")).unwrap();
    let key = PrivateKeyDer::from_pem_file(directory.join("key")).unwrap();
    let config = ServerConfig::builder().with_no_client_auth();
    config.with_single_cert(vec![certificate], key).unwrap()
}

/// Asserts that exports to the receiver at this port succeed only with its authority.
fn assert_believed_if_known(directory: &Path, port: u16, protocol: &str) {
    let path = |name: &str| directory.join(name).to_str().unwrap().to_owned();
    let configuration = path("ros2probe.yaml");
    let yaml = format!(
        "otlp: {{endpoint: 'https://localhost:{port}', protocol: {protocol}, interval_s: 1}}\n"
    );
    std::fs::write(&configuration, yaml).unwrap();
    let count = |outcome: &str| {
        format!("ros2probe_otlp_exports_total{{signal=\"metrics\",outcome=\"{outcome}\"}}")
    };
    let arguments = ["--config", configuration.as_str()];
    for (known, outcome, never) in [
        (Some(path("authority")), "delivered", "retried"),
        (None, "retried", "delivered"),
    ] {
        let mut command = rp();
        if let Some(known) = known {
            command.env("SSL_CERT_FILE", known);
        }
        let agent = LocalAgent::start(&mut command, &arguments);
        // Counters, gauges and histograms are separate requests.
        let wanted = if outcome == "delivered" { 3.0 } else { 1.0 };
        agent.wait_for_metric(&count(outcome), |count| count >= wanted);
        agent.wait_for_metric(&count(never), |count| count < 0.5);
    }
}

struct Receiver;

#[tonic::async_trait]
impl MetricsService for Receiver {
    async fn export(
        &self,
        request: Request<ExportMetricsServiceRequest>,
    ) -> Result<Response<ExportMetricsServiceResponse>, Status> {
        assert!(!request.into_inner().resource_metrics.is_empty());
        Ok(Response::new(ExportMetricsServiceResponse::default()))
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn only_a_receiver_with_a_known_authority_gets_exports() {
    let directory = tempfile::tempdir().unwrap();
    make_certificate(directory.path());
    let read = |name: &str| std::fs::read(directory.path().join(name)).unwrap();
    let identity = Identity::from_pem(read("certificate"), read("key"));
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = listener.local_addr().unwrap().port();
    let server = Server::builder()
        .tls_config(ServerTlsConfig::new().identity(identity))
        .unwrap()
        .add_service(MetricsServiceServer::new(Receiver));
    tokio::spawn(server.serve_with_incoming(TcpIncoming::from(listener)));
    assert_believed_if_known(directory.path(), port, "grpc");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn only_a_receiver_with_a_known_authority_gets_exports_over_http() {
    let directory = tempfile::tempdir().unwrap();
    let config = make_server_config(directory.path());
    let acceptor = TlsAcceptor::from(Arc::new(config));
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = listener.local_addr().unwrap().port();
    tokio::spawn(async move {
        loop {
            let (stream, _) = listener.accept().await.unwrap();
            let acceptor = acceptor.clone();
            tokio::spawn(async move {
                // An agent that does not know the authority ends the handshake.
                let Ok(stream) = acceptor.accept(stream).await else {
                    return;
                };
                let connection = http1::Builder::new();
                let _ = connection
                    .serve_connection(TokioIo::new(stream), service_fn(answer))
                    .await;
            });
        }
    });
    assert_believed_if_known(directory.path(), port, "http/protobuf");
}

async fn answer(
    request: hyper::Request<Incoming>,
) -> Result<hyper::Response<Full<Bytes>>, Infallible> {
    assert_eq!(request.uri().path(), "/v1/metrics");
    let body = request.into_body().collect().await.unwrap().to_bytes();
    let request = ExportMetricsServiceRequest::decode(body).unwrap();
    assert!(!request.resource_metrics.is_empty());
    let answer = ExportMetricsServiceResponse::default().encode_to_vec();
    Ok(hyper::Response::new(answer.into()))
}
