//! The OpenAPI document: derived from the routes, then completed with their common parts. A test
//! compares it with `config/openapi.json`.

use std::collections::BTreeSet;
use std::sync::LazyLock;

use axum::http::header::CONTENT_TYPE;
use axum::response::IntoResponse;
use serde_json::Value;
use utoipa::OpenApi;
use utoipa::openapi::path::Operation;
use utoipa::openapi::security::{Http, HttpAuthScheme, SecurityScheme};
use utoipa::openapi::{
    ContentBuilder, Object, PathItem, Ref, RefOr, Required, ResponseBuilder, Schema,
    SecurityRequirement,
};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::problem::{MEDIA_TYPE, ProblemBody};
use super::{Context, nouns};

/// Error responses that any request may receive.
const COMMON_ERRORS: [(&str, &str); 6] = [
    ("400", "The request cannot be read."),
    ("401", "The listener requires a bearer token."),
    (
        "403",
        "Sent to a foreign name, by a foreign web page, or to a listener that does not grant it.",
    ),
    ("413", "The body is too large."),
    ("429", "Too many requests."),
    ("503", "The agent is shutting down."),
];

#[derive(OpenApi)]
#[openapi(
    info(
        title = "ros2probe",
        description = "Control API of the ros2probe agent on one robot: watches, measurements and recordings.",
        license(name = "Apache-2.0 OR MIT", identifier = "Apache-2.0 OR MIT")
    ),
    // The route of topics also serves these paths, because names may contain slashes.
    paths(
        super::history::show,
        super::messages::definition,
        super::messages::follow
    ),
    // utoipa does not collect the schema of a type parameter, nor that of a path parameter.
    components(schemas(
        ProblemBody,
        super::messages::MessageLine,
        ros2probe_api::history::KeptNoun
    )),
    tags(
        (name = "watch", description = "Watches, changed while the agent runs."),
        (name = "events", description = "Events as they occur."),
        (name = "samples", description = "Messages of topics as they arrive."),
        (name = "recordings", description = "Bags that the agent writes."),
        (name = "graph", description = "The robot's graph and measurements."),
        (name = "robot", description = "What the robot itself says."),
        (name = "agent", description = "The agent itself."),
    )
)]
struct Head;

/// Returns the metadata of the document.
pub(super) fn head() -> utoipa::openapi::OpenApi {
    Head::openapi()
}

pub(super) fn routes() -> OpenApiRouter<Context> {
    OpenApiRouter::new().routes(routes!(openapi))
}

/// Returns the complete document.
#[must_use]
pub fn document() -> utoipa::openapi::OpenApi {
    let mut document = nouns(None).into_openapi();
    let paths = std::mem::take(&mut document.paths.paths);
    for (path, mut item) in paths {
        // The router marks parameters that may contain slashes with `*`.
        let path = path.replace("{*", "{");
        for (method, operation) in operations(&mut item) {
            operation.operation_id = Some(operation_id(method, &path));
            complete(operation);
        }
        document.paths.paths.insert(path, item);
    }
    let bodies = request_bodies(&document);
    let components = document.components.get_or_insert_default();
    for (name, schema) in &mut components.schemas {
        complete_schema(schema, !bodies.contains(name));
    }
    let scheme = SecurityScheme::Http(Http::new(HttpAuthScheme::Bearer));
    components.add_security_scheme("token", scheme);
    let none = SecurityRequirement::default();
    let token = SecurityRequirement::new("token", [] as [&str; 0]);
    document.security = Some(vec![none, token]);
    document
}

fn operations(item: &mut PathItem) -> impl Iterator<Item = (&'static str, &mut Operation)> {
    let all = [
        ("get", &mut item.get),
        ("post", &mut item.post),
        ("put", &mut item.put),
        ("delete", &mut item.delete),
    ];
    let operations = all.into_iter();
    operations.filter_map(|(method, operation)| Some((method, operation.as_mut()?)))
}

/// Returns the id of an operation, which generated clients take as the name of a function:
/// `get_recordings_by_name_files`. The names of the handlers are not unique.
fn operation_id(method: &str, path: &str) -> String {
    let mut id = method.to_owned();
    for segment in path.split('/') {
        let name = segment
            .strip_prefix('{')
            .and_then(|segment| segment.strip_suffix('}'));
        let word = name
            .unwrap_or(segment)
            .replace(|c: char| !c.is_ascii_alphanumeric(), "_");
        let word = word.trim_matches('_');
        if !word.is_empty() {
            id += if name.is_some() { "_by_" } else { "_" };
            id += word;
        }
    }
    id
}

fn complete(operation: &mut Operation) {
    // All request bodies are optional.
    if let Some(RefOr::T(body)) = &mut operation.request_body {
        body.required = Some(Required::False);
    }
    for (status, description) in COMMON_ERRORS {
        let problem = ContentBuilder::new().schema(Some(Ref::from_schema_name("Problem")));
        let response = ResponseBuilder::new()
            .description(description)
            .content(MEDIA_TYPE, problem.build())
            .build();
        let responses = &mut operation.responses.responses;
        responses
            .entry(status.to_owned())
            .or_insert(RefOr::T(response));
    }
}

/// Returns the names of the schemas that clients send.
fn request_bodies(document: &utoipa::openapi::OpenApi) -> BTreeSet<String> {
    let mut names = BTreeSet::new();
    let bodies = serde_json::to_value(&document.paths).unwrap_or_default();
    let schemas = serde_json::to_value(&document.components).unwrap_or_default();
    let mut waiting = Vec::new();
    let paths = bodies.as_object().into_iter().flatten();
    let operations = paths.flat_map(|(_, item)| item.as_object().into_iter().flatten());
    waiting.extend(operations.filter_map(|(_, operation)| operation.get("requestBody")));
    while let Some(value) = waiting.pop() {
        match value {
            Value::Object(object) => waiting.extend(object.values()),
            Value::Array(array) => waiting.extend(array),
            Value::String(text) => {
                let name = text.strip_prefix("#/components/schemas/");
                if let Some(name) = name.filter(|name| names.insert((*name).to_owned())) {
                    waiting.extend(schemas.pointer(&format!("/schemas/{name}")));
                }
            }
            _ => {}
        }
    }
    names
}

/// Sorts the properties of a schema. In an answer, the properties are also required. Clients
/// tolerate missing fields of older agents, but the document describes this agent, which sends all
/// fields.
fn complete_schema(schema: &mut RefOr<Schema>, is_answer: bool) {
    let items = match schema {
        RefOr::T(Schema::Object(object)) => {
            if is_answer {
                require_all(object);
            }
            object.properties.sort_keys();
            return;
        }
        RefOr::T(Schema::AllOf(all)) => &mut all.items,
        RefOr::T(Schema::OneOf(one)) => &mut one.items,
        _ => return,
    };
    for item in items {
        if is_answer {
            take_default(item);
        }
        complete_schema(item, is_answer);
    }
}

/// Requires all properties except properties whose default is null. Does nothing if no property has
/// a default.
fn require_all(object: &mut Object) {
    let defaults = object.properties.values_mut().map(take_default);
    let defaults: Vec<_> = defaults.collect();
    if defaults.iter().all(Option::is_none) {
        return;
    }
    let names = object.properties.keys().zip(defaults);
    let required = names.filter(|(_, default)| !matches!(default, Some(Value::Null)));
    object.required = required.map(|(name, _)| name.clone()).collect();
}

fn take_default(schema: &mut RefOr<Schema>) -> Option<Value> {
    match schema {
        RefOr::Ref(reference) => reference.default.take(),
        RefOr::T(Schema::Object(object)) => object.default.take(),
        RefOr::T(Schema::Array(array)) => array.default.take(),
        RefOr::T(Schema::AllOf(all)) => all.default.take(),
        RefOr::T(Schema::OneOf(one)) => one.default.take(),
        RefOr::T(_) => None,
    }
}

/// This document
#[utoipa::path(
    get,
    path = "/openapi.json",
    tag = "agent",
    responses((status = 200, description = "OpenAPI 3.1.", body = Object))
)]
async fn openapi() -> impl IntoResponse {
    static DOCUMENT_TEXT: LazyLock<String> =
        LazyLock::new(|| document().to_pretty_json().unwrap_or_default());
    ([(CONTENT_TYPE, "application/json")], DOCUMENT_TEXT.as_str())
}
