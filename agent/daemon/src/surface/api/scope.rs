//! What a listing is about: the query that all of them share, and how names are told apart.

use ros2probe_wire::DomainId;
use serde::Deserialize;
use utoipa::IntoParams;

use super::problem::{Code, Problem};

const _: () = assert!(ros2probe_api::MAX_DOMAIN_ID == DomainId::MAX.0);

/// What a listing covers.
#[derive(Clone, Copy, Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
pub(super) struct Scope {
    /// Only this domain; every domain when left out.
    #[param(minimum = 0, maximum = 232)]
    domain_id: Option<u32>,
    /// Also what `ros2` hides: names with a token that begins with `_`, and the plumbing below
    /// services and discovery.
    pub(super) hidden: Option<bool>,
}

/// The domain of one thing.
#[derive(Clone, Copy, Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
#[into_params(parameter_in = Query)]
pub(super) struct Domain {
    /// Its domain; may be left out where the name is in one domain only.
    #[param(minimum = 0, maximum = 232)]
    domain_id: Option<u32>,
}

impl Scope {
    /// # Errors
    /// There is no such domain.
    pub(super) fn checked(self) -> Result<Self, Problem> {
        check(self.domain_id)?;
        Ok(self)
    }

    pub(super) fn admits(self, domain_id: DomainId) -> bool {
        self.domain_id.is_none_or(|own| DomainId(own) == domain_id)
    }

    pub(super) fn shows_hidden(self) -> bool {
        self.hidden == Some(true)
    }
}

impl Domain {
    /// This one, or any.
    pub(super) const fn of(domain_id: Option<u32>) -> Self {
        Self { domain_id }
    }

    /// # Errors
    /// There is no such domain.
    pub(super) fn checked(self) -> Result<Self, Problem> {
        check(self.domain_id)?;
        Ok(self)
    }

    pub(super) fn admits(self, domain_id: DomainId) -> bool {
        self.domain_id.is_none_or(|own| DomainId(own) == domain_id)
    }
}

fn check(domain_id: Option<u32>) -> Result<(), Problem> {
    match domain_id {
        Some(domain_id) if domain_id > DomainId::MAX.0 => {
            let detail = format!(
                "domain_id is {domain_id}, must be between 0 and {}",
                DomainId::MAX
            );
            Err(Problem::new(Code::MalformedRequest, detail))
        }
        _ => Ok(()),
    }
}

/// The one of `found` that is meant, each with its domain.
///
/// # Errors
/// There is none, which `missing` says better, or there are several.
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
