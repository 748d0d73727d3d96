//! Exporting over TLS: only to a receiver whose certificate is known.

use std::path::Path;
use std::process::Command;

use crate::rp;
use opentelemetry_proto::tonic::collector::metrics::v1::metrics_service_server::{
    MetricsService, MetricsServiceServer,
};
use opentelemetry_proto::tonic::collector::metrics::v1::{
    ExportMetricsServiceRequest, ExportMetricsServiceResponse,
};
use ros2probe_testing::local_agent::LocalAgent;
use tokio::net::TcpListener;
use tonic::transport::server::{Server, TcpIncoming};
use tonic::transport::{Identity, ServerTlsConfig};
use tonic::{Request, Response, Status};

fn configuration(directory: &Path, port: u16) -> String {
    let path = directory.join("ros2probe.yaml");
    let yaml = format!("otlp: {{endpoint: 'https://localhost:{port}', interval_s: 1}}\n");
    std::fs::write(&path, yaml).unwrap();
    path.to_str().unwrap().to_owned()
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
async fn a_receiver_is_believed_whose_certificate_is_known_and_no_other() {
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
    let made = Command::new("openssl")
        .args([
            "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2",
        ])
        .args([
            "-subj",
            "/CN=collector",
            "-addext",
            "subjectAltName=DNS:localhost",
        ])
        .args(["-addext", "basicConstraints=critical,CA:FALSE"])
        .args(["-keyout", &path("key"), "-out", &path("certificate")])
        .output()
        .unwrap_or_else(|error| panic!("openssl: {error}; `apt-get install openssl`"));
    assert!(made.status.success());
    let read = |name: &str| std::fs::read(path(name)).unwrap();
    let identity = Identity::from_pem(read("certificate"), read("key"));
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = listener.local_addr().unwrap().port();
    let server = Server::builder()
        .tls_config(ServerTlsConfig::new().identity(identity))
        .unwrap()
        .add_service(MetricsServiceServer::new(Receiver));
    tokio::spawn(server.serve_with_incoming(TcpIncoming::from(listener)));

    let configuration = configuration(directory.path(), port);
    let count = |outcome: &str| {
        format!("ros2probe_otlp_exports_total{{signal=\"metrics\",outcome=\"{outcome}\"}}")
    };
    let arguments = ["--config", configuration.as_str()];
    for (known, outcome, never) in [
        (Some(path("certificate")), "delivered", "retried"),
        (None, "retried", "delivered"),
    ] {
        let mut command = rp();
        if let Some(known) = known {
            command.env("SSL_CERT_FILE", known);
        }
        let agent = LocalAgent::start(&mut command, &arguments);
        agent.wait_for_metric(&count(outcome), |count| count > 0.0);
        agent.wait_for_metric(&count(never), |count| count < 0.5);
    }
}
