//! Scope of a listing: the query that all listings share, and the choice among equal names.

use ros2probe_wire::DomainId;
use serde::Deserialize;
use utoipa::IntoParams;

use super::problem::{Code, Problem};

const _: () = assert!(ros2probe_api::MAX_DOMAIN_ID == DomainId::MAX.0);

/// The scope of a listing.
#[derive(Clone, Copy, Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
pub(super) struct Scope {
    /// Domain id; by default every domain.
    #[param(minimum = 0, maximum = 232)]
    domain_id: Option<u32>,
    /// Whether to include names that `ros2` hides: names with a token that begins with `_`, and
    /// topics of services and discovery.
    pub(super) hidden: Option<bool>,
}

/// The domain of one entity.
#[derive(Clone, Copy, Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
pub(super) struct Domain {
    /// Domain id; required only if the name exists in several domains.
    #[param(minimum = 0, maximum = 232)]
    domain_id: Option<u32>,
}

impl Scope {
    /// The scope with every domain and hidden names.
    pub(super) const EVERYTHING: Self = Self {
        domain_id: None,
        hidden: Some(true),
    };

    /// # Errors
    /// Fails if the domain id is invalid.
    pub(super) fn checked(self) -> Result<Self, Problem> {
        domain(self.domain_id, Code::MalformedRequest)?;
        Ok(self)
    }

    pub(super) fn includes(self, domain_id: DomainId) -> bool {
        self.domain_id.is_none_or(|own| DomainId(own) == domain_id)
    }

    pub(super) fn shows_hidden(self) -> bool {
        self.hidden == Some(true)
    }
}

impl Domain {
    /// Selects the domain `domain_id`, or every domain if it is `None`.
    pub(super) const fn of(domain_id: Option<u32>) -> Self {
        Self { domain_id }
    }

    /// # Errors
    /// Fails if the domain id is invalid.
    pub(super) fn checked(self) -> Result<Self, Problem> {
        domain(self.domain_id, Code::MalformedRequest)?;
        Ok(self)
    }

    pub(super) fn admits(self, domain_id: DomainId) -> bool {
        self.domain_id.is_none_or(|own| DomainId(own) == domain_id)
    }
}

/// Returns the domain of a request. An invalid number leads to a problem with this code.
///
/// # Errors
/// Fails if the number is not a domain id.
pub(super) fn domain(number: Option<u32>, code: Code) -> Result<Option<DomainId>, Problem> {
    let domain_id = number.map(DomainId::try_from).transpose();
    domain_id.map_err(|error| Problem::new(code, error.to_string()))
}

/// Returns the only entity in `found`, a list of entities with their domains.
///
/// # Errors
/// Returns the problem `missing` without an entity, or a problem that lists the domains of several
/// entities.
pub(super) fn only<T>(
    found: Vec<(DomainId, T)>,
    what: &str,
    missing: impl FnOnce() -> Problem,
) -> Result<T, Problem> {
    let mut domains: Vec<String> = found.iter().map(|(id, _)| id.to_string()).collect();
    domains.dedup();
    let count = found.len();
    match found.into_iter().next() {
        None => Err(missing()),
        Some((_, found)) if count == 1 => Ok(found),
        Some(_) => {
            let domains = domains.join(", ");
            let detail = format!("{what} is in the domains {domains}: add ?domain_id=");
            Err(Problem::new(Code::Ambiguous, detail))
        }
    }
}
