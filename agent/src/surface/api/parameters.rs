//! What requests say beside their bodies: a topic in the path, and the query. What cannot be read
//! is a problem like any other.

use axum::extract::rejection::{PathRejection, QueryRejection};
use axum::extract::{FromRequestParts, Path, Query};
use axum::http::request::Parts;
use serde::de::DeserializeOwned;

use super::problem::{Code, Problem};

/// `{*topic}` at the end of a path: a ROS name with its leading slash, which the path leaves out,
/// though a client that encodes the whole name may send it (`%2Fpoints`).
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Name(pub(super) String);

/// The query, with no parameter that is unknown.
#[derive(Clone, Copy, Debug)]
pub(super) struct Parameters<T>(pub(super) T);

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
        let Query(parameters) = query.map_err(|error: QueryRejection| {
            Problem::new(Code::MalformedRequest, error.body_text())
        })?;
        Ok(Self(parameters))
    }
}
