use std::time::Duration;

use super::*;

const SECRET: &str = "0123456789abcdef";

fn token() -> Token {
    Token(SECRET.as_bytes().into())
}

fn headers(pairs: &[(&str, &str)]) -> HeaderMap {
    let pair = |(name, value): &(&str, &str)| {
        (
            HeaderName::from_bytes(name.as_bytes()).unwrap(),
            value.parse().unwrap(),
        )
    };
    pairs.iter().map(pair).collect()
}

/// Returns the code of the refusal, if the request is refused.
fn refusal(door: &AccessRules, pairs: &[(&str, &str)]) -> Option<Code> {
    let answer = door.check_request(&headers(pairs), Instant::now());
    answer.err().map(|problem| problem.code())
}

/// Returns access rules that grant all rights.
fn access_rules(kind: Kind) -> AccessRules {
    AccessRules::new(kind, Rights::new(Access::All, None))
}

#[test]
fn a_loopback_listener_refuses_requests_for_foreign_hosts() {
    let door = access_rules(Kind::Loopback(None));
    for host in ["localhost", "127.0.0.1:17401", "[::1]:9000"] {
        assert_eq!(refusal(&door, &[("host", host)]), None, "{host}");
    }
    for host in ["evil.example", "localhost:x@evil", "[::1]evil", ""] {
        let refused = refusal(&door, &[("host", host)]);
        assert_eq!(refused, Some(Code::ForeignHost), "{host}");
    }
    assert_eq!(refusal(&door, &[]), Some(Code::ForeignHost));
    let two = [("host", "localhost"), ("host", "evil.example")];
    assert_eq!(refusal(&door, &two), Some(Code::ForeignHost));
}

#[test]
fn a_request_with_a_foreign_origin_among_several_is_refused() {
    let door = access_rules(Kind::Loopback(None));
    let own = ("origin", "http://localhost");
    for second in [
        ("origin", "http://evil.example"),
        ("sec-fetch-site", "cross-site"),
    ] {
        let site = ("sec-fetch-site", "none");
        let request = [("host", "localhost"), own, site, second];
        let refused = refusal(&door, &request);
        assert_eq!(refused, Some(Code::ForeignOrigin), "{second:?}");
    }
    assert_eq!(refusal(&door, &[("host", "localhost"), own, own]), None);
}

#[test]
fn refused_requests_do_not_use_up_the_rate_of_admitted_clients() {
    let now = Instant::now();
    let right = headers(&[("authorization", "Bearer 0123456789abcdef")]);
    let foreign = headers(&[
        ("host", "evil.example"),
        ("authorization", "Bearer 0123456789abcdef"),
    ]);
    for (door, outsider, client) in [
        (
            access_rules(Kind::Network(token())),
            HeaderMap::new(),
            right,
        ),
        (
            access_rules(Kind::Loopback(None)),
            foreign,
            headers(&[("host", "localhost")]),
        ),
    ] {
        let answered = |headers: &HeaderMap| match door.check_request(headers, now) {
            Err(problem) if problem.code() == Code::TooManyRequests => 0,
            _ => 1,
        };
        let outside: u32 = (0..5_000).map(|_| answered(&outsider)).sum();
        assert_eq!(outside, 1_000);
        let inside: u32 = (0..370).map(|_| answered(&client)).sum();
        assert_eq!(inside, 370);
    }
}

#[test]
fn clients_without_a_token_do_not_use_up_the_rate_of_page_tokens() {
    let now = Instant::now();
    let page = page::Shared::default();
    let token = page.tokens.create().unwrap();
    let granted = Rights::new(Access::Watch, None);
    let door = AccessRules::new(Kind::Loopback(None), granted).with(page);
    let plain = headers(&[("host", "localhost")]);
    let bearer = format!("Bearer {token}");
    let holder = headers(&[("host", "localhost"), ("authorization", &bearer)]);
    let answered = (0..5_000).filter(|_| door.check_request(&plain, now).is_ok());
    assert_eq!(answered.count(), 1_000);
    let answered = (0..370).filter(|_| {
        let granted = door.check_request(&holder, now);
        granted.is_ok_and(|granted| granted.has_token() && granted.access() == Access::All)
    });
    assert_eq!(answered.count(), 370);
}

#[test]
fn loopback_grants_the_configured_rights_and_socket_and_token_grant_all() {
    for loopback in [Access::Read, Access::Watch, Access::All] {
        assert_eq!(Kind::Loopback(None).access(loopback), loopback);
        for kind in [
            Kind::Socket,
            Kind::Loopback(Some(token())),
            Kind::Network(token()),
        ] {
            assert_eq!(kind.access(loopback), Access::All);
        }
    }
    let granted = Rights::new(Access::Watch, Some(Path::new("/run/a.sock").into()));
    assert!(granted.require(Access::Read).is_ok() && granted.require(Access::Watch).is_ok());
    let refused = granted.require(Access::All).unwrap_err();
    assert_eq!(refused.code(), Code::NeedsSocket);
    let refused = format!("{refused:?}");
    for part in ["/run/a.sock", "usermod -aG ros2probe", "api.loopback: all"] {
        assert!(refused.contains(part), "{refused}");
    }
}

#[test]
fn requests_from_web_pages_of_other_origins_are_refused() {
    for door in [
        access_rules(Kind::Loopback(None)),
        access_rules(Kind::Network(token())),
    ] {
        let host = ("host", "localhost:17401");
        let bearer = ("authorization", "Bearer 0123456789abcdef");
        let answer = |pair| refusal(&door, &[host, bearer, pair]);
        for good in [
            ("origin", "http://localhost:17401"),
            ("sec-fetch-site", "same-origin"),
            ("sec-fetch-site", "none"),
        ] {
            assert_eq!(answer(good), None, "{good:?}");
        }
        for bad in [
            ("origin", "http://evil.example"),
            ("origin", "http://localhost:3000"),
            ("origin", "null"),
            ("origin", ""),
            ("sec-fetch-site", "cross-site"),
            ("sec-fetch-site", "same-site"),
        ] {
            assert_eq!(answer(bad), Some(Code::ForeignOrigin), "{bad:?}");
        }
    }
}

#[test]
fn a_configured_token_is_required_except_on_the_unix_socket() {
    for door in [
        access_rules(Kind::Network(token())),
        access_rules(Kind::Loopback(Some(token()))),
    ] {
        let with = |value| refusal(&door, &[("host", "localhost"), ("authorization", value)]);
        assert_eq!(with("Bearer 0123456789abcdef"), None);
        assert_eq!(with("bearer  0123456789abcdef "), None);
        for wrong in [
            "Bearer 0123456789abcdeg",
            "Bearer 0123456789abcde",
            "Bearer 0123456789abcdef0",
            "Bearer ",
            "Bearer",
            "",
            "Basic 0123456789abcdef",
            "0123456789abcdef",
        ] {
            assert_eq!(with(wrong), Some(Code::Unauthorized), "{wrong}");
        }
        let without = refusal(&door, &[("host", "localhost")]);
        assert_eq!(without, Some(Code::Unauthorized));
    }
    let named = [
        ("host", "robot1:17401"),
        ("authorization", "Bearer 0123456789abcdef"),
    ];
    assert_eq!(refusal(&access_rules(Kind::Network(token())), &named), None);
    let anything = [("host", "evil.example"), ("origin", "http://evil.example")];
    assert_eq!(refusal(&access_rules(Kind::Socket), &anything), None);
}

#[test]
fn a_long_body_is_refused_before_it_is_read() {
    let door = access_rules(Kind::Socket);
    let length = |length: &str| refusal(&door, &[("content-length", length)]);
    assert_eq!(length("16384"), None);
    assert_eq!(length("16385"), Some(Code::BodyTooLarge));
}

#[test]
fn a_flood_exceeds_the_rate_limit_until_the_bucket_refills() {
    let start = Instant::now();
    let mut bucket = Bucket {
        left: REQUEST_BURST,
        at: start,
    };
    let drawn = (0..2000).filter(|_| bucket.draw(start)).count();
    assert_eq!(drawn, 1000);
    let later = start + Duration::from_millis(10);
    assert_eq!((0..100).filter(|_| bucket.draw(later)).count(), 5);
    let door = access_rules(Kind::Socket);
    let refused = |_: &u32| door.check_request(&HeaderMap::new(), start).is_err();
    assert_eq!((0..2000).filter(refused).count(), 1000);
    let again = door.check_request(&HeaderMap::new(), start).unwrap_err();
    assert_eq!(again.code(), Code::TooManyRequests);

    let rested = start + Duration::from_secs(3600);
    assert_eq!((0..2000).filter(|_| bucket.draw(rested)).count(), 1000);
}

#[test]
fn a_token_that_could_be_guessed_is_rejected() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("token");
    let load = |text: &[u8]| {
        std::fs::write(&path, text).unwrap();
        Token::load(&path)
    };
    assert!(load(b"0123456789abcdef\n").unwrap().is(SECRET.as_bytes()));
    for unfit in [
        &b""[..],
        b"short\n",
        b"0123456789 abcdef",
        b"0123456789abcde\xff",
        b"0123456789\nabcdef",
        &[b'a'; 5000],
    ] {
        assert!(matches!(load(unfit), Err(TokenError::Unfit { .. })));
    }
    std::fs::remove_file(&path).unwrap();
    let error = Token::load(&path).unwrap_err();
    assert!(error.to_string().contains("api.token_file"), "{error}");
}
