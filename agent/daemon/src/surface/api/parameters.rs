//! Path and query parameters. An invalid parameter is answered with problem details.

use axum::extract::rejection::{PathRejection, QueryRejection};
use axum::extract::{FromRequestParts, Path, Query};
use axum::http::Uri;
use axum::http::request::Parts;
use serde::de::DeserializeOwned;

use super::problem::{Code, Problem};

/// `{*topic}` at the end of a path: a ROS name, whose leading slash the path may omit. A client
/// that encodes the whole name includes the slash (`%2Fpoints`).
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Name(pub(super) String);

/// The query; unknown parameters are rejected.
#[derive(Clone, Copy, Debug)]
pub(super) struct Parameters<T>(pub(super) T);

/// Returns the value with this label, for a parameter called `what`.
///
/// # Errors
/// Fails if no value has this label.
pub(super) fn labelled<T: Copy>(
    what: &str,
    label: &str,
    all: &[T],
    label_of: fn(T) -> &'static str,
) -> Result<T, Problem> {
    let found = all.iter().find(|value| label_of(**value) == label);
    found.copied().ok_or_else(|| {
        let labels: Vec<_> = all.iter().map(|value| label_of(*value)).collect();
        let detail = format!(
            "the {what} `{}` is none of {}",
            label.chars().take(32).collect::<String>(),
            labels.join(", ")
        );
        Problem::new(Code::InvalidRequest, detail)
    })
}

impl<S: Send + Sync> FromRequestParts<S> for Name {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let path = Path::<String>::from_request_parts(parts, state).await;
        let Path(name) = path.map_err(|error: PathRejection| {
            Problem::new(Code::MalformedRequest, error.body_text())
        })?;
        Ok(Self(if name.starts_with('/') {
            name
        } else {
            format!("/{name}")
        }))
    }
}

impl<T: DeserializeOwned, S: Send + Sync> FromRequestParts<S> for Parameters<T> {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let query = Query::<T>::from_request_parts(parts, state).await;
        query.map(Self::from).map_err(|error| problem(&error))
    }
}

impl<T> From<Query<T>> for Parameters<T> {
    fn from(Query(parameters): Query<T>) -> Self {
        Self(parameters)
    }
}

impl<T: DeserializeOwned> Parameters<T> {
    /// Parses the query of an address, for routes with several forms of query.
    ///
    /// # Errors
    /// Fails if a parameter is unknown or has an invalid value.
    pub(super) fn of(uri: &Uri) -> Result<Self, Problem> {
        let query = Query::<T>::try_from_uri(uri);
        query.map(Self::from).map_err(|error| problem(&error))
    }
}

fn problem(error: &QueryRejection) -> Problem {
    Problem::new(Code::MalformedRequest, error.body_text())
}
