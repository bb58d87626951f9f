//! Access control of the server: only the page that it served has access, and from other machines only with the token.
//!
//! - `Host` must be an address, `localhost` or the host given by `--host`: a name that an attacker points at this machine (DNS
//!   rebinding) is refused.
//! - `Origin`, if a browser sends it, must be this server, over HTTP or, behind a proxy that ends TLS, over HTTPS: no page of another site
//!   can open the socket. Requests from another site without an origin, such as those for images, and from a page of the same host under
//!   the other scheme, are recognised by `Sec-Fetch-Site`.
//! - Beyond loopback every request needs the token: first in the address, then in a cookie.

use axum::http::header::{COOKIE, HOST, ORIGIN};
use axum::http::{HeaderMap, Method, Uri};
use std::net::IpAddr;

/// Name of the parameter in the address.
pub const TOKEN_NAME: &str = "token";
/// Path to which pages send scenes.
pub const UPLOAD_PATH: &str = "/merge/";

/// Why a request is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Refusal {
    Method,
    Host,
    Origin,
    Token,
}

impl Refusal {
    /// The reason in words, for the log and the response.
    pub fn reason(self) -> &'static str {
        match self {
            Self::Method => "only GET requests and scenes to merge are accepted",
            Self::Host => "the Host of the request is not this server",
            Self::Origin => "the request comes from a page of another site",
            Self::Token => "the address lacks the token: use the one that was printed",
        }
    }
}

/// How a request was admitted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Entry {
    Plain,
    /// With the token in its address: the response sets the cookie.
    ByAddress,
}

pub(crate) struct Guard {
    /// The host given by `--host`.
    pub host: String,
    pub port: u16,
    /// `None` on loopback.
    pub token: Option<String>,
}

impl Guard {
    /// Checks one request.
    pub fn check(&self, method: &Method, uri: &Uri, headers: &HeaderMap) -> Result<Entry, Refusal> {
        let sends = method == Method::POST && uri.path().starts_with(UPLOAD_PATH);
        if method != Method::GET && !sends {
            return Err(Refusal::Method);
        }
        let text = |name: &str| headers.get(name).and_then(|value| value.to_str().ok());
        let host = text(HOST.as_str()).ok_or(Refusal::Host)?;
        if headers.get_all(HOST).iter().count() != 1 || !self.is_own_host(host) {
            return Err(Refusal::Host);
        }
        let is_own = |origin: &str| {
            ["http://", "https://"]
                .iter()
                .any(|scheme| origin.strip_prefix(scheme) == Some(host))
        };
        match headers.get(ORIGIN) {
            Some(origin) if !origin.to_str().is_ok_and(is_own) => return Err(Refusal::Origin),
            // Every browser sends the origin of a POST request.
            None if sends => return Err(Refusal::Origin),
            _ => {}
        }
        // A link on another site may lead to the page; other sites may use nothing else.
        let foreign = matches!(text("sec-fetch-site"), Some("cross-site" | "same-site"));
        if foreign && !(uri.path() == "/" && text("sec-fetch-mode") == Some("navigate")) {
            return Err(Refusal::Origin);
        }
        let Some(token) = &self.token else {
            return Ok(Entry::Plain);
        };
        let query = uri.query().unwrap_or_default().split('&');
        let in_address = query
            .filter_map(|pair| pair.split_once('='))
            .any(|(name, value)| name == TOKEN_NAME && constant_time_eq(value, token));
        if in_address {
            return Ok(Entry::ByAddress);
        }
        let cookies = headers.get_all(COOKIE).iter().filter_map(|value| value.to_str().ok());
        let mut pairs = cookies
            .flat_map(|line| line.split(';'))
            .filter_map(|pair| pair.trim().split_once('='));
        let cookie_name = self.cookie_name();
        if pairs.any(|(name, value)| name == cookie_name && constant_time_eq(value, token)) {
            Ok(Entry::Plain)
        } else {
            Err(Refusal::Token)
        }
    }

    /// Name of the cookie: browsers send the cookies of a host to all of its ports, where other viewers may be.
    fn cookie_name(&self) -> String {
        format!("{TOKEN_NAME}-{}", self.port)
    }

    /// The cookie that has the token; `None` on loopback.
    pub fn cookie(&self) -> Option<String> {
        let token = self.token.as_ref()?;
        Some(format!(
            "{}={token}; HttpOnly; SameSite=Strict; Path=/",
            self.cookie_name()
        ))
    }

    /// Whether `host`, with or without a port, names this server. The port may be that of a tunnel.
    fn is_own_host(&self, host: &str) -> bool {
        let name = match host.rsplit_once(':') {
            Some((name, port)) if port.parse::<u16>().is_ok() && !name.ends_with(':') => name,
            _ => host,
        };
        let address = name
            .trim_start_matches('[')
            .trim_end_matches(']')
            .parse::<IpAddr>()
            .ok();
        match address {
            Some(address) => self.token.is_some() || address.is_loopback(),
            None => name.eq_ignore_ascii_case("localhost") || name.eq_ignore_ascii_case(&self.host),
        }
    }
}

/// Compares in a time that does not depend on how many bytes are equal.
fn constant_time_eq(a: &str, b: &str) -> bool {
    a.len() == b.len()
        && a.bytes()
            .zip(b.bytes())
            .fold(0, |different, (a, b)| different | (a ^ b))
            == 0
}

/// 128 random bits from the operating system, as hexadecimal digits.
pub(crate) fn random_token() -> Result<String, getrandom::Error> {
    let mut bytes = [0; 16];
    getrandom::fill(&mut bytes)?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(guard: &Guard, uri: &str, headers: &[(&'static str, &str)]) -> Result<Entry, Refusal> {
        let mut map = HeaderMap::new();
        for (name, value) in headers {
            map.append(*name, value.parse().expect("a header"));
        }
        guard.check(&Method::GET, &uri.parse().expect("a path"), &map)
    }

    fn local() -> Guard {
        Guard {
            host: "127.0.0.1".into(),
            port: 7979,
            token: None,
        }
    }

    #[test]
    fn on_loopback_only_its_own_names_and_page_pass() {
        for host in [
            "localhost:7979",
            "127.0.0.1:7979",
            "[::1]:7979",
            "LOCALHOST",
            "127.0.0.1:9000",
        ] {
            assert_eq!(check(&local(), "/", &[("host", host)]), Ok(Entry::Plain), "{host}");
        }
        for host in [
            "evil.example",
            "evil.example:7979",
            "10.0.0.1:7979",
            "localhost.evil.example",
            "",
            "::1:x",
        ] {
            assert_eq!(check(&local(), "/", &[("host", host)]), Err(Refusal::Host), "{host}");
        }
        assert_eq!(check(&local(), "/", &[]), Err(Refusal::Host));
        let twice = [("host", "localhost"), ("host", "localhost")];
        assert_eq!(check(&local(), "/", &twice), Err(Refusal::Host));
        for origin in ["http://localhost:7979", "https://localhost:7979"] {
            let own = [("host", "localhost:7979"), ("origin", origin)];
            assert_eq!(check(&local(), "/socket", &own), Ok(Entry::Plain), "{origin}");
            // Of two schemes on one host, browsers call the other one another site.
            let foreign = [own[0], own[1], ("sec-fetch-site", "cross-site")];
            assert_eq!(check(&local(), "/socket", &foreign), Err(Refusal::Origin), "{origin}");
        }
        let rebound = [("host", "evil.example"), ("origin", "https://evil.example")];
        assert_eq!(check(&local(), "/socket", &rebound), Err(Refusal::Host));
        for origin in [
            "http://localhost:3000",
            "https://localhost",
            "wss://localhost:7979",
            "localhost:7979",
            "null",
            "http://evil.example",
        ] {
            let foreign = [("host", "localhost:7979"), ("origin", origin)];
            assert_eq!(check(&local(), "/socket", &foreign), Err(Refusal::Origin), "{origin}");
        }
        let image = [
            ("host", "localhost"),
            ("sec-fetch-site", "cross-site"),
            ("sec-fetch-mode", "no-cors"),
        ];
        assert_eq!(check(&local(), "/view/0/photo", &image), Err(Refusal::Origin));
        let link = [
            ("host", "localhost"),
            ("sec-fetch-site", "cross-site"),
            ("sec-fetch-mode", "navigate"),
        ];
        assert_eq!(check(&local(), "/", &link), Ok(Entry::Plain));
        assert_eq!(check(&local(), "/splats", &link), Err(Refusal::Origin));
        assert_eq!(
            local().check(&Method::POST, &Uri::from_static("/"), &HeaderMap::new()),
            Err(Refusal::Method)
        );
        let post = |origin: Option<&'static str>| {
            let mut headers = HeaderMap::from_iter([(HOST, "localhost:7979".parse().expect("a header"))]);
            headers.extend(origin.map(|origin| (ORIGIN, origin.parse().expect("a header"))));
            local().check(&Method::POST, &Uri::from_static("/merge/a.ply"), &headers)
        };
        assert_eq!(post(Some("http://localhost:7979")), Ok(Entry::Plain));
        assert_eq!(post(Some("http://evil.example")), Err(Refusal::Origin));
        assert_eq!(post(None), Err(Refusal::Origin));
    }

    #[test]
    fn beyond_loopback_the_token_is_needed_and_a_name_must_be_asked_for() {
        let guard = Guard {
            host: "box".into(),
            port: 7979,
            token: Some("0123abcd".into()),
        };
        let host = ("host", "10.0.0.7:7979");
        assert_eq!(check(&guard, "/", &[host]), Err(Refusal::Token));
        assert_eq!(check(&guard, "/?token=0123abcc", &[host]), Err(Refusal::Token));
        assert_eq!(check(&guard, "/?a=1&token=0123abcd", &[host]), Ok(Entry::ByAddress));
        assert_eq!(
            check(&guard, "/", &[host, ("cookie", "token-7980=4567; token-7979=0123abcd")]),
            Ok(Entry::Plain)
        );
        for cookie in ["token-7979=0123abcd0", "token-7980=0123abcd"] {
            let refused = check(&guard, "/", &[host, ("cookie", cookie)]);
            assert_eq!(refused, Err(Refusal::Token), "{cookie}");
        }
        assert_eq!(
            check(&guard, "/?token=0123abcd", &[("host", "box:7979")]),
            Ok(Entry::ByAddress)
        );
        assert_eq!(
            check(&guard, "/?token=0123abcd", &[("host", "evil.example")]),
            Err(Refusal::Host)
        );
    }

    #[test]
    fn tokens_differ() {
        let tokens = [random_token(), random_token()].map(|token| token.expect("random numbers"));
        assert!(tokens[0] != tokens[1] && tokens[0].len() == 32);
    }
}
